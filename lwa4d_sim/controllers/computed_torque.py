"""Computed torque (inverse dynamics) control, in joint or task space (thesis, sections 4.3.3 and 4.3.4)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from lwa4d_sim.controllers.belief import Belief
from lwa4d_sim.controllers.gains import Gain, gain_rows
from lwa4d_sim.controllers.task import Posture, PostureLaw, apply, operational_space, task_state
from lwa4d_sim.interfaces import (
    STRICT,
    ArmModel,
    Array,
    Controller,
    JointReference,
    JointState,
    Positive,
    TaskReference,
)


@dataclass(frozen=True, kw_only=True)
class ComputedTorque:
    """Computed torque: the arm's own dynamics cancelled, a chosen linear error dynamics in their place.

    joint: tau = M (ddq_ref + Kd (dq_ref - dq) + Kp (q_ref - q)) + h;
    task: tau = M J^-1 (ddx_ref + Kd (dx_ref - J dq) + Kp (x_ref - x) - dJ dq) + h, with the dynamically consistent
    inverse and a null-space posture term for a redundant arm. With p both error poles lie at -p. With ``friction`` the
    friction that the model has at the desired speed is added; it follows the reference, so no loop sees it.

    Attributes:
        space: where the error is taken.
        p: double pole [rad/s]: Kp = p^2, Kd = 2 p. Give either p or kp and kd.
        kp: stiffness [1/s^2], one number or one per joint (task axis).
        kd: damping [1/s], likewise.
        posture: null-space term of a redundant arm in task space [1/s^2, 1/s].
        friction: feed the model's friction forward; joint space only.
        model: what the controller believes about the arm.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["computed_torque"] = "computed_torque"
    space: Literal["joint", "task"] = "joint"
    p: Positive | None = None
    kp: Gain | None = None
    kd: Gain | None = None
    posture: Posture = Posture()
    friction: bool = False
    model: Belief = Belief()

    def __post_init__(self) -> None:
        """Check that the gains are given exactly one way, and that friction is fed forward in joint space.

        Raises:
            ValueError: both p and kp/kd, or neither, or only one of kp and kd; or friction in task space.
        """
        if self.friction and self.space == "task":
            raise ValueError("friction is fed forward in joint space only: a task reference has no joint speeds")
        if (self.p is None) == (self.kp is None and self.kd is None) or (self.kp is None) != (self.kd is None):
            raise ValueError("give either p, or both kp and kd")

    @property
    def gains(self) -> tuple[Gain, Gain]:
        """(kp, kd), from p where p was given."""
        if self.p is not None:
            return self.p**2, 2.0 * self.p
        assert self.kp is not None
        assert self.kd is not None
        return self.kp, self.kd

    @staticmethod
    def build(rows: Sequence["ComputedTorque"], n: int, task_size: int) -> Controller:
        """The control law of N simulations, one row of parameters each."""
        return _JointComputedTorque(rows, n) if rows[0].space == "joint" else _TaskComputedTorque(rows, n, task_size)


class _JointComputedTorque:
    def __init__(self, rows: Sequence[ComputedTorque], n: int) -> None:
        self._kp = gain_rows([row.gains[0] for row in rows], n, "kp")
        self._kd = gain_rows([row.gains[1] for row in rows], n, "kd")
        self._with_friction = np.array([[float(row.friction)] for row in rows])

    def torque(self, state: JointState, ref: JointReference, model: ArmModel) -> Array:
        terms = model.at(state.q, state.dq)
        a = ref.ddq + self._kd * (ref.dq - state.dq) + self._kp * (ref.q - state.q)
        tau = apply(terms.M, a) + terms.h
        return tau + self._with_friction * model.friction(ref.dq) if self._with_friction.any() else tau


class _TaskComputedTorque:
    def __init__(self, rows: Sequence[ComputedTorque], n: int, task_size: int) -> None:
        self._kp = gain_rows([row.gains[0] for row in rows], task_size, "kp")
        self._kd = gain_rows([row.gains[1] for row in rows], task_size, "kd")
        self._posture = PostureLaw([row.posture for row in rows], n) if n > task_size else None

    def torque(self, state: JointState, ref: TaskReference, model: ArmModel) -> Array:
        terms = model.at(state.q, state.dq)
        task = task_state(state, ref, terms)
        m = task.J.shape[-2]
        a = task.acceleration_ref + self._kd * (task.rate_ref - task.rate) + self._kp * task.error
        a = a - terms.dJ_dq(state.dq)[:, :m]
        space = operational_space(task.J, terms.M)
        tau = apply(np.swapaxes(task.J, -1, -2), space.force(a)) + terms.h
        if self._posture is None:
            return tau
        return tau + space.null_torque(apply(terms.M, self._posture(state, ref)), task.J)
