"""Metrics of made-up records, where the right number is known beforehand."""

import dataclasses
import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lwa4d_sim.interfaces import NS_PER_S, Array, to_ns
from lwa4d_sim.metrics import (
    METRICS,
    SETTLED,
    SMOOTH_WINDOW,
    VIBRATION_FLOOR,
    VIBRATION_LIMIT,
    deviation,
    metrics,
    vibrations,
)
from lwa4d_sim.record import RunLog, StoredPaths, TickLog

H = 0.001  # plant step [s]


def made_log(
    dq: Array | None = None,
    *,
    x: Array | None = None,
    x_ref: Array | None = None,
    knots: tuple[float, ...] = (5.0,),
    tau: Array | None = None,
    ticks: dict[str, Array] | None = None,
    timestep: float = H,
    period: float = 0.01,
    diverged_at: float | None = None,
    n: int = 1,
) -> RunLog:
    """A record with the given signals and nothing else happening; as long as its longest signal, or its motion."""
    length = next((len(a) for a in (dq, x, x_ref, tau) if a is not None), round(knots[-1] / timestep) + 1)
    dq = np.zeros((length, n)) if dq is None else dq
    n = dq.shape[1]
    empty = dict.fromkeys(("q", "dq", "tau", "q_true", "dq_true", "q_ref"), np.zeros((0, n)))
    ticks = {"t": np.zeros(0), "age": np.zeros(0), **empty, **(ticks or {})}
    return RunLog(
        name="made",
        variant="default",
        timestep=to_ns(timestep),
        period=to_ns(period),
        q=np.cumsum(dq, axis=0) * timestep,
        dq=dq,
        tau=np.zeros_like(dq) if tau is None else tau,
        ticks=TickLog(**ticks),
        knots=np.array(knots),
        tau_max=np.full(n, 10.0),
        seed=0,
        diverged_at=diverged_at,
        paths=StoredPaths(np.zeros((length, 3)) if x is None else x, np.zeros((length, 3)) if x_ref is None else x_ref),
    )


def along(values: Array) -> Array:
    """A tool path along the x axis."""
    return np.column_stack([values, np.zeros((len(values), 2))])


def motion(T: float, distance: float) -> Array:
    """Speed of a quintic from rest to rest."""
    u = np.arange(round(T / H) + 1) * H / T
    return np.asarray(distance / T * 30 * u**2 * (1 - u) ** 2)


FREQUENCIES = st.floats(6.0, 50.0)
PHASES = st.floats(0.0, 2 * math.pi)


@settings(deadline=None, derandomize=True, max_examples=25)
@given(st.floats(1.0, 8.0), st.floats(-3.0, 3.0))
def test_a_smooth_motion_does_not_vibrate(T: float, distance: float) -> None:
    level, since = vibrations(made_log(motion(T, distance)[:, None], knots=(T,)))
    assert since is None
    assert level[0] is not None
    assert level[0] < VIBRATION_FLOOR


@settings(deadline=None, derandomize=True, max_examples=25)
@given(FREQUENCIES, PHASES, st.floats(0.1, 1.0), st.floats(0.1, 0.6))
def test_a_vibration_that_decays_is_stable(f: float, phase: float, amplitude: float, tau: float) -> None:
    t = np.arange(5001) * H
    ringing = amplitude * np.exp(-t / tau) * np.sin(2 * math.pi * f * t + phase)
    assert metrics(made_log((motion(5.0, 1.0) + ringing)[:, None]))["stable"]


@settings(deadline=None, derandomize=True, max_examples=25)
@given(FREQUENCIES, PHASES, st.floats(0.1, 1.0), st.floats(0.5, 4.0))
def test_a_vibration_that_stays_is_unstable_from_its_onset_on(
    f: float, phase: float, amplitude: float, start: float
) -> None:
    t = np.arange(5001) * H
    shaking = amplitude * np.sin(2 * math.pi * f * t + phase) * (t >= start)
    values = metrics(made_log((motion(5.0, 1.0) + shaking)[:, None]))
    assert not values["stable"]
    assert start - SMOOTH_WINDOW < values["unstable_since"] <= start + 1 / f
    # a cubic over the window follows little of it: what is left has nearly the sine's own rms
    assert values["vibration"][0] == pytest.approx(amplitude / math.sqrt(2), rel=0.3)


@settings(deadline=None, derandomize=True, max_examples=25)
@given(FREQUENCIES, PHASES, st.floats(0.3, 3.0))
def test_a_vibration_that_grows_is_unstable_from_where_it_passes_the_floor(f: float, phase: float, rate: float) -> None:
    t = np.arange(5001) * H
    shaking = np.exp(rate * (t - 5.0)) * np.sin(2 * math.pi * f * t + phase)
    log = made_log((motion(5.0, 1.0) + shaking)[:, None])
    values = metrics(log)
    passes = max(0.0, 5.0 + math.log(math.sqrt(2) * VIBRATION_FLOOR) / rate)
    assert not values["stable"]
    assert values["unstable_since"] == pytest.approx(passes, abs=SMOOTH_WINDOW)


