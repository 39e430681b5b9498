"""The sampled loop: two sides that meet only at a link, and the order of events in one control period.

Tick k, at t = k T: the drives latch and send; `phase` later the controller takes the newest measurement that has
arrived, computes and sends; the plant goes on under the newest command that acts. See docs/timing.md.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from lwa4d_sim.interfaces import (
    ArmModel,
    Array,
    Arrived,
    Channel,
    Controller,
    Estimator,
    IntArray,
    JointState,
    Measurement,
    Ns,
)


class Motion(Protocol):
    """The plant as the loop sees it."""

    q: Array
    dq: Array
    timestep: Ns

    def advance(self, tau: Array | None, steps: int) -> tuple[Array, Array]:
        """Step under torque (N, 1 or steps, n); None is braked. Returns q and dq (N, steps, n), reused arrays."""
        ...

    def give_up(self, arms: Any) -> None:
        """Count the arms of a mask (N,) as lost."""
        ...

    def diverged(self) -> Any:
        """Mask (N,) of arms lost since the last call, or None."""
        ...


class DriveSide(Protocol):
    """The drives as the loop sees them."""

    def encode(self, q: Array) -> Array:
        """Encoder reading of ``q`` (N, n)."""
        ...

    def torque(self, arrived: Arrived, now: Ns, steps: int) -> Array:
        """Torque over the next plant steps, (N, 1 or steps, n); NaN is braked."""
        ...


class SpeedSignal(Protocol):
    """A drive's own speed signal as the loop sees it."""

    def observe(self, q: Array, dq: Array) -> None:
        """Take in the motion (N, steps, n)."""
        ...

    def read(self) -> Array:
        """Speed (N, n) now."""
        ...


class References(Protocol):
    """The desired motion, tick by tick."""

    def at(self, k: int) -> Any:
        """Joint or task reference of tick k, each field with leading axis N or 1."""
        ...


class Between(Protocol):
    """What sits between estimator, law and link, as the controller's side sees it."""

    def ahead(self, estimate: JointState, meas: Measurement, now: Ns) -> JointState:
        """The state that the law is given in place of the ``estimate``."""
        ...

    def command(self, tau: Array, k: int, now: Ns) -> Array:
        """The command that goes out in place of the law's torque (N, n) at tick ``k``; NaN stays NaN."""
        ...


@dataclass(frozen=True, slots=True)
class Link:
    """Measurements go up, commands come down."""

    up: Channel
    down: Channel


@dataclass(frozen=True, slots=True)
class Timing:
    """The instants of one period.

    Attributes:
        period: control period T [ns], a whole number of plant steps.
        phase: from the sample to the controller's computation [ns], less than T.
        ticks: number of periods.
    """

    period: Ns
    phase: Ns
    ticks: int


class Tick(NamedTuple):
    """What happened in one period; arrays of ``q``, ``dq``, ``tau`` may be reused by the next.

    Attributes:
        k: index of the period.
        state: what the controller believed, or None when it had nothing to go by.
        command: torque (N, n) it asked for, or None.
        age: age of the data it used [ns], (N, n), or None.
        q, dq: plant states (N, steps, n) at the end of each plant step of the period.
        tau: torque (N, steps or 1, n) on the joints during each step; NaN while the brakes are closed.
        lost: mask (N,) of arms found to have diverged, or None.
    """

    k: int
    state: JointState | None
    command: Array | None
    age: IntArray | None
    q: Array
    dq: Array
    tau: Array
    lost: Any


