"""The controller side on a bus: every SYNC its measurements go to the controller and the torques to the drives.

One generator serves the simulated wire and a real bus; what differs is how time passes in the master's waiting.
"""

from collections.abc import Iterator
from typing import NamedTuple, Protocol

import numpy as np

from lwa4d_sim.bus.master import Master
from lwa4d_sim.bus.safety import Following
from lwa4d_sim.errors import BusError
from lwa4d_sim.interfaces import Array, Arrived, IntArray, JointState, Ns


class Control(Protocol):
    """Estimator, trajectory and control law."""

    def tick(self, arrived: Arrived, now: Ns, k: int, start: tuple[Array, ...]) -> tuple[JointState, Array]:
        """State and torque (1, n) from the newest measurement."""
        ...


class Guard(Protocol):
    """The safety envelope in front of the wire."""

    def check(self, q: Array, dq: Array, tau: Array) -> Array:
        """Torque (n,) that may go out.

        Raises:
            BusError: the arm must stop.
        """
        ...


class Cycle(NamedTuple):
    """What happened on the controller side in one cycle; None when it had nothing to go by or had stopped."""

    k: int
    state: JointState | None
    command: Array | None
    age: IntArray | None


class Session:
    """Runs a controller through a master.

    Args:
        master: commissioned.
        control: the controller side, as in a simulation.
        with_speed: the measurement carries the drives' own speed.
        guard: safety envelope, or None.
        following: limit of the distance from the desired motion, or None.

    Attributes:
        fault: why the arm is being stopped, or None; there is no way back.
        frozen: the process stands still (a fault to be injected).
        late: cycles that were not begun in time, or not at all.
        lateness: of the beginning of each that was [ns].
        work: from there to the last set-point sent [ns].
    """

    def __init__(
        self,
        master: Master,
        control: Control,
        *,
        with_speed: bool,
        guard: Guard | None = None,
        following: Following | None = None,
    ) -> None:
        self._master, self._control, self._guard = master, control, guard
        self._with_speed, self._following = with_speed, following
        self.fault: str | None = None
        self.frozen = False
        self.late = 0
        self.lateness: list[Ns] = []
        self.work: list[Ns] = []
        self._stopping = self._commanded = 0

    def cycles(self, start: Ns, ticks: int) -> Iterator[Cycle]:
        """Cycle by cycle from the instant ``start`` [ns]; each ends when the next is due.

        A cycle whose time has passed is counted and left out, and the next is again on the grid: no burst catches up.
        """
        master, period = self._master, self._master.plan.period
        first = self._measured()
        k = 0
        while k < ticks:
            due = Ns(start + k * period)
            master.wait(due)
            begun = master.clock()
            gone = (begun - due) // period
            if gone:
                self.late += min(gone + 1, ticks - k)
                k += gone + 1
                continue
            self.lateness.append(Ns(begun - due))
            cycle = self._cycle(k, start, first)
            self.work.append(Ns(master.clock() - begun))
            behind = (master.clock() - start) // period
            self.late += min(max(0, behind - k), ticks - 1 - k)
            k = max(k, behind) + 1
            master.wait(Ns(start + k * period))
            yield cycle

    def _cycle(self, k: int, start: Ns, first: tuple[Array, ...]) -> Cycle:
        master, nothing = self._master, Cycle(k, None, None, None)
        if self.frozen:
            self.late += 1
            return nothing
        if self.fault is not None:
            self._hold_still()
            return nothing
        try:
            master.sync()
            master.gather()
            if self.frozen:
                return nothing
            self.fault = master.watch.verdict(master.clock())
            if self.fault is None:
                return self._compute(k, start, first)
        except BusError as error:
            self.fault = master.watch.note(master.clock(), str(error))
        self._hold_still()
        return nothing

    def _compute(self, k: int, start: Ns, first: tuple[Array, ...]) -> Cycle:
        master = self._master
        now = Ns(master.clock() - start)
        stamp = np.array([[station.stamp - start for station in master.stations]])
        since = np.array([[station.since - start for station in master.stations]])
        arrived = Arrived(np.maximum(stamp, 0), np.maximum(since, 0), self._measured())
        state, command = self._control.tick(arrived, now, k, first)
        tau = command[0]
        if not np.isfinite(tau).all():
            raise BusError("the controller's torque is not a number")
        if self._following is not None:
            self._following.check(k, arrived.values[0][0])
        if self._guard is not None:
            tau = self._guard.check(arrived.values[0][0], state.dq[0], tau)
        master.command(tau)
        self._commanded += 1
        if self._commanded > 2:  # the drives have had a SYNC to follow the first command, and another to say so
            master.watch.enabled = True
        return Cycle(k, state, command, now - np.maximum(stamp, 0))

    def _hold_still(self) -> None:
        """After a fault: quick stop, then no voltage, as far as the bus allows."""
        try:
            if self._stopping:
                self._master.sync()
                self._master.gather()
                self._master.watch.standing(self._master.clock())
            self._stopping += 1
            self._master.halt()
        except BusError:
            return

    def _measured(self) -> tuple[Array, ...]:
        q = np.array([[station.q for station in self._master.stations]])
        if not self._with_speed:
            return (q,)
        return q, np.array([[station.dq for station in self._master.stations]])
