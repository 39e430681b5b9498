"""The loop of a scenario's variant at any operating point: what its blocks are, linearised and closed."""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from lwa4d_sim.assembly import Blocks, build_blocks, build_controller
from lwa4d_sim.controllers.belief import believed_model
from lwa4d_sim.dynamics import NominalModel
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import NS_PER_S, Array, Controller, IntArray
from lwa4d_sim.observers import ObserverVelocity
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.settings import CanopenLoop, IdealLoop, SampledLoop
from lwa4d_sim.stability.assist import Assist
from lwa4d_sim.stability.filters import Filter, filter_of
from lwa4d_sim.stability.instants import assist_of, bus_arrivals, bus_instants, instants_of
from lwa4d_sim.stability.jitter import continuous_delay_margin, jitter_margin
from lwa4d_sim.stability.linear import (
    Linear,
    at_rest,
    linearise_arm,
    linearise_law,
    rows_needed,
    scaled_gains,
    without_gains,
)
from lwa4d_sim.stability.loops import Continuous, Loop
from lwa4d_sim.stability.margins import Mode, delay_margin, gain_margin, leading_mode, spectral_radius
from lwa4d_sim.stability.points import Points
from lwa4d_sim.stability.sampled import Instants, close

_POINTS_AT_ONCE = 256  # operating points linearised together: 7,424 arms of 7 joints, some tens of megabytes (assumed)
_LONGEST = 50  # periods of extra latency that are tried (assumed: half a second at 10 ms)
_LATEST = 50  # periods that commands and samples may be late; longer ones take minutes (measured)
_INSTANTS = 12  # of a motion without waypoints that are looked at (assumed)


