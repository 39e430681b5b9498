"""Running trajectories: a motion laid down in joint space or in task space, read in either.

A motion laid down in one space is carried to the other by the forward or the inverse kinematics, sample by sample.
"""

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lwa4d_sim.errors import KinematicsError, SingularError, TrajectoryError
from lwa4d_sim.interfaces import Array, IntArray, JointReference, Pose, TaskReference
from lwa4d_sim.polynomials import HALF_NS, PiecewisePolynomial
from lwa4d_sim.rotations import rotation_matrix, rotation_vector

Curve = Callable[[Array], tuple[Array, Array, Array]]  # t (K,) -> position, velocity, acceleration, each (K, m)

POSE_JOINTS = 6  # an arm with this many joints or more can choose its tool's orientation
BRANCH_TOLERANCE = 1e-6  # [rad] assumed: above the rounding of an inverse, far below the distance of two branches
STEP = 1e-3  # of a segment's time, derived: rounding and truncation of the second difference are then about equal
STENCIL = np.arange(-2, 3)
FIRST, SECOND = np.array([1, -8, 0, 8, -1]) / 12, np.array([-1, 16, -30, 16, -1]) / 12  # fourth-order differences


class Kinematics(Protocol):
    """What a motion needs to know of the arm; shapes as in `lwa4d_sim.kinematics`."""

    def point(self, q: Array) -> Array:
        """Tool point (..., 3) [m] at ``q`` (..., n)."""
        ...

    def fk(self, q: Array) -> Pose:
        """Tool pose at ``q`` (..., n)."""
        ...

    def jacobian(self, q: Array) -> Array:
        """Tool Jacobian (..., 6, n), linear rows first."""
        ...

    def jacobian_rate(self, q: Array, dq: Array) -> Array:
        """Time derivative of the Jacobian (..., 6, n)."""
        ...

    def ik(
        self,
        x: Array,
        R: Array | None = None,
        *,
        elbow: Literal["up", "down"] = "up",
        arm_angle: Array | float = 0.0,
        near: Array | None = None,
    ) -> Array:
        """Joint angles (..., n), nearest to ``near``, that put the tool at ``x`` (..., 3) with orientation ``R``."""
        ...


@runtime_checkable
class RedundantKinematics(Kinematics, Protocol):
    """An arm whose self-motion is told by one angle."""

    def arm_angle_of(self, q: Array) -> Array:
        """Arm angle (...) [rad] at ``q`` (..., n), which `ik` takes with the elbow up."""
        ...


@dataclass(frozen=True, eq=False)
class JointMotion:
    """A motion laid down in joint space.

    Attributes:
        kinematics: the arm.
        knots: end time of each segment [s], (S,).
        curve: joint angles and their rates as functions of time within [0, knots[-1]].
    """

    kinematics: Kinematics
    knots: Array
    curve: Curve

    @property
    def duration(self) -> float:
        """Length of the motion [s]."""
        return float(self.knots[-1])

    def joint(self, t: Array) -> JointReference:
        """The motion itself at the times ``t`` (K,) [s]."""
        return JointReference(*_resting(self.curve, t, self.duration))

    def tool_point(self, t: Array) -> Array:
        """Where the tool point is at the times ``t`` (K,) [s], (K, 3)."""
        return self.kinematics.point(self.joint(t).q)

    def task(self, t: Array) -> TaskReference:
        """What the tool does at the times ``t`` (K,) [s]: dx = J dq, ddx = J ddq + dJ dq; the posture is the motion."""
        q, dq, ddq = _resting(self.curve, t, self.duration)
        pose, J = self.kinematics.fk(q), self.kinematics.jacobian(q)
        v = _times(J, dq)
        a = _times(J, ddq) + _times(self.kinematics.jacobian_rate(q, dq), dq)
        if q.shape[-1] < POSE_JOINTS:
            return TaskReference(pose.x, v[:, :3], a[:, :3], posture=q)
        return TaskReference(pose.x, v[:, :3], a[:, :3], pose.R, v[:, 3:], a[:, 3:], posture=q)


