"""The loop over the simulated CANopen bus against the sampled loop: two roads to the same run."""

import json
import math
import re
from pathlib import Path
from typing import Any

import can
import h5py
import numpy as np
import pytest

from lwa4d_sim.arm import ARMS, MODULES
from lwa4d_sim.bus.joints import TORQUE_CONSTANT
from lwa4d_sim.bus.options import Traffic
from lwa4d_sim.bus.simulation import add_traffic
from lwa4d_sim.bus.wire import BitErrors, Wire
from lwa4d_sim.bus_plots import draw_buses
from lwa4d_sim.bus_timing import analyse
from lwa4d_sim.errors import BusError, ScenarioError
from lwa4d_sim.frame_log import FrameLog
from lwa4d_sim.interfaces import NS_PER_S, Ns
from lwa4d_sim.record import RunLog
from lwa4d_sim.results import run_scenario
from lwa4d_sim.runner import run
from lwa4d_sim.scenario import Scenario

MILLIDEGREE = math.pi / 180_000
START = {
    "lwa4d_3dof": [-1.5707963267948966, -1.5707963267948966, 1.5707963267948966],
    "lwa4d_7dof": [-1.57, 0.01, 0.0, 1.62, 0.0, -0.32, 0.0],
}
PD = {"kind": "pd_gravity", "kp": 20.0, "kd": 4.0}
COMPUTED_TORQUE = {"kind": "computed_torque", "p": 12}
HELD = {"kind": "filtered_derivative", "time_constant": 0.01, "runs_on": "held"}


def torque_steps(arm: str, profile: str) -> list[float]:
    """One count of each joint's torque object [N m]: per mille of the peak torque, or a milliampere."""
    joints = [link.joint for link in ARMS[arm].links]
    if profile == "lwa4d":
        return [TORQUE_CONSTANT / 1000] * len(joints)
    return [MODULES[joint - 1].torque_max / 1000 for joint in joints]


def both(arm: str, profile: str, controller: Any, actuation: str, **canopen: Any) -> tuple[RunLog, RunLog]:
    """The sampled run with the bus's resolutions, and the run over the bus."""
    n = len(START[arm])
    goal = (np.array(START[arm]) + np.linspace(0.3, -0.2, n)).tolist()
    velocity = canopen.pop("velocity", HELD)
    period = canopen.pop("period", 0.01)
    common = {"period": period, "actuation": actuation, "velocity": velocity}
    sampled = {"position_resolution": MILLIDEGREE, "torque_resolution": torque_steps(arm, profile)}
    document = {
        "name": "two_roads",
        "arm": arm,
        "initial": {"q": START[arm]},
        "trajectory": {
            "waypoints": {"space": "joint", "points": [goal]},
            "segment_time": 0.6,
            "profile": "quintic",
            "follow": "joint",
        },
        "controller": controller,
        "variants": {
            "sampled": {"loop": {"kind": "sampled", **common, **sampled}},
            "canopen": {"loop": {"kind": "canopen", **common, "profile": profile, **canopen}},
        },
    }
    scenario = Scenario.parse(json.dumps(document))
    return run(scenario, "sampled"), run(scenario, "canopen")


def same(sampled: RunLog, canopen: RunLog) -> None:
    """Sample for sample: the two differ by the rounding of counts to radians alone."""
    np.testing.assert_allclose(canopen.q, sampled.q, atol=1e-9)
    np.testing.assert_allclose(canopen.dq, sampled.dq, atol=1e-7)
    np.testing.assert_allclose(canopen.tau, sampled.tau, atol=1e-9)
    np.testing.assert_allclose(canopen.ticks.q, sampled.ticks.q, atol=1e-12)
    assert np.abs(canopen.q[-1] - canopen.q[0]).max() > 0.2, "it moved"


@pytest.mark.parametrize("profile", ["cia402", "lwa4d"])
@pytest.mark.parametrize(("arm", "controller"), [("lwa4d_3dof", PD), ("lwa4d_7dof", COMPUTED_TORQUE)])
def test_a_bus_that_costs_nothing_is_the_ideal_link(arm: str, controller: Any, profile: str) -> None:
    same(*both(arm, profile, controller, "immediate", bit_rate=None))


@pytest.mark.parametrize("profile", ["cia402", "lwa4d"])
@pytest.mark.parametrize(("arm", "controller"), [("lwa4d_3dof", PD), ("lwa4d_7dof", COMPUTED_TORQUE)])
def test_the_cycle_at_500_kbit_is_the_sampled_loop_with_next_sync(arm: str, controller: Any, profile: str) -> None:
    sampled, canopen = both(arm, profile, controller, "next_sync")
    same(sampled, canopen)
    assert canopen.frames is not None
    in_cycles = canopen.frames.queued >= 0
    sync = in_cycles & (canopen.frames.id == 0x080)
    pdo = in_cycles & (canopen.frames.id >= 0x180) & (canopen.frames.id < 0x380)
    assert sync.sum() == 60
    assert pdo.sum() == 60 * 4 * len(START[arm])


