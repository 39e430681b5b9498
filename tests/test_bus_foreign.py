"""Foreign hands on the bus: the canopen library's master moves our arm, and our master starts durand's slaves."""

import math
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import can
import canopen
import durand
import numpy as np
import pytest
from canopen.profiles.p402 import BaseNode402
from canopen.sdo.exceptions import SdoAbortedError
from durand.datatypes import DatatypeEnum as Type
from durand.network import NetworkABC
from durand.object_dictionary import ObjectDictionary
from durand.scheduler import SyncScheduler, VirtualScheduler, get_scheduler, set_scheduler
from durand.services.nmt import StateEnum

from lwa4d_sim.assembly import Blocks, build_blocks
from lwa4d_sim.bus.build import served_arm
from lwa4d_sim.bus.commission import commission
from lwa4d_sim.bus.connect import connect
from lwa4d_sim.bus.dictionary import Joint, drive_dictionary
from lwa4d_sim.bus.joints import joints_for
from lwa4d_sim.bus.master import Master, Plan
from lwa4d_sim.bus.serve import monotonic, serve
from lwa4d_sim.bus.session import Session
from lwa4d_sim.bus.stations import opening
from lwa4d_sim.bus.wire import Wire
from lwa4d_sim.dynamics import Dynamics
from lwa4d_sim.errors import BusError
from lwa4d_sim.interfaces import Array, Arrived, JointState, Ns
from lwa4d_sim.mjcf import joint_facts
from lwa4d_sim.scenario import Scenario

# The library has types for a part of itself only.
library: Any = canopen
Drive402: Any = BaseNode402

NODES = tuple(range(3, 10))
GROUP = "239.74.163.9"
MASTER = 127
PATIENCE = 10.0  # [s] for what takes milliseconds on an idle machine
MS = 1_000_000  # [ns]
MDEG = 180_000 / math.pi

# The drives' own position loops want an arm with rotor inertia. The true speed, so that 606C has no filter's delay.
SERVED = """
name: served
arm: lwa4d_7dof
initial: {q: [-1.57, 0.2, 0, 1.2, 0, -0.3, 0]}
plant: {armature: lwa4d}
trajectory: {waypoints: {space: joint, points: [[-1.5, 0.2, 0, 1.2, 0, -0.3, 0]]}, segment_time: 10}
controller: {kind: pd_gravity, kp: 10, kd: 5}
loop: {kind: canopen, profile: cia402, velocity: {kind: true}}
"""


def blocks_of(file: Path) -> Blocks:
    return build_blocks([Scenario.load(file, {})], "default", 1)


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("served") / "served.yaml"
    path.write_text(SERVED)
    return path


