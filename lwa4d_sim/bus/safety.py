"""The safety envelope in front of the wire: what may reach a real arm, and when it must stop.

It stands beside the drives' own limits and a hardware emergency stop, and replaces neither.
"""

from collections.abc import Sequence

import numpy as np

from lwa4d_sim.bus.dictionary import Joint
from lwa4d_sim.errors import BusError
from lwa4d_sim.interfaces import Array, Trajectory

# Distance kept from each end of a joint's range [rad]: schunk_description, lwa4d.urdf.xacro (safety offset).
MARGIN = 0.02
# A joint may exceed its rated speed by this factor before the arm stops (assumed: ripple of a speed estimate).
OVERSPEED = 1.2


class Envelope:
    """Limits on position, speed, torque and its step from cycle to cycle.

    Args:
        joints: constants of each joint.
        torque: share of each joint's peak torque that may be asked.
        step: largest change of a torque from one cycle to the next, as a share of the peak torque.
        speed: share of each joint's rated speed at which the arm stops; default `OVERSPEED`.
    """

    def __init__(
        self, joints: Sequence[Joint], *, torque: float = 1.0, step: float = 0.5, speed: float = OVERSPEED
    ) -> None:
        peak = np.array([joint.torque for joint in joints])
        self._names = [joint.name for joint in joints]
        self._torque, self._step = torque * peak, step * peak
        self._speed = speed * np.array([joint.speed for joint in joints])
        self._low = np.array([-np.inf if joint.low is None else joint.low + MARGIN for joint in joints])
        self._high = np.array([np.inf if joint.high is None else joint.high - MARGIN for joint in joints])
        self._last: Array | None = None

    def check(self, q: Array, dq: Array, tau: Array) -> Array:
        """Torque (n,) that may go out: limited in size and step.

        Args:
            q: measured position (n,) [rad].
            dq: measured or estimated speed (n,) [rad/s].
            tau: asked torque (n,) [N m].

        Raises:
            BusError: a joint is outside its range, too fast, or its torque is no number.
        """
        self._stop_if(~np.isfinite(tau), "the torque of {} is not a number", tau)
        self._stop_if((q < self._low) | (q > self._high), "{} is at {:.3f} rad, outside its range", q)
        self._stop_if(np.abs(dq) > self._speed, "{} moves at {:.2f} rad/s, too fast", dq)
        limited = np.clip(tau, -self._torque, self._torque)
        if self._last is not None:
            limited = np.clip(limited, self._last - self._step, self._last + self._step)
        self._last = limited
        return np.asarray(limited)

    def _stop_if(self, bad: np.ndarray, text: str, values: Array) -> None:
        if bad.any():
            k = int(np.argmax(bad))
            raise BusError("safety stop: " + text.format(self._names[k], values[k]))


class Following:
    """Limit of the distance between where each joint is and where it should be.

    Args:
        trajectory: the desired motion.
        period: of the cycles [s].
        limit: [rad].
        names: of the joints.
    """

    def __init__(self, trajectory: Trajectory, period: float, limit: float, names: Sequence[str]) -> None:
        self._trajectory, self._period, self._limit, self._names = trajectory, period, limit, names

    def check(self, k: int, q: Array) -> None:
        """Look at the position (n,) [rad] measured in cycle ``k``.

        Raises:
            BusError: a joint is too far off.
        """
        error = np.abs(self._trajectory.joint(np.array([k * self._period])).q[0] - q)
        if error.max() > self._limit:
            j = int(np.argmax(error))
            raise BusError(f"safety stop: {self._names[j]} is {error[j]:.3f} rad from where it should be")
