"""Collects the loop's ticks into one record per simulation."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lwa4d_sim.interfaces import NS_PER_S, Array, Ns, Trajectory
from lwa4d_sim.loop import Tick, Timing
from lwa4d_sim.plant import SPEED_LIMIT
from lwa4d_sim.record import ComputedPaths, RunLog, TickLog, ToolPoint, in_blocks

# Joint errors need the reference only this often; inverse kinematics at every plant step would cost more than the run.
_REFERENCE_PERIOD = 10_000_000  # [ns]


@dataclass(frozen=True, kw_only=True)
class RunInfo:
    """What a record says beside the signals."""

    name: str
    variant: str
    seed: int
    kinematics: ToolPoint
    trajectory: Trajectory
    tau_max: Array
    scenario: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Seen:
    """What the controllers saw and asked at the kept ticks, (N, kept, n)."""

    q: Array
    dq: Array
    tau: Array
    age: Array  # (N, kept) [ns]

    @staticmethod
    def blank(n_sims: int, kept: int, n: int) -> "_Seen":
        q, dq, tau = (np.full((n_sims, kept, n), np.nan) for _ in range(3))
        return _Seen(q, dq, tau, np.full((n_sims, kept), np.nan))

    @property
    def count(self) -> int:
        return int(self.q.shape[1])

    def take(self, tick: Tick, k: int) -> None:
        if tick.state is None or tick.command is None or tick.age is None:
            return
        self.q[:, k], self.dq[:, k], self.tau[:, k] = tick.state.q, tick.state.dq, tick.command
        self.age[:, k] = tick.age[:, 0] if tick.age.shape[1] == 1 else tick.age.max(axis=1)

    def log(self, i: int, q: Array, dq: Array, t: Array, trajectory: Trajectory, *, exact: bool) -> TickLog:
        """Of simulation ``i``, with the arm's own q and dq at the ticks; ``exact``: the controller saw just those."""
        kept = len(t)
        return TickLog(
            t=t,
            q=q if exact else self.q[i, :kept],
            dq=dq if exact else self.dq[i, :kept],
            tau=self.tau[i, :kept],
            age=np.where(np.isnan(self.q[i, :kept, 0]), np.nan, self.age[i, :kept] / NS_PER_S),
            q_true=q,
            dq_true=dq,
            q_ref=in_blocks(lambda block: trajectory.joint(block).q, t),
        )


def record(
    ticks: Iterator[Tick],
    infos: Sequence[RunInfo],
    timing: Timing,
    timestep: Ns,
    q0: Array,
    *,
    full_ticks: bool,
) -> list[RunLog]:
    """Run the loop to its end, or until every arm has diverged, and return a log per simulation.

    Args:
        ticks: the running loop.
        infos: one for each simulation.
        timing: instants of a period.
        timestep: plant step [ns].
        q0: start positions (N, n).
        full_ticks: keep what the controller saw at every tick; without it (the ideal loop, whose ticks are the plant
            steps) the plant's own signals stand for it.
    """
    n_sims, n = q0.shape
    per_tick = timing.period // timestep
    total = timing.ticks * per_tick + 1
    q, dq, tau = (np.zeros((n_sims, total, n)) for _ in range(3))
    q[:, 0] = q0
    stride = 1 if full_ticks else max(1, _REFERENCE_PERIOD // timing.period)
    seen = _Seen.blank(n_sims, -(-timing.ticks // stride), n)
    end = np.full(n_sims, total)
    running = np.ones(n_sims, bool)
    for tick in ticks:
        start = tick.k * per_tick
        q[:, start + 1 : start + 1 + per_tick] = tick.q
        dq[:, start + 1 : start + 1 + per_tick] = tick.dq
        tau[:, start : start + per_tick] = tick.tau
        if tick.k % stride == 0:
            seen.take(tick, tick.k // stride)
        if tick.lost is not None:
            end[tick.lost] = start + per_tick + 1
            running &= ~tick.lost
            if not running.any():
                break
    tau[:, -1] = tau[:, -2]
    logs = []
    for i, info in enumerate(infos):
        stop, diverged = _last_good(q[i], dq[i], int(end[i]), total, timestep)
        braked_steps = np.isnan(tau[i, :stop]).any(axis=1)
        events = _events(braked_steps, diverged, timestep)
        tau[i, :stop][braked_steps] = 0.0
        first, step = timing.phase // timestep, stride * per_tick
        at = slice(first, min(stop, first + step * seen.count), step)
        t = np.arange(at.start, at.stop, step) * (timestep / NS_PER_S)
        logs.append(
            RunLog(
                name=info.name,
                variant=info.variant,
                timestep=timestep,
                period=timing.period,
                q=q[i, :stop],
                dq=dq[i, :stop],
                tau=tau[i, :stop],
                ticks=seen.log(i, q[i, at], dq[i, at], t, info.trajectory, exact=not full_ticks),
                knots=info.trajectory.knots,
                tau_max=info.tau_max,
                seed=info.seed,
                diverged_at=diverged,
                events=events,
                scenario=info.scenario,
                versions=info.versions,
                paths=ComputedPaths(info.kinematics, info.trajectory),
            )
        )
    return logs


def _last_good(q: Array, dq: Array, end: int, total: int, timestep: Ns) -> tuple[int, float | None]:
    """Number of samples before the motion left all bounds, and that instant [s]."""
    if end == total and np.isfinite(dq[-1]).all() and np.abs(dq[-1]).max() < SPEED_LIMIT:
        return total, None
    with np.errstate(invalid="ignore"):
        bad = ~((np.abs(dq[:end]) < SPEED_LIMIT).all(axis=1) & np.isfinite(q[:end]).all(axis=1))
    first = int(np.argmax(bad)) if bad.any() else end - 1
    stop = max(first, 1)
    return stop, stop * timestep / NS_PER_S


def _events(braked: Any, diverged: float | None, timestep: Ns) -> tuple[tuple[float, str], ...]:
    changes = np.flatnonzero(np.diff(np.concatenate([[False], braked]).astype(np.int8)))
    texts = {True: "brakes closed", False: "brakes released"}
    events = [(k * timestep / NS_PER_S, texts[bool(braked[k])]) for k in changes.tolist()]
    if diverged is not None:
        events.append((diverged, "diverged"))
    return tuple(events)