def test_a_strong_vibration_is_unstable_even_if_it_decays() -> None:
    t = np.arange(5001) * H
    ringing = 10.0 * np.exp(-0.5 * t) * np.sin(2 * math.pi * 20 * t)
    values = metrics(made_log(ringing[:, None]))
    assert values["vibration"][0] > VIBRATION_LIMIT
    assert not values["stable"]


def test_a_shaking_that_moves_to_another_joint_is_no_decay() -> None:
    t = np.arange(5001) * H
    wave = np.sin(2 * math.pi * 20 * t)
    dq = 0.2 * np.column_stack([wave * (t < 3.9), 0.5 * wave * (t >= 3.9)])
    assert not metrics(made_log(dq))["stable"]


def test_each_segment_is_judged_by_itself_and_the_first_bad_one_dates_the_instability() -> None:
    t = np.arange(9001) * H
    dq = 0.3 * np.sin(2 * math.pi * 15 * t) * ((t > 4.0) & (t < 6.0))
    values = metrics(made_log(dq[:, None], knots=(3.0, 6.0, 9.0)))
    assert [level > VIBRATION_FLOOR for level in values["vibration"]] == [False, True, False]
    assert 3.6 < values["unstable_since"] < 4.1


def test_a_segment_below_a_second_is_not_judged() -> None:
    values = metrics(made_log(motion(0.5, 1.0)[:, None], knots=(0.5,)))
    assert values["vibration"] == [None]
    assert values["stable"]


@pytest.mark.parametrize("period", [0.001, 0.002, 0.01, 0.05])
@pytest.mark.parametrize("timestep", [0.0005, 0.001])
def test_the_level_hardly_depends_on_plant_step_and_period(period: float, timestep: float) -> None:
    t = np.arange(round(5 / timestep) + 1) * timestep
    log = made_log(0.1 * np.sin(2 * math.pi * 8 * t)[:, None], timestep=timestep, period=period)
    level = vibrations(log)[0][0]
    reference = vibrations(made_log(0.1 * np.sin(2 * math.pi * 8 * np.arange(5001) * H)[:, None]))[0][0]
    assert level == pytest.approx(reference, rel=0.02)


@settings(deadline=None, derandomize=True, max_examples=30)
@given(st.floats(0.05, 1.0), st.floats(0.01, 2.0))
def test_settling_time_of_an_exponential_is_tau_ln_50(tau: float, distance: float) -> None:
    t = np.arange(5001) * H
    x = along(distance * (1 - np.exp(-t / tau)))
    values = metrics(made_log(x=x, x_ref=along(np.full(5001, distance))))
    assert values["settling_time"][0] == pytest.approx(tau * math.log(1 / SETTLED), abs=H)


def test_settling_counts_from_each_segments_start_and_is_none_when_it_never_settles() -> None:
    t = np.arange(3001) * H
    first, last = np.exp(-t / 0.1), 1 - np.exp(-t / 100.0)
    x = along(np.concatenate([(1 - first)[:-1], np.ones(3000), 1 + last]))
    goal = along(np.concatenate([np.full(6000, 1.0), np.full(3001, 2.0)]))
    values = metrics(made_log(x=x, x_ref=goal, knots=(3.0, 6.0, 9.0)))
    assert values["settling_time"] == [pytest.approx(0.1 * math.log(50), abs=H), 0.0, None]


def test_errors_of_a_known_offset() -> None:
    """A reference that steps at the knot is compared with where the arm is then: 3-4-0 away, and right on it later."""
    x_ref = along(np.where(np.arange(2001) < 1000, 1.0, 2.0))
    x = along(np.where(np.arange(2001) <= 1000, 1.0, 2.0))
    x[:1001] += [0.03, 0.04, 0.0]
    values = metrics(made_log(x=x, x_ref=x_ref, knots=(1.0, 2.0)))
    step = math.hypot(0.97, 0.04)
    assert values["final_error"] == pytest.approx([0.05, 0.0])
    assert values["max_error"] == pytest.approx(step)
    assert values["rms_error"] == pytest.approx(math.sqrt((1000 * 0.05**2 + step**2) / 2001))


def test_perfect_tracking_of_a_moving_end_has_no_final_error() -> None:
    x = along(np.linspace(0.0, 1.0, 1001))
    assert metrics(made_log(x=x, x_ref=x, knots=(1.0,)))["final_error"] == [0.0]


