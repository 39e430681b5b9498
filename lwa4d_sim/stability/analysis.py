"""What the stability of a scenario comes to: margins at each waypoint, and critical gains over latency and period."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.settings import CanopenLoop, IdealLoop, SampledLoop
from lwa4d_sim.stability.instants import is_random
from lwa4d_sim.stability.margins import Mode
from lwa4d_sim.stability.points import Points
from lwa4d_sim.stability.study import Study

_SAMPLES = 41  # of a chart's curve (assumed: smooth to the eye)
_PERIODS = 3  # of extra latency that a chart shows
_BESIDE = 1e-7  # [s] before and after the instant at which a SYNC is missed
_MOST = 10  # commands on their way at the shortest period that a chart shows
_SHORTEST, _SPREAD = 0.1, 2.5  # of the chart over the period, as shares of the scenario's own


@dataclass(frozen=True, slots=True)
class PointStability:
    """The loop at one operating point.

    Attributes:
        t: instant of the motion [s].
        q: joint angles [rad] (n,).
        x: tool point [m] (3,).
        spectral_radius: growth of the slowest-dying disturbance from tick to tick; below 1 is stable.
        gain_margin: factor on all gains at which that changes; inf if none does.
        delay_margin: extra latency of the commands at which the loop becomes unstable [s]; inf if none found.
        jitter_margin: how much later than planned commands may come, however that varies [s]; nan for an ideal loop.
        mode: what shakes at the limit, or the leading mode where there is no limit.
    """

    t: float
    q: Array
    x: Array
    spectral_radius: float
    gain_margin: float
    delay_margin: float
    jitter_margin: float
    mode: Mode


@dataclass(frozen=True, slots=True)
class Curve:
    """Critical factors on all gains over one quantity, (K, P): a curve for each operating point."""

    x: Array
    critical: Array


def default_variant(scenario: Scenario, variant: str | None = None) -> str:
    """The variant asked for; without one the first with a bus.

    Raises:
        ScenarioError: there is no such variant.
    """
    if variant is None:
        return next(
            (name for name, one in scenario.variants.items() if not isinstance(one.loop, IdealLoop)),
            next(iter(scenario.variants)),
        )
    if variant not in scenario.variants:
        raise ScenarioError(f"{scenario.source}: no variant '{variant}'; it has {', '.join(scenario.variants)}")
    return variant


def at_points(study: Study, points: Points) -> list[PointStability]:
    """Margins at each operating point."""
    linear = study.linear(points)
    loop = study.close(linear)
    P = len(points.q)
    radius, gain = loop.radius(np.arange(P), np.ones(P)), study.gain_margin(loop)
    delay, jitter = study.delay_margin(linear), study.jitter_margin(linear)
    x = study.blocks.arm.kinematics.point(points.q)
    return [
        PointStability(
            t=float(points.t[i]),
            q=points.q[i],
            x=x[i],
            spectral_radius=float(radius[i]),
            gain_margin=float(gain[i]),
            delay_margin=float(delay[i]),
            jitter_margin=float(jitter[i]),
            mode=study.mode(loop, i, float(gain[i]) if 0 < gain[i] < np.inf else 1.0),
        )
        for i in range(P)
    ]


def over_latency(study: Study, points: Points) -> Curve:
    """Critical gains over an extra latency of the commands [s], from none to three periods."""
    extra = np.linspace(0.0, _PERIODS * study.period, _SAMPLES)
    jumps = study.slack + study.period * np.arange(_PERIODS) if study.waits_for_sync else np.empty(0)
    extra = np.unique(np.concatenate([extra, *(jumps + side * _BESIDE for side in (-1.0, 1.0))]))
    linear = study.linear(points)
    return Curve(extra, np.stack([study.gain_margin(study.close(linear, x)) for x in extra.tolist()]))


def over_period(study: Study, points: Points) -> Curve:
    """Critical gains over the control period [s], other times as they are."""
    # a period much shorter than the delay has so many commands on their way that the curve takes minutes
    shortest = max(_SHORTEST * study.period, study.delay / _MOST)
    period = np.linspace(shortest, max(_SPREAD * study.period, 2.0 * shortest), _SAMPLES)
    linear = study.linear(points)
    return Curve(period, np.stack([study.gain_margin(study.close(linear, period=x)) for x in period.tolist()]))


def remarks(study: Study) -> list[str]:
    """What the linear loop leaves out of this scenario, in words."""
    settings, loop = study.settings, study.loop_settings
    said = []
    if is_random(loop):
        said.append("delays vary or samples get lost: margins hold for the mean latency; compare the jitter margin")
    if np.any(study.blocks.model.dof_frictionloss > 0):
        said.append("Coulomb friction is left out: it damps small motions, so the arm shakes later and less")
    if isinstance(loop, CanopenLoop) or (
        isinstance(loop, SampledLoop) and (np.any(loop.position_resolution) or np.any(loop.torque_resolution))
    ):
        said.append("resolutions are left out: near the limit they keep a small tremble alive")
    if study.bare_is_unknown:
        said.append("the gains of a law of one's own are not known: the gain margin is a factor on its whole feedback")
    if settings.plant.disturbances:
        said.append("disturbances are left out: they move the arm but not its limit")
    return said


def as_object(points: list[PointStability]) -> list[Mapping[str, Any]]:
    """For JSON; what is infinite or unknown is None."""
    return [
        {
            "t": point.t,
            "q": point.q.tolist(),
            "x": point.x.tolist(),
            "spectral_radius": _number(point.spectral_radius),
            "gain_margin": _number(point.gain_margin),
            "delay_margin": _number(point.delay_margin),
            "jitter_margin": _number(point.jitter_margin),
            "mode": {"frequency": point.mode.frequency, "share": point.mode.share.tolist()},
        }
        for point in points
    ]


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None
