"""Every row of the fault table (docs/canopen.md): the fault put in, and what drives, master and joints do about it.

The arm is the one with three joints, nodes 3 to 5, in the middle of a motion of one second when something goes wrong.
"""

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args, get_type_hints

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lwa4d_sim.assembly import build_blocks
from lwa4d_sim.bus.build import canopen_run
from lwa4d_sim.bus.cia402 import State
from lwa4d_sim.bus.commission import commission, interpolation_period, put_back
from lwa4d_sim.bus.dictionary import drive_dictionary
from lwa4d_sim.bus.fault_options import Fault
from lwa4d_sim.bus.node import NmtState
from lwa4d_sim.bus.simulation import Simulation
from lwa4d_sim.bus.wire import WireFrame
from lwa4d_sim.errors import BusError, LwaError, ScenarioError
from lwa4d_sim.interfaces import Array, Ns
from lwa4d_sim.runner import run
from lwa4d_sim.scenario import Scenario

BOTH = pytest.mark.parametrize("profile", ["cia402", "lwa4d"])
AT = 0.5  # [s] when most faults begin; the joints are fastest then
START, END = (0.0, -1.2, 1.2), (0.2, -1.1, 1.3)
MDEG = np.pi / 180e3
OFF = State.SWITCH_ON_DISABLED


def scenario(*faults: Mapping[str, Any], **loop: Any) -> Scenario:
    controller = loop.pop("controller", {"kind": "computed_torque", "p": 12})
    return Scenario.parse(
        json.dumps(
            {
                "name": "faults",
                "arm": "lwa4d_3dof",
                "initial": {"q": START},
                "trajectory": {"waypoints": {"space": "joint", "points": [END]}, "segment_time": 1.0},
                "controller": controller,
                "loop": {"kind": "canopen", "profile": "cia402", "nodes": [3, 4, 5], **loop, "faults": list(faults)},
            }
        )
    )


@dataclass
class Played:
    """What happened in a run."""

    simulation: Simulation
    q: Array
    dq: Array
    tau: Array
    states: Array  # positions that the controller went by, a row a cycle
    ages: Array  # of them [s]

    @property
    def events(self) -> list[tuple[float, str]]:
        """What the master noted."""
        return [(t / 1e9, text) for t, text in self.simulation.master.watch.events if t >= 0]

    def said(self, text: str) -> float:
        """When the master first noted something [s]."""
        times = [t for t, said in self.events if text in said]
        assert times, f"{text!r} is not in {self.events}"
        return times[0]

    def frames(self, cob_id: int, sender: str | None = None) -> list[WireFrame]:
        """Frames of an identifier that arrived after the start."""
        return [
            frame
            for frame in self.simulation.wire.frames
            if frame.can_id == cob_id and frame.received is not None and frame.started >= 0
            if not frame.extended and not frame.remote and (sender is None or frame.node == sender)
        ]

    def emergencies(self, node: int) -> list[tuple[float, int]]:
        """When a drive reported which codes."""
        return [(frame.started / 1e9, int.from_bytes(frame.data[:2], "little")) for frame in self.frames(0x80 + node)]

    def stood(self, joint: int) -> float:
        """When a joint came to its final rest [s]; the duration if it did not."""
        return float(np.flatnonzero(np.abs(self.dq[:, joint]) > 1e-9)[-1] + 1) / 1000

    def state(self, node: int) -> State:
        return self.simulation.arm.drives[node - 3].steering.machine.state

    def nmt(self, node: int) -> NmtState:
        return self.simulation.arm.nodes[node - 3].state

    def braked(self, node: int) -> bool:
        return self.simulation.arm.drives[node - 3].braked

    def speed(self, t: float) -> Array:
        """Joint speeds [rad/s]."""
        return np.asarray(np.abs(self.dq[round(1000 * t)]))

    def went_on(self) -> bool:
        """The motion was completed as if nothing had happened."""
        fine = all(self.state(node) is State.OPERATION_ENABLED for node in (3, 4, 5))
        return fine and self.simulation.session.fault is None and bool(np.abs(self.q[-1] - END).max() < 5e-3)

    def stopped(self, seen: float, *, within: float = 0.25) -> bool:
        """All joints came to rest on a ramp and stayed there, and no drive was told to move again."""
        rest = max(self.stood(joint) for joint in range(3))
        assert seen - 1e-3 <= rest <= seen + within, f"at rest at {rest} s, seen at {seen} s"
        assert all(self.braked(node) for node in (3, 4, 5))
        assert not any(self.state(node) is State.OPERATION_ENABLED for node in (3, 4, 5))
        for node in (3, 4, 5):
            words = [int(frame.data[0]) for frame in self.frames(0x200 + node, "master") if frame.queued > seen * 1e9]
            assert not any(word & 0x0F == 0x0F for word in words)
        return True


def play(*faults: Mapping[str, Any], **loop: Any) -> Played:
    simulation, ticks = canopen_run(build_blocks([scenario(*faults, **loop)], "default", 1))
    taken = [
        (tick.q[0], tick.dq[0], np.broadcast_to(tick.tau[0], tick.q[0].shape), tick.state, tick.age) for tick in ticks
    ]
    nothing = np.full(3, np.nan)
    return Played(
        simulation,
        np.concatenate([q for q, *_ in taken]),
        np.concatenate([dq for _, dq, *_ in taken]),
        np.concatenate([tau for _, _, tau, *_ in taken]),
        np.array([nothing if state is None else state.q[0] for *_, state, _ in taken]),
        np.array([np.nan if age is None else float(np.max(age)) / 1e9 for *_, age in taken]),
    )


