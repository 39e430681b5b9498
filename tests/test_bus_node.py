"""The slave core: network management, error control, SYNC, EMCY, PDOs, and frames that wish it harm."""

import contextlib
from collections.abc import Callable
from typing import Any

import can
import canopen
import pytest
from bus_loop import MS, NODE, SCRATCH, Bench, Loop, frame
from hypothesis import given, settings
from hypothesis import strategies as st

from lwa4d_sim.bus.dictionary import Abort
from lwa4d_sim.bus.node import NmtState, Node
from lwa4d_sim.interfaces import Ns

EMCY, ALIVE, SYNC = 0x080 + NODE, 0x700 + NODE, 0x080
RPDO1, RPDO2, TPDO1, TPDO2 = 0x200 + NODE, 0x300 + NODE, 0x180 + NODE, 0x280 + NODE
BOOT_UP = (ALIVE, b"\0")


def emcy(code: int, register: int, info: str = "0000000000") -> tuple[int, bytes]:
    return EMCY, code.to_bytes(2, "little") + bytes((register,)) + bytes.fromhex(info)


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture
def running() -> Bench:
    bench = Bench()
    bench.start()
    bench.device.calls.clear()
    return bench


# Network management.

COMMANDS = {0x01: 5, 0x02: 4, 0x80: 127, 0x81: 127, 0x82: 127}


def test_power_on_announces_the_node() -> None:
    bench = Bench(on=False)
    assert bench.node.state == 0
    assert bench.put(0x000, 1, NODE) == []
    assert bench.node.state == 0
    assert bench.node.poll(Ns(0)) is None
    bench.node.power_on(Ns(7))
    assert bench.take() == [BOOT_UP]
    assert bench.node.state == NmtState.PRE_OPERATIONAL
    assert bench.device.named("reset") == [("reset", 7)]


@settings(deadline=None)
@given(st.lists(st.tuples(st.sampled_from([*COMMANDS, 0x00, 0x03, 0x7F, 0x83]), st.integers(0, 255)), max_size=12))
def test_the_state_follows_the_master(commands: list[tuple[int, int]]) -> None:
    bench = Bench()
    state = 127
    for command, node in commands:
        sent = bench.put(0x000, command, node)
        if node in (0, NODE):
            state = COMMANDS.get(command, state)
            assert (BOOT_UP in sent) == (command in (0x81, 0x82))
        assert bench.node.state == state


@pytest.mark.parametrize("data", [b"", b"\1", b"\1\5\0", b"\1\5" + bytes(6)])
def test_a_malformed_command_is_no_command(bench: Bench, data: bytes) -> None:
    assert bench.put(0x000, data) == []
    assert bench.node.state == NmtState.PRE_OPERATIONAL


def test_resets_reset_what_they_say() -> None:
    for command, application in ((0x81, 6), (0x82, 77)):
        bench = Bench()
        assert bench.write(0x1017, 0, 500, 2) == 0
        assert bench.write(0x200E, 0, 77, 1) == 0
        bench.device.calls.clear()
        assert BOOT_UP in bench.nmt(command)
        assert (bench.dictionary[0x1017, 0], bench.dictionary[0x200E, 0]) == (0, application)
        assert bench.device.named("reset") == ([("reset", 0)] if command == 0x81 else [])
        assert bench.run(2000 * MS) == []  # the heartbeat is off


def test_parameters_that_were_saved_survive_power() -> None:
    bench = Bench()
    assert bench.write(0x1017, 0, 500, 2) == bench.write(0x200E, 0, 77, 1) == 0
    save, load = (int.from_bytes(text, "little") for text in (b"save", b"load"))
    assert bench.write(0x1010, 2, load, 4) == 0x08000020
    assert bench.write(0x1010, 2, save, 4) == 0
    bench.nmt(0x81)
    assert (bench.dictionary[0x1017, 0], bench.dictionary[0x200E, 0]) == (500, 6)
    assert [t for t, cob_id, _ in bench.run(1000 * MS) if cob_id == ALIVE] == [500 * MS, 1000 * MS]
    assert bench.write(0x1011, 1, save, 4) == 0x08000020
    assert bench.write(0x1011, 1, load, 4) == 0
    assert bench.dictionary[0x1017, 0] == 500  # until the next reset
    bench.nmt(0x82)
    assert bench.dictionary[0x1017, 0] == 0
    assert bench.sdo("4010100100000000") == "4310100101000000"


def test_each_state_has_its_services(running: Bench) -> None:
    read = bytes.fromhex("4000100000000000")
    for command, sdo, pdo, sync in ((0x01, 1, 2, 1), (0x80, 1, 0, 1), (0x02, 0, 0, 0)):
        running.nmt(command)
        running.device.calls.clear()
        assert len(running.put(0x600 + NODE, read)) == sdo
        assert len(running.put(SYNC)) == pdo
        assert len(running.device.named("sync")) == sync
        assert (RPDO1 in running.node.cob_ids) == bool(pdo)
        assert len(running.put(ALIVE, is_remote_frame=True)) == 1


def test_the_device_hears_of_a_stop_and_of_a_reset_of_the_communication(running: Bench) -> None:
    running.nmt(0x80)
    assert running.device.named("lost") == []
    running.nmt(0x02)
    running.nmt(0x02)
    assert running.device.named("lost") == [("lost", "nmt_stop", 0)]
    running.nmt(0x01)
    running.nmt(0x82)
    assert running.device.named("lost") == [("lost", "nmt_stop", 0)] * 2


