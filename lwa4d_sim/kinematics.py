"""Kinematics of an arm by its shape: the closed-form inverses of the 3- and the 7-joint LWA4D.

The shape is recognised in the chain, and lengths, signs and zero angles are read from it. What every serial arm shares
is in ``chain``.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lwa4d_sim.chain import Chain, Elbow, Frames, SerialKinematics, describe
from lwa4d_sim.errors import KinematicsError, ReachError, SingularError
from lwa4d_sim.interfaces import Array, IntArray
from lwa4d_sim.inverse import ClosedFormKinematics

__all__ = ["Chain", "Lwa3Kinematics", "SerialKinematics", "SrsKinematics", "kinematics_for"]

SHAPE = 1e-9  # [m, rad] a chain this close to the ideal shape gets the closed form, which is then as exact
LENGTH = 1e-9  # [m] a target this far beyond reach is at its edge, and this near an axis on it: far below any encoder
SINE = 1e-9  # two roll axes at a smaller angle count as one: the choice between them moves the tool by less than 1e-9 m
UPRIGHT = 1e-6  # sine of the angle to axis 1 below which the arm angle has another reference: it would lose ten digits
_BENDS: dict[Elbow | None, tuple[float, ...]] = {"up": (1.0,), "down": (-1.0,), None: (1.0, -1.0)}


class Lwa3Kinematics(ClosedFormKinematics):
    """Three joints: a turn about the base axis, then two parallel pitch axes, with the whole arm in one plane.

    With t2, t3 counted from the straight, horizontal arm and the target at radius r and height h from the shoulder
    (thesis, Eq. 4.5, errata corrected; the half-angle form of its cosine law keeps all digits at the edge of reach):

        t3 = ±2 atan2(sqrt((L2 + L3)^2 - d^2), sqrt(d^2 - (L2 - L3)^2)),  d^2 = r^2 + h^2
        t2 = atan2(-h, r) - atan2(L3 sin t3, L2 + L3 cos t3),  q1 = atan2(y, x)

    Elbow "up", along axis 1, is the + branch. ``ik_branches`` gives up and down, in this order. A solution that leans
    back over the shoulder (r < 0) is not sought. On the axis of joint 1 that joint is undefined.

    Args:
        chain: the arm.

    Raises:
        KinematicsError: the chain has another shape.
    """

    def __init__(self, chain: Chain) -> None:
        super().__init__(chain)
        if self.n != 3 or chain.slide.any():
            raise KinematicsError(f"this inverse needs 3 turning joints; the chain has {chain.names}")
        f = self.frames(np.zeros(3))
        self._B, self._shoulder, off = _shoulder_frame(f, 2)
        elbow, tool = (f.a[2] - self._shoulder) @ self._B, (f.x - self._shoulder) @ self._B
        fore = tool - elbow
        self._sign = float(np.sign(f.z[2] @ f.z[1]))
        self._upper_arm, self._forearm = float(np.hypot(elbow[0], elbow[2])), float(np.hypot(fore[0], fore[2]))
        off = max(off, float(np.linalg.norm(f.z[2] - self._sign * f.z[1])), abs(tool[1]))
        if not (off < SHAPE < min(self._upper_arm, self._forearm)):
            raise KinematicsError(f"chain {chain.names} is not a base turn and two parallel pitch axes in one plane")
        pitch = float(np.arctan2(-elbow[2], elbow[0]))
        self._zero = np.array([0.0, pitch, float(np.arctan2(-fore[2], fore[0])) - pitch])  # t at q = 0
        self._undefined = (f"joint {chain.names[0]!r}, on whose axis it lies,",)

    def _solve(
        self, x: Array, R: ArrayLike | None, elbow: Elbow | None, arm_angle: ArrayLike, near: Array | None
    ) -> tuple[Array, IntArray]:
        if R is not None or np.any(np.asarray(arm_angle) != 0.0):
            raise KinematicsError("a 3-joint arm reaches a point only: R must be None and arm_angle 0")
        p = (x - self._shoulder) @ self._B
        r, d = np.hypot(p[..., 0], p[..., 1]), np.linalg.norm(p, axis=-1)
        L2, L3 = self._upper_arm, self._forearm
        t3 = _elbow_angle(x, d, L2, L3, "target")[..., None] * np.array(_BENDS[elbow])
        t2 = np.arctan2(-p[..., 2], r)[..., None] - np.arctan2(L3 * np.sin(t3), L2 + L3 * np.cos(t3))
        on_axis = r < LENGTH
        q1 = np.where(on_axis, 0.0 if near is None else near[..., 0], np.arctan2(p[..., 1], p[..., 0]))
        t = np.stack(np.broadcast_arrays(q1[..., None], t2, t3), axis=-1)
        return (t - self._zero) * np.array([1.0, 1.0, self._sign]), on_axis.astype(np.int64)


class SrsKinematics(ClosedFormKinematics):
    """Seven joints, roll and pitch in turn, straight at q = 0: a spherical shoulder, an elbow, a spherical wrist.

    The shoulder is where axes 1, 2, 3 meet, the wrist where axes 5, 6, 7 meet; both stay put when the *arm angle* psi
    changes, and the elbow moves on a circle about the line from shoulder to wrist, whose direction is u:

        e = cos(psi) e0 + sin(psi) u × e0

    is the direction from that line to the elbow, and e0 the part of "up" perpendicular to u; up is the way the arm
    points at q = 0, along axis 1. So psi = 0 has the elbow in the vertical plane of shoulder and wrist, above the line,
    psi = pi has it below, and psi > 0 turns it right-handed about u. Where u is within 1e-6 rad of axis 1, e0 is the
    part of the front direction (axis 2 × up at q = 0: the base x axis) instead: psi = 0 then has the elbow in front. A
    straight elbow counts as one about to bend in its positive sense.

    ``ik_branches`` gives 8 branches, number 4 shoulder + 2 elbow + wrist, each 0 for a positive and 1 for a negative
    angle of joint 2, 4, 6 (counted right-handed about axis 2 at q = 0). The elbow is at the same point in all of them.
    Where joint 2 or 6 is straight, only the sum or difference of the roll joints beside it is determined.

    Args:
        chain: the arm.

    Raises:
        KinematicsError: the chain has another shape.
    """

    def __init__(self, chain: Chain) -> None:
        super().__init__(chain)
        if self.n != 7 or chain.slide.any():
            raise KinematicsError(f"this inverse needs 7 turning joints; the chain has {chain.names}")
        f = self.frames(np.zeros(7))
        B, self._shoulder, off = _shoulder_frame(f, 3)
        elbow, off_elbow = _meeting_point(f.z[2:5], f.a[2:5])
        wrist, off_wrist = _meeting_point(f.z[4:7], f.a[4:7])
        along = np.sign((elbow - self._shoulder) @ B[:, 2])  # -1 where axis 1 points from the elbow to the base
        self._B = B * [along, 1.0, along]
        up, side = self._B[:, 2], self._B[:, 1]
        ideal = np.array([up, side, up, side, up, side, up])
        self._sign = np.sign((f.z * ideal).sum(-1))
        off = max(off, off_elbow, off_wrist, float(np.abs(f.z - self._sign[:, None] * ideal).max()))
        self._upper_arm, self._forearm = float((elbow - self._shoulder) @ up), float((wrist - elbow) @ up)
        if not (off < SHAPE < min(self._upper_arm, self._forearm)):
            raise KinematicsError(f"chain {chain.names} is not a spherical shoulder, an elbow and a spherical wrist")
        self._tool_R, self._tool_x = self._B.T @ f.R, (f.x - wrist) @ self._B  # tool from wrist at q = 0
        rolls = [f"joints {chain.names[i]!r} and {chain.names[i + 2]!r}, whose axes coincide," for i in (0, 4)]
        self._undefined = (rolls[0], rolls[1], f"{rolls[0]} and {rolls[1]}")

    def _solve(
        self, x: Array, R: ArrayLike | None, elbow: Elbow | None, arm_angle: ArrayLike, near: Array | None
    ) -> tuple[Array, IntArray]:
        if R is None:
            raise KinematicsError("a target of the 7-joint arm needs an orientation R, (..., 3, 3)")
        R = np.asarray(R, dtype=float)
        if not (np.abs(R.swapaxes(-1, -2) @ R - np.eye(3)).max(initial=0.0) < 1e-6 and (np.linalg.det(R) > 0.0).all()):
            raise KinematicsError(f"R must hold rotation matrices (R^T R = I, det R = 1), not {R.tolist()!s:.200}")
        R07 = self._B.T @ R @ self._tool_R.T
        wrist = (x - self._shoulder) @ self._B - R07 @ self._tool_x
        d = np.linalg.norm(wrist, axis=-1)
        bend = _elbow_angle(x, d, self._upper_arm, self._forearm, "wrist")
        u = wrist / d[..., None]
        psi = np.asarray(arm_angle, dtype=float)[..., None] + (np.pi if elbow == "down" else 0.0)
        e0 = _arm_plane(u)
        e = np.cos(psi) * e0 + np.sin(psi) * np.cross(u, e0)
        # cosine and sine of the angle at the shoulder
        along = ((self._upper_arm + self._forearm * np.cos(bend)) / d)[..., None]
        across = (self._forearm * np.sin(bend) / d)[..., None]
        upper_arm = np.stack([across * u - along * e, np.cross(e, u), along * u + across * e], axis=-1)
        R03 = upper_arm[..., None, :, :] * np.array([[1.0, 1.0, 1.0], [-1.0, -1.0, 1.0]])[:, None, :]  # (..., 2, 3, 3)
        t4 = bend[..., None] * np.array([1.0, -1.0])  # (..., 2), as R03: both put the elbow at the same point
        rolls = np.zeros(7) if near is None else near * self._sign
        shoulder, folded = _roll_pitch_roll(R03, rolls[..., None, 0])
        R04 = R03 @ _pitch(t4)
        hand, straight = _roll_pitch_roll(R04.swapaxes(-1, -2) @ R07[..., None, :, :], rolls[..., None, 4])
        lead = np.broadcast_shapes(R03.shape[:-3], rolls.shape[:-1])
        t = np.empty((*lead, 2, 2, 2, 7))  # shoulder, elbow, wrist
        t[..., :3] = shoulder.swapaxes(-2, -3)[..., None, :]
        t[..., 3] = t4[..., None, :, None]
        t[..., 4:] = hand[..., None, :, :, :]
        code = np.asarray(folded.any(-1) + 2 * straight.any(-1), dtype=np.int64)
        return t.reshape(*lead, 8, 7) * self._sign, code

    def arm_angle_of(self, q: ArrayLike) -> Array:
        """Arm angle psi (...) [rad] of the configuration ``q`` (..., 7): ik(*fk(q), arm_angle=psi, near=q) is q."""
        q = self._joints(q)
        f = self.frames(q)
        wrist = (f.x - self._shoulder) @ self._B - self._B.T @ f.R @ self._tool_R.T @ self._tool_x
        u = wrist / np.linalg.norm(wrist, axis=-1, keepdims=True)
        bent = np.where(self._sign[3] * np.sin(q[..., 3]) >= 0.0, self._sign[3], -self._sign[3])[..., None]
        # the elbow's axis is e × u: unlike the elbow's offset, it does not vanish when the elbow is straight
        e = np.cross(u, bent * f.z[..., 3, :] @ self._B)
        e0 = _arm_plane(u)
        angle: Array = np.arctan2((e * np.cross(u, e0)).sum(-1), (e * e0).sum(-1))
        return angle


def kinematics_for(chain: Chain) -> SerialKinematics:
    """The closed-form kinematics that fits the chain's shape, or else the general one with its numeric inverse."""
    for kind in (Lwa3Kinematics, SrsKinematics):
        try:
            return kind(chain)
        except KinematicsError:
            continue
    return SerialKinematics(chain)