@cache
def undisturbed(profile: str) -> Played:
    return play(profile=profile)


def fault(kind: str, at: float = AT, **more: Any) -> dict[str, Any]:
    return {"kind": kind, "at": at, **more}


def applied(played: Played, node: int) -> tuple[Array, Array]:
    """Torque counts that a drive held over each plant step, and those that it should have by the frames on the wire.

    At each SYNC acts the last whole set-point that arrived before it; the plant takes it up at the nearest step.
    """
    drive = played.simulation.arm.drives[node - 3]
    expected, latched, acting = np.zeros(len(played.q)), 0.0, 0.0
    frames = sorted(played.frames(0x080) + played.frames(0x200 + node), key=lambda frame: frame.received or 0)
    for frame in frames:
        if frame.can_id != 0x080:
            if frame.dlc == 8:
                latched = float(int.from_bytes(frame.data[2:4], "little", signed=True))
        elif not frame.dlc:
            acting = latched
            expected[round((frame.received or 0) / 1e6) :] = acting
    return played.tau[:, node - 3] / drive.axis.newton_metres, expected


def follows_the_wire(played: Played, nodes: tuple[int, ...] = (3, 4, 5)) -> bool:
    """From the third cycle on every drive does what its frames ask."""
    for node in nodes:
        tau, expected = applied(played, node)
        np.testing.assert_allclose(tau[30:], expected[30:], atol=1e-6)
    return True


def test_without_faults_nothing_is_noted_and_the_torque_is_that_on_the_wire() -> None:
    played = undisturbed("cia402")
    assert played.went_on()
    assert follows_the_wire(played)
    assert not played.events
    assert played.speed(AT).min() > 0.15
    assert not any(played.emergencies(node) for node in (3, 4, 5))
    assert undisturbed("lwa4d").went_on()


# Row 1: one SYNC lost


@BOTH
def test_one_lost_sync_is_bridged(profile: str) -> None:
    played = play(fault("lost_sync"), profile=profile)
    assert played.went_on()
    k = round(AT * 100)
    for node in (3, 4, 5):
        assert not [f for f in played.frames(0x180 + node) if AT * 1e9 <= f.started < (AT + 0.01) * 1e9]
        assert not played.emergencies(node)
    hold = played.tau[10 * k - 9 : 10 * (k + 1)]  # the last set-point acts on
    assert (hold == hold[0]).all()
    assert played.ages[k] == pytest.approx(played.ages[k - 1] + 0.01, abs=4e-3)  # it knows that its data are older
    assert played.ages[k + 1] < 0.01
    assert np.abs(played.q - undisturbed(profile).q).max() < 2e-3


# Row 2: SYNC lost for longer


@BOTH
def test_many_lost_syncs_stop_the_arm(profile: str) -> None:
    played = play(fault("lost_sync", count=100), profile=profile)
    seen = played.said("no measurements for 3 cycles")
    assert seen == pytest.approx(AT + 0.025, abs=2e-3)
    assert played.stopped(seen)


def test_the_arm_stays_where_it_stopped_when_sync_comes_back() -> None:
    played = play(fault("lost_sync", count=8))
    assert played.stopped(played.said("no measurements"))
    assert len(played.frames(0x080)) > 80


# Rows 3 to 5: set-points lost, late, twice


def test_a_lost_set_point_leaves_the_one_before() -> None:
    played = play(fault("lost_pdo", 0.3, node=4, pdo="rpdo1", count=3))
    assert played.went_on()
    assert follows_the_wire(played)
    tau = played.tau[:, 1]
    assert len(set(tau[311:330].tolist())) == 1
    assert len(set(undisturbed("cia402").tau[311:330, 1].tolist())) > 1
    assert not played.emergencies(4)


def test_set_points_that_stay_away_are_missed_by_the_drive() -> None:
    played = play(fault("lost_pdo", node=4, pdo="rpdo1", count=100))
    ((t, code), *_) = played.emergencies(4)
    assert code == 0x8250
    assert t == pytest.approx(AT - 0.008 + 0.06, abs=2e-3)  # six periods after the last
    assert played.stopped(played.said("node 4: EMCY 0x8250"))


@BOTH
def test_set_points_that_stay_away_show_in_the_following_error(profile: str) -> None:
    """The firmware cannot miss its RPDOs: it has no 1400:5."""
    played = play(fault("lost_pdo", node=4, pdo="rpdo1", count=100), profile=profile, following_error=0.01)
    assert played.stopped(played.said("from where it should be" if profile == "lwa4d" else "EMCY 0x8250"), within=0.3)


def test_a_late_set_point_acts_a_cycle_later_and_once() -> None:
    played = play(fault("late_pdo", 0.3, node=4, pdo="rpdo1", delay=0.009, count=10))
    assert played.went_on()
    assert follows_the_wire(played)
    sent = [int.from_bytes(f.data[2:4], "little", signed=True) for f in played.frames(0x204)]
    tau, _ = applied(played, 4)
    assert [tau[10 * k + 5] for k in range(25, 30)] == pytest.approx(sent[24:29])
    assert [tau[10 * k + 5] for k in range(32, 40)] == pytest.approx(sent[30:38])  # one cycle more


