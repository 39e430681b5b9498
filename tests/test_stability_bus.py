"""Gain limits over the simulated CANopen bus, where each joint's torque acts when its own frame has come."""

import numpy as np
import pytest
from stability_rig import RATIO, limits, margins, pd

from lwa4d_sim.interfaces import Array
from lwa4d_sim.metrics import vibrating
from lwa4d_sim.runner import run
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.stability.instants import bus_arrivals
from lwa4d_sim.stability.study import Study

TEXT = """
name: bus
arm: lwa4d_3dof
plant: {{timestep: 0.0005}}
initial: {{q: {start}}}
trajectory: {{waypoints: {{space: joint, points: [{q}]}}, segment_time: 4.0, profile: step}}
controller: {{kind: pd_gravity, kp: {p!r}, kd: {kd!r}}}
loop: {{kind: canopen, actuation: {actuation}, velocity: {{kind: filtered_derivative, time_constant: 0.01}}}}
"""
NUDGE = 0.04  # [rad] large against the counts: a torque's is 10 mN m
EVERY = 20  # plant steps of a period


def over_the_bus(q: Array, p: float, actuation: str) -> Scenario:
    """PD+G that begins a little beside the pose ``q``."""
    start = (q + NUDGE * np.array([0, -1, 1])).tolist()
    return Scenario.parse(TEXT.format(start=start, q=q.tolist(), p=p, kd=RATIO * p, actuation=actuation))


def growth(scenario: Scenario) -> float:
    """Vibration in the fourth second over that in the first half second."""
    signal = vibrating(run(scenario).dq[::EVERY], 20)
    early, late = (np.sqrt(np.mean(part**2, axis=0)).max() for part in (signal[:50], signal[280:380]))
    return float(late / early)


def poses() -> Array:
    return limits("lwa4d_3dof", pd("joint", 0.5)).waypoints().q


@pytest.mark.parametrize("actuation", ["immediate", "next_sync"])
@pytest.mark.parametrize("waypoint", range(4))
def test_limits_over_the_bus(waypoint: int, actuation: str) -> None:
    q = poses()[waypoint]
    critical = 0.5 * float(margins(Study(over_the_bus(q, 0.5, actuation), "default"))[0])
    assert growth(over_the_bus(q, 0.97 * critical, actuation)) < 0.5
    assert growth(over_the_bus(q, 1.03 * critical, actuation)) > 1.5


def test_frames_come_one_after_the_other() -> None:
    """Every joint's torque is late by its own frame, and the limit is that of a loop with those latencies."""
    q = poses()[3]
    scenario = over_the_bus(q, 0.5, "immediate")
    late = bus_arrivals(scenario, "default")
    assert (np.diff(late) > 1e-4).all()
    assert 1e-3 < late[0] < late[-1] < 3e-3
    loop = {"loop": {"kind": "sampled", "latency": late.tolist()}}
    same = Study(scenario.changed(loop, "default"), "default")
    np.testing.assert_allclose(margins(same), margins(Study(scenario, "default")), rtol=1e-9)


def test_next_sync_over_the_bus_is_next_sync_without() -> None:
    for i, q in enumerate(poses()):
        found = margins(Study(over_the_bus(q, 0.5, "next_sync"), "default"))
        expected = margins(limits("lwa4d_3dof", pd("joint", 0.5), actuation="next_sync"))[i]
        np.testing.assert_allclose(found, expected, rtol=1e-9)
