"""Opens a bus of python-can by name, and keeps its quirks out of the rest."""

import time
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import Any

import can

from lwa4d_sim.bus.candump import CandumpLog
from lwa4d_sim.errors import BusError

RECENT = 256  # own frames remembered, to tell their echoes (assumed: many cycles' worth)
PATIENCE = 10.0  # [s] for a log's last frames to reach the file (assumed)
# Frames in a row that are skipped as echoes or unreadable before `recv` comes back empty-handed (assumed), so that
# nobody who floods the bus with them keeps the caller from its other work.
SKIPPED = 512

_Key = tuple[int, bool, bool, bytes]


class Connection:
    """A python-can bus that never hands back what it sent, nor fails on what it cannot read.

    `udp_multicast` does both: the sender hears itself, and one malformed datagram ends the reader.

    Args:
        bus: the bus.
        echoes: whether the bus hands back what was sent.

    Attributes:
        channel_info: of the bus.
        unreadable: datagrams that were no frame of a classic CAN bus.
        loggers: each is given all frames, sent and received, with the wall clock as time stamp. One that fails is
            given up: the bus is more important.
        log_error: why a logger was given up, or None.
    """

    def __init__(self, bus: can.BusABC, *, echoes: bool) -> None:
        self._bus, self._echoes = bus, echoes
        self._sent: deque[_Key] = deque()
        self._pending: dict[_Key, int] = {}
        self.channel_info = bus.channel_info
        self.unreadable = 0
        self.loggers: list[can.Listener] = []
        self.log_error: str | None = None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Put a frame on the bus."""
        if self._echoes:
            key = _key(msg)
            self._sent.append(key)
            self._pending[key] = self._pending.get(key, 0) + 1
            if len(self._sent) > RECENT:
                self._forget()
        if self.loggers:
            self._log(msg, time.time(), is_rx=False)
        self._bus.send(msg, timeout)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame of others, or None after ``timeout`` [s]."""
        end = None if timeout is None else time.monotonic() + timeout
        for _ in range(SKIPPED):
            try:
                msg = self._bus.recv(timeout)
            except can.CanOperationError as error:
                if not _is_about_content(error):
                    raise
                self.unreadable += 1
            except (ValueError, TypeError, KeyError, IndexError):
                self.unreadable += 1
            else:
                if msg is None:
                    return None
                if not _is_classic(msg):
                    self.unreadable += 1
                elif not (self._pending and self._is_echo(msg)):
                    if self.loggers:
                        self._log(msg, msg.timestamp, is_rx=True)
                    return msg
            if end is not None:
                timeout = max(0.0, end - time.monotonic())
        return None

    def shutdown(self) -> None:
        """Close the bus and the logs."""
        self._bus.shutdown()
        for logger in self.loggers:
            finish(logger)

    def _log(self, msg: can.Message, timestamp: float, *, is_rx: bool) -> None:
        """Log a copy, without what a hostile datagram may have put into the other fields."""
        copy = can.Message(
            timestamp=timestamp,
            arbitration_id=msg.arbitration_id,
            is_extended_id=bool(msg.is_extended_id),
            is_remote_frame=bool(msg.is_remote_frame),
            is_error_frame=bool(msg.is_error_frame),
            dlc=msg.dlc,
            data=msg.data,
            is_rx=is_rx,
        )
        for logger in list(self.loggers):
            try:
                logger(copy)
            except Exception as error:  # a full disk must not stop the arm's cycle
                self.loggers.remove(logger)
                self.log_error = str(error)
                with suppress(Exception):
                    logger.stop()

    def _is_echo(self, msg: can.Message) -> bool:
        key = _key(msg)
        if key not in self._pending:
            return False
        while self._forget() != key:
            pass  # an earlier own frame was lost on the way back
        return True

    def _forget(self) -> _Key:
        """No longer expect the oldest of the echoes."""
        key = self._sent.popleft()
        left = self._pending[key] - 1
        if left:
            self._pending[key] = left
        else:
            del self._pending[key]
        return key


def _key(msg: can.Message) -> _Key:
    return msg.arbitration_id, msg.is_extended_id, msg.is_remote_frame, bytes(msg.data)


def _is_classic(msg: can.Message) -> bool:
    """Whether it is a frame of a classic bus; in a datagram any field may be anything."""
    can_id, flags = msg.arbitration_id, (msg.is_extended_id, msg.is_remote_frame, msg.is_error_frame)
    if type(can_id) is not int or msg.is_fd is True or not all(type(flag) is bool for flag in flags):
        return False
    if type(msg.data) is not bytearray or type(msg.dlc) is not int or type(msg.timestamp) not in (float, int):
        return False
    return 0 <= can_id < (1 << 29 if msg.is_extended_id else 1 << 11) and 0 <= msg.dlc <= 8 and len(msg.data) <= 8


def _is_about_content(error: can.CanOperationError) -> bool:
    """Whether one datagram was bad, not the bus: python-can reports both alike, but for what caused it."""
    return error.__cause__ is not None and not isinstance(error.__cause__, OSError)


def connect(interface: str, channel: str, bit_rate: int | None = None) -> Connection:
    """Open a bus.

    Args:
        interface: python-can's name: virtual, udp_multicast, socketcan, ...
        channel: what the interface calls a channel: vcan0, 239.74.163.2, ... A port may follow the group of
            udp_multicast, as in 239.74.163.2:43114: who uses one port hears every group that the machine listens to.
        bit_rate: [bit/s], for interfaces that set it.

    Raises:
        BusError: no such interface or channel, or it cannot be opened.
    """
    names = sorted(can.VALID_INTERFACES)
    if interface not in names:
        raise BusError(f"no interface '{interface}'; python-can has {', '.join(names)}")
    options: dict[str, Any] = {}
    try:
        if interface == "udp_multicast":
            options = {"hop_limit": 0, "fd": False}  # stay on this machine
            group, colon, port = channel.rpartition(":")
            if colon and ":" not in group and port.isdecimal():
                channel, options["port"] = group, int(port)
        elif bit_rate is not None and interface != "virtual":
            options = {"bitrate": bit_rate}
        bus = can.Bus(channel=channel, interface=interface, **options)
    except Exception as error:  # drivers fail in many ways, some with a NameError where their library is missing
        reason = str(error) or type(error).__name__
        raise BusError(f"cannot open {interface} channel '{channel}': {' '.join(reason.split())}") from error
    made = Connection(bus, echoes=interface == "udp_multicast")
    made.channel_info = f"{interface} channel '{channel}'"  # not every bus knows its own
    return made


def log_to(bus: Connection, path: Path | None) -> None:
    """Log all frames of a connection to a file, in the format its ending names.

    Raises:
        BusError: no such format, or the file cannot be written.
    """
    if path is None:
        return
    bus.loggers.append(frame_writer(path))


def frame_writer(path: Path) -> can.Listener:
    """A file of frames, in the format its ending names.

    Raises:
        BusError: no such format, a library for it is missing, or the file cannot be written.
    """
    try:
        return CandumpLog(path) if path.suffix.lower() == ".log" else can.Logger(path)
    except (ValueError, OSError, ImportError, NotImplementedError) as error:
        raise BusError(f"{path}: cannot log frames: {error}") from error


def finish(writer: can.Listener) -> None:
    """Close a file of frames.

    python-can's SQLite writer has a thread of its own and throws away what that has not taken from its queue by then.
    """
    queue = getattr(writer, "buffer", None)
    end = time.monotonic() + PATIENCE
    while queue is not None and not queue.empty() and time.monotonic() < end:
        time.sleep(0.01)
    writer.stop()
