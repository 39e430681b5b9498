"""The CANopen master's work in every cycle: SYNC, measurements, set-points, and the orderly stop.

Nothing here reads a clock or sleeps: time passes in the bus's `recv` alone, on the simulated wire as on a real one.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import can

from lwa4d_sim.bus.client import Client
from lwa4d_sim.bus.dictionary import Joint
from lwa4d_sim.bus.options import Profile
from lwa4d_sim.bus.stations import (
    CONTROL,
    LAYOUTS,
    NEVER,
    POSITION,
    SET_POINT,
    TARGET_POSITION,
    Station,
    mappings,
    torque_counts_per_newton_metre,
)
from lwa4d_sim.bus.watch import ENABLED, MISSED_LIMIT, NMT, STATE_MASK, SYNC, Watch
from lwa4d_sim.errors import BusError
from lwa4d_sim.interfaces import NS_PER_S, Array, Ns

STOP, PRE_OPERATIONAL = 0x02, 0x80  # NMT commands (CiA 301)
QUICK_STOP, DISABLE_VOLTAGE = 0x02, 0x00  # CiA 402 controlwords
QUICK_STOP_ACTIVE = 0x07  # statusword under the mask (CiA 402)
MASTER_NODE = 127  # as which the master's heartbeat is heard (schunk_pg70, Schunk_0_63.dcf)
HEARTBEAT_MS = 100  # LWA 4P's DCF; the LWA4D's leaves it off
TRIES = 50  # SYNC cycles a state change may take (assumed)
DEFIED_LIMIT = 3  # cycles in which a drive may overlook a quick stop (assumed)
OVERTIME = 1_000_000  # [ns] for which frames that had arrived are taken in beyond an instant, were it a flood (assumed)


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """What the master is to set up.

    Attributes:
        profile: of the drives.
        joints: constants of each joint.
        period: SYNC period [ns].
        immediate: commands act when they arrive, not at the next SYNC.
        heartbeat: producer time of the drives and the master [ms], 0 = off.
        deadline: from the SYNC [ns] to when a cycle no longer waits for measurements.
    """

    profile: Profile
    joints: tuple[Joint, ...]
    period: Ns
    immediate: bool = False
    heartbeat: int = HEARTBEAT_MS
    deadline: Ns


class Bus(Protocol):
    """The part of python-can's `BusABC` that is used; time passes in `recv`."""

    channel_info: str

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Put a frame on the bus."""
        ...

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame, or None after ``timeout`` [s]."""
        ...