def test_listening_changes_with_the_parameters(running: Bench) -> None:
    known = running.node.cob_ids
    assert known == {0, SYNC, RPDO1, RPDO2, TPDO1, TPDO2, 0x600 + NODE, ALIVE}
    assert running.write(0x6081, 0, 5, 4) == 0
    assert running.node.cob_ids is known  # the arm side compares by identity
    assert running.write(0x1400, 1, 0x80000000 | RPDO1, 4) == 0
    assert running.write(0x1016, 1, 0x7F0064, 4) == 0
    assert running.node.cob_ids == known - {RPDO1} | {0x77F}


def test_a_node_id_that_cannot_be_is_refused(bench: Bench) -> None:
    for node_id in (0, 128):
        with pytest.raises(ValueError, match="node id"):
            Node(node_id, bench.dictionary, bench.sent.append)


# Error control.


@settings(deadline=None)
@given(st.integers(1, 500), st.integers(1, 500))
def test_heartbeats_keep_their_grid(period: int, other: int) -> None:
    bench = Bench()
    assert bench.write(0x1017, 0, period, 2) == 0
    bench.start()
    seen = bench.run(1000 * MS)
    assert seen == [(t * MS, ALIVE, b"\5") for t in range(period, 1001, period)]
    assert bench.write(0x1017, 0, other, 2) == 0
    assert bench.run(2000 * MS) == [(t * MS, ALIVE, b"\5") for t in range(1000 + other, 2001, other)]


def test_a_late_call_sends_one_heartbeat_and_returns_to_the_grid(bench: Bench) -> None:
    bench.write(0x1017, 0, 100, 2)
    bench.now = Ns(555 * MS)
    assert bench.run(700 * MS) == [(t * MS, ALIVE, b"\x7f") for t in (555, 600, 700)]


def test_guarding_answers_with_state_and_toggle(bench: Bench) -> None:
    answers = [bench.put(ALIVE, is_remote_frame=True) for _ in range(3)]
    assert answers == [[(ALIVE, b"\x7f")], [(ALIVE, b"\xff")], [(ALIVE, b"\x7f")]]
    bench.nmt(0x02)
    assert bench.put(ALIVE, is_remote_frame=True) == [(ALIVE, b"\x84")]
    assert bench.put(ALIVE, is_remote_frame=True) == [(ALIVE, b"\x04")]
    bench.nmt(0x82)
    assert bench.put(ALIVE, is_remote_frame=True) == [(ALIVE, b"\x7f")]  # toggle begins anew
    bench.write(0x1017, 0, 100, 2)
    assert bench.put(ALIVE, is_remote_frame=True) == []  # the heartbeat takes its place
    assert bench.put(ALIVE, 5) == []  # a foreign heartbeat with our id


def test_life_guarding(running: Bench) -> None:
    running.write(0x100C, 0, 50, 2)
    running.write(0x100D, 0, 3, 1)
    assert running.run(1000 * MS) == []  # it starts with the first remote frame
    for _ in range(4):
        running.put(ALIVE, is_remote_frame=True)
        assert running.run(running.now + 149 * MS) == []
    running.put(ALIVE, is_remote_frame=True)
    begun = running.now
    assert running.run(begun + 500 * MS) == [(begun + 150 * MS, *emcy(0x8130, 0x11))]
    assert running.device.named("lost") == [("lost", "guarding", begun + 150 * MS)]
    assert running.node.state == NmtState.PRE_OPERATIONAL
    assert emcy(0, 0) in running.put(ALIVE, is_remote_frame=True)


@pytest.mark.parametrize(("behaviour", "state"), [(0, 127), (1, 5), (2, 4)])
def test_a_lost_master(running: Bench, behaviour: int, state: int) -> None:
    assert running.write(0x1029, 1, behaviour, 1) == 0
    assert running.write(0x1016, 2, 1 << 16 | 100, 4) == 0
    assert running.run(1000 * MS) == []  # it is watched from its first heartbeat on
    for _ in range(3):
        assert running.put(0x701, 5) == []
        assert running.run(running.now + 99 * MS) == []
    begun = running.now
    seen = running.run(begun + 500 * MS)
    assert seen == [(begun + MS, *emcy(0x8130, 0x11))]
    assert running.device.named("lost") == [("lost", "heartbeat", begun + MS)]
    assert running.node.state == state
    assert running.dictionary[0x1001, 0] == 0x11
    back = running.put(0x701, 127)
    assert back == ([emcy(0, 0)] if state != 4 else [])
    assert running.dictionary[0x1001, 0] == 0
    running.nmt(0x80)
    assert running.put(0x701, 5) == []


def test_a_master_that_boots_has_been_lost(running: Bench) -> None:
    running.write(0x1016, 1, 1 << 16 | 100, 4)
    assert running.put(0x701, 0) == []
    running.put(0x701, 5)
    assert running.put(0x701, 0) == [emcy(0x8130, 0x11)]
    assert running.put(0x701, 5, 5) == running.put(0x701) == []  # not heartbeats
    assert running.put(0x701, 5) == [emcy(0, 0)]


