"""The best gains under stated margins: the fastest loop, or the least error, that keeps them at every pose."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from lwa4d_sim.controllers import ComputedTorque, PdGravity
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.runner import run
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.stability.maps import default_joints, slice_of
from lwa4d_sim.stability.points import Points
from lwa4d_sim.stability.study import Study
from lwa4d_sim.stability.tracking import Tracking, tracking

Gains = Literal["one", "two", "joints"]
Objective = Literal["bandwidth", "error"]

# Margins are checked at these shares of themselves, so that a window of instability below them is seen (assumed).
_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
_RANGE = (1e-3, 1e3)  # of the gains that are tried, as factors on the scenario's own
_STEP = 0.1  # of the logarithm of a common factor; a narrower window of good gains is missed (assumed)
_EVALUATIONS = {"two": 60, "joints": 150}  # at most, by number of gains (assumed: seconds to a minute)
_SIMULATIONS = 40  # at most, where each evaluation is a run
_RATIOS = (1.0, 1.2, 1.5, 2.0)  # damping ratios from which the joints' gains are searched (assumed)
_WORKSPACE = (8, 8)  # poses of a workspace that are looked at


@dataclass(frozen=True, kw_only=True)
class Wish:
    """What a tuning is to reach.

    Attributes:
        gains: ``one`` factor on kp and kd (computed torque: one p); ``two``: kp and kd; ``joints``: kp and kd of each
            joint or task axis.
        objective: ``bandwidth``: the largest at the slowest pose; ``error``: the least rms error of the tool in a run.
        gain_margin: factor that all gains must bear at every pose.
        delay_margin: extra latency of the commands that the loop must bear at every pose [s].
        peak: largest amplification of a reference at any frequency; not asked of ``one`` gain, which has no say in it.
        workspace: look at poses all over the workspace slice instead of the waypoints.
    """

    gains: Gains = "one"
    objective: Objective = "bandwidth"
    gain_margin: float = 2.0  # 6 dB, usual
    delay_margin: float = 0.0
    peak: float = 1.3  # 2.3 dB, usual
    workspace: bool = False


@dataclass(frozen=True, slots=True)
class Tuned:
    """What was found.

    Attributes:
        overrides: the gains, by dotted key.
        before, after: bandwidth [Hz] and peak at the slowest pose with the scenario's gains and with these; a bandwidth
            of 0 is a loop that is not stable.
        gain_margin, delay_margin: the smallest over the poses; infinite where none was found.
        evaluations: loops or runs that were looked at.
    """

    overrides: Mapping[str, Any]
    before: Tracking
    after: Tracking
    gain_margin: float
    delay_margin: float
    evaluations: int


def tune(scenario: Scenario, variant: str, wish: Wish, advance: Callable[[], None] = lambda: None) -> Tuned:
    """Search for gains.

    Args:
        scenario: whose controller is tuned.
        variant: which variant.
        wish: what is wanted.
        advance: called at each evaluation.

    Raises:
        ScenarioError: the controller has no gains that are known, or no gains keep the margins.
    """
    return _Search(Study(scenario, variant), wish, advance).run()


class _Search:
    def __init__(self, study: Study, wish: Wish, advance: Callable[[], None]) -> None:
        self._study, self._wish, self._advance = study, wish, advance
        given = study.settings.controller
        if not isinstance(given, (PdGravity, ComputedTorque)):
            rule = "its gains are not known; pd_gravity and computed_torque can be tuned"
            raise study.scenario.error(("controller", "kind"), rule, study.variant)
        if study.ideal:
            rule = "a loop without a bus has no largest gain; choose a variant with a bus"
            raise study.scenario.error(("loop", "kind"), rule, study.variant)
        self._given = given
        kp, kd = given.gains if isinstance(given, ComputedTorque) else (given.kp, given.kd)
        size = study.n if given.space == "joint" else study.blocks.arm.task_size
        self._kp, self._kd = (np.broadcast_to(np.asarray(gain, float), (size,)) for gain in (kp, kd))
        if not (self._kp > 0).all() or not (self._kd > 0).all():
            raise study.scenario.error(("controller",), "kp and kd must be above 0 to be tuned", study.variant)
        self._points = self._poses()
        self._evaluations = 0
        self._tries: dict[bytes, Study] = {}
        self._trackings: dict[bytes, Tracking] = {}
        self._best: tuple[float, Array] | None = None

    def _poses(self) -> Points:
        study = self._study
        if not self._wish.workspace:
            return study.waypoints()
        q, _, _ = slice_of(study, default_joints(study), _WORKSPACE)
        return study.resting(q.reshape(-1, study.n))

    def run(self) -> Tuned:
        found = self._best_gains()
        study = self._tried(found)
        linear = study.linear(self._points)
        return Tuned(
            overrides=self._overrides(found),
            before=self._tracking(self._study),
            after=self._tracking(study),
            gain_margin=float(study.gain_margin(study.close(linear)).min()),
            delay_margin=float(study.delay_margin(linear).min()),
            evaluations=self._evaluations,
        )

    def _best_gains(self) -> Array:
        start = self._start()
        if self._wish.gains == "one" and self._wish.objective == "bandwidth":
            return start  # of one gain the largest is the fastest
        if self._wish.gains == "joints":
            starts = [start, *(self._start(ratio) for ratio in _RATIOS[1:]), self._two()]
            kept = [one for one in starts if self._excess(one) <= 0]
            start = min(kept or starts[:1], key=self._cost)
        return self._improved(start)

    def _two(self) -> Array:
        """The best two gains, for all joints: more freedom is not to be worse."""
        fewer = _Search(self._study, replace(self._wish, gains="two"), self._advance)
        found: Array = np.repeat(fewer._best_gains(), len(self._kp))
        self._evaluations += fewer._evaluations
        return found

    def _start(self, ratio: float = 1.0) -> Array:
        """The largest gains of a ray that keep the margins, never mind the peak."""
        low, high = np.log(_RANGE)
        steps = np.arange(high, low, -_STEP).tolist()
        kept = next((s for s in steps if self._beyond_margins(self._ray(s, ratio), roughly=True) <= 0), None)
        if kept is None:
            asked = f"a gain margin of {self._wish.gain_margin:g} and {1e3 * self._wish.delay_margin:g} ms more delay"
            raise ScenarioError(f"{self._study.scenario.source}: no factor on these gains bears {asked} at every pose")
        good, bad = kept, kept + _STEP
        while bad - good > 1e-6:
            middle = 0.5 * (good + bad)
            keeps = self._beyond_margins(self._ray(middle, ratio), roughly=True) <= 0
            good, bad = (middle, bad) if keeps else (good, middle)
        return self._ray(good, ratio)

    def _ray(self, s: float, ratio: float) -> Array:
        """Gains along which the search begins: a common factor e^s; for joints one frequency e^s and damping ratio."""
        if self._wish.gains != "joints":
            return np.full({"one": 1, "two": 2}[self._wish.gains], s)
        stiffness, damping = np.exp(2.0 * s) * self._inertia, 2.0 * ratio * np.exp(s) * self._inertia
        ray: Array = np.log(np.concatenate([stiffness / self._kp, damping / self._kd]))
        return ray

    @cached_property
    def _inertia(self) -> Array:
        """What each gain acts on, at the pose where it is least: a joint's inertia when the others are free."""
        if isinstance(self._given, ComputedTorque):
            return np.ones(len(self._kp))  # gains in units of acceleration
        linear = self._study.linear(self._points)
        inverse = linear.B[:, self._study.n :]
        if self._given.space == "task":
            J = self._study.blocks.arm.kinematics.jacobian(self._points.q)[:, : len(self._kp)]
            inverse = J @ inverse @ np.swapaxes(J, 1, 2)
        least: Array = 1.0 / np.diagonal(inverse, axis1=1, axis2=2).max(axis=0)
        return least

    def _improved(self, start: Array) -> Array:
        """From the start to a local best, by a trust-region search that keeps to the margins (COBYQA)."""
        from scipy.optimize import NonlinearConstraint, minimize

        simulated = self._wish.objective == "error"
        most = _SIMULATIONS if simulated else _EVALUATIONS[self._wish.gains]
        # a start inside what is asked lets the search feel the slopes of its edges
        back = next((x for x in (start - 0.05 * i for i in range(1, 40)) if self._excess(x) <= 0), start - 0.05)

        def value(x: Array) -> float:
            self._evaluations += 1
            self._advance()
            cost = self._cost(x)
            if self._excess(x) <= 0 and (self._best is None or cost < self._best[0]):
                self._best = cost, np.array(x)
            return cost

        kept = NonlinearConstraint(lambda x: np.array([self._excess(x)]), -np.inf, 0.0)
        bounds = [tuple(np.log(_RANGE))] * len(start)
        minimize(value, back, method="COBYQA", bounds=bounds, constraints=kept, options={"maxfev": most})
        value(start)
        return start if self._best is None else self._best[1]  # the start keeps the margins, if not the peak

    def _cost(self, x: Array) -> float:
        if self._wish.objective == "error":
            values = run(self._tried(x).scenario, self._study.variant).metrics()
            return float(values["rms_error"]) if values["stable"] else 10.0  # [m] worse than any arm could be
        return -float(np.log(max(1e-9, self._found(x).bandwidth.min())))

    def _excess(self, x: Array) -> float:
        """How far the loop is beyond its margins or its peak: above 0 some pose breaks one; smooth in the gains."""
        excess = self._beyond_margins(x)
        if self._wish.gains == "one" or excess > 0:
            return excess
        return max(excess, float(np.log(self._found(x).peak.max() / self._wish.peak)))

    def _found(self, x: Array) -> Tracking:
        """The tracking with these gains; the search asks for it twice."""
        key = np.asarray(x).tobytes()
        if key not in self._trackings:
            self._trackings = {key: self._tracking(self._tried(x))}
        return self._trackings[key]

    def _beyond_margins(self, x: Array, *, roughly: bool = False) -> float:
        """The logarithm of the largest spectral radius; ``roughly``: or of the first that is too large."""
        study, wish = self._tried(x), self._wish
        linear = study.linear(self._points)
        rows = np.arange(len(self._points.q))
        plain, worst = study.close(linear), 0.0
        for share in _SHARES:
            factors = np.full(len(rows), 1.0 + share * (wish.gain_margin - 1.0))
            worst = max(worst, float(plain.radius(rows, factors).max()))
            if roughly and worst > 1.0:
                return worst - 1.0
        for share in _SHARES[1:] if wish.delay_margin else ():
            late = study.close(linear, share * wish.delay_margin)
            worst = max(worst, float(late.radius(rows, np.ones(len(rows))).max()))
            if roughly and worst > 1.0:
                return worst - 1.0
        return float(np.log(min(worst, 1e6)))

    def _tracking(self, study: Study) -> Tracking:
        """At the slowest pose, and the largest peak."""
        linear = study.linear(self._points)
        loop = study.close(linear)
        if loop.radius(np.arange(len(loop.U0)), np.ones(len(loop.U0))).max() >= 1.0:
            return Tracking(np.zeros(1), np.full(1, np.inf))
        found = tracking(loop, (linear.law - linear.bare)[:, :, : study.n])
        return Tracking(found.bandwidth.min(keepdims=True), found.peak.max(keepdims=True))

    def _gains(self, x: Array) -> tuple[Array, Array]:
        """Stiffness kp and damping kd of factors given as logarithms."""
        factors = np.exp(x)
        if self._wish.gains == "one":
            # with one p, kp = p^2 and kd = 2 p
            power = 2.0 if isinstance(self._given, ComputedTorque) and self._given.p is not None else 1.0
            return self._kp * factors**power, self._kd * factors
        first, second = np.split(factors, 2)
        return self._kp * first, self._kd * second

    def _overrides(self, x: Array) -> dict[str, Any]:
        prefix = self._study.place("controller")
        kp, kd = self._gains(x)
        if self._wish.gains == "one" and isinstance(self._given, ComputedTorque) and self._given.p is not None:
            return {f"{prefix}.p": float(self._given.p * np.exp(x[0]))}
        alike = self._wish.gains != "joints" and np.ptp(self._kp) == 0 and np.ptp(self._kd) == 0
        values: dict[str, Any] = {f"{prefix}.kp": float(kp[0]) if alike else kp.tolist()}
        values[f"{prefix}.kd"] = float(kd[0]) if alike else kd.tolist()
        if isinstance(self._given, ComputedTorque) and self._given.p is not None:
            values[f"{prefix}.p"] = None
        return values

    def _tried(self, x: Array) -> Study:
        """The loop with these gains; the search asks for each several times in a row."""
        key = np.asarray(x).tobytes()
        if key not in self._tries:
            self._tries = {key: self._study.with_gains(self._overrides(x))}
        return self._tries[key]
