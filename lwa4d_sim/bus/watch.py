"""What a master watches: heartbeats, emergencies, silence, the drives' states, and frames that do not belong."""

from collections.abc import Sequence

import can

from lwa4d_sim.bus.stations import Station
from lwa4d_sim.interfaces import Ns

ENABLED = 0x27  # statusword of a moving drive, under the mask
STATE_MASK = 0x6F
OPERATIONAL, BOOT_UP = 0x05, 0x00  # CiA 301, states in the heartbeat
MISSED_LIMIT = 3  # cycles without measurements: transmission type + 2, as ros_canopen counts (canopen_master, pdo.cpp)
HEARTBEATS = 3  # producer times without a heartbeat (ros_canopen, node.cpp)


class Watch:
    """Judges the drives; `verdict` names the first thing wrong.

    Args:
        stations: the drives.
        period: SYNC period [ns].
        heartbeat: producer time of the drives [ms], 0 = not watched.
    """

    def __init__(self, stations: Sequence[Station], period: Ns, heartbeat: int) -> None:
        self._stations, self._period = stations, period
        self._patience = HEARTBEATS * heartbeat * 1_000_000
        self._by_node = {station.node: station for station in stations}
        self._wrong: str | None = None
        self._started = False
        self.enabled = False
        self.events: list[tuple[Ns, str]] = []
        self._now = Ns(0)

    def start(self, now: Ns) -> None:
        """Begin to expect signs of life."""
        self._started = True
        for station in self._stations:
            station.alive = now

    def heard(self, msg: can.Message, now: Ns, sync_at: Ns) -> None:
        """Take in a frame that is no PDO and no SDO answer."""
        cob_id, data = msg.arbitration_id, msg.data
        if cob_id == 0x080:
            self._note(now, "another SYNC producer is on the bus")
        elif 0x080 < cob_id < 0x100 and cob_id - 0x080 in self._by_node and len(data) >= 3:
            self._emergency(self._by_node[cob_id - 0x080], int.from_bytes(data[:2], "little"), data[2], now)
        elif cob_id > 0x700 and cob_id - 0x700 in self._by_node and len(data) == 1:
            self._sign_of_life(self._by_node[cob_id - 0x700], data[0] & 0x7F, now)

    def odd(self, msg: can.Message) -> None:
        """Take in an error, remote or extended frame."""
        if msg.is_error_frame and msg.arbitration_id & 0x40:  # CAN_ERR_BUSOFF of linux/can/error.h
            self._note(self._now, "the master's controller is bus-off")

    def short(self, station: Station, msg: can.Message) -> None:
        """A TPDO with too few bytes is not used."""
        self.events.append((self._now, f"node {station.node}: TPDO of {len(msg.data)} bytes ignored"))

    def verdict(self, now: Ns) -> str | None:
        """The first thing wrong since the start, or None; call once a cycle, after gathering."""
        self._now = now
        if self._wrong is not None or not self._started:
            return self._wrong
        for station in self._stations:
            node = station.node
            if station.missed >= MISSED_LIMIT:
                return self._note(now, f"node {node}: no measurements for {station.missed} cycles")
            if self._patience and now - station.alive > self._patience:
                return self._note(now, f"node {node}: no heartbeat for {(now - station.alive) / 1e6:.0f} ms")
            if self.enabled and station.fresh & 1 and station.status & STATE_MASK != ENABLED:
                return self._note(now, f"node {node}: left operation, statusword 0x{station.status:04X}")
        return None

    def _note(self, now: Ns, text: str) -> str:
        self.events.append((now, text))
        if self._wrong is None:
            self._wrong = text
        return text

    def _emergency(self, station: Station, code: int, register: int, now: Ns) -> None:
        station.emergency = code
        text = f"node {station.node}: EMCY 0x{code:04X}, error register 0x{register:02X}"
        if code == 0 or not self._started or not self.enabled:
            self.events.append((now, text))
        else:
            self._note(now, text)

    def _sign_of_life(self, station: Station, state: int, now: Ns) -> None:
        station.alive, station.nmt = now, state
        if state == BOOT_UP:
            station.boots += 1
            if self._started:
                self._note(now, f"node {station.node}: has restarted")
        elif self._started and self.enabled and state != OPERATIONAL:
            self._note(now, f"node {station.node}: left the operational state (NMT state {state})")
