"""What noise of the samples does to an estimate: each sample's influence, exact to first order, and the sum of all.

A position error d of joint j moves window (w, i) of the residual b - Y x by

    int phi' (M_ij d' + dp_i/dq_j d) + phi (dl_i/ddq_j d' + dl_i/dq_j d) - phi viscous_j d' [i = j] dt,

with p the momentum and l = dL/dq of the estimated arm (derived by differentiating the momentum form), and a torque
error by its share of the window. An estimate is linear in the residual and a spline in its samples, so that every
sample's influence is a product of known matrices.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lwa4d_sim.identification.equations import Equations
from lwa4d_sim.identification.regressor import Regressor
from lwa4d_sim.interfaces import Array

STEP = 1e-5  # [rad] of central differences; momentum is smooth over radians, so 1e-10 of it is lost
PROBES = 16  # assumed: random signals behind a spectrum; with the next, it is known to about a tenth
SMOOTHING = 5  # assumed: frequencies averaged


@dataclass(frozen=True)
class Influence:
    """Covariances of an estimate per unit of noise.

    Attributes:
        position: (n, r, r) [1/rad^2]: white noise of variance 1 on the position samples of each joint.
        torque: (n, r, r) [1/(N m)^2]: the same on its torque samples.
        rows_position: spectrum of joint i's rows for such noise on joint j, (n, n, B).
        rows_torque: the same for torque noise on joint i, (n, B).
    """

    position: Array
    torque: Array
    rows_position: Array
    rows_torque: Array

    def torque_noise(self, residual: Array, position_noise: Array, parameters: int) -> Array:
        """Standard deviation of each joint's torque samples (n,) [N m] that explains the residual (W, n) best.

        Position noise shows at high frequencies, torque noise at all: the likelihood of the residual's spectrum tells
        one from the other (Whittle 1953).

        Args:
            residual: of a fit; 0 in rows that were not used.
            position_noise: standard deviation of each joint's position samples (n,) [rad].
            parameters: number fitted, which makes residuals smaller than errors.
        """
        from scipy.optimize import minimize_scalar

        found = np.zeros(len(position_noise))
        spectrum = _spectrum(residual) / (1.0 - parameters / np.count_nonzero(residual))
        from_position = np.einsum("ijb,j->ib", self.rows_position, position_noise**2)
        for i, (I, S_q, S_tau) in enumerate(zip(spectrum, from_position, self.rows_torque, strict=True)):

            def cost(log: float, I: Array = I, S_q: Array = S_q, S_tau: Array = S_tau) -> float:
                S = S_q + np.exp(log) * S_tau
                return float((np.log(S) + I / S).sum())

            middle = np.log(max(I.sum(), 1e-30) / S_tau.sum())
            found[i] = np.exp(0.5 * minimize_scalar(cost, bounds=(middle - 14.0, middle + 4.0), method="bounded").x)
        return found

    def covariance(self, position_noise: Array, torque_noise: Array) -> Array:
        """Covariance (r, r) of the estimate for standard deviations (n,) of the samples."""
        variances = np.concatenate([position_noise**2, torque_noise**2])
        return np.asarray(np.einsum("k,krs->rs", variances, np.concatenate([self.position, self.torque])))


def influence(equations: Equations, used: NDArray[np.bool_], x: Array, gain: Array) -> Influence:
    """The influence of noise on an estimate.

    Args:
        equations: that were fitted.
        used: rows (W, n) that were fitted.
        x: unknowns (P,) with the torques of the estimate.
        gain: the estimate's dependence on b, (r, W, n).
    """
    e, n = equations, equations.unknowns.n
    M, dp, dl = _rates(e, x)
    viscous = x[e.unknowns.columns("viscous")] if "viscous" in e.unknowns.kinds else np.zeros(n)
    slope = dp.swapaxes(1, 2) - viscous[:, None] * np.eye(n)  # dl_i/ddq_j = d^2 T / dq_i ddq_j = dp_j/dq_i
    through = gain.transpose(1, 2, 0)  # (W, n, r)
    flat = through.reshape(len(through), -1)
    seen, seen_rate = ((matrix.T @ flat).reshape(-1, n, len(gain)) for matrix in (e.F, e.dF))
    position = np.empty((n, len(gain), len(gain)))
    rows, rows_torque = [], []
    rng = np.random.default_rng(0)
    for j, spline in enumerate(e.motion.splines):
        on_speed = np.einsum("ti,tir->tr", M[:, :, j], seen_rate) + np.einsum("ti,tir->tr", slope[:, :, j], seen)
        on_angle = np.einsum("ti,tir->tr", dp[:, :, j], seen_rate) + np.einsum("ti,tir->tr", dl[:, :, j], seen)
        s = spline.adjoint((e.motion.t, 1, on_speed), (e.motion.t, 0, on_angle))
        position[j] = s.T @ s
        square = []
        for _ in range(PROBES):
            noise = spline.refit(rng.normal(size=len(spline.t)))
            d, rate = noise.at(e.motion.t)[:, None], noise.at(e.motion.t, 1)[:, None]
            moved = e.dF @ (M[:, :, j] * rate + dp[:, :, j] * d) + e.F @ (slope[:, :, j] * rate + dl[:, :, j] * d)
            square.append(_spectrum(moved * used))
        rows.append(_smoothed(np.mean(square, axis=0)))
    torque = np.empty_like(position)
    for i, A in enumerate(e.A):
        s = A.T @ through[:, i]
        torque[i] = s.T @ s
        moved = A @ rng.normal(size=(A.shape[1], PROBES)) * used[:, i, None]
        rows_torque.append(_smoothed(_spectrum(moved).mean(axis=0)))
    return Influence(position, torque, np.stack(rows, axis=1), np.stack(rows_torque))


def _spectrum(rows: Array) -> Array:
    """Periodogram (n, B) of series (W, n), the mean left out."""
    return np.asarray((np.abs(np.fft.rfft(rows, axis=0)[1:]) ** 2 / len(rows)).T)


def _smoothed(spectrum: Array) -> Array:
    """Running mean over a few frequencies: spectra of noise through smooth filters are smooth."""
    from scipy.ndimage import uniform_filter1d

    return np.asarray(uniform_filter1d(spectrum, SMOOTHING, axis=-1, mode="nearest"))


def _rates(e: Equations, x: Array) -> tuple[Array, Array, Array]:
    """M, dp_i/dq_j and dl_i/dq_j on the grid, each (T, n, n)."""
    u, motion = e.unknowns, e.motion
    regressor, pi = Regressor(u.chain, u.gravity), x[: 10 * u.n]
    M, dp, dl = np.empty((3, *motion.q.shape, u.n))
    for j, unit in enumerate(np.eye(u.n)):
        M[:, :, j] = regressor.momentum(motion.q, np.broadcast_to(unit, motion.q.shape))[0] @ pi
        ahead, behind = (regressor.momentum(motion.q + sign * STEP * unit, motion.dq) for sign in (1.0, -1.0))
        dp[:, :, j] = (ahead[0] - behind[0]) @ pi / (2.0 * STEP)
        dl[:, :, j] = (ahead[1] - behind[1]) @ pi / (2.0 * STEP)
    if "armature" in u.kinds:
        M += np.diag(x[u.columns("armature")])
    return M, dp, dl
