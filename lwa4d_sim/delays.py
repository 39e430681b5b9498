"""Laws of latency and loss, and the numbers drawn from them: one generator a simulation, so that runs do not mix."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Ge, Lt, MinLen

from lwa4d_sim.interfaces import NS_PER_S, STRICT, Array, IntArray, NonNegative

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


@dataclass(frozen=True, slots=True)
class LatencyStream:
    """What one simulation's latencies are drawn from: constant part or law, jitter, seed.

    Attributes:
        latency, jitter: as of a `Transport`.
        width: draws a sample: one, or one a joint.
        seed: of its generator.
    """

    latency: Latency
    jitter: float
    width: int
    seed: np.random.SeedSequence


class LatencyDraws:
    """Latencies [ns] of successive samples: constant part plus law plus jitter, one generator a simulation."""

    def __init__(self, streams: Sequence[LatencyStream]) -> None:
        self._streams = [(stream, np.random.default_rng(stream.seed)) for stream in streams]
        self._index = 0
        self._block: IntArray = np.empty((0,), np.int64)

    def next(self) -> IntArray:
        """Latency of the next sample, (N, n) or broadcastable to it."""
        k = self._index % _BLOCK
        if k == 0:
            drawn = [self._draw(stream, rng) for stream, rng in self._streams]
            width = max(block.shape[1] for block in drawn)
            self._block = np.stack([np.broadcast_to(block, (_BLOCK, width)) for block in drawn], axis=1)
        self._index += 1
        latency: IntArray = self._block[k]
        return latency

    def _draw(self, stream: LatencyStream, rng: np.random.Generator) -> IntArray:
        latency, shape = stream.latency, (_BLOCK, stream.width)
        if isinstance(latency, TraceLatency):
            trace = np.asarray(latency.values)
            seconds = trace[np.arange(self._index, self._index + _BLOCK) % len(trace), None]
        elif isinstance(latency, (float, int, tuple)):
            seconds = np.broadcast_to(np.asarray(latency, float), (_BLOCK, np.size(latency)))
        else:
            seconds = latency.draw(rng, shape)
        if stream.jitter:
            seconds = seconds + rng.uniform(0.0, stream.jitter, shape)
        drawn: IntArray = np.rint(seconds * NS_PER_S).astype(np.int64)
        return drawn


@dataclass(frozen=True, slots=True)
class LossStream:
    """What decides which of one simulation's samples are lost: law, draws a sample (one, or one a joint), seed."""

    loss: Loss
    width: int
    seed: np.random.SeedSequence


class LossDraws:
    """Which samples are lost, one generator a simulation."""

    def __init__(self, streams: Sequence[LossStream]) -> None:
        self._widths = [stream.width for stream in streams]
        self._generators = [np.random.default_rng(stream.seed) for stream in streams]
        self._leave, self._enter = (
            np.array([[getattr(stream.loss, name)] for stream in streams]) for name in ("leave", "enter")
        )
        self._bad = np.zeros((len(streams), max(self._widths)), bool)
        self._index = 0
        self._block: Array = np.empty((0,))

    def next(self) -> Any:
        """Mask of lost data (N, n) or (N, 1)."""
        k = self._index % _BLOCK
        if k == 0:
            shape = (_BLOCK, self._bad.shape[1])
            drawn = [rng.random((_BLOCK, width)) for rng, width in zip(self._generators, self._widths, strict=True)]
            self._block = np.stack([np.broadcast_to(block, shape) for block in drawn], axis=1)
        self._index += 1
        u = self._block[k]
        self._bad = np.where(self._bad, u >= self._leave, u < self._enter)
        return self._bad
