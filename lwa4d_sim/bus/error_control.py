"""Error control of a node: boot-up, heartbeat producer 1017 and consumer 1016, node guarding and life guarding."""

from collections.abc import Callable
from typing import Any, Literal

from lwa4d_sim.bus.dictionary import Dictionary
from lwa4d_sim.bus.entry import INCOMPATIBLE, Abort
from lwa4d_sim.bus.mapping import Key
from lwa4d_sim.interfaces import Ns

MS = 1_000_000  # [ns]
TOGGLE = 0x80
CONSUMERS = range(1, 4)  # sub-indices of 1016

Alarm = Callable[[Literal["heartbeat", "guarding"], bool, Ns], None]


def check_consumer(values: dict[Key, Any], sub: int, value: int) -> None:
    """Refuse to watch a node twice.

    Raises:
        Abort: another sub-index of 1016 watches the same node.
    """
    node = _watched(value)
    if node is not None and any(node == _watched(values[0x1016, other]) for other in CONSUMERS if other != sub):
        raise Abort(INCOMPATIBLE)


class ErrorControl:
    """Signs of life, given and expected.

    Args:
        dictionary: holds 100C, 100D, 1016 and 1017.
        send: puts one byte on the node's error control channel.
        alarm: told that the other side's signs of life are missing (True) or are there again (False).
    """

    def __init__(self, dictionary: Dictionary, send: Callable[[int], None], alarm: Alarm) -> None:
        self._values, self._send, self._alarm = dictionary.values, send, alarm
        self._beat: Ns | None = None  # next heartbeat to send
        self._toggle = 0
        self._guarded: Ns | None = None  # when life guarding expires
        self._unguarded = False
        self._due: dict[int, Ns] = {}  # node: when its heartbeat is overdue
        self._missing: set[int] = set()
        self.limits: dict[int, int] = {}  # node: longest pause between its heartbeats [ns]

    def boot(self, now: Ns) -> None:
        """Announce the node; everything begins anew."""
        self._toggle, self._guarded, self._unguarded = 0, None, False
        self._due.clear()
        self._missing.clear()
        self._send(0)
        self.produce(now)
        self.consume(now)

    def produce(self, now: Ns) -> None:
        """1017 was written: the next heartbeat is one period away."""
        period = self._values[0x1017, 0] * MS
        self._beat = Ns(now + period) if period else None
        if period:  # heartbeat takes the place of guarding
            self._guarded, self._unguarded = None, False

    def consume(self, now: Ns) -> None:
        """1016 was written: what is watched starts with the next heartbeat of each node."""
        entries = [self._values[0x1016, sub] for sub in CONSUMERS]
        limits = {node: (entry & 0xFFFF) * MS for entry in entries if (node := _watched(entry)) is not None}
        for node in self.limits.keys() | limits.keys():
            if self.limits.get(node) != limits.get(node):
                self._due.pop(node, None)
                self._found(node, now)
        self.limits = limits

    def heard(self, node: int, state: int, now: Ns) -> None:
        """A heartbeat of a watched node. A boot-up of one that was alive is a loss: it has forgotten what it did."""
        if state == 0:
            if self._due.pop(node, None) is not None:
                self._lost(node, now)
            return
        self._due[node] = Ns(now + self.limits[node])
        self._found(node, now)

    def guarded(self, state: int, now: Ns) -> None:
        """The master's remote frame: answer with state and toggle bit."""
        if self._values[0x1017, 0]:
            return
        self._send(state | self._toggle)
        self._toggle ^= TOGGLE
        life = self._values[0x100C, 0] * self._values[0x100D, 0] * MS
        self._guarded = Ns(now + life) if life else None
        if self._unguarded:
            self._unguarded = False
            self._alarm("guarding", False, now)

    def poll(self, state: int, now: Ns) -> Ns | None:
        """Send what is due and miss what is overdue; the next instant at which something is."""
        if self._beat is not None and now >= self._beat:
            self._send(state)
            period = self._values[0x1017, 0] * MS
            self._beat = Ns(now + period - (now - self._beat) % period)  # on the grid, whenever one is called
        if self._guarded is not None and now >= self._guarded:
            self._guarded, self._unguarded = None, True
            self._alarm("guarding", True, now)
        for node in [node for node, due in self._due.items() if now >= due]:
            del self._due[node]
            self._lost(node, now)
        return min((t for t in (self._beat, self._guarded, *self._due.values()) if t is not None), default=None)

    def _found(self, node: int, now: Ns) -> None:
        if node in self._missing:
            self._missing.discard(node)
            if not self._missing:
                self._alarm("heartbeat", False, now)

    def _lost(self, node: int, now: Ns) -> None:
        self._missing.add(node)
        self._alarm("heartbeat", True, now)


def _watched(entry: int) -> int | None:
    """Node that an entry of 1016 watches, None if it is switched off."""
    node = entry >> 16
    return node if 1 <= node <= 127 and entry & 0xFFFF else None
