"""Which parameters are estimated: base parameters, or the thesis's five of the planar arm."""

from dataclasses import dataclass

import numpy as np

from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.identification.base import base_of, random_regressor
from lwa4d_sim.identification.inertia import NAMES
from lwa4d_sim.identification.parameters import Unknowns
from lwa4d_sim.interfaces import Array


@dataclass(frozen=True)
class ParameterSet:
    """R parameters of an arm's P unknowns.

    Attributes:
        names: of the parameters.
        units: likewise.
        words: what each stands for, in unknowns.
        combine: their values are ``combine @ unknowns`` (r, P).
        motion: what of the regressor without gravity makes their columns (P, r).
        gravity: the same of gravity's part (P, r).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    words: tuple[str, ...]
    combine: Array
    motion: Array
    gravity: Array

    @property
    def splits(self) -> bool:
        """Whether a parameter stands for gravity's part of an unknown only, or for the rest of it."""
        return self.gravity is not self.motion

    def columns(self, Y: Array, gravity: Array | None) -> Array:
        """Regressor (W, n, r) from that of the unknowns (W, n, P) and, where this set `splits` it, gravity's part."""
        return np.asarray(Y @ self.motion if gravity is None else (Y - gravity) @ self.motion + gravity @ self.gravity)

    def unknowns(self, x: Array) -> Array:
        """Some unknowns (P,) of which these are the parameters (r,)."""
        return np.asarray(np.linalg.lstsq(self.combine, x, rcond=None)[0])


def usual_columns(parameters: ParameterSet, unknowns: Unknowns) -> Array:
    """Rms of the parameters' columns (r,) at random states: a measure of what is next to nothing."""
    still = Unknowns(unknowns.chain, np.zeros(3), unknowns.kinds, unknowns.names, unknowns.units)
    Y = random_regressor(unknowns)
    weight = Y - random_regressor(still) if parameters.splits else None
    return np.asarray(np.sqrt((parameters.columns(Y, weight) ** 2).mean(axis=(0, 1))))


def base_set(unknowns: Unknowns, fixed: tuple[str, ...]) -> ParameterSet:
    """Base parameters of the unknowns that are not ``fixed``."""
    base = base_of(unknowns, fixed)
    pick = np.zeros((len(unknowns.names), len(base.names)))
    pick[base.columns, np.arange(len(base.names))] = 1.0
    return ParameterSet(base.names, base.units, base.words, base.combine, pick, pick)


def thesis_set(unknowns: Unknowns, fixed: tuple[str, ...], nominal: Array) -> ParameterSet:
    """The thesis's p1 to p5 (eq. 5.1), followed by the joints' unknowns that are not ``fixed``.

    The five are not free: p5 = g p3 / l2. They are what the thesis estimates all the same.

    Args:
        unknowns: of the planar arm.
        fixed: names of unknowns that are not estimated.
        nominal: values of the unknowns (P,).

    Raises:
        IdentificationError: another arm, or one whose torque is no combination of the five.
    """
    P, n = len(unknowns.names), unknowns.n
    wrong = IdentificationError(
        "identify.parameters: thesis is for lwa4d_planar, two links in a vertical plane; use base"
    )
    if n != 2:
        raise wrong
    first, second = ({name: 10 * link + NAMES.index(name) for name in ("m", "hz", "Iyy")} for link in (0, 1))
    l2, g = float(np.linalg.norm(unknowns.chain.pos[1])), float(np.linalg.norm(unknowns.gravity))
    if l2 == 0 or g == 0:
        raise wrong
    combine, motion, gravity = np.zeros((5, P)), np.zeros((P, 5)), np.zeros((P, 5))
    combine[0, first["Iyy"]], combine[0, second["m"]], motion[first["Iyy"], 0] = 1.0, l2**2, 1.0
    combine[1, second["Iyy"]], motion[second["Iyy"], 1] = 1.0, 1.0
    combine[2, second["hz"]], motion[second["hz"], 2] = l2, 1.0 / l2
    combine[3, first["hz"]], combine[3, second["m"]], gravity[first["hz"], 3] = g, g * l2, 1.0 / g
    combine[4, second["hz"]], gravity[second["hz"], 4] = g, 1.0 / g
    rest = [k for k in range(10 * n, P) if unknowns.names[k] not in fixed]
    picked = np.eye(P)[rest]
    made = ParameterSet(
        names=("p1", "p2", "p3", "p4", "p5", *(unknowns.names[k] for k in rest)),
        units=(*["kg m^2"] * 3, "N m", "N m", *(unknowns.units[k] for k in rest)),
        words=(
            "m1 lc2^2 + m2 l2^2 + Izz1",
            "m2 lc3^2 + Izz2",
            "m2 l2 lc3",
            "g (m1 lc2 + m2 l2)",
            "g m2 lc3",
            *(unknowns.names[k] for k in rest),
        ),
        combine=np.vstack([combine, picked]),
        motion=np.hstack([motion, picked.T]),
        gravity=np.hstack([gravity, picked.T]),
    )
    still = Unknowns(unknowns.chain, np.zeros(3), unknowns.kinds, unknowns.names, unknowns.units)
    Y, Y0 = random_regressor(unknowns), random_regressor(still)
    inertial = np.where(np.arange(P) < 10 * n, nominal, 0.0)
    if not np.allclose(made.columns(Y, Y - Y0) @ (made.combine @ inertial), Y @ inertial, atol=1e-8):
        raise wrong
    return made
