"""Desired motions inside a drive: pieces of constant acceleration, exact at every instant.

Profile moves, speed ramps, stops and the line between two interpolated set-points are all the same thing, a `Motion`.
It is a function of time and not a sum over steps, so it ends exactly where and when it should. Positions are in rad,
speeds in rad/s, accelerations in rad/s^2 and all positive; instants in ns.
"""

import math
from bisect import bisect_right
from typing import NamedTuple

from lwa4d_sim.interfaces import NS_PER_S, Ns


class Point(NamedTuple):
    """Where the reference is: position, speed and acceleration."""

    q: float
    dq: float
    ddq: float


class Motion:
    """A motion from ``start`` on; before it, it stands at its first point.

    Args:
        start: instant [ns] of the first piece.
        pieces: (length [s], speed at its start, acceleration) one after the other from ``q``.
        q: first position.
        last: the motion ends in this position and speed for good; by default where the pieces lead, at rest.

    Attributes:
        end: instant [ns] of the end, rounded up.
        last: the point at and after the end.
    """

    __slots__ = ("_begins", "_points", "end", "last", "start")

    def __init__(
        self, start: Ns, q: float, pieces: list[tuple[float, float, float]], last: tuple[float, float] | None = None
    ) -> None:
        self.start = start
        self._begins: list[float] = []
        self._points: list[Point] = []
        t = 0.0
        for length, dq, ddq in pieces:
            if length > 0:
                self._begins.append(t)
                self._points.append(Point(q, dq, ddq))
                t += length
                q += (dq + 0.5 * ddq * length) * length
        self.last = Point(q, 0.0, 0.0) if last is None else Point(last[0], last[1], 0.0)
        self._begins.append(t)
        self._points.append(self.last)
        # a motion too slow to end in any life (2^62 ns are 146 years) is not to overflow
        self.end = Ns(start + math.ceil(min(t * NS_PER_S, 2.0**62)))

    @property
    def duration(self) -> float:
        """From start to end [s]."""
        return self._begins[-1]

    def at(self, now: Ns) -> Point:
        """The reference at an instant."""
        if now >= self.end:
            q, dq, _ = last = self.last
            return last if dq == 0.0 else Point(q + dq * ((now - self.start) / NS_PER_S - self._begins[-1]), dq, 0.0)
        t = max(now - self.start, 0) / NS_PER_S
        begins = self._begins
        k = max(bisect_right(begins, t) - 1, 0)
        q, dq, ddq = self._points[k]
        t -= begins[k]
        return Point(q + (dq + 0.5 * ddq * t) * t, dq + ddq * t, ddq)


def rest(start: Ns, q: float) -> Motion:
    """Stand still."""
    return Motion(start, q, [])


def change_speed(start: Ns, at: Point, speed: float, acceleration: float, deceleration: float) -> Motion:
    """Ramp from the speed of ``at`` to ``speed`` (signed) and go on with it; through zero, it slows down first."""
    q, dq, _ = at
    pieces = []
    if dq * speed < 0 or abs(dq) > abs(speed):
        low = speed if dq * speed > 0 else 0.0
        length = abs(dq - low) / deceleration
        pieces.append((length, dq, math.copysign(deceleration, -dq)))
        q += 0.5 * (dq + low) * length
        dq = low
    length = abs(speed - dq) / acceleration
    pieces.append((length, dq, math.copysign(acceleration, speed - dq)))
    q += 0.5 * (dq + speed) * length
    return Motion(start, at.q, pieces, (q, speed))


def stop(start: Ns, at: Point, deceleration: float) -> Motion:
    """Ramp to rest."""
    return change_speed(start, at, 0.0, deceleration, deceleration)


def stopping_point(at: Point, deceleration: float) -> float:
    """Where a ramp to rest would end."""
    return at.q + 0.5 * at.dq * abs(at.dq) / deceleration


def move_to(start: Ns, at: Point, target: float, speed: float, acceleration: float, deceleration: float) -> Motion:
    """Trapezoidal move to rest at ``target`` from any speed, in least time within the limits.

    A start that leads past the target, or away from it, slows down to rest first. From rest over the distance D with
    v^2 (1/a + 1/d) / 2 <= D the move takes D/v + v/2a + v/2d, else it peaks at sqrt(2 D a d / (a + d)).
    """
    q, dq, _ = at
    pieces = []
    direction = math.copysign(1.0, target - stopping_point(at, deceleration))
    if dq * direction < 0:
        length = abs(dq) / deceleration
        pieces.append((length, dq, direction * deceleration))
        q += 0.5 * dq * length
        dq = 0.0
    v = abs(dq)
    distance = max(direction * (target - q), 0.0)
    fall = 0.5 * v * v
    peak = math.sqrt(2 * (distance + fall / acceleration) * acceleration * deceleration / (acceleration + deceleration))
    top = min(peak, speed)
    if v > speed:  # slow down to the limit
        first, rate = (v - speed) / deceleration, -deceleration
    else:
        first, rate = max(top - v, 0.0) / acceleration, acceleration
    pieces.append((first, dq, direction * rate))
    last = top / deceleration
    left = distance - 0.5 * (v + top) * first - 0.5 * top * last
    if peak > speed and left > 0:
        pieces.append((left / speed, direction * speed, 0.0))
    pieces.append((last, direction * top, -direction * deceleration))
    return Motion(start, at.q, pieces, (target, 0.0))


def line(start: Ns, q: float, target: float, period: Ns, *, beyond: bool) -> Motion:
    """Straight from ``q`` to ``target`` in one period, as interpolated positions are joined.

    With ``beyond`` it goes on at the same speed for one period more before it rests: one set-point may fail to come.
    """
    length = period / NS_PER_S
    dq = (target - q) / length
    if not beyond:
        return Motion(start, q, [(length, dq, 0.0)], (target, 0.0))
    return Motion(start, q, [(2 * length, dq, 0.0)], (2 * target - q, 0.0))