def test_consumers_are_not_doubled_and_can_be_dropped(running: Bench) -> None:
    assert running.write(0x1016, 1, 1 << 16 | 100, 4) == 0
    assert running.write(0x1016, 2, 1 << 16 | 50, 4) == 0x06040043
    assert running.write(0x1016, 2, 2 << 16 | 50, 4) == 0
    running.put(0x701, 5)
    running.put(0x702, 5)
    assert [data for _, _, data in running.run(200 * MS)] == [emcy(0x8130, 0x11)[1]]  # told once
    assert running.put(0x701, 5) == []
    assert emcy(0, 0) in running.put(0x600 + NODE, bytes.fromhex("2316100200000000"))


def test_who_was_missing_before_a_reset_is_forgotten(running: Bench) -> None:
    for sub in (1, 2):
        assert running.write(0x1016, sub, sub << 16 | 100, 4) == 0
        running.put(0x700 + sub, 5)
    running.write(0x1010, 1, int.from_bytes(b"save", "little"), 4)
    assert [data for _, _, data in running.run(200 * MS)] == [emcy(0x8130, 0x11)[1]]
    running.nmt(0x82)
    assert running.put(0x701, 5) == []
    assert [data for _, _, data in running.run(400 * MS)] == [emcy(0x8130, 0x11)[1]]
    assert running.put(0x701, 5) == [emcy(0, 0)]


# SYNC.


def test_a_sync_of_the_wrong_length_is_reported_once_and_has_no_effect(running: Bench) -> None:
    assert running.put(SYNC, 1) == [emcy(0x8240, 0x11)]
    assert running.put(SYNC, 1) == running.put(SYNC, bytes(8)) == []
    assert running.device.named("sync") == []
    assert running.put(SYNC, is_remote_frame=True) == []
    assert [cob_id for cob_id, _ in running.put(SYNC)] == [EMCY, TPDO1, TPDO2]
    assert running.dictionary[0x1001, 0] == 0


def test_the_sync_can_move_and_count(bench: Bench) -> None:
    assert bench.write(0x1019, 0, 1, 1) == 0x06090030
    assert bench.write(0x1019, 0, 241, 1) == 0x06090031
    assert bench.write(0x1019, 0, 10, 1) == 0
    assert bench.write(0x1005, 0, 0x90, 4) == 0
    assert [bench.write(0x1005, 0, bad, 4) for bad in (0x20000080, 0x800, 0x10)] == [0x06090030] * 3
    assert bench.write(0x1005, 0, EMCY, 4) == 0x06040043
    bench.start()
    assert bench.put(SYNC) == []
    assert [cob_id for cob_id, _ in bench.put(0x90, 1)] == [TPDO1, TPDO2]
    assert bench.put(0x90) == [emcy(0x8240, 0x11)]


@pytest.mark.parametrize("overflow", [0, 3])
def test_a_producer_sends_on_its_grid_and_obeys_itself(bench: Bench, overflow: int) -> None:
    assert bench.write(0x1019, 0, overflow, 1) == 0
    assert bench.write(0x1006, 0, 4000, 4) == 0
    assert bench.write(0x1019, 0, 5, 1) == 0x08000022
    assert bench.write(0x1005, 0, 0x40000080, 4) == 0
    assert bench.write(0x1005, 0, 0x40000090, 4) == 0x06090030
    bench.start()
    seen = bench.run(20 * MS)
    counters = [bytes((1 + k % overflow,)) if overflow else b"" for k in range(5)]
    assert [(t, data) for t, cob_id, data in seen if cob_id == SYNC] == [
        (4 * (k + 1) * MS, counter) for k, counter in enumerate(counters)
    ]
    assert [t for t, cob_id, _ in seen if cob_id == TPDO1] == [4 * k * MS for k in range(1, 6)]
    bench.nmt(0x02)
    assert bench.run(100 * MS) == []
    bench.nmt(0x80)
    assert bench.run(104 * MS) == [(104 * MS, SYNC, counters[0])]  # it begins anew


def test_the_firmware_cannot_produce_sync() -> None:
    bench = Bench("lwa4d")
    assert bench.write(0x1005, 0, 0x40000080, 4) == 0x06090030
    assert bench.write(0x1006, 0, 1000, 4) == 0x06020000


# Emergencies.


def test_errors_are_told_once_kept_and_taken_back(bench: Bench) -> None:
    node, values = bench.node, bench.dictionary
    node.emergency(0x2310, 0x02, b"\xde")
    node.emergency(0x2310, 0x02, b"\xde")
    assert bench.take() == [emcy(0x2310, 0x03, "de00000000")]
    node.emergency(0x8611, 0x20, b"123456")
    assert bench.take() == [emcy(0x8611, 0x23, "3132333435")]
    assert [values[0x1003, sub] for sub in range(4)] == [2, 0x32318611, 0x00DE2310, 0]
    node.recovered(0x2310)
    node.recovered(0x2310)
    assert bench.take() == [emcy(0, 0x21)]
    node.recovered(0x8611)
    assert bench.take() == [emcy(0, 0)]
    assert values[0x1001, 0] == 0
    assert values[0x1003, 0] == 2  # history stays until it is cleared
    assert bench.write(0x1003, 0, 0, 1) == 0
    assert [values[0x1003, sub] for sub in range(4)] == [0, 0, 0, 0]
    node.emergency(0x2310, 0x02)
    assert bench.take() == [emcy(0x2310, 0x03)]


