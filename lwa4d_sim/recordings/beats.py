"""The even beat behind the time stamps of SYNC frames, and what happened in each of its cycles."""

from dataclasses import dataclass

import numpy as np

from lwa4d_sim.interfaces import Array, IntArray
from lwa4d_sim.recordings.pdo_log import Trace

PAUSE = 10.0  # periods without a beat, after which the count begins anew (assumed)
SKIPPED = 1.5  # periods from one beat to the next, from which on one is missing between them
MAD = 1.4826  # standard deviation of a normal law over its median absolute deviation
TRACK = (
    0.1  # share of a deviation, itself limited to this share of a period, by which the expected beat follows (assumed)
)
LEAST = 1e-7  # [s]; stamps written as floating point since 1970 are no finer


@dataclass(frozen=True, slots=True)
class Beat:
    """Cycles of a log.

    Attributes:
        count: number of each beat (m,), from 0; a missing one leaves a number out.
        t: instants of all numbers (count[-1] + 1,) [s].
        period: [s].
        spread: standard deviation of the stamps about the even beat [s].
        worst: largest deviation [s].
        even: the instants are the even beat's; else the stamps themselves.
    """

    count: IntArray
    t: Array
    period: float
    spread: float
    worst: float
    even: bool


def even_beat(stamps: Array) -> Beat:
    """A straight line through time stamps (m,) over their count, m >= 2.

    The line is fitted with a soft L1 loss, which a few late stamps do not move. Where the stamps stray further from the
    line than each does from the one before, it is the clock of the beat that wanders, not the stamps: they stay then.
    """
    from scipy.optimize import least_squares

    steps = np.diff(stamps)
    period = float(np.median(steps))
    count = _count(stamps, period)
    grid = np.arange(count[-1] + 1)
    k, t = count - count.mean(), stamps - stamps.mean()
    start = np.polyfit(k, t, 1) if len(k) > 1 else np.array([period, 0.0])
    scale = max(_spread(t - np.polyval(start, k)), LEAST)

    def stray(p: Array) -> Array:
        scaled: Array = (t - p[0] * k - p[1]) / scale
        return scaled

    slope, offset = least_squares(stray, start, loss="soft_l1", x_scale="jac").x
    residual = t - slope * k - offset
    spread, shake = _spread(residual), _spread(steps - slope * np.diff(count))
    even = bool(spread <= max(shake, LEAST))
    line = stamps.mean() + slope * (grid - count.mean()) + offset
    instants = line if even else np.interp(grid, count, stamps)
    return Beat(count, instants, float(slope), spread, float(np.abs(residual).max()), even)


def _count(stamps: Array, period: float) -> IntArray:
    """Number of the beat that each stamp (m,) belongs to; a stamp may be late, even by periods, but hardly early."""
    found, expected = [0], float(stamps[0])
    for stamp in stamps[1:].tolist():
        passed = round((stamp - expected) / period)
        found.append(found[-1] + passed)
        expected += passed * period
        expected += TRACK * min(max(stamp - expected, -TRACK * period), TRACK * period)
    # no two stamps have one number: what came behind others that were late was late itself
    latest = np.array(found) - np.arange(len(found))
    count: IntArray = np.minimum.accumulate(latest[::-1])[::-1] + np.arange(len(found))
    return count - int(count[0])


def _spread(x: Array) -> float:
    return MAD * float(np.median(np.abs(x - np.median(x))))


@dataclass(frozen=True, slots=True)
class InCycles:
    """A trace by cycles; NaN where a cycle has no value.

    Attributes:
        values: raw (m,).
        stamps: of the frames (m,) [s].
        synchronous: every frame was (`lwa4d_sim.recordings.pdo_log.Pdo`).
        crowded: frames for which a cycle had no room.
    """

    values: Array
    stamps: Array
    synchronous: bool
    crowded: int


def in_cycles(trace: Trace, first: int, last: int) -> InCycles:
    """What a trace holds in the cycles from ``first`` up to, not including, ``last``.

    Of several frames in a cycle the last counts, as it does for a drive; but the first of two belongs to the cycle
    before if that has none: it was late.
    """
    cells, stamps = np.array(trace.beats, np.int64) - 1, np.array(trace.stamps)
    here = np.flatnonzero((cells >= first) & (cells < last))
    values, at = np.full(last - first, np.nan), np.full(last - first, np.nan)
    crowded = 0
    for i in here.tolist():
        c = int(cells[i]) - first
        if not np.isnan(values[c]):
            if c and np.isnan(values[c - 1]):
                values[c - 1], at[c - 1] = values[c], at[c]
            else:
                crowded += 1
        values[c], at[c] = trace.values[i], stamps[i]
    kinds = [trace.synchronous[i] for i in here.tolist()]
    return InCycles(values, at, all(kinds), crowded)


def held(command: InCycles, beats: Array, period: float, *, next_sync: bool) -> tuple[Array, Array]:
    """Command that acts from each beat on, or from its own arrival, until the next one does.

    Args:
        command: as it came.
        beats: stamps (m,) [s].
        period: usual distance of two [s].
        next_sync: a command acts at the beat after it; else when it comes.

    Returns:
        Raw values (m,), NaN where none is known, as after a beat that the log lacks; and the instants of those that
        came between beats (m,) [s], NaN for those that act from the beat on.
    """
    acting, since = np.full(len(beats), np.nan), np.full(len(beats), np.nan)
    now = np.nan
    for i, start in enumerate(beats.tolist()):
        skipped = i > 0 and start - beats[i - 1] > SKIPPED * period
        if next_sync:
            if i and not np.isnan(command.values[i - 1]):
                now = command.values[i - 1]
                skipped &= bool(start - command.stamps[i - 1] > SKIPPED * period)
            now = np.nan if skipped else now
        elif not np.isnan(command.values[i]):
            now, since[i] = command.values[i], command.stamps[i]
        elif skipped:
            now = np.nan
        acting[i] = now
    return acting, since
