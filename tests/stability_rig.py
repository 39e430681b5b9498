"""Loops at the thesis's four waypoints, and how fast a small disturbance of them grows in simulation."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lwa4d_sim.interfaces import Array
from lwa4d_sim.metrics import vibrating
from lwa4d_sim.observers import ObserverVelocity
from lwa4d_sim.runner import run_batch
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.stability.filters import filter_of
from lwa4d_sim.stability.instants import instants_of
from lwa4d_sim.stability.study import Study

WAYPOINTS = [[-0.5, -0.3, 0.6], [-0.5, -0.3, 0.05], [0.5, -0.4, 0.05], [0.5, -0.4, 0.6]]
RATIO = 5.0 / 3.0  # kd over kp of the thesis
PERIOD, STEP = 0.01, 0.0025  # [s]; RK4 is exact enough: the limits differ by 1e-6 from those at 1 ms
NUDGE = 2e-6  # [rad] so small that what is not linear stays below a thousandth, and large against rounding
LENGTH = 5.0  # [s] of a simulation
OFF = 0.03  # how far from the limit a simulation is to show it; nearer where it would grow out of what is linear:
SLOW = 0.006  # largest growth per period, 20-fold over a simulation
APART = 200  # periods between the two windows that are compared

TEXT = """
name: limits
arm: {arm}
plant: {{timestep: {step}}}
initial: {{q: [-1.5707963, -1.5707963, 1.5707963]}}
trajectory: {{waypoints: {{space: task, points: {points}}}, segment_time: {length}, profile: step}}
controller: {controller}
loop: {{period: 0.01, actuation: {actuation}, velocity: {{kind: filtered_derivative, time_constant: 0.01,
  runs_on: {runs_on}}}}}