def _meeting_point(z: Array, a: Array) -> tuple[Array, float]:
    """The point nearest to the lines a + s z, both (m, 3), and its largest distance from one of them [m]."""
    across = np.eye(3) - z[:, :, None] * z[:, None, :]  # (m, 3, 3)
    point = np.linalg.lstsq(across.sum(0), (across @ a[..., None]).sum(0)[:, 0], rcond=None)[0]
    return point, float(np.linalg.norm(across @ (point - a)[..., None], axis=1).max())


def _shoulder_frame(f: Frames, axes: int) -> tuple[Array, Array, float]:
    """Frame (3, 3), z on axis 1 and y on axis 2; where the first axes meet; how far both are off [m, rad]."""
    point, off = _meeting_point(f.z[:axes], f.a[:axes])
    B = np.column_stack([np.cross(f.z[1], f.z[0]), f.z[1], f.z[0]])
    return B, point, max(off, float(abs(f.z[0] @ f.z[1])))


def _elbow_angle(x: Array, d: Array, upper_arm: float, forearm: float, what: str) -> Array:
    """Elbow bend (...) in [0, pi] for a distance d (...) [m] of shoulder and ``what``, or a ReachError."""
    far, near = upper_arm + forearm, abs(upper_arm - forearm)
    outside = ~((d <= far + LENGTH) & (d >= near - LENGTH))  # written so that nan is outside
    if outside.any():
        target, i = describe(x, outside)
        raise ReachError(
            f"{target}: the {what} would be {d.ravel()[i]:.6g} m from the shoulder; "
            f"the arm reaches {near:.6g} to {far:.6g} m"
        )
    if (d < LENGTH).any():
        raise SingularError(f"{describe(x, d < LENGTH)[0]}: the {what} is at the shoulder: no direction to it")
    stretch, fold = (far - d) * (far + d), (d - near) * (d + near)
    return np.asarray(2.0 * np.arctan2(np.sqrt(np.maximum(stretch, 0.0)), np.sqrt(np.maximum(fold, 0.0))))


