"""The ten inertial parameters of a link, as a vector, as a pseudo-inertia, and read from a compiled model.

A link's vector is (m, hx, hy, hz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz): mass, mass times centre of mass, and the inertia about
the origin of the link's frame, all in that frame (the order of Pinocchio's ``Inertia.toDynamicParameters``).
"""

from typing import Any

import numpy as np

from lwa4d_sim.interfaces import Array

NAMES = ("m", "hx", "hy", "hz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
UNITS = ("kg", *["kg m"] * 3, *["kg m^2"] * 6)
_ROW, _COLUMN = np.array([0, 0, 1, 0, 1, 2]), np.array([0, 1, 1, 2, 2, 2])  # of the six entries of I


def inertia_matrix(pi: Array) -> Array:
    """Inertia about the frame's origin (..., 3, 3) [kg m^2] of vectors (..., 10)."""
    I = np.empty((*pi.shape[:-1], 3, 3))
    I[..., _ROW, _COLUMN] = I[..., _COLUMN, _ROW] = pi[..., 4:]
    return I


def pseudo_inertia(pi: Array) -> Array:
    """Pseudo-inertia (..., 4, 4) of vectors (..., 10).

    [[tr(I)/2 1 - I, h], [h^T, m]]; positive definite exactly where some mass distribution of positive density has these
    parameters (Wensing, Kim, Slotine 2018, "Linear matrix inequalities for physically-consistent inertial parameter
    identification").
    """
    I = inertia_matrix(pi)
    J = np.empty((*pi.shape[:-1], 4, 4))
    J[..., :3, :3] = 0.5 * np.trace(I, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - I
    J[..., :3, 3] = J[..., 3, :3] = pi[..., 1:4]
    J[..., 3, 3] = pi[..., 0]
    return J


def from_pseudo_inertia(J: Array) -> Array:
    """Vectors (..., 10) of pseudo-inertias (..., 4, 4)."""
    S = J[..., :3, :3]
    I = np.trace(S, axis1=-2, axis2=-1)[..., None, None] * np.eye(3) - S
    return np.concatenate([J[..., 3, 3, None], J[..., :3, 3], I[..., _ROW, _COLUMN]], axis=-1)


def lump(mass: float, com: Array, inertia: Array) -> Array:
    """Vector (10,) of a body with an inertia (3, 3) about its centre of mass (3,), all in the link's frame."""
    I = inertia + mass * (com @ com * np.eye(3) - np.outer(com, com))
    return np.concatenate([[mass], mass * com, I[_ROW, _COLUMN]])


def standard_parameters(model: Any) -> Array:
    """Inertial parameters (n, 10) of the links of a compiled arm; bodies welded to a link count as part of it."""
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    mujoco.mj_kinematics(model, data)
    pi = np.zeros((model.njnt, 10))
    for row, link in zip(pi, model.jnt_bodyid, strict=True):
        R, x = data.xmat[link].reshape(3, 3), data.xpos[link]
        for b in np.flatnonzero(model.body_weldid == link):
            turn = R.T @ data.ximat[b].reshape(3, 3)
            row += lump(model.body_mass[b], R.T @ (data.xipos[b] - x), turn * model.body_inertia[b] @ turn.T)
    return pi
