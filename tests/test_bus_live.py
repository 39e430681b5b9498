"""Both sides on real buses of python-can: frames that are not ours, logs, pacing, and the orderly stop."""

import json
import math
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import can
import canopen
import numpy as np
import pytest

from lwa4d_sim.assembly import Blocks, build_blocks
from lwa4d_sim.bus.build import bus_loop, canopen_run, driving_session, plan_for, served_arm, write_sheets
from lwa4d_sim.bus.connect import Connection, connect, frame_writer, log_to
from lwa4d_sim.bus.frame_files import ORIGIN, messages, replay, write
from lwa4d_sim.bus.live_run import LiveRun, drive_arm, report
from lwa4d_sim.bus.master import Master
from lwa4d_sim.bus.process import stoppable, undisturbed
from lwa4d_sim.bus.serve import monotonic, serve
from lwa4d_sim.bus.session import Session
from lwa4d_sim.bus.simulation import Simulation
from lwa4d_sim.bus.wire import Wire
from lwa4d_sim.errors import BusError
from lwa4d_sim.frame_log import FrameLog
from lwa4d_sim.interfaces import Ns
from lwa4d_sim.scenario import Scenario

MS = 1_000_000  # [ns]
msgpack: Any = import_module("msgpack")  # without types
GROUP = "239.74.163.9"
CLASSIC = (".asc", ".blf", ".csv", ".db", ".log", ".trc")

NODES = (3, 4, 6)  # of the arm below: joints 1, 2 and 4 of the LWA4D
# Slow, since a real cycle of 10 ms is no business of tests on a machine shared with others.
ARM = """
name: live
arm: lwa4d_3dof_printed
initial: {q: [-1.5707963267948966, -1.5707963267948966, 1.5707963267948966]}
plant: {armature: 0.2}
trajectory:
  waypoints: {space: joint, points: [[-1.2, -1.4, 1.3], [-1.57, -1.57, 1.57]]}
  segment_time: 2.0
controller: {kind: computed_torque, space: joint, p: 3, model: {armature: 0.2}}
loop: {kind: canopen, profile: cia402, period: PERIOD, deadline: DEADLINE, heartbeat: 0.5}
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "live.yaml"
    path.write_text(ARM.replace("PERIOD", "0.05").replace("DEADLINE", "0.04"))
    return path


def blocks_of(path: Path, **overrides: Any) -> Blocks:
    scenario = Scenario.load(path, overrides)
    return build_blocks([scenario], next(iter(scenario.variants)), 1)


def frame(can_id: int, data: bytes = b"", **options: Any) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, **{"is_extended_id": False, **options})


def contents(msg: can.Message) -> tuple[int, bool, bool, bytes]:
    return msg.arbitration_id, msg.is_extended_id, msg.is_remote_frame, bytes(msg.data)


@contextmanager
def virtual(count: int = 2) -> Iterator[list[Connection]]:
    channel = f"test {time.monotonic_ns()}"
    ends = [connect("virtual", channel) for _ in range(count)]
    try:
        yield ends
    finally:
        for end in ends:
            end.shutdown()


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("", 0))
        return int(sock.getsockname()[1])


@pytest.fixture
def channel() -> str:
    """Of udp_multicast, nobody else's."""
    name = f"{GROUP}:{free_port()}"
    try:
        bus = connect("udp_multicast", name)
    except BusError as error:
        pytest.skip(str(error))
    bus.shutdown()
    return name


@contextmanager
def multicast(channel: str, count: int = 2) -> Iterator[list[Connection]]:
    ends = [connect("udp_multicast", channel) for _ in range(count)]
    try:
        yield ends
    finally:
        for end in ends:
            end.shutdown()


def received(bus: Connection, timeout: float = 1.0) -> list[can.Message]:
    """All frames until none comes for a while."""
    frames = []
    while (msg := bus.recv(timeout)) is not None:
        frames.append(msg)
        timeout = 0.05
    return frames


# A connection


