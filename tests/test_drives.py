"""The drive: encoder, torque limit, and the four answers to a command that does not come."""

import json
from typing import Any

import numpy as np
import pytest

from lwa4d_sim.drives import Drives, LateData
from lwa4d_sim.interfaces import Array, Arrived, Ns
from lwa4d_sim.record import RunLog
from lwa4d_sim.runner import run
from lwa4d_sim.scenario import Scenario

MS = 1_000_000  # [ns]
LOST = 1e6  # [s] a latency that is as good as a loss


def drives(late: LateData | None = None, **resolution: Array) -> Drives:
    given = {"position_resolution": None, "torque_resolution": None, **resolution}
    return Drives(np.array([10.0, 4.0]), late=late or LateData(), period=0.01, timestep=Ns(MS), **given)


def command(*tau: tuple[float, float], since: int = 0) -> Arrived:
    values = np.array(tau)
    return Arrived(np.full(values.shape, 0), np.full(values.shape, since), (values,))


def test_encoder_and_torque_are_rounded_to_their_steps() -> None:
    q = np.array([[0.1234567, -0.1234567], [0.00024, 0.00026]])
    coarse = drives(position_resolution=np.array([0.001, 0.0]), torque_resolution=np.array([0.5, 0.0]))
    np.testing.assert_allclose(coarse.encode(q), [[0.123, -0.1234567], [0.0, 0.00026]], atol=1e-15)
    np.testing.assert_allclose(coarse.torque(command((3.26, -3.26)), Ns(0), 1)[:, 0], [[3.5, -3.26]])
    fine = drives()
    assert fine.encode(q) is not q  # the plant's array lives on
    np.testing.assert_array_equal(fine.encode(q), q)


def test_torque_is_limited_joint_by_joint() -> None:
    tau = drives().torque(command((12.0, -5.0), (-1e300, 3.0)), Ns(0), 5)
    np.testing.assert_array_equal(tau[:, 0], [[10.0, -4.0], [-10.0, 3.0]])


@pytest.mark.parametrize("policy", ["zero", "ramp", "stop"])
def test_what_never_came_is_not_late(policy: Any) -> None:
    never = Arrived(np.array([[-1, -1], [0, 0]]), np.array([[-1, -1], [0, 0]]), (np.array([[np.nan] * 2, [1.0, 1.0]]),))
    side = drives(LateData(policy=policy, timeout=0.005))
    tau = side.torque(never, Ns(0), 4)
    assert np.isnan(tau[0]).all()
    np.testing.assert_array_equal(np.broadcast_to(tau[1], (4, 2)), 1.0)
    assert np.isnan(side.torque(never, Ns(90 * MS), 10)[0]).all()
    # and when it comes at last it acts
    first = Arrived(np.full((2, 2), 90 * MS), np.full((2, 2), 100 * MS), (np.full((2, 2), 2.0),))
    np.testing.assert_array_equal(np.broadcast_to(side.torque(first, Ns(100 * MS), 1)[0, 0], (2,)), 2.0)


def test_the_timeout_is_two_periods_unless_said_otherwise() -> None:
    tau = drives(LateData(policy="zero")).torque(command((1.0, 1.0)), Ns(15 * MS), 10)
    np.testing.assert_array_equal(tau[0, :, 0], [1.0] * 5 + [0.0] * 5)


def test_only_the_late_joint_is_led_to_zero() -> None:
    arrived = Arrived(np.zeros((1, 2), np.int64), np.array([[0, 9 * MS]]), (np.array([[2.0, 2.0]]),))
    ramp = drives(LateData(policy="ramp", timeout=0.004, ramp_time=0.01)).torque(arrived, Ns(0), 20)
    t = np.arange(20)
    np.testing.assert_allclose(ramp[0, :, 0], 2.0 * np.clip(1.0 - (t - 4) / 10, 0.0, 1.0), atol=1e-15)
    np.testing.assert_allclose(ramp[0, :, 1], 2.0 * np.clip(1.0 - (t - 13) / 10, 0.0, 1.0), atol=1e-15)


def test_one_late_joint_stops_its_arm_for_good_and_no_other() -> None:
    side = drives(LateData(policy="stop", timeout=0.004))
    since = np.array([[0, 9 * MS], [9 * MS, 9 * MS]])
    tau = side.torque(Arrived(since, since, (np.ones((2, 2)),)), Ns(0), 6)
    np.testing.assert_array_equal(np.isnan(tau[0, :, 0]), [False] * 4 + [True] * 2)
    np.testing.assert_array_equal(np.isnan(tau[0]).any(axis=1), np.isnan(tau[0]).all(axis=1))
    assert not np.isnan(tau[1]).any()
    fresh = Arrived(since, np.full((2, 2), 20 * MS), (np.ones((2, 2)),))
    later = side.torque(fresh, Ns(20 * MS), 3)
    assert np.isnan(later[0]).all()
    assert not np.isnan(later[1]).any()


