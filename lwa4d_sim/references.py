"""The desired motion as the loop needs it: sampled in blocks of ticks, stacked over simulations."""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from lwa4d_sim.interfaces import NS_PER_S, Array, JointReference, Ns, TaskReference, Trajectory

_BLOCK = 512  # ticks sampled at a time: one vectorised call instead of many small ones, and bounded memory


class Remembered:
    """A trajectory that many runs share: every run asks for the same instants, and only the first waits for them."""

    def __init__(self, trajectory: Trajectory) -> None:
        self._trajectory = trajectory
        self._answers: dict[tuple[str, bytes], Any] = {}

    @property
    def duration(self) -> float:
        return self._trajectory.duration

    @property
    def knots(self) -> Array:
        return self._trajectory.knots

    def joint(self, t: Array) -> JointReference:
        motion: JointReference = self._ask("joint", t)
        return motion

    def task(self, t: Array) -> TaskReference:
        motion: TaskReference = self._ask("task", t)
        return motion

    def tool_point(self, t: Array) -> Array:
        point: Array = self._ask("tool_point", t)
        return point

    def _ask(self, what: str, t: Array) -> Any:
        key = (what, t.tobytes())
        if key not in self._answers:
            self._answers[key] = getattr(self._trajectory, what)(t)
        return self._answers[key]


class ReferenceBlocks:
    """References of N simulations at the instants of computation.

    Args:
        trajectories: one for each simulation, or a single one for all.
        space: joint or task.
        period: control period [ns].
        offsets: from tick to the instant the reference is taken [s]: one for each simulation, or a single one for all.
        ticks: number of ticks.
    """

    def __init__(
        self,
        trajectories: Sequence[Trajectory],
        space: Literal["joint", "task"],
        period: Ns,
        offsets: Sequence[float],
        ticks: int,
    ) -> None:
        rows = max(len(trajectories), len(offsets))
        self._motions = [(trajectories[k % len(trajectories)], offsets[k % len(offsets)]) for k in range(rows)]
        self._space = space
        self._period, self._ticks = period / NS_PER_S, ticks
        self._type: Any = JointReference if space == "joint" else TaskReference
        self._start = -_BLOCK
        self._block: list[Any] = []

    def at(self, k: int) -> Any:
        """Reference of tick ``k``; fields have leading axis N, or 1 when all simulations share the motion."""
        i = k - self._start
        if not 0 <= i < _BLOCK:
            self._sample(k)
            i = 0
        return self._block[i]

    def _sample(self, k: int) -> None:
        t = np.arange(k, min(k + _BLOCK, self._ticks)) * self._period
        sampled = [
            trajectory.joint(t + offset) if self._space == "joint" else trajectory.task(t + offset)
            for trajectory, offset in self._motions
        ]
        self._start = k
        columns = [
            [None] * len(t) if part[0] is None else np.stack(part, axis=1) for part in zip(*sampled, strict=True)
        ]
        self._block = [self._type(*row) for row in zip(*columns, strict=True)]