def test_no_own_frame_comes_back_and_every_frame_of_others_does(channel: str) -> None:
    with multicast(channel) as (one, other):
        mine = [frame(0x203, bytes([k % 5])) for k in range(40)]
        theirs = [frame(0x183, bytes([k % 3])) for k in range(40)]
        for a, b in zip(mine, theirs, strict=True):
            one.send(a)
            other.send(b)
        assert [contents(msg) for msg in received(one)] == [contents(msg) for msg in theirs]
        assert [contents(msg) for msg in received(other)] == [contents(msg) for msg in mine]


def test_a_frame_equal_to_an_own_one_is_seen_once_its_echo_has_passed(channel: str) -> None:
    with multicast(channel) as (one, other):
        one.send(frame(0x080))
        assert received(one, 0.2) == []
        other.send(frame(0x080))
        assert len(received(one)) == 1


class _Silent(can.BusABC):
    """A bus on which everything is lost."""

    def __init__(self) -> None:
        super().__init__(channel="silent")
        self.inbox: list[can.Message] = []

    def send(self, msg: can.Message, timeout: float | None = None) -> None: ...

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return (self.inbox.pop(0) if self.inbox else None), False


def test_lost_echoes_do_not_pile_up_nor_hide_what_comes_later() -> None:
    bus = _Silent()
    connection = Connection(bus, echoes=True)
    for k in range(10_000):
        connection.send(frame(0x200, k.to_bytes(4, "little")))
    bus.inbox = [frame(0x200, (0).to_bytes(4, "little")), frame(0x200, (9_999).to_bytes(4, "little"))]
    # the first is long forgotten, so it is somebody else's; the last is the echo of the newest
    assert [contents(msg)[3] for msg in received(connection, 0)] == [(0).to_bytes(4, "little")]
    assert len(connection._sent) == 0 == len(connection._pending)
    connection.shutdown()


HOSTILE = [
    b"",
    b"\xff" * 200,
    b"no msgpack",
    msgpack.packb(7),
    msgpack.packb([1, 2, 3]),
    msgpack.packb({"arbitration_id": "one"}),
    msgpack.packb({"arbitration_id": -1, "data": b""}),
    msgpack.packb({"arbitration_id": math.nan, "data": b"", "dlc": 0, "is_extended_id": False}),
    msgpack.packb({"arbitration_id": 0x183, "data": b"123456789", "dlc": 9, "is_extended_id": False}),
    msgpack.packb({"arbitration_id": 0x183, "data": b"12", "dlc": 5, "is_extended_id": False}),
    msgpack.packb({"arbitration_id": 0x183, "data": bytes(64), "dlc": 64, "is_fd": True, "is_extended_id": False}),
    msgpack.packb({"arbitration_id": 0x183, "surprise": 1}),
    msgpack.packb({"arbitration_id": 0x183, "data": b"12", "dlc": 2, "is_extended_id": [], "timestamp": 0.0}),
    msgpack.packb({"arbitration_id": 0x183, "data": b"", "dlc": 1e9, "is_remote_frame": True, "is_extended_id": False}),
    msgpack.packb({"arbitration_id": 0x183, "data": b"", "dlc": 0, "is_remote_frame": {}, "is_extended_id": False}),
    msgpack.packb({"arbitration_id": 1 << 40, "data": b"", "is_extended_id": True}),
]


def test_hostile_datagrams_are_counted_and_passed_over(channel: str) -> None:
    group, _, port = channel.partition(":")
    with multicast(channel) as (one, other), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for payload in HOSTILE:
            sock.sendto(payload, (group, int(port)))
        other.send(frame(0x183, b"good"))
        assert [contents(msg)[3] for msg in received(one)] == [b"good"]
        one.send(frame(0x203, b"12"))  # with an echo awaited, every frame is compared with it
        for payload in HOSTILE:
            sock.sendto(payload, (group, int(port)))
        assert received(one) == []
        # python-can itself drops the FD frame
        assert one.unreadable >= len(HOSTILE) - 1
        assert one.recv(0) is None


