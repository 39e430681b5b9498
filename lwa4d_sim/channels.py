"""One direction of the link in virtual time: latency, jitter, loss; a late item never replaces a newer one.

A channel is a queue keyed by arrival. "Nothing has arrived yet" is None for the whole channel and stamp -1 for a joint,
never a zero.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from heapq import heappop, heappush
from typing import Any

import numpy as np

from lwa4d_sim.delays import Latency, LatencyDraws, LatencyStream, Loss, LossDraws, LossStream
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


class StaggeredChannel:
    """A constant latency for each simulation: one queue, from which each takes in its own time.

    From the first `send` on, `newest` answers for every joint, so that a simulation does not depend on its neighbours.
    """

    def __init__(self, latencies: Sequence[Ns], gate: "Gate") -> None:
        each = np.asarray(latencies)
        self._groups = [(int(latency), np.flatnonzero(each == latency)) for latency in np.unique(each)]
        self._gate = gate
        self._queue: list[tuple[int, Ns, int, tuple[Array, ...]]] = []  # a heap: by arrival, then by stamp
        self._newest: Arrived | None = None

    def send(self, stamp: Ns, values: tuple[Array, ...]) -> None:
        for k, (latency, _) in enumerate(self._groups):
            # the group's number keeps the heap from comparing arrays
            heappush(self._queue, (self._gate.opens(stamp + latency), stamp, k, values))
        if self._newest is None:
            never = np.full((len(values[0]), 1), -1, np.int64)
            self._newest = Arrived(never, never, tuple(np.full_like(value, np.nan) for value in values))

    def newest(self, now: Ns) -> Arrived | None:
        if not self._queue or self._queue[0][0] > now:
            return self._newest
        assert self._newest is not None
        stamps, since = self._newest.stamp.copy(), self._newest.since.copy()
        rows = [value.copy() for value in self._newest.values]
        while self._queue and self._queue[0][0] <= now:
            arrival, stamp, k, values = heappop(self._queue)
            members = self._groups[k][1]
            stamps[members], since[members] = stamp, arrival
            for row, value in zip(rows, values, strict=True):
                row[members] = value[members]
        self._newest = Arrived(stamps, since, tuple(rows))
        return self._newest

    def changes(self, after: Ns, before: Ns) -> list[Ns]:
        return sorted({Ns(item[0]) for item in self._queue if after < item[0] < before})


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

    @property
    def constant(self) -> Ns | None:
        """The latency where it is one constant for all joints and nothing is lost, else None."""
        plain = isinstance(self.latency, (int, float)) and not self.jitter and not self.loss.probability
        return to_ns(self.latency) if plain and isinstance(self.latency, (int, float)) else None


def build_channel(transports: Sequence[Transport], seeds: Sequence[int], signal: int, n: int, gate: Gate) -> Channel:
    """The channel of N simulations, one transport and one seed each.

    Args:
        transports: of each simulation.
        seeds: of each simulation.
        signal: tells this channel's random streams from all others.
        n: number of joints.
        gate: when arrivals take effect.

    Raises:
        ScenarioError: a list of latencies is not one per joint.
    """
    for transport in transports:
        if isinstance(transport.latency, tuple) and len(transport.latency) != n:
            raise ScenarioError(
                f"has {len(transport.latency)} values; give one number or one for each of {n} joints",
                key="loop.latency",
            )
    constants = [transport.constant for transport in transports]
    known = [latency for latency in constants if latency is not None]
    if len(known) == len(constants):
        return DirectChannel(known[0], gate) if len(set(known)) == 1 else StaggeredChannel(known, gate)
    laws, losses = ([np.random.SeedSequence(seed, spawn_key=(signal, k)) for seed in seeds] for k in (0, 1))
    widths = [n if transport.per_joint else 1 for transport in transports]
    latencies = [
        LatencyStream(transport.latency, transport.jitter, width, seed)
        for transport, width, seed in zip(transports, widths, laws, strict=True)
    ]
    drops = None
    if any(transport.loss.probability for transport in transports):
        drops = LossDraws(
            [
                LossStream(transport.loss, width, seed)
                for transport, width, seed in zip(transports, widths, losses, strict=True)
            ]
        )
    return RandomChannel(LatencyDraws(latencies), drops, gate)