class Study:
    """A scenario's variant, ready to be linearised.

    Args:
        scenario: the scenario.
        variant: which variant.

    Raises:
        ScenarioError: the scenario does not fit together, or has a block without a linear model.
        ModelError, KinematicsError, TrajectoryError: the arm or the motion cannot be built.
    """

    def __init__(self, scenario: Scenario, variant: str) -> None:
        self.scenario, self.variant = scenario, variant
        self.blocks: Blocks = build_blocks([scenario.changed({}, variant)], variant, 1)
        self.settings = self.blocks.settings
        self.n, self.loop_settings = self.blocks.arm.n, self.settings.loop
        with self.blocks.about("controller"):
            belief = self.settings.controller.model
            self._believed = believed_model(belief, self.settings.arm, scenario.folder)
            self._make_law()
        self._arms: dict[tuple[str, int], NominalModel] = {}
        if isinstance(self.loop_settings, SampledLoop):
            late = self.delay / self._sampled.period
            if late > _LATEST:
                rule = f"data are {late:.0f} periods late in all; the linear loop takes {_LATEST}"
                raise scenario.error(("loop", "latency"), rule, variant)

    def _make_law(self) -> None:
        self._law = build_controller([self.settings], self.blocks.arm)
        bare = without_gains(self.settings.controller)
        self._bare = None if bare is None else self._law_of([bare])

    def _law_of(self, parameters: Sequence[Any]) -> Controller:
        """The law with other parameters, for as many arms."""
        return build_controller([replace(self.settings, controller=one) for one in parameters], self.blocks.arm)

    def with_gains(self, overrides: Mapping[str, Any]) -> "Study":
        """This study with other gains, by the dotted keys of the scenario; all else must stay."""
        other = copy(self)
        other.scenario = self.scenario.changed(overrides, self.variant)
        other.settings = other.scenario.variants[self.variant]
        other._make_law()
        return other

    def place(self, block: str) -> str:
        """The dotted key at which this variant has its settings of ``block``."""
        own = (self.scenario.document.get("variants") or {}).get(self.variant) or {}
        return f"variants.{self.variant}.{block}" if block in own else block

    def _filter(self, loop: Any) -> Filter:
        """The velocity estimator of each joint."""
        try:
            return filter_of(loop.velocity, loop.period)
        except TypeError as error:
            raise self.scenario.error(("loop", "velocity"), str(error), self.variant) from None

    @property
    def _velocity(self) -> Any:
        return getattr(self.loop_settings, "velocity", None)

    def _assist(self, loop: Any) -> Assist | None:
        with self.blocks.about("compensation"):
            return assist_of(replace(self.settings, loop=loop), self.n, self.blocks.timing.phase)

    @cached_property
    def _arrivals(self) -> Array:
        return bus_arrivals(self.scenario, self.variant)

    def _instants(self, loop: Any, extra: float) -> Instants:
        """When samples are taken and torques act, with ``extra`` latency of the commands [s]."""
        if isinstance(loop, CanopenLoop):
            return bus_instants(loop, self._arrivals, extra=extra)
        return instants_of(loop, self.n, extra=extra)

    def waypoints(self) -> Points:
        """The arm at rest at each waypoint; for a motion without waypoints at some instants of it."""
        trajectory = self.blocks.infos[0].trajectory
        ends = trajectory.knots
        t = ends if len(ends) > 1 or self._goes_to_points() else np.linspace(0.0, ends[-1], _INSTANTS)
        before = np.maximum(0.0, t - 1e-9)  # a step jumps at the knot itself
        return self.resting(trajectory.joint(before).q, t)

    def _goes_to_points(self) -> bool:
        return hasattr(self.settings.trajectory, "waypoints")

    def resting(self, q: Array, t: Array | None = None) -> Points:
        """The arm at rest at the poses ``q`` (P, n) [rad]."""
        q = np.atleast_2d(np.asarray(q, float))
        if q.shape[1] != self.n:
            raise ScenarioError(f"a pose has {q.shape[1]} values, the arm has {self.n} joints")
        none = np.zeros_like(q)
        arm = self.blocks.arm
        ref = at_rest(q, arm.kinematics, self.settings.controller.space, arm.task_size)
        return Points(np.zeros(len(q)) if t is None else t, q, none, none, ref)

    def along(self, t: Array) -> Points:
        """The arm on its motion at the instants ``t`` (P,) [s]."""
        trajectory = self.blocks.infos[0].trajectory
        motion = trajectory.joint(t)
        ref: Any = motion if self.settings.controller.space == "joint" else trajectory.task(t)
        return Points(t, motion.q, motion.dq, motion.ddq, ref)

    def linear(self, points: Points) -> Linear:
        """Arm and law near the operating points."""
        pieces = [
            self._linear(points.part(slice(start, start + _POINTS_AT_ONCE)))
            for start in range(0, len(points.q), _POINTS_AT_ONCE)
        ]
        whole = Linear.of([np.concatenate(part) for part in zip(*(piece.parts for piece in pieces), strict=True)])
        if getattr(self.settings.controller, "damping_limit", None) is None:
            return whole
        return replace(whole, curve=lambda rows, k: self._curved(points, rows, k))

    def _curved(self, points: Points, rows: IntArray, k: Array) -> Array:
        """Slopes of the law at some points with all gains times ``k``; a damping limit does not grow with them."""
        some = points.part(rows)
        arms = rows_needed(1, self.n)
        parameters = [scaled_gains(self.settings.controller, factor) for factor in k.tolist() for _ in range(arms)]
        believed = self._arm("belief", rows_needed(len(rows), self.n))
        return linearise_law(self._law_of(parameters), believed, some.q, some.dq, some.ref)

    def _linear(self, points: Points) -> Linear:
        rows = rows_needed(len(points.q), self.n)
        plant, believed = self._arm("plant", rows), self._arm("belief", rows)
        A, B = linearise_arm(plant, points.q, points.dq, points.ddq)
        if self.settings.compensation is None and not isinstance(self._velocity, ObserverVelocity):
            A_model, B_model = A, B  # nobody asks
        else:
            A_model, B_model = linearise_arm(believed, points.q, points.dq, points.ddq, passive=False)
        with self.blocks.about("controller"):
            law = linearise_law(self._law, believed, points.q, points.dq, points.ref, own=self.bare_is_unknown)
        if self._bare is None:
            bare = np.zeros_like(law)
        else:
            bare = linearise_law(self._bare, believed, points.q, points.dq, points.ref)
        return Linear(A, B, law, bare, A_model, B_model)

    def _arm(self, which: str, rows: int) -> NominalModel:
        """Plant or belief for so many arms; made once, for making costs more than asking."""
        if which == "belief" and self._believed is self.blocks.model:
            which = "plant"
        if (which, rows) not in self._arms:
            model = self.blocks.model if which == "plant" else self._believed
            self._arms[which, rows] = NominalModel(model, rows)
        return self._arms[which, rows]

    @property
    def ideal(self) -> bool:
        """Whether the loop is continuous."""
        return isinstance(self.loop_settings, IdealLoop)

    @property
    def steps(self) -> bool:
        """Whether the desired motion jumps."""
        return getattr(self.settings.trajectory, "profile", None) == "step"

    @property
    def period(self) -> float:
        """From tick to tick [s]; of an ideal loop a plant step."""
        return self.blocks.timing.period / NS_PER_S

    @property
    def bare_is_unknown(self) -> bool:
        """Whether the law's gains are not known, so that a factor on them is one on its whole feedback."""
        return self._bare is None

    def close(self, linear: Linear, extra: float = 0.0, period: float | None = None) -> Loop | Continuous:
        """The loop at the points of ``linear``.

        Args:
            linear: arm and law.
            extra: latency added to the commands [s]; a loop without a bus has none.
            period: another control period than the scenario's [s].
        """
        if self.ideal:
            return Continuous.of(linear, self.period)
        loop: Any = self.loop_settings if period is None else replace(self._sampled, period=period)
        try:
            return close(linear, self._filter(loop), self._instants(loop, extra), self._assist(loop))
        except OverflowError as error:
            raise self.scenario.error(("loop", "period"), f"{error}; give a shorter one", self.variant) from None

    def gain_margin(self, loop: Loop | Continuous) -> Array:
        """Factor (P,) on all gains at which each loop changes its stability, see `margins.gain_margin`."""
        return gain_margin(loop.radius, len(loop.U0))

    def delay_margin(self, linear: Linear) -> Array:
        """Extra latency (P,) [s] of the commands at which each loop becomes unstable; inf if none found."""
        loop = self.close(linear)
        if isinstance(loop, Continuous):
            return continuous_delay_margin(loop)

        def radius(rows: IntArray, extra: float) -> Array:
            return spectral_radius(self.close(linear.pick(rows), extra).at_gain())

        margin: Array = delay_margin(radius, len(linear.A), loop.period, _LONGEST * loop.period)
        return margin

    def jitter_margin(self, linear: Linear) -> Array:
        """How much later than planned commands may come (P,) [s], however they vary; see `jitter.jitter_margin`."""
        loop = self.close(linear)
        if isinstance(loop, Continuous):
            return np.full(len(linear.A), np.nan)
        settings = self._sampled
        whole = self.waits_for_sync
        apart = getattr(settings, "per_joint", not whole)  # on a bus each joint has a frame of its own
        slack = self.slack if whole else 0.0
        return jitter_margin(loop, linear, self._filter(settings).time_constant, slack, whole=whole, apart=apart)

    @property
    def _sampled(self) -> SampledLoop | CanopenLoop:
        assert not isinstance(self.loop_settings, IdealLoop)
        return self.loop_settings

    @property
    def waits_for_sync(self) -> bool:
        """Whether torques act at a SYNC."""
        return not self.ideal and self._sampled.actuation == "next_sync"

    @property
    def delay(self) -> float:
        """From a sample to the torque computed from it, the slowest joint's [s]; 0 without a bus."""
        if self.ideal:
            return 0.0
        instants = self._instants(self._sampled, 0.0)
        return float((instants.old * instants.period + instants.acts).max())

    @cached_property
    def slack(self) -> float:
        """How much later the latest command may come and still be in time for its SYNC [s]."""
        settings = self._sampled
        planned = self._instants(settings, 0.0).acts
        low, high = 0.0, settings.period
        while high - low > 1e-9:
            middle = 0.5 * (low + high)
            in_time = np.allclose(self._instants(settings, middle).acts, planned)
            low, high = (middle, high) if in_time else (low, middle)
        return low

    def mode(self, loop: Loop | Continuous, row: int, k: float = 1.0) -> Mode:
        """The leading mode of one loop with all gains times ``k``."""
        matrix = loop.at_gain(np.full(len(loop.U0), k))[row]
        return leading_mode(matrix, self.n, loop.period)
