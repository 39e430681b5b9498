"""The theoretical limit of stability across a sweep's map: where some waypoint's linear loop becomes unstable."""

import numpy as np

from lwa4d_sim.errors import LwaError
from lwa4d_sim.settings import IdealLoop
from lwa4d_sim.stability.boundary import critical_value
from lwa4d_sim.sweep.design import RangeAxis
from lwa4d_sim.sweep.file import Sweep

Curve = list[tuple[float, float]]

_POINTS = 65  # of the line (assumed: smooth beside the cells of a map)


def stability_limit(sweep: Sweep) -> Curve | None:
    """The line (first axis, second axis) over a grid of two ranges; None for another design or a loop without a limit.

    Along the axis that moves gains, or else the first, the first loss of stability is looked for at each value of the
    other one.
    """
    ranges = {name: axis for name, axis in sweep.axes.items() if isinstance(axis, RangeAxis)}
    if len(sweep.axes) != 2 or len(ranges) != 2 or isinstance(sweep.scenario.variants[sweep.variant].loop, IdealLoop):
        return None
    names = list(ranges)
    k = next((i for i, name in enumerate(names) if _moves_gains(name, ranges[name])), 0)
    along, across = ranges[names[k]], ranges[names[1 - k]]
    line: Curve = []
    for other in sorted(set(across.at(np.linspace(0.0, 1.0, _POINTS)))):

        def changes(value: float, other: float = other) -> dict[str, object]:
            row = (value, other) if k == 0 else (other, value)
            return dict(sweep.point(0, row).overrides)

        low, high = sorted((along.from_, along.to))
        try:
            found = critical_value(sweep.scenario, sweep.variant, changes, low, high)
        except LwaError:
            return None  # some loop on the map has no linear model
        if found is not None:
            line.append((found, other) if k == 0 else (other, found))
    return line or None


def _moves_gains(name: str, axis: RangeAxis) -> bool:
    return all(key.startswith("controller.") for key in axis.keys or {name: 1.0})
