"""A CANopen slave: network management, error control, SYNC, emergencies, PDOs and SDOs of one node."""

from collections.abc import Callable
from enum import IntEnum
from typing import Literal

import can

from lwa4d_sim.bus import emergency as emcy
from lwa4d_sim.bus.access import Access
from lwa4d_sim.bus.device import Device, Loss, Nothing
from lwa4d_sim.bus.dictionary import Dictionary
from lwa4d_sim.bus.emergency import Emergency
from lwa4d_sim.bus.error_control import ErrorControl
from lwa4d_sim.bus.pdo import Pdos
from lwa4d_sim.bus.pdo_rules import is_pdo, record_of
from lwa4d_sim.bus.sdo import SdoServer
from lwa4d_sim.bus.sync import Sync
from lwa4d_sim.interfaces import Ns


class NmtState(IntEnum):
    """States of network management, numbered as in heartbeats (CiA 301, 7.2.8.3.2.2)."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


COMMANDS = {0x01: NmtState.OPERATIONAL, 0x02: NmtState.STOPPED, 0x80: NmtState.PRE_OPERATIONAL}

# Error classes and details of linux/can/error.h.
CONTROLLER, BUS_OFF, RESTARTED = 0x004, 0x040, 0x100
OVERFLOWS, PASSIVE, ACTIVE = 0x03, 0x30, 0x40


class Node:
    """One slave. It does no input or output and reads no clock: frames and time are handed in, frames are handed out.

    Call `poll` at the instant it last returned and after every `receive`, which can bring the next instant nearer.

    Args:
        node_id: 1 to 127.
        dictionary: its objects; becomes the node's.
        send: takes the frames it sends; must not call back into the node before it returns.
        device: what the objects from 2000 on belong to; None = nothing.

    Attributes:
        state: of network management.
        cob_ids: the 11-bit identifiers it listens to at present; another object after each change.
        data_ids: those of them of which data frames matter; the others are answered as remote frames only.
    """

    def __init__(
        self, node_id: int, dictionary: Dictionary, send: Callable[[can.Message], None], device: Device | None = None
    ) -> None:
        if not 1 <= node_id <= 127:
            raise ValueError(f"node id {node_id} is not in 1 to 127")
        self.node_id, self.dictionary = node_id, dictionary
        self.state = NmtState.INITIALISING
        self.cob_ids: frozenset[int] = frozenset()
        self.data_ids = self.cob_ids
        self._send_message, self._device = send, device or Nothing()
        self._now = Ns(0)
        self._sync_wrong = False
        self._handlers: dict[int, Callable[[can.Message, Ns], None]] = {}
        self._emergency = Emergency(dictionary, self._send)
        self._control = ErrorControl(dictionary, lambda byte: self._send(0x700 + node_id, bytes((byte,))), self._alarm)
        self._sync = Sync(dictionary, self._send)
        self._pdos = Pdos(dictionary, self._send, self._device.written, self._report)
        self._objects = Access(dictionary, node_id, self._device, self._reconfigure)
        self._sdo = SdoServer(self._objects, lambda data: self._send(0x580 + node_id, data))

    def power_on(self, now: Ns) -> None:
        """Switch on: stored or default values, boot-up, PRE-OPERATIONAL."""
        self._boot(now, everything=True)

    def receive(self, msg: can.Message, now: Ns) -> None:
        """Any frame from the bus. What does not concern the node, or is malformed, has no effect."""
        if msg.is_error_frame:
            if self.state is not NmtState.INITIALISING:
                self._now = now
                self._controller(msg.arbitration_id, bytes(msg.data), now)
        elif not msg.is_extended_id and not msg.is_fd:
            handler = self._handlers.get(msg.arbitration_id)
            if handler is not None:
                self._now = now
                handler(msg, now)

    def poll(self, now: Ns) -> Ns | None:
        """Let the timers act that are due; the next instant at which one is, or None."""
        if self.state is NmtState.INITIALISING:
            return None
        self._now = now
        if self._pdos.watching:
            self._device.advance(now)
            self._device.refresh()
        next_sync, synced, counter = self._sync.poll(now)
        if synced:
            self._synchronize(counter, now)
        deadlines = (
            next_sync,
            self._control.poll(self.state, now),
            self._sdo.poll(now),
            self._pdos.poll(now),
            self._device.poll(now),
            self._emergency.poll(now),
        )
        return min((t for t in deadlines if t is not None), default=None)

    def emergency(self, code: int, register: int, info: bytes = b"") -> None:
        """Report an error of the device.

        Args:
            code: CiA error code.
            register: bits of the error register 1001 that it sets.
            info: up to five bytes of the manufacturer; the first two stand in the history 1003 too.
        """
        self._emergency.raised(code, register, info, self._now)

    def recovered(self, code: int) -> None:
        """Report that an error is gone."""
        self._emergency.recovered(code, self._now)

    # Network management.

    def _boot(self, now: Ns, *, everything: bool) -> None:
        """Reset node, or reset communication only."""
        self._now, self.state = now, NmtState.INITIALISING
        self._emergency.allowed = False
        self._device.advance(now)
        self._sdo.reset()
        self.dictionary.reset("all" if everything else "communication")
        self._emergency.reset(device=everything)
        self._pdos.forget()
        self._sync_wrong = False
        if everything:
            self._device.reset(now)
        self._control.boot(now)
        self._enter(NmtState.PRE_OPERATIONAL, now)

    def _enter(self, state: NmtState, now: Ns) -> None:
        if state is self.state:
            return
        talking = self.state in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL)
        self.state = state
        self._emergency.allowed = state is not NmtState.STOPPED
        self._emergency.poll(now)
        if state is NmtState.STOPPED:
            self._sdo.reset()
            self._sync.stop()
        elif not talking:
            self._sync.start(now)
        self._pdos.rebuild(now, running=state is NmtState.OPERATIONAL)
        self._listen()

    def _listen(self) -> None:
        """Which identifiers matter follows from the state (CiA 301, table 38) and the parameters."""
        handlers: dict[int, Callable[[can.Message, Ns], None]] = {}
        if self.state is NmtState.OPERATIONAL:
            handlers |= dict.fromkeys(self._pdos.receivers, self._on_pdo)
            handlers |= dict.fromkeys(self._pdos.transmitters, self._on_pdo_request)
        if self.state is not NmtState.STOPPED:
            handlers |= {self._sync.cob_id: self._on_sync, 0x600 + self.node_id: self._on_sdo}
        handlers |= {0x700 + node: self._on_heartbeat for node in self._control.limits}
        self._handlers = handlers | {0x000: self._on_nmt, 0x700 + self.node_id: self._on_guarding}
        if self._handlers.keys() != self.cob_ids:
            self.cob_ids = frozenset(self._handlers)
        remote_only = {*self._pdos.transmitters, 0x700 + self.node_id}
        self.data_ids = self.cob_ids - remote_only if self.state is NmtState.OPERATIONAL else self.cob_ids

    def _on_nmt(self, msg: can.Message, now: Ns) -> None:
        if msg.is_remote_frame or len(msg.data) != 2 or msg.data[1] not in (0, self.node_id):
            return
        command = msg.data[0]
        if command in (0x81, 0x82):
            if command == 0x82 and self.state is NmtState.OPERATIONAL:
                self._lose("nmt_stop", now)  # it would go on without PDOs
            self._boot(now, everything=command == 0x81)
        elif command in COMMANDS:
            if COMMANDS[command] is NmtState.STOPPED and self.state is not NmtState.STOPPED:
                self._lose("nmt_stop", now)
            self._enter(COMMANDS[command], now)

    # Errors of the communication.

    def _report(self, code: int, present: bool, now: Ns) -> None:
        if present:
            self._emergency.raised(code, emcy.COMMUNICATION, b"", now)
            if code == emcy.RPDO_TIME_OUT:
                self._lose("rpdo", now)
        else:
            self._emergency.recovered(code, now)

    def _alarm(self, reason: Literal["heartbeat", "guarding"], present: bool, now: Ns) -> None:
        self._report(emcy.NO_SIGN_OF_LIFE, present, now)
        if present:
            self._disconnected(reason, now)

    def _lose(self, reason: Loss, now: Ns) -> None:
        self._device.advance(now)
        self._device.lost(reason, now)

    def _disconnected(self, reason: Loss, now: Ns) -> None:
        """The device's own reaction (6007), then that of the communication (1029)."""
        self._lose(reason, now)
        behaviour = self.dictionary.values.get((0x1029, 1), 0)
        if behaviour == 2:
            self._enter(NmtState.STOPPED, now)
        elif behaviour == 0 and self.state is NmtState.OPERATIONAL:
            self._enter(NmtState.PRE_OPERATIONAL, now)

    def _controller(self, kind: int, data: bytes, now: Ns) -> None:
        """What the CAN controller reports, as an error frame of SocketCAN (linux/can/error.h)."""
        detail = data[1] if kind & CONTROLLER and len(data) > 1 else 0
        if kind & BUS_OFF:
            self._disconnected("bus_off", now)
        if kind & RESTARTED:
            self._report(emcy.BUS_OFF_OVER, True, now)
            self._report(emcy.BUS_OFF_OVER, False, now)
        if detail & OVERFLOWS:
            self._report(emcy.OVERRUN, True, now)
            self._report(emcy.OVERRUN, False, now)
        if detail & PASSIVE:
            self._report(emcy.ERROR_PASSIVE, True, now)
        if detail & ACTIVE or kind & RESTARTED:
            self._report(emcy.ERROR_PASSIVE, False, now)

    def _on_heartbeat(self, msg: can.Message, now: Ns) -> None:
        if not msg.is_remote_frame and len(msg.data) == 1:
            self._control.heard(msg.arbitration_id - 0x700, msg.data[0] & 0x7F, now)

    def _on_guarding(self, msg: can.Message, now: Ns) -> None:
        if msg.is_remote_frame:
            self._control.guarded(self.state, now)

    # SYNC and PDOs.

    def _on_sync(self, msg: can.Message, now: Ns) -> None:
        if msg.is_remote_frame:
            return
        right, counter = self._sync.counter(msg.data)
        if right is self._sync_wrong:
            self._sync_wrong = not right
            self._report(emcy.SYNC_LENGTH, self._sync_wrong, now)
        if right:
            self._synchronize(counter, now)

    def _synchronize(self, counter: int | None, now: Ns) -> None:
        device, pdos = self._device, self._pdos
        device.advance(now)
        if pdos.running:
            pdos.apply()
        device.sync(now)
        if pdos.running:
            device.refresh()
            pdos.sample(counter, now)

    def _on_pdo(self, msg: can.Message, now: Ns) -> None:
        if not msg.is_remote_frame:
            pdo = self._pdos.receivers[msg.arbitration_id]
            if not pdo.synchronous:
                self._device.advance(now)
            self._pdos.receive(pdo, msg.data, now)

    def _on_pdo_request(self, msg: can.Message, now: Ns) -> None:
        if msg.is_remote_frame:
            self._device.advance(now)
            self._device.refresh()
            self._pdos.request(self._pdos.transmitters[msg.arbitration_id])

    # Objects.

    def _on_sdo(self, msg: can.Message, now: Ns) -> None:
        if not msg.is_remote_frame:
            self._objects.now = now
            self._sdo.receive(bytes(msg.data), now)

    def _reconfigure(self, index: int) -> None:
        """A communication object was written."""
        now = self._now
        if index == 0x1003:
            self._emergency.clear_history()
        elif index in (0x1005, 0x1006):
            self._sync.start(now)
        elif index == 0x1016:
            self._control.consume(now)
        elif index == 0x1017:
            self._control.produce(now)
        elif is_pdo(index):
            self._pdos.changed(record_of(index), now)
        self._listen()

    def _send(self, cob_id: int, data: bytes) -> None:
        try:  # noqa: SIM105  # the quick road
            self._send_message(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))
        except can.CanError:
            pass  # a controller in bus-off: the frame is lost, its error frame tells the node