class Master:
    """The controller side's end of the bus.

    Args:
        bus: any python-can bus.
        clock: the instant now [ns]; of the wire, or monotonic.
        plan: what to set up.
    """

    def __init__(self, bus: Bus, clock: Callable[[], Ns], plan: Plan) -> None:
        self.bus, self.clock, self.plan = bus, clock, plan
        self.layout = LAYOUTS[plan.profile]
        self.stations = [Station(joint.node, joint) for joint in plan.joints]
        self.client = Client(self.send, lambda timeout, done: self.wait(Ns(self.clock() + round(timeout * 1e9)), done))
        self.watch = Watch(self.stations, plan.heartbeat)
        self._by_node = {station.node: station for station in self.stations}
        self._receive, self._transmit = mappings(self.layout.receive), mappings(self.layout.transmit)
        self._cob = {
            0x180 + 0x100 * i + station.node: (station, mapping, 1 << i)
            for station in self.stations
            for i, mapping in enumerate(self._transmit)
        }
        self._scale = [torque_counts_per_newton_metre(plan.profile, station.joint) for station in self.stations]
        self._all = (1 << len(self._transmit)) - 1
        self._waiting = 0
        self.sync_at = NEVER
        self._beat = Ns(0)

    # -- the bus -----------------------------------------------------------------------------------------------------

    def send(self, msg: can.Message) -> None:
        """Put a frame on the bus.

        Raises:
            BusError: the bus does not take it.
        """
        try:
            self.bus.send(msg)
        except can.CanError as error:
            raise BusError(f"cannot send on {self.bus.channel_info}: {error}") from error

    def wait(self, until: Ns, done: Callable[[], bool] | None = None) -> bool:
        """Take in what the bus brings until a condition holds or the instant has come; says whether it held.

        What had arrived by then is taken in too, or it would pass for the next cycle's.
        """
        while done is None or not done():
            left = until - self.clock()
            try:
                msg = self.bus.recv(max(left, 0) / NS_PER_S)
            except can.CanError as error:
                raise BusError(f"cannot receive from {self.bus.channel_info}: {error}") from error
            if msg is not None:
                self._take(msg)
                if left > -OVERTIME:
                    continue
            if self.clock() >= until:
                return done is not None and done()
        return True

    def frame(self, cob_id: int, data: bytes) -> None:
        self.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))

    def _take(self, msg: can.Message) -> None:
        if msg.is_error_frame or msg.is_extended_id or msg.is_remote_frame:
            self.watch.odd(msg, self.clock())
            return
        found = self._cob.get(msg.arbitration_id)
        if found is None:
            if 0x580 < msg.arbitration_id < 0x600:
                if msg.arbitration_id - 0x580 in self._by_node:
                    self._by_node[msg.arbitration_id - 0x580].answers += 1
                self.client.notify(msg.arbitration_id, bytearray(msg.data), msg.timestamp)
            else:
                self.watch.heard(msg, self.clock(), self.sync_at)
            return
        station, mapping, bit = found
        if len(msg.data) < mapping.size:
            self.watch.ignored(station, f"TPDO of {len(msg.data)} bytes ignored", self.clock())
            return
        data = bytes(msg.data)
        if station.fresh & bit:
            # Frames have no number. Those of one kind keep their order on the wire, so the last is the newest, unless
            # it is a copy of one of the cycle before.
            if data == station.before.get(bit):
                self.watch.ignored(station, "copy of an older TPDO ignored", self.clock())
                return
            station.owed &= ~bit
        station.frames[bit] = data
        station.values.update(mapping.unpack(data))
        station.fresh |= bit
        if station.fresh == self._all and not station.owed and not station.complete:
            station.complete = True
            self._waiting -= 1
        if bit == 1:
            station.stamp, station.since = self.sync_at, self.clock()
            station.missed = 0  # late, for the cycle that did not wait for it, but not lost

    # -- one cycle ---------------------------------------------------------------------------------------------------

    def sync(self) -> None:
        """Begin a cycle: SYNC, and the master's heartbeat when it is due."""
        for station in self.stations:
            station.owed = 0 if station.stamp == NEVER else self._all & ~station.fresh
            station.fresh, station.complete = 0, False
            station.before, station.frames = station.frames, {}
        self._waiting = len(self.stations)
        self.sync_at = self.clock()
        self.frame(SYNC, b"")
        if self.plan.heartbeat and self.sync_at >= self._beat:
            self.frame(0x700 + MASTER_NODE, b"\x05")
            self._beat = Ns(self.sync_at + self.plan.heartbeat * 1_000_000)

    def gather(self) -> bool:
        """Wait until every drive has sent its measurements, at most until the deadline; says whether all have.

        After a cycle in which a TPDO did not come, the next may be the late one, and it is worth waiting for another.
        """
        complete = self.wait(Ns(self.sync_at + self.plan.deadline), lambda: not self._waiting)
        for station in self.stations:
            station.missed = 0 if station.fresh & 1 else station.missed + 1
        return complete

    def command(self, tau: Array | None, control: int | None = None) -> None:
        """Send set-points and controlwords to all drives.

        Args:
            tau: torque (n,) [N m], finite; None = none.
            control: controlword; default the one with which the drives move.
        """
        word = self.layout.control if control is None else control
        torque = [0.0] * len(self.stations) if tau is None else tau.tolist()
        for station, newton_metres, scale in zip(self.stations, torque, self._scale, strict=True):
            values = station.values
            values[CONTROL] = word
            values[self.layout.torque] = max(-32767, min(32767, round(newton_metres * scale)))
            # whichever position the drive looks at, it is to see no error there
            values[SET_POINT] = values[TARGET_POSITION] = values.get(POSITION, 0)
            for i, mapping in enumerate(self._receive):
                self.frame(0x200 + 0x100 * i + station.node, mapping.pack_from(values))

    # -- the end -----------------------------------------------------------------------------------------------------

    def halt(self) -> None:
        """One step towards standstill: quick stop to the drives that move, no voltage to those that have stopped.

        A drive that sends no measurements may not take set-points either, and one that does not obey does not. NMT
        stop makes it stop by itself (6007).
        """
        for station in self.stations:
            station.defied = station.defied + 1 if station.status & STATE_MASK == ENABLED else 0
            if station.missed or station.defied > DEFIED_LIMIT:
                self.frame(NMT, bytes([STOP, station.node]))
            moving = station.status & STATE_MASK in (ENABLED, QUICK_STOP_ACTIVE)
            station.values[CONTROL] = QUICK_STOP if moving else DISABLE_VOLTAGE
            station.values[self.layout.torque] = 0
            for i, mapping in enumerate(self._receive):
                self.frame(0x200 + 0x100 * i + station.node, mapping.pack_from(station.values))

    def stop(self) -> None:
        """Quick stop until no drive moves, then switch off; a drive silent for 3 cycles is not waited for.

        Raises:
            BusError: the bus itself is gone.
        """
        self.watch.enabled = False
        for _ in range(TRIES):
            start = self.clock()
            self.sync()
            self.gather()
            moving = (ENABLED, QUICK_STOP_ACTIVE)
            if not any(s.missed < MISSED_LIMIT and s.status & STATE_MASK in moving for s in self.stations):
                break
            self.halt()
            self.wait(Ns(start + self.plan.period))
        self.command(None, DISABLE_VOLTAGE)
        # each of these waits for the one before: SYNC is more urgent than set-points, and NMT than SYNC
        self.wait(Ns(self.clock() + self.plan.period))
        self.sync()
        self.gather()
        self.let_go()
        self.wait(Ns(self.clock() + self.plan.period))

    def let_go(self) -> None:
        """Leave the drives pre-operational, where they take no set-points."""
        for station in self.stations:
            if station.missed:
                self.frame(NMT, bytes([STOP, station.node]))
            self.frame(NMT, bytes([PRE_OPERATIONAL, station.node]))
