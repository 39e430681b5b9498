"""What the task-space laws share: tool error, operational-space inertia and the null space of the task."""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from lwa4d_sim.controllers.gains import Gain, gain_rows
from lwa4d_sim.interfaces import STRICT, Array, JointState, RigidBodyTerms, TaskReference
from lwa4d_sim.rotations import rotation_vector

# Below this smallest singular value of J (m for the rows of a 3-D task, mixed m and 1 for a 6-D one) the inverse is
# damped; assumed: half the smallest value on the shipped 7-DOF motion, so that only bad poses are touched.
SINGULAR_BELOW = 0.03
# Largest damping as a share of the mean eigenvalue of J M^-1 J^T (assumed: keeps the condition number below about 100).
LARGEST_DAMPING = 0.01


@dataclass(frozen=True, kw_only=True)
class Posture:
    """Null-space term of a redundant arm: PD towards the posture of the reference, felt by no task axis.

    Attributes:
        kp: stiffness [N m/rad] (pd_gravity) or [1/s^2] (computed_torque), one number or one per joint.
        kd: damping [N m s/rad] or [1/s], likewise.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    kp: Gain = 0.0
    kd: Gain = 0.0


@dataclass(frozen=True, slots=True)
class TaskState:
    """Tool error and rate for a task of m = 3 (point) or 6 (pose) rows; ``J`` (N, m, n)."""

    J: Array
    error: Array
    rate: Array
    rate_ref: Array
    acceleration_ref: Array


def task_state(state: JointState, ref: TaskReference, terms: RigidBodyTerms) -> TaskState:
    """Tool error (reference minus actual) in the base frame.

    The orientation error is the rotation vector of R_ref R^T (Caccavale et al. 1998, angle-axis error).
    """
    pose = terms.pose
    if ref.R is None or ref.w is None or ref.dw is None:
        J = terms.J[:, :3]
        error, rate_ref, acceleration_ref = ref.x - pose.x, ref.dx, ref.ddx
    else:
        J = terms.J
        turn = rotation_vector(ref.R @ np.swapaxes(pose.R, -1, -2))
        error = np.concatenate([ref.x - pose.x, turn], axis=-1)
        rate_ref = np.concatenate([ref.dx, ref.w], axis=-1)
        acceleration_ref = np.concatenate([ref.ddx, ref.dw], axis=-1)
    return TaskState(J, error, apply(J, state.dq), rate_ref, acceleration_ref)


def apply(A: Array, v: Array) -> Array:
    """Matrix-vector product of stacks: (N, m, n) and (N, n) to (N, m)."""
    product: Array = np.matmul(A, v[..., None])[..., 0]
    return product


@dataclass(frozen=True, slots=True)
class OperationalSpace:
    """Task inertia and null space at one configuration (Khatib 1987), damped near singularities."""

    Minv_JT: Array  # (N, n, m)
    mobility: Array  # J M^-1 J^T, damped (N, m, m)

    def force(self, acceleration: Array) -> Array:
        """Task force that gives the task acceleration (N, m): Lambda a."""
        return np.linalg.solve(self.mobility, acceleration[..., None])[..., 0]

    def null_torque(self, tau: Array, J: Array) -> Array:
        """The part of the joint torque ``tau`` (N, n) that gives the task no acceleration: (I - J^T Jbar^T) tau."""
        return tau - apply(np.swapaxes(J, -1, -2), self.force(apply(np.swapaxes(self.Minv_JT, -1, -2), tau)))


def operational_space(J: Array, M: Array) -> OperationalSpace:
    """Task mobility J M^-1 J^T with variable damping: zero away from singularities (Nakamura and Hanafusa 1986)."""
    Minv_JT = np.linalg.solve(M, np.swapaxes(J, -1, -2))
    mobility = J @ Minv_JT
    smallest = np.linalg.svd(J, compute_uv=False)[..., -1]
    closeness = np.maximum(0.0, 1.0 - (smallest / SINGULAR_BELOW) ** 2)
    if closeness.any():
        m = J.shape[-2]
        mean = np.trace(mobility, axis1=-2, axis2=-1) / m
        mobility = mobility + (LARGEST_DAMPING * closeness * mean)[..., None, None] * np.eye(m)
    return OperationalSpace(Minv_JT, mobility)


class PostureLaw:
    """PD towards the reference posture, in whatever unit the caller's gains have."""

    def __init__(self, rows: list[Posture], n: int) -> None:
        self._kp = gain_rows([row.kp for row in rows], n, "posture.kp")
        self._kd = gain_rows([row.kd for row in rows], n, "posture.kd")

    def __call__(self, state: JointState, ref: TaskReference) -> Array:
        """Kp (q_posture - q) - Kd dq, (N, n)."""
        pull = -self._kd * state.dq
        return pull if ref.posture is None else pull + self._kp * (ref.posture - state.q)