def free_port() -> int:
    """One that no other run on this machine uses: who has the port hears every group."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


class Foreign:
    """The canopen library's network with its threads, and its drives by the sheets that ours export."""

    def __init__(self, scenario: Path, folder: Path, **options: Any) -> None:
        blocks = blocks_of(scenario)
        self.network: Any = library.Network()
        self.network.connect(**options)
        self.blocks = blocks
        self.nodes: dict[int, Any] = {}
        joints = joints_for(blocks.settings.arm, joint_facts(blocks.model))
        for node, joint in zip(NODES, joints, strict=True):
            sheet = folder / f"{node}.eds"
            drive_dictionary("cia402", node, joint).export_eds(sheet, node)
            drive = self.nodes[node] = self.network.add_node(Drive402(node, str(sheet)))
            drive.TIMEOUT_SWITCH_STATE_SINGLE = drive.TIMEOUT_SWITCH_STATE_FINAL = drive.TIMEOUT_SWITCH_OP_MODE = (
                PATIENCE
            )
            drive.TIMEOUT_CHECK_TPDO = drive.sdo.RESPONSE_TIMEOUT = PATIENCE

    def fresh(self) -> None:
        """All nodes as after power-on; the library's drives forget what they knew."""
        self.network.sync.stop()
        self.network.nmt.send_command(0x81)
        for node in self.nodes.values():
            node.nmt.send_command(0x80)
            node.tpdo_values.clear()
            node.tpdo_pointers.clear()
            node.rpdo_pointers.clear()
            node.emcy.reset()

    def commission(self, mode: str, receive: list[tuple[int, int]], nodes: Sequence[int] = NODES) -> None:
        """As the library's users do: read the PDOs, change them, write them back, start, mode, enable."""
        self.fresh()
        for node in (self.nodes[each] for each in nodes):
            node.setup_402_state_machine()
            remap(node.rpdo[1], [(0x6040, 0)], 255)
            remap(node.rpdo[2], receive, 255)
            remap(node.tpdo[1], [(0x6041, 0), (0x6061, 0), (0x6064, 0)], 1)
            remap(node.tpdo[2], [(0x606C, 0), (0x6077, 0)], 1)
            for known in (node.tpdo_values, node.tpdo_pointers, node.rpdo_pointers):
                known.clear()
            node.setup_pdos(upload=False)
            for pdo in node.rpdo.values():
                # udp_multicast hands back what was sent; the library would take the echo for a periodic PDO
                if pdo.cob_id in self.network.subscribers:
                    self.network.unsubscribe(pdo.cob_id)
            node.nmt.state = "OPERATIONAL"
        self.network.sync.start(0.02)
        for node in (self.nodes[each] for each in nodes):
            node.op_mode = mode
            assert node.op_mode == mode
            node.state = "OPERATION ENABLED"

    def position(self, node: int) -> int:
        """As read on request [mdeg]."""
        return int(self.nodes[node].sdo[0x6064].raw)

    def close(self) -> None:
        self.network.sync.stop()  # which the drives notice, and stop
        for node in self.nodes.values():
            until(lambda: node.sdo[0x6041].raw & 0x6F not in (0x27, 0x07), "a drive goes on without SYNC")  # noqa: B023
        self.network.disconnect()


def remap(pdo: Any, objects: list[tuple[int, int]], kind: int) -> None:
    pdo.clear()
    for index, sub in objects:
        pdo.add_variable(index, sub)
    pdo.trans_type, pdo.enabled = kind, True
    pdo.save()


def until(condition: Callable[[], bool], what: str) -> None:
    """Give up long after any machine should have got there; no deadline of the bus."""
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.01)


def in_a_thread(scenario: Path) -> Iterator[dict[str, Any]]:
    options = {"interface": "virtual", "channel": f"foreign {os.getpid()} {random.getrandbits(64)}"}
    bus = connect(options["interface"], options["channel"])
    arm = served_arm(blocks_of(scenario), bus, epoch=monotonic(), per_sync=False)
    over = threading.Event()
    thread = threading.Thread(target=serve, args=(arm, bus, monotonic, over.is_set), daemon=True)
    thread.start()
    yield options
    over.set()
    thread.join()
    bus.shutdown()