def test_torque_metrics() -> None:
    tau = np.zeros((5001, 2))
    tau[:1000, 0] = 10.0  # at the limit for a fifth of the time, on one of two joints
    tau[4500:, 1] = np.where(np.arange(501) % 2, 1.0, -3.0)
    values = metrics(made_log(tau=tau, n=2))
    assert values["saturation_fraction"] == pytest.approx(1000 / 10002)
    assert values["peak_torque"] == [10.0, 3.0]
    assert values["torque_ripple"] == [0.0, 4.0]


def test_joint_and_estimate_errors_at_the_ticks_skip_what_the_controller_had_not_heard() -> None:
    zero = np.zeros((4, 1))
    ticks = {
        "t": np.arange(4) * 0.01,
        "q": zero,
        "dq": np.array([[np.nan], [1.0], [1.0], [1.0]]),
        "tau": zero,
        "age": np.array([np.nan, 0.0, 0.02, 0.01]),
        "q_true": np.array([[0.0], [1.0], [2.0], [3.0]]),
        "dq_true": np.array([[5.0], [1.0], [2.0], [3.0]]),
        "q_ref": np.array([[1.0], [1.0], [1.0], [1.0]]),
    }
    values = metrics(made_log(ticks=ticks))
    assert values["max_joint_error"] == [2.0]
    assert values["rms_joint_error"] == pytest.approx([math.sqrt((1 + 0 + 1 + 4) / 4)])
    assert values["velocity_error_rms"] == pytest.approx([math.sqrt((0 + 1 + 4) / 3)])
    assert values["data_age_max"] == 0.02


def test_every_metric_is_named_and_none_is_missing() -> None:
    assert metrics(made_log()).keys() == METRICS.keys() - {"deviation"}


@pytest.mark.parametrize("steps", [1, 2, 7, 400, 1700])
def test_a_record_cut_short_has_none_and_never_nan(steps: int) -> None:
    whole = made_log(motion(3.0, 1.0)[:, None], knots=(1.0, 2.0, 3.0))
    short = dataclasses.replace(
        whole,
        q=whole.q[:steps],
        dq=whole.dq[:steps],
        tau=whole.tau[:steps],
        diverged_at=steps * H,
        paths=StoredPaths(whole.x[:steps], whole.x_ref[:steps]),
    )
    values = metrics(short)
    json.dumps(values, allow_nan=False)
    complete = [end < steps * H for end in (1.0, 2.0, 3.0)]
    for key in ("final_error", "settling_time", "vibration"):
        assert [value is not None for value in values[key]] == complete
    assert not values["stable"]
    assert values["unstable_since"] == values["diverged_at"] == steps * H
    assert values["max_joint_error"] is None


@pytest.mark.parametrize("bad", [np.inf, -np.inf, np.nan])
def test_what_is_not_a_number_becomes_none(bad: float) -> None:
    tau = np.zeros((5001, 1))
    tau[-1] = bad
    values = metrics(made_log(tau=tau))
    json.dumps(values, allow_nan=False)
    assert values["peak_torque"] == [None]


@pytest.mark.parametrize("knots", [(1e-9,), (0.0004,), (0.001,), (0.0004, 1.0), (1.0, 1.0004)])
def test_segments_shorter_than_a_step_do_no_harm(knots: tuple[float, ...]) -> None:
    json.dumps(metrics(made_log(np.zeros((1101, 1)), knots=knots)), allow_nan=False)


def test_deviation_is_the_largest_distance_in_each_segment_and_symmetric() -> None:
    base = made_log(knots=(1.0, 2.0))
    x = np.zeros((2001, 3))
    x[500], x[1500] = [0.0, 0.3, 0.4], [1.0, 0.0, 0.0]
    other = made_log(x=x, knots=(1.0, 2.0))
    assert deviation(other, base) == pytest.approx([0.5, 1.0]) == deviation(base, other)
    assert deviation(base, base) == [0.0, 0.0]


def test_deviation_from_a_run_that_ended_early_is_none_beyond_its_end() -> None:
    base, short = made_log(knots=(1.0, 2.0)), made_log(x=np.zeros((1500, 3)), knots=(1.0, 2.0))
    assert deviation(base, short) == [0.0, None] == deviation(short, base)


def test_the_metrics_are_reckoned_once() -> None:
    log = made_log()
    assert log.metrics() is log.metrics()
    assert log.step_at(2.0) == 2000
    assert log.timestep * 1000 == NS_PER_S


def test_made_log_takes_what_it_is_given() -> None:
    """The tests above lean on it."""
    dq = np.ones((11, 2))
    log: Any = made_log(dq, knots=(0.01,))
    assert log.q[-1] == pytest.approx([0.011, 0.011])
