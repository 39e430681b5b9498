"""The arm side on a real bus: drives for anybody's master, paced by the clock or by the SYNC."""

import time
from collections.abc import Callable

from lwa4d_sim.bus.arm import BusArm
from lwa4d_sim.bus.connect import Connection
from lwa4d_sim.interfaces import NS_PER_S, Ns

# The plant is brought up to the clock at least this often, so that no single call takes long (assumed).
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
    deadline = arm.power_on(clock())
    while not until():
        now = clock()
        nap = LONGEST_NAP if deadline is None else max(0, min(LONGEST_NAP, deadline - now))
        msg = bus.recv(nap / NS_PER_S)
        now = clock()
        deadline = arm.poll(now) if msg is None else arm.receive(msg, now)
        arm.catch_up(now)
        arm.forget()
