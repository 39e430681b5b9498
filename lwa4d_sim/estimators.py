"""Velocity from positions: the thesis's filter before or after the sampler, differences, a Kalman filter, or the truth.

Every kind is a pair. The *source* lives in the drive, sees every plant step and may add a speed to the measurement; the
*estimator* lives in the controller and sees only what the link delivered. All shapes are (N, n).
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar, Literal, Protocol

import numpy as np

from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import NS_PER_S, STRICT, Array, Estimator, JointState, Measurement, Ns, Positive


class VelocitySource(Protocol):
    """The drive's own speed signal."""

    def observe(self, q: Array, dq: Array) -> None:
        """Take in the plant's motion since the last call, both (N, steps, n); the arrays may be reused afterwards."""
        ...

    def read(self) -> Array:
        """Speed (N, n) at the last observed instant."""
        ...


class TrueSource:
    """The plant's own joint speed."""

    def __init__(self, q0: Array) -> None:
        self._dq = np.zeros_like(q0)

    def observe(self, q: Array, dq: Array) -> None:
        self._dq = dq[:, -1].copy()

    def read(self) -> Array:
        return self._dq


class FilterSource:
    """s / (1 + T s)^2 on the continuous position, exact for the cubic through each plant step's q and dq.

    With y1 = q / (1 + T s) and y2 = y1 / (1 + T s) the output is (y1 - y2) / T: strictly proper, so the newest sample
    does not show at once. Starts in its steady state (thesis, Figure 5.3).
    """

    def __init__(self, q0: Array, time_constant: float, timestep: float) -> None:
        self._T = time_constant
        self._dt = timestep
        # rows: y1, y2, q and dq before the stretch, then q and dq at each of its steps
        self._rows = np.stack([q0, q0, q0, np.zeros_like(q0)], axis=1)
        self._speed = np.zeros_like(q0)

    def observe(self, q: Array, dq: Array) -> None:
        steps = q.shape[1]
        if self._rows.shape[1] != 4 + 2 * steps:
            blank = np.empty((len(q), 2 * steps, q.shape[2]))
            self._rows = np.concatenate([self._rows[:, :4], blank], axis=1)
        rows = self._rows
        rows[:, 4 : 4 + steps], rows[:, 4 + steps :] = q, dq
        out = np.matmul(_filter_weights(steps, self._dt, self._T), rows)
        rows[:, :4], self._speed = out[:, :4], out[:, 4]

    def read(self) -> Array:
        return self._speed


@lru_cache(maxsize=64)
def _filter_weights(steps: int, dt: float, T: float) -> Array:
    """The filter over ``steps`` plant steps as one linear map: `FilterSource`'s rows to their first four and the speed.

    Convolutions of the cubic Hermite basis with the impulse responses e^(-s/T)/T and s e^(-s/T)/T^2, by Gauss-Legendre
    quadrature: 32 nodes a step are exact to rounding up to dt = 10 T.
    """
    nodes, gauss = np.polynomial.legendre.leggauss(32)
    u, gauss = 0.5 * (nodes + 1.0), 0.5 * dt * gauss
    hermite = [2 * u**3 - 3 * u**2 + 1, dt * (u**3 - 2 * u**2 + u), 3 * u**2 - 2 * u**3, dt * (u**3 - u**2)]
    samples = np.zeros((2, 2, steps + 1))  # (y1, y2) x (q, dq) x sample
    for j in range(steps):
        s = (steps - j - u) * dt  # time from the node to the end of the stretch
        impulses = np.stack([np.exp(-s / T) / T, s * np.exp(-s / T) / T**2]) * gauss
        for basis, (signal, at) in zip(hermite, [(0, j), (1, j), (0, j + 1), (1, j + 1)], strict=True):
            samples[:, signal, at] += impulses @ basis
    decay = np.exp(-steps * dt / T)
    state = np.array([[decay, 0.0], [steps * dt / T * decay, decay]])
    y = np.hstack([state, samples[:, :, 0], samples[:, 0, 1:], samples[:, 1, 1:]])
    last = np.zeros((2, y.shape[1]))
    last[0, 3 + steps] = last[1, -1] = 1.0  # the last q and dq are the next stretch's first
    return np.vstack([y, last, (y[0] - y[1]) / T])


