"""Kinematics of any serial arm, from plain numbers: where the tool is, how it moves, and a numeric inverse."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lwa4d_sim.errors import KinematicsError, ReachError
from lwa4d_sim.interfaces import Array, Pose
from lwa4d_sim.newton import RESIDUAL, RESTARTS, solve

Elbow = Literal["up", "down"]

CHUNK = 4096  # samples; component arrays of 32 kB stay in the processor's cache (measured: larger ones gain nothing)


@dataclass(frozen=True)
class Chain:
    """A serial arm as plain numbers.

    Attributes:
        names: the n joint names.
        pos, R: frame of link i in the frame of link i-1 (the base for i = 0) at q = 0; (n, 3) [m] and (n, 3, 3).
        axis, anchor: joint axis (unit length) and a point on it, in link i's own frame; each (n, 3).
        slide: True where a joint slides instead of turning, (n,).
        tool_pos, tool_R: tool frame in the last link's frame, (3,) [m] and (3, 3).
        lower, upper: joint limits [rad or m], (n,), infinite where there is none.
    """

    names: tuple[str, ...]
    pos: Array
    R: Array
    axis: Array
    anchor: Array
    slide: NDArray[np.bool_]
    tool_pos: Array
    tool_R: Array
    lower: Array
    upper: Array


def describe(x: Array, bad: NDArray[np.bool_]) -> tuple[str, int]:
    """Words for the first bad target, to begin an error message with, and its index in ``bad`` (...), raveled."""
    i = int(np.argmax(bad))
    point = np.broadcast_to(x, (*bad.shape, 3)).reshape(-1, 3)[i]
    number = f" ({i + 1} of {bad.size})" if bad.size > 1 else ""
    return "target (" + ", ".join(f"{v:.6g}" for v in point) + f") m{number}", i


class Frames(NamedTuple):
    """Joint axes ``z`` (..., n, 3), points on them ``a`` (..., n, 3) [m] and the tool pose, all in the base frame."""

    z: Array
    a: Array
    x: Array
    R: Array


def jacobian_from_axes(z: Array, a: Array, x: Array, slide: NDArray[np.bool_]) -> Array:
    """Tool Jacobian: column i is [z_i × (x - a_i); z_i], or [z_i; 0] for a sliding joint.

    Args:
        z: joint axes, base frame, (..., n, 3).
        a: a point on each axis [m], (..., n, 3).
        x: tool point [m], (..., 3).
        slide: True where a joint slides, (n,).

    Returns:
        (..., 6, n), linear rows first.
    """
    Z, r = _twice(z.swapaxes(-1, -2)), _twice((x[..., None, :] - a).swapaxes(-1, -2))  # (..., 5, n)
    J = np.empty((*Z.shape[:-2], 6, Z.shape[-1]))
    J[..., :3, :] = Z[..., 1:4, :] * r[..., 2:5, :] - Z[..., 2:5, :] * r[..., 1:4, :]
    J[..., 3:, :] = Z[..., :3, :]
    if slide.any():
        J[..., :3, slide] = J[..., 3:, slide]
        J[..., 3:, slide] = 0.0
    return J


def _twice(v: Array) -> Array:
    """Rows x y z x y of v (..., 3, n): their slices make a cross product for a third of the time np.cross takes."""
    out = np.empty((*v.shape[:-2], 5, v.shape[-1]))
    out[..., :3, :], out[..., 3:, :] = v, v[..., :2, :]
    return out


# (18, 6): takes [a × v; a × w / 2] out of the outer products [a v^T, a w^T] (3, 6) laid in one row
_CROSS = np.reshape([np.kron(np.diag([1.0, 0.5]), E) for E in np.cross(np.eye(3)[:, None], np.eye(3))], (18, 6))


def bias_from_jacobian(J: Array, dq: Array) -> Array:
    """Bias acceleration dJ dq of the tool, from the Jacobian alone.

    With w_i, v_i the angular and linear columns of J times dq_i and omega_i = w_1 + ... + w_i (derived from
    ``rate_from_jacobian`` by exchanging its two sums):

        dJ dq = sum_i [(2 omega_i - w_i) × v_i; (2 omega_i - w_i) × w_i / 2]

    Args:
        J: Jacobian of a serial chain (..., 6, n), linear rows first.
        dq: joint speed (..., n) [rad/s or m/s].

    Returns:
        (..., 6) [m/s^2, rad/s^2].
    """
    V = J * dq[..., None, :]  # (..., 6, n)
    w = V[..., 3:, :]
    S = (2.0 * w.cumsum(-1) - w) @ V.swapaxes(-1, -2)  # (..., 3, 6) sums of outer products
    return np.asarray(S.reshape(*S.shape[:-2], 18) @ _CROSS)


def rate_from_jacobian(J: Array, dq: Array) -> Array:
    """Rate dJ (..., 6, n) of a serial chain's Jacobian J (..., 6, n) at joint speed dq (..., n).

    Column i turns with link i-1, and the tool moves with joints i..n on it (z_i is zero for a sliding joint):

        dJ_i = [omega_{i-1} × J_i + z_i × (v_i + ... + v_n); omega_{i-1} × z_i]
    """
    V = J * dq[..., None, :]
    w, z = V[..., 3:, :], J[..., 3:, :]
    omega = w.cumsum(-1) - w
    v = V[..., :3, ::-1].cumsum(-1)[..., ::-1]
    linear = np.cross(omega, J[..., :3, :], axis=-2) + np.cross(z, v, axis=-2)
    return np.concatenate([linear, np.cross(omega, z, axis=-2)], axis=-2)


class SerialKinematics:
    """Forward, differential and numeric inverse kinematics of a serial chain.

    Every method takes ``q`` (..., n) [rad or m] with any leading axes. Inside, each joint turns about the z axis of a
    frame of its own: T = A_0 Rz(q_1) A_1 Rz(q_2) ... A_n with constant A.

    Args:
        chain: the arm.
    """

    def __init__(self, chain: Chain) -> None:
        self.chain = chain
        self.n = len(chain.names)
        self.lower, self.upper = np.asarray(chain.lower, float), np.asarray(chain.upper, float)
        F: Array = np.eye(3)
        c, rotations, offsets = np.zeros(3), [], []
        for i in range(self.n):
            F_next = _frame_about(chain.axis[i])
            offsets.append(F.T @ (chain.pos[i] + chain.R[i] @ chain.anchor[i] - c))
            rotations.append(F.T @ chain.R[i] @ F_next)
            F, c = F_next, chain.anchor[i]
        offsets.append(F.T @ (chain.tool_pos - c))
        rotations.append(F.T @ chain.tool_R)
        # Rounding turns the 1e-16 that quaternions leave behind into zeros, which point() then skips.
        self._A, self._b = np.round(rotations, 15), np.round(offsets, 15)  # (n + 1, 3, 3), (n + 1, 3)

    def _joints(self, q: ArrayLike) -> Array:
        q = np.asarray(q, dtype=float)
        if q.ndim == 0 or q.shape[-1] != self.n:
            raise KinematicsError(f"q has shape {q.shape}; its last axis must hold the {self.n} joints of the arm")
        return q

    def frames(self, q: ArrayLike) -> Frames:
        """Joint axes, anchors and tool pose at ``q`` (..., n)."""
        q = self._joints(q)
        c, s = np.cos(q)[..., None], np.sin(q)[..., None]
        z, a = np.empty((*q.shape, 3)), np.empty((*q.shape, 3))
        x, R = np.zeros((*q.shape[:-1], 3)), np.broadcast_to(np.eye(3), (*q.shape[:-1], 3, 3))
        for i in range(self.n):
            x = x + R @ self._b[i]
            R = R @ self._A[i]
            z[..., i, :], a[..., i, :] = R[..., 2], x
            if self.chain.slide[i]:
                x = x + q[..., i, None] * R[..., 2]
            else:
                ci, si = c[..., i, :], s[..., i, :]
                turned = ci * R[..., 0] + si * R[..., 1]
                R[..., 1] = ci * R[..., 1] - si * R[..., 0]
                R[..., 0] = turned
        return Frames(z, a, x + R @ self._b[-1], R @ self._A[-1])

    def fk(self, q: ArrayLike) -> Pose:
        """Tool pose at ``q`` (..., n): x (..., 3) [m] and R (..., 3, 3)."""
        return Pose(*self.frames(q)[2:])

    def point(self, q: ArrayLike) -> Array:
        """Tool point (..., 3) [m] only, for long records: carried from tool to base with one array a component."""
        q = self._joints(q)
        samples = q.reshape(-1, self.n)
        out = np.empty((len(samples), 3))
        for start in range(0, len(samples), CHUNK):
            angles = samples[start : start + CHUNK].T.copy()
            p: list[Array | float] = [float(v) for v in self._b[-1]]
            for i in reversed(range(self.n)):
                x, y, z = p
                if self.chain.slide[i]:
                    p[2] = z + angles[i]
                elif not (isinstance(x, float) and x == 0.0 and isinstance(y, float) and y == 0.0):  # else on the axis
                    c, s = np.cos(angles[i]), np.sin(angles[i])
                    p[0], p[1] = c * x - s * y, s * x + c * y
                p = [_affine(row, p, b) for row, b in zip(self._A[i], self._b[i], strict=True)]
            for k in range(3):
                out[start : start + CHUNK, k] = p[k]
        return out.reshape(*q.shape[:-1], 3)

    def _pose_and_jacobian(self, q: Array) -> tuple[Pose, Array]:
        f = self.frames(q)
        return Pose(f.x, f.R), jacobian_from_axes(f.z, f.a, f.x, self.chain.slide)

    def jacobian(self, q: ArrayLike) -> Array:
        """Tool Jacobian (..., 6, n) at ``q``, base frame, linear rows first."""
        return self._pose_and_jacobian(self._joints(q))[1]

    def jacobian_rate(self, q: ArrayLike, dq: ArrayLike) -> Array:
        """Time derivative (..., 6, n) of the Jacobian at ``q`` and joint speed ``dq``, both (..., n)."""
        return rate_from_jacobian(self.jacobian(q), self._joints(dq))

    def _singular_values(self, q: ArrayLike) -> Array:
        J = self.jacobian(q)
        return np.asarray(np.linalg.svd(J if self.n >= 6 else J[..., :3, :], compute_uv=False), dtype=float)

    def singularity(self, q: ArrayLike) -> Array:
        """Smallest singular value (...) of the task Jacobian (all 6 rows from 6 joints on, else the 3 linear ones)."""
        return self._singular_values(q)[..., -1]

    def manipulability(self, q: ArrayLike) -> Array:
        """Product (...) of the singular values of the task Jacobian (Yoshikawa 1985, sqrt(det(J J^T)))."""
        return np.asarray(self._singular_values(q).prod(axis=-1))

    def ik(
        self,
        x: ArrayLike,
        R: ArrayLike | None = None,
        *,
        elbow: Elbow = "up",
        arm_angle: ArrayLike = 0.0,
        near: ArrayLike | None = None,
    ) -> Array:
        """Joint angles within the limits that reach a target, by damped least squares from ``near``.

        Args:
            x: tool point [m], (..., 3).
            R: tool orientation (..., 3, 3), or None when only the point matters.
            elbow: choice of the closed-form inverses; a general chain has only "up".
            arm_angle: choice of the closed-form inverses; a general chain has only 0.
            near: start and posture to stay close to, (..., n); without it the middle of the joint ranges.

        Returns:
            q (..., n) with a residual below 1e-9 m and rad.

        Raises:
            ReachError: no start converged.
            KinematicsError: ``elbow`` or ``arm_angle`` was asked of a chain that has none.
        """
        if elbow != "up" or np.any(np.asarray(arm_angle) != 0.0):
            raise KinematicsError(
                f"elbow (={elbow!r}) and arm_angle (={arm_angle!r}) must be 'up' and 0 for a chain without a "
                "closed-form inverse; choose the posture with near"
            )
        x = np.asarray(x, dtype=float)
        X = x.reshape(-1, 3)
        Rs = None if R is None else np.broadcast_to(np.asarray(R, float), (*x.shape[:-1], 3, 3)).reshape(-1, 3, 3)
        span = np.where(self.chain.slide, 1.0, np.pi)  # where a joint has no limits, search one turn or 2 m
        low, high = np.maximum(self.lower, -span), np.minimum(self.upper, span)
        start = (low + high) / 2.0 if near is None else self._joints(near)
        start = np.broadcast_to(start, (*x.shape[:-1], self.n)).reshape(-1, self.n)
        q, error = solve(self._pose_and_jacobian, start, X, Rs, limits=(self.lower, self.upper), search=(low, high))
        failed = ~(error < RESIDUAL)
        if failed.any():
            what, i = describe(X, failed)
            raise ReachError(
                f"{what}: none of {1 + RESTARTS} starts found joint angles within the limits; the last ended "
                f"{error[i]:.3g} (m or rad) away, and at most {RESIDUAL:g} is valid"
            )
        return q.reshape(*x.shape[:-1], self.n)

    def ik_branches(
        self, x: ArrayLike, R: ArrayLike | None = None, arm_angle: ArrayLike = 0.0, near: ArrayLike | None = None
    ) -> Array:
        """Every known solution (..., branches, n); the numeric inverse knows one. Arguments as ``ik``."""
        return self.ik(x, R, arm_angle=arm_angle, near=near)[..., None, :]


def _frame_about(axis: Array) -> Array:
    """A rotation (3, 3) whose z column is ``axis``; for a coordinate axis a cyclic permutation, which costs nothing."""
    z = axis / np.linalg.norm(axis)
    x = np.roll(np.eye(3)[np.argmax(np.abs(z))], 1)
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _affine(row: Array, p: list[Array | float], b: float) -> Array | float:
    """The sum row · p + b, leaving out what is zero (most of it: axes are parallel or perpendicular)."""
    total: Array | float = float(b)
    for a, v in zip(row, p, strict=True):
        if a != 0.0:
            term = v if a == 1.0 else a * v
            total = term if isinstance(total, float) and total == 0.0 else total + term
    return total
