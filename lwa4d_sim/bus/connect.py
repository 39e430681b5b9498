"""Opens a bus of python-can by name, and keeps its quirks out of the rest."""

from collections import deque
from pathlib import Path
from typing import Any

import can

from lwa4d_sim.errors import BusError

RECENT = 256  # own frames remembered, to tell their echoes (assumed: many cycles' worth)


class Connection:
    """A python-can bus that never hands back what it sent, nor fails on what it cannot read.

    `udp_multicast` does both: the sender hears itself, and one malformed datagram ends the reader.

    Args:
        bus: the bus.
        echoes: whether the bus hands back what was sent.
    """

    def __init__(self, bus: can.BusABC, *, echoes: bool) -> None:
        self._bus, self._echoes = bus, echoes
        self._sent: deque[tuple[int, bytes]] = deque(maxlen=RECENT)
        self.channel_info = bus.channel_info
        self.unreadable = 0
        self.loggers: list[can.Listener] = []

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Put a frame on the bus."""
        if self._echoes:
            self._sent.append((msg.arbitration_id, bytes(msg.data)))
        for logger in self.loggers:
            logger(msg)
        self._bus.send(msg, timeout)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame of others, or None after ``timeout`` [s]; an echo or an unreadable frame also gives None."""
        try:
            msg = self._bus.recv(timeout)
        except can.CanOperationError:
            raise
        except (ValueError, TypeError, KeyError, IndexError, can.CanError):  # what a hostile datagram can cause
            self.unreadable += 1
            return None
        if msg is None:
            return None
        if self._echoes and self._is_echo(msg):
            return None
        for logger in self.loggers:
            logger(msg)
        return msg

    def shutdown(self) -> None:
        """Close the bus and the logs."""
        for logger in self.loggers:
            logger.stop()
        self._bus.shutdown()

    def _is_echo(self, msg: can.Message) -> bool:
        key = (msg.arbitration_id, bytes(msg.data))
        if key not in self._sent:
            return False
        while self._sent.popleft() != key:
            pass  # an earlier own frame was lost on the way back
        return True


def connect(interface: str, channel: str, bit_rate: int | None = None) -> Connection:
    """Open a bus.

    Args:
        interface: python-can's name: virtual, udp_multicast, socketcan, ...
        channel: what the interface calls a channel: vcan0, 239.74.163.2, ...
        bit_rate: [bit/s], for interfaces that set it.

    Raises:
        BusError: no such interface or channel, or it cannot be opened.
    """
    names = sorted(can.VALID_INTERFACES)
    if interface not in names:
        raise BusError(f"no interface '{interface}'; python-can has {', '.join(names)}")
    options: dict[str, Any] = {}
    if interface == "udp_multicast":
        options = {"hop_limit": 0, "fd": False}  # stay on this machine
    elif bit_rate is not None and interface != "virtual":
        options = {"bitrate": bit_rate}
    try:
        bus = can.Bus(channel=channel, interface=interface, **options)
    except (can.CanError, OSError, ValueError, TypeError, ImportError, AttributeError) as error:
        reason = str(error) or type(error).__name__
        raise BusError(f"cannot open {interface} channel '{channel}': {' '.join(reason.split())}") from error
    return Connection(bus, echoes=interface == "udp_multicast")


def log_to(bus: Connection, path: Path | None) -> None:
    """Log all frames of a connection to a file, in the format its ending names.

    Raises:
        BusError: no such format, or the file cannot be written.
    """
    if path is None:
        return
    try:
        bus.loggers.append(can.Logger(path))
    except (ValueError, OSError) as error:
        raise BusError(f"{path}: cannot log frames: {error}") from error
