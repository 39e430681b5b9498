"""How well the data tell each parameter: an interval against the size that such a parameter has."""

from dataclasses import dataclass

import numpy as np

from lwa4d_sim.identification.estimate import INTERVAL
from lwa4d_sim.identification.findings import Findings
from lwa4d_sim.identification.problem import Problem
from lwa4d_sim.interfaces import Array

WELL, WEAK, LOST = "well", "weakly", "not"  # told, by the data
NOTHING = 30.0  # assumed: sizes that half an interval may be wide before the number in its middle says nothing at all


@dataclass(frozen=True)
class Grades:
    """Of each parameter.

    Attributes:
        size: a value (r,) that such a parameter of such an arm may well have, in its own unit.
        half: half the width of the 95 % interval (r,); NaN where the data do not tell.
        told: ``WELL`` where ``half`` is below ``size``, ``WEAK`` where not, ``LOST`` where there is no
            estimate, or one with an interval `NOTHING` times as wide as that.
        error: estimate minus truth (r,), NaN where there is either not.
    """

    size: Array
    half: Array
    told: tuple[str, ...]
    error: Array

    def rows(self, told: str) -> list[int]:
        """Indices of the parameters that are told like this."""
        return [k for k, grade in enumerate(self.told) if grade == told]


def grades(found: Findings) -> Grades:
    """How well the data tell each parameter."""
    estimate, half = found.fit.estimate, INTERVAL * found.fit.std_error
    size = sizes(found.problem)
    lost = estimate.lost | (half > NOTHING * size)
    half = np.where(lost, np.nan, half)
    told = tuple(LOST if gone else WELL if h <= s else WEAK for gone, h, s in zip(lost, half, size, strict=True))
    error = np.full(len(size), np.nan) if found.truth is None else np.where(lost, np.nan, estimate.x - found.truth)
    return Grades(size, half, told, error)


def sizes(problem: Problem) -> Array:
    """Sizes (r,) of the parameters: the nominal value, or what their leading unknown may come to, whichever is more.

    A link whose pseudo-inertia is [[S, h], [h^T, m]] has |h_i| <= sqrt(m tr S), I_ii <= tr S and |I_ij| <= tr S / 2,
    because S_ii and its minors are positive (derived from Wensing, Kim, Slotine 2018); tr S = tr I / 2 is taken from
    the nominal arm. A joint's own are what a drive of its peak torque usually has (`problem.USUAL`).
    """
    u, parameters = problem.unknowns, problem.parameters
    pi = problem.nominal[: 10 * u.n].reshape(u.n, 10)
    m, second = pi[:, 0], pi[:, [4, 6, 9]].sum(axis=1) / 2.0
    link = np.stack([m, *[np.sqrt(m * second)] * 3, *(second * f for f in (1.0, 0.5, 1.0, 0.5, 0.5, 1.0))], axis=1)
    usual = dict(zip(u.names, np.concatenate([link.ravel(), problem.usual_joints]), strict=True))
    leading = np.array([usual.get(name, 0.0) for name in parameters.names])
    return np.asarray(np.maximum(np.abs(problem.value(problem.nominal)), leading))