@dataclass(frozen=True, eq=False)
class Turn:
    """Orientation that turns in each segment about an axis fixed in the base: R = exp(s turn) R_start (slerp).

    Attributes:
        progress: the time law, a curve through 0, 1, ..., S at the knots, so s = progress - segment.
        start: orientation at the start of each segment, (S, 3, 3).
        turn: the shortest rotation to the next knot, in the base frame [rad], (S, 3).
    """

    progress: PiecewisePolynomial
    start: Array
    turn: Array

    @classmethod
    def through(cls, R: Array, progress: PiecewisePolynomial) -> "Turn":
        """Turn through the orientations ``R`` (S + 1, 3, 3) at the knots."""
        return cls(progress, R[:-1], rotation_vector(R[1:] @ np.swapaxes(R[:-1], -1, -2)))

    def at(self, segment: IntArray, local: Array) -> Array:
        """Orientation (K, 3, 3) at a time (K,) [s] since the start of the segment (K,)."""
        s = self.progress.at(segment, local) - segment[:, None]
        return np.asarray(rotation_matrix(s * self.turn[segment]) @ self.start[segment])


@dataclass(frozen=True, eq=False)
class TaskMotion:
    """A motion laid down in task space.

    Attributes:
        kinematics: the arm.
        point: path of the tool point [m], m = 3.
        turn: orientation of the tool, or None for an arm that cannot choose it.
        posture: joint angles at the knots joined by the same time law [rad], m = n.
        arm_angle: of a redundant arm, joined likewise [rad], m = 1; None for an arm that has none.
        elbow: branch of the inverse kinematics of an arm without arm angle.
    """

    kinematics: Kinematics
    point: PiecewisePolynomial
    turn: Turn | None
    posture: PiecewisePolynomial
    arm_angle: PiecewisePolynomial | None
    elbow: Literal["up", "down"]

    @property
    def knots(self) -> Array:
        """End time of each segment [s], (S,)."""
        return self.point.knots

    @property
    def duration(self) -> float:
        """Length of the motion [s]."""
        return float(self.knots[-1])

    def tool_point(self, t: Array) -> Array:
        """Where the tool point is at the times ``t`` (K,) [s], (K, 3)."""
        return _resting(self.point, t, self.duration)[0]

    def task(self, t: Array) -> TaskReference:
        """The motion itself at the times ``t`` (K,) [s]."""
        x, dx, ddx = _resting(self.point, t, self.duration)
        posture = _resting(self.posture, t, self.duration)[0]
        if self.turn is None:
            return TaskReference(x, dx, ddx, posture=posture)
        segment, local = self.point.locate(t)
        _, ds, dds = _resting(self.turn.progress, t, self.duration)
        axis = self.turn.turn[segment]
        return TaskReference(x, dx, ddx, self.turn.at(segment, local), ds * axis, dds * axis, posture)

    def joint(self, t: Array) -> JointReference:
        """What the joints do at the times ``t`` (K,) [s]: of the inverse's solutions those nearest to the posture.

        The tool's motion is met exactly: dq = J^-1 dx and ddq = J^-1 (ddx - dJ dq). The self-motion of an arm with more
        joints than that (the part in the null space of J) comes from five-point differences of the inverse kinematics;
        measured on a smooth path, it is good to 1e-9 of the joint speed and acceleration.

        Raises:
            KinematicsError: (as one of its subclasses) the arm cannot follow the path; the message says when.
            TrajectoryError: the posture at a knot is not on the branch of the inverse kinematics.
        """
        _ = self._knots_on_branch
        t = np.asarray(t, dtype=float)
        segment, local = self.point.locate(t)
        q = self._inverse(segment, local)
        ref = self.task(t)
        v = ref.dx if ref.w is None else np.concatenate([ref.dx, ref.w], axis=-1)
        a = ref.ddx if ref.dw is None else np.concatenate([ref.ddx, ref.dw], axis=-1)
        rows = v.shape[-1]
        J = self.kinematics.jacobian(q)[:, :rows]
        dq = ddq = np.zeros_like(q)
        J_inverse: Array
        if rows == q.shape[-1]:
            J_inverse = _inverses(J, np.asarray((v == 0).all(axis=-1) & (a == 0).all(axis=-1)), t)
        else:
            J_inverse = np.asarray(np.linalg.pinv(J), dtype=float)
            if rows < q.shape[-1]:
                moving = _moving(t, self.duration)
                dq, ddq = (np.where(moving, rate, 0.0) for rate in self._differences(segment, local))
        dq = dq + _times(J_inverse, v - _times(J, dq))
        dJ = self.kinematics.jacobian_rate(q, dq)[:, :rows]
        return JointReference(q, dq, ddq + _times(J_inverse, a - _times(dJ, dq) - _times(J, ddq)))

    @cached_property
    def _knots_on_branch(self) -> bool:
        """True, or an error where the posture at a knot is not what the inverse gives: the joints would jump there."""
        t = np.array([0.0, *self.knots])
        segment, local = self.point.locate(t)
        posture = self.posture.at(segment, local)
        q = self._inverse(segment, local)
        gap = np.abs(q - posture).max(axis=-1)
        k = int(gap.argmax())
        if gap[k] > BRANCH_TOLERANCE:
            raise TrajectoryError(
                f"task path at t = {t[k]:.6g} s: the joints would jump, because the posture "
                f"{np.round(posture[k], 4).tolist()} rad is not what the inverse kinematics gives with "
                f"elbow = {self.elbow!r}, {np.round(q[k], 4).tolist()} rad; choose the other elbow, or a start and "
                "waypoints on this branch"
            )
        return True

    def _inverse(self, segment: IntArray, local: Array) -> Array:
        """Joint angles (K, n) nearest to the posture at times (K,) [s] since the starts of the segments (K,)."""
        x = self.point.at(segment, local)
        R = None if self.turn is None else self.turn.at(segment, local)
        near = self.posture.at(segment, local)
        psi = None if self.arm_angle is None else self.arm_angle.at(segment, local)[:, 0]

        def solve(samples: slice) -> Array:
            target, nearby = (x[samples], None if R is None else R[samples]), near[samples]
            if psi is None:
                return self.kinematics.ik(*target, elbow=self.elbow, near=nearby)
            return self.kinematics.ik(*target, arm_angle=psi[samples], near=nearby)

        def fails(count: int) -> bool:
            try:
                solve(slice(count))
            except KinematicsError:
                return True
            return False

        try:
            return solve(slice(None))
        except KinematicsError:
            k = bisect_left(range(len(x)), True, key=lambda k: fails(k + 1))
        t = (self.knots - self.point.lengths)[segment[k]] + local[k]
        try:
            return solve(slice(k, k + 1))
        except KinematicsError as error:
            raise type(error)(f"task path at t = {t:.6g} s: {error}") from error

    def _differences(self, segment: IntArray, local: Array) -> tuple[Array, Array]:
        """Rates dq, ddq (K, n) of the inverse kinematics, each segment's polynomials run past its ends."""
        h = STEP * self.point.lengths[segment][:, None]
        times = local[:, None] + STENCIL * h
        around = self._inverse(np.repeat(segment, len(STENCIL)), times.ravel()).reshape(*times.shape, -1)
        return np.einsum("s,ksn->kn", FIRST, around) / h, np.einsum("s,ksn->kn", SECOND, around) / h**2