def in_a_process(scenario: Path) -> Iterator[dict[str, Any]]:
    port = free_port()
    options = {"interface": "udp_multicast", "channel": GROUP, "port": port, "hop_limit": 0}
    try:
        can.Bus(**options).shutdown()  # type: ignore[arg-type]
    except (OSError, can.CanError) as error:
        pytest.skip(f"no multicast here: {error}")
    command = [sys.executable, "-m", "lwa4d_sim", "bus", "serve", str(scenario), "-i", "udp_multicast"]
    root = Path(__file__).parent.parent
    process = subprocess.Popen([*command, "-c", f"{GROUP}:{port}"], cwd=root, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert "nodes 3, 4, 5, 6, 7, 8, 9" in process.stdout.readline()
    yield options
    process.send_signal(signal.SIGINT)
    assert process.communicate(timeout=20)[0] == "ended; brakes closed: 7 of 7\n"
    assert process.returncode == 0


@pytest.fixture(scope="module", params=["virtual", "udp_multicast"])
def foreign(
    request: pytest.FixtureRequest, scenario: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Foreign]:
    """A foreign master and the served arm, in a thread of this process or in another process."""
    serving = in_a_thread(scenario) if request.param == "virtual" else in_a_process(scenario)
    options = next(serving)
    master = Foreign(scenario, tmp_path_factory.mktemp("sheets"), **options)
    yield master
    master.close()
    assert next(serving, None) is None


def test_a_scan_finds_seven_drives_that_are_what_their_sheets_say(foreign: Foreign) -> None:
    foreign.fresh()
    foreign.network.scanner.reset()
    foreign.network.scanner.search(20)
    until(lambda: len(foreign.network.scanner.nodes) >= len(NODES), "not all nodes answer")
    assert sorted(foreign.network.scanner.nodes) == list(NODES)
    for node, drive in foreign.nodes.items():
        assert drive.sdo[0x1000].raw == 0x20192
        assert drive.sdo[0x1008].raw == f"joint{node - 2}"
        assert drive.sdo[0x1018][4].raw == node
        assert drive.sdo[0x607D][1].raw == drive.object_dictionary[0x607D][1].default


def test_block_transfer_both_ways(foreign: Foreign) -> None:
    drive = foreign.nodes[5]
    sent = random.Random(3).randbytes(5000)
    with drive.sdo[0x2F00].open("wb", size=len(sent), block_transfer=True) as file:
        file.write(sent)
    with drive.sdo[0x2F00].open("rb", block_transfer=True) as file:
        assert file.read() == sent
    assert drive.sdo.upload(0x2F00, 0) == sent  # the other road: segments


def test_remapping_takes_effect_and_is_refused_with_a_reason(foreign: Foreign) -> None:
    foreign.fresh()
    drive = foreign.nodes[8]
    drive.tpdo.read()
    remap(drive.tpdo[3], [(0x6064, 0)], 1)
    drive.nmt.state = "OPERATIONAL"
    came = threading.Event()
    drive.tpdo[3].add_callback(lambda pdo: came.set())
    foreign.network.sync.transmit()
    assert came.wait(20)
    assert drive.tpdo[3].data == foreign.position(8).to_bytes(4, "little", signed=True)
    drive.tpdo[3].callbacks.clear()

    def refusal(index: int, sub: int, value: int, size: int) -> int:
        with pytest.raises(SdoAbortedError) as error:
            drive.sdo.download(index, sub, value.to_bytes(size, "little"))
        return int(error.value.code)

    assert refusal(0x1A02, 0, 2, 1) == 0x06010000  # the PDO is valid
    drive.sdo[0x1802][1].raw = 1 << 31 | 0x388
    drive.sdo[0x1A02][0].raw = 0
    assert refusal(0x1A02, 1, 0x71230020, 4) == 0x06020000  # no such object
    assert refusal(0x1A02, 1, 0x65020020, 4) == 0x06040041  # not mappable


def test_profile_position(foreign: Foreign) -> None:
    foreign.commission("PROFILED POSITION", [(0x607A, 0), (0x6081, 0)])
    start = {node: foreign.position(node) for node in NODES}
    goal = {node: start[node] + (4000 if node % 2 else -4000) for node in NODES}
    for node, drive in foreign.nodes.items():
        drive.rpdo[2]["target position"].raw = goal[node]
        drive.rpdo[2]["profile velocity"].raw = 10_000
        drive.rpdo[2].transmit()
        drive.controlword = 0x1F
    for node, drive in foreign.nodes.items():
        until(lambda: drive.statusword & 0x1000 != 0, f"node {node} does not acknowledge")  # noqa: B023
        until(lambda: drive.statusword & 0x400 != 0, f"node {node} does not reach its target")  # noqa: B023
        assert abs(foreign.position(node) - goal[node]) <= drive.sdo[0x6067].raw
        assert drive.state == "OPERATION ENABLED"
        assert drive.sdo[0x1003][0].raw == 0
    # switched off, the brakes hold
    for drive in foreign.nodes.values():
        drive.state = "SWITCHED ON"
    held = [foreign.position(node) for node in NODES]
    time.sleep(0.2)
    assert [foreign.position(node) for node in NODES] == held


def test_interpolated_position(foreign: Foreign) -> None:
    foreign.commission("INTERPOLATED POSITION", [(0x60C1, 1)])
    step, steps, drive = 500, 8, foreign.nodes[6]
    # a period of a fifth of a second forgives a busy machine
    drive.sdo[0x60C2][1].raw, drive.sdo[0x60C2][2].raw = 20, -2
    start = foreign.position(6)
    others = {node: foreign.position(node) for node in NODES if node != 6}
    seen: list[int] = []
    drive.tpdo[1].add_callback(lambda pdo: seen.append(pdo["position actual value"].raw))
    target = drive.rpdo[2]["interpolation data record.interpolation set-point"]
    target.raw = start
    drive.rpdo[2].transmit()
    drive.controlword = 0x1F
    for k in range(1, steps + 3):
        target.raw = start + step * min(k, steps)
        drive.rpdo[2].transmit()
        time.sleep(0.2)
    assert drive.state == "OPERATION ENABLED"
    assert drive.statusword & 0x1000, "interpolation is not active"
    assert abs(foreign.position(6) - start - step * steps) < 100
    # lines between the set-points: the joint has been everywhere on its way and never went back
    assert max(np.diff(seen)) < step
    assert min(np.diff(seen)) > -20
    assert all(abs(foreign.position(node) - there) < 100 for node, there in others.items())
    drive.tpdo[1].callbacks.pop()
    drive.controlword = 0x0F


@pytest.mark.parametrize("mode", ["PROFILED TORQUE", "CYCLIC SYNCHRONOUS TORQUE"])
def test_torque(foreign: Foreign, mode: str) -> None:
    """The speed gained over a way tells the acceleration whatever the clock says: dq^2 = 2 tau / M (q - q0)."""
    foreign.commission(mode, [(0x6071, 0)], [3])  # all other brakes stay closed: joint 1 turns the whole arm
    q = np.array([foreign.position(node) for node in NODES]) / MDEG
    inertia = float(Dynamics(foreign.blocks.model).M(q)[0, 0])
    drive, start = foreign.nodes[3], foreign.position(3)
    permil = -6 if start > -90_000 else 6
    samples: list[tuple[int, int, int]] = []

    def note(pdo: Any) -> None:
        samples.append((drive.tpdo_values[0x6064], drive.tpdo_values[0x606C], drive.tpdo_values[0x6077]))

    drive.tpdo[2].add_callback(note)
    drive.rpdo[2]["target torque"].raw = permil
    drive.rpdo[2].transmit()
    until(lambda: abs(foreign.position(3) - start) > 4000, "joint 1 does not move")
    drive.tpdo[2].callbacks.remove(note)
    drive.state = "SWITCHED ON"
    until(lambda: drive.sdo[0x606C].raw == 0, "joint 1 does not stop")
    stopped = foreign.position(3)
    time.sleep(0.2)
    assert foreign.position(3) == stopped

    moved = [(now - start, speed, torque) for now, speed, torque in samples if abs(now - start) > 2000]
    assert moved
    tau = permil * drive.sdo[0x6076].raw / 1e6
    for way, speed, torque in moved:
        assert torque == permil
        assert (speed / MDEG) ** 2 / (2 * way / MDEG) == pytest.approx(tau / inertia, rel=0.05)


def test_the_arm_stops_when_the_masters_heartbeat_is_lost(foreign: Foreign) -> None:
    foreign.commission("PROFILED POSITION", [(0x607A, 0), (0x6081, 0)])
    heartbeat = foreign.network.send_periodic(0x700 + MASTER, b"\x05", 0.05)
    start = {node: foreign.position(node) for node in (3, 9)}
    for node in start:
        drive = foreign.nodes[node]
        drive.sdo[0x1016][1].raw = MASTER << 16 | 500
        drive.sdo[0x6007].raw = 1  # fault
        drive.rpdo[2]["target position"].raw = start[node] - math.copysign(60_000, start[node])
        drive.rpdo[2]["profile velocity"].raw = 5000
        drive.rpdo[2].transmit()
        drive.controlword = 0x1F
    for node in start:
        until(lambda: abs(foreign.position(node) - start[node]) > 3000, f"node {node} does not move")  # noqa: B023
        assert foreign.nodes[node].state == "OPERATION ENABLED"
        assert not foreign.nodes[node].emcy.log
    heartbeat.stop()
    for node in start:
        drive = foreign.nodes[node]
        until(lambda: bool(drive.emcy.log), f"node {node} says nothing")  # noqa: B023
        assert drive.emcy.log[0].code == 0x8130
        until(lambda: drive.sdo[0x6041].raw & 0x4F == 0x08, f"node {node} is in no fault")  # noqa: B023
        stopped = foreign.position(node)
        assert abs(stopped - start[node]) < 50_000, "it went on to its target"
        time.sleep(0.2)
        assert foreign.position(node) == stopped
    # and only an acknowledged fault lets it go on
    drive = foreign.nodes[3]
    drive.nmt.state = "OPERATIONAL"
    drive.controlword = 0x0F
    assert drive.sdo[0x6041].raw & 0x4F == 0x08
    drive.reset_from_fault()
    assert drive.state == "OPERATION ENABLED"


# ---- our master, foreign slaves ----

# What a drive must have for our master, beyond what durand brings along.
OBJECTS: dict[int, tuple[Type, str, int]] = {
    0x6040: (Type.UNSIGNED16, "rw", 0),
    0x6041: (Type.UNSIGNED16, "ro", 0x40),
    0x6060: (Type.INTEGER8, "rw", 0),
    0x6061: (Type.INTEGER8, "ro", 0),
    0x6064: (Type.INTEGER32, "ro", 0),
    0x606C: (Type.INTEGER32, "ro", 0),
    0x6071: (Type.INTEGER16, "rw", 0),
    0x6077: (Type.INTEGER16, "ro", 0),
    0x607A: (Type.INTEGER32, "rw", 0),
    0x60B2: (Type.INTEGER16, "rw", 0),
    0x60F4: (Type.INTEGER32, "ro", 0),
    0x60FF: (Type.INTEGER32, "rw", 0),
    0x6502: (Type.UNSIGNED32, "ro", 1 << 9),
}
RECORDS: dict[int, list[Type]] = {0x1016: [Type.UNSIGNED32], 0x60C2: [Type.UNSIGNED8, Type.INTEGER8]}
DISABLED, READY, SWITCHED_ON, ENABLED, STOPPING = 0x40, 0x21, 0x23, 0x27, 0x07


class DurandDrive:
    """A CiA 402 drive with durand as its CANopen: statusword after controlword, and a mass that the torque moves."""

    def __init__(
        self, network: Any, node: int, *, modes: int = 1 << 9, device: int = 0x20192, stays: bool = False
    ) -> None:
        self.stays = stays  # after a quick stop (605A = 6), or is switched off by itself (2)
        self.od = ObjectDictionary()
        self.node = durand.MinimalNode(network, node, self.od)
        for index, (kind, access, value) in OBJECTS.items():
            self.od[index] = durand.Variable(kind, access, value)
        for index, kinds in RECORDS.items():
            record = self.od[index] = durand.Record()
            for sub, kind in enumerate(kinds, start=1):
                record[sub] = durand.Variable(kind, "rw", 0)
        self.od.write(0x1000, 0, device)
        self.od.write(0x6502, 0, modes)
        self.speed, self.place, self.states = 0.0, 0.1, [DISABLED]
        self.torques: list[int] = []
        self.od.update_callbacks[0x6040, 0].add(self._controlled)
        self.od.update_callbacks[0x6060, 0].add(lambda mode: self.od.write(0x6061, 0, mode))
        self.node.sync.callbacks.add(self._synced)
        self.node.nmt.state_callbacks.add(self._managed)

    @property
    def status(self) -> int:
        return int(self.od.read(0x6041, 0))

    def _controlled(self, word: int) -> None:
        state = self.status
        if not word & 2:
            state = DISABLED
        elif not word & 4:
            state = STOPPING if state == ENABLED else state if state == STOPPING else DISABLED
        elif word & 7 == 6 and state in (DISABLED, SWITCHED_ON, ENABLED):
            state = READY
        elif word & 15 == 7 and state in (READY, ENABLED):
            state = SWITCHED_ON
        elif word & 15 == 15 and state == SWITCHED_ON:
            state = ENABLED
        if state != self.states[-1]:
            self.states.append(state)
            self.od.write(0x6041, 0, state)

    def _managed(self, state: StateEnum) -> None:
        """What 6007 = 2 means: no voltage without a network."""
        if state is StateEnum.STOPPED:
            self._controlled(0)

    def _synced(self) -> None:
        """One cycle of 10 ms of a mass on a viscous bearing."""
        torque = self.od.read(0x6071, 0) if self.status == ENABLED else 0
        self.torques.append(torque)
        self.speed = 0.7 * self.speed + 0.01 * torque if self.status == ENABLED else 0.0
        self.place += 0.01 * self.speed
        self.od.write(0x6064, 0, round(self.place * MDEG))
        self.od.write(0x606C, 0, round(self.speed * MDEG))
        if self.status == STOPPING and not self.stays:
            self._controlled(0)


class OnWire(NetworkABC):  # type: ignore[misc]
    """durand on the simulated wire."""

    def __init__(self, wire: Wire, name: str) -> None:
        self.callbacks: dict[int, Callable[[int, bytes], None]] = {}
        self.port = wire.port(name, self._heard)
        self.mute: Callable[[int], bool] = lambda cob_id: False

    def add_subscription(self, cob_id: int, callback: Callable[[int, bytes], None]) -> None:
        self.callbacks[cob_id] = callback

    def remove_subscription(self, cob_id: int, callback: object = None) -> None:
        del self.callbacks[cob_id]

    def send(self, cob_id: int, msg: bytes) -> None:
        if not self.mute(cob_id):
            self.port.send(can.Message(arbitration_id=cob_id, data=msg, is_extended_id=False))

    def _heard(self, msg: can.Message, now: Ns) -> None:
        if msg.arbitration_id in self.callbacks:
            self.callbacks[msg.arbitration_id](msg.arbitration_id, bytes(msg.data))


class Push:
    """Torque towards q = 0.3 rad for every joint."""

    def tick(self, arrived: Arrived, now: Ns, k: int, start: tuple[Array, ...]) -> tuple[JointState, Array]:
        q = arrived.values[0]
        return JointState(q, np.zeros_like(q)), 20.0 * (0.3 - q)


JOINTS = tuple(
    Joint(node=3 + k, name=f"joint{k}", low=-2.0, high=2.0, speed=1.0, acceleration=5.0, torque=40.0) for k in range(3)
)


class Bench:
    """Our master and three of durand's nodes on a wire in virtual time."""

    def __init__(self, **options: Any) -> None:
        self.wire = Wire(500_000)
        self.scheduler = VirtualScheduler()
        set_scheduler(self.scheduler)
        self.networks = [OnWire(self.wire, f"durand {k}") for k in range(3)]
        self.drives = [DurandDrive(network, 3 + k, **options) for k, network in enumerate(self.networks)]
        self._tick()
        plan = Plan(profile="cia402", joints=JOINTS, period=Ns(10 * MS), deadline=Ns(8 * MS))
        self.master = Master(self.wire.port("master"), lambda: self.wire.now, plan)
        self.session = Session(self.master, Push(), with_speed=False)

    def _tick(self) -> None:
        self.scheduler.run(0.001)
        self.wire.call_at(Ns(self.wire.now + MS), self._tick)

    def cycles(self, count: int, each: Callable[[int], object] = lambda k: None) -> int:
        """Run until the count or a fault; the number of the last cycle."""
        for cycle in self.session.cycles(self.wire.now, count):
            if self.session.fault is not None:
                break
            each(cycle.k)
        return cycle.k


@pytest.fixture
def bench() -> Iterator[Callable[..., Bench]]:
    before = get_scheduler()
    yield Bench
    set_scheduler(before)


@pytest.mark.parametrize("stays", [False, True])
def test_our_master_starts_and_moves_foreign_slaves(bench: Callable[..., Bench], stays: bool) -> None:
    rig = bench(stays=stays)
    commission(rig.master, opening("cia402"))
    assert [drive.states for drive in rig.drives] == [[DISABLED, READY, SWITCHED_ON]] * 3
    assert [drive.od.read(0x6060, 0) for drive in rig.drives] == [10] * 3
    assert rig.cycles(300) == 299
    assert rig.session.fault is None
    assert [drive.states[-1] for drive in rig.drives] == [ENABLED] * 3
    for drive in rig.drives:
        assert drive.place == pytest.approx(0.3, abs=0.02)
        assert max(drive.torques) == pytest.approx(20.0 * 0.2 / 40.0 * 1000, abs=5)
    rig.master.stop()
    rig.master.wait(Ns(rig.wire.now + 10 * MS))
    assert [drive.states[3:] for drive in rig.drives] == [[ENABLED, STOPPING, DISABLED]] * 3


def test_silence_of_the_measurements_is_noticed_in_three_cycles(bench: Callable[..., Bench]) -> None:
    rig = bench()
    commission(rig.master)

    def unplug(k: int) -> None:
        if k == 20:
            rig.networks[1].mute = lambda cob_id: 0x180 < cob_id < 0x580

    assert rig.cycles(100, unplug) == 23
    assert rig.session.fault == "node 4: no measurements for 3 cycles"
    rig.master.stop()
    rig.master.wait(Ns(rig.wire.now + 10 * MS))
    assert [drive.states[-1] for drive in rig.drives] == [DISABLED] * 3


def test_silence_of_the_heartbeat_is_noticed_in_three_of_its_periods(bench: Callable[..., Bench]) -> None:
    rig = bench()
    commission(rig.master)
    beats: list[int] = []

    def unplug(k: int) -> None:
        if k == 30:
            beats.append(rig.master.stations[2].alive)
            rig.networks[2].mute = lambda cob_id: cob_id > 0x700

    rig.cycles(100, unplug)
    assert rig.session.fault is not None
    assert rig.session.fault.startswith("node 5: no heartbeat for 30")
    late = rig.wire.now - beats[0] - 300 * MS
    assert 0 <= late <= 20 * MS  # the cycle in which it was noticed, and that cycle's end


def test_an_emergency_of_a_foreign_slave_stops_the_run(bench: Callable[..., Bench]) -> None:
    rig = bench()
    commission(rig.master)
    rig.cycles(50, lambda k: rig.drives[0].node.emcy.set(0x4310, 0x09) if k == 10 else None)
    assert rig.session.fault == "node 3: EMCY 0x4310, error register 0x09"


def test_a_foreign_slave_that_is_no_such_drive_is_refused(bench: Callable[..., Bench]) -> None:
    with pytest.raises(BusError, match=r"node 3: is no drive: device type 0x00000191, expected profile 402"):
        commission(bench(device=0x191).master)
    with pytest.raises(BusError, match=r"node 3: does not support mode 10 of the profile 'cia402'; .* are 0x1"):
        commission(bench(modes=1).master)
    with pytest.raises(BusError, match=r"node 3: cannot read object 0x2030:00: .*\(SDO abort 0x06020000\)"):
        commission(bench().master, opening("lwa4d"))


def test_our_master_over_real_threads() -> None:
    """durand with its own threads on python-can; in real time, so with long periods and no deadlines asserted."""
    before, scheduler = get_scheduler(), SyncScheduler()
    set_scheduler(scheduler)
    runner = threading.Thread(target=scheduler.run)
    runner.start()
    channel = f"durand {os.getpid()} {random.getrandbits(64)}"
    buses = [can.Bus(interface="virtual", channel=channel) for _ in range(3)]
    networks = [durand.CANBusNetwork(bus) for bus in buses]
    drives = [DurandDrive(network, 3 + k) for k, network in enumerate(networks)]
    bus = connect("virtual", channel)
    try:
        plan = Plan(profile="cia402", joints=JOINTS, period=Ns(60 * MS), deadline=Ns(50 * MS), heartbeat=300)
        master = Master(bus, monotonic, plan)
        commission(master)
        session = Session(master, Push(), with_speed=False)
        for cycle in session.cycles(monotonic(), 30):
            if session.fault is not None:
                break
            if cycle.k == 8:
                assert [drive.status for drive in drives] == [ENABLED] * 3
                networks[2].stop()  # unplugged: neither hears nor answers
        assert session.fault is not None
        assert session.fault.startswith("node 5: no measurements for 3 cycles")
        master.stop()
        until(lambda: [drive.status for drive in drives[:2]] == [DISABLED] * 2, "the others are not switched off")
    finally:
        for drive in drives:
            drive.od.write(0x1017, 0, 0)
        scheduler.stop()
        runner.join()
        for network in networks:
            network.stop()
        for each in buses:
            each.shutdown()
        bus.shutdown()
        set_scheduler(before)