@pytest.mark.parametrize("delay", [0.0, 0.013])
def test_of_set_points_that_come_twice_or_out_of_order_the_last_before_sync_acts(delay: float) -> None:
    played = play(fault("duplicated_pdo", 0.3, node=4, pdo="rpdo1", delay=delay, count=5))
    assert played.went_on()
    assert follows_the_wire(played)
    assert len(played.frames(0x204)) == len(undisturbed("cia402").frames(0x204)) + 5


# Row 6: measurements lost or late


def test_a_lost_measurement_leaves_a_gap_and_no_zero() -> None:
    played = play(fault("lost_pdo", node=4, pdo="tpdo1"))
    k = round(AT * 100)
    assert played.went_on()
    assert played.states[k, 1] == played.states[k - 1, 1] != 0
    assert played.states[k, 0] != played.states[k - 1, 0]
    assert played.ages[k] > 0.01 > played.ages[k + 1]


@pytest.mark.parametrize(
    "happens",
    [
        fault("late_pdo", node=4, pdo="tpdo1", delay=0.009),
        fault("late_pdo", node=4, pdo="tpdo1", delay=0.0105),
        fault("duplicated_pdo", node=4, pdo="tpdo1"),
        fault("duplicated_pdo", node=4, pdo="tpdo1", delay=0.0125),
        fault("duplicated_pdo", node=4, pdo="tpdo1", delay=0.0098),
        fault("duplicated_pdo", node=4, pdo="tpdo1", delay=0.0105),
    ],
    ids=lambda happens: f"{happens['kind']} {happens.get('delay', 0)}",
)
def test_an_older_measurement_never_replaces_a_newer_one(happens: dict[str, Any]) -> None:
    played = play(happens)
    assert played.went_on()
    k = round(AT * 100)
    sampled = played.q[[10 * j - 1 for j in range(40, 80)], 1]  # row i is the state at step i + 1
    error = np.abs(played.states[40:80, 1] - sampled)
    if happens["kind"] == "late_pdo":
        error[k - 40] = 0.0  # the one that did not come in time
    assert error.max() < MDEG


def test_a_measurement_that_stays_away_too_long_stops_the_arm() -> None:
    played = play(fault("lost_pdo", node=4, pdo="tpdo1", count=3))
    assert played.stopped(played.said("node 4: no measurements for 3 cycles"))


def test_a_short_measurement_is_not_used() -> None:
    played = play(fault("short_pdo", node=4, pdo="tpdo1"))
    assert played.went_on()
    assert played.said("TPDO of 7 bytes ignored") == pytest.approx(AT, abs=2e-3)


# Rows 7 and 8: SYNC late, of two producers, with data


def test_drives_sample_at_each_sync_however_late() -> None:
    played = play(fault("late_sync", delay=0.004, count=3))
    assert played.went_on()
    assert follows_the_wire(played)
    late = [frame.started / 1e9 for frame in played.frames(0x080)][50:53]
    assert late == pytest.approx([0.504, 0.514, 0.524], abs=3e-4)
    first = [frame.started / 1e9 for frame in played.frames(0x183)][50:53]
    assert all(0 < t - s < 1e-3 for s, t in zip(late, first, strict=True))


@BOTH
def test_a_second_sync_producer_is_found(profile: str) -> None:
    played = play(fault("foreign_sync", 0.503, count=50), profile=profile)
    seen = played.said("another SYNC producer")
    assert seen == pytest.approx(0.503, abs=1e-3)
    assert played.stopped(seen)
    assert len([f for f in played.frames(0x183) if 0.5e9 <= f.started < 0.51e9]) == 2


def test_a_sync_with_data_is_none() -> None:
    played = play(fault("long_sync"))
    for node in (3, 4, 5):
        assert played.emergencies(node)[0][1] == 0x8240
        assert not [f for f in played.frames(0x180 + node) if AT * 1e9 <= f.started < (AT + 0.01) * 1e9]
    assert played.stopped(played.said("EMCY 0x8240"))


# Rows 9 and 10: set-points of the wrong length


def test_a_short_set_point_is_not_taken_and_reported_once() -> None:
    played = play(fault("short_pdo", node=4, pdo="rpdo1", size=5, count=2))
    assert [code for _, code in played.emergencies(4)] == [0x8210, 0x0000]
    tau, _ = applied(played, 4)
    assert tau[515] == tau[505]  # one cycle before the quick stop
    assert played.stopped(played.said("EMCY 0x8210"))


def test_a_long_set_point_is_taken_and_reported() -> None:
    played = play(fault("long_pdo", node=4, pdo="rpdo2", size=8, count=2))
    assert [code for _, code in played.emergencies(4)] == [0x8220, 0x0000]
    assert played.stopped(played.said("EMCY 0x8220"))


# Rows 11 and 12: signs of life


