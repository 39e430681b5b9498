"""A Fourier series as a running curve, and the quintics that lead into it from rest and out of it to rest."""

from collections.abc import Callable

import numpy as np

from lwa4d_sim.interfaces import Array
from lwa4d_sim.polynomials import PiecewisePolynomial, boundary_polynomial

Curve = Callable[[Array], tuple[Array, Array, Array]]  # t (K,) -> position, velocity, acceleration, each (K, m)


def fourier_series(a: Array, b: Array, offset: Array, omega: float) -> Curve:
    """Sum of sines (thesis, eq. 5.4): offset + sum over k of a_k / (k omega) sin(k omega t) - b_k / (k omega) cos(...).

    Args:
        a: speed amplitudes (m, N) [rad/s].
        b: likewise (m, N) [rad/s].
        offset: (m,) [rad].
        omega: base frequency [rad/s].
    """
    k_omega = omega * np.arange(1, a.shape[-1] + 1)

    def curve(t: Array) -> tuple[Array, Array, Array]:
        sin, cos = np.sin(t[:, None] * k_omega), np.cos(t[:, None] * k_omega)  # (K, N)
        q = offset + (sin / k_omega) @ a.T - (cos / k_omega) @ b.T
        return q, cos @ a.T + sin @ b.T, (cos * k_omega) @ b.T - (sin * k_omega) @ a.T

    return curve


def led(curve: Curve, q0: Array, lead_in: float, duration: float, lead_out: float) -> tuple[Array, Curve]:
    """The curve with a start from rest and a stop, both continuous up to the acceleration.

    Before it a quintic goes from rest at ``q0`` to the curve's first position, speed and acceleration. After it another
    goes to rest at p + v T / 2, with p and v at the curve's end and T = ``lead_out``: as far as an even braking takes,
    so that the speed falls without a swing where the curve ends without acceleration (derived).

    Args:
        curve: the motion in [0, ``duration``].
        q0: start (m,) [rad].
        lead_in: time before the curve [s]; 0 for none.
        duration: length of the curve [s].
        lead_out: time after the curve [s]; 0 for none.

    Returns:
        End time of each part (parts,) [s], and the whole motion as a function of time from 0 to the last of them.
    """
    start = np.array([np.asarray(x)[0] for x in curve(np.zeros(1))])
    end = np.array([np.asarray(x)[0] for x in curve(np.array([duration]))])
    begin, rest = np.zeros((2, *start.shape))
    begin[0] = q0
    rest[0] = end[0] + end[1] * lead_out / 2.0
    lead = _quintic(lead_in, begin, start) if lead_in > 0.0 else None
    stop = _quintic(lead_out, end, rest) if lead_out > 0.0 else None

    def whole(t: Array) -> tuple[Array, Array, Array]:
        since, after = t - lead_in, t - lead_in - duration
        q, dq, ddq = curve(np.clip(since, 0.0, duration))
        for part, local, inside in ((lead, t, since < 0.0), (stop, after, after > 0.0)):
            if part is not None and inside.any():
                q, dq, ddq = (np.where(inside[:, None], x, y) for x, y in zip(part(local), (q, dq, ddq), strict=True))
        return q, dq, ddq

    return np.cumsum([lead_in, duration, lead_out])[[lead_in > 0.0, True, lead_out > 0.0]], whole


def _quintic(T: float, start: Array, end: Array) -> PiecewisePolynomial:
    """From position, velocity, acceleration (3, m) to others in the time ``T`` [s]."""
    return PiecewisePolynomial(np.array([T]), boundary_polynomial(T, start, end)[:, None])
