"""The exact sampled-data loop: arm, hold, delays, estimator and law as one matrix from tick to tick."""

from typing import NamedTuple

import numpy as np

from lwa4d_sim.interfaces import Array, IntArray
from lwa4d_sim.stability.assist import Assist, Forecast
from lwa4d_sim.stability.filters import Filter
from lwa4d_sim.stability.linear import Linear
from lwa4d_sim.stability.loops import Loop

_HUGE = 1e100  # growth within a period beyond which products overflow (derived)


class Instants(NamedTuple):
    """When things happen in a period, joint by joint.

    Attributes:
        period: control period T [s].
        old: number of whole periods by which the samples are old that the controller uses, (n,).
        acts: from the sample tick to the instant at which the torque computed for it acts [s], (n,).
    """

    period: float
    old: IntArray
    acts: Array


class _Rows:
    """Places of the parts of X, and rows that read them."""

    def __init__(self, points: int, **sizes: int) -> None:
        self._points, ends = points, np.cumsum([0, *sizes.values()]).tolist()
        self.size = ends[-1]
        self._at = {name: slice(ends[i], ends[i + 1]) for i, name in enumerate(sizes)}

    def __getitem__(self, part: str) -> slice:
        return self._at[part]

    def zero(self, count: int) -> Array:
        """Rows that read nothing, (P, count, m)."""
        return np.zeros((self._points, count, self.size))

    def read(self, part: str, which: slice | None = None) -> Array:
        """Rows that read a part of X, or a piece of it."""
        columns = np.arange(self.size)[self._at[part]]
        columns = columns if which is None else columns[which]
        rows = self.zero(len(columns))
        rows[:, np.arange(len(columns)), columns] = 1.0
        return rows


def close(linear: Linear, estimator: Filter, instants: Instants, assist: Assist | None = None) -> Loop:
    """Close the loop.

    Between two ticks the arm moves under torques that change at most once a joint, so the step is exact: with e^(At)
    and its integral over the parts before and after the change (Åström and Wittenmark, Computer-Controlled Systems,
    section 3.2).

    Args:
        linear: arm and law.
        estimator: of each joint's speed; not used where ``assist`` has a state observer.
        instants: when samples are taken and torques act.
        assist: predictor and observers.

    Raises:
        OverflowError: the arm falls so far within a period that no number can say it.
    """
    n, T = linear.n, instants.period
    whole = np.floor(instants.acts / T + 1e-9).astype(np.int64)
    part = np.maximum(0.0, instants.acts - whole * T)
    A, B, H = continuous_part(linear, estimator.time_constant)
    P, size = A.shape[0], A.shape[1]
    step, late, soon = _discrete(A, B, T, part)
    old, waiting = int(instants.old.max()), int((whole + (part > 0)).max())
    forecast = None if assist is None else Forecast(linear.A_model, linear.B_model, assist.acts, T)
    newest = float(instants.old.min())  # periods since the newest sample was taken
    if forecast is not None:
        waiting = max(waiting, forecast.ages(-(newest + 1.0) * T))
    observed = assist is not None and assist.gain is not None
    X = _Rows(
        P,
        arm=size,
        estimate=2 * n if observed else estimator.A.shape[0] * n,
        samples=2 * n * old,
        disturbance=3 * n if assist is not None and assist.bandwidth is not None else 0,
        commands=n * waiting,
    )
    F, G = X.zero(X.size), np.zeros((P, X.size, n))

    # arm and drives' filters under the commands that were under way
    F[:, X["arm"], X["arm"]] = step
    for j in range(n):
        for age, column in ((int(whole[j]), late[:, :, j]), (int(whole[j]) + 1, soon[:, :, j])):
            if age == 0:
                G[:, X["arm"], j] += column
            elif column.any():
                F[:, X["arm"], X["commands"].start + n * (age - 1) + j] += column

    # samples y = (q, v), as the controller gets them
    now = X.zero(2 * n)
    now[:, :, X["arm"]] = H
    seen = now.copy()
    for j in np.flatnonzero(instants.old).tolist():
        for row in (j, n + j):
            seen[:, row] = X.read("samples", slice(2 * n * (instants.old[j] - 1) + row, None))[:, 0]
    if old:
        F[:, X["samples"]] = np.concatenate([now, X.read("samples")[:, : 2 * n * (old - 1)]], axis=1)
    if waiting:
        F[:, X["commands"]][:, n:] = X.read("commands")[:, : n * (waiting - 1)]
        G[:, X["commands"]][:, :n] = np.eye(n)

    rest = X.zero(n)
    if assist is None or forecast is None:
        given = _filtered(X, F, estimator, seen, n)
    else:
        behind = (instants.old - newest) * T
        given, rest = _assisted(X, F, linear, estimator, assist, forecast, seen, newest * T, behind)
    U0 = linear.bare @ given + rest
    return Loop(F, G, U0, linear.law @ given + rest - U0, T, given, rest, linear.curve)


