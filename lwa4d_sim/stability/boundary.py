"""Where theory draws the line across a chart: the value of one setting at which some waypoint becomes unstable."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from lwa4d_sim.scenario import Scenario
from lwa4d_sim.stability.study import Study

_LOOKS = 13  # values between the ends that are looked at (assumed: a narrower window of stability is missed)


def largest_radius(scenario: Scenario, variant: str, overrides: Mapping[str, Any]) -> float:
    """Largest spectral radius over the waypoints of a variant with changes.

    Raises:
        ScenarioError: a change does not fit, or the loop has no linear model.
    """
    study = Study(scenario.changed(overrides, variant), variant)
    points = study.waypoints()
    loop = study.close(study.linear(points))
    rows = np.arange(len(points.q))
    return float(loop.radius(rows, np.ones(len(rows))).max())


def critical_value(
    scenario: Scenario, variant: str, changes: Callable[[float], Mapping[str, Any]], low: float, high: float
) -> float | None:
    """The first value from ``low`` to ``high`` at which stability is lost; None if it is not.

    Args:
        scenario: the scenario.
        variant: which variant.
        changes: what a value of the setting means, as overrides by dotted key.
        low: where the loop may be stable.
        high: how far to look.
    """
    from scipy.optimize import brentq

    def excess(value: float) -> float:
        return float(np.log(min(largest_radius(scenario, variant, changes(value)), 1e6)))

    looks = np.linspace(low, high, _LOOKS).tolist()
    stable = False
    for before, value in zip([low, *looks], looks, strict=False):
        now = excess(value) < 0
        if stable and not now:
            return float(brentq(excess, before, value, xtol=1e-4 * (high - low)))
        stable = now
    return None
