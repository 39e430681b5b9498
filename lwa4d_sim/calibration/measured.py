"""Measured poses of the tool, with what is known of the instrument; and what a simulated instrument would have read."""

from dataclasses import dataclass

import numpy as np

from lwa4d_sim.calibration.error_model import ErrorModel
from lwa4d_sim.interfaces import Array, IntArray
from lwa4d_sim.rotations import rotation_matrix


@dataclass(frozen=True, kw_only=True)
class Instrument:
    """What measures the tool: standard deviations of each coordinate.

    Attributes:
        position: [m].
        angle: [rad]; None where only positions are measured.
    """

    position: float
    angle: float | None = None

    @property
    def weights(self) -> Array:
        """One over the standard deviations, (3,) or (6,)."""
        sigma = [self.position] * 3 + ([] if self.angle is None else [self.angle] * 3)
        return 1.0 / np.array(sigma)


@dataclass(frozen=True, kw_only=True)
class Measured:
    """K poses of the tool in the frame of the arm's base.

    Attributes:
        q: joint readings (K, n) [rad or m].
        x: tool points (K, 3) [m].
        R: tool orientations (K, 3, 3), or None where only points are measured.
        labels: what messages call each pose, e.g. "row 7".
        source: where they come from.
    """

    q: Array
    x: Array
    R: Array | None
    labels: tuple[str, ...]
    source: str

    def take(self, which: IntArray) -> "Measured":
        """The poses with these indices."""
        R = None if self.R is None else self.R[which]
        labels = tuple(self.labels[i] for i in which)
        return Measured(q=self.q[which], x=self.x[which], R=R, labels=labels, source=self.source)


def measure(
    model: ErrorModel, xi: Array, q: Array, instrument: Instrument, rng: np.random.Generator | None = None
) -> Measured:
    """What the instrument reads of the arm with errors ``xi`` (p,) at readings ``q`` (K, n); exact without ``rng``."""
    x, R, _ = model.predict(q, xi)
    if rng is not None:
        x = x + instrument.position * rng.normal(size=x.shape)
        R = rotation_matrix((instrument.angle or 0.0) * rng.normal(size=x.shape)) @ R
    labels = tuple(f"pose {k + 1}" for k in range(len(q)))
    return Measured(q=q, x=x, R=None if instrument.angle is None else R, labels=labels, source="simulated")
