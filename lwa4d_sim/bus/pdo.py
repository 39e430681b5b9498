"""The PDOs of a node at work: received ones latched and written, transmitted ones sampled and sent.

Transmission types (CiA 301, 7.5.2.36): 0 at a SYNC if something changed, 1-240 at every n-th SYNC, 252 sampled at SYNC
and 253 sampled on request and sent by remote frame, 254 and 255 when something changes. An RPDO of type 0-240 acts at
the next SYNC, of 254 and 255 at once.
"""

from collections.abc import Callable, Iterable
from typing import Any

from lwa4d_sim.bus.dictionary import Dictionary
from lwa4d_sim.bus.emergency import PDO_TOO_LONG, PDO_TOO_SHORT, RPDO_TIME_OUT
from lwa4d_sim.bus.entry import Abort
from lwa4d_sim.bus.mapping import Key
from lwa4d_sim.bus.pdo_rules import (
    EVENT,
    LAST_CYCLIC,
    ON_REQUEST_SAMPLED,
    RECEIVE,
    Parameters,
    parameters,
    records,
)
from lwa4d_sim.interfaces import Ns

SCAN = 1_000_000  # [ns] between two looks for a change in what event-driven TPDOs hold (assumed)


class Receive:
    """One RPDO that exists: what has come and waits for SYNC, and when the next is overdue."""

    __slots__ = ("due", "keys", "latched", "limited", "record", "size", "synchronous", "timer", "values")

    def __init__(self, given: Parameters, dictionary: Dictionary) -> None:
        self.record, self.timer, self.synchronous = given.record, given.timer, given.kind <= LAST_CYCLIC
        self.size, self.keys, self.values = given.mapping.size, given.mapping.keys, given.mapping.values
        # Objects with limits; a value beyond them, which an SDO would be refused, is left out.
        self.limited = {key: entry for key in self.keys if (entry := dictionary.entry(*key)).limited}
        self.latched: bytes | None = None
        self.due: Ns | None = None


class Transmit:
    """One TPDO that exists: what was sent last, and when the next may or must be sent."""

    def __init__(self, given: Parameters) -> None:
        self.record = given.record
        self.cob_id, self.remote, self.kind, self.pack = given.cob_id, given.remote, given.kind, given.mapping.pack_from
        self.inhibit, self.timer, self.start = given.inhibit, given.timer, given.start
        self.count, self.started = 0, given.start == 0
        self.last: bytes | None = None  # data last sampled or sent
        self.pending = True  # it has something to tell
        self.free = Ns(0)  # when the inhibit time is over
        self.due: Ns | None = None  # when the event timer expires


