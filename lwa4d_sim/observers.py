"""A state observer: joint positions and speeds from the encoders, the commands, and the nominal arm between them."""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from lwa4d_sim.estimators import kalman_gain
from lwa4d_sim.forecast import Forecast
from lwa4d_sim.interfaces import NS_PER_S, STRICT, Array, Estimator, IntArray, JointState, Measurement, Ns, Positive


class Observer:
    """Predicts with the nominal arm, corrects with the encoders (a Luenberger observer with a Kalman filter's gain).

    From the stamp s_(k-1) of the last sample to s_k,

        (q', dq') = Forecast.advance((q, dq), s_(k-1), s_k);   i = q_measured - q';   q = q' + g1 i;   dq = dq' + g2 i

    with the gain (g1, g2) of `kalman_gain`, per joint. It starts at rest at ``q0``. A joint whose sample is older than
    the newest one is brought to its instant with dq'. While a sample stays away, the state is carried on by the model
    to the instant at which it was due, and corrected when one comes.

    Attributes:
        instant: when the state given out holds [ns], (N, 1) or (1, 1).
    """

    def __init__(self, q0: Array, gain: Array) -> None:
        self._gain = gain
        self._state = JointState(q0.copy(), np.zeros_like(q0))
        self._clock = self.instant = np.zeros((1, 1), np.int64)
        self._heard = np.full((1, 1), -1, np.int64)
        self._forecast: Forecast | None = None

    def believe(self, forecast: Forecast) -> None:
        """Take the nominal arm and the commands from ``forecast``; needed before the first `update`."""
        self._forecast = forecast

    def update(self, meas: Measurement, now: Ns) -> JointState:
        """The state at `instant`."""
        assert self._forecast is not None
        newest = np.maximum(meas.stamp.max(axis=1, keepdims=True), self._clock)
        q, dq = self._forecast.advance(self._state, self._clock, newest)
        behind = (newest - meas.stamp) / NS_PER_S
        innovation = np.where(meas.stamp > self._heard, meas.q + behind * dq - q, 0.0)
        self._state = JointState(q + self._gain[0] * innovation, dq + self._gain[1] * innovation)
        self._clock, self._heard = newest, meas.stamp
        self.instant = np.maximum(newest, self._forecast.schedule.due(now))
        return self._forecast.advance(self._state, newest, self.instant)

    @property
    def clock(self) -> IntArray:
        """Instant of the last correction [ns]; commands that acted before it are not asked for again."""
        return self._clock


@dataclass(frozen=True, kw_only=True)
class ObserverVelocity:
    """State observer with the controller's model of the arm.

    Attributes:
        acceleration: standard deviation of what the model does not explain, white and held over a period [rad/s^2].
        position: standard deviation of a position sample [rad].
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["observer"] = "observer"
    acceleration: Positive = 0.3
    position: Positive = 1.75e-5  # one millidegree, the bus's resolution

    def build(self, q0: Array, period: float, timestep: float) -> tuple[None, Estimator]:
        """No source in the drive, and the controller's estimator for start positions ``q0`` (N, n)."""
        return None, Observer(q0, kalman_gain(period, self.acceleration, self.position))
