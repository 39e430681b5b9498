"""Forward kinematics by Denavit-Hartenberg tables, the thesis's road, independent of any other model of the arm.

Source: "Towards a Model-Based Motion Control Design for a 7-axis Robotic Arm LWA4D by Schunk", Eq. 4.1, 4.2 and Tables
4.1, 4.2. The minus signs of alpha are missing in the printed tables; with those added here, both agree with the inverse
and the dynamics in the rest of the thesis.
"""

import numpy as np
from numpy.typing import ArrayLike

from lwa4d_sim.interfaces import Array

_L1, _L2, _L3, _L4 = 0.300, 0.328, 0.320, 0.077  # [m] thesis, chapter 5, CAD lengths used in simulation
_RIGHT = np.pi / 2

# Rows a [m], alpha [rad], d [m], theta0 [rad].
THESIS_DH_3DOF: Array = np.array(  # thesis, Table 4.1, alpha_1 corrected to -pi/2: positive q2 and q4 turn the arm down
    [
        [0.0, -_RIGHT, _L1, 0.0],
        [_L2, 0.0, 0.0, 0.0],
        [_L3 + _L4, 0.0, 0.0, 0.0],
    ]
)
DH_7DOF: Array = (
    np.array(  # thesis, Table 4.2, alphas corrected to alternate: straight up at q = 0, roll and pitch in turn
        [
            [0.0, -_RIGHT, _L1, 0.0],
            [0.0, _RIGHT, 0.0, 0.0],
            [0.0, -_RIGHT, _L2, 0.0],
            [0.0, _RIGHT, 0.0, 0.0],
            [0.0, -_RIGHT, _L3, 0.0],
            [0.0, _RIGHT, 0.0, 0.0],
            [0.0, 0.0, _L4, 0.0],
        ]
    )
)
THESIS_DH_3DOF.setflags(write=False)
DH_7DOF.setflags(write=False)


def dh_forward(table: Array, q: ArrayLike) -> Array:
    """Tool frame in the base frame, T_1 T_2 ... T_n (thesis, Eq. 4.2) with T_i of Eq. 4.1 and theta_i = theta0_i + q_i.

    Args:
        table: standard DH rows a [m], alpha [rad], d [m], theta0 [rad], (n, 4).
        q: joint angles [rad], (..., n).

    Returns:
        Homogeneous transforms (..., 4, 4).
    """
    q = np.asarray(q, dtype=float)
    T = np.broadcast_to(np.eye(4), (*q.shape[:-1], 4, 4))
    for i, (a, alpha, d, theta0) in enumerate(table):
        c, s = np.cos(q[..., i] + theta0), np.sin(q[..., i] + theta0)
        ca, sa = np.cos(alpha), np.sin(alpha)
        step = np.zeros((*q.shape[:-1], 4, 4))
        step[..., 0, 0], step[..., 0, 1], step[..., 0, 2], step[..., 0, 3] = c, -s * ca, s * sa, a * c
        step[..., 1, 0], step[..., 1, 1], step[..., 1, 2], step[..., 1, 3] = s, c * ca, -c * sa, a * s
        step[..., 2, 1], step[..., 2, 2], step[..., 2, 3] = sa, ca, d
        step[..., 3, 3] = 1.0
        T = T @ step
    return T
