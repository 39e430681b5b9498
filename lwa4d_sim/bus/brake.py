"""The holding brake of a module: closed without current, opened when a motion mode takes the axis."""

from lwa4d_sim.interfaces import Ns


class Brake:
    """Closed until told otherwise.

    Args:
        delay: from the current in its coil to the open brake [ns].

    Attributes:
        works: False: it holds nothing (a fault to be injected).
        closed: it has no current, or has not opened yet.
        opening: it has current and will be open at this instant, or None.
    """

    def __init__(self, delay: int) -> None:
        self._delay = delay
        self.works = True
        self.closed = True
        self.opening: Ns | None = None
        self._by_hand = False

    @property
    def holds(self) -> bool:
        """The joint cannot move."""
        return self.closed and self.works and not self._by_hand

    def close(self) -> None:
        """Take the current away."""
        self.closed, self.opening = True, None

    def open(self, now: Ns) -> None:
        """Give it current."""
        self._by_hand = False
        if self.closed and self.opening is None:
            self.opening = Ns(now + self._delay)

    def opened(self, now: Ns) -> bool:
        """Whether it has just opened; true once."""
        if self.opening is None or now < self.opening:
            return False
        self.closed, self.opening = False, None
        return True

    def by_hand(self, outputs: int, mask: int, *, in_control: bool) -> None:
        """Digital outputs 60FE: bit 0 = 0 opens the brake of an axis that is not in control (schunk_powerball.cpp).

        ASSUMED: the mask must let bit 0 through, as CiA 402 has it.
        """
        self._by_hand = bool(mask & 1 and not outputs & 1) and not in_control
