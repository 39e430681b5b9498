"""Scripted faults of a scenario, put into a simulation of the bus."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial

import can

from lwa4d_sim.bus.dictionary import drive_dictionary
from lwa4d_sim.bus.fault_options import (
    BabblingNode,
    BrakeFailure,
    ControllerErrors,
    DriveError,
    DuplicateNode,
    Fault,
    ForeignFrames,
    ForeignNmt,
    ForeignSync,
    FrameFault,
    HeartbeatLoss,
    MasterCrash,
    NodeReset,
    NodeSilence,
    SdoFlood,
    StrangerFault,
    StuckEncoder,
    WrongDevice,
)
from lwa4d_sim.bus.frames import frame_bits
from lwa4d_sim.bus.master import MASTER_NODE, Plan
from lwa4d_sim.bus.node import Node
from lwa4d_sim.bus.simulation import Simulation
from lwa4d_sim.bus.tamper import Tamper, rule
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import NS_PER_S, Ns, to_ns

# Disturbed transmissions in a row, 8 counts each, that make a transmitter error passive, and bus-off (CAN 2.0, 7).
DISTURBED = {"error_passive": 16, "bus_off": 32}
NMT = {"start": 0x01, "stop": 0x02, "pre_operational": 0x80, "reset_node": 0x81, "reset_communication": 0x82}
# Two devices never answer at the same instant: the second drive with an id is so much slower (assumed).
SLOWER = Ns(300_000)
# SDO requests: read 1000; begin a download to 2F00 of unknown size; seven bytes of it, with either toggle bit.
READ, BEGIN, SEGMENTS = "4000100000000000", "20002F0000000000", ("0001020304050607", "1001020304050607")


class Faults:
    """The faults of one simulation.

    Args:
        simulation: not run yet.
        plan: of its master.
        bit_rate: of its wire, None when frames take no time.
        faults: what goes wrong.

    Raises:
        ScenarioError: a fault that this bus cannot have.
    """

    def __init__(self, simulation: Simulation, plan: Plan, bit_rate: int | None, faults: Sequence[Fault]) -> None:
        self._simulation, self._plan, self._bit_rate = simulation, plan, bit_rate
        self._wire, self._arm = simulation.wire, simulation.arm
        self._tamper = Tamper()
        nodes = {node.node_id: k for k, node in enumerate(simulation.arm.nodes)}
        for i, fault in enumerate(faults):
            key = f"loop.faults.{i}"
            node = getattr(fault, "node", None)
            if node is not None and node not in nodes:
                known = ", ".join(map(str, nodes))
                raise ScenarioError(f"no drive has this node id; they have {known}", f"{key}.node")
            self._install(fault, key, nodes[node] if node is not None else None)
        if self._tamper.rules or any(isinstance(fault, HeartbeatLoss) for fault in faults):
            self._wire.tamper = self._tamper

    def _install(self, fault: Fault, key: str, k: int | None) -> None:
        if isinstance(fault, WrongDevice):
            assert k is not None
            self._arm.nodes[k].dictionary[0x6502, 0] = fault.modes
        elif isinstance(fault, FrameFault):
            self._tamper.rules.append(rule(fault, f"{key}.size", self._plan.profile))
            self._at(fault.at, fault.kind, lambda: None)
        elif isinstance(fault, StrangerFault):
            self._stranger(fault, key, k)
        elif isinstance(fault, ControllerErrors):
            self._need_bits(fault.kind, key)
            port = "master" if fault.node is None else f"node {fault.node}"
            self._at(fault.at, fault.kind, lambda: self._spoil(port, DISTURBED[fault.kind]))
        elif isinstance(fault, HeartbeatLoss):
            cob_id = 0x700 + (MASTER_NODE if fault.node is None else fault.node)
            swallowed = self._tamper.without_heartbeat
            self._for(fault, lambda: swallowed.add(cob_id), lambda: swallowed.discard(cob_id))
        elif isinstance(fault, MasterCrash):
            self._for(fault, self._simulation.freeze, self._simulation.thaw)
        else:
            assert k is not None
            self._drive(fault, k)

    # Drives

    def _drive(self, fault: NodeReset | NodeSilence | DriveError | StuckEncoder | BrakeFailure, k: int) -> None:
        node, drive = self._arm.nodes[k], self._arm.drives[k]
        if isinstance(fault, NodeReset):
            self._at(fault.at, fault.kind, lambda: self._simulation.switch_on(node.node_id))
        elif isinstance(fault, NodeSilence):
            off = fault.how == "off"
            if fault.at == 0:
                self._simulation.cut_off(node.node_id, power=not off)
            begin = partial(self._simulation.cut_off, node.node_id, power=not off)
            self._for(fault, begin, partial(self._simulation.connect, node.node_id, power=not off))
        elif isinstance(fault, DriveError):
            self._at(fault.at, fault.kind, partial(self._simulation.fail, k, fault.code))
        elif isinstance(fault, StuckEncoder):
            self._for(
                fault, partial(setattr, drive, "encoder_stuck", True), partial(setattr, drive, "encoder_stuck", False)
            )
        else:
            self._at(fault.at, fault.kind, lambda: setattr(drive, "brake_works", False))

    def _spoil(self, port: str, times: int) -> None:
        self._wire.disturb(lambda msg, name: name == port, times=times)

    # Strangers

    def _stranger(self, fault: StrangerFault, key: str, k: int | None) -> None:
        name = f"stranger {key.rpartition('.')[2]}"
        if isinstance(fault, DuplicateNode):
            assert k is not None
            self._duplicate(fault, k, name)
        elif isinstance(fault, ForeignNmt):
            self._send(name, fault, [_frame(0, bytes([NMT[fault.command], fault.node or 0]))], Ns(0), 1)
        elif isinstance(fault, ForeignSync):
            self._send(name, fault, [_frame(0x080, b"")], to_ns(fault.period), fault.count)
        elif isinstance(fault, ForeignFrames):
            self._send(name, fault, [_foreign(fault, key)], to_ns(fault.period), fault.count)
        elif isinstance(fault, SdoFlood):
            texts = (READ, READ) if fault.request == "read" else SEGMENTS
            first = READ if fault.request == "read" else BEGIN
            frames = [_frame(0x600 + fault.node, bytes.fromhex(text)) for text in (first, *texts)]
            self._send(name, fault, frames, to_ns(fault.period), fault.count)
        else:
            bit_rate = self._need_bits(fault.kind, key)
            msg = _frame(fault.id, bytes(fault.size))
            period = Ns(frame_bits(msg) * NS_PER_S // bit_rate)
            length = fault.duration if fault.duration is not None else 1e6
            self._send(name, fault, [msg], period, max(1, to_ns(length) // period))

    def _send(
        self,
        name: str,
        fault: BabblingNode | ForeignNmt | ForeignSync | ForeignFrames | SdoFlood,
        frames: list[can.Message],
        period: Ns,
        count: int,
    ) -> None:
        """Send the first frame once and the others in turn."""
        port = self._wire.port(name, lambda msg, now: None)

        def fire(sent: int) -> None:
            with suppress(can.CanOperationError):  # bus-off
                port.send(frames[sent] if sent < len(frames) else frames[1 + (sent - 1) % (len(frames) - 1)])
            if sent + 1 < count:
                self._wire.call_at(Ns(self._wire.now + period), partial(fire, sent + 1))

        if len(frames) == 1:
            frames = frames * 2
        self._at(fault.at, fault.kind, lambda: fire(0))

    def _duplicate(self, fault: DuplicateNode, k: int, name: str) -> None:
        dictionary = drive_dictionary(self._plan.profile, fault.node, self._plan.joints[k])

        def answer(msg: can.Message) -> None:
            self._wire.call_at(Ns(self._wire.now + SLOWER), partial(put, msg))

        def put(msg: can.Message) -> None:
            with suppress(can.CanOperationError):
                port.send(msg)

        def hear(msg: can.Message, now: Ns) -> None:
            second.receive(msg, now)
            second.poll(now)

        second = Node(fault.node, dictionary, answer)
        port = self._wire.port(name, hear)
        if fault.at == 0:
            second.power_on(self._wire.now)
        else:
            self._at(fault.at, fault.kind, lambda: second.power_on(self._wire.now))

    # Times

    def _need_bits(self, kind: str, key: str) -> int:
        if self._bit_rate is None:
            raise ScenarioError(f"'{kind}' needs frames that take time, not bit_rate null", f"{key}.kind")
        return self._bit_rate

    def _at(self, seconds: float, text: str, act: Callable[[], object]) -> None:
        def happen() -> None:
            self._simulation.notes.append((self._wire.now, f"fault: {text}"))
            act()

        self._wire.call_at(to_ns(seconds), happen)

    def _for(
        self,
        fault: NodeSilence | HeartbeatLoss | StuckEncoder | MasterCrash,
        begin: Callable[[], object],
        end: Callable[[], object],
    ) -> None:
        self._at(fault.at, fault.kind, begin)
        if fault.duration is not None:
            self._at(fault.at + fault.duration, f"{fault.kind} is over", end)


def _frame(cob_id: int, data: bytes) -> can.Message:
    return can.Message(arbitration_id=cob_id, data=data, is_extended_id=False)


def _foreign(fault: ForeignFrames, key: str) -> can.Message:
    if len(fault.data) > 8:
        raise ScenarioError("a classic CAN frame has at most 8 bytes", f"{key}.data")
    if not fault.extended and fault.id > 0x7FF:
        raise ScenarioError("must be at most 2047 (0x7FF), or with extended: true a 29-bit identifier", f"{key}.id")
    return can.Message(
        arbitration_id=fault.id,
        data=None if fault.remote else bytes(fault.data),
        dlc=len(fault.data),
        is_extended_id=fault.extended,
        is_remote_frame=fault.remote,
    )
