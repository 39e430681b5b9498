"""From a recording to linear equations Y x = b, by the momentum form seen through test functions.

Momentum changes by what acts: d/dt (M dq) = tau - friction + dL/dq. Weighted with a smooth bump phi and integrated by
parts, acceleration drops out,

    - int phi' M dq dt - int phi dL/dq dt + int phi friction dt = int phi tau dt,

and a torque that is held between instants enters exactly (weak form, modulating functions: Shinbrot 1957). Each side is
the signal after one and the same zero-phase filter, with the bump as its impulse response.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.identification.friction import Friction
from lwa4d_sim.identification.parameters import Unknowns
from lwa4d_sim.identification.regressor import Regressor
from lwa4d_sim.identification.smooth import Spline
from lwa4d_sim.interfaces import Array
from lwa4d_sim.recordings.recording import Recording

# The bump is a cubic B-spline whose knots are WIDTH / bandwidth apart: its spectrum sinc(f width)^4 has fallen by 3 dB
# at the bandwidth (derived: sinc(0.2276)^4 = 1 / sqrt(2)).
WIDTH = 0.2276
CELLS = 8  # of a knot interval, over which integrals are sums; the sum's own error is then below 1e-5 (derived: sinc^4)
KNOT_RATE = 8.0  # knots of the motion's splines per second and hertz of bandwidth: they pass four times the bandwidth
RIPPLE = 4  # knot intervals on either side of a gap in which the spline still feels it (measured: below 1e-4 then)
SURELY = 2.0  # assumed: shares of Coulomb friction from which on a joint slides for sure, wrong as its softness may be
FEWEST = 10  # windows that data must fill (assumed)


@dataclass(frozen=True)
class Motion:
    """Splines of the joints, on a grid of cell midpoints (T,) [s], each (T, n)."""

    splines: tuple[Spline, ...]
    t: Array
    q: Array
    dq: Array
    ddq: Array


@dataclass(frozen=True)
class Equations:
    """W windows, n rows each.

    Attributes:
        unknowns: of the arm.
        t: middle of each window (W,) [s].
        Y: (W, n, P).
        b: filtered torque (W, n) [N m].
        gravity: the part of Y that gravity makes (W, n, P), or None where it was not asked for.
        motion: the joints.
        F, dF: what takes the integral of phi and of phi' over a signal on the grid (W, T).
        A: the same of phi over each joint's torque samples (W, K).
        noise: standard deviation of each joint's position samples (n,) [rad].
        sliding: rows (W, n) in which the joint slides from end to end, so that Coulomb friction is a constant.
    """

    unknowns: Unknowns
    t: Array
    Y: Array
    b: Array
    gravity: Array | None
    motion: Motion
    F: Any
    dF: Any
    A: tuple[Any, ...]
    noise: Array
    sliding: NDArray[np.bool_]

    @property
    def rows(self) -> int:
        """Number of equations."""
        return self.b.size


def equations(
    recording: Recording,
    unknowns: Unknowns,
    bandwidth: float,
    friction: Friction,
    coulomb: Array,
    *,
    gravity: bool = False,
) -> Equations:
    """The equations of a recording.

    Args:
        recording: of as many joints as the arm has.
        unknowns: of the arm.
        bandwidth: of the filter, -3 dB [Hz].
        friction: law of Coulomb friction.
        coulomb: about its size (n,) [N m], which says how slowly a joint may slide.
        gravity: whether gravity's part of the regressor is wanted by itself.

    Raises:
        IdentificationError: the recording is too short, has too many gaps, or another number of joints.
    """
    if recording.n != unknowns.n:
        raise IdentificationError(f"{recording.source}: has {recording.n} joints, the arm has {unknowns.n}")
    width = WIDTH / bandwidth
    splines: list[Spline] = []
    for t, q in zip(recording.t.T, recording.q.T, strict=True):
        splines.append(Spline.through(t, q, 1.0 / (KNOT_RATE * bandwidth), splines[-1] if splines else None))
    if any(spline.noise is None for spline in splines):
        highest = 1.0 / (1.5 * KNOT_RATE * recording.period)
        raise IdentificationError(
            f"{recording.source}: samples every {recording.period:.4g} s are too few for a bandwidth of "
            f"{bandwidth:g} Hz; at most {highest:.3g} Hz is possible",
            "identify.bandwidth",
        )
    start = max(recording.since[0].max(), *(spline.t[0] for spline in splines)) + width
    end = min(recording.end, *(spline.t[-1] for spline in splines)) - width
    count = int((end - start) / width) - 3  # a bump is four intervals wide
    if count < FEWEST:
        need = (FEWEST + 6) * width
        raise IdentificationError(
            f"{recording.source}: {max(end - start, 0.0) + 2 * width:.3g} s of motion are too short for a bandwidth of "
            f"{bandwidth:g} Hz; at least {need:.3g} s are needed"
        )
    cell = width / CELLS
    grid = start + cell * (np.arange((count + 3) * CELLS) + 0.5)
    middles = start + width * (np.arange(count) + 2.0)
    F, dF = (_window_matrix(middles, grid, width, order) * cell for order in (0, 1))
    A: tuple[Any, ...] = ()
    for j in range(unknowns.n):
        same = j > 0 and np.array_equal(recording.since[:, j], recording.since[:, j - 1])
        A = (*A, A[-1] if same else _torque_matrix(recording, j, middles, width))
    kept = _complete(recording, splines, A, F, grid, width)
    if kept.sum() < FEWEST:
        raise IdentificationError(
            f"{recording.source}: gaps leave {int(kept.sum())} of {count} windows; at least {FEWEST} are needed"
        )
    F, dF, A = F[kept], dF[kept], tuple(a[kept] for a in A)
    motion = Motion(tuple(splines), grid, *(np.stack([s.at(grid, k) for s in splines], axis=1) for k in range(3)))
    tau = np.nan_to_num(recording.tau)
    b = np.stack([a @ tau[:, j] for j, a in enumerate(A)], axis=1)
    direction = friction.direction(motion.dq, motion.ddq, coulomb)
    Y = _matrix(unknowns, motion, F, dF, b, direction)
    weight = _weight(unknowns, motion, F) if gravity else None
    sliding = F @ (np.abs(friction.effort(motion.dq, motion.ddq, coulomb)) < SURELY) < 1e-9
    step = recording.position_step / np.sqrt(12.0)
    noise = np.array([max(spline.noise or 0.0, step[j]) for j, spline in enumerate(splines)])
    return Equations(unknowns, middles[kept], Y, b, weight, motion, F, dF, A, noise, sliding)


def _matrix(unknowns: Unknowns, motion: Motion, F: Any, dF: Any, b: Array, direction: Array) -> Array:
    """Y (W, n, P)."""
    n, W = unknowns.n, F.shape[0]
    Y = np.zeros((W, n, len(unknowns.names)))
    p, l = Regressor(unknowns.chain, unknowns.gravity).momentum(motion.q, motion.dq)
    inertial = -(dF @ p.reshape(len(p), -1)) - F @ l.reshape(len(l), -1)
    Y[..., : 10 * n] = inertial.reshape(W, n, 10 * n)
    own: dict[str, Callable[[], Any]] = {
        "viscous": lambda: F @ motion.dq,
        "coulomb": lambda: F @ direction,
        "offset": lambda: np.ones((W, n)),
        "armature": lambda: -(dF @ motion.dq),
        "gain": lambda: -b,
    }
    for kind in unknowns.kinds:
        Y[:, np.arange(n), unknowns.columns(kind)] = own[kind]()
    return Y


def _weight(unknowns: Unknowns, motion: Motion, F: Any) -> Array:
    """Gravity's part of Y."""
    still = Regressor(unknowns.chain, unknowns.gravity).momentum(motion.q, np.zeros_like(motion.dq))[1]
    part = np.zeros((F.shape[0], unknowns.n, len(unknowns.names)))
    part[..., : 10 * unknowns.n] = -(F @ still.reshape(len(still), -1)).reshape(F.shape[0], unknowns.n, -1)
    return part


