"""What a drive watches while it moves: following error, runaway, and SYNC."""

from lwa4d_sim.bus import alarms
from lwa4d_sim.bus.axis import Axis
from lwa4d_sim.interfaces import Ns

RUNAWAY = 2.0  # times the speed limit is a fault in modes that close the speed loop (assumed)


class Supervision:
    """Of one axis.

    Attributes:
        silent: SYNC has been missed, which has been reported.
    """

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self.silent = False
        self._beyond_since: Ns | None = None
        self._synced: Ns | None = None
        self._enabled = Ns(0)

    def forget(self) -> None:
        """No following error from here on."""
        self._beyond_since = None

    def follow(self, error: float, now: Ns) -> int:
        """Look at a following error [rad]; emergency code, or 0."""
        axis = self._axis
        if abs(axis.dq) > RUNAWAY * axis.speed_max:
            return alarms.OVERSPEED
        if -axis.window <= error <= axis.window:
            self._beyond_since = None
            return 0
        if self._beyond_since is None:
            self._beyond_since = now
        return alarms.FOLLOWING if now - self._beyond_since >= axis.window_time else 0

    def enabled(self, now: Ns) -> None:
        """The drive begins to move: from here on SYNC counts."""
        self._enabled = now

    def sync(self, now: Ns) -> bool:
        """A SYNC; whether it ends a silence."""
        self._synced = now
        ended, self.silent = self.silent, False
        return ended

    def sync_deadline(self) -> Ns | None:
        """When the next SYNC must have come: 200E times 60C2 after the last (Schunk_0_63.dcf); 200E = 0 is off.

        ASSUMED: a drive that has never seen a SYNC is not run by one, and does not miss it.
        """
        factor = self._axis.get(0x200E)
        if self._synced is None or not factor or self.silent:
            return None
        return Ns(max(self._synced, self._enabled) + factor * self._axis.period)
