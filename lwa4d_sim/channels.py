"""One direction of the link in virtual time: latency, jitter, loss; a late item never replaces a newer one.

A channel is a queue keyed by arrival. "Nothing has arrived yet" is None for the whole channel and stamp -1 for a joint,
never a zero.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lwa4d_sim.delays import Latency, LatencyDraws, Loss, LossDraws
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import Array, Arrived, Channel, IntArray, NonNegative, Ns, to_ns


class DirectChannel:
    """The same constant latency for all: a plain queue."""

    def __init__(self, latency: Ns, gate: "Gate") -> None:
        self._latency, self._gate = latency, gate
        self._queue: deque[tuple[Ns, Ns, tuple[Array, ...]]] = deque()
        self._newest: Arrived | None = None

    def send(self, stamp: Ns, values: tuple[Array, ...]) -> None:
        self._queue.append((self._gate.opens(stamp + self._latency), stamp, values))

    def newest(self, now: Ns) -> Arrived | None:
        item = None
        while self._queue and self._queue[0][0] <= now:
            item = self._queue.popleft()
        if item is not None:
            # one instant for all: (1, 1) costs a tenth of the full shape
            stamp = np.array([[item[1]]])
            self._newest = Arrived(stamp, stamp if item[0] == item[1] else np.array([[item[0]]]), item[2])
        return self._newest

    def changes(self, after: Ns, before: Ns) -> list[Ns]:
        return sorted({arrival for arrival, _, _ in self._queue if after < arrival < before})


class RandomChannel:
    """Latency and loss drawn per sample, simulation and, if wanted, joint; order of arrival may differ from order sent.

    From the first `send` on, `newest` answers for every joint, so that a simulation does not depend on its neighbours.
    """

    def __init__(self, law: LatencyDraws, loss: LossDraws | None, gate: "Gate") -> None:
        self._law, self._loss, self._gate = law, loss, gate
        self._queue: deque[tuple[IntArray, Ns, tuple[Array, ...]]] = deque()
        self._newest: Arrived | None = None

    def send(self, stamp: Ns, values: tuple[Array, ...]) -> None:
        shape = values[0].shape
        arrival = self._gate.opens(stamp + np.broadcast_to(self._law.next(), shape))
        if self._loss is not None:
            arrival = np.where(self._loss.next(), np.iinfo(np.int64).max, arrival)
        self._queue.append((arrival, stamp, values))
        if self._newest is None:
            never = np.full(shape, -1, np.int64)
            self._newest = Arrived(never, never, tuple(np.full(shape, np.nan) for _ in values))

    def newest(self, now: Ns) -> Arrived | None:
        waiting: deque[tuple[IntArray, Ns, tuple[Array, ...]]] = deque()
        for arrival, stamp, values in self._queue:
            here = arrival <= now
            if here.any():
                self._take(here, arrival, stamp, values)
            left = np.where(here, np.iinfo(np.int64).max, arrival)
            if (left < np.iinfo(np.int64).max).any():
                waiting.append((left, stamp, values))
        self._queue = waiting
        return self._newest

    def _take(self, here: Any, arrival: IntArray, stamp: Ns, values: tuple[Array, ...]) -> None:
        assert self._newest is not None
        newer = here & (stamp > self._newest.stamp)
        self._newest = Arrived(
            np.where(newer, stamp, self._newest.stamp),
            np.where(newer, arrival, self._newest.since),
            tuple(np.where(newer, new, old) for new, old in zip(values, self._newest.values, strict=True)),
        )

    def changes(self, after: Ns, before: Ns) -> list[Ns]:
        found: set[int] = set()
        for arrival, _, _ in self._queue:
            found.update(arrival[(arrival > after) & (arrival < before)].tolist())
        return [Ns(t) for t in sorted(found)]


@dataclass(frozen=True, slots=True)
class Gate:
    """When what has arrived takes effect.

    Attributes:
        grid: arrivals are rounded up to this grid [ns] (the plant step).
        sync: period [ns] of the SYNC that latches arrivals, or 0 for at once. What arrives at the very instant of a
            SYNC has missed it and waits for the next.
    """

    grid: int
    sync: int = 0

    def opens(self, arrival: Any) -> Any:
        """Instant [ns] at which data arriving at ``arrival`` (number or array) acts."""
        if self.sync:
            return (arrival // self.sync + 1) * self.sync
        return -(-arrival // self.grid) * self.grid


@dataclass(frozen=True, kw_only=True)
class Transport:
    """Latency, jitter and loss of one direction.

    Attributes:
        latency: seconds for all joints, a list of seconds (one a joint), or a random law.
        jitter: width [s] of an extra latency drawn evenly from zero up, per sample and joint.
        loss: lost samples.
        per_joint: draws are made joint by joint, as each joint's frame on CAN fares by itself; else once a sample.
    """

    latency: Latency = 0.0
    jitter: NonNegative = 0.0
    loss: Loss = field(default_factory=Loss)
    per_joint: bool = False

    @property
    def usual_longest(self) -> float:
        """Longest latency [s] that is not an exception: the law's upper end, or the point 95 % or more stay below."""
        if isinstance(self.latency, (int, float)):
            base = float(self.latency)
        elif isinstance(self.latency, tuple):
            base = max(self.latency)
        else:
            base = self.latency.usual_longest
        return base + self.jitter

    def build(self, seeds: Sequence[int], signal: int, n: int, gate: Gate) -> Channel:
        """The channel of N simulations; ``signal`` tells this channel's random streams from all others.

        Raises:
            ScenarioError: a list of latencies is not one per joint.
        """
        if isinstance(self.latency, tuple) and len(self.latency) != n:
            raise ScenarioError(
                f"has {len(self.latency)} values; give one number or one for each of {n} joints", key="loop.latency"
            )
        if isinstance(self.latency, (int, float)) and not self.jitter and not self.loss.probability:
            return DirectChannel(to_ns(self.latency), gate)
        laws, losses = ([np.random.SeedSequence(seed, spawn_key=(signal, k)) for seed in seeds] for k in (0, 1))
        width = n if self.per_joint else 1
        draws = LossDraws(self.loss, width, losses) if self.loss.probability else None
        return RandomChannel(LatencyDraws(self.latency, self.jitter, width, laws), draws, gate)
