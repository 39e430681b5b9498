"""The search for the coefficients of an exciting series: SLSQP with exact slopes, limits as smooth maxima over time.

A motion is linear in its coefficients, leads included, so one basis serves all joints.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np

from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.excitation.clearance import Clearance, Near
from lwa4d_sim.excitation.information import Information
from lwa4d_sim.excitation.limits import Limits
from lwa4d_sim.fourier import fourier_series, led
from lwa4d_sim.interfaces import Array

PER_HARMONIC = 20  # samples in a period of the highest harmonic; derived: between two, a peak rises by 1.2 % at most
LEAD_SAMPLES = 40  # samples in each lead (assumed)
SHARPNESS = 100.0  # of the smooth maximum; derived: with ten samples near a peak it is 2.3 % too large, never too small
NEAR = 0.1  # [m] in which a clearance counts as 1; pairs further apart than this and the clearance are not looked at
DRAWS = 50  # random motions tried
SHRINK = 0.8  # of a random motion that breaks a limit, until it keeps them
GENTLE = 0.1  # of the log det per parameter is what SLSQP sees: its first steps are then short enough to keep limits
ENOUGH = 1e-5  # gain in log det per parameter at which the search ends (assumed): 0.0005 % in a standard error
SLACK = 1e-4  # of a limit (assumed): what a motion may lack to be kept as one that holds the smooth limits
BACK = tuple(0.05 * k for k in range(19, 0, -1))  # of a cut-off search's last step, tried in case it breaks limits
LEAST = 0.1  # of a random motion that must remain, so that it still excites


class Sampling(Protocol):
    """How the motion is laid out in time; see `ExcitationWish`."""

    @property
    def harmonics(self) -> int: ...
    @property
    def period(self) -> float: ...
    @property
    def lead_in(self) -> float: ...
    @property
    def lead_out(self) -> float: ...


class Improved(NamedTuple):
    """What a search has found: coefficients (n, 2 N + 1), iterations used, and whether it came to its end."""

    x: Array
    used: int
    done: bool


class _Peak(NamedTuple):
    """Smooth maxima over K values: ``value`` (m,) and the derivatives ``share`` (K, m), which add up to 1."""

    value: Array
    share: Array


class _State(NamedTuple):
    """What is known at one point of the search; arrays over samples (T, n)."""

    z: Array
    q: Array
    dq: Array
    ddq: Array
    Y: Array
    near: Near
    value: float
    peaks: tuple[_Peak, ...]
    room: Array


class Search:
    """The search.

    Args:
        information: of the arm.
        clearance: of the arm.
        limits: of the arm.
        start: posture that the motion starts from (n,) [rad].
        sampling: harmonics and times.
        omega: base frequency [rad/s].
    """

    def __init__(
        self,
        information: Information,
        clearance: Clearance,
        limits: Limits,
        start: Array,
        sampling: Sampling,
        omega: float,
    ) -> None:
        self._information, self._clearance, self._limits, self._start = information, clearance, limits, start
        self._n, N = len(start), sampling.harmonics
        t_in, period, t_out = sampling.lead_in, sampling.period, sampling.lead_out
        self._counted = PER_HARMONIC * N
        series = t_in + period * np.arange(self._counted) / self._counted
        leads = np.linspace(0.0, t_in, LEAD_SAMPLES), t_in + period + np.linspace(0.0, t_out, LEAD_SAMPLES)
        self._basis, self._rest = _basis(N, omega, t_in, period, t_out, np.concatenate([series, *leads]))
        speed = limits.speed[:, None]
        self._unit = np.hstack([np.ones_like(speed), np.repeat(speed, 2 * N, axis=1)])  # (n, 2 N + 1)
        self._lead_in = t_in
        self._stops = np.flatnonzero(np.isfinite(limits.lower) & np.isfinite(limits.upper))
        self._driven = np.flatnonzero(np.isfinite(limits.torque))
        # |a| <= 4 / pi times the top speed (derived: a square wave's coefficient); an offset lies between the stops, or
        # no further from the start than top speed takes it
        far = limits.speed * (t_in + period)
        low = np.hstack([np.maximum(limits.lower, start - far)[:, None], np.full((self._n, 2 * N), -4.0 / np.pi)])
        high = np.hstack([np.minimum(limits.upper, start + far)[:, None], np.full((self._n, 2 * N), 4.0 / np.pi)])
        self._bounds = np.column_stack([low.ravel(), high.ravel()])
        self._tight = 0.0
        self._best: tuple[float, Array] = -np.inf, np.zeros(0)
        self._known: _State | None = None
        self._sloped: tuple[Array, Array, Array] | None = None

    def random_start(self, rng: np.random.Generator) -> Array:
        """Coefficients (n, 2 N + 1) of a random motion that keeps the limits.

        Raises:
            IdentificationError: none was found.
        """
        limits, N = self._limits, (self._basis.shape[2] - 1) // 2
        reach = 0.4 * limits.speed * self._lead_in  # a quintic to 0.53 of speed times time has that top speed (derived)
        low, high = np.maximum(limits.lower, self._start - reach), np.minimum(limits.upper, self._start + reach)
        k = np.tile(np.arange(1, N + 1), 2)
        for _ in range(DRAWS):
            offset = rng.uniform(low, high)
            wave = rng.normal(size=(self._n, 2 * N)) / np.sqrt(k) * limits.speed[:, None] / 2.0
            share = 1.0
            while share > LEAST:
                x = np.column_stack([offset, share * wave])
                if self._at((x / self._unit).ravel()).room.min() >= 0.0:
                    return x
                share *= SHRINK
        raise IdentificationError(
            f"none of {DRAWS} random motions keeps all limits; choose a start in the open (initial.q), a longer "
            "lead-in or period, or smaller margins"
        )

    def improve(self, x: Array, iterations: int, tight: float, progress: Callable[[], None]) -> Improved:
        """Better coefficients than ``x`` (n, 2 N + 1): the best seen that keep the limits, else ``x``.

        Args:
            x: where to start.
            iterations: at most.
            tight: share of each limit that is not to be used.
            progress: called after each iteration.
        """
        from scipy.optimize import minimize

        self._tight, self._known, self._sloped = tight, None, None
        size = len(self._information.base) / GENTLE
        best, used, done = (x / self._unit).ravel(), 0, False
        self._best = -np.inf, best
        keep = {"type": "ineq", "fun": lambda z: self._at(z).room, "jac": lambda z: self._slopes(z)[1]}
        search: Any = minimize  # whose stubs know no dictionaries
        while used < iterations:
            found = search(
                lambda z: -self._at(z).value / size,
                best,
                jac=lambda z: -self._slopes(z)[0] / size,
                method="SLSQP",
                bounds=self._bounds,
                constraints=keep,
                callback=lambda _: progress(),
                options={"maxiter": iterations - used, "ftol": GENTLE * ENOUGH},
            )
            used += max(1, int(found.nit))
            done = bool(found.success)
            for share in () if done else BACK:
                self._at(best + share * (found.x - best))  # which keeps what is better
            moved = not np.array_equal(best, self._best[1])
            best = self._best[1]
            if done or not moved:
                break
        return Improved(best.reshape(self._n, -1) * self._unit, used, done)

    def _at(self, z: Array) -> _State:
        """Value and room at the scaled coefficients ``z``; the last answer is kept, for it is asked for four times."""
        if self._known is not None and np.array_equal(z, self._known.z):
            return self._known
        x = z.reshape(self._n, -1) * self._unit
        q, dq, ddq = np.einsum("dtk,nk->dtn", self._basis, x) + self._rest[..., None] * self._start
        Y = self._information.columns(q, dq, ddq)
        near = self._clearance.near(q, self._limits.clearance + NEAR)
        peaks = self._peaks(q, dq, self._information.torque(Y), near)
        room = 1.0 - self._tight - np.concatenate([peak.value for peak in peaks])
        value = self._information.of(Y[: self._counted])
        self._known = _State(z.copy(), q, dq, ddq, Y, near, value, peaks, room)
        if room.min() >= -SLACK and value > self._best[0]:
            self._best = value, self._known.z
        return self._known

    def _peaks(self, q: Array, dq: Array, tau: Array, near: Near) -> tuple[_Peak, ...]:
        """Largest values over time, 1 at the limit: upper and lower stops, speeds, torques, distances."""
        limits, stops, driven = self._limits, self._stops, self._driven
        close = 1.0 + (limits.clearance - near.distance) / NEAR
        return (
            _peak(1.0 + q[:, stops] - limits.upper[stops]),
            _peak(1.0 + limits.lower[stops] - q[:, stops]),
            _peak(np.concatenate([dq, -dq]) / limits.speed),
            _peak(np.concatenate([tau, -tau])[:, driven] / limits.torque[driven]),
            _peak(close[:, None]) if len(close) else _Peak(np.zeros(1), np.zeros((0, 1))),
        )

    def _slopes(self, z: Array) -> tuple[Array, Array]:
        """Derivatives of value (Z,) and room (C, Z) at the scaled coefficients ``z`` (Z,)."""
        if self._sloped is None or not np.array_equal(z, self._sloped[0]):
            at = self._at(z)
            slopes = self._information.slopes(at.q, at.dq, at.ddq, at.Y, self._counted)
            rates = self._rates(at, slopes.torque)  # (3, T, C, n)
            value = np.einsum("dtk,dtn->nk", self._basis, slopes.log_det) * self._unit
            room = -np.tensordot(rates, self._basis, axes=((0, 1), (0, 1))) * self._unit
            self._sloped = z.copy(), value.ravel(), room.reshape(len(room), -1)
        return self._sloped[1:]

    def _rates(self, at: _State, torque: Array) -> Array:
        """Derivatives (3, T, C, n) of the peaks with respect to position, speed and acceleration at each sample."""
        T, n = at.q.shape
        upper, lower, speed, load, close = at.peaks
        stops, driven = self._stops, self._driven
        ends = np.cumsum([0, len(stops), len(stops), n, len(driven)])
        out = np.zeros((3, T, ends[-1] + 1, n))
        out[0][:, ends[0] + np.arange(len(stops)), stops] = upper.share
        out[0][:, ends[1] + np.arange(len(stops)), stops] = -lower.share
        out[1][:, ends[2] + np.arange(n), np.arange(n)] = (speed.share[:T] - speed.share[T:]) / self._limits.speed
        share = (load.share[:T] - load.share[T:]) / self._limits.torque[driven]
        out[:, :, ends[3] : ends[4]] = share[..., None] * torque[:, :, driven]
        np.add.at(out[0][:, -1], at.near.sample, -close.share / NEAR * at.near.slope)
        return out


def _peak(values: Array) -> _Peak:
    """Smooth maxima of ``values`` (K, m) over K, never below the true ones (Kreisselmeier and Steinhauser 1979)."""
    top = values.max(axis=0)
    grown = np.exp(SHARPNESS * (values - top))
    total = grown.sum(axis=0)
    return _Peak(top + np.log(total) / SHARPNESS, grown / total)


def _basis(N: int, omega: float, lead_in: float, period: float, lead_out: float, t: Array) -> tuple[Array, Array]:
    """What a unit of each coefficient adds to position, speed, acceleration, (3, T, 2 N + 1), and the start (3, T).

    It is the running curve itself, of joints that have one coefficient each.
    """
    m = 2 * N + 1
    a, b, offset, q0 = np.zeros((m + 1, N)), np.zeros((m + 1, N)), np.zeros(m + 1), np.zeros(m + 1)
    offset[0] = q0[m] = 1.0
    a[1 : N + 1], b[N + 1 : m] = np.eye(N), np.eye(N)
    _, curve = led(fourier_series(a, b, offset, omega), q0, lead_in, period, lead_out)
    rates = np.stack(curve(t))
    return rates[..., :m], rates[..., m]