class PassThrough:
    """Uses the speed that came with the measurement."""

    def update(self, meas: Measurement, now: Ns) -> JointState:
        assert meas.dq is not None
        return JointState(meas.q, meas.dq)


class Midpoint:
    """For the ideal loop: the state half a plant step ahead, so that the hold over one step costs no delay.

    With h the step and speeds at the last three samples, d1 = dq - dq_1 and d2 = dq - 2 dq_1 + dq_2 stand for h ddq
    and h^2 dddq: q + h dq/2 + h d1/8 and dq + d1/2 + 3 d2/8, Taylor's series to the second order. What is left of the
    hold is a torque error of h^2/8 times the torque's second derivative.
    """

    def __init__(self, q0: Array, timestep: float) -> None:
        self._h = timestep
        self._last, self._before = np.zeros_like(q0), np.zeros_like(q0)

    def update(self, meas: Measurement, now: Ns) -> JointState:
        assert meas.dq is not None
        first = meas.dq - self._last
        second = first - self._before
        self._last, self._before = meas.dq, first
        q = meas.q + self._h * (0.5 * meas.dq + 0.125 * first)
        return JointState(q, meas.dq + 0.5 * first + 0.375 * second)


class HeldFilter:
    """s / (1 + T s)^2 fed by the held staircase, discretised exactly; read just before each new step.

    Its samples are 8 % low on a ramp at T = period, because the newest sample has had no time to act (thesis-style loop
    with the filter after the sampler).
    """

    def __init__(self, q0: Array, time_constant: float, period: float) -> None:
        self._T = time_constant
        self._decay = float(np.exp(-period / time_constant))
        self._carry = period / time_constant * self._decay
        self._y1, self._y2, self._held = q0.copy(), q0.copy(), q0.copy()

    def update(self, meas: Measurement, now: Ns) -> JointState:
        e1, e2 = self._y1 - self._held, self._y2 - self._held
        self._y1, self._y2 = self._held + self._decay * e1, self._held + self._decay * e2 + self._carry * e1
        self._held = meas.q
        return JointState(meas.q, (self._y1 - self._y2) / self._T)


class BackwardDifference:
    """(q_k - q_{k-1}) over the difference of their stamps; keeps its value while nothing new arrives."""

    def __init__(self, q0: Array) -> None:
        self._q, self._dq = q0.copy(), np.zeros_like(q0)
        self._stamp = np.full(q0.shape, -1, np.int64)

    def update(self, meas: Measurement, now: Ns) -> JointState:
        elapsed = meas.stamp - self._stamp
        fresh = (elapsed > 0) & (self._stamp >= 0)
        slope = (meas.q - self._q) * (NS_PER_S / np.where(fresh, elapsed, NS_PER_S))
        self._dq = np.where(fresh, slope, self._dq)
        self._q, self._stamp = meas.q, meas.stamp
        return JointState(meas.q, self._dq)


class Tustin:
    """s / (1 + T s)^2 by the bilinear rule s = (2/h) (z - 1)/(z + 1) at the controller's period h."""

    def __init__(self, q0: Array, time_constant: float, period: float) -> None:
        c = 2.0 * time_constant / period
        self._b = 2.0 / period / (1.0 + c) ** 2
        self._a = (1.0 - c) / (1.0 + c)
        self._u = [q0.copy(), q0.copy()]
        self._y = [np.zeros_like(q0), np.zeros_like(q0)]

    def update(self, meas: Measurement, now: Ns) -> JointState:
        y = self._b * (meas.q - self._u[1]) - 2.0 * self._a * self._y[0] - self._a**2 * self._y[1]
        self._u = [meas.q, self._u[0]]
        self._y = [y, self._y[0]]
        return JointState(meas.q, y)


class Kalman:
    """Steady-state Kalman filter for position and speed under white acceleration, one per joint."""

    def __init__(self, q0: Array, period: float, gain: Array) -> None:
        self._h, self._gain = period, gain
        self._q, self._dq = q0.copy(), np.zeros_like(q0)
        self._stamp = np.full(q0.shape, -1, np.int64)

    def update(self, meas: Measurement, now: Ns) -> JointState:
        q = self._q + self._h * self._dq
        innovation = np.where(meas.stamp > self._stamp, meas.q - q, 0.0)
        self._q = q + self._gain[0] * innovation
        self._dq = self._dq + self._gain[1] * innovation
        self._stamp = meas.stamp
        return JointState(self._q, self._dq)


