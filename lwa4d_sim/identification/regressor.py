"""Regressors of a serial arm: torque, momentum and its counterpart, each linear in the links' inertial parameters.

With S_j the screw of joint j, V and A twist and acceleration of link i and I(pi) its spatial inertia, all in the link's
own frame (Featherstone 2008, chapters 2 and 5; derived from the Newton-Euler and Lagrange equations):

    tau_j    = S_j . I A - (V x S_j) . I V           gravity enters as A - g
    p_j      = S_j . I V                             momentum, M(q) dq
    dL/dq_j  = (P_j x S_j) . I V + S_j . I g         P_j: the part of V from joints 1..j

so that d/dt p = tau + dL/dq. Each is a sum over links of one bilinear form, `_project`.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from lwa4d_sim.chain import Chain
from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.rotations import skew

CHUNK = 1024  # samples evaluated together (measured: fewer cost NumPy's overhead, more gain nothing)


class _Link(NamedTuple):
    """Link i at some states: screws (3, i + 1, T) of joints 1 to i+1 and gravity (3, 1, T), in the link's frame."""

    w: Array
    v: Array
    g: Array


class Regressor:
    """Regressors of one arm; columns are the ten inertial parameters of each link, base to tip (`inertia.NAMES`).

    Args:
        chain: geometry.
        gravity: (3,) [m/s^2] in the base frame.
    """

    def __init__(self, chain: Chain, gravity: Array) -> None:
        self.n = len(chain.names)
        self._chain = chain
        self._gravity = np.asarray(gravity, float)
        # the part of each joint's rotation matrix that turns: R(q) = 1 + sin(q) K + (1 - cos(q)) K^2 (Rodrigues)
        K = skew(chain.axis)
        self._K, self._K2 = K, K @ K
        self._anchor = chain.pos + np.einsum("nij,nj->ni", chain.R, chain.anchor)  # in the previous link's frame

    def torque(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Y with tau = Y pi, (T, n, 10 n), at states (T, n)."""
        out = np.empty((len(q), self.n, 10 * self.n))
        scratch = self._scratch()
        for rows, (Q, dQ, ddQ) in self._chunks(q, dq, ddq):
            for i, link in enumerate(self._links(Q)):
                d, dd = dQ[: i + 1], ddQ[: i + 1]
                P_w, P_v = _prefix_sums(link.w * d), _prefix_sums(link.v * d)
                w, v = P_w[:, -1:], P_v[:, -1:]
                turn, slide = _ad(link.w, link.v, w - P_w, v - P_v)
                alpha = (link.w * dd + turn * d).sum(axis=1, keepdims=True)
                a = (link.v * dd + slide * d).sum(axis=1, keepdims=True) - link.g
                block = scratch[: i + 1, 10 * i : 10 * i + 10, : Q.shape[1]]
                _project(link.w, link.v, alpha, a, block)
                block -= _project(*_ad(w, v, link.w, link.v), w, v)
            out[rows] = scratch[..., : Q.shape[1]].transpose(2, 0, 1)
        return out

    def momentum(self, q: Array, dq: Array) -> tuple[Array, Array]:
        """Yp and Yq with M dq = Yp pi and dL/dq = Yq pi, each (T, n, 10 n), at states (T, n)."""
        Yp, Yq = np.empty((2, len(q), self.n, 10 * self.n))
        p, l = self._scratch(), self._scratch()
        for rows, (Q, dQ) in self._chunks(q, dq):
            for i, link in enumerate(self._links(Q)):
                P_w, P_v = _prefix_sums(link.w * dQ[: i + 1]), _prefix_sums(link.v * dQ[: i + 1])
                w, v = P_w[:, -1:], P_v[:, -1:]
                at = slice(0, i + 1), slice(10 * i, 10 * i + 10), slice(0, Q.shape[1])
                _project(link.w, link.v, w, v, p[at])
                _project(*_ad(P_w, P_v, link.w, link.v), w, v, l[at])
                l[at] += _project(link.w, link.v, np.zeros_like(link.g), link.g)
            Yp[rows], Yq[rows] = (x[..., : Q.shape[1]].transpose(2, 0, 1) for x in (p, l))
        return Yp, Yq

    def _scratch(self) -> Array:
        """Room for the regressor of a chunk, samples last; what a link does not do to the joints above it stays 0."""
        return np.zeros((self.n, 10 * self.n, CHUNK))

    def _chunks(self, *states: Array) -> Iterator[tuple[slice, list[Array]]]:
        """Pieces of the states, joints first (n, T)."""
        for x in states:
            if x.ndim != 2 or x.shape[1] != self.n or x.shape != states[0].shape:
                raise IdentificationError(f"states have shape {x.shape}; they must be (samples, {self.n} joints)")
        for start in range(0, len(states[0]), CHUNK):
            rows = slice(start, min(start + CHUNK, len(states[0])))
            yield rows, [np.ascontiguousarray(x[rows].T) for x in states]

    def _links(self, q: Array) -> Iterator[_Link]:
        """The links from base to tip at ``q`` (n, T)."""
        T = q.shape[1]
        w: Array = np.empty((3, 0, T))
        v: Array = np.empty((3, 0, T))
        g: Array = np.repeat(self._gravity[:, None, None], T, axis=2)
        for i in range(self.n):
            chain = self._chain
            joint = chain.axis[i], chain.anchor[i]
            if chain.slide[i]:
                E = chain.R[i].T[:, :, None]
                anchor = self._anchor[i][:, None] + (chain.R[i] @ chain.axis[i])[:, None] * q[i]
                own = np.zeros(3), joint[0]
            else:
                turn = np.eye(3)[:, :, None] - np.sin(q[i]) * self._K[i][:, :, None]
                turn = turn + (1.0 - np.cos(q[i])) * self._K2[i][:, :, None]  # transposed, so from parent to link
                E = np.einsum("ijt,kj->ikt", turn, chain.R[i])
                anchor = np.repeat(self._anchor[i][:, None], T, axis=1)
                own = joint[0], np.zeros(3)
            v = v + _cross(w, anchor[:, None])
            back = -chain.anchor[i][:, None, None]
            w, v, g = (_turned(E, x) for x in (w, v, g))
            v = v + _cross(w, np.broadcast_to(back, (3, 1, T))) if chain.anchor[i].any() else v
            own = own[0], own[1] - np.cross(own[0], chain.anchor[i])
            w, v = (_with_column(x, column) for x, column in zip((w, v), own, strict=True))
            yield _Link(w, v, g)


def _turned(E: Array, x: Array) -> Array:
    """E x for rotations (3, 3, T) and vectors (3, k, T)."""
    out = np.empty_like(x)
    for i in range(3):
        np.multiply(E[i, 0], x[0], out=out[i])
        out[i] += E[i, 1] * x[1]
        out[i] += E[i, 2] * x[2]
    return out


def _with_column(x: Array, column: Array) -> Array:
    out = np.empty((3, x.shape[1] + 1, x.shape[2]))
    out[:, :-1], out[:, -1] = x, column[:, None]
    return out


def _prefix_sums(x: Array) -> Array:
    """Sums over the first 1, 2, ... of k, in place (a tenth of the time of np.cumsum along this axis)."""
    for j in range(1, x.shape[1]):
        x[:, j] += x[:, j - 1]
    return x


def _cross(a: Array, b: Array) -> Array:
    """Cross products of vectors (3, k, T), k broadcast."""
    out = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        np.multiply(a[j], b[k], out=out[i])
        out[i] -= a[k] * b[j]
    return out


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _ad(w: Array, v: Array, w2: Array, v2: Array) -> tuple[Array, Array]:
    """Cross product of twists (w, v) x (w2, v2)."""
    return _cross(w, w2), _cross(w, v2) + _cross(v, w2)


def _project(w: Array, v: Array, omega: Array, u: Array, out: Array | None = None) -> Array:
    """Coefficients (k, 10, T) of (w, v) . I(pi) (omega, u) in pi, for screws (3, k, T) and one twist (3, 1, T)."""
    if out is None:
        out = np.empty((w.shape[1], 10, w.shape[2]))
    rows = out.swapaxes(0, 1)
    rows[0] = _dot(v, u)
    rows[1:4] = _cross(v, omega) + _cross(u, w)
    rows[4], rows[6], rows[9] = w * omega
    rows[5] = w[0] * omega[1] + w[1] * omega[0]
    rows[7] = w[0] * omega[2] + w[2] * omega[0]
    rows[8] = w[1] * omega[2] + w[2] * omega[1]
    return out