"""


def pd(space: str, p: float) -> str:
    """PD+G with kd = 5/3 kp."""
    return f"{{kind: pd_gravity, space: {space}, kp: {p!r}, kd: {RATIO * p!r}}}"


def limits(
    arm: str,
    controller: str,
    *,
    actuation: str = "immediate",
    runs_on: str = "continuous",
    changes: dict[str, Any] | None = None,
) -> Study:
    """The study of an arm that is to stand at each of the waypoints in turn."""
    text = TEXT.format(
        arm=arm,
        step=STEP,
        points=WAYPOINTS,
        length=LENGTH,
        controller=controller,
        actuation=actuation,
        runs_on=runs_on,
    )
    return Study(Scenario.parse(text, overrides=changes), "default")


def margins(study: Study) -> Array:
    """Gain margin at each waypoint."""
    found: Array = study.gain_margin(study.close(study.linear(study.waypoints())))
    return found


def gains(study: Study, factor: float) -> dict[str, Any]:
    """Overrides that multiply all gains of the law by a factor, with respect to `without_gains`."""
    law: Any = study.settings.controller
    kp, kd = law.gains if hasattr(law, "gains") else (law.kp, law.kd)
    changes: dict[str, Any] = {"controller.kp": scaled(kp, factor), "controller.kd": scaled(kd, factor)}
    if hasattr(law, "p"):
        changes["controller.p"] = None
    posture = law.posture
    if study.settings.controller.space == "task" and study.n > study.blocks.arm.task_size:
        changes["controller.posture"] = {"kp": scaled(posture.kp, factor), "kd": scaled(posture.kd, factor)}
    return changes


def scaled(gain: Any, factor: float) -> Any:
    return [factor * g for g in gain] if isinstance(gain, (tuple, list)) else factor * gain


def simulated(
    study: Study, rows: Sequence[int], factors: Sequence[float], changes: Sequence[dict[str, Any]] | None = None
) -> Array:
    """Disturbances (K, ticks, 2n), angles and speeds, that start at the waypoints ``rows``, gains times ``factors``.

    ``changes`` are overrides of each run.
    """
    points, stride = study.waypoints(), round(PERIOD / study.settings.plant.timestep)
    members = [
        {
            **gains(study, factor),
            **change,
            "initial.q": (points.q[row] + nudge(study.n)).tolist(),
            "trajectory": {
                "kind": "waypoints",
                "waypoints": {"space": "joint", "points": [points.q[row].tolist()], "orientations": None},
                "segment_time": LENGTH,
                "profile": "step",
            },
        }
        for row, factor, change in zip(rows, factors, changes or [{}] * len(rows), strict=True)
    ]
    logs = run_batch(study.scenario, members, study.variant)
    motions = [
        np.hstack([log.q[:-1:stride] - points.q[row], log.dq[:-1:stride]]) for row, log in zip(rows, logs, strict=True)
    ]
    return np.stack(motions)


def predicted(study: Study, rows: Sequence[int], factors: Sequence[float], extra: float = 0.0) -> Array:
    """What `simulated` must find with so much ``extra`` latency of the commands, by the loop's matrices alone.

    The arm begins at rest, everything that estimators and drives remember is that rest, and the commands on their way
    are what holds the arm there: until the first command acts the brakes are closed.
    """
    linear = study.linear(study.waypoints())
    loop: Any = study.close(linear, extra)
    how: Any = study.settings.loop
    assist = study.settings.compensation
    n, at, k = study.n, np.asarray(rows), np.asarray(factors, float)
    old = int(instants_of(how, n, extra=extra).old.max())
    rest = [1.0, 0.0]  # q and dq of each joint, as shares of the nudge
    parts = [rest]
    if isinstance(how.velocity, ObserverVelocity):
        parts.append(rest)
    else:
        estimator = filter_of(how.velocity, PERIOD)
        parts.append([1.0, 1.0] if estimator.time_constant else [])
        parts.append(np.linalg.solve(np.eye(len(estimator.A)) - estimator.A, estimator.B @ rest).tolist())
    parts += [rest] * old
    if assist is not None and assist.disturbance_observer is not None:
        parts.append([0.0, *rest])
    known = np.concatenate(parts)
    matrix = loop.F[at] + loop.G[at] @ loop.U(at, k)
    X = np.zeros(matrix.shape[:2])
    X[:, : n * len(known)] = np.kron(known, nudge(n))
    hold = linear.bare[at][:, :, :n] @ nudge(n)
    X[:, n * len(known) :] = np.tile(hold, X.shape[1] // n - len(known))
    motion = [X[:, : 2 * n]] * old  # until the first sample has arrived
    while len(motion) < round(LENGTH / PERIOD):
        motion.append(X[:, : 2 * n])
        X = (matrix @ X[..., None])[..., 0]
    return np.stack(motion, axis=1)


def nudge(n: int) -> Array:
    """A disturbance that every joint but the first takes part in."""
    return np.where(np.arange(n) == 0, 0.5, 1.0) * NUDGE * (-1.0) ** np.arange(n)


def growth(motion: Array) -> float:
    """Growth per period of the fastest joint's vibration, from two windows of a second; motion (ticks, 2n)."""
    signal = vibrating(motion[:, motion.shape[1] // 2 :], round(0.2 / PERIOD))
    second, tail = round(1.0 / PERIOD), round(0.2 / PERIOD)
    late, early = (signal[len(signal) - tail - second - shift :][:second] for shift in (0, APART))
    before, after = (np.sqrt(np.mean(part**2, axis=0)) for part in (early, late))
    worst = int(np.argmax(after))
    return float((after[worst] / before[worst]) ** (1.0 / APART))


def compare(study: Study) -> Array:
    """Just below its limit every waypoint's loop calms down and just above it grows, and each as the analysis says.

    Returns:
        The limits that the two simulations give, as factors on the ones of the analysis.
    """
    loop: Any = study.close(study.linear(study.waypoints()))
    margin = study.gain_margin(loop)
    rows = np.flatnonzero(np.isfinite(margin) & (margin > 0))
    assert rows.size
    fastest = float(np.log(loop.radius(rows, (1 + OFF) * margin[rows])).max())
    off = OFF * min(1.0, SLOW / fastest)
    below, above = 1 - off, 1 + off
    members = [*rows, *rows], np.concatenate([margin[rows] * below, margin[rows] * above]).tolist()
    found, expected = simulated(study, *members), predicted(study, *members)
    assert apart(found, expected) < 1e-3
    calm, grown = np.log([growth(one) for one in found]).reshape(2, -1)
    assert (calm < 0).all()
    assert (grown > 0).all()
    limit: Array = below - calm * (above - below) / (grown - calm)
    return limit


def apart(found: Array, expected: Array) -> float:
    """How far apart motions (K, ticks, 2n) are at the worst tick, as a share of the largest angle and speed of each."""
    shape = (*expected.shape[:2], 2, -1)
    error, size = (np.abs(x.reshape(shape)).max(axis=(1, 3)) for x in (found - expected, expected))
    return float((error / size).max())
