"""Which points a sweep visits: axes with their values or laws, and the designs that choose among them."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Ge, Le, MinLen

from lwa4d_sim.interfaces import STRICT, STRICT_BARE, Array, Positive

_Seed = Annotated[int, Ge(0)]
_Count = Annotated[int, Ge(1)]
_GridCount = Annotated[int, Ge(1), Le(1_000_000)]
# Quantiles of 0 and 1 of a normal law are infinite; this far from them is 7 standard deviations out (derived).
_EDGE = 1e-12
_DIGITS = 12  # values keep so many, so that a grid has 0.3 and not 0.30000000000000004


@dataclass(frozen=True, kw_only=True)
class RangeAxis:
    """Numbers between two ends: evenly spaced in a grid, evenly distributed in a random design.

    Attributes:
        law: uniform.
        from_, to: the ends; both belong to it.
        count: values in a grid.
        scale: linear, or log = evenly spaced in the logarithm.
        keys: scenario keys that the axis moves, each with a factor; default the key that it is named like.
    """

    __pydantic_config__: ClassVar[Any] = STRICT_BARE
    law: Literal["uniform"] = "uniform"
    from_: float
    to: float
    count: _GridCount | None = None
    scale: Literal["linear", "log"] = "linear"
    keys: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        """Check the ends (ValueError)."""
        if self.scale == "log" and min(self.from_, self.to) <= 0:
            raise ValueError("from and to must be above 0 on a log scale")
        if self.count == 1 and self.from_ != self.to:
            raise ValueError("count must be at least 2 where from and to differ")

    def at(self, u: Array) -> list[Any]:
        """Values at the shares ``u`` (K,) of the way from one end to the other."""
        if self.scale == "log":
            a, b = math.log(self.from_), math.log(self.to)
            return _short(np.where(u == 0, self.from_, np.where(u == 1, self.to, np.exp(a + u * (b - a)))))
        return _short(self.from_ + u * (self.to - self.from_))

    def grid(self) -> list[Any] | None:
        """All values, or None where it has no count."""
        return None if self.count is None else self.at(np.linspace(0.0, 1.0, self.count))


@dataclass(frozen=True, kw_only=True)
class NormalAxis:
    """Numbers by a normal law, cut off at the bounds where there are some; for random designs.

    Attributes:
        law: normal.
        mean, deviation: of the law before it is cut.
        min, max: bounds.
        keys: as of a range.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    law: Literal["normal"] = "normal"
    mean: float
    deviation: Positive
    min: float | None = None
    max: float | None = None
    keys: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        """Check the bounds (ValueError)."""
        if self.min is not None and self.max is not None and self.max <= self.min:
            raise ValueError(f"max (={self.max}) must be above min (={self.min})")

    def at(self, u: Array) -> list[Any]:
        """Quantiles ``u`` (K,)."""
        from scipy.special import ndtr, ndtri

        low, high = (None if b is None else (b - self.mean) / self.deviation for b in (self.min, self.max))
        a, b = 0.0 if low is None else ndtr(low), 1.0 if high is None else ndtr(high)
        values = self.mean + self.deviation * ndtri(np.clip(a + u * (b - a), _EDGE, 1.0 - _EDGE))
        ends = (-np.inf if self.min is None else self.min, np.inf if self.max is None else self.max)
        return _short(np.clip(values, *ends))

    def grid(self) -> list[Any] | None:
        """None: a law has no grid."""
        return None


@dataclass(frozen=True, kw_only=True)
class ValuesAxis:
    """A list of values of any kind; in a random design each is as likely as the others.

    Attributes:
        values: numbers, texts, lists or mappings.
        keys: as of a range; factors other than 1 need numbers.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    values: Annotated[tuple[Any, ...], MinLen(1)]
    keys: Mapping[str, float] | None = None

    def __post_init__(self) -> None:
        """Check that factors have something to multiply (ValueError)."""
        if any(factor != 1 for factor in (self.keys or {}).values()) and not all(map(_is_number, self.values)):
            raise ValueError("factors other than 1 need values that are numbers")

    def at(self, u: Array) -> list[Any]:
        """Values at the shares ``u`` (K,) of the list."""
        picks = np.minimum((u * len(self.values)).astype(int), len(self.values) - 1)
        return [self.values[k] for k in picks]

    def grid(self) -> list[Any] | None:
        """All values."""
        return list(self.values)


Axis = RangeAxis | NormalAxis | ValuesAxis


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Every combination of the axes' values; the last axis changes fastest."""

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["grid"] = "grid"

    def count(self, axes: Mapping[str, Axis]) -> int:
        """Number of points."""
        return math.prod(len(axis.grid() or ()) for axis in axes.values())

    def points(self, axes: Mapping[str, Axis], limit: int) -> Iterator[tuple[Any, ...]]:
        """The first ``limit`` points, in order."""
        columns = [axis.grid() or [] for axis in axes.values()]
        shape = [len(column) for column in columns]
        for k in range(min(limit, math.prod(shape))):
            # plain integers: a grid may have more points than an int64 can count
            at = []
            for size in reversed(shape):
                k, i = divmod(k, size)
                at.append(i)
            yield tuple(column[i] for column, i in zip(columns, reversed(at), strict=True))


