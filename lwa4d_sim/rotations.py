"""Rotations in space: vectors, matrices, roll-pitch-yaw angles and the shortest turn between two of them.

Every function works on arrays with any leading axes. Matrices map coordinates of the turned frame into the fixed one.
"""

import numpy as np
from numpy.typing import ArrayLike

from lwa4d_sim.interfaces import Array


def skew(v: ArrayLike) -> Array:
    """Matrix (..., 3, 3) with ``skew(v) @ u = cross(v, u)``, for ``v`` (..., 3)."""
    v = np.asarray(v, dtype=float)
    K = np.zeros((*v.shape, 3))
    K[..., 2, 1], K[..., 0, 2], K[..., 1, 0] = v[..., 0], v[..., 1], v[..., 2]
    return np.asarray(K - np.swapaxes(K, -1, -2))


def rotation_matrix(v: ArrayLike) -> Array:
    """Rotation about ``v`` by its length: R = I + sin(a)/a K + (1 - cos a)/a^2 K^2 (Rodrigues), K = skew(v).

    Args:
        v: rotation vectors (..., 3) [rad].

    Returns:
        Matrices (..., 3, 3).
    """
    K = skew(v)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    # np.sinc(x) is sin(pi x)/(pi x), exact at zero; (1 - cos a)/a^2 = (sin(a/2)/(a/2))^2 / 2 loses no digits there.
    return np.asarray(np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (K @ K))


def rotation_vector(R: ArrayLike) -> Array:
    """Inverse of `rotation_matrix`, with a length of at most pi; at pi either of the two opposite axes.

    The way goes over the unit quaternion, taken from its largest component (Shepperd 1978, "Quaternion from Rotation
    Matrix"), so that no digits are lost near 0 or near pi.

    Args:
        R: rotation matrices (..., 3, 3).

    Returns:
        Rotation vectors (..., 3) [rad].
    """
    R = np.asarray(R, dtype=float)
    S = np.empty((*R.shape[:-2], 4, 4))  # 4 q q^T of the unit quaternion q = (scalar, vector)
    trace = np.trace(R, axis1=-2, axis2=-1)
    vee = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    S[..., 0, 0] = 1 + trace
    S[..., 0, 1:] = S[..., 1:, 0] = vee
    S[..., 1:, 1:] = R + np.swapaxes(R, -1, -2) + (1 - trace)[..., None, None] * np.eye(3)
    largest = np.argmax(np.diagonal(S, axis1=-2, axis2=-1), axis=-1)
    quaternion = np.take_along_axis(S, largest[..., None, None], axis=-2)[..., 0, :]
    quaternion = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    quaternion = np.where(quaternion[..., :1] < 0, -quaternion, quaternion)
    sine = np.linalg.norm(quaternion[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quaternion[..., :1])
    return np.asarray(quaternion[..., 1:] * np.where(sine > 0, angle / np.where(sine > 0, sine, 1.0), 2.0))


def from_rpy(rpy: ArrayLike) -> Array:
    """Matrix of roll, pitch, yaw about the fixed x, y, z axes in that order: R = Rz(yaw) Ry(pitch) Rx(roll).

    Args:
        rpy: angles (..., 3) [rad].

    Returns:
        Matrices (..., 3, 3).
    """
    rpy = np.asarray(rpy, dtype=float)
    Rx, Ry, Rz = (rotation_matrix(rpy[..., i : i + 1] * np.eye(3)[i]) for i in range(3))
    return np.asarray(Rz @ Ry @ Rx)


def to_rpy(R: ArrayLike) -> Array:
    """Inverse of `from_rpy`, with pitch in [-pi/2, pi/2].

    At pitch = +-pi/2 only a sum or difference of roll and yaw is defined; the answer is then one of the many, and still
    gives back ``R``, because roll is measured after yaw has been taken out.

    Args:
        R: rotation matrices (..., 3, 3).

    Returns:
        Angles (..., 3) [rad].
    """
    R = np.asarray(R, dtype=float)
    yaw = np.arctan2(R[..., 1, 0], R[..., 0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    pitch = np.arctan2(-R[..., 2, 0], c * R[..., 0, 0] + s * R[..., 1, 0])
    roll = np.arctan2(s * R[..., 0, 2] - c * R[..., 1, 2], c * R[..., 1, 1] - s * R[..., 0, 1])
    return np.stack([roll, pitch, yaw], axis=-1)


def slerp(R0: ArrayLike, R1: ArrayLike, s: ArrayLike) -> Array:
    """Rotation the fraction ``s`` of the shortest way from ``R0`` to ``R1``, about a fixed axis.

    Args:
        R0: rotation matrices (..., 3, 3) at s = 0.
        R1: rotation matrices (..., 3, 3) at s = 1.
        s: fractions (...).

    Returns:
        Matrices (..., 3, 3).
    """
    R0 = np.asarray(R0, dtype=float)
    turn = rotation_vector(np.swapaxes(R0, -1, -2) @ np.asarray(R1, dtype=float))
    return np.asarray(R0 @ rotation_matrix(np.asarray(s, dtype=float)[..., None] * turn))