def _times(A: Array, v: Array) -> Array:
    """Products (K, m) of the matrices (K, m, n) with the vectors (K, n)."""
    return np.asarray((A @ v[..., None])[..., 0])


def _moving(t: Array, duration: float) -> NDArray[np.bool_]:
    """Whether the times (K,) lie within the motion, (K, 1)."""
    return np.asarray((t >= 0.0) & (t < duration - HALF_NS))[:, None]


def _resting(curve: Curve, t: Array, duration: float) -> tuple[Array, Array, Array]:
    """The curve within [0, duration]; before and after it the end positions at rest."""
    t = np.asarray(t, dtype=float)
    p, dp, ddp = curve(np.clip(t, 0.0, duration))
    moving = _moving(t, duration)
    return p, np.where(moving, dp, 0.0), np.where(moving, ddp, 0.0)


def _inverses(J: Array, at_rest: NDArray[np.bool_], t: Array) -> Array:
    """Inverses (K, n, n) at the times (K,), or an error; a singular arm does no harm where the tool rests."""
    J = np.where(at_rest[:, None, None], np.eye(J.shape[-1]), J)
    try:
        return np.asarray(np.linalg.inv(J), dtype=float)
    except np.linalg.LinAlgError as error:
        k = int(np.abs(np.linalg.det(J)).argmin())
        raise SingularError(
            f"task path at t = {t[k]:.6g} s: the arm is singular, so no joint speed gives the tool's velocity; "
            "lead the path around"
        ) from error
