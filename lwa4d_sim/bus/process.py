"""What a process under a deadline does about itself: signals, garbage, scheduling."""

import ctypes
import gc
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from lwa4d_sim.errors import BusError

# Under SCHED_FIFO, 1 to 99 (assumed: at the level of threaded interrupts). On one processor the controller, whose SYNC
# is everybody's clock, goes before the arm.
CONTROLLER, ARM = 50, 49
_MCL_CURRENT = 1  # flag of mlockall, <asm-generic/mman.h>


class Stop:
    """Becomes true when the process is asked to end, by SIGINT (Ctrl-C) or SIGTERM.

    A flag and no exception, so that an orderly stop happens between two cycles and not in the middle of a frame, and a
    second Ctrl-C does not break it off.
    """

    def __init__(self) -> None:
        self.asked = False

    def __call__(self) -> bool:
        """Whether it was asked."""
        return self.asked

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.asked = True


@contextmanager
def stoppable() -> Iterator[Stop]:
    """Turn SIGINT and SIGTERM into a flag; only the main thread can, in others the flag stays down."""
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.signal(number, stop._note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def undisturbed(priority: int | None = None) -> Iterator[None]:
    """No collection of garbage; with a ``priority`` ahead of all ordinary processes, and not paged out.

    Raises:
        BusError: the system does not allow it.
    """
    if priority is not None:
        go_first(priority)
    was_on = gc.isenabled()
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.unfreeze()
        if was_on:
            gc.enable()


def go_first(priority: int) -> None:
    """Schedule this process by SCHED_FIFO and lock its memory, to its end.

    Raises:
        BusError: the system does not allow it.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, OSError) as error:  # not on Linux, or neither root nor allowed by RLIMIT_RTPRIO
        raise BusError(f"--realtime: this system does not grant SCHED_FIFO: {error}") from error
    ctypes.CDLL(None).mlockall(_MCL_CURRENT)  # where it is refused, paging remains possible