@settings(deadline=None)
@given(st.lists(st.integers(0x1000, 0x10FF), max_size=20, unique=True), st.sampled_from(["lwa4d", "cia402"]))
def test_the_history_holds_the_newest_first(codes: list[int], profile: str) -> None:
    bench = Bench("lwa4d" if profile == "lwa4d" else "cia402")
    depth = 2 if profile == "lwa4d" else 8
    for code in codes:
        bench.node.emergency(code, 0)
    kept = codes[::-1][:depth]
    assert [bench.dictionary[0x1003, sub] for sub in range(1, depth + 1)] == kept + [0] * (depth - len(kept))
    assert bench.dictionary[0x1003, 0] == len(kept)


def test_the_inhibit_time_keeps_emergencies_apart(bench: Bench) -> None:
    assert bench.write(0x1015, 0, 50, 2) == 0  # 5 ms
    for code in (0x2310, 0x4310, 0x5000):
        bench.node.emergency(code, 1)
    assert bench.take() == [emcy(0x2310, 1)]
    assert bench.run(100 * MS) == [(5 * MS, *emcy(0x4310, 1)), (10 * MS, *emcy(0x5000, 1))]


def test_emergencies_of_a_stopped_node_wait(bench: Bench) -> None:
    bench.nmt(0x02)
    for code in range(0x2000, 0x2100):
        bench.node.emergency(code, 1)
    assert bench.take() == []
    told = bench.nmt(0x80)
    assert told == [emcy(code, 1) for code in range(0x20F0, 0x2100)]  # the newest; memory has an end


def test_a_reset_forgets_what_was_not_told_yet_and_tells_anew(running: Bench) -> None:
    running.nmt(0x02)
    running.node.emergency(0x2310, 1)
    assert running.nmt(0x81) == [BOOT_UP]
    for _ in range(2):
        running.start()
        assert running.put(RPDO1, 0) == [emcy(0x8210, 0x11)]
        assert running.put(SYNC, 0) == [emcy(0x8240, 0x11)]
        running.nmt(0x82)


def test_the_emergency_identifier_can_move_and_go(bench: Bench) -> None:
    assert bench.write(0x1014, 0, 0x99, 4) == 0x06090030  # not while it is valid
    assert bench.write(0x1014, 0, 0x80000085, 4) == 0
    bench.node.emergency(0x2310, 1)
    assert bench.take() == []
    assert bench.write(0x1014, 0, 0x99, 4) == 0
    bench.node.emergency(0x4310, 1)
    assert bench.take() == [(0x99, emcy(0x4310, 1)[1])]
    assert bench.dictionary[0x1003, 1] == 0x4310


def test_a_reset_of_the_communication_keeps_the_errors_of_the_device(running: Bench) -> None:
    running.node.emergency(0x2310, 0x02)
    running.put(SYNC, 1)
    assert running.dictionary[0x1001, 0] == 0x13
    running.nmt(0x82)
    assert running.dictionary[0x1001, 0] == 0x03
    running.nmt(0x81)
    assert running.dictionary[0x1001, 0] == 0
    running.take()
    running.node.recovered(0x2310)
    assert running.take() == []


def error_frame(kind: int, detail: int = 0) -> can.Message:
    return can.Message(arbitration_id=kind, is_error_frame=True, is_extended_id=False, data=[0, detail] + [0] * 6)


def test_what_the_controller_reports(running: Bench) -> None:
    def report(kind: int, detail: int = 0) -> list[tuple[int, bytes]]:
        running.node.receive(error_frame(kind, detail), running.now)
        return running.take()

    assert report(0x204, 0x20) == [emcy(0x8120, 0x11)]
    assert report(0x204, 0x10) == []
    assert report(0x204, 0x40) == [emcy(0, 0)]
    assert report(0x004, 0x01) == [emcy(0x8110, 0x11), emcy(0, 0)]
    report(0x040)
    assert running.device.named("lost") == [("lost", "bus_off", 0)]
    assert running.node.state == NmtState.PRE_OPERATIONAL
    assert report(0x100) == [emcy(0x8140, 0x11), emcy(0, 0)]
    assert report(0x008, 0xFF) == report(0x080) == []


def test_a_bus_that_takes_no_frames_is_no_crash() -> None:
    def refuse(msg: can.Message) -> None:
        raise can.CanOperationError("bus-off")

    bench = Bench()
    node = Node(NODE, bench.dictionary, refuse)
    node.power_on(Ns(0))
    node.receive(frame(0x000, 1, 0), Ns(0))
    node.receive(frame(SYNC), Ns(0))
    node.emergency(0x2310, 1)
    assert node.state == NmtState.OPERATIONAL


# PDOs.


def test_a_command_waits_for_sync_and_the_last_one_wins(running: Bench) -> None:
    assert running.put(RPDO1, bytes.fromhex("06000000 64000000")) == []
    assert running.put(RPDO1, bytes.fromhex("0f00f6ff e8030000")) == []
    assert running.put(RPDO2, bytes.fromhex("70170000 0300")) == []
    assert running.dictionary[0x6040, 0] == 0
    assert running.device.calls == []
    running.now = Ns(3 * MS)
    running.put(SYNC)
    values = running.dictionary
    assert [values[k, 0] for k in (0x6040, 0x6071, 0x607A, 0x60FF, 0x60B2)] == [15, -10, 1000, 6000, 3]
    assert running.device.calls == [
        ("advance", 3 * MS),
        *[("written", index, 0) for index in (0x6040, 0x6071, 0x607A, 0x60FF, 0x60B2)],
        ("sync", 3 * MS),
        ("refresh",),
    ]
    running.device.calls.clear()
    running.put(SYNC)
    assert running.device.named("written") == []  # it acts once


