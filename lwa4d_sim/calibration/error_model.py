"""An arm whose frames are slightly off: six small coordinates for each joint's frame and six for the tool's.

The frames of joint i and of the tool are moved and turned, each by a product of two exponentials, before the joint
turns (the local form of Okamura and Park 1996, "Kinematic calibration using the product of exponentials formula"; Chen,
Yang, Tan, Yeo 2001, "Local POE model for robot kinematic calibration"):

    T(q) = A_1 E_1 Rz(q_1) A_2 E_2 Rz(q_2) ... A_n E_n Rz(q_n) A_t E_t,  E = [rotation_matrix(w), v; 0, 1]

Unlike Denavit and Hartenberg's four, these coordinates stay small for axes that are nearly parallel.
"""

from dataclasses import replace
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from lwa4d_sim.chain import Chain, SerialKinematics
from lwa4d_sim.interfaces import Array
from lwa4d_sim.rotations import rotation_matrix, skew

COORDINATES = ("dx", "dy", "dz", "rx", "ry", "rz")
_STEEP = np.cos(np.pi / 4)  # a joint axis nearer to the base's x axis than this takes y as its reference


class Predicted(NamedTuple):
    """Tool poses, ``x`` (K, 3) [m] and ``R`` (K, 3, 3), and ``J`` (K, 6, p): what the p coordinates do, base axes."""

    x: Array
    R: Array
    J: Array


class ErrorModel:
    """The chain with errors ``xi`` (6 n + 6,): v [m] and w [rad] of the frame of each joint, then of the tool.

    A joint's frame has z along the axis, its origin on the anchor, and x along the base's x axis at q = 0, as far as
    that is perpendicular to z (the base's y axis where the joint's is within 45 degrees of x). The tool's frame is its
    own. The coordinate that a joint itself moves, rz or dz, is named ``offset``: true joint value minus reading.

    Args:
        chain: the nominal arm.
    """

    def __init__(self, chain: Chain) -> None:
        self.nominal = chain
        self.n = len(chain.names)
        f = SerialKinematics(chain).frames(np.zeros(self.n))
        self._frames = np.concatenate([[_about(z) for z in f.z], f.R[None]])  # (n + 1, 3, 3), base axes at q = 0
        origins = np.vstack([f.a, f.x])
        before = np.concatenate([np.eye(3)[None], self._frames[:-1]]).swapaxes(-1, -2)
        self._A = before @ self._frames
        self._b = (before @ np.diff(origins, axis=0, prepend=0.0)[..., None])[..., 0]
        tool = "tool" if "tool" not in chain.names else "tool frame"
        moved = ["dz" if slides else "rz" for slides in chain.slide]
        self.names = tuple(
            f"{joint}.{'offset' if c == own else c}"
            for joint, own in zip((*chain.names, tool), (*moved, ""), strict=True)
            for c in COORDINATES
        )
        self.units = tuple("m" if c.startswith("d") else "rad" for c in COORDINATES) * (self.n + 1)
        self.offsets = np.array([6 * i + COORDINATES.index(own) for i, own in enumerate(moved)])
        self.base = self._b[0]  # (3,) [m] where the first joint is
        # [m] how far an arm reaches; makes metres and radians comparable
        self.length = float(np.linalg.norm(self._b[1:], axis=-1).sum()) or 1.0

    @property
    def scale(self) -> Array:
        """Units of the coordinates (p,) in which all of them move the tool by about the arm's length."""
        return np.where(np.array(self.units) == "m", self.length, 1.0)

    def predict(self, q: Array, xi: Array) -> Predicted:
        """Tool poses at readings ``q`` (K, n) [rad or m] of the arm with errors ``xi`` (p,), and their derivatives."""
        v, w = xi.reshape(-1, 2, 3).swapaxes(0, 1)
        turn, rate = rotation_matrix(w), _rotation_rate(w)
        c, s = np.cos(q), np.sin(q)
        x, R = np.zeros((len(q), 3)), np.broadcast_to(np.eye(3), (len(q), 3, 3))
        origins, axes, turning = [], [], []
        for i in range(self.n + 1):
            x = x + R @ self._b[i]
            R = R @ self._A[i]
            x = x + R @ v[i]
            origins.append(x)
            axes.append(R)
            turning.append(R @ rate[i])
            R = R @ turn[i]
            if i == self.n:
                break
            if self.nominal.slide[i]:
                x = x + q[:, i, None] * R[..., 2]
            else:
                ci, si = c[:, i, None], s[:, i, None]
                X, Y = R[..., 0], R[..., 1]
                R = np.stack([ci * X + si * Y, ci * Y - si * X, R[..., 2]], axis=-1)
        J = np.zeros((len(q), 6, self.n + 1, 6))
        J[:, :3, :, :3] = np.stack(axes, axis=2)
        J[:, 3:, :, 3:] = np.stack(turning, axis=2)
        lever = np.stack([x - o for o in origins], axis=-1)  # (K, 3, n + 1)
        J[:, :3, :, 3:] = np.cross(J[:, 3:, :, 3:], lever[..., None], axis=1)
        return Predicted(x, R, J.reshape(len(q), 6, 6 * (self.n + 1)))

    def in_links(self, xi: Array) -> tuple[Array, Array]:
        """The joints' errors as motions of the links, in the links' frames: shifts (n, 3) [m], turns (n, 3, 3)."""
        v, w = xi[:-6].reshape(-1, 2, 3).swapaxes(0, 1)
        links = np.array(list(accumulate(self.nominal.R, np.matmul)))  # orientations at q = 0
        frames = links.swapaxes(-1, -2) @ self._frames[:-1]
        turns = frames @ rotation_matrix(w) @ frames.swapaxes(-1, -2)
        anchor = self.nominal.anchor[..., None]
        return (anchor + frames @ v[..., None] - turns @ anchor)[..., 0], turns

    def corrected(self, xi: Array) -> Chain:
        """The arm with errors ``xi`` (p,) as a chain: links moved as a whole, axes and anchors as they are in them."""
        chain = self.nominal
        shifts, turns = self.in_links(xi)
        return replace(
            chain,
            pos=chain.pos + (chain.R @ shifts[..., None])[..., 0],
            R=chain.R @ turns,
            tool_pos=chain.tool_pos + chain.tool_R @ xi[-6:-3],
            tool_R=chain.tool_R @ rotation_matrix(xi[-3:]),
        )


def _about(z: Array) -> Array:
    x = np.eye(3)[int(abs(z[0]) > _STEEP)]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _rotation_rate(w: Array) -> Array:
    """Left Jacobian (..., 3, 3) of rotation vectors (..., 3): the angular velocity is this times dw/dt.

    J = I + (1 - cos a)/a^2 K + (a - sin a)/a^3 K^2, K = skew(w), a = |w| (Chirikjian 2012, "Stochastic Models,
    Information Theory, and Lie Groups", vol. 2, section 10.8).
    """
    a = np.linalg.norm(w, axis=-1)[..., None, None]
    K = skew(w)
    safe = np.where(a > 1e-3, a, 1.0)
    third = np.where(a > 1e-3, (safe - np.sin(safe)) / safe**3, 1.0 / 6.0 - a**2 / 120.0)  # series: no lost digits
    return np.asarray(np.eye(3) + 0.5 * np.sinc(a / (2 * np.pi)) ** 2 * K + third * (K @ K))