@pytest.mark.parametrize("period", [0.005, 0.02])
def test_other_periods(period: float) -> None:
    same(*both("lwa4d_3dof", "cia402", PD, "next_sync", period=period))


def test_the_drives_own_speed_is_the_filters_to_a_millidegree() -> None:
    """The speed signal of the drives crosses the bus in counts, so the runs part by counts and no more."""
    velocity = {"kind": "filtered_derivative", "time_constant": 0.01, "runs_on": "continuous"}
    sampled, canopen = both("lwa4d_3dof", "cia402", PD, "next_sync", velocity=velocity)
    count = np.array(torque_steps("lwa4d_3dof", "cia402"))
    assert (np.abs(canopen.tau - sampled.tau) <= 2.5 * count).all()
    np.testing.assert_allclose(canopen.ticks.dq[:20], sampled.ticks.dq[:20], atol=2 * MILLIDEGREE)


def test_a_command_on_its_way_acts_at_the_nearest_plant_step() -> None:
    """With event-driven set-points each joint's torque changes when its frame has arrived."""
    _, canopen = both("lwa4d_3dof", "lwa4d", PD, "immediate")
    frames = canopen.frames
    assert frames is not None
    for joint, node in enumerate((3, 4, 6)):
        here = (frames.id == 0x200 + node) & (frames.queued > 0)
        arrivals = {round(int(t) / 1e6) for t in frames.received[here]}
        changes = set((np.flatnonzero(np.diff(canopen.tau[:, joint])) + 1).tolist())
        assert changes <= arrivals
        assert len(changes) > 40
        assert min(t % 10 for t in arrivals) >= 1, "not at the SYNC"


def test_two_runs_are_alike_to_the_last_frame_and_noise_costs_time() -> None:
    runs = [both("lwa4d_3dof", "cia402", PD, "next_sync", noise={"per_bit": 2e-4})[1] for _ in range(2)]
    first, second = (log.frames for log in runs)
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(runs[0].q, runs[1].q)
    np.testing.assert_array_equal(first.started, second.started)
    np.testing.assert_array_equal(first.data, second.data)
    expected = 2e-4 * first.bits.sum()
    assert abs((first.outcome == 1).sum() - expected) < 4 * math.sqrt(expected), "spoilt frames"
    assert (first.attempt > 1).any()


def test_other_traffic_delays_the_sync() -> None:
    """A long frame on the wire makes the SYNC wait, at most that frame's length."""
    _, canopen = both("lwa4d_3dof", "cia402", PD, "next_sync", traffic=[{"id": 0x7F0, "size": 8, "period": 0.0009}])
    frames = canopen.frames
    assert frames is not None
    sync = (frames.id == 0x080) & (frames.queued >= 0)
    wait = frames.started[sync] - frames.queued[sync]
    assert wait.max() > 0
    assert wait.max() <= 135 * 2000