def test_actual_values_are_sampled_after_sync(running: Bench) -> None:
    def refresh() -> None:
        running.dictionary[0x6041, 0] = 0x1237
        running.dictionary[0x6064, 0] = -10000

    running.device.on_refresh = refresh
    assert running.put(SYNC)[0] == (TPDO1, bytes.fromhex("37120000f0d8ffff"))


def test_an_asynchronous_command_acts_at_once() -> None:
    bench = Bench("lwa4d")
    bench.start()
    bench.device.calls.clear()
    bench.put(RPDO1, bytes.fromhex("0f00 0100 64000000"))
    assert bench.device.calls[0] == ("advance", 0)
    assert bench.device.named("written") == [("written", 0x6040, 0), ("written", 0x60B2, 0), ("written", 0x60C1, 1)]
    assert bench.dictionary[0x60C1, 1] == 100


def test_the_whole_set_point_is_there_when_the_device_is_told(running: Bench) -> None:
    seen: list[tuple[int, int]] = []
    running.device.on_written = lambda index, sub: seen.append(
        (running.dictionary[0x6040, 0], running.dictionary[0x60FF, 0])
    )
    running.put(RPDO1, bytes.fromhex("0f00 0000 00000000"))
    running.put(RPDO2, bytes.fromhex("70170000 0000"))
    running.put(SYNC)
    assert seen == [(15, 6000)] * 5


def test_a_value_that_the_device_or_the_limits_refuse_is_left_out(running: Bench) -> None:
    def refuse(index: int, sub: int) -> None:
        if index == 0x6071:
            raise Abort(0x06090030)

    running.device.on_written = refuse
    running.put(RPDO1, bytes.fromhex("0f00 0500 64000000"))
    running.put(SYNC)
    assert [running.dictionary[k, 0] for k in (0x6040, 0x6071, 0x607A)] == [15, 0, 100]
    running.nmt(0x80)
    assert remap(running, 0x1400, [0x20020120, 0x60600008]) == [0] * 6
    running.start()
    running.put(RPDO1, bytes.fromhex("0000c07f 07"))  # NaN
    running.put(SYNC)
    assert (running.dictionary[0x2002, 1], running.dictionary[0x6060, 0]) == (0, 7)


def test_sdo_writes_reach_the_device_and_can_be_refused(bench: Bench) -> None:
    bench.device.calls.clear()
    assert bench.write(0x6060, 0, 7, 1) == 0
    assert bench.device.calls == [("advance", 0), ("written", 0x6060, 0)]

    def refuse(index: int, sub: int) -> None:
        assert bench.dictionary[index, sub] == 8
        raise Abort(0x08000022)

    bench.device.on_written = refuse
    assert bench.write(0x6060, 0, 8, 1) == 0x08000022
    assert bench.dictionary[0x6060, 0] == 7
    bench.device.on_refresh = lambda: bench.dictionary.__setitem__((0x6064, 0), 42)
    assert bench.sdo("4064600000000000") == "436460002a000000"


def test_an_object_in_two_commands_keeps_its_old_value_when_refused(running: Bench) -> None:
    assert remap(running, 0x1401, [0x60710010]) == [0] * 5

    def refuse(index: int, sub: int) -> None:
        if index == 0x6071:
            raise Abort(0x06090030)

    running.device.on_written = refuse
    running.put(RPDO1, bytes.fromhex("0f00 0500 64000000"))
    running.put(RPDO2, bytes.fromhex("0600"))
    running.put(SYNC)
    assert running.dictionary[0x6071, 0] == 0
    assert running.device.named("written").count(("written", 0x6071, 0)) == 1


def remap(bench: Bench, record: int, entries: list[int], cob_id: int | None = None) -> list[int]:
    """The steps of CiA 301: invalid, none, each entry, their number, valid. The abort code of each."""
    old = int(bench.dictionary[record, 1]) & 0x7FF
    table = record + 0x200
    codes = [bench.write(record, 1, 1 << 31 | old, 4), bench.write(table, 0, 0, 1)]
    codes += [bench.write(table, k, entry, 4) for k, entry in enumerate(entries, 1)]
    return [*codes, bench.write(table, 0, len(entries), 1), bench.write(record, 1, cob_id or old, 4)]


def test_a_pdo_is_rewritten_at_run_time(running: Bench) -> None:
    assert remap(running, 0x1400, [0x60400010, 0x00050008, 0x60C10120], 0x345) == [0] * 7
    assert running.put(RPDO1, bytes(8)) == []
    running.put(0x345, bytes.fromhex("0f00 ff 10270000"))
    running.put(SYNC)
    assert (running.dictionary[0x6040, 0], running.dictionary[0x60C1, 1]) == (15, 10000)
    assert remap(running, 0x1801, [0x60610008, 0x20500008]) == [0] * 6
    assert running.put(SYNC)[1] == (TPDO2, b"\0\0")