@BOTH
@pytest.mark.parametrize("how", ["off", "unplugged"])
def test_when_a_drive_is_gone_the_others_stop(profile: str, how: str) -> None:
    played = play(fault("node_silence", node=4, how=how), profile=profile)
    seen = played.said("node 4: no measurements for 3 cycles")
    assert seen == pytest.approx(AT + 0.025, abs=2e-3)
    assert played.stopped(seen)
    assert [played.state(node) for node in (3, 5)] == [OFF, OFF]
    quick_stops = [f for f in played.frames(0x203) if f.data[:2] == b"\x02\x00"]
    assert quick_stops[0].started / 1e9 == pytest.approx(seen, abs=3e-3)
    assert played.stood(0) - seen > 0.05  # a ramp, no jolt
    if how == "off":
        assert played.stood(1) <= AT + 2e-3  # its brake closes at once
    else:
        assert played.stood(1) > AT + 0.06  # it stops by itself when SYNC stays away, and brakes


@pytest.mark.parametrize("how", ["off", "unplugged"])
def test_a_drive_that_comes_back_is_not_enabled_again(how: str) -> None:
    played = play(fault("node_silence", 0.3, node=4, how=how, duration=0.3))
    assert played.stopped(played.said("no measurements"))
    assert played.nmt(4) is not NmtState.OPERATIONAL
    assert played.state(4) in (OFF, State.FAULT)
    if how == "off":
        assert played.said("node 4: has restarted") == pytest.approx(0.6, abs=1e-3)


def test_a_drive_without_heartbeat_stops_all() -> None:
    played = play(fault("heartbeat_loss", 0.3, node=4))
    seen = played.said("node 4: no heartbeat")
    last = max(f.started for f in played.frames(0x704)) / 1e9
    assert 0.3 < seen - last < 0.32
    assert played.stopped(seen)


@BOTH
def test_a_master_without_heartbeat_is_left(profile: str) -> None:
    played = play(fault("heartbeat_loss", 0.3), profile=profile)
    last = max(f.started for f in played.frames(0x77F)) / 1e9
    for node in (3, 4, 5):
        t, code = played.emergencies(node)[0]
        assert t == pytest.approx(last + 0.3, abs=2e-3)
        assert code == 0x8130
        assert played.state(node) in (OFF, State.FAULT)
    assert played.stopped(played.said("EMCY 0x8130"))


# Rows 13 and 14: resets, network management


@BOTH
def test_a_drive_that_restarts_in_motion(profile: str) -> None:
    played = play(fault("node_reset", node=4), profile=profile)
    seen = played.said("node 4: has restarted")
    assert seen == pytest.approx(AT, abs=1e-3)
    assert (played.state(4), played.braked(4)) == (OFF, True)
    assert played.stood(1) <= AT + 2e-3
    assert played.nmt(4) in (NmtState.PRE_OPERATIONAL, NmtState.STOPPED)
    assert played.simulation.arm.nodes[1].dictionary[0x6060, 0] == 0  # defaults are back
    assert played.stopped(seen)


@BOTH
@pytest.mark.parametrize("command", ["stop", "pre_operational", "reset_node", "reset_communication"])
@pytest.mark.parametrize("node", [4, None])
def test_a_command_of_another_master_stops_the_arm(profile: str, command: str, node: int | None) -> None:
    target = {} if node is None else {"node": node}
    played = play(fault("foreign_nmt", command=command, **target), profile=profile)
    assert played.stopped(played.said("another master sends NMT command"))
    assert played.nmt(4) is not NmtState.OPERATIONAL


@BOTH
def test_a_drive_that_leaves_operation_unseen_is_missed(profile: str) -> None:
    """The drive alone: another master's command that ours does not hear. PDOs stop, and the torque acts on."""
    simulation, ticks = canopen_run(build_blocks([scenario(profile=profile)], "default", 1))
    for k, _ in enumerate(ticks):
        if k == 50:
            simulation.arm.nodes[1]._enter(NmtState.PRE_OPERATIONAL, simulation.wire.now)
    assert simulation.session.fault == "node 4: no measurements for 3 cycles"
    assert all(drive.braked for drive in simulation.arm.drives)
    assert simulation.arm.nodes[1].state is NmtState.STOPPED
    said = next(t for t, text in simulation.master.watch.events if t > 0 and "node 4" in text)
    told = next(f.queued for f in simulation.wire.frames if f.can_id == 0 and f.data == b"\x02\x04" and f.queued > 0)
    assert told == said  # the quick stop it could not hear came as NMT stop, at once


def test_a_start_command_to_running_drives_is_harmless() -> None:
    assert play(fault("foreign_nmt", command="start")).went_on()


# Rows 15 and 16: bus-off, error passive


@BOTH
def test_a_drive_in_bus_off_stops_itself_and_all(profile: str) -> None:
    played = play(fault("bus_off", node=4), profile=profile)
    assert played.emergencies(4)[0][1] == 0x8140
    assert [f.outcome for f in played.simulation.wire.frames if f.node == "node 4"].count("error") == 32
    assert played.stopped(played.said("node 4"))
    assert played.nmt(4) is not NmtState.OPERATIONAL


@BOTH
def test_a_master_in_bus_off_gives_up_and_the_drives_stop_by_themselves(profile: str) -> None:
    played = play(fault("bus_off"), profile=profile)
    seen = played.said("the master's controller is bus-off")
    assert not [f for f in played.simulation.wire.frames if f.node == "master" and f.started > seen * 1e9]
    assert played.stopped(seen)
    assert played.stood(0) > 0.49 + 0.06  # by the SYNC watchdog, six periods after the last
    assert len(played.events) < 10  # no hot loop


