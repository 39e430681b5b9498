"""The drive but for its bus: encoder, torque resolution and limit, and what it does with late data."""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from lwa4d_sim.interfaces import NS_PER_S, STRICT, Array, Arrived, Ns, Positive, to_ns


@dataclass(frozen=True, kw_only=True)
class LateData:
    """What a drive does when no new command has come for a while.

    Attributes:
        policy: hold = keep the last torque; zero = no torque; ramp = lead the torque to zero over ``ramp_time``;
            stop = close the brakes, for good.
        timeout: age of the last command [s] after which the policy acts; default two periods.
        ramp_time: length of the ramp [s].
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    policy: Literal["hold", "zero", "ramp", "stop"] = "hold"
    timeout: Positive | None = None
    ramp_time: Positive = 0.1


class Drives:
    """Encoder, torque limit and watchdog of N arms with n joints.

    Args:
        tau_max: torque limit (n,) [N m].
        position_resolution: encoder step (n,) or (N, n) [rad], 0 for none.
        torque_resolution: torque step (n,) or (N, n) [N m], 0 for none.
        late: late-data policy.
        period: control period [s], for the default timeout.
        timestep: plant step [ns].
    """

    def __init__(
        self,
        tau_max: Array,
        *,
        position_resolution: Array | None,
        torque_resolution: Array | None,
        late: LateData,
        period: float,
        timestep: Ns,
    ) -> None:
        self.tau_max = tau_max
        self._low = -tau_max
        self._encoder, self._torque_step = position_resolution, torque_resolution
        self._late = late
        self._timeout = to_ns(late.timeout if late.timeout is not None else 2.0 * period)
        self._dt = timestep
        self._stopped: Any = None

    def encode(self, q: Array) -> Array:
        """Joint positions as the encoder gives them, (N, n) [rad]."""
        return q.copy() if self._encoder is None else _round(q, self._encoder)

    def torque(self, arrived: Arrived, now: Ns, steps: int) -> Array:
        """Torque on the joints over ``steps`` plant steps from ``now``, (N, 1 or steps, n) [N m].

        NaN says that the brakes are closed: no command has arrived yet, or the watchdog has stopped the arm.
        """
        tau = arrived.values[0]
        if self._torque_step is not None:
            tau = _round(tau, self._torque_step)
        # not np.clip: a third of its cost for seven numbers
        tau = np.minimum(np.maximum(tau, self._low), self.tau_max)[:, None, :]
        if self._late.policy == "hold":
            return tau
        return self._watchdog(tau, arrived, now, steps)

    def _watchdog(self, tau: Array, arrived: Arrived, now: Ns, steps: int) -> Array:
        instants = now + self._dt * np.arange(steps, dtype=np.int64)
        overdue = instants[None, :, None] - arrived.since[:, None, :] - self._timeout
        late = (overdue >= 0) & ~np.isnan(tau)  # no command yet is not a late one: the brakes stay closed
        if self._late.policy == "zero":
            return np.where(late, 0.0, tau)
        if self._late.policy == "ramp":
            share = np.clip(1.0 - overdue / (self._late.ramp_time * NS_PER_S), 0.0, 1.0)
            return np.where(late, tau * share, tau)
        # stop: one late joint stops the arm, and it stays stopped
        stopped = np.maximum.accumulate(late.any(axis=2), axis=1)
        if self._stopped is not None:
            stopped |= self._stopped[:, None]
        self._stopped = stopped[:, -1]
        return np.where(stopped[:, :, None], np.nan, tau)


def _round(x: Array, step: Array) -> Array:
    """``x`` to the nearest multiple of ``step``; a step of 0 leaves it as it is."""
    coarse: Array = np.where(step > 0, np.rint(x / np.where(step > 0, step, 1.0)) * step, x)
    return coarse
