"""Choosing among the branches of a closed-form inverse: joint limits, whole turns, nearness, paths.

The formulas themselves are in ``kinematics``.
"""

from abc import abstractmethod

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lwa4d_sim.chain import Elbow, SerialKinematics, describe
from lwa4d_sim.errors import JointLimitError, KinematicsError, SingularError
from lwa4d_sim.interfaces import Array, IntArray

ANGLE = 1e-9  # [rad] a joint this far beyond its limit is at it: above rounding, below what any drive resolves
TURN = 2.0 * np.pi


class ClosedFormKinematics(SerialKinematics):
    """A chain whose inverse is a formula with several branches."""

    _undefined: tuple[str, ...]  # what the codes of _solve mean, from 1 on

    @abstractmethod
    def _solve(
        self, x: Array, R: ArrayLike | None, elbow: Elbow | None, arm_angle: ArrayLike, near: Array | None
    ) -> tuple[Array, IntArray]:
        """Branches (..., m, n) of the elbow, or of both (None), and a code (...), not 0 where angles come from near."""

    def ik(
        self,
        x: ArrayLike,
        R: ArrayLike | None = None,
        *,
        elbow: Elbow = "up",
        arm_angle: ArrayLike = 0.0,
        near: ArrayLike | None = None,
    ) -> Array:
        """Joint angles within the limits that put the tool at a target, each target on its own.

        Args:
            x: tool point [m], (..., 3).
            R: tool orientation (..., 3, 3): none for three joints, required for seven.
            elbow: above ("up") or below ("down") the line from the shoulder to the target (3 joints) or to the wrist
                (7 joints, where "down" adds pi to the arm angle).
            arm_angle: see ``SrsKinematics`` [rad], (...); three joints have none.
            near: joint angles (..., n). Of several branches the nearest (least sum of squares) is taken, and joints
                that the target leaves undefined stay as they are. Without it the branch wins whose largest share of a
                joint limit (of pi where there is none) is smallest.

        Returns:
            q (..., n) [rad].

        Raises:
            ReachError: a target lies outside the workspace.
            SingularError: a target leaves joints undefined, and there is no ``near``.
            JointLimitError: no branch lies within the joint limits, whole turns considered.
            KinematicsError: ``R``, ``elbow`` or ``arm_angle`` does not suit the arm.
        """
        _require_elbow(elbow)
        x, near = np.asarray(x, dtype=float), None if near is None else self._joints(near)
        return self._choose(x, self._branches(x, R, elbow, arm_angle, near), near)

    def ik_branches(
        self, x: ArrayLike, R: ArrayLike | None = None, arm_angle: ArrayLike = 0.0, near: ArrayLike | None = None
    ) -> Array:
        """All branches (..., m, n) in [-pi, pi], ordered as the class says, limits not applied; the rest as ``ik``."""
        near = None if near is None else self._joints(near)
        return wrap(self._branches(np.asarray(x, dtype=float), R, None, arm_angle, near))

    def ik_path(
        self,
        x: ArrayLike,
        R: ArrayLike | None = None,
        *,
        elbow: Elbow = "up",
        arm_angle: ArrayLike = 0.0,
        near: ArrayLike | None = None,
    ) -> Array:
        """Joint angles (K, n) along a path x (K, 3), R (K, 3, 3): each sample the one nearest to the sample before.

        Arguments and errors as ``ik``, with ``near`` (n,) for the first sample. Joints that a sample leaves undefined
        keep the angles of the sample before. Joints jump only where the path forces them to, at a limit or singularity.
        """
        _require_elbow(elbow)
        x = np.asarray(x, dtype=float)
        psi = np.broadcast_to(np.asarray(arm_angle, dtype=float), x.shape[:-1])
        Rs = None if R is None else np.broadcast_to(np.asarray(R, dtype=float), (len(x), 3, 3))
        branches, code = self._solve(x, R, elbow, arm_angle, None)
        q = np.empty((len(x), self.n))
        last = None if near is None else self._joints(near)
        for k in range(len(x)):
            if code[k]:
                q[k] = self.ik(x[k], None if Rs is None else Rs[k], elbow=elbow, arm_angle=psi[k], near=last)
            else:
                q[k] = self._choose(x[k], branches[k], last)
            last = q[k]
        return q

    def _branches(
        self, x: Array, R: ArrayLike | None, elbow: Elbow | None, arm_angle: ArrayLike, near: Array | None
    ) -> Array:
        branches, code = self._solve(x, R, elbow, arm_angle, near)
        if near is None and code.any():
            what, i = describe(x, code != 0)
            raise SingularError(
                f"{what} leaves {self._undefined[int(code.ravel()[i]) - 1]} undefined; valid with near, whose angles "
                "are then kept"
            )
        return branches

    def _choose(self, x: Array, branches: Array, near: Array | None) -> Array:
        """The best branch (..., n) of (..., m, n) within the limits."""
        centre = 0.0 if near is None else near[..., None, :]
        q = centre + wrap(branches - centre)
        q = q - TURN * np.maximum(np.ceil((q - self.upper - ANGLE) / TURN), 0.0)
        q = q + TURN * np.maximum(np.ceil((self.lower - q - ANGLE) / TURN), 0.0)
        excess = np.maximum(q - self.upper, self.lower - q)  # (..., m, n)
        allowed = (excess <= ANGLE).all(-1)
        solved = allowed.any(-1)
        if not solved.all():
            self._refuse(x, q, excess, solved)
        if near is None:
            limit = np.maximum(np.abs(self.lower), np.abs(self.upper))
            share = np.abs(q) / np.where(np.isfinite(limit), limit, np.pi)
            cost = share.max(-1) + 1e-6 * share.sum(-1)  # the sum decides between equals, so that rounding does not
        else:
            cost = ((q - centre) ** 2).sum(-1)
        best = np.where(allowed, cost, np.inf).argmin(-1)
        chosen = np.take_along_axis(q, best[..., None, None], axis=-2)[..., 0, :]
        return np.asarray(np.minimum(np.maximum(chosen, self.lower), self.upper))

    def _refuse(self, x: Array, q: Array, excess: Array, solved: NDArray[np.bool_]) -> None:
        """Name the joint that breaks its limit in the branch that comes closest to being allowed."""
        what, i = describe(x, ~solved)
        q, excess = q.reshape(-1, *q.shape[-2:])[i], excess.reshape(-1, *excess.shape[-2:])[i]
        branch = int(excess.max(-1).argmin())
        joint = int(excess[branch].argmax())
        raise JointLimitError(
            f"{what}: joint {self.chain.names[joint]!r} (={q[branch, joint]:.6g} rad) must be in "
            f"[{self.lower[joint]:.6g}, {self.upper[joint]:.6g}], and that is the closest of {len(q)} branches"
        )


def _require_elbow(elbow: str) -> None:
    if elbow not in ("up", "down"):
        raise KinematicsError(f"elbow (={elbow!r}) must be 'up' or 'down'")


def wrap(angle: Array) -> Array:
    """The same angle [rad] in [-pi, pi]."""
    return np.asarray(angle - TURN * np.round(angle / TURN))
