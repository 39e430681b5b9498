"""Polynomials that meet given derivatives at both ends of a time interval, one after the other.

Coefficients are in ascending powers of time everywhere: ``p(t) = c[0] + c[1] t + c[2] t^2 + ...``. (The thesis, eq.
4.24-4.26, mixes ascending powers in its matrix with descending ones in its derivatives.)
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from lwa4d_sim.errors import TrajectoryError
from lwa4d_sim.interfaces import Array, IntArray

HALF_NS = 0.5e-9  # [s] simulated time is whole nanoseconds: a time this near to a knot is meant to be the knot


def falling(k: ArrayLike, j: int) -> Array:
    """Factor k (k - 1) ... (k - j + 1) that the j-th derivative puts before t^(k - j); 0 where k < j."""
    k = np.asarray(k, dtype=float)
    return np.prod([k - i for i in range(j)], axis=0) if j else np.ones_like(k)


def boundary_polynomial(T: ArrayLike, start: ArrayLike, end: ArrayLike) -> Array:
    """Polynomial of lowest degree with given derivatives at t = 0 and t = T.

    The equations (thesis, eq. 4.24-4.26) are solved in s = t / T, where they do not depend on T.

    Args:
        T: length of the interval [s], positive; a number or an array that broadcasts to the trailing axes.
        start: position, velocity, acceleration, ... at t = 0, (d, ...).
        end: the same at t = T, (d, ...).

    Returns:
        Coefficients (2 d, ...) in ascending powers of t; d = 1 is a line, 2 a cubic, 3 a quintic, 4 a septic.

    Raises:
        TrajectoryError: T is not positive, or start and end differ in shape.
    """
    T, start, end = np.asarray(T, dtype=float), np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    if not np.all(T > 0):
        raise TrajectoryError(f"T (={T.min()}) must be a positive time in seconds")
    if start.shape != end.shape or start.ndim == 0:
        raise TrajectoryError(f"start (shape {start.shape}) and end (shape {end.shape}) must both have shape (d, ...)")
    d = len(start)
    k = np.arange(2 * d)
    A = np.array([falling(k, j) for j in range(d)])  # (d, 2 d): derivatives of s^k at s = 1
    unit = T ** k.reshape(-1, *[1] * (start.ndim - 1))  # (2 d, ...): d^k/ds^k = T^k d^k/dt^k
    low = unit[:d] * start / np.array([falling(j, j) for j in range(d)]).reshape(-1, *[1] * (start.ndim - 1))
    rest = unit[:d] * end - np.tensordot(A[:, :d], low, axes=1)
    high = np.linalg.solve(A[:, d:], rest.reshape(d, -1)).reshape(rest.shape)
    return np.asarray(np.concatenate([low, high]) / unit)


def differentiate(coefficients: Array, order: int = 1) -> Array:
    """Coefficients (max(p - order, 0), ...) of a derivative of the polynomial with ``coefficients`` (p, ...)."""
    factors = falling(np.arange(len(coefficients)), order)[order:]
    return np.asarray(coefficients[order:] * factors.reshape(-1, *[1] * (coefficients.ndim - 1)))


def evaluate(coefficients: Array, t: ArrayLike, derivative: int = 0) -> Array:
    """Value of a polynomial or of one of its derivatives.

    Args:
        coefficients: ascending powers, (p, ...).
        t: times [s], broadcast against the trailing axes of the coefficients.
        derivative: 0 for the value, 1 for the velocity, ...

    Returns:
        The value, of the broadcast shape of ``t`` and ``coefficients[0]``.
    """
    t = np.asarray(t, dtype=float)
    value = np.zeros(np.broadcast_shapes(t.shape, coefficients.shape[1:]))
    for c in differentiate(coefficients, derivative)[::-1]:  # Horner
        value *= t
        value += c
    return value


@dataclass(frozen=True, eq=False)
class PiecewisePolynomial:
    """Polynomials joined end to end, each in the time since its own start.

    Attributes:
        lengths: length of each segment [s], (S,).
        coefficients: ascending powers, (p, S, m).
    """

    lengths: Array
    coefficients: Array

    @cached_property
    def knots(self) -> Array:
        """End time of each segment [s], (S,)."""
        return np.cumsum(self.lengths)

    def locate(self, t: Array) -> tuple[IntArray, Array]:
        """Segment (K,) and time since its start (K,) [s] of each time; a knot belongs to the segment it starts."""
        segment = np.minimum(np.searchsorted(self.knots - HALF_NS, t, side="right"), len(self.lengths) - 1)
        start = self.knots - self.lengths
        return segment, np.clip(t - start[segment], 0.0, self.lengths[segment])

    def at(self, segment: IntArray, local: Array, derivative: int = 0) -> Array:
        """Derivative (K, m) at a time (K,) [s] since the start of the segment (K,)."""
        return evaluate(differentiate(self.coefficients, derivative).take(segment, axis=1), local[:, None])

    def __call__(self, t: Array) -> tuple[Array, Array, Array]:
        """Position, velocity and acceleration at the times ``t`` (K,) [s], each (K, m)."""
        segment, local = self.locate(t)
        return self.at(segment, local), self.at(segment, local, 1), self.at(segment, local, 2)
