"""Pieces of a recording that a model is to follow, each from a start of its own (multiple shooting).

A free-running arm soon leaves the recorded one, whatever its model is worth; over a piece of half a second it does not.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.identification.smooth import Spline
from lwa4d_sim.interfaces import Array, IntArray
from lwa4d_sim.recordings.recording import Recording

# Distance of the spline's knots [s]; assumed: passes 20 Hz, above what a controller over a bus can ask of an arm. The
# spline gives first guesses of starts only.
KNOTS = 0.025
LEAST = 10  # samples of each joint in a piece, two of which go into its start (assumed)
FEWEST = 4  # pieces; with fewer their scatter says nothing about errors (assumed)


@dataclass(frozen=True)
class Pieces:
    """S pieces of N steps each, and in each up to m samples of every joint.

    Attributes:
        start: (S,) [s].
        step: of the model [s].
        steps: N.
        state: first guess of position and speed at the start (S, 2 n).
        q: samples (S, m, n) [rad]; 0 where there is none.
        there: whether there is one.
        at: step in which each sample lies, and how far in it, from 0 to 1.
        held: instants [s] and torque integrated up to them [N m s], of each joint.
    """

    start: Array
    step: float
    steps: int
    state: Array
    q: Array
    there: NDArray[np.bool_]
    at: tuple[IntArray, Array]
    held: tuple[tuple[Array, Array], ...]

    def torque(self, delay: Array) -> Array:
        """Mean over each step of the torque that acts ``delay`` (n,) [s] later than recorded, (S, N, n) [N m].

        A torque that changes within a step counts by its share, so that what follows is smooth in the delay.
        """
        edges = self.start[:, None] + self.step * np.arange(self.steps + 1)
        impulse = np.stack([np.interp(edges - d, *held) for d, held in zip(delay, self.held, strict=True)], axis=-1)
        return np.diff(impulse, axis=1) / self.step

    def sampled(self, state: Array) -> Array:
        """Positions (S, m, n) at the samples' instants, from states (S, N + 1, 2 n) at the steps: cubic Hermite."""
        n = self.q.shape[2]
        k, s = self.at
        pieces, joints = np.arange(len(k))[:, None, None], np.arange(n)
        q0, q1 = state[pieces, k, joints], state[pieces, k + 1, joints]
        v0, v1 = (self.step * state[pieces, k + i, joints + n] for i in (0, 1))
        rise = q1 - q0
        return np.asarray(q0 + s * (v0 + s * (3 * rise - 2 * v0 - v1 + s * (v0 + v1 - 2 * rise))))


def cut(recording: Recording, length: float, step: float, reach: float, most: int) -> Pieces:
    """Cut a recording, evenly over its length.

    Args:
        recording: where positions or torques are missing for long, nothing is cut out.
        length: of a piece [s].
        step: of the model [s].
        reach: time before and after a piece in which torques are to be known [s].
        most: pieces.

    Raises:
        IdentificationError: too little remains, or the pieces are too short.
    """
    steps = round(length / step)
    length = steps * step
    if not length > (LEAST - 0.5) * recording.period:
        raise IdentificationError(
            f"{recording.source}: pieces of {length:g} s are too short for samples every {recording.period:g} s; give "
            f"at least {LEAST * recording.period:g} s"
        )
    try:
        splines = [Spline.through(t, q, KNOTS) for t, q in zip(recording.t.T, recording.q.T, strict=True)]
    except IdentificationError as error:
        raise IdentificationError(f"{recording.source}: {error}") from error
    first = max(recording.since[0].max() + reach, *(spline.t[0] for spline in splines))
    last = min(recording.end - reach, *(spline.t[-1] for spline in splines))
    start = first + length * np.arange(max(int((last - first) / length), 0))
    start = start[_known(recording, start - reach, start + length + reach) & _sampled(splines, start, length)]
    if len(start) < FEWEST:
        raise IdentificationError(
            f"{recording.source}: {len(start)} pieces of {length:g} s have positions and torques throughout; at least "
            f"{FEWEST} are needed"
        )
    start = start[np.unique(np.linspace(0, len(start) - 1, min(most, len(start))).round().astype(int))]
    state = np.stack([spline.at(start, order) for order in (0, 1) for spline in splines], axis=1)
    held = tuple(_impulse(recording, j) for j in range(recording.n))
    return Pieces(start, step, steps, state, *_samples(recording, start, step, steps), held)


def _known(recording: Recording, since: Array, until: Array) -> NDArray[np.bool_]:
    """Whether all torques are known between instants (S,) [s]."""
    known = np.ones(len(since), bool)
    for start, tau in zip(recording.since.T, recording.tau.T, strict=True):
        count = np.concatenate([[0], np.cumsum(np.isnan(tau))])
        held = np.searchsorted(start, since, side="right") - 1
        known &= count[np.searchsorted(start, until)] == count[np.maximum(held, 0)]
    return known


def _sampled(splines: list[Spline], start: Array, length: float) -> NDArray[np.bool_]:
    """Whether no joint's samples are missing for long in pieces that begin at instants (S,)."""
    good = np.ones(len(start), bool)
    for spline in splines:
        gaps = np.diff(spline.t)
        for g in np.flatnonzero(gaps > max(KNOTS, 4.5 * float(np.median(gaps)))):
            good &= (spline.t[g + 1] <= start) | (spline.t[g] >= start + length)
    return good


def _impulse(recording: Recording, joint: int) -> tuple[Array, Array]:
    edges = np.append(recording.since[:, joint], recording.end)
    impulse = np.cumsum(np.nan_to_num(recording.tau[:, joint]) * np.diff(edges))
    return edges, np.concatenate([[0.0], impulse])


def _samples(recording: Recording, start: Array, step: float, steps: int) -> tuple[Any, Any, Any]:
    """What `Pieces` says of the samples."""
    ranges = np.stack([np.searchsorted(t, [start, start + steps * step]) for t in recording.t.T], axis=-1)  # (2, S, n)
    rows = ranges[0][:, None] + np.arange((ranges[1] - ranges[0]).max())[:, None]
    inside = rows < ranges[1][:, None]
    rows, joints = np.minimum(rows, len(recording.t) - 1), np.arange(recording.n)
    q = recording.q[rows, joints]
    there = inside & np.isfinite(q)
    place = np.where(there, (recording.t[rows, joints] - start[:, None, None]) / step, 0.0)
    k = np.minimum(place.astype(int), steps - 1)
    return np.where(there, q, 0.0), there, (k, place - k)
