"""The nominal arm's motion under the commands in flight: what is known of the arm between its last sample and later.

Everything here is the controller's belief: its own model, the commands it sent, and the instants at which it takes them
to act. Times are integer nanoseconds, (N, 1), or (1, 1) when all simulations are alike.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np

from lwa4d_sim.interfaces import NS_PER_S, ArmModel, Array, IntArray, JointState, Ns

# Integration step at most [s]. Measured: RK4 then meets the plant to 1e-9 rad over 21 ms on smooth motions; the
# error falls with the fourth power of the step.
LONGEST_STEP = 0.005
# A forecast goes no faster [rad/s]; the plant counts an arm as lost there (docs/timing.md), and numbers stay finite.
FASTEST = 1000.0
# Commands remembered; measurements older than that many periods are beyond any forecast (assumed).
REMEMBERED = 100


@dataclass(frozen=True, slots=True)
class Schedule:
    """When the loop usually does what.

    Attributes:
        period: control period T [ns].
        latency: from a sample to its arrival [ns], (N, 1) or (1, 1).
        acts: from tick k T to the instant its command begins to act [ns], (N, n), or (N, 1) or (1, 1) where joints or
            simulations are alike; None for as soon as it is computed.
    """

    period: Ns
    latency: IntArray
    acts: IntArray | None

    def due(self, now: Ns) -> IntArray:
        """Instant of the newest sample that should have arrived by ``now``."""
        due: IntArray = (now - self.latency) // self.period * self.period
        return due

    def acting(self, k: int, now: Ns) -> IntArray:
        """Instant from which the command of tick ``k``, computed at ``now``, acts."""
        return np.array([[now]], np.int64) if self.acts is None else k * self.period + self.acts


class Forecast:
    """Integrates M(q) ddq + h(q, dq) = tau + disturbance with the commands as the drives apply them.

    A command is limited to the torque limit and held until the next one acts. Before the first one acts the arm is
    braked and stands still. Lost commands, late-data policies and friction are not known here.

    Args:
        model: what the controller believes about the arm.
        tau_max: torque limit (n,) [N m].
        schedule: when commands act.
        shape: (N, n).

    Attributes:
        disturbance: torque (N, n) [N m] that acts besides the commands, as far as it is known; zero until set.
    """

    def __init__(self, model: ArmModel, tau_max: Array, schedule: Schedule, shape: tuple[int, int]) -> None:
        self.model, self.schedule = model, schedule
        self._low, self._high = -tau_max, tau_max
        self._steps = max(1, -(-schedule.period // round(LONGEST_STEP * NS_PER_S)))
        self._commands: deque[tuple[IntArray, Array]] = deque(maxlen=REMEMBERED)
        self.disturbance = np.zeros(shape)

    def issue(self, k: int, now: Ns, tau: Array) -> None:
        """Remember the command (N, n) of tick ``k``; NaN is a closed brake."""
        self._commands.append((self.schedule.acting(k, now), np.minimum(np.maximum(tau, self._low), self._high)))

    def forget(self, before: IntArray) -> None:
        """Let go of commands that act only before the instants ``before``, in every simulation."""
        oldest = before.min()
        while len(self._commands) > 1 and self._commands[1][0].max() <= oldest:
            self._commands.popleft()

    def advance(self, state: JointState, since: IntArray, until: IntArray) -> JointState:
        """The state at ``until`` of the arm that has ``state`` at ``since``; unchanged where that is no later.

        Classical Runge-Kutta of order 4, a fixed number of steps from one command to the next.
        """
        q, dq = state
        for begin, end in self._stretches(since, until):
            tau = self._torque(begin)
            braked = np.isnan(tau).any(axis=1, keepdims=True)
            h = np.where(braked, 0.0, (end - begin) / (NS_PER_S * self._steps))
            if h.any():
                tau = np.where(braked, 0.0, tau) + self.disturbance
                q_new, dq_new = q, dq
                for _ in range(self._steps):
                    q_new, dq_new = self._step(q_new, dq_new, tau, h)
                q, dq = np.where(h > 0, q_new, q), np.where(h > 0, dq_new, dq)
        return JointState(q, dq)

    def mean_torque(self, since: IntArray, until: IntArray) -> Array:
        """Mean command (N, n) that acted from ``since`` to ``until``; NaN where a brake was closed meanwhile."""
        total, span = np.zeros_like(self.disturbance), np.maximum(until - since, 1)
        for begin, end in self._stretches(since, until):
            share = (end - begin) / span
            total = np.where(share > 0, total + share * self._torque(begin), total)
        return total

    def _stretches(self, since: IntArray, until: IntArray) -> list[tuple[IntArray, IntArray]]:
        """The time from ``since`` to ``until``, cut where commands begin to act; a stretch may be empty for some.

        An empty stretch changes nothing, so a simulation's bits do not depend on its neighbours' cuts.
        """
        first, last = since.min(), until.max()
        within = [acts for acts, _ in self._commands if acts.max() > first and acts.min() < last]
        rows = max(len(each) for each in (since, until, *within))
        cuts = np.concatenate(
            [np.broadcast_to(np.clip(each, since, np.maximum(since, until)), (rows, each.shape[1])) for each in within]
            + [np.broadcast_to(each, (rows, 1)) for each in (since, np.maximum(since, until))],
            axis=1,
        )
        cuts.sort(axis=1)
        pairs = [(cuts[:, i : i + 1], cuts[:, i + 1 : i + 2]) for i in range(cuts.shape[1] - 1)]
        return [(begin, end) for begin, end in pairs if (end > begin).any()]

    def _torque(self, at: IntArray) -> Array:
        """Command (N, n) that acts from the instants ``at`` on; NaN where none has acted yet."""
        tau = np.full_like(self.disturbance, np.nan)
        for acts, value in self._commands:
            tau = np.where(acts <= at, value, tau)
        return tau

    def _step(self, q: Array, dq: Array, tau: Array, h: Array) -> tuple[Array, Array]:
        a1 = self._acceleration(q, dq, tau)
        v2 = _bounded(dq + 0.5 * h * a1)
        a2 = self._acceleration(q + 0.5 * h * dq, v2, tau)
        v3 = _bounded(dq + 0.5 * h * a2)
        a3 = self._acceleration(q + 0.5 * h * v2, v3, tau)
        v4 = _bounded(dq + h * a3)
        a4 = self._acceleration(q + h * v3, v4, tau)
        q_new = q + h / 6.0 * (dq + 2.0 * v2 + 2.0 * v3 + v4)
        return q_new, _bounded(dq + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4))

    def _acceleration(self, q: Array, dq: Array, tau: Array) -> Array:
        terms = self.model.at(q, dq)
        ddq: Array = np.linalg.solve(terms.M, (tau - terms.h)[..., None])[..., 0]
        return ddq


def _bounded(dq: Array) -> Array:
    return np.minimum(np.maximum(dq, -FASTEST), FASTEST)
