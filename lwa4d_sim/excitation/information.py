"""How much a motion tells about the base parameters: the log determinant of the information, and its slope."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from lwa4d_sim.identification.base import base_of, random_regressor
from lwa4d_sim.identification.options import Kind
from lwa4d_sim.identification.parameters import unknowns_of
from lwa4d_sim.identification.regressor import Regressor
from lwa4d_sim.interfaces import Array

KINDS: tuple[Kind, ...] = ("viscous", "coulomb", "offset", "armature")  # of unknowns in every joint
STEP = 1e-6  # [rad, rad/s] of the differences; derived: their truncation and rounding are then both far below 1e-5
FLOOR = 1e-12  # information that everybody has, so that a motion which tells nothing has a finite logarithm (assumed)
WIDTH = 0.05  # share of the speed limit over which Coulomb friction turns (assumed), see `Information`


class Slopes(NamedTuple):
    """Derivatives with respect to position, speed and acceleration at each sample.

    Attributes:
        log_det: of the log determinant, (3, T, n).
        torque: of the torque of joint i with respect to joint k, (3, T, n, n).
    """

    log_det: Array
    torque: Array


class Information:
    """Information about the base parameters of an arm with viscous and Coulomb friction, rotor inertia and offset.

    A sample counts with Y^T W Y: Y the regressor of the joint torques, W = 1 / limit^2 for each joint, as if torques
    were known to one share of the joint's limit. Columns are scaled to an rms of 1 over random states, which shifts the
    log determinant by a constant and frees it of units. Coulomb torque turns smoothly, as a search needs it, over a
    share of the speed limit; slower samples tell little about it in truth as well.

    Args:
        model: compiled nominal arm.
        torque: scale of the torque of each joint (n,) [N m].
        speed: largest speeds (n,) [rad/s].

    Attributes:
        base: columns of the base parameters.
    """

    def __init__(self, model: Any, torque: Array, speed: Array) -> None:
        unknowns = unknowns_of(model, KINDS)
        self._regressor = Regressor(unknowns.chain, unknowns.gravity)
        self._pi, self._torque, self._turn = unknowns.values(model), torque, WIDTH * speed
        self._own: Mapping[Kind, Any] = {kind: unknowns.columns(kind) for kind in KINDS}
        self.base = base_of(unknowns).columns
        drawn = random_regressor(unknowns)[..., self.base] / torque[:, None]
        self._scale = np.sqrt(np.mean(drawn**2, axis=(0, 1)))

    def columns(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Regressor of all parameters, rows as shares of the torque scale, (T, n, P)."""
        T, n = q.shape
        Y = np.zeros((T, n, len(self._pi)))
        Y[:, :, : 10 * n] = self._regressor.torque(q, dq, ddq)
        own = {"viscous": dq, "coulomb": np.tanh(dq / self._turn), "offset": np.ones_like(q), "armature": ddq}
        for kind, columns in self._own.items():
            Y[:, np.arange(n), columns] = own[kind]
        Y /= self._torque[:, None]
        return Y

    def torque(self, Y: Array) -> Array:
        """Torques (T, n) [N m] that the nominal parameters give."""
        return np.asarray((Y @ self._pi) * self._torque)

    def of(self, Y: Array) -> float:
        """Log determinant of the information of the samples with columns ``Y`` (T, n, P)."""
        return float(np.linalg.slogdet(self._matrix(Y)).logabsdet)

    def condition(self, Y: Array) -> float:
        """Condition number of the base columns, each scaled to length 1."""
        rows = Y[..., self.base].reshape(-1, len(self.base))
        return float(np.linalg.cond(rows / np.linalg.norm(rows, axis=0)))

    def _matrix(self, Y: Array) -> Array:
        rows = (Y[..., self.base] / self._scale).reshape(-1, len(self.base))
        return np.asarray(rows.T @ rows + FLOOR * np.eye(len(self.base)))

    def slopes(self, q: Array, dq: Array, ddq: Array, Y: Array, counted: int) -> Slopes:
        """Derivatives of `of` (from the first ``counted`` samples) and of `torque` (of all).

        d log det A = 2 sum over samples of tr(A^-1 Y^T W dY); dY by differences.
        """
        T, n = q.shape
        rows = Y[:counted, :, self.base] / self._scale
        G = np.zeros((T, n, Y.shape[2]))
        solved = np.linalg.solve(self._matrix(Y[:counted]), rows.reshape(-1, len(self.base)).T).T
        G[:counted, :, self.base] = 2.0 * solved.reshape(rows.shape) / self._scale
        log_det, torque = np.zeros((3, T, n)), np.zeros((3, T, n, n))
        states = np.stack([q, dq, ddq])
        links = slice(0, 10 * n)
        weighted = G[..., links] / self._torque[:, None]
        base = Y[..., links] * self._torque[:, None]
        for kind in range(3):
            for k in range(n):
                moved = states.copy()
                moved[kind, :, k] += STEP
                dY = (self._regressor.torque(*moved) - base) / STEP
                log_det[kind, :, k] = np.einsum("tip,tip->t", weighted, dY)
                torque[kind, :, :, k] = dY @ self._pi[links]
        self._add_joints(dq, G, log_det, torque)
        return Slopes(log_det, torque)

    def _add_joints(self, dq: Array, G: Array, log_det: Array, torque: Array) -> None:
        """What friction and rotors add to the derivatives."""
        j, one = np.arange(dq.shape[1]), np.ones_like(dq)
        turning = (1.0 - np.tanh(dq / self._turn) ** 2) / self._turn
        slopes: tuple[tuple[Kind, int, Array], ...] = ("viscous", 1, one), ("coulomb", 1, turning), ("armature", 2, one)
        for kind, rate, slope in slopes:
            columns = self._own[kind]
            log_det[rate] += G[:, j, columns] / self._torque * slope
            torque[rate][:, j, j] += self._pi[columns] * slope
