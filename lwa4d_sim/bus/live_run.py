"""A controller's run on a real bus: set up, cycles, orderly stop, and the record of what was measured."""

import math
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from lwa4d_sim.assembly import Blocks
from lwa4d_sim.bus.build import bus_loop, driving_session
from lwa4d_sim.bus.commission import Kept, commission, put_back
from lwa4d_sim.bus.connect import Connection
from lwa4d_sim.bus.master import Master
from lwa4d_sim.bus.options import Profile
from lwa4d_sim.bus.process import CONTROLLER, undisturbed
from lwa4d_sim.bus.serve import monotonic
from lwa4d_sim.bus.session import Cycle, Session
from lwa4d_sim.bus.stations import opening
from lwa4d_sim.errors import BusError
from lwa4d_sim.interfaces import NS_PER_S, Array, Ns
from lwa4d_sim.record import ComputedPaths, RunLog, TickLog

LEAD = Ns(20_000_000)  # from the end of the set-up to the first cycle (assumed)
# Edges of the histograms [s], six a decade and open at the end: from what a good system does to ten lost cycles.
EDGES = np.array([0.0, *np.geomspace(1e-5, 1e-1, 25), np.inf])


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
        self._start = Ns(0)
        self._kept: list[Kept] = []

    def set_up(self, profile: Profile) -> None:
        """Commission the drives; if that fails they are left with closed brakes.

        Raises:
            BusError: they are not there or refuse.
        """
        try:
            self._kept = commission(self._master, opening(profile))
        except BaseException:
            with suppress(BusError):
                self._master.let_go()
            raise

    def run(self, ticks: int, stopped: Callable[[], object]) -> str:
        """Drive, then stop in order, whatever happens; says how it ended: ``done``, or why not.

        Args:
            ticks: cycles.
            stopped: asked in every cycle whether to end.
        """
        ended = "done"
        try:
            self._start = Ns(self._master.clock() + LEAD)
            for cycle in self._session.cycles(self._start, ticks):
                self._cycles.append(cycle)
                if self._session.fault is not None:
                    ended = self._session.fault
                    break
                if stopped():
                    ended = "interrupted"
                    break
        finally:
            try:
                self._master.stop()
                put_back(self._master, self._kept)
            except BusError as error:
                ended = f"{ended}; {error}" if ended != "done" else str(error)
        return ended

    def summary(self) -> dict[str, Any]:
        """Numbers of the run: cycles, those missed, how late they began, how long they worked, largest joint errors."""
        log = self.record()
        error = np.abs(log.ticks.q - log.ticks.q_ref)
        late = np.array(self._session.lateness) / NS_PER_S
        return {
            "cycles": len(self._cycles),
            "missed": self._session.late,
            "lateness": _spread(late),
            "work": _spread(np.array(self._session.work) / NS_PER_S),
            "histogram": _histogram(late),
            "joint_error": np.nanmax(error, axis=0).tolist() if len(error) else [],
        }

    def record(self) -> RunLog:
        """What was measured and asked, one sample a cycle, as the record of a run."""
        info, period = self._blocks.infos[0], self._master.plan.period
        n = len(self._master.stations)
        done = [cycle for cycle in self._cycles if cycle.state is not None]
        q = np.array([cycle.state.q[0] for cycle in done if cycle.state is not None]).reshape(-1, n)
        dq = np.array([cycle.state.dq[0] for cycle in done if cycle.state is not None]).reshape(-1, n)
        tau = np.array([cycle.command[0] for cycle in done if cycle.command is not None]).reshape(-1, n)
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
            events=tuple(((time - self._start) / NS_PER_S, text) for time, text in self._master.watch.events),
            scenario=info.scenario,
            versions=info.versions,
            paths=ComputedPaths(info.kinematics, info.trajectory),
        )


def drive_arm(
    blocks: Blocks,
    bus: Connection,
    stopped: Callable[[], object],
    *,
    seconds: float | None,
    realtime: bool,
    torque: float = 1.0,
) -> tuple[LiveRun, dict[str, Any]]:
    """Drive an arm over a bus; the run and its summary, with how it ended.

    Args:
        blocks: of the scenario.
        bus: open.
        stopped: asked in every cycle whether to end.
        seconds: longest duration [s]; default that of the motion.
        realtime: ahead of all ordinary processes.
        torque: share of each joint's peak torque that may be asked.

    Raises:
        BusError: no real-time scheduling here, or the drives cannot be set up.
    """
    loop = bus_loop(blocks.settings)
    ticks = blocks.timing.ticks if seconds is None else math.ceil(min(blocks.timing.ticks, seconds / loop.period))
    master, session = driving_session(blocks, bus, monotonic, torque=torque)
    live = LiveRun(blocks, master, session)
    # begun before the set-up, since what it does takes longer than the drives wait for a heartbeat
    with undisturbed(CONTROLLER if realtime else None):
        live.set_up(loop.profile)
        ended = live.run(ticks, stopped)
    return live, {**live.summary(), "ended": ended}


def report(found: dict[str, Any]) -> str:
    """The summary as text, with the histogram as bars."""
    lines = [f"{found['cycles']} cycles, {found['missed']} missed"]
    for key, what in (("lateness", "start after its due time"), ("work", "from SYNC to the last set-point")):
        spread = found[key]
        if spread:
            p50, p99, largest = (1e3 * spread[name] for name in ("p50", "p99", "max"))
            lines.append(f"{what:32} p50 {p50:7.3f} ms, p99 {p99:7.3f} ms, max {largest:7.3f} ms")
    highest = max((count for count, _, _ in found["histogram"]), default=1)
    for count, low, high in found["histogram"]:
        top = "       " if high is None else f"{1e3 * high:7.3f}"
        bar = "#" * -(-50 * count // highest)
        lines.append(f"  {1e3 * low:7.3f} to {top} ms {count:7} {bar}")
    if found["joint_error"]:
        lines.append(f"largest joint error {max(found['joint_error']):.4f} rad")
    return "\n".join([*lines, f"ended: {found['ended']}"])


def _spread(values: Array) -> dict[str, float]:
    if not len(values):
        return {}
    return {
        "p50": float(np.percentile(values, 50)),
        "p99": float(np.percentile(values, 99)),
        "max": float(values.max()),
    }


def _histogram(values: Array) -> list[tuple[int, float, float | None]]:
    """Count and edges of the bins from the first to the last that is not empty; the last may be open."""
    counts = np.histogram(np.maximum(values, 0.0), EDGES)[0]
    used = np.flatnonzero(counts)
    if not len(used):
        return []
    return [
        (int(counts[k]), float(EDGES[k]), float(EDGES[k + 1]) if k + 2 < len(EDGES) else None)
        for k in range(used[0], used[-1] + 1)
    ]
