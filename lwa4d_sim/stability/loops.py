"""A loop as one matrix from tick to tick, with the gains still free; and the loop without a bus."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lwa4d_sim.interfaces import Array, IntArray
from lwa4d_sim.stability.linear import Linear
from lwa4d_sim.stability.margins import spectral_radius


@dataclass(frozen=True, slots=True)
class Loop:
    """The loop at P operating points, from tick to tick: X' = (F + G (U0 + k U1)) X, with k a factor on all gains.

    X holds the arm (q, dq), the drives' speed filters, the estimators, samples on their way and commands on their way.

    Attributes:
        F: (P, m, m), the loop with the torque command taken away.
        G: (P, m, n), what a command does.
        U0: (P, n, m), the command with all gains zero.
        U1: (P, n, m), what the gains add.
        period: [s].
        given: rows of the q and dq that the law gets, (P, 2n, m).
        rest: rows of what is added to its torque, (P, n, m).
        curve: slopes of the law (K, n, 2n) at some of the points with all gains times (K,), where the command is not
            U0 + k U1.
    """

    F: Array
    G: Array
    U0: Array
    U1: Array
    period: float
    given: Array
    rest: Array
    curve: Callable[[IntArray, Array], Array] | None

    @property
    def n(self) -> int:
        """Number of joints."""
        return int(self.G.shape[2])

    def U(self, rows: IntArray, k: Array) -> Array:
        """The commands (K, n, m) of the loops ``rows`` with all gains times ``k``, both (K,)."""
        if self.curve is not None:
            command: Array = self.curve(rows, k) @ self.given[rows] + self.rest[rows]
            return command
        return self.U0[rows] + k[:, None, None] * self.U1[rows]

    def at_gain(self, k: Array | float = 1.0) -> Array:
        """The loop's matrix (P, m, m) with all gains times ``k`` (P,)."""
        everyone = np.arange(len(self.F))
        matrix: Array = self.F + self.G @ self.U(everyone, np.broadcast_to(np.asarray(k, float), everyone.shape))
        return matrix

    def radius(self, rows: IntArray, k: Array) -> Array:
        """Spectral radii of the loops ``rows`` with all gains times ``k``, both (K,)."""
        return spectral_radius(self.F[rows] + self.G[rows] @ self.U(rows, k))


@dataclass(frozen=True, slots=True)
class Continuous:
    """The ideal loop at P operating points, dx/dt = (A + B (U0 + k U1)) x; its matrix is that of one plant step."""

    A: Array
    B: Array
    U0: Array
    U1: Array
    period: float

    @classmethod
    def of(cls, linear: Linear, step: float) -> "Continuous":
        """The loop without a bus; ``step`` [s] is the time that its spectral radius refers to."""
        return cls(linear.A, linear.B, linear.bare, linear.law - linear.bare, step)

    @property
    def n(self) -> int:
        """Number of joints."""
        return int(self.B.shape[2])

    def at_gain(self, k: Array | float = 1.0) -> Array:
        """e^((A + B U) h) (P, m, m) with all gains times ``k`` (P,)."""
        from scipy.linalg import expm

        factor = np.asarray(k, float)[..., None, None]
        matrix: Array = expm(self.period * (self.A + self.B @ (self.U0 + factor * self.U1)))
        return matrix

    def radius(self, rows: IntArray, k: Array) -> Array:
        """Spectral radii over one plant step of the loops ``rows`` with all gains times ``k``, both (K,)."""
        slopes = self.A[rows] + self.B[rows] @ (self.U0[rows] + k[:, None, None] * self.U1[rows])
        radius: Array = np.exp(self.period * np.linalg.eigvals(slopes).real.max(axis=1))
        return radius