class Pdos:
    """The PDO engine.

    Args:
        dictionary: parameters, and the objects that are mapped.
        send: puts (identifier, data) on the bus.
        written: told of each object that an RPDO wrote; an `Abort` puts the old value back.
        report: told of an error code that appears (True) or is gone (False).

    Attributes:
        receivers: the RPDOs that exist and have contents, by identifier.
        transmitters: such TPDOs.
        running: whether the node is operational.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        send: Callable[[int, bytes], None],
        written: Callable[[int, int], None],
        report: Callable[[int, bool, Ns], None],
    ) -> None:
        self._dictionary, self._values = dictionary, dictionary.values
        self._send, self._written, self._report = send, written, report
        self._records = records(dictionary)
        self._wrong: dict[int, set[int]] = {code: set() for code in (PDO_TOO_SHORT, PDO_TOO_LONG, RPDO_TIME_OUT)}
        self.running = False
        self.receivers: dict[int, Receive] = {}
        self.transmitters: dict[int, Transmit] = {}
        self._sampled: list[Transmit] = []
        self._events: list[Transmit] = []

    @property
    def watching(self) -> bool:
        """Whether `poll` will look at the objects, which must be fresh then."""
        return self.running and bool(self._events)

    def rebuild(self, now: Ns, *, running: bool) -> None:
        """Read all parameters anew; what was latched or counted is forgotten."""
        self.running = running
        self.receivers, self.transmitters = {}, {}
        for record in self._records:
            self._make(record)
        self._sort(now)

    def changed(self, record: int, now: Ns) -> None:
        """A parameter of one PDO was written."""
        self.receivers = {cob_id: pdo for cob_id, pdo in self.receivers.items() if pdo.record != record}
        self.transmitters = {cob_id: pdo for cob_id, pdo in self.transmitters.items() if pdo.record != record}
        self._make(record)
        for code in self._wrong:
            self._right(code, record, now)
        self._sort(now)

    def forget(self) -> None:
        """No frame was ever wrong, as after a reset."""
        for wrong in self._wrong.values():
            wrong.clear()

    def _make(self, record: int) -> None:
        given = parameters(self._dictionary, record)
        if not given.valid or not given.mapping.size:
            return
        if record in RECEIVE:
            self.receivers[given.cob_id] = Receive(given, self._dictionary)
        else:
            self.transmitters[given.cob_id] = Transmit(given)

    def _sort(self, now: Ns) -> None:
        pdos = [self.transmitters[cob_id] for cob_id in sorted(self.transmitters)]
        self._sampled = [pdo for pdo in pdos if pdo.kind <= ON_REQUEST_SAMPLED]
        self._events = [pdo for pdo in pdos if pdo.kind >= EVENT]
        for pdo in self._events:
            if pdo.due is None and pdo.timer:
                pdo.due = Ns(now + pdo.timer)

    # Reception.

    def receive(self, pdo: Receive, data: bytes | bytearray, now: Ns) -> None:
        """The data field of a frame with an RPDO's identifier."""
        size = len(data)
        if size < pdo.size:
            self._fail(PDO_TOO_SHORT, pdo.record, now)
            return
        if size > pdo.size:
            self._fail(PDO_TOO_LONG, pdo.record, now)
        elif self._wrong[PDO_TOO_LONG]:
            self._right(PDO_TOO_LONG, pdo.record, now)
        if self._wrong[PDO_TOO_SHORT]:
            self._right(PDO_TOO_SHORT, pdo.record, now)
        if pdo.timer:
            pdo.due = Ns(now + pdo.timer)
            self._right(RPDO_TIME_OUT, pdo.record, now)
        pdo.latched = bytes(data)
        if not pdo.synchronous:
            self._write((pdo,))

    def apply(self) -> None:
        """SYNC: write what has been latched."""
        self._write(self.receivers.values())

    def _write(self, pdos: Iterable[Receive]) -> None:
        """Write all objects first and tell the device then, so that it never sees half of a set-point."""
        values = self._values
        old: dict[Key, Any] = {}
        for pdo in pdos:
            if pdo.latched is None:
                continue
            for key, value in zip(pdo.keys, pdo.values(pdo.latched), strict=True):
                entry = pdo.limited.get(key)
                if entry is None or entry.within(value):
                    old.setdefault(key, values[key])
                    values[key] = value
            pdo.latched = None
        for key, value in old.items():
            try:
                self._written(*key)
            except Abort:
                values[key] = value

    def _fail(self, code: int, record: int, now: Ns) -> None:
        wrong = self._wrong[code]
        if record not in wrong:
            wrong.add(record)
            if len(wrong) == 1:
                self._report(code, True, now)

    def _right(self, code: int, record: int, now: Ns) -> None:
        wrong = self._wrong[code]
        if record in wrong:
            wrong.discard(record)
            if not wrong:
                self._report(code, False, now)

    # Transmission.

    def sample(self, counter: int | None, now: Ns) -> None:
        """SYNC, objects fresh: sample the synchronous TPDOs and send those that are due.

        Args:
            counter: of the SYNC, None if it carries none.
            now: [ns].
        """
        for pdo in self._sampled:
            kind = pdo.kind
            if 1 <= kind <= LAST_CYCLIC and not self._turn(pdo, counter):
                continue
            data = pdo.pack(self._values)
            if kind != ON_REQUEST_SAMPLED and (kind or data != pdo.last):
                self._send(pdo.cob_id, data)
            pdo.last = data

    @staticmethod
    def _turn(pdo: Transmit, counter: int | None) -> bool:
        """Whether this SYNC is the n-th of a cyclic TPDO, which may have to start at a certain SYNC counter."""
        if not pdo.started and counter is not None:
            pdo.started, pdo.count = counter == pdo.start, pdo.kind
        else:
            pdo.count += 1
        if pdo.count < pdo.kind or not (pdo.started or counter is None):
            return False
        pdo.count = 0
        return True

    def request(self, pdo: Transmit) -> None:
        """A remote frame asks for a TPDO; objects are fresh."""
        if not pdo.remote:
            return
        if pdo.kind > ON_REQUEST_SAMPLED or pdo.last is None:
            pdo.last = pdo.pack(self._values)
        self._send(pdo.cob_id, pdo.last)

    def poll(self, now: Ns) -> Ns | None:
        """Send the event-driven TPDOs that are due and miss overdue RPDOs; the next instant of interest."""
        if not self.running:
            return None
        deadlines: list[int] = []
        for pdo in self._events:
            data = pdo.pack(self._values)
            pdo.pending |= data != pdo.last or (pdo.due is not None and now >= pdo.due)
            if pdo.pending and now >= pdo.free:
                self._send(pdo.cob_id, data)
                pdo.last, pdo.pending = data, False
                pdo.free = Ns(now + pdo.inhibit)
                pdo.due = Ns(now + pdo.timer) if pdo.timer else None
            deadlines.append(pdo.free if pdo.pending else now - now % SCAN + SCAN)
            if pdo.due is not None and not pdo.pending:
                deadlines.append(pdo.due)
        for receive in self.receivers.values():
            if receive.due is not None:
                if now >= receive.due:
                    receive.due = None
                    self._fail(RPDO_TIME_OUT, receive.record, now)
                else:
                    deadlines.append(receive.due)
        return Ns(min(deadlines)) if deadlines else None