@cache
def bump(order: int) -> Any:
    """The cubic B-spline on -2..2 with integral 1 (order 0), its derivative (1) or antiderivative (-1)."""
    from scipy.interpolate import BSpline

    spline: Any = BSpline
    phi = spline.basis_element(np.arange(-2.0, 3.0), extrapolate=False)
    if order == 0:
        return phi
    return phi.derivative() if order == 1 else phi.antiderivative()


def _window_matrix(middles: Array, t: Array, width: float, order: int) -> Any:
    """Values of every window's bump, or of its derivative, at instants (T,): sparse (W, T)."""
    from scipy.sparse import csr_array

    first = np.searchsorted(t, middles - 2.0 * width)
    span = 4 * CELLS
    columns = first[:, None] + np.arange(span)
    x = (t[np.minimum(columns, len(t) - 1)] - middles[:, None]) / width
    values = np.nan_to_num(bump(order)(x)) / width ** (1 + order)
    pointers = np.arange(len(middles) + 1) * span
    return csr_array((values.ravel(), columns.ravel(), pointers), shape=(len(middles), len(t)))


def _torque_matrix(recording: Recording, joint: int, middles: Array, width: float) -> Any:
    """What a window's integral takes of each held torque of one joint: sparse (W, K)."""
    from scipy.sparse import coo_array

    edges = np.append(recording.since[:, joint], recording.end)
    x = (edges[None] - middles[0]) / width  # in windows from the first middle
    low, high = x[0, :-1], x[0, 1:]
    first = np.maximum(np.ceil(low - 2.0), 0).astype(int)
    last = np.minimum(np.floor(high + 2.0), len(middles) - 1).astype(int)
    rows, columns, values = [], [], []
    for offset in range(int(max((last - first).max(), -1)) + 1):
        w = first + offset
        held = np.flatnonzero(w <= last)
        inside = [np.clip(edge[held] - w[held], -2.0, 2.0) for edge in (low, high)]
        rows.append(w[held])
        columns.append(held)
        values.append(bump(-1)(inside[1]) - bump(-1)(inside[0]))
    if not rows:
        raise IdentificationError(f"{recording.source}: no torque acts while the joints move")
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return coo_array(entries, shape=(len(middles), len(low))).tocsr()


def _complete(
    recording: Recording, splines: Sequence[Spline], A: tuple[Any, ...], F: Any, grid: Array, width: float
) -> NDArray[np.bool_]:
    """Windows (W,) in which no torque is unknown and no position is missing for longer than half a knot interval."""
    kept = np.ones(F.shape[0], bool)
    margin = RIPPLE * width / (WIDTH * KNOT_RATE)
    for j, (spline, a) in enumerate(zip(splines, A, strict=True)):
        kept &= (abs(a) @ np.isnan(recording.tau[:, j])) == 0
        gaps = np.diff(spline.t)
        wide = gaps > max(0.5 * width, 2.5 * float(np.median(gaps)))
        begins, ends = spline.t[:-1][wide] - margin, spline.t[1:][wide] + margin
        inside = np.searchsorted(begins, grid, "right") > np.searchsorted(ends, grid, "left")
        kept &= (F @ inside) == 0
    return kept