@pytest.mark.parametrize("node", [4, None])
def test_error_passive_is_a_warning(node: int | None) -> None:
    played = play(fault("error_passive", **({} if node is None else {"node": node})))
    assert played.went_on()
    if node is None:
        assert played.said("the master's controller is error passive")
    else:
        assert [code for _, code in played.emergencies(4)] == [0x8120, 0x0000]


# Row 17: EMCY


@BOTH
def test_a_drive_with_an_error_stops_and_so_do_the_others(profile: str) -> None:
    played = play(fault("emergency", node=4, code=0x4310), profile=profile)
    assert [code for _, code in played.emergencies(4)] == [0x4310]
    dictionary = played.simulation.arm.nodes[1].dictionary
    assert dictionary[0x1001, 0] == 0x09  # generic, temperature
    assert dictionary[0x1003, 1] & 0xFFFF == 0x4310
    seen = played.said("node 4: EMCY 0x4310, error register 0x09")
    assert played.stopped(seen)
    assert played.state(4) is State.FAULT
    assert [played.state(node) for node in (3, 5)] == [OFF, OFF]


def test_a_stop_begun_in_a_cycle_without_measurements_is_a_quick_stop() -> None:
    lost = [fault("lost_pdo", node=node, pdo="tpdo1") for node in (3, 4, 5)]
    simulation, ticks = canopen_run(build_blocks([scenario(*lost)], "default", 1))
    for _ in range(round(AT / 0.01)):
        next(ticks)
    simulation.master.stop()
    words = [frame.data[0] for frame in simulation.wire.frames if frame.can_id == 0x203 and frame.started >= 0]
    assert [word for word, before in zip(words, [None, *words], strict=False) if word != before] == [0x0F, 0x02, 0x00]


# Rows 18, 20, 21: what is found before anything moves


def test_a_missing_drive_is_named_in_bounded_time() -> None:
    blocks = build_blocks([scenario(fault("node_silence", 0, node=5))], "default", 1)
    with pytest.raises(BusError, match=r"node 5: cannot read object 0x1000:00: no answer"):
        canopen_run(blocks)


def test_an_object_that_a_drive_lacks_is_named_with_the_text_of_the_abort(monkeypatch: pytest.MonkeyPatch) -> None:
    def lacking(profile: Any, node_id: int, joint: Any) -> Any:
        dictionary = drive_dictionary(profile, node_id, joint)
        if node_id == 4:
            del dictionary._entries[0x6502, 0]
        return dictionary

    monkeypatch.setattr("lwa4d_sim.bus.arm.drive_dictionary", lacking)
    with pytest.raises(BusError, match=r"node 4: cannot read object 0x6502:00: .*\(SDO abort 0x06090011\)"):
        canopen_run(build_blocks([scenario()], "default", 1))


def test_two_drives_with_one_id_do_not_start() -> None:
    with pytest.raises(LwaError, match=r"node 4: two answers to one request; two devices have this node id"):
        run(scenario(fault("duplicate_node", 0, node=4)))


def test_a_drive_that_starts_twice_is_not_trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    def flickering(master: Any, parameters: Any) -> None:
        master.wait(Ns(master.clock() + 2_000_000))  # equal frames at one instant are one frame
        master.bus._wire.port("flicker").send(can.Message(arbitration_id=0x704, data=[0], is_extended_id=False))
        commission(master, parameters)

    monkeypatch.setattr("lwa4d_sim.bus.simulation.commission", flickering)
    with pytest.raises(BusError, match=r"node 4: has started 2 times; two devices have this node id"):
        run(scenario())


def test_a_second_drive_with_an_id_that_appears_in_motion_stops_the_arm() -> None:
    played = play(fault("duplicate_node", node=4))
    assert played.stopped(played.said("node 4: has restarted"))


@pytest.mark.parametrize(("profile", "mode"), [("cia402", 10), ("lwa4d", 7)])
def test_a_drive_without_the_mode_does_not_start(profile: str, mode: int) -> None:
    with pytest.raises(BusError, match=rf"node 4: does not support mode {mode} .* its modes \(0x6502\) are 0x1"):
        run(scenario({"kind": "wrong_device", "node": 4}, profile=profile))


@pytest.mark.parametrize("reached", ["set up", "switched on"])
def test_a_start_up_that_fails_gives_the_gains_back(reached: str, monkeypatch: pytest.MonkeyPatch) -> None:
    gains: list[bytes] = []

    def refused(*args: Any) -> None:
        gains.append(args[0].client.read(4, 0x2020))
        raise BusError("refused")

    def watched(master: Any, parameters: Any) -> None:
        gains.append(master.client.read(4, 0x2020))
        try:
            commission(master, parameters)
        finally:
            gains.append(master.client.read(4, 0x2020))

    monkeypatch.setattr("lwa4d_sim.bus.simulation.commission", watched)
    name = "_reach" if reached == "set up" else "_time_out"
    monkeypatch.setattr(f"lwa4d_sim.bus.commission.{name}", refused)
    with pytest.raises(BusError, match="refused"):
        canopen_run(build_blocks([scenario(profile="lwa4d")], "default", 1))
    before, during, after = gains
    assert during == bytes(4)
    assert before == after != during