class ArmSide:
    """Plant and drives."""

    def __init__(self, plant: Motion, drives: DriveSide, source: SpeedSignal | None) -> None:
        self._plant, self._drives, self._source = plant, drives, source

    def latch(self) -> tuple[Array, ...]:
        """What the drives measure now: (q,) or (q, dq)."""
        q = self._drives.encode(self._plant.q)
        return (q,) if self._source is None else (q, self._source.read())

    def advance(self, down: Channel, now: Ns, steps: int) -> tuple[Array, Array, Array]:
        """Step the plant from ``now`` under whatever commands act; returns q, dq (N, steps, n) and tau."""
        dt = self._plant.timestep
        end = Ns(now + steps * dt)
        changes = down.changes(now, end)
        if not changes:
            tau = self._torque(down, now, steps)
        else:
            pieces = []
            for start, stop in zip([now, *changes], [*changes, end], strict=True):
                count = (stop - start) // dt
                piece = self._torque(down, start, count)
                n_sims, n = self._plant.q.shape
                blank = np.full((n_sims, 1, n), np.nan) if piece is None else piece
                pieces.append(np.broadcast_to(blank, (n_sims, count, n)))
            tau = np.concatenate(pieces, axis=1)
        q, dq = self._plant.advance(tau, steps)
        if self._source is not None:
            self._source.observe(q, dq)
        if tau is None:
            tau = np.full((q.shape[0], 1, q.shape[2]), np.nan)
        return q, dq, tau

    def _torque(self, down: Channel, now: Ns, steps: int) -> Array | None:
        arrived = down.newest(now)
        return None if arrived is None else self._drives.torque(arrived, now, steps)

    def give_up(self, arms: Any) -> None:
        """Count the arms of a mask (N,) as lost."""
        self._plant.give_up(arms)

    def diverged(self) -> Any:
        """Mask (N,) of arms lost since the last call, or None."""
        return self._plant.diverged()


class ControllerSide:
    """Estimator, trajectory and control law, and what may sit between them and the link."""

    def __init__(
        self,
        estimator: Estimator,
        references: References,
        controller: Controller,
        model: ArmModel,
        between: Between | None = None,
    ) -> None:
        self._estimator, self._references = estimator, references
        self._controller, self._model = controller, model
        self._between = between
        self._ready = False

    def tick(self, arrived: Arrived, now: Ns, k: int, start: tuple[Array, ...]) -> tuple[JointState, Array]:
        """Estimate, compute; the state handed back is the estimate, whatever the law is given.

        A joint that was never heard of is taken to be where it was at the ``start``, so that nothing jumps when it
        speaks; until every joint of an arm has spoken, that arm's state and torque are NaN outside.
        """
        values = arrived.values
        heard = None
        if not self._ready:
            known = arrived.stamp >= 0
            heard = known.all(axis=1, keepdims=True)
            self._ready = bool(heard.all())
            values = tuple(np.where(known, value, first) for value, first in zip(values, start, strict=True))
        meas = Measurement(arrived.stamp, values[0], values[1] if len(values) > 1 else None)
        state = self._estimator.update(meas, now)
        given = state if self._between is None else self._between.ahead(state, meas, now)
        tau = self._controller.torque(given, self._references.at(k), self._model)
        if heard is not None and not self._ready:
            state = JointState(np.where(heard, state.q, np.nan), np.where(heard, state.dq, np.nan))
            tau = np.where(heard, tau, np.nan)
        return state, tau if self._between is None else self._between.command(tau, k, now)


def simulate(arm: ArmSide, control: ControllerSide, link: Link, timing: Timing, timestep: Ns) -> Iterator[Tick]:
    """Run the loop, one period a turn. Ends early when every arm has diverged is the consumer's choice.

    Args:
        arm: plant side.
        control: controller side.
        link: the two channels.
        timing: instants of a period; period and phase are whole numbers of plant steps.
        timestep: plant step [ns].
    """
    before = timing.phase // timestep
    after = timing.period // timestep - before
    start = arm.latch()
    for k in range(timing.ticks):
        now = Ns(k * timing.period)
        link.up.send(now, arm.latch())
        head = None
        if before:
            head = [a.copy() for a in _full(arm.advance(link.down, now, before))]
            now = Ns(now + timing.phase)
        state = command = age = None
        arrived = link.up.newest(now)
        if arrived is not None:
            state, command = control.tick(arrived, now, k, start)
            age = now - arrived.stamp
            link.down.send(now, (command,))
            # A torque that is no number, from a state that is one, is no closed brake. The ufunc's own reduce and the
            # isnan of math cost a third of sum() and numpy's; this runs at every tick.
            if math.isnan(np.add.reduce(command, axis=None)):
                arm.give_up(np.isnan(command).any(axis=1) & ~np.isnan(state.q).any(axis=1))
        q, dq, tau = arm.advance(link.down, now, after)
        if head is not None:
            q, dq, tau = (np.concatenate(pair, axis=1) for pair in zip(head, _full((q, dq, tau)), strict=True))
        yield Tick(k, state, command, age, q, dq, tau, arm.diverged())


def _full(arrays: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    q, dq, tau = arrays
    return q, dq, np.broadcast_to(tau, q.shape)