def test_a_flood_of_rubbish_does_not_keep_recv_for_ever() -> None:
    class Flood(_Silent):
        def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
            raise can.CanOperationError("could not unpack") from ValueError("rubbish")

    connection = Connection(Flood(), echoes=True)
    assert connection.recv(5.0) is None
    assert connection.unreadable > 100
    connection.shutdown()


def test_a_bus_that_is_down_is_no_rubbish() -> None:
    class Down(_Silent):
        def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
            raise can.CanOperationError("network is down") from OSError(100, "Network is down")

    connection = Connection(Down(), echoes=True)
    with pytest.raises(can.CanOperationError):
        connection.recv(0)
    connection.shutdown()


# Logs

FRAMES = [
    frame(0x000, b"\x01\x00"),
    frame(0x080),
    frame(0x183, bytes(range(8))),
    frame(0x703, is_remote_frame=True, dlc=1),
    frame(0x18FF1234, b"\xaa\x55", is_extended_id=True),
]


@pytest.mark.parametrize("suffix", CLASSIC)
def test_every_format_holds_both_directions(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"frames{suffix}"
    # python-can does not write remote frames to .trc
    given = [msg for msg in FRAMES if not (suffix == ".trc" and msg.is_remote_frame)]
    before = time.time()
    with virtual() as (one, other):
        log_to(one, path)
        for k, msg in enumerate(given):
            (one if k % 2 else other).send(msg)
            received(one, 0.2)
    with can.LogReader(path) as reader:
        found = list(reader)
    assert [contents(msg) for msg in found] == [contents(msg) for msg in given]
    times = [msg.timestamp for msg in found]
    assert times == sorted(times)
    if suffix in (".log", ".csv", ".db"):  # the others store times since their first frame, or to the millisecond
        assert before - 0.01 <= times[0] <= times[-1] <= time.time() + 0.01


@pytest.mark.parametrize("name", ["frames.xyz", "frames", "no/such/folder/frames.log", "no/such/folder/frames.asc"])
def test_a_log_that_cannot_be_is_one_line(name: str, tmp_path: Path) -> None:
    with pytest.raises(BusError, match="cannot log frames"):
        frame_writer(tmp_path / name)


def test_a_log_that_breaks_is_given_up_and_the_bus_goes_on() -> None:
    class Full(can.Listener):
        def on_message_received(self, msg: can.Message) -> None:
            raise OSError(28, "No space left on device")

    with virtual() as (one, other):
        one.loggers.append(Full())
        one.send(frame(0x080))
        assert one.loggers == []
        assert one.log_error is not None
        assert "space" in one.log_error
        assert len(received(other)) == 1


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Blocks, np.ndarray, FrameLog]:
    """60 cycles on the simulated wire: blocks, positions (cycle, joint) at the SYNCs, frames."""
    path = tmp_path_factory.mktemp("run") / "live.yaml"
    path.write_text(ARM.replace("PERIOD", "0.01").replace("DEADLINE", "0.005"))
    blocks = blocks_of(path)
    simulation, ticks = canopen_run(blocks)
    positions = [blocks.plant.q[0].copy()]
    for _, tick in zip(range(60), ticks, strict=False):
        positions.append(tick.q[0, -1].copy())
    return blocks, np.array(positions), FrameLog.of(simulation.wire.frames)