def test_a_drive_that_is_gone_does_not_keep_the_others_from_their_parameters() -> None:
    simulation, _ = canopen_run(build_blocks([scenario()], "default", 1))
    simulation.cut_off(4, power=True)
    with pytest.raises(BusError, match="node 4: cannot write object 0x6081:00: no answer"):
        put_back(simulation.master, [(node, (0x6081, 0), bytes((node, 0, 0, 0))) for node in (3, 4, 5)])
    assert [node.dictionary[0x6081, 0] for node in simulation.arm.nodes][::2] == [3, 5]


# Row 19: SDO flood


@pytest.mark.parametrize("request_", ["read", "endless"])
def test_an_sdo_flood_does_not_reach_the_pdos(request_: str) -> None:
    played = play(fault("sdo_flood", 0.2, node=4, request=request_, count=600))
    assert played.went_on()
    assert not played.events
    answers = played.frames(0x584)
    assert len(answers) >= (600 if request_ == "read" else 2)
    k = np.arange(3, 100)
    assert (played.ages[k] < 0.005).all()


# Rows 22 and 23: periods and set-points that cannot be


@given(count=st.integers(1, 255), exponent=st.integers(-6, -3))
def test_any_period_that_60c2_can_say_is_said(count: int, exponent: int) -> None:
    period = Ns(count * 10 ** (9 + exponent))
    said = interpolation_period(period)
    assert said[0] * 10 ** (9 + said[1]) == period
    assert 1 <= said[0] <= 255


@pytest.mark.parametrize(("period", "said"), [(0.01, (10, -3)), (0.0025, (25, -4))])
def test_the_drives_know_the_period(period: float, said: tuple[int, int]) -> None:
    simulation, _ = canopen_run(build_blocks([_fine(period)], "default", 1))
    for node in simulation.arm.nodes:
        assert (node.dictionary[0x60C2, 1], node.dictionary[0x60C2, 2]) == said


def _fine(period: float) -> Scenario:
    return scenario(period=period, bit_rate=1_000_000).changed({"plant.timestep": 0.0005}, "default")


LAW = """
import numpy as np
class Law:
    space = "joint"
    def torque(self, state, ref, model):
        return np.array([[{torque}, 0.0, 0.0]])
"""


@pytest.mark.parametrize("torque", ["np.nan", "np.inf"])
def test_a_torque_that_is_no_number_never_reaches_the_bus(
    torque: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = f"law_{torque[3:]}"
    (tmp_path / f"{name}.py").write_text(LAW.format(torque=torque))
    monkeypatch.syspath_prepend(tmp_path)
    played = play(controller={"kind": f"{name}:Law"})
    assert played.said("the controller's torque is not a number") < 0.02
    assert not any(int(f.data[0]) & 0x0F == 0x0F for f in played.frames(0x203))
    assert (played.dq == 0).all()


def test_a_torque_beyond_the_number_range_is_the_largest_that_there_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "law_huge.py").write_text(LAW.format(torque="-1e9"))
    monkeypatch.syspath_prepend(tmp_path)
    simulation, ticks = canopen_run(build_blocks([scenario(controller={"kind": "law_huge:Law"})], "default", 1))
    tau = np.concatenate([tick.tau[0] for _, tick in zip(range(5), ticks, strict=False)])
    assert np.nanmin(tau[:, 0]) == pytest.approx(-simulation.arm.drives[0].axis.joint.torque)
    sent = [f for f in simulation.wire.frames if f.can_id == 0x203 and f.started > 0]
    assert int.from_bytes(sent[-1].data[2:4], "little", signed=True) == -32767


# Row 24: following error


def test_a_following_error_of_one_drive_stops_the_others() -> None:
    played = play(fault("emergency", node=3, code=0x8611))
    assert played.stopped(played.said("node 3: EMCY 0x8611"))
    assert played.state(3) is State.FAULT


# Row 28 (and 34): the controller's process


def test_a_short_pause_of_the_controller_is_counted_and_not_caught_up() -> None:
    played = play(fault("master_crash", 0.4985, duration=0.035))
    assert played.went_on()
    assert played.simulation.session.late == 4
    syncs = [frame.queued for frame in played.frames(0x080)]
    gaps = [b - a for a, b in pairwise(syncs)]
    assert sorted(set(gaps)) == [10_000_000, 50_000_000]
    assert all(t % 10_000_000 == 0 for t in syncs)


def test_a_long_pause_of_the_controller_is_a_loss() -> None:
    played = play(fault("master_crash", duration=0.2))
    for node in (3, 4, 5):
        t, code = played.emergencies(node)[0]
        assert t == pytest.approx(0.49 + 0.06, abs=2e-3)
        assert code == 0x8100
    assert played.stopped(0.55)
    assert played.simulation.session.fault is not None


@BOTH
def test_drives_whose_master_has_died_stop_by_themselves(profile: str) -> None:
    played = play(fault("master_crash"), profile=profile)
    assert not [f for f in played.simulation.wire.frames if f.node == "master" and f.queued > AT * 1e9]
    assert played.stopped(0.55)
    assert not played.events  # the dead say nothing


