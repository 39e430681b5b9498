"""How fast a stable loop follows: bandwidth and resonance of the joint angles over their references."""

from typing import Any, NamedTuple

import numpy as np

from lwa4d_sim.interfaces import Array
from lwa4d_sim.stability.loops import Continuous, Loop

# Frequencies looked at [Hz] (assumed: an arm that follows less than 1 mHz follows nothing, none follows 200 Hz).
_SLOWEST, _FASTEST, _COUNT = 1e-3, 200.0, 80
_DROP = 1.0 / np.sqrt(2.0)  # -3 dB, the usual bandwidth


class Tracking(NamedTuple):
    """Of each loop (P,).

    Attributes:
        bandwidth: frequency up to which every joint follows its own reference within 3 dB [Hz].
        peak: largest amplification of a joint's own reference at any frequency.
    """

    bandwidth: Array
    peak: Array


def tracking(loop: Loop | Continuous, gains: Array) -> Tracking:
    """Bandwidth and peak of each q over its own q_ref, from the loop's frequency response.

    A reference q_ref adds ``-gains q_ref`` to the command where q adds ``gains q``: both laws act on the difference,
    and so near an operating point do those in task space.

    Args:
        loop: P loops, stable ones.
        gains: slope of the torque over q that the gains alone make (P, n, n).
    """
    n, m = loop.n, loop.U0.shape[2]
    frequency = np.geomspace(_SLOWEST, min(_FASTEST, 0.5 / loop.period), _COUNT)
    z = np.exp(2j * np.pi * frequency * loop.period)[:, None, None]
    bandwidth, peak = np.empty(len(loop.U0)), np.empty(len(loop.U0))
    for i in range(len(loop.U0)):
        push: Any = _push(loop, i)
        U = loop.U0[i] + loop.U1[i]
        matrix = loop.at_gain(np.ones(len(loop.U0)))[i] if isinstance(loop, Continuous) else loop.F[i] + push @ U
        right = np.broadcast_to(push @ -gains[i], (len(z), m, n))
        response = np.linalg.solve(z * np.eye(m) - matrix, right)[:, :n]
        own = np.abs(np.diagonal(response, axis1=1, axis2=2))
        slowest = own.min(axis=1)
        below = np.flatnonzero(slowest < _DROP)
        k = int(below[0]) if below.size else len(frequency) - 1
        bandwidth[i], peak[i] = _between(frequency, slowest, k), own.max()
    return Tracking(bandwidth, peak)


def _push(loop: Loop | Continuous, i: int) -> Array:
    """What a command held for a period adds to the state (m, n)."""
    if isinstance(loop, Loop):
        push: Array = loop.G[i]
        return push
    from scipy.linalg import expm

    m, n = loop.B[i].shape
    A = loop.A[i] + loop.B[i] @ (loop.U0[i] + loop.U1[i])
    joined = np.zeros((m + n, m + n))
    joined[:m, :m], joined[:m, m:] = A, loop.B[i]
    held: Array = expm(joined * loop.period)[:m, m:]
    return held


def _between(frequency: Array, value: Array, k: int) -> float:
    """Frequency at which ``value`` falls through the drop between samples k - 1 and k."""
    if k == 0 or value[k] >= _DROP:
        return float(frequency[k])
    share = (value[k - 1] - _DROP) / (value[k - 1] - value[k])
    return float(frequency[k - 1] * (frequency[k] / frequency[k - 1]) ** share)
