"""Files of CAN frames: what the simulated wire carried written like a log of a real bus, and logs sent again."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can

from lwa4d_sim.bus.connect import Connection, finish, frame_writer
from lwa4d_sim.errors import BusError
from lwa4d_sim.frame_log import OUTCOMES, FrameLog
from lwa4d_sim.interfaces import NS_PER_S

# Time stamp [s] of a run's first instant in a written log: what is before it, the set-up from -10 s on, needs stamps of
# at least zero.
ORIGIN = 10
LONGEST_GAP = 60.0  # [s]; longer silence in a log is cut down to this when it is sent again (assumed)
NAP = 0.1  # [s], in which a replay notices that it is to end (assumed)
# What drives obey (CiA 301, predefined connection set): network management, SYNC and time stamp, RPDOs, SDO requests.
COMMANDS = frozenset(
    {0x000, 0x080, 0x100}.union(*(range(base + 1, base + 0x80) for base in (0x200, 0x300, 0x400, 0x500, 0x600)))
)


def messages(log: FrameLog) -> Iterator[can.Message]:
    """The frames that arrived, in that order, with the time stamp `ORIGIN` + time of the run [s]."""
    sent = OUTCOMES.index("sent")
    for k in range(len(log)):
        if log.outcome[k] != sent:
            continue
        size = int(log.size[k])
        remote = bool(log.remote[k])
        yield can.Message(
            timestamp=ORIGIN + int(log.received[k]) / NS_PER_S,
            arbitration_id=int(log.id[k]),
            is_extended_id=bool(log.extended[k]),
            is_remote_frame=remote,
            dlc=size,
            data=b"" if remote else log.data[k, :size].tobytes(),
        )


def write(log: FrameLog, path: Path) -> None:
    """Write a record's frames in the format that the file's ending names.

    Raises:
        BusError: no such format, or the file cannot be written.
    """
    writer = frame_writer(path)
    try:
        for msg in messages(log):
            writer(msg)
    except OSError as error:
        raise BusError(f"{path}: cannot write: {error}") from error
    finally:
        finish(writer)


def replay(path: Path, bus: Connection, stopped: Callable[[], bool], *, commands: bool) -> tuple[int, int]:
    """Send a log's frames again, as far apart as they were; how many were sent and how many left out.

    Args:
        path: log in any format that python-can reads.
        bus: where to.
        stopped: asked before every frame whether to end.
        commands: also send what drives obey.

    Raises:
        BusError: the file cannot be read, or the bus does not take a frame.
    """
    sent = left_out = 0
    due, before = time.monotonic(), None
    for msg in read(path):
        # no gap is negative, and what is no number is none
        due += min(max(0.0, msg.timestamp - before), LONGEST_GAP) if before is not None else 0.0
        before = msg.timestamp
        if not _reached(due, stopped):
            break
        if not msg.is_extended_id and msg.arbitration_id in COMMANDS and not commands:
            left_out += 1
            continue
        try:
            bus.send(msg)
        except can.CanError as error:
            raise BusError(f"cannot send on {bus.channel_info}: {error}") from error
        while bus.recv(0) is not None:
            pass  # nobody here listens; a full buffer would keep echoes from being known
        sent += 1
    return sent, left_out


def _reached(due: float, stopped: Callable[[], bool]) -> bool:
    """Sleep until an instant [s]; False when asked to end before."""
    while not stopped():
        left = due - time.monotonic()
        if left <= 0:
            return True
        time.sleep(min(left, NAP))
    return False


def read(path: Path) -> Iterator[can.Message]:
    """Data and remote frames of a log.

    Raises:
        BusError: the file is not there, or not a log.
    """
    try:
        with can.LogReader(path) as reader:
            for msg in reader:
                if not msg.is_error_frame and not msg.is_fd and msg.dlc <= 8:
                    yield msg
    except Exception as error:  # the readers fail in many ways on what is no log
        raise BusError(f"{path}: cannot read frames: {error or type(error).__name__}") from error
