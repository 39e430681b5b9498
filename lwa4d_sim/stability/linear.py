"""The arm and its control law linearised at operating points: at rest at a pose, or along a motion."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lwa4d_sim.controllers import CustomController
from lwa4d_sim.dynamics import NominalModel
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import ArmModel, Array, Controller, IntArray, JointReference, JointState, TaskReference

# Step of the central differences [rad, rad/s]: truncation 1e-12 and rounding 1e-10 of the slopes are alike (derived).
STEP = 1e-5


@dataclass(frozen=True, slots=True)
class Linear:
    """Arm and law near P operating points, with x = (q, dq) - operating point.

    Attributes:
        A: dx/dt = A x + B tau of the plant, (P, 2n, 2n).
        B: (P, 2n, n).
        law: slope of the torque over the estimated state, (P, n, 2n), with the scenario's gains.
        bare: the same with all gains zero; what is left compensates gravity and inertia.
        A_model, B_model: as A and B, of the arm that the controller believes in, without springs and dampers.
        curve: slopes of the law (K, n, 2n) at some of the points with all gains times (K,), for a law that is not
            linear in its gains.
    """

    A: Array
    B: Array
    law: Array
    bare: Array
    A_model: Array
    B_model: Array
    curve: Callable[[IntArray, Array], Array] | None = None

    @property
    def n(self) -> int:
        """Number of joints."""
        return int(self.B.shape[2])

    @classmethod
    def of(cls, parts: Sequence[Array]) -> "Linear":
        """From all matrices, in the order of the attributes."""
        A, B, law, bare, A_model, B_model = parts
        return cls(A, B, law, bare, A_model, B_model)

    def pick(self, rows: IntArray) -> "Linear":
        """Some of the points."""
        curve = self.curve
        some = Linear.of([part[rows] for part in self.parts])
        return some if curve is None else replace(some, curve=lambda which, k: curve(rows[which], k))

    def with_arm(self, other: "Linear") -> "Linear":
        """This law on the arm of ``other``."""
        return replace(self, A=other.A, B=other.B)

    @property
    def parts(self) -> tuple[Array, ...]:
        """All matrices, in the order of the attributes."""
        return self.A, self.B, self.law, self.bare, self.A_model, self.B_model


def linearise_arm(arm: NominalModel, q: Array, dq: Array, ddq: Array, *, passive: bool = True) -> tuple[Array, Array]:
    """A (P, 2n, 2n) and B (P, 2n, n) of an arm near a motion.

    ddq(q, dq, tau) = M^-1 (tau - h + passive), with the torque that the motion needs; central differences in q and dq.
    Coulomb friction is left out: a slope at rest it has not.

    Args:
        arm: for `rows_needed` arms.
        q: operating points (P, n) [rad].
        dq: their speeds [rad/s].
        ddq: their accelerations [rad/s^2].
        passive: with springs and dampers.
    """
    P, n = q.shape
    rows = _rows(q, dq, n)
    arm.at(*rows)
    M, load = arm.M, arm.h - arm.passive if passive else arm.h
    blocks = load.reshape(P, 4 * n + 1, n)
    inertia = M.reshape(P, 4 * n + 1, n, n)
    tau = (inertia[:, -1] @ ddq[..., None])[..., 0] + blocks[:, -1]
    acceleration = np.linalg.solve(inertia, (tau[:, None] - blocks)[..., None])[..., 0]
    A = np.zeros((P, 2 * n, 2 * n))
    A[:, :n, n:] = np.eye(n)
    A[:, n:] = _slopes(acceleration, n)
    B = np.zeros((P, 2 * n, n))
    B[:, n:] = np.linalg.inv(inertia[:, -1])
    return A, B


def linearise_law(
    controller: Controller, model: ArmModel, q: Array, dq: Array, ref: Any, *, own: bool = False
) -> Array:
    """Slope of the torque over the estimated state, (P, n, 2n), by central differences of the law itself.

    Args:
        controller: the law.
        model: what it believes, for P (4n + 1) arms.
        q: operating points (P, n) [rad].
        dq: their speeds [rad/s].
        ref: JointReference or TaskReference with leading axis P.
        own: whether the law is a user's, which is asked twice, for it may have a memory.

    Raises:
        ScenarioError: the law fails, has a memory, or has no finite slope.
    """
    P, n = q.shape
    rows = _rows(q, dq, n)
    repeated = type(ref)(*(None if field is None else np.repeat(field, 4 * n + 1, axis=0) for field in ref))
    try:
        tau = controller.torque(JointState(*rows), repeated, model)
        again = controller.torque(JointState(*rows), repeated, model) if own else tau
    except ScenarioError as error:
        rule = f"it was asked for {len(rows[0])} arms at once, and a law with a memory, or for one arm, has no slope"
        raise ScenarioError(f"{error}; {rule}" if own else str(error), key=error.key) from error
    if not np.array_equal(tau, again, equal_nan=True):
        rule = "torque() answers differently when asked the same again; a law with a memory cannot be linearised"
        raise ScenarioError(rule)
    with np.errstate(invalid="ignore"):
        slopes = _slopes(tau.reshape(P, 4 * n + 1, n), n)
    if not np.isfinite(slopes).all():
        raise ScenarioError(f"torque() has no finite slope near q = {_told(q[~np.isfinite(slopes).all((1, 2))][0])}")
    return slopes


def _told(q: Array) -> str:
    return ", ".join(f"{angle:.4g}" for angle in q)


def rows_needed(points: int, n: int) -> int:
    """Number of arms that are evaluated at once for some operating points."""
    return points * (4 * n + 1)


def without_gains(parameters: Any) -> Any:
    """The same law with all gains zero; None for a user's own, whose gains are not known."""
    if isinstance(parameters, CustomController):
        return None
    return scaled_gains(parameters, 0.0)