@dataclass(frozen=True, kw_only=True)
class TrueVelocity:
    """The plant's own speed, latched with the position."""

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["true"] = "true"

    def build(self, q0: Array, period: float, timestep: float) -> tuple[VelocitySource | None, Estimator]:
        """The drive's source and the controller's estimator for start positions ``q0`` (N, n)."""
        return TrueSource(q0), PassThrough()


@dataclass(frozen=True, kw_only=True)
class FilteredDerivative:
    """The thesis's s / (1 + T s)^2.

    Attributes:
        time_constant: T [s] (thesis: 0.01).
        runs_on: continuous = in the drive, before the sampler; held = in the controller, on the received staircase.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["filtered_derivative"] = "filtered_derivative"
    time_constant: Positive = 0.01
    runs_on: Literal["continuous", "held"] = "continuous"

    def build(self, q0: Array, period: float, timestep: float) -> tuple[VelocitySource | None, Estimator]:
        """The drive's source and the controller's estimator for start positions ``q0`` (N, n)."""
        if self.runs_on == "continuous":
            return FilterSource(q0, self.time_constant, timestep), PassThrough()
        return None, HeldFilter(q0, self.time_constant, period)


@dataclass(frozen=True, kw_only=True)
class BackwardDifferenceVelocity:
    """Difference of the last two samples over their age."""

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["backward_difference"] = "backward_difference"

    def build(self, q0: Array, period: float, timestep: float) -> tuple[VelocitySource | None, Estimator]:
        """The drive's source and the controller's estimator for start positions ``q0`` (N, n)."""
        return None, BackwardDifference(q0)


@dataclass(frozen=True, kw_only=True)
class TustinVelocity:
    """The thesis's filter, discretised by the bilinear rule in the controller.

    Attributes:
        time_constant: T [s].
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["tustin"] = "tustin"
    time_constant: Positive = 0.01

    def build(self, q0: Array, period: float, timestep: float) -> tuple[VelocitySource | None, Estimator]:
        """The drive's source and the controller's estimator for start positions ``q0`` (N, n)."""
        return None, Tustin(q0, self.time_constant, period)


@dataclass(frozen=True, kw_only=True)
class KalmanVelocity:
    """Steady-state Kalman filter on position and speed.

    Attributes:
        acceleration: standard deviation of the acceleration, taken as white and held over a period [rad/s^2].
        position: standard deviation of a position sample [rad].
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["kalman"] = "kalman"
    acceleration: Positive = 10.0
    position: Positive = 1.75e-5  # one millidegree, the bus's resolution

    def build(self, q0: Array, period: float, timestep: float) -> tuple[VelocitySource | None, Estimator]:
        """The drive's source and the controller's estimator for start positions ``q0`` (N, n)."""
        return None, Kalman(q0, period, kalman_gain(period, self.acceleration, self.position))


def kalman_gain(period: float, acceleration: float, position: float) -> Array:
    """Steady-state gain (2,) of the (q, dq) filter, from the discrete Riccati equation (scipy).

    Raises:
        ScenarioError: the two deviations are so far apart that the equation has no numerical solution.
    """
    from scipy.linalg import solve_discrete_are

    A = np.array([[1.0, period], [0.0, 1.0]])
    G = np.array([[0.5 * period**2], [period]])
    C = np.array([[1.0, 0.0]])
    # only the ratio of the two deviations matters; in units of the position's, nothing over- or underflows
    try:
        P = solve_discrete_are(A.T, C.T, (acceleration / position) ** 2 * (G @ G.T), np.eye(1))
    except np.linalg.LinAlgError as error:
        raise ScenarioError(
            f"kalman: acceleration (={acceleration:g}) and position (={position:g}) are too far apart",
            key="loop.velocity",
        ) from error
    gain: Array = (P @ C.T / (C @ P @ C.T + 1.0))[:, 0]
    return gain


VelocityParameters = FilteredDerivative | TrueVelocity | BackwardDifferenceVelocity | TustinVelocity | KalmanVelocity