def test_a_station_of_the_traffic_in_bus_off_is_silent_and_comes_back() -> None:
    wire = Wire(500_000, record=True)
    wire.port("another", lambda msg, now: None)
    add_traffic(wire, [Traffic(id=1600, period=0.005)])
    wire.disturb(lambda msg, name: True, times=32)
    wire.run_until(Ns(100_000_000))
    sent = [frame.queued // 1_000_000 for frame in wire.frames if frame.outcome == "sent"]
    assert len(wire.frames) > 32
    assert 0 < sent[0] < 20, "bus-off for 128 times 11 bits, 2.8 ms"
    assert sent == list(range(sent[0], 100, 5))


def test_the_load_of_a_wire_with_errors_is_the_time_it_was_busy() -> None:
    wire = Wire(500_000, errors=BitErrors(probability=5e-4), record=True)
    for name in "ab":  # without another nobody would acknowledge
        wire.port(name, lambda msg, now: None)
    add_traffic(wire, [Traffic(id=1600, period=0.001), Traffic(id=1601, period=0.001)])
    wire.run_until(Ns(NS_PER_S))
    found = analyse(FrameLog.of(wire.frames), 500_000, Ns(1_000_000), 1000)
    assert (found.log.outcome == 1).sum() > 50
    assert found.load == pytest.approx(wire.busy / NS_PER_S, rel=1e-3)


def test_a_set_up_that_takes_too_long_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lwa4d_sim.bus.build.STARTUP", Ns(-50_000_000))
    with pytest.raises(BusError, match="the set-up takes longer"):
        both("lwa4d_3dof", "cia402", PD, "next_sync")


def test_a_bus_too_slow_for_its_cycle_is_refused() -> None:
    """At 100 kbit/s the cycle of seven joints needs more than 30 ms."""
    with pytest.raises(ScenarioError, match=r"375 % of the bus .* at least 375000 bit/s"):
        both("lwa4d_7dof", "cia402", COMPUTED_TORQUE, "next_sync", bit_rate=100_000)


def test_a_run_over_the_bus_gets_a_picture_of_it(tmp_path: Path) -> None:
    sampled, canopen = both("lwa4d_3dof", "lwa4d", PD, "next_sync")
    _, costless = both("lwa4d_3dof", "lwa4d", PD, "immediate", bit_rate=None)
    made = draw_buses({"sampled": sampled, "canopen": canopen, "costless": costless}, tmp_path)
    assert [picture.path.name for picture in made] == ["bus_canopen.png"]
    assert made[0].path.stat().st_size > 20_000
    assert "500 kbit/s" in made[0].title


def test_a_silent_bus_has_a_picture_too(tmp_path: Path) -> None:
    crash = [{"kind": "master_crash", "at": 0}]
    _, canopen = both("lwa4d_3dof", "lwa4d", PD, "next_sync", heartbeat=0, faults=crash)
    assert canopen.frames is not None
    assert (canopen.frames.queued < 0).all()
    assert [picture.path.name for picture in draw_buses({"can": canopen}, tmp_path)] == ["bus_can.png"]


@pytest.mark.parametrize(
    ("key", "column", "words"),
    [
        ("node", [99], "frames/node holds a number that is none of 0 to"),
        ("size", [9], "frames/size holds a number that is none of 0 to 8"),
        ("outcome", [-1], "frames/outcome holds"),
        ("bits", [0, 0], "frames/bits does not fit"),
        ("id", [0.0], "frames/id does not fit"),
    ],
)
def test_a_record_whose_frames_make_no_sense_is_refused(
    key: str, column: list[float], words: str, tmp_path: Path
) -> None:
    one = can.Message(arbitration_id=1, data=b"1", is_extended_id=False)
    wire = Wire(500_000, record=True)
    wire.port("a").send(one)
    wire.port("b")
    wire.run_until(Ns(1_000_000))
    with h5py.File(tmp_path / "x.h5", "w") as file:
        for name, (values, _) in FrameLog.of(wire.frames).columns().items():
            file[name] = values
        file.attrs["names"] = "a"
        assert len(FrameLog.read(file)) == 1
        del file[key]
        file[key] = np.array(column)
        with pytest.raises(ValueError, match=words):
            FrameLog.read(file)


def test_the_record_keeps_the_frames(tmp_path: Path) -> None:
    _, log = both("lwa4d_3dof", "lwa4d", PD, "next_sync")
    log.save(tmp_path / "canopen.h5")
    again = RunLog.load(tmp_path / "canopen.h5").frames
    assert log.frames is not None
    assert again is not None
    assert again.names == log.frames.names
    assert {"master", "node 3", "node 6"} <= set(again.names)
    for name, (column, unit) in log.frames.columns().items():
        np.testing.assert_array_equal(again.columns()[name][0], column)
        assert again.columns()[name][1] == unit
    page = (Path(__file__).parent.parent / "docs" / "record.md").read_text(encoding="utf-8")
    told = re.findall(r"^\| `/frames/(\w+)` \| F( x 8)? \| ([\w-]+) \|", page, re.MULTILINE)
    assert {name: (wide, unit) for name, wide, unit in told} == {
        name: (" x 8" if name == "data" else "", unit or "-") for name, (_, unit) in again.columns().items()
    }
    # what a drive says is where the arm is: TPDO 1 carries statusword, torque and position
    here = (again.id == 0x183) & (again.queued >= 0)
    position = again.data[here][:, 4:8].copy().view("<i4")[:, 0] * MILLIDEGREE
    np.testing.assert_allclose(position, log.q[: 10 * len(position) : 10, 0], atol=0.51 * MILLIDEGREE)


def test_a_run_that_the_master_stopped_says_so(tmp_path: Path) -> None:
    fault = {"kind": "node_silence", "at": 0.3, "node": 4, "how": "unplugged"}
    sampled, canopen = both("lwa4d_3dof", "lwa4d", PD, "next_sync", faults=[fault])
    assert sampled.stopped is None
    assert canopen.stopped is not None
    at, why = canopen.stopped
    assert 0.3 < at < 0.35
    assert why == "node 4: no measurements for 3 cycles"
    canopen.save(tmp_path / "canopen.h5")
    assert RunLog.load(tmp_path / "canopen.h5").stopped == canopen.stopped
    document = {"name": "stopped", "variants": {"canopen": {}}, **_only_canopen(fault)}
    summary = run_scenario(Scenario.parse(json.dumps(document)))
    assert summary["variants"]["canopen"]["stopped"]["why"] == why


def _only_canopen(fault: dict[str, Any]) -> dict[str, Any]:
    return {
        "arm": "lwa4d_3dof",
        "trajectory": {"waypoints": {"space": "joint", "points": [START["lwa4d_3dof"]]}, "segment_time": 0.5},
        "controller": PD,
        "loop": {"kind": "canopen", "faults": [fault]},
    }
