"""PD control with gravity compensation, in joint or task space (thesis, sections 4.3.1 and 4.3.2)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from lwa4d_sim.controllers.belief import Belief
from lwa4d_sim.controllers.gains import Gain, gain_rows
from lwa4d_sim.controllers.shaping import GainSchedule, Shaping, bounds
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
        schedule: none, or gains in 1/s^2 and 1/s times the inertia's diagonal or the whole inertia (see `Shaping`).
        damping_limit: beta [rad]: no direction is damped faster than beta over the loop's delay (see `Shaping`).
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["pd_gravity"] = "pd_gravity"
    space: Literal["joint", "task"] = "joint"
    kp: Gain
    kd: Gain
    posture: Posture = Posture()
    model: Belief = Belief()
    schedule: GainSchedule = "none"
    damping_limit: Positive | None = None

    @staticmethod
    def build(rows: Sequence["PdGravity"], n: int, task_size: int, delays: Sequence[float] | None = None) -> Controller:
        """The control law of N simulations, one row of parameters each.

        Args:
            rows: the parameters.
            n: joints.
            task_size: rows of a task.
            delays: delay of each loop [s], for the damping limit; none by default.

        Raises:
            ScenarioError: gains of another length.
        """
        shaping = Shaping(rows[0].schedule, bounds([row.damping_limit for row in rows], delays or [0.0] * len(rows)))
        return _JointPd(rows, n, shaping) if rows[0].space == "joint" else _TaskPd(rows, n, task_size, shaping)


class _JointPd:
    def __init__(self, rows: Sequence[PdGravity], n: int, shaping: Shaping) -> None:
        self._shaping = shaping
        self._kp = gain_rows([row.kp for row in rows], n, "kp")
        self._kd = gain_rows([row.kd for row in rows], n, "kd")

    def torque(self, state: JointState, ref: JointReference, model: ArmModel) -> Array:
        terms = model.at(state.q)
        error, rate = ref.q - state.q, ref.dq - state.dq
        if self._shaping.idle:
            return self._kp * error + self._kd * rate + terms.h
        return self._shaping.force(self._kp, self._kd, error, rate, terms.M) + terms.h


class _TaskPd:
    def __init__(self, rows: Sequence[PdGravity], n: int, task_size: int, shaping: Shaping) -> None:
        self._shaping = shaping
        self._kp = gain_rows([row.kp for row in rows], task_size, "kp")
        self._kd = gain_rows([row.kd for row in rows], task_size, "kd")
        self._posture = PostureLaw([row.posture for row in rows], n) if n > task_size else None

    def torque(self, state: JointState, ref: TaskReference, model: ArmModel) -> Array:
        terms = model.at(state.q)
        task = task_state(state, ref, terms)
        rate = task.rate_ref - task.rate
        force: Array
        if self._shaping.idle:
            force = self._kp * task.error + self._kd * rate
        else:
            inertia = np.linalg.inv(operational_space(task.J, terms.M).mobility)
            inertia = 0.5 * (inertia + np.swapaxes(inertia, -1, -2))
            force = self._shaping.force(self._kp, self._kd, task.error, rate, inertia)
        tau = apply(np.swapaxes(task.J, -1, -2), force) + terms.h
        if self._posture is None:
            return tau
        return tau + operational_space(task.J, terms.M).null_torque(self._posture(state, ref), task.J)