def test_a_log_of_the_simulated_wire_decodes_with_the_exported_sheets(
    run: tuple[Blocks, np.ndarray, FrameLog], tmp_path: Path
) -> None:
    blocks, positions, frames = run
    write(frames, tmp_path / "run.log")
    nodes: dict[int, Any] = {}
    for number, sheet in zip(NODES, write_sheets(blocks, tmp_path), strict=True):
        node: Any = canopen.RemoteNode(number, str(sheet))
        canopen.Network().add_node(node)
        node.tpdo.read(from_od=True)
        nodes[0x180 + number] = node.tpdo[1]
    syncs: list[float] = []
    decoded: dict[int, list[float]] = {cob_id: [] for cob_id in nodes}
    for line in (tmp_path / "run.log").read_text().splitlines():
        stamp, cob_id, data = re.fullmatch(r"\((\d+\.\d{6})\) vcan0 (\w{3})#(\w*)", line).groups()  # type: ignore[union-attr]
        if float(stamp) < ORIGIN:
            continue
        if cob_id == "080":
            syncs.append(float(stamp) - ORIGIN)
        elif int(cob_id, 16) in nodes:
            pdo = nodes[int(cob_id, 16)]
            pdo.on_message(int(cob_id, 16), bytearray.fromhex(data), float(stamp))
            decoded[int(cob_id, 16)].append(math.radians(pdo["position actual value"].raw / 1000))
    np.testing.assert_allclose(syncs[:60], np.arange(60) * 0.01, atol=0.0003)
    found = np.array([values[:60] for values in decoded.values()]).T
    half = math.radians(0.0005)  # half a millidegree
    assert np.abs(found - positions[:60]).max() < 1.001 * half
    assert np.ptp(positions[:60], axis=0).max() > 100 * half  # or it would prove nothing


def test_all_formats_of_the_simulated_wire_hold_the_same(
    run: tuple[Blocks, np.ndarray, FrameLog], tmp_path: Path
) -> None:
    _, _, frames = run
    expected = [contents(msg) for msg in messages(frames)]
    for suffix in CLASSIC:
        write(frames, tmp_path / f"run{suffix}")
        with can.LogReader(tmp_path / f"run{suffix}") as reader:
            assert [contents(msg) for msg in reader] == expected, suffix


def test_replay_keeps_order_and_spacing_and_leaves_commands_out_unless_asked(tmp_path: Path) -> None:
    path = tmp_path / "frames.log"
    writer = frame_writer(path)
    given = [(0x000, b"\x01\x00"), (0x080, b""), (0x183, b"1"), (0x203, b"2"), (0x603, bytes(8)), (0x583, bytes(8))]
    for k, (can_id, data) in enumerate(given):
        writer(frame(can_id, data, timestamp=5.0 + 0.05 * k))
    writer.stop()
    harmless = [(0x183, b"1"), (0x583, bytes(8))]
    for commands, expected in ((True, given), (False, harmless)):
        with virtual() as (one, other):
            begin = time.monotonic()
            assert replay(path, one, bool, commands=commands) == (len(expected), len(given) - len(expected))
            assert time.monotonic() - begin > 0.24
            assert [contents(msg)[::3] for msg in received(other, 0.1)] == expected


@pytest.mark.parametrize("text", [None, "nonsense\n", "(1.0) vcan0 zzz#00\n", "(1.0) vcan0\n"])
def test_replay_of_what_is_no_log_is_one_line(text: str | None, tmp_path: Path) -> None:
    path = tmp_path / "frames.log"
    if text is not None:
        path.write_text(text)
    with virtual(1) as (one,), pytest.raises(BusError, match="cannot read frames"):
        replay(path, one, bool, commands=True)


@pytest.mark.parametrize("later", ["1000000.1", "1e300"])
def test_replay_ends_when_asked_also_in_a_long_silence(later: str, tmp_path: Path) -> None:
    path = tmp_path / "frames.log"
    path.write_text(f"(0.0) vcan0 555#11\n({later}) vcan0 556#01\n")
    begin = time.monotonic()
    with virtual() as (one, other):
        assert replay(path, one, lambda: time.monotonic() - begin > 0.3, commands=True) == (1, 0)
        assert len(received(other, 0.1)) == 1
    assert 0.3 < time.monotonic() - begin < 2


def test_replay_sends_at_once_what_goes_back_in_time_and_nothing_too_long(tmp_path: Path) -> None:
    path = tmp_path / "frames.log"
    lines = ["(5.0) x 123#11", "(1.0) x 124#22", "(nan) x 125#", "(1.0) x 126#112233445566778899", "(1.1) x 127#"]
    path.write_text("\n".join(lines))
    with virtual() as (one, other):
        assert replay(path, one, bool, commands=True) == (4, 0)
        assert [msg.arbitration_id for msg in received(other, 0.1)] == [0x123, 0x124, 0x125, 0x127]


