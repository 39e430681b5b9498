"""Margins of sampled loops: spectral radius, critical gain, extra latency, and the mode that goes unstable."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from lwa4d_sim.interfaces import Array, IntArray

# Factors on the gains that are looked at: a window of stability or instability narrower than the step is missed.
_GAIN_STEP, _GAIN_RANGE = 1.1, 1e4  # assumed: finer than any trial by hand; a loop that bears 1e4 has no limit
_STILL = 1e-12  # [-] beyond 1 that a spectral radius may be by rounding
_TURNS = 60  # bisections and more leave nothing to do


Radius = Callable[[IntArray, Array], Array]
LateRadius = Callable[[IntArray, float], Array]


class Mode(NamedTuple):
    """The oscillation of a loop's largest eigenvalue.

    Attributes:
        frequency: [Hz].
        share: of each joint, largest 1, (n,).
        radius: modulus of the eigenvalue.
    """

    frequency: float
    share: Array
    radius: float


def spectral_radius(matrices: Array) -> Array:
    """Largest modulus of an eigenvalue of each matrix (P, m, m); inf where a matrix is not finite."""
    finite = np.isfinite(matrices).all(axis=(1, 2))
    radius = np.full(len(matrices), np.inf)
    if finite.any():
        radius[finite] = np.abs(np.linalg.eigvals(matrices[finite])).max(axis=1)
    return radius


def gain_margin(radius: Radius, points: int) -> Array:
    """Factor (P,) on all gains at which each loop becomes unstable, inf if there is none.

    For a stable loop the smallest factor above 1. For one that is unstable the largest below 1 that makes it stable, or
    where none does the smallest above 1 that does (gravity compensation of a late q needs gains that outweigh it), or
    0 where no gains help.

    Args:
        radius: spectral radii of some of the loops, given their rows and a factor for each.
        points: number of loops P.
    """
    everyone = np.arange(points)
    start = _log(radius(everyone, np.ones(points)))
    margin = np.empty(points)
    for rows, step, none in (
        (everyone[start <= _STILL], _GAIN_STEP, np.inf),
        (everyone[start > _STILL], 1.0 / _GAIN_STEP, 0.0),
    ):
        margin[rows] = _crossing(radius, rows, start[rows], step, none)
    weak = everyone[margin == 0.0]
    margin[weak] = _crossing(radius, weak, start[weak], _GAIN_STEP, 0.0)
    return margin


def _crossing(radius: Radius, rows: IntArray, value: Array, step: float, none: float) -> Array:
    """First factor from 1 on, in steps of ``step``, at which each loop changes its stability; else ``none``."""
    edge = np.full(len(rows), none)
    low, high = np.zeros(len(rows)), np.zeros(len(rows))  # natural logarithms of factors
    at_low, at_high = value.copy(), value.copy()
    here, unstable = np.arange(len(rows)), value > _STILL
    for i in range(1, round(np.log(_GAIN_RANGE) / abs(np.log(step))) + 1):
        if not here.size:
            break
        factor = np.full(len(here), i * np.log(step))
        now = _log(radius(rows[here], np.exp(factor)))
        changed = (now > _STILL) != unstable[here]
        high[here[changed]], at_high[here[changed]] = factor[changed], now[changed]
        low[here[~changed]], at_low[here[~changed]] = factor[~changed], now[~changed]
        here = here[~changed]
    found = np.setdiff1d(np.arange(len(rows)), here)
    if found.size:
        asked = rows[found]
        ends = low[found], high[found], at_low[found], at_high[found]
        edge[found] = np.exp(root(lambda x: _log(radius(asked, np.exp(x))), *ends, 1e-10))
    return edge


def _log(radius: Array) -> Array:
    """Zero at the edge of stability, and near enough to a straight line for a quick search."""
    value: Array = np.log(np.clip(radius, 1e-300, 1e300))
    return value


def root(f: Callable[[Array], Array], a: Array, b: Array, fa: Array, fb: Array, tolerance: float) -> Array:
    """Where ``f`` changes sign between ``a`` and ``b``, all (P,), to ``tolerance``; false position, Illinois rule.

    One call of ``f`` serves all; where false position is slow, bisection takes turns (Dowell and Jarratt 1971).
    """
    a, b, fa, fb = a.copy(), b.copy(), fa.copy(), fb.copy()
    for turn in range(_TURNS):
        if np.abs(b - a).max() < tolerance:
            break
        with np.errstate(invalid="ignore", divide="ignore"):
            c = b - fb * (b - a) / (fb - fa)
        inside = (c > np.minimum(a, b)) & (c < np.maximum(a, b))
        c = np.where(inside & (turn % 4 != 3), c, 0.5 * (a + b))
        fc = f(c)
        crossed = (fc > 0) != (fb > 0)
        a, fa = np.where(crossed, b, a), np.where(crossed, fb, 0.5 * fa)
        b, fb = c, fc
        if np.abs(fb).max() < 1e-15:
            break
    return b


def delay_margin(radius: LateRadius, points: int, period: float, longest: float) -> Array:
    """Extra latency (P,) [s] of the commands at which each loop becomes unstable; inf beyond ``longest``, 0 if it is.

    Args:
        radius: spectral radii of some of the loops, given their rows and the extra latency [s].
        points: number of loops P.
        period: control period [s]; the search goes in quarters of it.
        longest: [s] where to give up.
    """
    margin = np.where(radius(np.arange(points), 0.0) <= 1.0 + _STILL, np.inf, 0.0)
    low = 0.0
    for i in range(1, round(4 * longest / period) + 1):
        waiting = np.flatnonzero(np.isinf(margin))
        if not waiting.size:
            break
        high = 0.25 * i * period
        for row in waiting[radius(waiting, high) > 1.0 + _STILL]:
            margin[row] = _bisect(radius, np.array([row]), low, high)
        low = high
    return margin


def _bisect(radius: LateRadius, row: IntArray, low: float, high: float) -> float:
    """A jump (at a SYNC missed) is found like a crossing."""
    while high - low > 1e-9:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if radius(row, middle)[0] <= 1.0 + _STILL else (low, middle)
    return low


def leading_mode(matrix: Array, n: int, period: float) -> Mode:
    """The mode of the largest eigenvalue of one loop's matrix (m, m), whose first ``n`` states are the joint angles."""
    values, vectors = np.linalg.eig(matrix)
    worst = int(np.argmax(np.abs(values)))
    share = np.abs(vectors[:n, worst])
    largest = float(share.max())
    return Mode(
        frequency=abs(float(np.angle(values[worst]))) / (2.0 * np.pi * period),
        share=share / largest if largest > 0 else share,
        radius=float(np.abs(values[worst])),
    )