def _arm_plane(u: Array) -> Array:
    """The reference e0 (..., 3) of the arm angle for the directions u (..., 3), in the shoulder frame."""
    up = np.array([0.0, 0.0, 1.0]) - u[..., 2:] * u
    front = np.array([1.0, 0.0, 0.0]) - u[..., :1] * u
    e0 = np.where(np.linalg.norm(up, axis=-1, keepdims=True) < UPRIGHT, front, up)
    return np.asarray(e0 / np.linalg.norm(e0, axis=-1, keepdims=True))


def _pitch(t: Array) -> Array:
    """Turns about y by t (...), (..., 3, 3)."""
    c, s, zero, one = np.cos(t), np.sin(t), np.zeros_like(t), np.ones_like(t)
    return np.stack([c, zero, s, zero, one, zero, -s, zero, c], axis=-1).reshape(*t.shape, 3, 3)


def _roll_pitch_roll(R: Array, roll: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Angles (..., 2, 3) with R = Rz Ry Rz, pitch positive and negative, and where (...) the first was taken from roll.

    Only the first roll is ill defined near a straight pitch; the other two follow from it to full accuracy.
    """
    straight = np.hypot(R[..., 0, 2], R[..., 1, 2]) < SINE
    first = np.where(straight, roll, np.arctan2(R[..., 1, 2], R[..., 0, 2]))[..., None] + np.array([0.0, np.pi])
    c, s, R = np.cos(first), np.sin(first), R[..., None, :, :]
    pitch = np.arctan2(c * R[..., 0, 2] + s * R[..., 1, 2], R[..., 2, 2])
    last = np.arctan2(c * R[..., 1, 0] - s * R[..., 0, 0], c * R[..., 1, 1] - s * R[..., 0, 1])
    return np.stack([first, pitch, last], axis=-1), straight