# The controller side in virtual time


class Rig:
    """A live run over the simulated wire, whose clock is the wire's."""

    def __init__(self, path: Path, control: Callable[[Any, Wire], Any] = lambda control, wire: control) -> None:
        self.blocks = blocks_of(path)
        loop = bus_loop(self.blocks.settings)
        self.wire = Wire(500_000, record=True)
        plan = plan_for(self.blocks, loop)
        self.simulation = Simulation(self.wire, self.blocks.plant, plan.joints, loop.profile, None)
        self.master = Master(self.wire.port("master"), lambda: self.wire.now, plan)
        _, estimator = loop.velocity.build(self.blocks.q0, loop.period, 0.001)
        made = control(self.blocks.control(estimator), self.wire)
        self.session = Session(self.master, made, with_speed=True)
        self.live = LiveRun(self.blocks, self.master, self.session)
        self.live.set_up(loop.profile)
        self.begin = self.wire.now

    def words(self, first_byte: int) -> set[int]:
        """Nodes that were sent a controlword since the set-up."""
        return {
            each.can_id - 0x200
            for each in self.wire.frames
            if 0x200 < each.can_id < 0x280 and each.data[0] == first_byte and each.started > self.begin
        }

    def syncs(self) -> list[Ns]:
        return [each.queued for each in self.wire.frames if each.can_id == 0x080 and each.queued > self.begin]

    def has_stopped_in_order(self) -> bool:
        stopped = all(drive.braked for drive in self.simulation.arm.drives)
        return stopped and self.words(0x02) == set(NODES) == self.words(0x00)


@pytest.fixture
def fast(tmp_path: Path) -> Path:
    path = tmp_path / "fast.yaml"
    path.write_text(ARM.replace("PERIOD", "0.01").replace("DEADLINE", "0.005"))
    return path


class Meddling:
    """A controller side that does something in one of its cycles."""

    def __init__(self, control: Any, k: int, what: Callable[[], None]) -> None:
        self._control, self._k, self._what = control, k, what

    def tick(self, arrived: Any, now: Ns, k: int, start: Any) -> Any:
        if k == self._k:
            self._what()
        return self._control.tick(arrived, now, k, start)


def test_a_run_to_the_end_stops_in_order(fast: Path) -> None:
    rig = Rig(fast)
    assert rig.live.run(50, bool) == "done"
    assert rig.has_stopped_in_order()
    found = rig.live.summary()
    assert (found["cycles"], found["missed"]) == (50, 0)
    assert max(found["joint_error"]) < 0.01
    assert "50 cycles, 0 missed" in report({**found, "ended": "done"})


def test_asked_to_stop_it_stops_in_order_within_a_cycle(fast: Path) -> None:
    rig = Rig(fast)
    asked = iter([False] * 19 + [True])
    assert rig.live.run(50, lambda: next(asked)) == "interrupted"
    assert rig.live.summary()["cycles"] == 20
    assert rig.has_stopped_in_order()


def test_an_exception_in_the_controller_stops_in_order_and_goes_on_up(fast: Path) -> None:
    def fail() -> None:
        raise ZeroDivisionError

    rig = Rig(fast, lambda control, wire: Meddling(control, 20, fail))
    with pytest.raises(ZeroDivisionError):
        rig.live.run(50, bool)
    assert rig.has_stopped_in_order()


@pytest.mark.parametrize(("ms", "missed"), [(3, 0), (12, 1), (25, 2), (34, 3)])
def test_a_cycle_that_takes_too_long_costs_its_slots_and_no_burst_follows(fast: Path, ms: int, missed: int) -> None:
    rig = Rig(fast, lambda control, wire: Meddling(control, 20, lambda: wire.run_until(Ns(wire.now + ms * MS))))
    assert rig.live.run(50, bool) == "done"
    assert rig.session.late == missed
    assert rig.live.summary()["cycles"] == 50 - missed
    syncs = np.array(rig.syncs()[: 50 - missed])
    slots, off = np.divmod(syncs - syncs[0], 10 * MS)
    assert not off.any()  # each on the grid
    assert slots.tolist() == [*range(21), *range(21 + missed, 50)]


