"""The emergency producer of a node: error register 1001, history 1003, EMCY frames and their inhibit time 1015."""

from collections import deque
from collections.abc import Callable

from lwa4d_sim.bus.dictionary import Dictionary
from lwa4d_sim.interfaces import Ns

# Error codes (CiA 301, table 26) that the communication itself can cause.
OVERRUN, ERROR_PASSIVE, NO_SIGN_OF_LIFE, BUS_OFF_OVER = 0x8110, 0x8120, 0x8130, 0x8140
PDO_TOO_SHORT, PDO_TOO_LONG, SYNC_LENGTH, RPDO_TIME_OUT = 0x8210, 0x8220, 0x8240, 0x8250
ERROR_RESET = 0x0000
COMMUNICATION_CODES = range(0x8100, 0x8300)

GENERIC, COMMUNICATION = 0x01, 0x10  # bits of the error register (CiA 301, 7.5.2.2)
WAITING = 16  # frames kept while none may be sent (assumed)
INHIBIT_UNIT = 100_000  # [ns] of 1015
NOT_VALID = 1 << 31  # bit of 1014


class Emergency:
    """Errors that are present, and what has been told of them.

    Args:
        dictionary: holds 1001, 1003, 1014 and 1015.
        send: puts (identifier, data) on the bus.

    Attributes:
        allowed: whether frames may be sent now (pre-operational and operational).
    """

    def __init__(self, dictionary: Dictionary, send: Callable[[int, bytes], None]) -> None:
        self._dictionary, self._send = dictionary, send
        self._depth = sum((0x1003, sub) in dictionary for sub in range(1, 255))
        self._active: dict[int, int] = {}
        self._waiting: deque[bytes] = deque(maxlen=WAITING)
        self._free: Ns = Ns(0)  # from when on the next frame may be sent
        self.allowed = False

    def reset(self, *, device: bool) -> None:
        """Forget errors of the communication, and those of the ``device`` too, as after power-on."""
        for code in list(self._active):
            if device or code in COMMUNICATION_CODES:
                del self._active[code]
        self._waiting.clear()
        self._free = Ns(0)
        self._show()

    def _show(self) -> None:
        register = GENERIC if self._active else 0
        for bits in self._active.values():
            register |= bits
        self._dictionary[0x1001, 0] = register

    def raised(self, code: int, register: int, info: bytes, now: Ns) -> None:
        """An error is present; one that is known already is not told again.

        Args:
            code: CiA error code.
            register: bits of 1001 that it sets.
            info: up to five bytes of the manufacturer; the first two stand in the history too.
            now: [ns].
        """
        if code in self._active:
            return
        self._active[code] = register
        self._show()
        info = info[:5].ljust(5, b"\0")
        values = self._dictionary
        for sub in range(self._depth, 1, -1):
            values[0x1003, sub] = values[0x1003, sub - 1]
        values[0x1003, 1] = code | int.from_bytes(info[:2], "little") << 16
        values[0x1003, 0] = min(values[0x1003, 0] + 1, self._depth)
        self._tell(code, info, now)

    def recovered(self, code: int, now: Ns) -> None:
        """An error is gone; the error register in the frame tells what is left."""
        if self._active.pop(code, None) is not None:
            self._show()
            self._tell(ERROR_RESET, bytes(5), now)

    def clear_history(self) -> None:
        """1003:0 was written with 0."""
        for sub in range(1, self._depth + 1):
            self._dictionary[0x1003, sub] = 0

    def poll(self, now: Ns) -> Ns | None:
        """Send what waits and may go; the instant at which the next may."""
        values = self._dictionary.values
        while self._waiting and self.allowed:
            if now < self._free:
                return self._free
            data = self._waiting.popleft()
            if not values[0x1014, 0] & NOT_VALID:
                self._send(values[0x1014, 0] & 0x7FF, data)
                self._free = Ns(now + values.get((0x1015, 0), 0) * INHIBIT_UNIT)
        return None

    def _tell(self, code: int, info: bytes, now: Ns) -> None:
        self._waiting.append(code.to_bytes(2, "little") + bytes((self._dictionary[0x1001, 0],)) + info)
        self.poll(now)
