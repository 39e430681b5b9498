"""PD gains that follow the arm's inertia: scheduled with it, and damped no more than a late loop can bear."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from lwa4d_sim.controllers.task import apply
from lwa4d_sim.interfaces import Array

GainSchedule = Literal["none", "diagonal", "inertia"]


@dataclass(frozen=True, slots=True)
class Shaping:
    """The force K e + D de of a PD law whose gains depend on the pose, in joint space or on a task's axes.

    With W the inertia there, M(q) or Lambda(q) = (J M^-1 J^T)^-1, and w its diagonal:

        none      K = diag(kp)      D = diag(kd)
        diagonal  K = diag(w kp)    D = diag(w kd)
        inertia   K = W diag(kp)    D = W diag(kd)

    so with `inertia` and equal gains the error obeys dde + kd de + kp e = 0 in every direction at every pose, but for
    the Coriolis torque that PD control leaves alone (gain scheduling; compare the inner loop of Khatib 1987).

    The damping limit: with W = L L^T and the eigenvalues of L^-1 D L^-T = V diag(lambda) V^T [1/s], which do not depend
    on the square root taken,

        D' = L V diag(min(lambda, beta / T_d)) V^T L^T

    Along an eigenvector the arm is a mass 1 with a damper lambda that acts T_d late, dv/dt = -lambda v(t - T_d). Its
    loop lambda e^(-s T_d) / s crosses 1 at lambda [rad/s] with a phase margin of pi/2 - lambda T_d: beta is the phase
    [rad] that the delay may cost there, and at beta = pi/2 it would be all. Colgate and Schenkel (1997) bound a sampled
    damper by the physical damping of the joint; an arm that has none can be damped, but never passively, so this rule
    bounds the phase instead. With `inertia` D is W diag(kd), whose eigenvalues are the gains: they are limited.

    Attributes:
        schedule: how the gains follow the inertia.
        bound: largest eigenvalue beta / T_d [1/s], (N, 1), infinite for none; None when no simulation has a limit.
    """

    schedule: GainSchedule
    bound: Array | None

    @property
    def idle(self) -> bool:
        """The gains are constant: kp e + kd de is all there is to do."""
        return self.schedule == "none" and self.bound is None

    def force(self, kp: Array, kd: Array, error: Array, rate: Array, inertia: Array) -> Array:
        """K ``error`` + D' ``rate``, (N, m), from gains (N or 1, m) and the inertia W (N, m, m)."""
        if self.schedule == "inertia":
            limited = kd if self.bound is None else np.minimum(kd, self.bound)
            return apply(inertia, kp * error + limited * rate)
        if self.schedule == "diagonal":
            own = np.diagonal(inertia, axis1=-2, axis2=-1)
            kp, kd = own * kp, own * kd
        damping = kd * rate
        if self.bound is not None:
            needed, limited = _limited(np.broadcast_to(kd, rate.shape), inertia, self.bound)
            damping = np.where(needed, apply(limited, rate), damping)
        total: Array = kp * error + damping
        return total


def bounds(limits: Sequence[float | None], delays: Sequence[float]) -> Array | None:
    """Bound of the damping's eigenvalues beta / T_d [1/s], (N, 1); infinite without limit or delay, None if all are."""
    rows = [
        np.inf if beta is None or delay == 0.0 else beta / delay for beta, delay in zip(limits, delays, strict=True)
    ]
    return np.array(rows)[:, None] if np.isfinite(rows).any() else None


def _limited(kd: Array, inertia: Array, bound: Array) -> tuple[Any, Array]:
    """Whether the limit acts (N, 1), and the damping matrix (N, m, m) with its eigenvalues limited."""
    L = np.linalg.cholesky(inertia)
    root = np.linalg.solve(L, np.sqrt(kd)[..., None] * np.eye(kd.shape[-1]))  # L^-1 diag(sqrt(kd))
    values, V = np.linalg.eigh(root @ np.swapaxes(root, -1, -2))
    LV = L @ V
    return values[:, -1:] > bound, (LV * np.minimum(values, bound)[:, None, :]) @ np.swapaxes(LV, -1, -2)