def outage(first: int, count: int, **late: Any) -> RunLog:
    """A push against a spring-like law; the commands of some ticks never arrive (a replayed trace of latencies)."""
    ticks = 40
    trace = [0.0] * first + [LOST] * count + [0.0] * (ticks - first - count)
    document = {
        "name": "outage",
        "arm": "lwa4d_3dof",
        "initial": {"q": [-1.5, -1.0, 1.0]},
        "trajectory": {
            "waypoints": {"space": "joint", "points": [[-1.2, -1.1, 1.1]]},
            "segment_time": ticks / 100,
            "profile": "step",
            "follow": "joint",
        },
        "controller": {"kind": "pd_gravity", "kp": 20.0, "kd": 10.0},
        "loop": {
            "latency": {"command": {"kind": "trace", "values": trace}},
            "late_data": late,
        },
    }
    return run(Scenario.parse(json.dumps(document)))


def test_hold_keeps_the_last_torque() -> None:
    log = outage(10, 30, policy="hold")
    last = log.tau[90]
    assert np.abs(last).min() > 1e-3
    np.testing.assert_array_equal(log.tau[90:], np.broadcast_to(last, log.tau[90:].shape))
    np.testing.assert_array_equal(last, log.ticks.tau[9])


def test_zero_lets_go_and_takes_up_again() -> None:
    log = outage(10, 20, policy="zero", timeout=0.035)
    np.testing.assert_array_equal(log.tau[90:125], np.broadcast_to(log.ticks.tau[9], (35, 3)))
    np.testing.assert_array_equal(log.tau[125:300], 0.0)
    np.testing.assert_array_equal(log.tau[300:310], np.broadcast_to(log.ticks.tau[30], (10, 3)))
    assert log.events == ()  # the brakes have no part in it


def test_ramp_is_a_straight_line_to_zero() -> None:
    log = outage(10, 30, policy="ramp", timeout=0.02, ramp_time=0.08)
    late = np.arange(90, 400)
    share = np.clip(1.0 - (late - 110) / 80, 0.0, 1.0)
    np.testing.assert_allclose(log.tau[90:400], log.ticks.tau[9] * share[:, None], rtol=1e-12, atol=1e-14)
    assert log.tau[189, 1] != 0.0
    np.testing.assert_array_equal(log.tau[190:], 0.0)


def test_stop_closes_the_brakes_for_good() -> None:
    log = outage(10, 5, policy="stop", timeout=0.02)
    assert np.isfinite(log.ticks.tau).all()  # the controller goes on and its commands arrive again
    np.testing.assert_array_equal(log.tau[110:], 0.0)
    np.testing.assert_array_equal(log.q[111:], np.broadcast_to(log.q[110], log.q[111:].shape))
    np.testing.assert_array_equal(log.dq[111:], 0.0)
    assert np.abs(log.dq[110]).max() > 1e-3  # it was moving
    assert log.events == ((0.11, "brakes closed"),)


def test_a_single_loss_is_no_outage() -> None:
    for policy in ("zero", "ramp", "stop"):
        log, held = outage(10, 1, policy=policy), outage(10, 1, policy="hold")
        np.testing.assert_array_equal(log.tau, held.tau)


def test_resolution_reaches_record_and_controller() -> None:
    text = json.dumps({
        "name": "coarse", "arm": "lwa4d_3dof",
        "trajectory": {"waypoints": {"space": "joint", "points": [[-1.2, -1.1, 1.1]]}, "segment_time": 0.1,
                       "profile": "step", "follow": "joint"},
        "controller": {"kind": "pd_gravity", "kp": 20.0, "kd": 10.0},
        "loop": {"position_resolution": 0.01, "torque_resolution": [0.5, 0.25, 0.0]},
    })  # fmt: skip
    log = run(Scenario.parse(text))
    np.testing.assert_allclose(log.ticks.q, np.rint(log.ticks.q_true / 0.01) * 0.01, atol=1e-15)
    np.testing.assert_allclose(
        log.tau[:-1:10, :2], np.rint(log.ticks.tau[:, :2] / [0.5, 0.25]) * [0.5, 0.25], atol=1e-12
    )
    np.testing.assert_array_equal(log.tau[:-1:10, 2], log.ticks.tau[:, 2])
