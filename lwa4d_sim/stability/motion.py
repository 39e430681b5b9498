"""Stability along a motion: frozen at each instant, and over a whole cycle of one that repeats."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lwa4d_sim.controllers import ComputedTorque
from lwa4d_sim.interfaces import NS_PER_S, Array
from lwa4d_sim.runner import run
from lwa4d_sim.settings import IdealLoop
from lwa4d_sim.stability.points import Points
from lwa4d_sim.stability.study import Study

# A motion that ends within this of where it began, in angle and speed, repeats (assumed: nobody would call it closed
# with more) [rad, rad/s].
CLOSED = 1e-3
_MOST = 400  # instants of a motion (assumed: what a curve can show)


@dataclass(frozen=True, slots=True)
class Course:
    """Stability along a motion.

    Attributes:
        t: instants [s] (P,).
        q: joint angles there (P, n) [rad].
        spectral_radius, gain_margin: of the loop frozen at each instant (P,).
        worst: index of the largest radius where some loop is unstable, else of the smallest gain margin.
        floquet: for a motion that repeats, the factor by which a disturbance grows per control period over a whole
            cycle (spectral radius of the product of all periods' matrices, its root); None for one that does not.
    """

    t: Array
    q: Array
    spectral_radius: Array
    gain_margin: Array
    worst: int
    floquet: float | None


def along(study: Study) -> Course:
    """Follow the motion of the study's scenario.

    The frozen loop tells the truth where the arm moves little within the loop's settling time; that is why the factor
    over a cycle is given as well where there is one.
    """
    trajectory = study.blocks.infos[0].trajectory
    period = study.period
    ticks = max(1, round(trajectory.duration / period))
    t = np.arange(ticks) * (trajectory.duration / ticks)
    stride = -(-ticks // _MOST)
    points = path(study, t[::stride])
    loop = study.close(study.linear(points))
    P = len(points.t)
    radius, margin = loop.radius(np.arange(P), np.ones(P)), study.gain_margin(loop)
    worst = int(np.argmin(margin)) if radius.max() < 1.0 else int(np.argmax(radius))
    return Course(points.t, points.q, radius, margin, worst, _floquet(study))


def path(study: Study, t: Array) -> Points:
    """Operating points at ``t``: where the ideal loop takes the arm.

    Computed torque follows its reference; a PD law lags behind it, so its path is found by a run. Where the reference
    jumps, the arm is looked at as if it stood at each place of the path: half-way between two steps it is pulled hard,
    and a frozen loop would tell that pull from shaking no better than the eye.
    """
    if isinstance(study.settings.controller, ComputedTorque) and not study.steps:
        return study.along(t)
    ideal = replace(study.settings, loop=IdealLoop())
    log = run(replace(study.scenario, variants={study.variant: ideal}), study.variant)
    rows = np.minimum(np.rint(t / (log.timestep / NS_PER_S)).astype(np.int64), len(log.q) - 1)
    if study.steps:
        return study.resting(log.q[rows], t)
    ddq = np.gradient(log.dq, log.timestep / NS_PER_S, axis=0)
    return Points(t, log.q[rows], log.dq[rows], ddq[rows], study.along(t).ref)


def _floquet(study: Study) -> float | None:
    """Growth per control period over one cycle of the motion; the arm is frozen in the middle of each period."""
    trajectory: Any = study.blocks.infos[0].trajectory
    if study.ideal or study.steps:
        return None
    cycle = getattr(study.settings.trajectory, "omega", None)
    length = trajectory.duration if cycle is None else 2.0 * np.pi / cycle
    ends = trajectory.joint(np.array([0.0, length - 1e-9]))
    if (
        length > trajectory.duration * (1 + 1e-9)
        or max(np.ptp(ends.q, axis=0).max(), np.ptp(ends.dq, axis=0).max()) > CLOSED
    ):
        return None
    ticks = round(length / study.period)
    last = trajectory.duration - length  # the cycle in which what the start has stirred up is over
    at = last + np.arange(ticks) * (length / ticks)
    both = path(study, np.concatenate([at, at + 0.5 * length / ticks]))  # in one go: a PD law's path is a run
    here, middle = (study.linear(both.part(slice(k * ticks, (k + 1) * ticks))) for k in (0, 1))
    matrices = study.close(here.with_arm(middle)).at_gain()
    product, grown = np.eye(matrices.shape[1]), 0.0
    for matrix in matrices:
        product = matrix @ product
        size = float(np.linalg.norm(product))
        product, grown = product / size, grown + np.log(size)
    radius = float(np.abs(np.linalg.eigvals(product)).max())
    return float(np.exp((np.log(radius) + grown) / ticks)) if radius > 0 else 0.0