@pytest.mark.parametrize(
    ("entries", "codes"),
    [
        ([0x23450010], [0x06020000]),
        ([0x60410110], [0x06020000]),
        ([0x60410010], [0x06040041]),  # an RPDO cannot write it
        ([0x60830020, 0x10170010], [0, 0x06040041]),  # not mappable
        ([0x60400008], [0x06040041]),  # half of it
        ([0x00050010], [0x06040041]),  # a gap of a byte has eight bits
        ([0x60C10120, 0x607A0020, 0x60600008], [0, 0, 0, 0x06040042]),
        ([0x60C10120, 0, 0x60600008], [0, 0, 0, 0x06020000]),
        ([0x60600008] * 8, [0] * 8 + [0]),
    ],
)
def test_a_mapping_that_cannot_be_is_refused(bench: Bench, entries: list[int], codes: list[int]) -> None:
    assert bench.write(0x1400, 1, 0x80000205, 4) == bench.write(0x1600, 0, 0, 1) == 0
    answers = [bench.write(0x1600, k, entry, 4) for k, entry in enumerate(entries, 1)]
    if not any(answers):
        answers.append(bench.write(0x1600, 0, len(entries), 1))
    assert answers == codes
    assert bench.write(0x1600, 0, 9, 1) == 0x06090031
    if any(codes):
        assert bench.dictionary[0x1600, 0] == 0


def test_a_valid_pdo_is_not_rewritten(bench: Bench) -> None:
    for sub, value, size in ((0, 0, 1), (1, 0x60600008, 4)):
        assert bench.write(0x1600, sub, value, size) == 0x06010000
    assert bench.write(0x1800, 3, 10, 2) == bench.write(0x1800, 6, 10, 1) == 0x06010000
    assert bench.write(0x1400, 1, 0x206, 4) == 0x06090030  # another identifier
    assert bench.write(0x1400, 1, 0x40000205, 4) == 0
    bench.write(0x1400, 1, 0x80000205, 4)
    assert bench.write(0x1600, 1, 0x60600008, 4) == 0x06010000  # still three entries
    for cob_id in (0x20000205, 0x801, 0x000, 0x07F, 0x101, 0x180, 0x581, 0x5FF, 0x67F, 0x6E0, 0x701, 0x7FF):
        assert bench.write(0x1400, 1, cob_id, 4) == 0x06090030
    for cob_id in (SYNC, EMCY, RPDO2, TPDO1):
        assert bench.write(0x1400, 1, cob_id, 4) == 0x06040043
    assert bench.write(0x1400, 1, 0x333, 4) == 0


@pytest.mark.parametrize("record", [0x1400, 0x1800])
def test_reserved_transmission_types_are_refused(bench: Bench, record: int) -> None:
    refused = {kind for kind in range(256) if bench.write(record, 2, kind, 1) == 0x06090030}
    assert refused == (set(range(241, 254)) if record == 0x1400 else set(range(241, 252)))


def test_the_librarys_own_remapping_works(bench: Bench) -> None:
    """canopen's RemoteNode writes and reads the PDOs of both directions, and they carry values."""
    loop = Loop(bench)
    remote: Any = loop.join()
    remote.tpdo.read()
    assert [(v.index, v.length) for v in remote.tpdo[1].map] == [(0x6041, 16), (0x6077, 16), (0x6064, 32)]
    for pdo, names in ((remote.rpdo[2], (0x607A, 0x6060)), (remote.tpdo[4], (0x6062, 0x6061, 0x60F4))):
        pdo.read()
        pdo.clear()
        for name in names[:3]:
            pdo.add_variable(name)
        if pdo is remote.tpdo[4]:
            pdo.map.pop()
            pdo.length -= 32
        pdo.trans_type, pdo.enabled = 1, True
        pdo.save()
    again: Any = canopen.RemoteNode(NODE, bench.dictionary.eds(NODE))
    loop.add_node(again)
    again.rpdo.read()
    assert [(v.index, v.length) for v in again.rpdo[2].map] == [(0x607A, 32), (0x6060, 8)]
    loop.nmt.send_command(0x01)
    again.rpdo[2][0].raw, again.rpdo[2][1].raw = -123456, 8
    again.rpdo[2].transmit()
    bench.device.on_refresh = lambda: bench.dictionary.__setitem__((0x6062, 0), -777)
    again.tpdo.read()
    loop.send_message(SYNC, b"")
    assert (bench.dictionary[0x607A, 0], bench.dictionary[0x6060, 0]) == (-123456, 8)
    assert again.tpdo[4][0].raw == -777


@settings(deadline=None)
@given(st.integers(1, 240), st.integers(1, 40))
def test_a_cyclic_tpdo_comes_with_every_nth_sync(n: int, times: int) -> None:
    bench = Bench()
    bench.write(0x1800, 2, n, 1)
    bench.start()
    sent = [any(cob_id == TPDO1 for cob_id, _ in bench.put(SYNC)) for _ in range(n * 2 + times)]
    assert [k for k, was in enumerate(sent, 1) if was] == list(range(n, n * 2 + times + 1, n))


def test_a_cyclic_tpdo_can_start_at_a_counter(bench: Bench) -> None:
    bench.write(0x1019, 0, 6, 1)
    bench.write(0x1800, 1, 0x80000185, 4)
    assert bench.write(0x1800, 6, 4, 1) == 0
    bench.write(0x1800, 2, 3, 1)
    bench.write(0x1800, 1, 0x185, 4)
    bench.start()
    counters = [1 + k % 6 for k in range(20)]
    sent = [any(cob_id == TPDO1 for cob_id, _ in bench.put(SYNC, counter)) for counter in counters]
    assert [k for k, was in enumerate(sent) if was] == [3, 6, 9, 12, 15, 18]


