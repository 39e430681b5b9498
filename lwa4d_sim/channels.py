"""One direction of the link in virtual time: latency, jitter, loss; a late item never replaces a newer one.

A channel is a queue keyed by arrival. "Nothing has arrived yet" is None for the whole channel and stamp -1 for a joint,
never a zero.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Ge, Lt, MinLen

from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import NS_PER_S, STRICT, Array, Arrived, Channel, IntArray, NonNegative, Ns, to_ns

_BLOCK = 256  # draws taken from a generator at a time; fixed, so that a run's bits do not depend on its length


@dataclass(frozen=True, kw_only=True)
class UniformLatency:
    """Latency drawn evenly between ``low`` and ``high`` [s], in whole multiples of ``step`` where that is given."""

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["uniform"] = "uniform"
    low: NonNegative = 0.0
    high: NonNegative
    step: NonNegative = 0.0

    def __post_init__(self) -> None:
        """Check the order of the bounds (ValueError)."""
        if self.high < self.low:
            raise ValueError(f"high (={self.high}) must not be below low (={self.low})")

    def draw(self, rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Latencies [s] of the given shape."""
        seconds = rng.uniform(self.low, self.high, shape)
        return np.rint(seconds / self.step) * self.step if self.step else seconds

    @property
    def usual_longest(self) -> float:
        """The upper end [s]."""
        return self.high


@dataclass(frozen=True, kw_only=True)
class NormalLatency:
    """Latency drawn from a normal law, cut off at zero [s]."""

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["normal"] = "normal"
    mean: NonNegative
    std: NonNegative

    def draw(self, rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Latencies [s] of the given shape."""
        return np.maximum(rng.normal(self.mean, self.std, shape), 0.0)

    @property
    def usual_longest(self) -> float:
        """Mean plus two standard deviations [s]: 97.7 % stay below."""
        return self.mean + 2.0 * self.std


@dataclass(frozen=True, kw_only=True)
class ExponentialLatency:
    """A fixed latency plus an exponential tail of the given mean [s]."""

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["exponential"] = "exponential"
    minimum: NonNegative = 0.0
    tail: NonNegative

    def draw(self, rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
        """Latencies [s] of the given shape."""
        return self.minimum + rng.exponential(self.tail, shape)

    @property
    def usual_longest(self) -> float:
        """Minimum plus three means of the tail [s]: 95 % stay below."""
        return self.minimum + 3.0 * self.tail


@dataclass(frozen=True, kw_only=True)
class TraceLatency:
    """Measured latencies replayed in order [s], from the start again when they run out; all joints alike."""

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["trace"] = "trace"
    values: Annotated[tuple[NonNegative, ...], MinLen(1)]

    @property
    def usual_longest(self) -> float:
        """The largest of the trace [s]."""
        return max(self.values)


RandomLaw = UniformLatency | NormalLatency | ExponentialLatency
# one number for all joints, one number a joint, or a law
Latency = NonNegative | Annotated[tuple[NonNegative, ...], MinLen(1)] | RandomLaw | TraceLatency


@dataclass(frozen=True, kw_only=True)
class Loss:
    """Lost samples, alone or in bursts (Gilbert-Elliott: in a burst everything is lost).

    Attributes:
        probability: long-run share of samples lost, 0 up to (not including) 1.
        mean_burst: mean number of samples lost in a row; 1 / (1 - probability) is independent loss, the default.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    probability: Annotated[float, Ge(0), Lt(1)] = 0.0
    mean_burst: Annotated[float, Ge(1)] | None = None

    def __post_init__(self) -> None:
        """Check that such bursts can have such a share (ValueError)."""
        if self.mean_burst is not None and self.probability > 0 and self.enter > 1.0:
            raise ValueError(f"mean_burst (={self.mean_burst}) is too short for probability (={self.probability})")

    @property
    def leave(self) -> float:
        """Probability that a burst ends at the next sample."""
        return 1.0 - self.probability if self.mean_burst is None else 1.0 / self.mean_burst

    @property
    def enter(self) -> float:
        """Probability that a burst begins at the next sample."""
        return self.leave * self.probability / (1.0 - self.probability)


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
            self._newest = Arrived(np.array([[item[1]]]), np.array([[item[0]]]), item[2])
        return self._newest

    def changes(self, after: Ns, before: Ns) -> list[Ns]:
        return sorted({arrival for arrival, _, _ in self._queue if after < arrival < before})


class RandomChannel:
    """Latency and loss drawn per sample, simulation and, if wanted, joint; order of arrival may differ from order sent.

    From the first `send` on, `newest` answers for every joint, so that a simulation does not depend on its neighbours.
    """

    def __init__(self, law: "LatencyDraws", loss: "LossDraws | None", gate: "Gate") -> None:
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


class LatencyDraws:
    """Latencies [ns] of successive samples: constant part plus law plus jitter, one generator a simulation."""

    def __init__(self, transport: "Transport", seeds: Sequence[np.random.SeedSequence], n: int) -> None:
        self._latency, self._jitter = transport.latency, transport.jitter
        self._shape = (_BLOCK, n if transport.per_joint else 1)
        self._generators = [np.random.default_rng(seed) for seed in seeds]
        self._index = 0
        self._block: IntArray = np.empty((0,), np.int64)

    def next(self) -> IntArray:
        """Latency of the next sample, (N, n) or broadcastable to it."""
        k = self._index % _BLOCK
        if k == 0:
            self._block = np.stack([self._draw(rng) for rng in self._generators], axis=1)
        self._index += 1
        latency: IntArray = self._block[k]
        return latency

    def _draw(self, rng: np.random.Generator) -> IntArray:
        if isinstance(self._latency, TraceLatency):
            trace = np.asarray(self._latency.values)
            seconds = trace[np.arange(self._index, self._index + _BLOCK) % len(trace), None]
        elif isinstance(self._latency, (float, int, tuple)):
            seconds = np.broadcast_to(np.asarray(self._latency, float), (_BLOCK, np.size(self._latency)))
        else:
            seconds = self._latency.draw(rng, self._shape)
        if self._jitter:
            seconds = seconds + rng.uniform(0.0, self._jitter, self._shape)
        drawn: IntArray = np.rint(seconds * NS_PER_S).astype(np.int64)
        return drawn


class LossDraws:
    """Which samples are lost, one generator a simulation."""

    def __init__(self, transport: "Transport", seeds: Sequence[np.random.SeedSequence], n: int) -> None:
        self._loss = transport.loss
        self._generators = [np.random.default_rng(seed) for seed in seeds]
        self._width = n if transport.per_joint else 1
        self._bad = np.zeros((len(seeds), self._width), bool)
        self._index = 0
        self._block: Array = np.empty((0,))

    def next(self) -> Any:
        """Mask of lost data (N, n) or (N, 1)."""
        k = self._index % _BLOCK
        if k == 0:
            self._block = np.stack([rng.random((_BLOCK, self._width)) for rng in self._generators], axis=1)
        self._index += 1
        u = self._block[k]
        self._bad = np.where(self._bad, u >= self._loss.leave, u < self._loss.enter)
        return self._bad


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
        draws = LossDraws(self, losses, n) if self.loss.probability else None
        return RandomChannel(LatencyDraws(self, laws, n), draws, gate)
