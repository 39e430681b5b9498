"""What of the errors of pieces is explained, to first order, by what nobody asks for: their starts and the inertia.

Only the rest counts (variable projection: Golub and Pereyra 1973).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lwa4d_sim.identification.regressor import Regressor
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import chain_of

SEEN = 1e-6  # least torque, of columns of length 1, that is told from rounding and differences in time (assumed)


@dataclass(frozen=True)
class Slack:
    """What starts of S pieces, and K parameters of all, can explain of weighted errors.

    Attributes:
        sigma: size of each joint's errors (n,) [rad], one over their weight.
        starts: orthonormal base for each piece (S, m n, 2 n).
        inverse: from coordinates in it to starts, in usual amounts (S, 2 n, 2 n).
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
        """From the change of positions by usual amounts of each start (S, m, n, 2 n) and each parameter (S, m, n, K).

        Samples that are not there are 0 in both. What changes the positions by less than their errors, if it is off by
        as much as usual, is left alone: an estimate of it would be further off.
        """
        pieces, samples, n, _ = starts.shape
        U, inverse = _base((starts / sigma[:, None]).reshape(pieces, samples * n, -1), least=1.0)
        all_of = (shared / sigma[:, None]).reshape(pieces, samples * n, shared.shape[-1])
        left = all_of - U @ (U.swapaxes(1, 2) @ all_of)
        base, back = _base(left.reshape(pieces * samples * n, shared.shape[-1]), least=1.0)
        return Slack(sigma, U, inverse, all_of.reshape(base.shape), base, back)

    @property
    def rank(self) -> int:
        """Number of values that the samples tell of what nobody asks for."""
        return int(np.count_nonzero(self.starts.any(axis=1)) + np.count_nonzero(self.base.any(axis=0)))

    def left(self, error: Array) -> Array:
        """The part of errors (S, m, n) that is not explained."""
        r = self._moving(error).ravel()
        return np.asarray((r - self.base @ (self.base.T @ r)).reshape(error.shape) * self.sigma)

    def explained(self, error: Array) -> tuple[Array, Array]:
        """Changes of starts (S, 2 n) and parameters (K,) that explain most, in usual amounts."""
        parameters = self.back @ (self.base.T @ self._moving(error).ravel())
        r = (error / self.sigma).reshape(len(error), -1, 1) - (self.shared @ parameters).reshape(len(error), -1, 1)
        return (self.inverse @ (self.starts.swapaxes(1, 2) @ r))[..., 0], parameters

    def _moving(self, error: Array) -> Array:
        """Weighted errors (S, m n, 1) less what other starts explain."""
        r = (error / self.sigma).reshape(len(error), -1, 1)
        return np.asarray(r - self.starts @ (self.starts.swapaxes(1, 2) @ r))


def _base(columns: Array, least: float) -> tuple[Array, Array]:
    """Orthonormal base of columns (..., M, K), 0 where it has none, and what leads back to them (..., K, K).

    A direction in which the columns are no longer than ``least`` counts as none.
    """
    U, s, Vt = np.linalg.svd(columns, full_matrices=False)
    told = s > least
    back = Vt.swapaxes(-1, -2) * (told / np.where(told, s, 1.0))[..., None, :]
    return U * told[..., None, :], back


@dataclass(frozen=True)
class Inertia:
    """Torques by which arms of other inertia differ along a path: to first order, other links are as less torque.

    Attributes:
        Y: with links' parameters, then rotors' inertia (S, N, n, 11 n).
        base: all such torques, of rms 1 N m each (S, N, n, K) [N m].
        back: from coordinates in it to parameters (11 n, K).
    """

    Y: Array
    base: Array
    back: Array

    @staticmethod
    def along(model: Any, path: Array, step: float) -> "Inertia":
        """Of a compiled arm that goes through positions and speeds (S, N + 1, 2 n), one each ``step`` [s]."""
        n = model.njnt
        middle, ddq = 0.5 * (path[:, :-1] + path[:, 1:]), np.diff(path[..., n:], axis=1) / step
        rows = middle[..., :n].reshape(-1, n), middle[..., n:].reshape(-1, n), ddq.reshape(-1, n)
        Y = Regressor(chain_of(model), np.array(model.opt.gravity)).torque(*rows)
        Y = np.concatenate([Y, rows[2][..., None] * np.eye(n)], axis=-1)
        flat = Y.reshape(-1, 11 * n)
        length = np.linalg.norm(flat, axis=0)
        length = np.where(length > 0, length, 1.0)
        base, back = _base(flat / length, least=SEEN)
        told, size = base.any(axis=0), np.sqrt(len(rows[0]))
        base = size * base[:, told].reshape(*ddq.shape, -1)
        return Inertia(Y.reshape(*ddq.shape, -1), base, size * back[:, told] / length[:, None])
