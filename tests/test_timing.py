"""The delay that was asked for is the delay seen at the plant, for every tick, in whole nanoseconds."""

import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.record import RunLog
from lwa4d_sim.runner import run
from lwa4d_sim.scenario import Scenario

MS = 1_000_000  # [ns]
QUANTUM = 2.0**-20  # [N m] torque of the marker a call: tiny, so that the arm hardly moves, and exact in binary

# The torque tells which call of the controller it comes from. It is the same array every time, on purpose.
MARKER = f"""
import numpy as np

class Marker:
    def __init__(self):
        self.calls = 0
        self.tau = None

    def torque(self, state, ref, model):
        if self.tau is None:
            self.tau = np.zeros_like(state.q)
        self.calls += 1
        self.tau[:] = self.calls * {QUANTUM!r}
        return self.tau
"""


@pytest.fixture(autouse=True)
def marker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "marker_law.py").write_text(MARKER)
    monkeypatch.syspath_prepend(tmp_path)


def scenario(*, dt: float = 0.001, duration: float = 0.1, controller: Any = None, **loop: Any) -> Scenario:
    """Three joints without gravity under the marker; loop keys as in a scenario file."""
    document = {
        "name": "timing",
        "arm": "lwa4d_3dof",
        "initial": {"q": [-1.5, -1.0, 1.0]},
        "plant": {"timestep": dt, "gravity": [0, 0, 0]},
        "trajectory": {
            "waypoints": {"space": "joint", "points": [[-1.5, -1.0, 1.0], [-1.4, -1.0, 1.0]]},
            "segment_time": duration / 2,
            "profile": "step",
            "follow": "joint",
        },
        "controller": controller or {"kind": "marker_law:Marker"},
        "loop": {"velocity": {"kind": "true"}, **loop},
    }
    return Scenario.parse(json.dumps(document))


def ns(seconds: float) -> int:
    return round(seconds * 1e9)


