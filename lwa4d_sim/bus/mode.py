"""What a mode of operation is: it gives the loops a reference, or a torque, and says how it is getting on.

Stopping (halt, quick stop, faults) is not a mode's business: the drive takes the reference away from it and gives it
back with `Mode.resume`.
"""

from enum import Enum

from lwa4d_sim.bus.axis import Axis
from lwa4d_sim.bus.motion import Motion, Point, rest
from lwa4d_sim.interfaces import Ns


class Loop(Enum):
    """Which loops of the drive a mode closes."""

    POSITION = "position"
    SPEED = "speed"
    TORQUE = "torque"


class Dwell:
    """Whether a condition has held for a time.

    Attributes:
        held: it had, at the last look.
    """

    def __init__(self) -> None:
        self._since: Ns | None = None
        self.held = False

    def look(self, condition: bool, now: Ns, time: int) -> None:
        """Look again, at ``now``; ``time`` in ns."""
        if not condition:
            self._since, self.held = None, False
            return
        if self._since is None:
            self._since = now
        self.held = now - self._since >= time


class Mode:
    """No mode (6060 = 0): the axis holds its place.

    Attributes:
        number: value of 6060.
        loop: loops closed.
        set_points: objects whose writing moves it.
        limited: a set-point was beyond a limit and is not followed as it came.
        excess: how far the position asked for lies beyond the reference [rad]: it counts as following error.
        motion: the reference.
    """

    number = 0
    loop = Loop.POSITION
    set_points: frozenset[int] = frozenset()

    def __init__(self, axis: Axis) -> None:
        self.axis = axis
        self.motion: Motion = rest(Ns(0), 0.0)
        self.word = 0
        self.limited = False
        self.excess = 0.0

    def enter(self, now: Ns, word: int) -> None:
        """Begin; ``word`` is the controlword before, so that what rises with the next one is an edge."""
        self.word = word
        self.resume(now)

    def resume(self, now: Ns) -> None:
        """Go on from where the joint is now, at rest."""
        self.motion = rest(now, self.axis.q)
        self.limited, self.excess = False, 0.0

    def control(self, word: int, now: Ns) -> None:
        """Take a controlword."""
        self.word = word

    def write(self, index: int, now: Ns) -> None:
        """One of the ``set_points`` was written."""

    def demand(self, now: Ns) -> Point:
        """Reference at an instant."""
        return self.motion.at(now)

    def torque(self, now: Ns) -> float:
        """Torque asked for besides what the loops give [N m]."""
        return 0.0

    def constant(self, now: Ns) -> bool:
        """Whether `torque` stays as it is until something is written."""
        return True

    def fault(self, now: Ns) -> int:
        """Emergency code of what went wrong in this mode, or 0."""
        return 0

    def bits(self, now: Ns) -> int:
        """Statusword bits 10, 12 and 13 of this mode."""
        return 0