def test_an_acyclic_tpdo_comes_with_the_sync_after_a_change(bench: Bench) -> None:
    bench.write(0x1800, 2, 0, 1)
    bench.start()

    def synced() -> list[bytes]:
        return [data for cob_id, data in bench.put(SYNC) if cob_id == TPDO1]

    assert len(synced()) == 1
    assert synced() == []
    bench.dictionary[0x6064, 0] = 1
    assert bench.run(100 * MS) == []
    assert len(synced()) == 1
    assert synced() == []


def test_remote_frames_fetch_what_was_sampled_or_what_is(bench: Bench) -> None:
    bench.write(0x1800, 2, 252, 1)
    bench.write(0x1801, 2, 253, 1)
    bench.start()

    def ask(cob_id: int) -> list[tuple[int, bytes]]:
        return bench.put(cob_id, is_remote_frame=True)

    assert bench.put(SYNC) == []
    bench.device.on_refresh = lambda: bench.dictionary.values.update({(0x6064, 0): 7, (0x606C, 0): 7})
    assert ask(TPDO1) == [(TPDO1, bytes(8))]
    assert ask(TPDO2) == [(TPDO2, bytes.fromhex("0700000000000000"))]
    bench.device.on_refresh = lambda: bench.dictionary.values.update({(0x6064, 0): 7, (0x606C, 0): 8})
    assert ask(TPDO2) == [(TPDO2, bytes.fromhex("0800000000000000"))]
    bench.put(SYNC)
    assert ask(TPDO1) == [(TPDO1, bytes.fromhex("0000000007000000"))]
    bench.write(0x1801, 1, 0x40000285, 4)
    assert ask(TPDO2) == []
    assert bench.put(TPDO2, bytes(8)) == ask(RPDO1) == []


@pytest.mark.parametrize("kind", [254, 255])
def test_an_event_driven_tpdo(bench: Bench, kind: int) -> None:
    bench.write(0x1800, 1, 0x80000185, 4)
    bench.write(0x1800, 2, kind, 1)
    bench.write(0x1800, 3, 50, 2)  # inhibit 5 ms
    bench.write(0x1800, 5, 40, 2)  # event timer 40 ms
    bench.write(0x1800, 1, 0x185, 4)
    position = {20: 1, 22: 2, 23: 3, 70: 4}
    bench.device.on_refresh = lambda: bench.dictionary.__setitem__(
        (0x6064, 0), max((value for t, value in position.items() if t * MS <= bench.now), default=0)
    )
    bench.nmt(0x01)
    seen = [(t / MS, data[4]) for t, cob_id, data in bench.run(200 * MS) if cob_id == TPDO1]
    # at once; at a change; after the inhibit time with the newest value; by the timer; at a change; by the timer
    assert seen == [(0, 0), (20, 1), (25, 3), (65, 3), (70, 4), (110, 4), (150, 4), (190, 4)]
    bench.nmt(0x80)
    assert bench.run(400 * MS) == []


def test_short_and_long_commands(running: Bench) -> None:
    good, other = bytes.fromhex("0f00000001000000"), bytes.fromhex("010000000000")
    assert running.put(RPDO1, good[:7]) == [emcy(0x8210, 0x11)]
    assert running.put(RPDO1, b"") == []  # told once
    running.put(SYNC)
    assert running.device.named("written") == []
    assert running.put(RPDO2, other[:2]) == []
    assert running.put(RPDO1, good) == []  # the other is still wrong
    assert running.put(RPDO2, other) == [emcy(0, 0)]
    assert running.put(RPDO2, other + b"\1") == [emcy(0x8220, 0x11)]
    running.put(SYNC)
    assert (running.dictionary[0x607A, 0], running.dictionary[0x60FF, 0]) == (1, 1)  # its first bytes count
    assert running.put(RPDO2, other) == [emcy(0, 0)]


def test_a_command_that_is_rewritten_is_no_longer_wrong(running: Bench) -> None:
    assert running.put(RPDO1, 0) == [emcy(0x8210, 0x11)]
    invalid = bytes.fromhex("23001401") + (0x80000000 | RPDO1).to_bytes(4, "little")
    assert emcy(0, 0) in running.put(0x600 + NODE, invalid)


def test_a_command_that_stays_away(running: Bench) -> None:
    running.write(0x1400, 5, 20, 2)
    assert running.run(100 * MS) == []  # it is awaited from the first one on
    running.put(RPDO1, bytes(8))
    begun = running.now
    assert running.run(begun + 15 * MS) == []
    running.put(RPDO1, bytes(8))
    assert running.run(begun + 200 * MS) == [(begun + 35 * MS, *emcy(0x8250, 0x11))]
    assert running.device.named("lost") == [("lost", "rpdo", begun + 35 * MS)]
    assert running.node.state == NmtState.OPERATIONAL
    assert running.put(RPDO1, bytes(8)) == [emcy(0, 0)]
    running.nmt(0x80)
    assert running.run(running.now + 200 * MS) == []


def test_what_was_latched_does_not_outlive_the_operational_state(running: Bench) -> None:
    running.put(RPDO1, bytes.fromhex("0f00000001000000"))
    running.nmt(0x80)
    running.nmt(0x01)
    running.put(SYNC)
    assert running.device.named("written") == []


# What LocalNode of the canopen library fails and no other test here asks.