# Rows 29 and 30: too much on the bus


@pytest.mark.parametrize(
    ("loop", "text"),
    [
        ({"bit_rate": 100_000}, r"loop.bit_rate .*3 drives every 10 ms take up to 1\d\d % of the bus at 100000 bit/s"),
        ({"period": 0.002}, r"loop.bit_rate: 3 drives every 2 ms take up to 1\d\d % of the bus at 500000 bit/s"),
        ({"deadline": 0.001}, r"loop.deadline .*SYNC and measurements of 3 drives take up to 1.\d ms"),
        ({"deadline": 0.01}, r"loop.deadline .*must be below the period of 0.01 s"),
        ({"period": 0.301}, r"loop.period .*cannot be told a period of 301 ms"),
        ({"traffic": [{"id": 0x184, "period": 0.1}]}, r"loop.traffic.0.id.*identifier 0x184 has a sender already"),
        ({"traffic": [{"id": 0x604, "period": 0.1}]}, r"loop.traffic.0.id.*identifier 0x604 has a sender already"),
        ({"traffic": [{"id": 5, "period": 0.0002}]}, r"loop.bit_rate: 3 drives .* % of the bus"),
        ({"traffic": [{"id": 5, "period": 1e-10}]}, r"loop.traffic.0.period .*must be a number of at least 4.7e-05"),
        ({"heartbeat": 0.003}, r"loop.heartbeat .*must be 0 or above 0.003333 s"),
        ({"heartbeat": 1e-9}, r"loop.heartbeat .*must be 0 or above 0.003333 s"),
        ({"noise": {"per_bit": 1e-4}, "bit_rate": None}, r"loop.noise.per_bit.*needs frames that take time"),
    ],
    ids=str,
)
def test_what_the_bus_cannot_carry_is_refused_with_figures(loop: dict[str, Any], text: str) -> None:
    with pytest.raises(ScenarioError, match=text):
        run(scenario(**loop))


def test_on_a_full_bus_the_least_urgent_starve_first() -> None:
    """Heartbeats (7xx) behind a stranger that takes all that is left: the PDOs go on until they are missed."""
    played = play(fault("babbling_node", 0.3, id=0x6FF))
    last = max(f.started for node in (3, 4, 5, 127) for f in played.frames(0x700 + node)) / 1e9
    assert last < 0.32
    (t, code) = played.emergencies(3)[0]
    assert code == 0x8130
    before = [f for f in played.frames(0x183) if 0.3e9 < f.started < t * 1e9]
    assert len(before) >= 18  # no measurement was lost
    assert played.stopped(played.said("EMCY 0x8130"), within=0.3)


@BOTH
def test_a_babbling_node_starves_all_and_the_arm_stops(profile: str) -> None:
    played = play(fault("babbling_node", duration=0.3), profile=profile)
    seen = played.said("no measurements for 3 cycles")
    assert seen == pytest.approx(AT + 0.025, abs=2e-3)
    assert played.stopped(seen)
    busy = [f for f in played.simulation.wire.frames if 0.51e9 < f.started < 0.79e9 and f.received]
    assert {f.can_id for f in busy} == {0, 1}  # the master's NMT stop is more urgent still


# Rows 31 and 32: frames that do not belong


@pytest.mark.parametrize(
    "foreign",
    [
        {"id": 0x603, "data": [0x40, 0, 0x10, 0, 0, 0, 0, 0], "extended": True},
        {"id": 0x080, "extended": True},
        {"id": 0x000, "data": [2, 0], "extended": True},
        {"id": 0x203, "data": [0] * 8, "extended": True},
        {"id": 0x1FFFFFFF, "data": [1] * 8, "extended": True},
        {"id": 0x603, "data": [0x40]},
        {"id": 0x603, "data": []},
        {"id": 0x583, "data": [1, 2, 3]},
        {"id": 0x083, "data": [1]},
        {"id": 0x703, "data": []},
        {"id": 0x183, "remote": True},
        {"id": 0x704, "data": [0], "remote": True},
        {"id": 0x080, "remote": True},
        {"id": 0x7FF, "data": [9] * 8},
        {"id": 0x000, "data": [2]},
        {"id": 0x000, "data": [2, 0, 0]},
        {"id": 0x000, "data": [0x55, 0]},
        {"id": 0x000, "data": [2, 200]},
        {"id": 0x000, "data": [2, 77]},
    ],
    ids=lambda foreign: (
        f"{foreign['id']:X}{'x' * foreign.get('extended', 0)}{'r' * foreign.get('remote', 0)} "
        f"{bytes(foreign.get('data', ())).hex()}"
    ),
)
def test_frames_that_do_not_belong_change_nothing(foreign: dict[str, Any]) -> None:
    played = play(fault("foreign_frames", 0.5035, count=20, period=0.0021, **foreign))
    assert played.went_on()
    assert follows_the_wire(played)
    assert len(played.frames(foreign["id"])) > 0 or foreign.get("extended")
    assert [text for _, text in played.events if "TPDO" not in text] == []
    assert np.abs(played.q - undisturbed("cia402").q).max() < 1e-3


