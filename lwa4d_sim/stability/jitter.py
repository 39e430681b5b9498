"""Delays beyond the plan: the delay margin of a loop without a bus, and how much a sampled loop's delay may vary."""

from typing import Any

import numpy as np

from lwa4d_sim.interfaces import Array
from lwa4d_sim.stability.linear import Linear
from lwa4d_sim.stability.loops import Continuous, Loop
from lwa4d_sim.stability.margins import spectral_radius
from lwa4d_sim.stability.sampled import continuous_part

_FREQUENCIES = 600  # [-] of the search; the largest gain is then refined (assumed: margins differ by less than 1e-4)
_BALANCES = 4  # rounds of scaling the torques against each other; the margin does not grow any more after three


def continuous_delay_margin(loop: Continuous) -> Array:
    """Largest delay (P,) [s] of the ideal loop's torques; inf if any delay will do, 0 if it is unstable without.

    The loop has an eigenvalue jw with delay d where an eigenvalue of L(jw) = U (jw - A)^-1 B is e^(jwd): its modulus is
    1 and its angle w d. The least such d over all w is the margin.
    """
    unstable = spectral_radius(loop.at_gain()) >= 1.0 + 1e-12
    U = loop.U0 + loop.U1
    margin = np.full(len(U), np.inf)
    for i in range(len(U)):
        margin[i] = 0.0 if unstable[i] else _first_crossing(loop.A[i], loop.B[i], U[i])
    return margin


def _first_crossing(A: Array, B: Array, U: Array) -> float:
    from scipy.optimize import brentq

    unit = np.eye(len(A))
    scale = float(np.abs(np.linalg.eigvals(A + B @ U)).max())

    def values(w: Array | float) -> Any:
        jw = 1j * np.atleast_1d(w)[:, None, None]
        found: Any = np.linalg.eigvals(U @ np.linalg.solve(jw * unit - A, np.broadcast_to(B, (len(jw), *B.shape))))
        return np.take_along_axis(found, np.argsort(np.abs(found), axis=1), axis=1)  # moduli, sorted, are continuous

    grid = np.geomspace(1e-4 * scale, 1e3 * scale, _FREQUENCIES)
    moduli = np.log(np.abs(values(grid)))
    least = np.inf
    for k, i in zip(*np.nonzero((moduli[1:] > 0) != (moduli[:-1] > 0)), strict=True):
        w = brentq(lambda x, i=i: float(np.log(np.abs(values(x))[0, i])), grid[k], grid[k + 1], xtol=1e-12 * scale)
        angle = float(np.angle(values(w)[0, i])) % (2.0 * np.pi)
        least = min(least, angle / w)
    return least


def jitter_margin(loop: Loop, linear: Linear, time_constant: float, slack: float, *, whole: bool, apart: bool) -> Array:
    """How much later than planned each command may come (P,) [s], never mind how it varies; 0 if unstable anyway.

    A sufficient bound: by the small-gain theorem the loop is stable for any delays that vary between the planned one
    and N periods more, if with z = e^(jw)

        sqrt(N~ T) |z - 1| ||D U (z - F)^-1 W^(1/2)|| < 1  for all w,  N~ = n^2 + 2 n f + f,  N = n + f

    (Kao and Lincoln 2004; Cervin et al. 2004 for sampled control of one input, whose squared P_alias is here
    (z - F)^-1 W (...)*, with W = integral of e^(As) B D^-1 D^-T B' e^(A's) over a period). D scales the torques against
    each other. Where each is late on its own it must be diagonal and is found by balancing; where all are late alike it
    may be any matrix, and M^(-1/2), which makes the modes of the arm independent, is tried as well.

    Args:
        loop: the loop at P points.
        linear: its arm and law.
        time_constant: of the drives' speed filter [s], or 0.
        slack: what the actuation instant forgives anyway [s].
        whole: delays beyond that are whole periods, as when torques act at a SYNC.
        apart: each joint's torque is late on its own.
    """
    stable = spectral_radius(loop.at_gain()) < 1.0 + 1e-12
    A, B, _ = continuous_part(linear, time_constant)
    out = np.zeros(len(A))
    for i in np.flatnonzero(stable):
        n = linear.n
        one = _Transfer(loop, int(i), A[i], B[i])
        gain = one.balanced() if apart else min(one.balanced(), one.largest(_root(linear.B[i, n:])))
        allowed = 1.0 / (gain**2 * loop.period)
        periods = int(np.floor(np.sqrt(allowed)))
        share = 0.0 if whole else (allowed - periods**2) / (2 * periods + 1)
        out[i] = slack + (periods + share) * loop.period
    return out