def up_to(t: int, grid: int) -> int:
    return -(-t // grid) * grid


def acts_at(sent: int, latency: int, period: int, dt: int, actuation: str) -> int:
    """Instant [ns] at which a command acts, from the rules as the documentation words them."""
    arrival = sent + latency
    if actuation == "immediate":
        return up_to(arrival, dt)
    sync = 0
    while sync <= arrival:
        sync += period
    return sync


def check(log: RunLog, *, period: int, dt: int, phase: int, up: int, down: list[int], actuation: str) -> None:
    """Everything a record says about time against the asked instants, all in integers [ns]."""
    ticks = len(log.ticks.t)
    computed = [k * period + phase for k in range(ticks)]
    assert [ns(t) for t in log.ticks.t] == computed
    # what the controller used: the newest sample that had arrived
    samples = [(t - up) // period for t in computed]
    used = [s if s >= 0 else None for s in samples]
    for k, sample in enumerate(used):
        if sample is None:
            assert np.isnan(log.ticks.age[k])
            assert np.isnan(log.ticks.q[k]).all()
        else:
            assert ns(log.ticks.age[k]) == computed[k] - sample * period
            np.testing.assert_array_equal(log.ticks.q[k], log.q[sample * period // dt])
    # what acted on each joint at each plant step: the newest command that had arrived
    calls = np.cumsum([sample is not None for sample in used])
    n = log.tau.shape[1]
    newest = np.zeros((len(log.t) - 1, n))
    for k, sample in enumerate(used):
        if sample is not None:
            for j in range(n):
                newest[acts_at(computed[k], down[j], period, dt, actuation) // dt :, j] = calls[k]
    braked = (newest == 0).any(axis=1)
    newest[braked] = 0  # a joint that was never told anything keeps the whole arm braked
    np.testing.assert_array_equal(log.tau[:-1] / QUANTUM, newest)
    # the brakes: closed until the first command acts, and nothing moves
    held = int(braked.sum())
    assert braked[:held].all()
    assert 0 <= held < len(braked)
    np.testing.assert_array_equal(log.q[: held + 1], np.broadcast_to(log.q[0], (held + 1, n)))
    np.testing.assert_array_equal(log.dq[: held + 1], 0.0)
    assert np.all(log.q[held + 2 :] != log.q[0])
    assert [(ns(t), text) for t, text in log.events] == (
        [(0, "brakes closed"), (held * dt, "brakes released")] if held else []
    )


@pytest.mark.parametrize("actuation", ["immediate", "next_sync"])
@pytest.mark.parametrize("dt", [500_000, MS])
@pytest.mark.parametrize("period", [2 * MS, 5 * MS, 10 * MS])
def test_asked_delay_is_seen_at_the_plant(period: int, dt: int, actuation: str) -> None:
    latencies = [0, 300_000, period // 2 + 123, period, 2 * period + 700_000]
    for up, down in list(itertools.product(latencies, latencies))[dt // MS :: 2]:
        loop: dict[str, Any] = {"latency": {"measurement": up / 1e9, "command": down / 1e9}, "period": period / 1e9}
        log = run(scenario(dt=dt / 1e9, duration=10 * period / 1e9, actuation=actuation, **loop))
        phase = up_to(up, dt) % period
        check(log, period=period, dt=dt, phase=phase, up=up, down=[down] * 3, actuation=actuation)
        # without an asked phase the controller waits for the sample: its age is the latency, on the plant's grid
        assert {ns(age) for age in log.ticks.age[~np.isnan(log.ticks.age)]} == {up_to(up, dt)}


@pytest.mark.parametrize("actuation", ["immediate", "next_sync"])
@pytest.mark.parametrize("phase", [0, MS, 4 * MS, 9 * MS])
def test_phase_moves_the_computation(phase: int, actuation: str) -> None:
    for up, down in itertools.product([0, 2 * MS, 4 * MS, 12 * MS], [0, MS, 6 * MS]):
        loop: dict[str, Any] = {"latency": {"measurement": up / 1e9, "command": down / 1e9}, "phase": phase / 1e9}
        log = run(scenario(actuation=actuation, **loop))
        check(log, period=10 * MS, dt=MS, phase=phase, up=up, down=[down] * 3, actuation=actuation)


@pytest.mark.parametrize("actuation", ["immediate", "next_sync"])
def test_each_joint_has_its_own_latency(actuation: str) -> None:
    down = [0, 4 * MS, 13 * MS]
    log = run(scenario(actuation=actuation, latency=[t / 1e9 for t in down]))
    check(log, period=10 * MS, dt=MS, phase=0, up=0, down=down, actuation=actuation)


def test_the_controller_waits_for_the_slowest_joint() -> None:
    log = run(scenario(latency={"measurement": [0.0, 0.0021, 0.004]}))
    np.testing.assert_allclose(log.ticks.age, 0.004)
    np.testing.assert_allclose(log.ticks.t, 0.004 + 0.01 * np.arange(10))
    late = run(scenario(latency={"measurement": [0.0, 0.0021, 0.004]}, phase=0.003))
    assert np.isnan(late.ticks.q[0]).all()  # the third joint has not spoken yet
    np.testing.assert_allclose(late.ticks.age[1:], 0.013)
    at = 3 + 10 * np.arange(1, 10)
    np.testing.assert_array_equal(late.ticks.q[1:, :2], late.q[at - 3][:, :2])
    np.testing.assert_array_equal(late.ticks.q[1:, 2], late.q[at - 13, 2])


@pytest.mark.parametrize("kind", ["filtered_derivative", "held", "backward_difference", "tustin", "kalman", "true"])
def test_no_estimator_is_kicked_by_a_joint_that_speaks_late(kind: str) -> None:
    velocity = {"kind": "filtered_derivative", "runs_on": "held"} if kind == "held" else {"kind": kind}
    log = run(scenario(latency={"measurement": [0.0, 0.0021, 0.033]}, phase=0.003, velocity=velocity))
    assert np.isnan(log.ticks.dq[:3]).all()
    assert np.abs(log.ticks.dq[3:]).max() < 1e-4  # the arm hardly moves: a kick would be about 1 rad in 10 ms


@pytest.mark.parametrize(("period", "dt"), [(3 * MS, MS), (3 * MS, 500_000), (7 * MS, MS)])
def test_ticks_never_drift(period: int, dt: int) -> None:
    log = run(scenario(dt=dt / 1e9, duration=2000 * period / 1e9, period=period / 1e9))
    assert [ns(t) for t in log.ticks.t] == [k * period for k in range(2000)]
    expected = np.repeat(np.arange(1, 2001), period // dt)
    np.testing.assert_array_equal(log.tau[:-1, 0] / QUANTUM, expected)


@pytest.mark.parametrize(
    ("command", "actuation", "delay"),
    [(0.0, "immediate", 0), (0.0034, "immediate", 4), (0.0, "next_sync", 10), (0.01, "next_sync", 20)],
)
def test_a_step_of_the_reference_shows_after_the_asked_delay(command: float, actuation: str, delay: int) -> None:
    law = {"kind": "pd_gravity", "kp": 10.0, "kd": 1.0, "model": {"gravity": [0, 0, 0]}}
    log = run(scenario(controller=law, actuation=actuation, latency=command))
    assert int(np.argmax(np.abs(log.tau[:, 0]) > 1e-9)) == 50 + delay


def test_periods_and_phases_that_do_not_fit_are_errors() -> None:
    with pytest.raises(
        ScenarioError, match=r"loop\.period.*0\.0105 s is not a whole multiple of the plant step 0\.001 s"
    ):
        run(scenario(period=0.0105))
    with pytest.raises(ScenarioError, match=r"phase 0\.01 s must be shorter than the period"):
        run(scenario(phase=0.01))
