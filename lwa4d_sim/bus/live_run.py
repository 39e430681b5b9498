"""A controller's run on a real bus: set up, cycles, orderly stop, and the record of what was measured."""

from collections.abc import Callable
from typing import Any

import numpy as np

from lwa4d_sim.assembly import Blocks
from lwa4d_sim.bus.commission import commission
from lwa4d_sim.bus.master import Master
from lwa4d_sim.bus.options import Profile
from lwa4d_sim.bus.session import Cycle, Session
from lwa4d_sim.bus.stations import opening
from lwa4d_sim.errors import BusError
from lwa4d_sim.interfaces import NS_PER_S, Ns
from lwa4d_sim.record import ComputedPaths, RunLog, TickLog

LEAD = Ns(20_000_000)  # from the end of the set-up to the first cycle: time to build the first references (assumed)
BINS = 12  # of the histogram


class LiveRun:
    """One run over a master.

    Args:
        blocks: of the scenario.
        master: on an open bus.
        session: of that master.
    """

    def __init__(self, blocks: Blocks, master: Master, session: Session) -> None:
        self._blocks, self._master, self._session = blocks, master, session
        self._cycles: list[Cycle] = []

    def set_up(self, profile: Profile) -> None:
        """Commission the drives.

        Raises:
            BusError: they are not there or refuse.
        """
        commission(self._master, opening(profile))

    def run(self, ticks: int, advance: Callable[[], None]) -> str:
        """Drive, then stop in order; says how it ended: ``done``, or why not."""
        ended = "done"
        try:
            start = Ns(self._master.clock() + LEAD)
            for cycle in self._session.cycles(start, ticks):
                self._cycles.append(cycle)
                advance()
                if self._session.fault is not None:
                    ended = self._session.fault
                    break
        except KeyboardInterrupt:
            ended = "interrupted"
        finally:
            try:
                self._master.stop()
            except BusError as error:
                ended = f"{ended}; {error}" if ended != "done" else str(error)
        return ended

    def summary(self) -> dict[str, Any]:
        """Numbers of the run: cycles, those missed, lateness of their starts, and the largest joint errors."""
        late = np.array(self._session.lateness or [Ns(0)]) / NS_PER_S
        counts, edges = np.histogram(late, bins=np.geomspace(1e-5, max(2e-5, late.max()), BINS))
        log = self.record()
        error = np.abs(log.ticks.q - log.ticks.q_ref)
        return {
            "cycles": len(self._cycles),
            "missed": self._session.late,
            "lateness": {
                "p50": float(np.percentile(late, 50)),
                "p99": float(np.percentile(late, 99)),
                "max": float(late.max()),
            },
            "histogram": [
                [int(count), float(low), float(high)]
                for count, low, high in zip(counts, edges[:-1], edges[1:], strict=True)
            ],
            "joint_error": np.nanmax(error, axis=0).tolist() if len(error) else [],
        }

    def record(self) -> RunLog:
        """What was measured and asked, one sample a cycle, as the record of a run."""
        info, period = self._blocks.infos[0], self._master.plan.period
        n = len(self._master.stations)
        blank = np.full(n, np.nan)
        done = [cycle for cycle in self._cycles if cycle.state is not None]
        q = np.array([blank if cycle.state is None else cycle.state.q[0] for cycle in done]).reshape(-1, n)
        dq = np.array([blank if cycle.state is None else cycle.state.dq[0] for cycle in done]).reshape(-1, n)
        tau = np.array([blank if cycle.command is None else cycle.command[0] for cycle in done]).reshape(-1, n)
        age = np.array([np.nan if cycle.age is None else float(cycle.age.max()) for cycle in done]) / NS_PER_S
        t = np.array([cycle.k for cycle in done]) * (period / NS_PER_S)
        q_ref = info.trajectory.joint(t).q if len(t) else q
        return RunLog(
            name=info.name,
            variant="bus",
            timestep=period,
            period=period,
            q=q,
            dq=dq,
            tau=tau,
            ticks=TickLog(t=t, q=q, dq=dq, tau=tau, age=age, q_true=q, dq_true=dq, q_ref=q_ref),
            knots=info.trajectory.knots,
            tau_max=info.tau_max,
            seed=info.seed,
            diverged_at=None,
            events=tuple((time / NS_PER_S, text) for time, text in self._master.watch.events),
            scenario=info.scenario,
            versions=info.versions,
            paths=ComputedPaths(info.kinematics, info.trajectory),
        )