@pytest.mark.parametrize(("ms", "missed"), [(3, 0), (12, 2), (25, 3)])
def test_a_process_that_sleeps_too_long_goes_on_at_the_next_slot(fast: Path, ms: int, missed: int) -> None:
    rig = Rig(fast)
    calls = iter(range(50))

    def oversleep() -> None:
        if next(calls) == 19:
            rig.wire.run_until(Ns(rig.wire.now + ms * MS))

    assert rig.live.run(50, oversleep) == "done"
    assert rig.session.late == missed
    syncs = np.array(rig.syncs()[: 50 - missed])
    slots, off = np.divmod(syncs - syncs[0], 10 * MS)
    assert np.flatnonzero(off).tolist() == ([20] if ms < 10 else [])  # somewhat late is late, and no slot lost
    assert slots.tolist() == [*range(20), *range(20 + missed, 50)]


def test_an_overrun_in_the_last_cycle_is_no_missed_cycle_of_the_future(fast: Path) -> None:
    rig = Rig(fast, lambda control, wire: Meddling(control, 29, lambda: wire.run_until(Ns(wire.now + 45 * MS))))
    assert rig.live.run(30, bool) == "done"
    assert (rig.session.late, rig.live.summary()["cycles"]) == (0, 30)


def test_the_record_counts_time_from_the_first_cycle(fast: Path) -> None:
    rig = Rig(fast)
    rig.live.run(10, bool)
    record = rig.live.record()
    assert record.ticks.t.tolist() == pytest.approx(np.arange(10) * 0.01)
    assert all(abs(t) < 1.0 for t, _ in record.events)


def test_a_drive_that_refuses_leaves_the_others_without_set_points(fast: Path) -> None:
    with pytest.raises(BusError, match="node 4"):
        _refused(fast)


def _refused(path: Path) -> None:
    loop = bus_loop(blocks_of(path).settings)
    blocks = blocks_of(path)
    wire = Wire(500_000, record=True)
    plan = plan_for(blocks, loop)
    simulation = Simulation(wire, blocks.plant, plan.joints, loop.profile, None)
    wire.run_until(Ns(100 * MS))
    simulation.arm.nodes[1].dictionary[0x6502, 0] = 0x43  # without torque mode
    master = Master(wire.port("master"), lambda: wire.now, plan)
    live = LiveRun(blocks, master, Session(master, blocks.control(None), with_speed=True))  # type: ignore[arg-type]
    try:
        live.set_up(loop.profile)
    finally:
        wire.run_until(Ns(wire.now + 10 * MS))
        assert all(drive.braked for drive in simulation.arm.drives)
        assert [int(node.state) for node in simulation.arm.nodes] == [127, 127, 127]
        assert [bytes(each.data) for each in wire.frames[-3:]] == [bytes((0x80, node)) for node in NODES]


# The process


def test_signals_become_a_flag_and_nothing_else() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    for number in (signal.SIGINT, signal.SIGTERM):
        with stoppable() as stop:
            assert not stop()
            os.kill(os.getpid(), number)
            os.kill(os.getpid(), number)
            assert stop()
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


def test_no_garbage_is_collected_meanwhile() -> None:
    import gc

    assert gc.isenabled()
    with undisturbed():
        assert not gc.isenabled()
        assert gc.get_freeze_count() > 0
    assert gc.isenabled()
    assert gc.get_freeze_count() == 0


# Both sides


@contextmanager
def serving(blocks: Blocks, bus: Connection, *, per_sync: bool = False) -> Iterator[Any]:
    """The arm served in a thread."""
    arm = served_arm(blocks, bus, epoch=monotonic(), per_sync=per_sync)
    over = threading.Event()
    thread = threading.Thread(target=serve, args=(arm, bus, monotonic, over.is_set))
    thread.start()
    try:
        yield arm
    finally:
        over.set()
        thread.join(5.0)
        assert not thread.is_alive()


