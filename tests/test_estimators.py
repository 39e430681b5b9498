"""Velocity from positions: each estimator against an independent road to the same numbers."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import bilinear, cont2discrete, dlsim, lfilter

from lwa4d_sim.arm import load_arm
from lwa4d_sim.dynamics import ClosedForm3
from lwa4d_sim.estimators import (
    BackwardDifference,
    BackwardDifferenceVelocity,
    FilteredDerivative,
    FilterSource,
    HeldFilter,
    Kalman,
    KalmanVelocity,
    PassThrough,
    TrueSource,
    TrueVelocity,
    Tustin,
    TustinVelocity,
    VelocityParameters,
    kalman_gain,
)
from lwa4d_sim.interfaces import Array, Estimator, Measurement, Ns
from lwa4d_sim.runner import run
from lwa4d_sim.scenario import Scenario

PERIOD, DT = 0.01, 0.001  # [s]
TICK = 10_000_000  # [ns]

Motion = Callable[[Array], tuple[Array, Array]]


def measured(q: Array, k: int, dq: Array | None = None) -> Measurement:
    return Measurement(np.full(q.shape, k * TICK), q, dq)


def speeds(estimator: Estimator, samples: Array) -> Array:
    """Speed after each of the samples (K,), all on time, seen through two equal joints of one arm."""
    found = []
    for k, q in enumerate(samples):
        state = estimator.update(measured(np.full((1, 2), q), k), Ns(k * TICK))
        assert state.dq[0, 0] == state.dq[0, 1]
        found.append(float(state.dq[0, 0]))
    return np.array(found)


def sine(t: Array) -> tuple[Array, Array]:
    return 1.3 - np.cos(4.0 * t), 4.0 * np.sin(4.0 * t)


def cubic(t: Array) -> tuple[Array, Array]:
    return -0.2 - 2.0 * t**2 + 5.0 * t**3, -4.0 * t + 15.0 * t**2


@pytest.mark.parametrize("T", [0.01, 0.002, 0.1])
@pytest.mark.parametrize("steps", [1, 4, 10])
@pytest.mark.parametrize(("motion", "tolerance"), [(cubic, 1e-10), (sine, 1e-9)])
def test_continuous_filter_is_the_filter(motion: Motion, tolerance: float, steps: int, T: float) -> None:
    t = DT * np.arange(1, 401)
    q, dq = (np.stack([values, 2.0 * values])[:, :, None] for values in motion(t))  # two arms of one joint
    start = float(motion(np.zeros(1))[0][0])
    source = FilterSource(np.array([[start], [2.0 * start]]), T, DT)
    found = []
    for k in range(0, 400, steps):
        source.observe(q[:, k : k + steps], dq[:, k : k + steps])
        found.append(source.read())

    # independent road: the two first-order lags as differential equations
    def lag(s: float, y: Array) -> Array:
        return np.array([(motion(np.array(s))[0] - y[0]) / T, (y[0] - y[1]) / T])

    tight: Any = {"rtol": 1e-13, "atol": 1e-13, "max_step": T}
    lags = solve_ivp(lag, (0.0, float(t[-1])), [start, start], "DOP853", t[steps - 1 :: steps], **tight)
    expected = (lags.y[0] - lags.y[1]) / T
    np.testing.assert_allclose(np.array(found)[:, 0, 0], expected, atol=tolerance)
    np.testing.assert_allclose(np.array(found)[:, 1, 0], 2.0 * expected, atol=2 * tolerance)


def test_continuous_filter_takes_stretches_of_any_length() -> None:
    t = DT * np.arange(1, 121)
    q, dq = (values.reshape(1, -1, 1) for values in sine(t))
    whole, parts = (FilterSource(np.array([[0.3]]), 0.01, DT) for _ in range(2))
    whole.observe(q, dq)
    k = 0
    for steps in (1, 3, 7, 1, 40, 6, 4, 10, 48):
        parts.observe(q[:, k : k + steps], dq[:, k : k + steps])
        k += steps
    np.testing.assert_allclose(parts.read(), whole.read(), atol=1e-12)
    assert parts.read()[0, 0] == pytest.approx(sine(t[-1:] - 0.02)[1][0], abs=0.02)  # about two time constants late


def test_continuous_filter_gives_a_ramps_slope_in_the_end() -> None:
    source = FilterSource(np.array([[2.0]]), 0.01, DT)
    for k in range(50):
        t = DT * (10 * k + np.arange(1, 11))
        source.observe((2.0 + 0.7 * t).reshape(1, -1, 1), np.full((1, 10, 1), 0.7))
    assert source.read()[0, 0] == pytest.approx(0.7, abs=1e-9)


@pytest.mark.parametrize("T", [0.01, 0.003, 0.05])
def test_held_filter_is_the_exact_discretisation(T: float) -> None:
    rng = np.random.default_rng(5)
    q = 1.5 + np.cumsum(rng.normal(size=300)) * 0.01
    q[0] = 1.5
    found = speeds(HeldFilter(np.full((1, 2), 1.5), T, PERIOD), q)
    # s / (1 + T s)^2 in controllable form
    A, B = np.array([[0.0, 1.0], [-1.0 / T**2, -2.0 / T]]), np.array([[0.0], [1.0]])
    C, D = np.array([[0.0, 1.0 / T**2]]), np.zeros((1, 1))
    _, expected, _ = dlsim(cont2discrete((A, B, C, D), PERIOD, "zoh"), (q - 1.5)[:, None])
    np.testing.assert_allclose(found, expected[:, 0], atol=1e-12)


def test_held_filter_is_eight_percent_low_on_a_ramp() -> None:
    found = speeds(HeldFilter(np.zeros((1, 2)), PERIOD, PERIOD), 0.01 * np.arange(200))
    # by hand: the sum over k >= 1 of k e^-k, what the filter's impulse responses leave of a unit step a period
    assert found[-1] == pytest.approx(math.e / (math.e - 1.0) ** 2, abs=1e-12)
    assert found[-1] == pytest.approx(0.92, abs=0.005)


@pytest.mark.parametrize("T", [0.01, 0.003, 0.05])
def test_tustin_is_the_bilinear_rule(T: float) -> None:
    rng = np.random.default_rng(6)
    q = -0.5 + np.cumsum(rng.normal(size=300)) * 0.01
    b, a = bilinear([1.0, 0.0], [T**2, 2.0 * T, 1.0], 1.0 / PERIOD)
    expected = lfilter(b, a, q + 0.5)
    np.testing.assert_allclose(speeds(Tustin(np.full((1, 2), -0.5), T, PERIOD), q), expected, rtol=1e-9, atol=1e-10)


def test_backward_difference_goes_by_the_stamps() -> None:
    estimator = BackwardDifference(np.array([[0.0, 0.0]]))

    def speed(now: int, stamps: list[int], q: list[float]) -> list[float]:
        state = estimator.update(Measurement(np.array([stamps]), np.array([q]), None), Ns(now))
        return [float(v) for v in state.dq[0]]

    assert speed(TICK, [0, 0], [5.0, 7.0]) == [0.0, 0.0]  # one sample is no difference
    assert speed(2 * TICK, [TICK, TICK], [5.01, 6.98]) == pytest.approx([1.0, -2.0])
    assert speed(3 * TICK, [TICK, 2 * TICK], [5.01, 6.96]) == pytest.approx([1.0, -2.0])  # first joint's sample lost
    assert speed(4 * TICK, [TICK, 2 * TICK], [5.01, 6.96]) == pytest.approx([1.0, -2.0])  # nothing new at all
    assert speed(5 * TICK, [4 * TICK, 4 * TICK], [5.10, 7.00]) == pytest.approx(
        [3.0, 2.0]
    )  # over three periods, over two
    assert speed(6 * TICK, [4 * TICK + 1234, 5 * TICK], [5.10 + 1.234e-6, 7.0]) == pytest.approx([1.0, 0.0], rel=1e-6)


def test_kalman_gain_solves_the_riccati_recursion() -> None:
    for acceleration, position in [(10.0, 1.75e-5), (1.0, 1e-3), (200.0, 1e-6)]:
        A = np.array([[1.0, PERIOD], [0.0, 1.0]])
        G = np.array([0.5 * PERIOD**2, PERIOD]) * acceleration
        P = np.eye(2)
        for _ in range(20_000):
            K = P[:, 0] / (P[0, 0] + position**2)
            P = A @ (P - np.outer(K, P[0])) @ A.T + np.outer(G, G)
        np.testing.assert_allclose(kalman_gain(PERIOD, acceleration, position), K, rtol=1e-6)


def test_kalman_is_unbiased_at_constant_speed() -> None:
    gain = kalman_gain(PERIOD, 10.0, 1e-3)
    q = 0.4 + 0.9 * PERIOD * np.arange(400)
    found = speeds(Kalman(np.full((1, 2), 0.4), PERIOD, gain), q)
    assert found[-1] == pytest.approx(0.9, abs=1e-9)
    rng = np.random.default_rng(8)
    noisy = speeds(Kalman(np.full((1, 2), 0.4), PERIOD, gain), 0.4 + 0.9 * PERIOD * np.arange(20_000)
                   + rng.normal(0.0, 1e-3, 20_000))[200:]  # fmt: skip
    assert noisy.mean() == pytest.approx(0.9, abs=1e-3)
    assert noisy.std() < 0.5 * np.std(np.diff(rng.normal(0.0, 1e-3, 20_000))) / PERIOD  # calmer than a difference


def test_kalman_predicts_through_a_loss() -> None:
    estimator = Kalman(np.full((1, 1), 0.0), PERIOD, kalman_gain(PERIOD, 10.0, 1e-4))
    k = 0
    for k in range(300):
        state = estimator.update(measured(np.array([[0.5 * PERIOD * k]]), k), Ns(k * TICK))
    for ahead in range(1, 6):
        state = estimator.update(measured(np.array([[0.5 * PERIOD * k]]), k), Ns((k + ahead) * TICK))
        assert state.q[0, 0] == pytest.approx(0.5 * PERIOD * (k + ahead), abs=1e-9)
        assert state.dq[0, 0] == pytest.approx(0.5, abs=1e-9)


def test_the_true_speed_passes_through() -> None:
    source = TrueSource(np.zeros((1, 2)))
    q, dq = np.zeros((1, 3, 2)), np.arange(6.0).reshape(1, 3, 2)
    assert source.read().tolist() == [[0.0, 0.0]]
    source.observe(q, dq)
    dq[:] = 99.0  # the arrays are reused by the plant
    assert source.read().tolist() == [[4.0, 5.0]]
    state = PassThrough().update(measured(q[:, 0], 0, source.read()), Ns(0))
    assert state.dq.tolist() == [[4.0, 5.0]]


EVERY_KIND: list[VelocityParameters] = [
    TrueVelocity(),
    FilteredDerivative(),
    FilteredDerivative(runs_on="held"),
    BackwardDifferenceVelocity(),
    TustinVelocity(),
    KalmanVelocity(),
]


@pytest.mark.parametrize("parameters", EVERY_KIND, ids=str)
def test_every_kind_starts_in_its_steady_state(parameters: VelocityParameters) -> None:
    q0 = np.array([[0.3, -1.7, 2.9], [1.0, 2.0, 3.0]])
    source, estimator = parameters.build(q0, PERIOD, DT)
    for k in range(30):
        dq = None if source is None else source.read()
        state = estimator.update(measured(q0, k, dq), Ns(k * TICK))
        np.testing.assert_allclose(state.dq, 0.0, atol=1e-11)
        np.testing.assert_allclose(state.q, q0, rtol=1e-15)
        if source is not None:
            source.observe(np.repeat(q0[:, None], 10, axis=1), np.zeros((2, 10, 3)))


@pytest.mark.parametrize("parameters", EVERY_KIND, ids=str)
def test_every_kind_finds_a_constant_speed(parameters: VelocityParameters) -> None:
    slope = np.array([[0.5, -0.25]])
    source, estimator = parameters.build(np.zeros((1, 2)), PERIOD, DT)
    for k in range(400):
        state = estimator.update(measured(slope * PERIOD * k, k, source.read() if source else None), Ns(k * TICK))
        if source is not None:
            t = PERIOD * k + DT * np.arange(1, 11)[:, None]
            source.observe((slope * t)[None], np.broadcast_to(slope, (1, 10, 2)))
    low = 0.9207 if parameters == FilteredDerivative(runs_on="held") else 1.0
    np.testing.assert_allclose(state.dq, low * slope, rtol=1e-4)


def test_the_ideal_loop_is_second_order_in_the_plant_step() -> None:
    q0, duration = [-1.5, -1.0, 1.0], 0.3
    document = {
        "name": "ideal",
        "arm": "lwa4d_3dof",
        "initial": {"q": q0},
        "trajectory": {
            "waypoints": {"space": "joint", "points": [[-1.3, -1.2, 1.3]]},
            "segment_time": duration,
            "profile": "quintic",
            "follow": "joint",
        },
        "controller": {"kind": "pd_gravity", "kp": 30.0, "kd": 6.0},
        "loop": {"kind": "ideal"},
    }
    scenario = Scenario.parse(json.dumps(document))
    arm = load_arm("lwa4d_3dof")
    motion = scenario.variants["default"].trajectory.build(arm.kinematics, np.array(q0), Path())
    terms = ClosedForm3(arm.model)

    def derivative(t: float, y: Array) -> Array:
        q, dq = y[None, :3], y[None, 3:]
        ref = motion.joint(np.array([t]))
        at = terms.at(q, dq)
        tau = 30.0 * (ref.q - q) + 6.0 * (ref.dq - dq) + terms.at(q).h
        return np.concatenate([dq[0], np.linalg.solve(at.M[0], (tau - at.h)[0])])

    t = np.arange(0.0, duration + 1e-9, 0.004)
    truth = solve_ivp(derivative, (0.0, duration), [*q0, 0, 0, 0], "DOP853", t, rtol=1e-11, atol=1e-12).y[:3].T
    errors = []
    for dt in (0.004, 0.002, 0.001):
        log = run(Scenario.parse(json.dumps({**document, "plant": {"timestep": dt}})))
        errors.append(float(np.abs(log.q[:: round(0.004 / dt)] - truth).max()))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 2.0, atol=0.25)
    assert errors[-1] < 2e-5
