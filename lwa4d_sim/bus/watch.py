"""What a master watches: heartbeats, emergencies, silence, the drives' states, and frames that do not belong."""

from collections.abc import Sequence

import can

from lwa4d_sim.bus.stations import Station
from lwa4d_sim.interfaces import Ns

# Statusword of a moving drive under the mask (CiA 402). A drive in fault or after a quick stop differs in bit 3 or 5.
STATE_MASK, ENABLED = 0x6F, 0x27
MOVING = (ENABLED, 0x07, 0x0F, 0x2F)  # the others: quick stop active, fault reaction active
OPERATIONAL, BOOT_UP = 0x05, 0x00  # CiA 301, states in the heartbeat
MISSED_LIMIT = 3  # cycles without measurements: transmission type + 2, as ros_canopen counts (canopen_master, pdo.cpp)
HEARTBEATS = 3  # producer times without a heartbeat (ros_canopen, node.cpp)
NMT, SYNC = 0x000, 0x080  # CiA 301, predefined connection set
TAKES_OVER = (0x02, 0x80, 0x81, 0x82)  # NMT commands that end the operational state
SET_POINTS = range(0x200, 0x580)  # where RPDOs lie, between TPDOs
# Emergencies that are no reason to stop: CAN overrun, error passive (CiA 301, table 26).
WARNINGS = frozenset({0x8110, 0x8120})
# linux/can/error.h: error classes, and what a controller's problem is.
BUS_OFF, CONTROLLER, OVERFLOWS, PASSIVE = 0x040, 0x004, 0x03, 0x30
SLIP = 0.01  # [rad] a joint with a closed brake may move as much (assumed)


class Watch:
    """Judges the drives; `verdict` names the first thing wrong.

    Args:
        stations: the drives.
        heartbeat: producer time of the drives [ms], 0 = not watched.
    """

    def __init__(self, stations: Sequence[Station], heartbeat: int) -> None:
        self._stations = stations
        self._patience = HEARTBEATS * heartbeat * 1_000_000
        self._by_node = {station.node: station for station in stations}
        self._wrong: str | None = None
        self._started = False
        self._told: set[str] = set()
        self._stood: dict[int, float] = {}  # node: where its brake closed [rad]
        self.enabled = False
        self.events: list[tuple[Ns, str]] = []

    def start(self, now: Ns) -> None:
        """Begin to expect signs of life."""
        self._started = True
        for station in self._stations:
            station.alive = now

    def heard(self, msg: can.Message, now: Ns, sync_at: Ns) -> None:
        """Take in a frame that is no TPDO and no SDO answer. What only the master may send is another master's."""
        cob_id, data = msg.arbitration_id, msg.data
        if cob_id == SYNC:
            self._once(now, "another SYNC producer is on the bus")
        elif cob_id == NMT:
            if len(data) == 2 and data[0] in TAKES_OVER and (not data[1] or data[1] in self._by_node):
                self._once(now, f"another master sends NMT command 0x{data[0]:02X}")
        elif cob_id in SET_POINTS and cob_id & 0x80 == 0 and cob_id & 0x7F in self._by_node:
            self._once(now, f"another master sends set-points to node {cob_id & 0x7F}")
        elif 0x080 < cob_id < 0x100 and cob_id - 0x080 in self._by_node and len(data) >= 3:
            self._emergency(self._by_node[cob_id - 0x080], int.from_bytes(data[:2], "little"), data[2], now)
        elif cob_id > 0x700 and cob_id - 0x700 in self._by_node and len(data) == 1:
            self._sign_of_life(self._by_node[cob_id - 0x700], data[0] & 0x7F, now)

    def odd(self, msg: can.Message, now: Ns) -> None:
        """Take in an error, remote or extended frame."""
        if not msg.is_error_frame:
            return
        kind, data = msg.arbitration_id, bytes(msg.data)
        detail = data[1] if kind & CONTROLLER and len(data) > 1 else 0
        if kind & BUS_OFF:
            self.note(now, "the master's controller is bus-off")
        elif detail & OVERFLOWS:
            self.events.append((now, "the master's controller has lost frames"))
        elif detail & PASSIVE:
            self.events.append((now, "the master's controller is error passive"))

    def ignored(self, station: Station, why: str, now: Ns) -> None:
        """A TPDO is not used; said once."""
        text = f"node {station.node}: {why}"
        if text not in self._told:
            self._told.add(text)
            self.events.append((now, text))

    def standing(self, now: Ns) -> None:
        """After a fault: whether each drive that says it is off stands; call once a cycle, after gathering."""
        for station in self._stations:
            moving = station.status & STATE_MASK in MOVING
            if moving or not station.fresh & 1:
                self._stood.pop(station.node, None)
            elif abs(station.q - self._stood.setdefault(station.node, station.q)) > SLIP:
                self._once(now, f"node {station.node}: moves although its brake is closed")

    def verdict(self, now: Ns) -> str | None:
        """The first thing wrong since the start, or None; call once a cycle, after gathering."""
        if self._wrong is not None or not self._started:
            return self._wrong
        for station in self._stations:
            node = station.node
            if station.missed >= MISSED_LIMIT:
                return self.note(now, f"node {node}: no measurements for {station.missed} cycles")
            if self._patience and now - station.alive > self._patience:
                return self.note(now, f"node {node}: no heartbeat for {(now - station.alive) / 1e6:.0f} ms")
            if self.enabled and station.fresh & 1 and station.status & STATE_MASK != ENABLED:
                return self.note(now, f"node {node}: left operation, statusword 0x{station.status:04X}")
        return None

    def note(self, now: Ns, text: str) -> str:
        """Something is wrong; the first such thing is the verdict."""
        self.events.append((now, text))
        if self._wrong is None:
            self._wrong = text
        return text

    def _once(self, now: Ns, text: str) -> None:
        if text not in self._told:
            self._told.add(text)
            self.note(now, text)

    def _emergency(self, station: Station, code: int, register: int, now: Ns) -> None:
        station.emergency = code
        text = f"node {station.node}: EMCY 0x{code:04X}, error register 0x{register:02X}"
        if code == 0 or code in WARNINGS or not self._started or not self.enabled:
            self.events.append((now, text))
        else:
            self.note(now, text)

    def _sign_of_life(self, station: Station, state: int, now: Ns) -> None:
        news = state != station.nmt
        station.alive, station.nmt = now, state
        if state == BOOT_UP:
            station.boots += 1
            if self._started:
                self.note(now, f"node {station.node}: has restarted")
        elif self._started and self.enabled and news and state != OPERATIONAL:
            self.note(now, f"node {station.node}: left the operational state (NMT state {state})")
