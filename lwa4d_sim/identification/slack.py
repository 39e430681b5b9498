"""What of the errors of pieces is explained, to first order, by what nobody asks for: their starts and the inertia.

Only the rest counts (variable projection: Golub and Pereyra 1973).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lwa4d_sim.identification.regressor import Regressor
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import chain_of

# Least share of the largest effect that is told from the errors of differences (assumed: they are 1e-6 of an effect,
# and what is that much smaller than the rest changes nothing)
SEEN = 1e-6


@dataclass(frozen=True)
class Slack:
    """What starts of S pieces, and K parameters of all, can explain of weighted errors.

    Attributes:
        sigma: size of each joint's errors (n,) [rad], one over their weight.
        starts: orthonormal base for each piece (S, m n, 2 n).
        inverse: from coordinates in it to starts (S, 2 n, 2 n).
        shared: weighted change with the parameters (S m n, K).
        base: orthonormal base (S m n, K) of what the starts leave of it.
        back: from coordinates in it to parameters (K, K).
    """

    sigma: Array
    starts: Array
    inverse: Array
    shared: Array
    base: Array
    back: Array

    @staticmethod
    def of(starts: Array, shared: Array, sigma: Array) -> "Slack":
        """From the change of positions with each start (S, m, n, 2 n) and each parameter (S, m, n, K).

        Samples that are not there are 0 in both.
        """
        weighted = (starts / sigma[:, None]).reshape(len(starts), -1, starts.shape[-1])
        U, inverse = _base(weighted)
        all_of = (shared / sigma[:, None]).reshape(len(starts), -1, shared.shape[-1])
        left = all_of - U @ (U.swapaxes(1, 2) @ all_of)
        base, back = _base(left.reshape(-1, shared.shape[-1]))
        return Slack(sigma, U, inverse, all_of.reshape(base.shape), base, back)

    @property
    def rank(self) -> int:
        """Number of values that the samples tell of what nobody asks for."""
        return int(np.count_nonzero(self.starts.any(axis=1)) + np.count_nonzero(self.base.any(axis=0)))

    def left(self, error: Array) -> Array:
        """The part of errors (S, m, n) that is not explained."""
        r = (error / self.sigma).reshape(len(error), -1, 1)
        r = (r - self.starts @ (self.starts.swapaxes(1, 2) @ r)).ravel()
        return np.asarray((r - self.base @ (self.base.T @ r)).reshape(error.shape) * self.sigma)

    def explained(self, error: Array) -> tuple[Array, Array]:
        """Changes of starts (S, 2 n) and parameters (K,) that explain most."""
        r = (error / self.sigma).reshape(len(error), -1, 1)
        parameters = self.back @ (self.base.T @ (r - self.starts @ (self.starts.swapaxes(1, 2) @ r)).ravel())
        r = r - (self.shared @ parameters).reshape(r.shape)
        return (self.inverse @ (self.starts.swapaxes(1, 2) @ r))[..., 0], parameters


def _base(columns: Array) -> tuple[Array, Array]:
    """Orthonormal base of columns (..., M, K), 0 where it has none, and what leads back to them (..., K, K)."""
    length = np.linalg.norm(columns, axis=-2, keepdims=True)
    length = np.where(length > 0, length, 1.0)
    U, s, Vt = np.linalg.svd(columns / length, full_matrices=False)
    told = s > SEEN * s[..., :1]
    back = Vt.swapaxes(-1, -2) * (told / np.where(told, s, 1.0))[..., None, :] / length.swapaxes(-1, -2)
    return U * told[..., None, :], back


def inertia_torques(model: Any, path: Array, step: float) -> Array:
    """Torques (S, N, n, K) [N m] by which arms of other inertia differ along a path, of size 1 each.

    To first order other links and rotors are the same as less torque, Y dpi; of all such torques this is a base.

    Args:
        model: compiled arm.
        path: position and speed at the steps (S, N + 1, 2 n).
        step: [s].
    """
    n = model.njnt
    middle, ddq = 0.5 * (path[:, :-1] + path[:, 1:]), np.diff(path[..., n:], axis=1) / step
    rows = middle[..., :n].reshape(-1, n), middle[..., n:].reshape(-1, n), ddq.reshape(-1, n)
    Y = Regressor(chain_of(model), np.array(model.opt.gravity)).torque(*rows)
    Y = np.concatenate([Y, rows[2][..., None] * np.eye(n)], axis=-1).reshape(-1, 11 * n)
    base = _base(Y)[0]
    base = base[:, base.any(axis=0)] * np.sqrt(len(base))
    return np.asarray(base.reshape(*ddq.shape, -1))
