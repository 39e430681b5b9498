"""Designs of sweeps: how many points, which, and what laws they follow."""

import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from lwa4d_sim.sweep.design import (
    Axis,
    Grid,
    LatinHypercube,
    NormalAxis,
    RandomDesign,
    RangeAxis,
    SobolDesign,
    ValuesAxis,
)
from lwa4d_sim.sweep.statistics import wilson

counts = st.integers(1, 6)


@given(st.lists(counts, min_size=1, max_size=4))
def test_a_grid_is_the_product_of_its_axes(sizes: list[int]) -> None:
    axes: dict[str, Axis] = {
        f"a{k}": RangeAxis(from_=0, to=size - 1, count=size) if size > 1 else ValuesAxis(values=("only",))
        for k, size in enumerate(sizes)
    }
    points = list(Grid().points(axes, 10**6))
    values = [[float(k) for k in range(size)] if size > 1 else ["only"] for size in sizes]
    assert points == list(itertools.product(*values))
    assert Grid().count(axes) == math.prod(sizes) == len(points)
    assert list(Grid().points(axes, 3)) == points[:3]


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.integers(2, 50))
def test_a_range_has_its_ends_and_even_steps(a: float, b: float, count: int) -> None:
    values = RangeAxis(from_=a, to=b, count=count).grid()
    assert values is not None
    np.testing.assert_allclose(values, np.linspace(a, b, count), rtol=1e-11, atol=1e-11 * max(abs(a), abs(b)))
    assert len(values) == count


def test_values_of_a_grid_are_as_people_write_them() -> None:
    assert RangeAxis(from_=0, to=0.01, count=11).grid() == [k / 1000 for k in range(11)]
    assert RangeAxis(from_=0.001, to=1000, count=7, scale="log").grid() == [0.001, 0.01, 0.1, 1.0, 10.0, 100.0, 1000.0]


def test_a_grid_too_large_to_hold_is_counted_and_begun() -> None:
    axes: dict[str, Axis] = {f"a{k}": RangeAxis(from_=0, to=1, count=100_000) for k in range(5)}
    assert Grid().count(axes) == 10**25
    assert len(list(Grid().points(axes, 5))) == 5


AXES: dict[str, Axis] = {
    "even": RangeAxis(from_=-1, to=3),
    "log": RangeAxis(from_=1e-3, to=10, scale="log"),
    "normal": NormalAxis(mean=2, deviation=0.5),
    "cut": NormalAxis(mean=0, deviation=1, min=-0.5, max=2),
    "choice": ValuesAxis(values=("a", "b", "c", "d")),
}


def quantiles(points: list[tuple[Any, ...]]) -> dict[str, Any]:
    """Each axis's points by scipy's own distribution functions, in [0, 1]."""
    even, log, normal, cut, choice = (np.array(column) for column in zip(*points, strict=True))
    return {
        "even": stats.uniform(-1, 4).cdf(even),
        "log": stats.loguniform(1e-3, 10).cdf(log),
        "normal": stats.norm(2, 0.5).cdf(normal),
        "cut": stats.truncnorm(-0.5, 2).cdf(cut),
        "choice": choice,
    }


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32), st.integers(3, 8))
def test_each_axis_of_a_latin_hypercube_has_one_point_in_each_stretch(seed: int, power: int) -> None:
    samples = 2**power + 4 * (power % 2)
    shares = quantiles(list(LatinHypercube(samples=samples, seed=seed).points(AXES, samples)))
    for name in ("even", "log", "normal", "cut"):
        stretch = np.floor(shares[name] * samples + 1e-6).astype(int)
        assert len(set(np.minimum(stretch, samples - 1).tolist())) >= samples - 1, (
            name
        )  # one may be rounded over an edge
    assert np.ptp(np.unique(shares["choice"], return_counts=True)[1]) <= 1


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32), st.integers(3, 9))
def test_sobol_points_are_balanced_in_every_elementary_stretch(seed: int, power: int) -> None:
    samples = 2**power
    shares = SobolDesign(samples=samples, seed=seed).shares(samples, 2)
    for split in range(power + 1):  # any box of sides 2^-a by 2^-(power - a) holds one point, in two dimensions
        boxes = np.floor(shares * [2**split, 2 ** (power - split)]).astype(int)
        assert len({tuple(box) for box in boxes.tolist()}) == samples


@pytest.mark.parametrize("kind", [RandomDesign, LatinHypercube, SobolDesign])
def test_the_seed_decides_the_points(kind: type[RandomDesign]) -> None:
    first = list(kind(samples=64, seed=3).points(AXES, 64))
    assert first == list(kind(samples=64, seed=3).points(AXES, 64))
    assert first != list(kind(samples=64, seed=4).points(AXES, 64))
    assert len(set(first)) == 64


def test_random_points_follow_their_laws() -> None:
    shares = quantiles(list(RandomDesign(samples=4000, seed=1).points(AXES, 4000)))
    for name in ("even", "log", "normal", "cut"):
        assert stats.kstest(shares[name], "uniform").pvalue > 1e-3, name
    assert stats.chisquare(np.unique(shares["choice"], return_counts=True)[1]).pvalue > 1e-3


def test_a_cut_law_keeps_to_its_bounds() -> None:
    axis = NormalAxis(mean=0, deviation=1, min=4, max=5)  # far out in the tail
    values = axis.at(np.linspace(0, 1, 101))
    assert min(values) >= 4
    assert max(values) <= 5
    assert values == sorted(values)
    assert all(map(math.isfinite, NormalAxis(mean=0, deviation=1).at(np.array([0.0, 1.0]))))


@given(st.integers(0, 300), st.integers(1, 300))
def test_the_interval_is_wilsons(passed: int, runs: int) -> None:
    passed = min(passed, runs)
    expected = stats.binomtest(passed, runs).proportion_ci(0.95, "wilson")
    assert wilson(passed, runs) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_of_no_runs_nothing_is_known() -> None:
    assert wilson(0, 0) == (0.0, 1.0)
