"""Motions inside a drive against the closed forms of school physics, and against a sum over small steps."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lwa4d_sim.bus.motion import Motion, Point, change_speed, line, move_to, rest, stop, stopping_point
from lwa4d_sim.interfaces import Ns, to_ns

POSITIONS = st.floats(-6, 6)
SPEEDS = st.floats(-2, 2)
LIMITS = st.floats(0.05, 3)
RATES = st.floats(0.2, 20)
T0 = Ns(-1_234_567)  # any start, even before zero


def points(motion: Motion, count: int = 400) -> list[tuple[float, Point]]:
    end = motion.end - motion.start
    instants = [motion.start + end * k // count for k in range(count + 1)]
    return [((t - motion.start) / 1e9, motion.at(Ns(t))) for t in instants]


@pytest.mark.parametrize(
    ("distance", "v", "a", "d"),
    [(2.0, 0.5, 1.0, 1.0), (-2.0, 0.5, 1.0, 2.0), (0.05, 0.5, 1.0, 1.0), (0.05, 0.5, 4.0, 1.0), (-1e-5, 0.5, 1.0, 1.0)],
)
def test_a_trapezoid_lasts_what_its_area_says(distance: float, v: float, a: float, d: float) -> None:
    motion = move_to(T0, Point(1.0, 0.0, 0.0), 1.0 + distance, v, a, d)
    size = abs(distance)
    if v * v * (1 / a + 1 / d) / 2 <= size:
        expected = size / v + v / (2 * a) + v / (2 * d)
    else:
        expected = math.sqrt(2 * size * (a + d) / (a * d))
    assert motion.duration == pytest.approx(expected, rel=1e-12)
    assert motion.at(motion.end) == Point(1.0 + distance, 0.0, 0.0)
    assert motion.at(Ns(motion.end + 10**12)).q == 1.0 + distance
    # the same number as an instant, rounded up
    assert 0 <= (motion.end - motion.start) / 1e9 - expected < 2e-9


@given(q=POSITIONS, dq=SPEEDS, target=POSITIONS, v=LIMITS, a=RATES, d=RATES)
def test_a_move_keeps_its_limits_and_is_one_curve(
    q: float, dq: float, target: float, v: float, a: float, d: float
) -> None:
    motion = move_to(T0, Point(q, dq, 0.0), target, v, a, d)
    samples = points(motion)
    assert samples[0][1].q == pytest.approx(q, abs=1e-9)
    assert motion.at(motion.end) == Point(target, 0.0, 0.0)
    for (t0, before), (t1, after) in pairwise(samples):
        assert abs(after.dq) <= max(v, abs(dq)) + 1e-9
        assert -1e-9 <= max(abs(after.ddq), abs(before.ddq)) <= max(a, d) + 1e-9
        # position is the integral of speed, and speed of acceleration: neither jumps
        assert abs(after.dq - before.dq) <= max(a, d) * (t1 - t0) * 1.000001 + 1e-8
        swing = max(a, d) * (t1 - t0) ** 2
        assert abs(after.q - before.q - (after.dq + before.dq) / 2 * (t1 - t0)) <= swing + 1e-8


@given(q=POSITIONS, dq=SPEEDS, target=POSITIONS, v=LIMITS, a=RATES, d=RATES)
def test_a_move_that_can_go_straight_never_turns_round(
    q: float, dq: float, target: float, v: float, a: float, d: float
) -> None:
    at = Point(q, dq, 0.0)
    motion = move_to(T0, at, target, v, a, d)
    straight = (target - stopping_point(at, d)) * dq >= 0
    signs = {math.copysign(1, p.dq) for _, p in points(motion) if abs(p.dq) > 1e-6}
    assert len(signs) <= (1 if straight else 2)


@given(q=POSITIONS, dq=SPEEDS, speed=SPEEDS, a=RATES, d=RATES)
def test_a_speed_ramp_takes_the_time_of_its_two_rates(q: float, dq: float, speed: float, a: float, d: float) -> None:
    motion = change_speed(T0, Point(q, dq, 0.0), speed, a, d)
    straight = abs(speed - dq) / (a if abs(speed) > abs(dq) else d)
    expected = abs(dq) / d + abs(speed) / a if dq * speed < 0 else straight
    assert motion.duration == pytest.approx(expected, rel=1e-9, abs=1e-12)
    end = motion.at(motion.end)
    assert end.dq == pytest.approx(speed)
    later = motion.at(Ns(motion.end + to_ns(2.0)))
    assert later.q - end.q == pytest.approx(2 * speed, abs=1e-8)


@given(q=POSITIONS, dq=SPEEDS, d=RATES)
def test_a_stop_ends_where_the_parabola_says(q: float, dq: float, d: float) -> None:
    at = Point(q, dq, 0.0)
    motion = stop(T0, at, d)
    assert motion.at(motion.end).q == pytest.approx(q + math.copysign(dq * dq / (2 * d), dq), abs=1e-12)
    assert stopping_point(at, d) == pytest.approx(motion.last.q, abs=1e-12)
    assert all(abs(p.ddq) in (0.0, pytest.approx(d)) for _, p in points(motion, 50))


@given(q=POSITIONS, targets=st.lists(POSITIONS, min_size=1, max_size=8), period=st.sampled_from([1, 4, 8, 10, 50]))
def test_interpolation_is_exact_at_set_points_and_straight_between(q: float, targets: list[float], period: int) -> None:
    step = Ns(period * 1_000_000)
    now = T0
    for target in targets:
        start = q
        motion = line(now, q, target, step, beyond=True)
        assert motion.at(Ns(now + step // 2)).q == pytest.approx((start + target) / 2, abs=1e-12)
        now = Ns(now + step)
        q = motion.at(now).q
        assert q == pytest.approx(target, abs=1e-14)
        # one period more in the same direction, then rest
        assert motion.at(Ns(now + step)).q == pytest.approx(2 * target - start, abs=1e-12)
        assert motion.at(Ns(now + 5 * step)) == motion.at(Ns(now + step))
        assert line(Ns(now - step), start, target, step, beyond=False).at(Ns(now + 3 * step)) == Point(target, 0.0, 0.0)


def test_a_motion_stands_before_it_starts_and_a_rest_always() -> None:
    motion = move_to(Ns(1000), Point(1.0, 0.0, 0.0), 2.0, 1.0, 1.0, 1.0)
    assert motion.at(Ns(0)).q == motion.at(Ns(1000)).q == 1.0
    assert rest(Ns(5), 0.7).at(Ns(10**15)) == rest(Ns(5), 0.7).at(Ns(0)) == Point(0.7, 0.0, 0.0)


def test_a_motion_slower_than_any_life_does_not_overflow() -> None:
    motion = move_to(Ns(0), Point(0.0, 0.0, 0.0), 1.0, 1e-10, 1.0, 1.0)
    assert motion.end == 2**62
    assert motion.at(Ns(10**18)).q == pytest.approx(0.1)


@given(q=POSITIONS, dq=SPEEDS, target=POSITIONS, v=LIMITS, a=RATES, again=st.floats(0, 1), other=POSITIONS)
def test_a_move_may_be_replaced_on_the_way_without_a_step(
    q: float, dq: float, target: float, v: float, a: float, again: float, other: float
) -> None:
    first = move_to(T0, Point(q, dq, 0.0), target, v, a, a)
    now = Ns(first.start + round(again * (first.end - first.start)))
    at = first.at(now)
    second = move_to(now, at, other, v, a, a)
    assert second.at(now).q == pytest.approx(at.q, abs=1e-9)
    assert second.at(now).dq == pytest.approx(at.dq, abs=1e-6)
    assert second.at(second.end).q == other
