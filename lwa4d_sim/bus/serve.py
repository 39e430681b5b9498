"""The arm side on a real bus: drives for anybody's master, paced by the clock or by the SYNC."""

import time
from collections.abc import Callable

from lwa4d_sim.bus.arm import BusArm
from lwa4d_sim.bus.connect import Connection
from lwa4d_sim.interfaces import NS_PER_S, Ns

# The plant is brought up to the clock at every SYNC, and otherwise this often: few calls of many steps, none of which
# takes long (assumed).
LONGEST_NAP = Ns(5_000_000)


def monotonic() -> Ns:
    """The wall clock [ns], from any start."""
    return Ns(time.monotonic_ns())


def serve(arm: BusArm, bus: Connection, clock: Callable[[], Ns], until: Callable[[], bool]) -> None:
    """Answer the bus and keep the plant up to the clock until told otherwise.

    Args:
        arm: plant and drives; their send goes to ``bus``.
        bus: the bus.
        clock: the instant now [ns].
        until: asked every few milliseconds whether to end.
    """
    due = arm.power_on(clock())
    now = clock()
    step_at = now + LONGEST_NAP
    while not until():
        left = (step_at if due is None or due > step_at else due) - now
        msg = bus.recv(left / NS_PER_S) if left > 0 else None
        now = clock()
        if msg is not None:
            sooner = arm.receive(msg, now)
            if sooner is not None and (due is None or sooner < due):
                due = sooner
        if now >= step_at:
            arm.catch_up(now)
            step_at = now + LONGEST_NAP
        if due is not None and due <= now:
            due = arm.poll(now)
        arm.forget()