def scaled_gains(parameters: Any, k: float) -> Any:
    """The same law with all gains times ``k``."""
    kp, kd = parameters.gains if hasattr(parameters, "gains") else (parameters.kp, parameters.kd)
    posture = replace(parameters.posture, kp=_times(parameters.posture.kp, k), kd=_times(parameters.posture.kd, k))
    changes: dict[str, Any] = {"kp": _times(kp, k), "kd": _times(kd, k), "posture": posture}
    if hasattr(parameters, "p"):
        changes["p"] = None
    return replace(parameters, **changes)


def _times(gain: Any, k: float) -> Any:
    return tuple(float(g * k) for g in gain) if isinstance(gain, tuple) else float(gain * k)


def at_rest(q: Array, kinematics: Any, space: str, task_size: int) -> JointReference | TaskReference:
    """The reference of an arm that stands at ``q`` (P, n) and is to stay there."""
    zero = np.zeros_like(q)
    if space == "joint":
        return JointReference(q, zero, zero)
    pose = kinematics.fk(q)
    still = np.zeros_like(pose.x)
    if task_size < 6:
        return TaskReference(pose.x, still, still, posture=q)
    return TaskReference(pose.x, still, still, pose.R, still, still, q)


def _rows(q: Array, dq: Array, n: int) -> tuple[Array, Array]:
    """Each operating point's perturbed states: q + and -, dq + and -, and the point itself; (P (4n + 1), n)."""
    step = STEP * np.eye(n)
    none = np.zeros((n, n))
    more_q = np.vstack([step, -step, none, none, np.zeros((1, n))])
    more_dq = np.vstack([none, none, step, -step, np.zeros((1, n))])
    return (q[:, None] + more_q).reshape(-1, n), (dq[:, None] + more_dq).reshape(-1, n)


def _slopes(values: Array, n: int) -> Array:
    """Central differences (P, n, 2n) of values (P, 4n + 1, n) at `_rows`."""
    over_q = (values[:, :n] - values[:, n : 2 * n]) / (2.0 * STEP)
    over_dq = (values[:, 2 * n : 3 * n] - values[:, 3 * n : 4 * n]) / (2.0 * STEP)
    return np.swapaxes(np.concatenate([over_q, over_dq], axis=1), 1, 2)