def test_frames_that_are_not_ours_have_no_effect(running: Bench) -> None:
    read = bytes.fromhex("4000100000000000")
    for flags in ({"is_extended_id": True}, {"is_fd": True, "is_extended_id": False}):
        for cob_id in (0x000, SYNC, RPDO1, 0x600 + NODE, ALIVE):
            running.node.receive(can.Message(arbitration_id=cob_id, data=read, **flags), running.now)
    for cob_id in (0x000, SYNC, RPDO1, 0x600 + NODE):
        running.node.receive(frame(cob_id, is_remote_frame=True, dlc=8), running.now)
    for cob_id in (0x600 + NODE + 1, 0x100, 0x7E5, 0x7FF):
        running.node.receive(frame(cob_id, read), running.now)
    assert running.take() == []
    assert running.device.calls == []
    assert running.node.state == NmtState.OPERATIONAL


def test_pdo_and_sdo_see_the_same_values(running: Bench) -> None:
    running.put(RPDO1, bytes.fromhex("0600 0000 39300000"))
    running.put(SYNC)
    assert running.sdo("407a600000000000") == "437a600039300000"


# Anybody at all.

KNOWN = [0x000, SYNC, EMCY, RPDO1, RPDO2, TPDO1, 0x600 + NODE, ALIVE, 0x701]
FRAMES = st.builds(
    can.Message,
    arbitration_id=st.one_of(st.sampled_from(KNOWN), st.integers(0, 0x7FF)),
    data=st.one_of(
        st.binary(max_size=8),
        st.sampled_from([bytes((command, NODE)) for command in COMMANDS]),
        st.builds(
            lambda command, index, sub, value: bytes((command,)) + index.to_bytes(2, "little") + bytes((sub,)) + value,
            st.sampled_from([0x23, 0x27, 0x2B, 0x2F, 0x40, 0xA4, 0xC6]),
            st.one_of(
                st.sampled_from([0x1005, 0x1014, 0x1016, 0x1017, 0x1019, 0x1400, 0x1600, 0x1800, 0x1A00, 0x6040])
            ),
            st.integers(0, 6),
            st.one_of(
                st.binary(min_size=4, max_size=4),
                st.sampled_from([b"\x85\1\0\x80", b"\x85\1\0\0", b"\5\2\0\x80", b"\0\0\0\0", b"\x10\0\x40\x60"]),
            ),
        ),
    ),
    is_extended_id=st.sampled_from([False, False, False, True]),
    is_remote_frame=st.sampled_from([False, False, False, True]),
    is_error_frame=st.sampled_from([False, False, False, False, True]),
    is_fd=st.sampled_from([False, False, False, True]),
)


@settings(deadline=None, max_examples=150)
@given(st.lists(st.tuples(FRAMES, st.integers(0, 300)), max_size=40), st.sampled_from(["lwa4d", "cia402"]))
def test_no_frame_breaks_a_node(frames: list[tuple[can.Message, int]], profile: str) -> None:
    bench = Bench("lwa4d" if profile == "lwa4d" else "cia402")
    for msg, pause in frames:
        bench.node.receive(msg, bench.now)
        bench.run(bench.now + pause * MS // 10)
        state = bench.node.state
        assert state in (NmtState.STOPPED, NmtState.OPERATIONAL, NmtState.PRE_OPERATIONAL)
        assert {0x000, ALIVE} <= bench.node.cob_ids
        assert all(0 <= cob_id <= 0x7FF for cob_id in bench.node.cob_ids)
    for key, value in bench.dictionary.values.items():
        entry = bench.dictionary.entry(*key)
        assert not entry.bits or entry.within(value)
    # whatever came before, the node still obeys and answers
    assert BOOT_UP in bench.nmt(0x81)
    assert bench.sdo("4000100000000000") == "4300100092010200"
    bench.start()
    assert bench.node.state == NmtState.OPERATIONAL


@settings(deadline=None, max_examples=100)
@given(st.data())
def test_an_exchange_with_frames_changed_on_the_way(data: st.DataObject) -> None:
    """The library reads and writes while frames are lost, cut or changed: it may fail, the node may not."""
    bench = Bench()
    loop = Loop(bench)
    remote = loop.join()
    remote.sdo.RESPONSE_TIMEOUT = 0.0001

    def tamper(cob_id: int, sent: bytes) -> bytes | None:
        what = data.draw(st.sampled_from(["whole"] * 12 + ["lost", "cut", "changed"]))
        if what == "changed" and sent:
            place = data.draw(st.integers(0, len(sent) - 1))
            return sent[:place] + bytes((sent[place] ^ 1 << data.draw(st.integers(0, 7)),)) + sent[place + 1 :]
        return {"lost": None, "cut": sent[: len(sent) // 2]}.get(what, sent)

    loop.tamper = lambda cob_id, sent: tamper(cob_id, sent) if cob_id == 0x600 + NODE else sent
    actions: tuple[Callable[[], Any], ...] = (
        lambda: remote.sdo.download(0x6081, 0, b"\1\0\0\0"),
        lambda: remote.sdo.download(SCRATCH, 0, bytes(40)),
        lambda: remote.sdo.upload(0x1008, 0),
    )
    for action in actions:
        with contextlib.suppress(canopen.SdoCommunicationError, canopen.SdoAbortedError):
            action()
    loop.tamper = lambda cob_id, sent: sent
    bench.run(bench.now + 2000 * MS)
    assert bench.sdo("4000100000000000") == "4300100092010200"
