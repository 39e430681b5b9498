"""The search for the worst point of a sweep's region: differential evolution, a whole population at a time."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from lwa4d_sim.errors import LwaError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.metrics import METRICS
from lwa4d_sim.sweep.design import WorstCase, mapped
from lwa4d_sim.sweep.file import Point, Sweep
from lwa4d_sim.sweep.table import metric_of

Evaluate = Callable[[Sequence[Point]], list[Mapping[str, Any]]]
_MEMBERS = 10  # of a population for each axis (Storn and Price 1997 advise ten)
_LEAST, _MOST = 16, 64  # enough to be stepped together without waste; so many that generations are left
_UNSTABLE = 1e6  # added to the score of a run that is not stable: above every metric of one that is


def score(row: Mapping[str, Any], objective: str, duration: float) -> float:
    """How bad a run is: its objective, or for one that is not stable a number beyond, the larger the sooner it shakes.

    Args:
        row: of the table.
        objective: metric; of several columns the largest counts.
        duration: of the motion [s].
    """
    if row["status"] != "ok":
        return -math.inf
    if not row["stable"]:
        since = row.get("unstable_since")
        return _UNSTABLE * (2.0 - (0.0 if since is None else min(1.0, since / duration)))
    values = [v for key, v in row.items() if v is not None and key in row and _belongs(key, objective)]
    return max(map(float, values), default=-math.inf)


def _belongs(column: str, objective: str) -> bool:
    return column == objective or (column not in METRICS and metric_of(column) == objective)


def search(sweep: Sweep, evaluate: Evaluate) -> list[Point]:
    """All points that the search looks at, in order; the same seed looks at the same points.

    Args:
        sweep: with a design of kind worst_case.
        evaluate: rows of points.

    Raises:
        LwaError: whatever ``evaluate`` raises.
    """
    from scipy.optimize import Bounds, differential_evolution
    from scipy.stats import qmc

    design = sweep.settings.design
    assert isinstance(design, WorstCase)
    dimensions = len(sweep.axes)
    members = max(8, min(max(_LEAST, _MEMBERS * dimensions), _MOST, design.evaluations))
    points: list[Point] = []

    def objective(population: Array) -> Any:
        shares = population.T.reshape(-1, dimensions)
        new = [sweep.point(len(points) + k, row) for k, row in enumerate(mapped(sweep.axes, shares))]
        points.extend(new)
        return -np.array([score(row, design.objective, duration(sweep)) for row in evaluate(new)])

    vectorised: Any = objective  # whose type the stubs know for one point at a time only
    try:
        differential_evolution(
            vectorised,
            Bounds(np.zeros(dimensions), np.ones(dimensions)),
            init=qmc.LatinHypercube(dimensions, rng=design.seed).random(members),
            maxiter=max(0, design.evaluations // members - 1),
            tol=1e-6,  # ends early only where all members are at one point
            polish=False,
            updating="deferred",
            vectorized=True,
            rng=design.seed,
        )
    except RuntimeError as error:  # SciPy's wrapping of a ValueError, which many of ours are
        if isinstance(error.__cause__, LwaError):
            raise error.__cause__ from None
        raise
    return points


def duration(sweep: Sweep) -> float:
    """A time [s] that no run of the sweep is longer than, as far as onsets go."""
    motion = sweep.scenario.variants[sweep.variant].trajectory
    times = getattr(motion, "segment_time", None)
    if times is None:
        return float(getattr(motion, "duration", 1e3))
    count = len(motion.waypoints.points)  # type: ignore[union-attr]
    return float(np.sum(np.broadcast_to(np.asarray(times, float), count)))
