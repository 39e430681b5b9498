"""Least-squares splines through samples: a zero-phase filter and differentiator whose every step is a known matrix."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.interfaces import Array

DEGREE = 5  # two continuous derivatives are needed; the fifth degree keeps the fourth, and bends least at the ends


class Frame:
    """Splines of degree 5 through samples at given instants: what depends on the instants alone, worked out once.

    A knot every ``spacing`` lets pass what is slower than 1 / (2 spacing) and nothing faster; no phase is lost.

    Args:
        t: instants of the samples (K,) [s].
        spacing: of the knots [s]; at least that of the samples.

    Raises:
        IdentificationError: too few samples.
    """

    def __init__(self, t: Array, spacing: float) -> None:
        from scipy.sparse.linalg import splu

        if len(t) < 4 * DEGREE:
            raise IdentificationError(f"{len(t)} samples are too few for a spline; at least {4 * DEGREE} are needed")
        every = max(1, round(spacing / float(np.median(np.diff(t)))))
        inner = t[DEGREE // 2 + 1 : -(DEGREE // 2 + 1) : every]
        self.t = t
        self.knots = np.concatenate([[t[0]] * (DEGREE + 1), inner, [t[-1]] * (DEGREE + 1)])
        self.samples = _basis(t, self.knots, DEGREE, 0)
        self.normal: Any = splu((self.samples.T @ self.samples).tocsc())
        self._bases: dict[tuple[int, int], tuple[Array, Any]] = {}

    def basis(self, t: Array, derivative: int) -> Any:
        """B-splines, or a derivative of them, at instants (T,): sparse (T, m)."""
        key = id(t), derivative
        if key not in self._bases:
            self._bases[key] = t, _basis(t, self.knots, DEGREE, derivative)  # with t, so that its id stays taken
        return self._bases[key][1]


@dataclass(frozen=True)
class Spline:
    """A least-squares spline through noisy samples of one signal.

    Attributes:
        frame: of the samples that exist.
        coefficients: of the B-splines (m,).
        noise: standard deviation of the samples about the spline, or None where it goes through all of them.
    """

    frame: Frame
    coefficients: Array
    noise: float | None

    @staticmethod
    def through(t: Array, values: Array, spacing: float, like: "Spline | None" = None) -> "Spline":
        """Fit samples (K,) at instants (K,) [s]; NaN are left out.

        Args:
            t: instants.
            values: samples.
            spacing: of the knots [s].
            like: another spline, whose frame is taken over where the instants are the same.

        Raises:
            IdentificationError: too few samples.
        """
        there = np.isfinite(values)
        t, values = t[there], values[there]
        same = like is not None and np.array_equal(like.t, t)
        frame = like.frame if like is not None and same else Frame(t, spacing)
        c = frame.normal.solve(frame.samples.T @ values)
        left = len(t) - len(c)
        noise = float(np.sqrt(((values - frame.samples @ c) ** 2).sum() / left)) if 4 * left > len(t) else None
        return Spline(frame, c, noise)

    @property
    def t(self) -> Array:
        """Instants of the samples (K,) [s]."""
        return self.frame.t

    def at(self, t: Array, derivative: int = 0) -> Array:
        """The signal or one of its derivatives at instants (T,)."""
        return np.asarray(self.frame.basis(t, derivative) @ self.coefficients)

    def refit(self, values: Array) -> "Spline":
        """The spline through other samples (K,) at the same instants."""
        return replace(self, coefficients=self.frame.normal.solve(self.frame.samples.T @ values))

    def adjoint(self, *terms: tuple[Array, int, Array]) -> Array:
        """Gradient (K, ...) with respect to the samples of the sum of ``weights @ at(t, derivative)``.

        Args:
            terms: (instants (T,), derivative, weights (T, ...)) each.
        """
        total = sum(self.frame.basis(t, derivative).T @ weights for t, derivative, weights in terms)
        return np.asarray(self.frame.samples @ self.frame.normal.solve(np.ascontiguousarray(total)))


def _basis(t: Array, knots: Array, degree: int, derivative: int) -> Any:
    """B-splines, or a derivative of them, at instants (T,): sparse (T, m)."""
    from scipy.interpolate import BSpline
    from scipy.sparse import diags_array

    if derivative == 0:
        return BSpline.design_matrix(t, knots, degree)
    # d/dt B_i,k = k B_i,k-1 / (t_i+k - t_i) - k B_i+1,k-1 / (t_i+k+1 - t_i+1) (de Boor 1978, chapter X)
    rate = degree / (knots[degree + 1 : -1] - knots[1 : -degree - 1])
    m = len(rate)
    differences: Any = diags_array((-rate, rate), offsets=(0, 1), shape=(m, m + 1))
    return _basis(t, knots[1:-1], degree - 1, derivative - 1) @ differences
