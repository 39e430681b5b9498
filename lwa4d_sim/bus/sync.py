"""The SYNC of a node: what a good one looks like (1005, 1019), and its production where 1006 exists."""

from collections.abc import Callable

from lwa4d_sim.bus.dictionary import Dictionary
from lwa4d_sim.interfaces import Ns

PRODUCE = 1 << 30  # bit of 1005
US = 1_000  # [ns], unit of 1006


class Sync:
    """SYNC consumer and producer.

    Args:
        dictionary: holds 1005, and perhaps 1006 and 1019.
        send: puts (identifier, data) on the bus.
    """

    def __init__(self, dictionary: Dictionary, send: Callable[[int, bytes], None]) -> None:
        self._values, self._send = dictionary.values, send
        self._next: Ns | None = None
        self._counter = 1

    @property
    def cob_id(self) -> int:
        """Its identifier."""
        return int(self._values[0x1005, 0]) & 0x7FF

    def counter(self, data: bytes | bytearray) -> tuple[bool, int | None]:
        """Whether a SYNC has the right length, and its counter if it has one."""
        if not self._values.get((0x1019, 0)):
            return not data, None
        return len(data) == 1, data[0] if data else None

    def start(self, now: Ns) -> None:
        """1005 or 1006 was written, or the node has booted or left STOPPED: produce from now on, if asked to."""
        period = self._values.get((0x1006, 0), 0)
        produce = self._values[0x1005, 0] & PRODUCE and period
        self._next, self._counter = (Ns(now + period * US) if produce else None), 1

    def stop(self) -> None:
        """Produce no more."""
        self._next = None

    def poll(self, now: Ns) -> tuple[Ns | None, bool, int | None]:
        """Send what is due: the next instant, whether a SYNC was sent now, and its counter."""
        if self._next is None or now < self._next:
            return self._next, False, None
        period = self._values[0x1006, 0] * US
        self._next = Ns(now + period - (now - self._next) % period)
        last, counter = self._values.get((0x1019, 0), 0), None
        if last:
            counter = self._counter
            self._counter = counter % last + 1
        self._send(self.cob_id, b"" if counter is None else bytes((counter,)))
        return self._next, True, counter
