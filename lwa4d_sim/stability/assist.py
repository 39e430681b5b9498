"""Compensation blocks as linear systems: how the nominal arm moves under the commands that were sent."""

from dataclasses import dataclass

import numpy as np

from lwa4d_sim.interfaces import Array


@dataclass(frozen=True, slots=True)
class Assist:
    """What a controller does besides its law, see `compensation` and `observers`; instants as it believes them.

    Attributes:
        acts: from a tick to the instant its command begins to act [s], (n,).
        gain: (g1, g2) of the state observer, or None where another estimator serves.
        due: from a tick to the stamp of the sample that was due, 0 or negative [s].
        horizon: of the predictor, from there [s]; None for no predictor.
        bandwidth: of the disturbance observer [rad/s], or None.
    """

    acts: Array
    gain: Array | None
    due: float
    horizon: float | None
    bandwidth: float | None


class Forecast:
    """The nominal arm over a stretch of time, linear: what state, commands and a constant torque make of the state.

    With E(t) = integral of e^(As) B over [0, t], a torque that acts from t0 to t1 adds E(end - t0) - E(end - t1).

    Args:
        A, B: the nominal arm, (P, 2n, 2n) and (P, 2n, n).
        acts: from a tick to the instant its command begins to act [s], (n,).
        period: control period [s].
    """

    def __init__(self, A: Array, B: Array, acts: Array, period: float) -> None:
        self._n, self._size, self._acts, self.period = B.shape[2], B.shape[1], acts, period
        self._joined = np.zeros((len(A), self._size + self._n, self._size + self._n))
        self._joined[:, : self._size, : self._size], self._joined[:, : self._size, self._size :] = A, B
        self._known: dict[float, Array] = {}

    def _exponential(self, t: float) -> Array:
        from scipy.linalg import expm

        key = round(t, 12)
        if key not in self._known:
            self._known[key] = expm(self._joined * max(t, 0.0))
        return self._known[key]

    def step(self, t: float) -> Array:
        """e^(At), (P, 2n, 2n)."""
        return self._exponential(t)[:, : self._size, : self._size]

    def constant(self, t: float) -> Array:
        """What a constant torque over a time ``t`` does, (P, 2n, n)."""
        return self._exponential(t)[:, : self._size, self._size :]

    def ages(self, start: float) -> int:
        """Age in ticks, as seen from the present one, of the command that acts at the instant ``start``."""
        return max(1, int(np.ceil((float(self._acts.max()) - start) / self.period + 1e-9)))

    def commands(self, start: float, end: float) -> list[Array]:
        """What unit commands of 1, 2, ... ticks ago do to the state from ``start`` to ``end``, each (P, 2n, n).

        The newest is held on, since nothing newer has been sent.
        """
        weights: list[Array] = [np.zeros((len(self._joined), self._size, self._n)) for _ in range(self.ages(start))]
        for age, j, low, high in self._overlaps(start, end):
            change = self.constant(end - low) - self.constant(end - high)
            weights[age - 1][:, :, j] = change[:, :, j]
        return weights

    def shares(self, start: float, end: float) -> list[Array]:
        """Which part of the time from ``start`` to ``end`` each joint's command of 1, 2, ... ticks ago acts, (n,)."""
        parts: list[Array] = [np.zeros(self._n) for _ in range(self.ages(start))]
        for age, j, low, high in self._overlaps(start, end):
            parts[age - 1][j] = (high - low) / (end - start)
        return parts

    def _overlaps(self, start: float, end: float) -> list[tuple[int, int, float, float]]:
        """(age, joint, from, to) of the commands that act between two instants."""
        found = []
        for age in range(1, self.ages(start) + 1):
            for j in range(self._n):
                begin = float(self._acts[j]) - age * self.period
                low = max(start, begin)
                high = end if age == 1 else min(end, begin + self.period)
                if high > low + 1e-12:
                    found.append((age, j, low, high))
        return found
