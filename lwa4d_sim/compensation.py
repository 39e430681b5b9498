"""What wins back gain lost to the bus: a state predictor and a disturbance observer between estimator, law and link."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from lwa4d_sim.forecast import Forecast
from lwa4d_sim.interfaces import NS_PER_S, STRICT, Array, IntArray, JointState, Measurement, NonNegative, Ns, Positive
from lwa4d_sim.observers import Observer


@dataclass(frozen=True, kw_only=True)
class Predictor:
    """The law gets the state, and the reference, of the instant at which its command will act.

    Attributes:
        horizon: from the sample to the instant predicted [s]; default to when the loop lets the command act.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    horizon: NonNegative | None = None


@dataclass(frozen=True, kw_only=True)
class DisturbanceObserver:
    """Torque that the model does not explain, taken off the command.

    Attributes:
        bandwidth: rate of the estimate [rad/s].
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    bandwidth: Positive


@dataclass(frozen=True, kw_only=True)
class Compensation:
    """Blocks beside the controller.

    Attributes:
        predictor: state prediction over the loop's delay.
        disturbance_observer: estimate of unmodelled torque.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    predictor: Predictor | None = None
    disturbance_observer: DisturbanceObserver | None = None


class MomentumObserver:
    """Generalised-momentum observer of the torque d in M ddq + h = tau + d (De Luca and Mattone 2003, 2005).

    The continuous residual r = K (p - integral of (tau + C^T dq - g + r)), p = M dq, obeys dr/dt = K (d - r). Here it
    is integrated from one estimate to the next, at s_(k-1) and s_k = s_(k-1) + T, by the trapezoidal rule; with
    dM/dt = C + C^T the momentum's terms become

        seen = (M_(k-1) + M_k)/2 (dq_k - dq_(k-1))/T + (h_(k-1) + h_k)/2 - mean applied torque from s_(k-1) to s_k
        d_k  = d_(k-1) + (1 - e^(-K T)) (seen - d_(k-1)),   d_0 = 0

    so that a constant torque is found as with the continuous observer, and no acceleration is needed. While an arm was
    braked its estimate rests.

    Args:
        forecast: model and commands; its `disturbance` is kept up to date.
        bandwidth: K [rad/s], (N, 1) or (1, 1).
    """

    def __init__(self, forecast: Forecast, bandwidth: Array) -> None:
        self._forecast, self._bandwidth = forecast, bandwidth
        self._last: tuple[IntArray, Array, Array, Array] | None = None

    def update(self, state: JointState, instant: IntArray) -> Array:
        """Take in the estimate at ``instant``; the torque found (N, n) [N m]."""
        forecast = self._forecast
        terms = forecast.model.at(*state)
        M, h = terms.M, terms.h
        found = forecast.disturbance
        if self._last is not None:
            since, M_1, h_1, dq_1 = self._last
            T = (instant - since) / NS_PER_S
            tau = forecast.mean_torque(since, instant)
            use = (T > 0) & ~np.isnan(tau).any(axis=1, keepdims=True)
            slope = (state.dq - dq_1) / np.where(T > 0, T, 1.0)
            seen = np.matmul(0.5 * (M_1 + M), slope[..., None])[..., 0] + 0.5 * (h_1 + h) - tau
            found = np.where(use, found - np.expm1(-self._bandwidth * T) * (seen - found), found)
        self._last = (instant, M, h, state.dq)
        forecast.disturbance = found
        return found


class Compensator:
    """Order of events in a tick: estimate, disturbance, prediction, law, command.

    Args:
        forecast: the nominal arm and the commands in flight, shared by all blocks.
        observer: the estimator, when it is one that asks the forecast.
        horizon: of the predictor, from the due sample to the instant predicted [ns], (N, 1) or (1, 1); None for no
            predictor.
        disturbance: the disturbance observer, or None.
    """

    def __init__(
        self,
        forecast: Forecast,
        *,
        observer: Observer | None,
        horizon: IntArray | None,
        disturbance: MomentumObserver | None,
    ) -> None:
        self._forecast, self._observer = forecast, observer
        self._horizon, self._disturbance = horizon, disturbance
        if observer is not None:
            observer.believe(forecast)

    def ahead(self, estimate: JointState, meas: Measurement, now: Ns) -> JointState:
        """The state that the law is given in place of the ``estimate``."""
        if self._observer is None:
            state, instant = _aligned(estimate, meas.stamp)
            oldest = instant
        else:
            state, instant, oldest = estimate, self._observer.instant, self._observer.clock
        if self._disturbance is not None:
            self._disturbance.update(state, instant)
        self._forecast.forget(oldest)
        if self._horizon is None:
            return estimate
        return self._forecast.advance(state, instant, self._forecast.schedule.due(now) + self._horizon)

    def command(self, tau: Array, k: int, now: Ns) -> Array:
        """The command that goes out in place of the law's torque (N, n); NaN stays NaN."""
        if self._disturbance is not None:
            tau = tau - self._forecast.disturbance
        self._forecast.issue(k, now, tau)
        return tau


def _aligned(estimate: JointState, stamp: IntArray) -> tuple[JointState, IntArray]:
    """The estimate with all joints of an arm at the instant of its newest sample (N, 1): q + dq times the difference.

    A joint that was never heard of stands where it stood.
    """
    newest = np.maximum(stamp.max(axis=1, keepdims=True), 0)
    if stamp.shape[1] == 1:
        return estimate, newest
    behind = np.where(stamp >= 0, newest - stamp, 0) / NS_PER_S
    return JointState(estimate.q + behind * estimate.dq, estimate.dq), newest