def _filtered(X: _Rows, F: Array, estimator: Filter, seen: Array, n: int) -> Array:
    """Rows of the estimated q and dq (P, 2n, m); the estimator's own step goes into ``F``."""
    unit = np.eye(n)
    own = X.read("estimate")
    F[:, X["estimate"]] = np.kron(estimator.A, unit) @ own + np.kron(estimator.B, unit) @ seen
    rows: Array = np.kron(estimator.C, unit) @ own + np.kron(estimator.D, unit) @ seen
    return rows


def _assisted(
    X: _Rows,
    F: Array,
    linear: Linear,
    estimator: Filter,
    assist: Assist,
    forecast: Forecast,
    seen: Array,
    age: float,
    behind: Array,
) -> tuple[Array, Array]:
    """Rows of the state that the law is given, and of what is added to its torque, with observers and predictor.

    Args:
        X: the state's places.
        F: the loop's matrix, into which the blocks' own steps go.
        linear: arm and law.
        estimator: of each joint's speed.
        assist: the blocks.
        forecast: the nominal arm under the commands.
        seen: rows of the samples.
        age: of the newest sample [s].
        behind: how much older each joint's sample is than the newest [s], (n,).
    """
    n, T = linear.n, forecast.period
    commands = X.read("commands")
    known = X.read("disturbance", slice(0, n)) if assist.bandwidth is not None else X.zero(n)

    def ahead(state: Array, disturbance: Array, start: float, end: float) -> Array:
        rows = forecast.step(end - start) @ state + forecast.constant(end - start) @ disturbance
        for i, weight in enumerate(forecast.commands(start, end)):
            rows = rows + weight @ commands[:, n * i : n * (i + 1)]
        return rows

    if assist.gain is not None:
        state = ahead(X.read("estimate"), known, -age - T, -age)
        innovation = seen[:, :n] + behind[:, None] * state[:, n:] - state[:, :n]
        state = state + np.concatenate([assist.gain[0] * innovation, assist.gain[1] * innovation], axis=1)
        F[:, X["estimate"]] = state
        given = state
    else:
        given = _filtered(X, F, estimator, seen, n)
        state = given.copy()
        state[:, :n] += behind[:, None] * given[:, n:]  # all joints at the instant of the newest sample
    if assist.bandwidth is not None:
        before = X.read("disturbance", slice(n, 3 * n))
        M = np.linalg.inv(linear.B_model[:, n:])
        slope = -M @ linear.A_model[:, n:]  # of the bias torque
        missing = M @ (state[:, n:] - before[:, n:]) / T + slope @ (0.5 * (state + before))
        for i, share in enumerate(forecast.shares(-age - T, -age)):
            missing = missing - share[:, None] * commands[:, n * i : n * (i + 1)]
        known = known - np.expm1(-assist.bandwidth * T) * (missing - known)
        F[:, X["disturbance"]] = np.concatenate([known, state], axis=1)
    if assist.horizon is not None:
        given = ahead(state, known, -age, max(-age, assist.due + assist.horizon))
    return given, -known


def continuous_part(linear: Linear, T: float) -> tuple[Array, Array, Array]:
    """dξ/dt = A ξ + B tau of arm and drives' filters, and the measurement y = H ξ, y = (q, v)."""
    n, P = linear.n, len(linear.A)
    unit = np.eye(n)
    if not T:
        return linear.A, linear.B, np.broadcast_to(np.eye(2 * n), (P, 2 * n, 2 * n))
    # y1 = q / (1 + T s), y2 = y1 / (1 + T s), v = (y1 - y2) / T
    A = np.zeros((P, 4 * n, 4 * n))
    A[:, : 2 * n, : 2 * n] = linear.A
    A[:, 2 * n : 3 * n, :n], A[:, 2 * n : 3 * n, 2 * n : 3 * n] = unit / T, -unit / T
    A[:, 3 * n :, 2 * n : 3 * n], A[:, 3 * n :, 3 * n :] = unit / T, -unit / T
    B = np.concatenate([linear.B, np.zeros((P, 2 * n, n))], axis=1)
    H = np.zeros((P, 2 * n, 4 * n))
    H[:, :n, :n] = unit
    H[:, n:, 2 * n : 3 * n], H[:, n:, 3 * n :] = unit / T, -unit / T
    return A, B, H


def _discrete(A: Array, B: Array, T: float, part: Array) -> tuple[Array, Array, Array]:
    """e^(AT) (P, s, s), and what a unit command of each joint does after and before its change in the period (P, s, n).

    The command that begins to act at ``part`` (n,) [s] does the integral of e^(As) B over [0, T - part]; the one before
    it the rest of the integral up to T.
    """
    from scipy.linalg import expm

    s, n = B.shape[1:]
    joined = np.zeros((len(A), s + n, s + n))
    joined[:, :s, :s], joined[:, :s, s:] = A, B
    with np.errstate(over="ignore", invalid="ignore"):
        whole = expm(joined * T)
    if not (np.abs(whole) < _HUGE).all():
        raise OverflowError(f"disturbances of the arm grow beyond all numbers within {T:g} s")
    step, full = whole[:, :s, :s], whole[:, :s, s:]
    late = full.copy()
    for a in np.unique(part[part > 0]).tolist():
        columns = np.flatnonzero(part == a)
        late[:, :, columns] = expm(joined * (T - a))[:, :s, s + columns]
    return step, late, full - late