@dataclass(frozen=True, kw_only=True)
class RandomDesign:
    """Points drawn independently.

    Attributes:
        kind: random.
        samples: number of points.
        seed: of the draws.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["random"] = "random"
    samples: _Count
    seed: _Seed = 0

    def count(self, axes: Mapping[str, Axis]) -> int:
        """Number of points."""
        return self.samples

    def points(self, axes: Mapping[str, Axis], limit: int) -> Iterator[tuple[Any, ...]]:
        """The first ``limit`` points, in order (fewer than all stand for a sample of a smaller design)."""
        return mapped(axes, self.shares(min(limit, self.samples), len(axes)))

    def shares(self, samples: int, dimensions: int) -> Array:
        """Points of the unit cube (samples, dimensions)."""
        return np.random.default_rng(self.seed).random((samples, dimensions))


@dataclass(frozen=True, kw_only=True)
class LatinHypercube(RandomDesign):
    """Points of which every axis has exactly one in each of `samples` equally likely stretches (McKay et al. 1979)."""

    kind: Literal["latin_hypercube"] = "latin_hypercube"  # type: ignore[assignment]

    def shares(self, samples: int, dimensions: int) -> Array:
        """Points of the unit cube (samples, dimensions)."""
        from scipy.stats import qmc

        points: Array = qmc.LatinHypercube(dimensions, rng=self.seed).random(samples)
        return points


@dataclass(frozen=True, kw_only=True)
class SobolDesign(RandomDesign):
    """Scrambled Sobol points (Owen 1998): `samples` is a power of two, for only then are they balanced."""

    kind: Literal["sobol"] = "sobol"  # type: ignore[assignment]

    def __post_init__(self) -> None:
        """Check the number of samples (ValueError)."""
        if self.samples & (self.samples - 1):
            lower = 1 << (self.samples.bit_length() - 1)
            raise ValueError(f"samples (={self.samples}) must be a power of 2; nearest: {lower} or {2 * lower}")

    def shares(self, samples: int, dimensions: int) -> Array:
        """Points of the unit cube (samples, dimensions)."""
        from scipy.stats import qmc

        points: Array = qmc.Sobol(dimensions, rng=self.seed).random_base2(max(0, (samples - 1).bit_length()))
        return points[:samples]


@dataclass(frozen=True, kw_only=True)
class WorstCase:
    """A search for the point with the worst outcome, by differential evolution (Storn and Price 1997).

    Attributes:
        kind: worst_case.
        objective: metric to be made as large as possible; of a list its largest entry counts. A run that is not stable
            is worse than any that is, the more so the sooner it shakes.
        evaluations: runs at most.
        seed: of the search.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["worst_case"] = "worst_case"
    objective: str = "max_error"
    evaluations: Annotated[int, Ge(8)] = 500
    seed: _Seed = 0

    def count(self, axes: Mapping[str, Axis]) -> int:
        """Runs at most."""
        return self.evaluations

    def points(self, axes: Mapping[str, Axis], limit: int) -> Iterator[tuple[Any, ...]]:
        """Some points of the region searched: its corners on the diagonal and its middle."""
        return mapped(axes, np.array([[0.5], [0.0], [1.0]])[:limit] * np.ones(len(axes)))


Design = Grid | RandomDesign | LatinHypercube | SobolDesign | WorstCase


def mapped(axes: Mapping[str, Axis], shares: Array) -> Iterator[tuple[Any, ...]]:
    """Points of the unit cube (K, axes) as axis values."""
    return zip(*(axis.at(u) for axis, u in zip(axes.values(), shares.T, strict=True)), strict=True)


def _short(values: Array) -> list[Any]:
    return [float(f"{value:.{_DIGITS}g}") for value in values.tolist()]


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
