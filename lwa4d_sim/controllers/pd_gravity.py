"""PD control with gravity compensation, in joint or task space (thesis, sections 4.3.1 and 4.3.2)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from lwa4d_sim.controllers.belief import Belief
from lwa4d_sim.controllers.gains import Gain, gain_rows
from lwa4d_sim.controllers.task import Posture, PostureLaw, apply, operational_space, task_state
from lwa4d_sim.interfaces import STRICT, ArmModel, Array, Controller, JointReference, JointState, TaskReference


@dataclass(frozen=True, kw_only=True)
class PdGravity:
    """PD with gravity compensation.

    joint: tau = Kp (q_ref - q) + Kd (dq_ref - dq) + g(q);
    task: tau = J^T (Kp (x_ref - x) + Kd (dx_ref - J dq)) + g(q). A step reference has dq_ref = dx_ref = 0.

    Attributes:
        space: where the error is taken.
        kp: stiffness [N m/rad], or [N/m] and [N m/rad] in task space; one number or one per joint (task axis).
        kd: damping [N m s/rad], or [N s/m] and [N m s/rad].
        posture: null-space term of a redundant arm in task space [N m/rad, N m s/rad].
        model: what the controller believes about the arm.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["pd_gravity"] = "pd_gravity"
    space: Literal["joint", "task"] = "joint"
    kp: Gain
    kd: Gain
    posture: Posture = Posture()
    model: Belief = Belief()

    @staticmethod
    def build(rows: Sequence["PdGravity"], n: int, task_size: int) -> Controller:
        """The control law of N simulations, one row of parameters each."""
        return _JointPd(rows, n) if rows[0].space == "joint" else _TaskPd(rows, n, task_size)


class _JointPd:
    def __init__(self, rows: Sequence[PdGravity], n: int) -> None:
        self._kp = gain_rows([row.kp for row in rows], n, "kp")
        self._kd = gain_rows([row.kd for row in rows], n, "kd")

    def torque(self, state: JointState, ref: JointReference, model: ArmModel) -> Array:
        g = model.at(state.q).h
        return self._kp * (ref.q - state.q) + self._kd * (ref.dq - state.dq) + g


class _TaskPd:
    def __init__(self, rows: Sequence[PdGravity], n: int, task_size: int) -> None:
        self._kp = gain_rows([row.kp for row in rows], task_size, "kp")
        self._kd = gain_rows([row.kd for row in rows], task_size, "kd")
        self._posture = PostureLaw([row.posture for row in rows], n) if n > task_size else None

    def torque(self, state: JointState, ref: TaskReference, model: ArmModel) -> Array:
        terms = model.at(state.q)
        task = task_state(state, ref, terms)
        force = self._kp * task.error + self._kd * (task.rate_ref - task.rate)
        tau = apply(np.swapaxes(task.J, -1, -2), force) + terms.h
        if self._posture is None:
            return tau
        return tau + operational_space(task.J, terms.M).null_torque(self._posture(state, ref), task.J)
