"""The largest gain at a pose, found by simulation: below it a small disturbance dies out, above it it grows."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from lwa4d_sim.interfaces import Array
from lwa4d_sim.metrics import VIBRATION_FLOOR, vibrating
from lwa4d_sim.record import RunLog
from lwa4d_sim.runner import run_batch
from lwa4d_sim.scenario import Scenario

WAYPOINTS = [[-0.5, -0.3, 0.6], [-0.5, -0.3, 0.05], [0.5, -0.4, 0.05], [0.5, -0.4, 0.6]]
NUDGE = 2e-4  # [rad] small enough for the motion to be linear, large against rounding
GONE = 1e-7  # [rad/s] below this are slow motion that leaks into the vibration, and rounding

TEXT = """
name: at_waypoint
arm: {arm}
initial: {{q: [0, 0, 0]}}
trajectory:
  waypoints: {{space: task, points: [{point}]}}
  segment_time: 6.0
  profile: step
controller: {{kind: pd_gravity, space: joint, kp: 1, kd: 1}}
loop:
  kind: sampled
  period: 0.01
  actuation: next_sync
  velocity: {{kind: filtered_derivative, time_constant: 0.01, runs_on: continuous}}
"""


def at_waypoint(arm: str, waypoint: int, changes: Mapping[str, Any]) -> tuple[Scenario, Array]:
    """A scenario that rests at a waypoint (0 to 3), and its joint angles (n,)."""
    scenario = Scenario.parse(TEXT.format(arm=arm, point=WAYPOINTS[waypoint]), overrides=changes)
    log = next(run_batch(scenario, [{"trajectory.segment_time": 0.05}]))
    return scenario, log.ticks.q_ref[-1]


def grows(log: RunLog) -> bool:
    """Whether the worst joint vibrates more in the fifth second than in the third, or has left all bounds."""
    if log.diverged_at is not None or len(log.dq) < 5000:
        return True
    signal = vibrating(log.dq[::5], 40)
    third, fifth = (np.sqrt(np.mean(signal[start : start + 200] ** 2, axis=0)).max() for start in (400, 800))
    return bool(fifth > VIBRATION_FLOOR or (fifth > third and fifth > GONE))


def critical_gain(
    arm: str,
    waypoint: int,
    changes: Mapping[str, Any],
    *,
    low: float = 0.3,
    high: float = 300.0,
    damping: float = 5.0 / 3.0,
    rounds: int = 3,
    width: int = 12,
) -> float:
    """The gain p at which PD+G with kp = p, kd = ``damping`` p loses stability at a waypoint.

    Each round runs ``width`` gains, evenly apart in their logarithm, and goes on between the last calm one below the
    first that grows; three rounds of twelve leave 0.5 % of a range of 1 to 1000. Infinite when even ``high`` is calm.
    """
    scenario, q = at_waypoint(arm, waypoint, changes)
    nudged = (q + np.array([0.0, NUDGE, -NUDGE])).tolist()
    for _ in range(rounds):
        gains = np.geomspace(low, high, width)
        members = [{"controller.kp": p, "controller.kd": damping * p, "initial.q": nudged} for p in gains.tolist()]
        growing = np.array([grows(log) for log in run_batch(scenario, members)])
        if not growing.any():
            return np.inf
        first = int(np.argmax(growing))
        if first == 0:
            return 0.0
        low, high = float(gains[first - 1]), float(gains[first])
    return float(np.sqrt(low * high))