@BOTH
def test_a_drive_that_somebody_else_disables_stops_the_others(profile: str) -> None:
    """An SDO of a stranger, who writes controlword 0."""
    played = play(fault("foreign_frames", id=0x604, data=[0x2B, 0x40, 0x60, 0, 0, 0, 0, 0]), profile=profile)
    assert played.stopped(played.said("node 4: left operation"))
    assert played.stood(1) < AT + 2e-3
    assert played.stood(0) > AT + 0.05


def test_set_points_of_a_stranger_stop_the_arm() -> None:
    played = play(fault("foreign_frames", id=0x204, data=[0x0F, 0, 0xD8, 0xFF, 0, 0, 0, 0]))
    assert played.stopped(played.said("another master sends set-points to node 4"))


# Beyond the table: encoder and brake


@BOTH
def test_a_stuck_encoder_shows_in_the_following_error(profile: str) -> None:
    played = play(fault("stuck_encoder", node=3), profile=profile, following_error=0.03)
    seen = played.said("is 0.03")
    assert AT < seen < AT + 0.2
    assert all(played.braked(node) for node in (3, 4, 5))
    assert not any(played.state(node) is State.OPERATION_ENABLED for node in (3, 4, 5))


@BOTH
def test_a_brake_that_fails_lets_its_joint_fall_and_is_noticed(profile: str) -> None:
    faults = [fault("brake_failure", 0.2, node=4), fault("emergency", node=3)]
    played = play(*faults, profile=profile)
    assert played.said("node 4: moves although its brake is closed") > 0.6
    assert np.abs(played.dq[-1, 1]) > 0.1
    assert [played.braked(node) for node in (3, 4, 5)] == [True, False, True]
    assert (played.dq[-100:, [0, 2]] == 0).all()


# The parameters


@pytest.mark.parametrize(
    ("happens", "text"),
    [
        (fault("lost_snc"), "must be one of lost_sync, late_sync"),
        (fault("lost_pdo", node=4), r"faults.0.pdo: is missing; it must be one of rpdo1, rpdo2, tpdo1, tpdo2"),
        (fault("node_reset", node=9), r"faults.0.node.*no drive has this node id; they have 3, 4, 5"),
        (fault("long_pdo", node=4, pdo="rpdo1"), r"faults.0.size.* rpdo1 of the profile 'cia402' has 8 bytes"),
        (fault("short_pdo", node=4, pdo="rpdo2", size=6), r"faults.0.size.*has 6 bytes; size must be below 6"),
        (fault("foreign_frames", id=0x800), r"faults.0.id.*must be at most 2047"),
        (fault("foreign_frames", id=1, data=[0] * 9), r"faults.0.data.*at most 8 bytes"),
        (fault("foreign_sync", period=1e-9), r"faults.0.period .*must be a number of at least 4.7e-05"),
        (fault("late_sync", delay=0), r"faults.0.delay .*must be a number above 0"),
        (fault("babbling_node", id=2048), r"must be a whole number of at least 0 and of at most 2047"),
    ],
    ids=lambda value: value["kind"] if isinstance(value, dict) else "",
)
def test_a_fault_that_cannot_be_is_refused(happens: dict[str, Any], text: str) -> None:
    with pytest.raises(ScenarioError, match=text):
        run(scenario(happens))


@pytest.mark.parametrize("kind", ["bus_off", "error_passive", "babbling_node"])
def test_faults_of_bits_need_bits(kind: str) -> None:
    with pytest.raises(ScenarioError, match=r"faults.0.kind.*needs frames that take time"):
        run(scenario(fault(kind), bit_rate=None))


def test_faults_stand_in_the_record() -> None:
    log = run(scenario(fault("node_silence", node=4, duration=0.1)))
    texts = [text for t, text in log.events if t >= AT]
    assert texts[0] == "fault: node_silence"
    assert "fault: node_silence is over" in texts


def test_a_run_with_faults_repeats_bit_for_bit() -> None:
    faults = [fault("bus_off", 0.3, node=5), fault("lost_pdo", 0.2, node=3, pdo="rpdo1")]
    one, two = run(scenario(*faults)), run(scenario(*faults))
    assert one.q.tobytes() == two.q.tobytes()
    assert one.events == two.events


# The page

PAGE = (Path(__file__).parent.parent / "docs" / "canopen.md").read_text(encoding="utf-8")
TABLE = [row.split("|")[1:-1] for row in PAGE.splitlines() if row.startswith("| ") and row[2].isdigit()]


def test_the_table_of_faults_is_complete_and_each_row_has_its_tests() -> None:
    assert [int(row[0]) for row in TABLE] == list(range(1, 37))
    for number, *_, tests in TABLE:
        named = [part.strip().strip("`").split("::") for part in tests.split(",")]
        assert named, number
        for file, name in named:
            text = (Path(__file__).parent / file).read_text(encoding="utf-8")
            assert f"def {name}(" in text, f"row {number}: {name}"


def test_every_kind_of_fault_is_in_the_table_and_is_put_in_by_a_test() -> None:
    kinds = {kind for cls in get_args(Fault) for kind in get_args(get_type_hints(cls)["kind"])}
    told = set(re.findall(r"`([a-z_]+)`", " ".join(row[1] for row in TABLE)))
    assert told == kinds
    here = Path(__file__).read_text(encoding="utf-8")
    assert all(f'"{kind}"' in here for kind in kinds)