class _Transfer:
    """From what late torques do in between the samples to the next change of the command, for one loop."""

    def __init__(self, loop: Loop, i: int, A: Array, B: Array) -> None:
        self._A, self._B, self._period, self._n = A, B, loop.period, loop.n
        self._U = loop.U0[i] + loop.U1[i]
        self._F = loop.F[i] + loop.G[i] @ self._U
        self._angles = np.pi * np.geomspace(1e-4, 1.0, _FREQUENCIES)
        self._T = self._at(self._angles)

    def _at(self, angles: Array) -> Array:
        z = np.exp(1j * angles)[:, None, None]
        right = np.broadcast_to(np.eye(len(self._F), len(self._A)), (len(z), len(self._F), len(self._A)))
        T: Array = (z - 1.0) * (self._U @ np.linalg.solve(z * np.eye(len(self._F)) - self._F, right))
        return T

    def largest(self, D: Array) -> float:
        """Supremum of the norm over the frequency."""
        from scipy.optimize import minimize_scalar

        W = _gramian(self._A, self._B @ np.linalg.inv(D), self._period)
        gains = _norms(self._T, W, D)
        worst = int(np.argmax(gains))
        near = self._angles[[max(0, worst - 1), min(_FREQUENCIES - 1, worst + 1)]]
        found: Any = minimize_scalar(lambda a: -_norms(self._at(np.array([a])), W, D)[0], bounds=tuple(near))
        return max(float(gains.max()), -float(found.fun))

    def balanced(self) -> float:
        """The least of `largest` over some diagonal scalings, each balancing the worst frequency of the one before."""
        grams = np.stack([_gramian(self._A, self._B[:, j : j + 1], self._period) for j in range(self._n)])
        scale: Array = np.ones(self._n)
        least = np.inf
        for _ in range(_BALANCES):
            W = np.einsum("j,jab->ab", scale**-2, grams)
            least = min(least, self.largest(np.diag(scale)))
            worst = int(np.argmax(_norms(self._T, W, np.diag(scale))))
            scale = _balance(self._T[worst], grams, scale)
        return least


def _norms(T: Array, W: Array, D: Array) -> Array:
    """Norms of D T W^(1/2) for transfers T (K, n, s)."""
    square = D @ T @ W @ np.conj(np.swapaxes(T, 1, 2)) @ D.T
    norms: Array = np.sqrt(np.maximum(0.0, np.linalg.eigvalsh(square)[:, -1]))
    return norms


def _root(matrix: Array) -> Array:
    """Symmetric square root of a positive definite matrix."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    root: Array = (vectors * np.sqrt(values)) @ vectors.T
    return root


def _balance(T: Array, grams: Array, scale: Array) -> Array:
    """The scaling that makes rows and columns of the channels' gains alike at one frequency (Osborne 1960)."""
    power = np.einsum("ia,jab,ib->ij", T, grams, np.conj(T)).real  # from a late torque j to the next torque i
    d = scale.copy()
    for _ in range(20):
        for k in range(len(d)):
            others = np.arange(len(d)) != k
            row = (power[k, others] * d[k] ** 2 / d[others] ** 2).sum()
            column = (power[others, k] * d[others] ** 2 / d[k] ** 2).sum()
            if row > 0 and column > 0:
                d[k] *= (column / row) ** 0.25
    balanced: Array = d / d.max()
    return balanced


def _gramian(A: Array, B: Array, T: float) -> Array:
    """Integral of e^(As) B B' e^(A's) over [0, T] (Van Loan 1978)."""
    from scipy.linalg import expm

    s = len(A)
    joined = np.block([[-A, B @ B.T], [np.zeros((s, s)), A.T]])
    e = expm(joined * T)
    gram: Array = e[s:, s:].T @ e[:s, s:]
    return gram