@pytest.mark.parametrize("per_sync", [False, True])
def test_serve_and_drive_meet_on_a_virtual_bus(file: Path, per_sync: bool) -> None:
    with virtual() as (arm_end, controller_end), serving(blocks_of(file), arm_end, per_sync=per_sync) as arm:
        live, found = drive_arm(blocks_of(file), controller_end, bool, seconds=1.5, realtime=False)
    assert found["ended"] == "done", found
    assert found["cycles"] + found["missed"] == 30
    assert max(found["joint_error"]) < 0.05
    moved = np.abs(live.record().q[-1] - live.record().q[0])
    assert moved.min() > 0.01
    assert all(drive.braked for drive in arm.drives)


def test_a_crashed_controller_leaves_closed_brakes(file: Path) -> None:
    """No orderly stop: the drives notice the silence (heartbeat) by themselves."""
    with virtual() as (arm_end, controller_end), serving(blocks_of(file), arm_end) as arm:
        blocks = blocks_of(file, **{"loop.heartbeat": 0.1})
        master, session = driving_session(blocks, controller_end, monotonic)
        LiveRun(blocks, master, session).set_up("cia402")
        for cycle in session.cycles(Ns(monotonic() + 20 * MS), 20):
            assert session.fault is None, (cycle.k, session.fault)
        assert not any(drive.braked for drive in arm.drives)
        time.sleep(1.5)
        assert all(drive.braked for drive in arm.drives)


CLI = [sys.executable, "-m", "lwa4d_sim", "bus"]


@contextmanager
def serve_process(file: Path, channel: str, log: Path) -> Iterator[subprocess.Popen[str]]:
    command = [*CLI, "serve", str(file), "-i", "udp_multicast", "-c", channel, "--log", str(log)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        assert "nodes 3, 4, 6" in process.stdout.readline()
        try:
            yield process
        finally:
            process.send_signal(signal.SIGTERM)


def test_interrupted_between_two_processes_it_stops_in_order(file: Path, channel: str, tmp_path: Path) -> None:
    log = tmp_path / "serve.log"
    command = [*CLI, "drive", str(file), "-i", "udp_multicast", "-c", channel, "--arm", "--json"]
    command += ["--set", "trajectory.segment_time=20"]
    with serve_process(file, channel, log) as arm:
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as driver:
            deadline = time.monotonic() + 30
            while "203#0F00" not in log.read_text():  # its buffer is full and written from time to time
                assert time.monotonic() < deadline
                assert driver.poll() is None, driver.communicate()
                time.sleep(0.1)
            driver.send_signal(signal.SIGINT)
            driver.send_signal(signal.SIGINT)
            out, err = driver.communicate(timeout=20)
        assert (driver.returncode, err) == (2, "")
        found = json.loads(out)
        assert found["ended"] == "interrupted"
        arm.send_signal(signal.SIGTERM)
        told, _ = arm.communicate(timeout=20)
        assert told.strip() == "ended; brakes closed: 3 of 3"
    frames = [(int(can_id, 16), data) for can_id, data in re.findall(r" (\w{3})#(\w*)$", log.read_text(), re.MULTILINE)]
    for node in NODES:
        words = [data[:4] for can_id, data in frames if can_id == 0x200 + node]
        order = [word for k, word in enumerate(words) if k == 0 or words[k - 1] != word]
        assert order[-3:] == ["0F00", "0200", "0000"]  # enabled, quick stop, no voltage
        status = [int(data[2:4] + data[:2], 16) for can_id, data in frames if can_id == 0x180 + node]
        assert status[-1] & 0x4F == 0x40  # switch on disabled
        assert (0x000, f"80{node:02X}") in frames[-20:]  # NMT: pre-operational


def test_one_line_and_code_2_where_nobody_answers(file: Path, channel: str) -> None:
    command = [*CLI, "drive", str(file), "-i", "udp_multicast", "-c", channel, "--arm"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stdout == ""
    assert re.fullmatch(r"lwa4d-sim: node 3: .*no answer\n", done.stderr), done.stderr
