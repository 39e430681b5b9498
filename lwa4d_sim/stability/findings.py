"""Everything that the command `stability` finds out about one variant of a scenario."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from lwa4d_sim.assembly import versions
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.stability.analysis import (
    Curve,
    PointStability,
    as_object,
    at_points,
    default_variant,
    over_latency,
    over_period,
    remarks,
)
from lwa4d_sim.stability.maps import Slice, default_joints, workspace
from lwa4d_sim.stability.motion import Course, along
from lwa4d_sim.stability.points import Points
from lwa4d_sim.stability.study import Study

STILL = 1e-9  # [-] beyond 1 that a spectral radius may be by the rounding of numeric slopes (derived)
CURVES = 3  # charts that take longer than a moment, beside the map
_DRAWN = 12  # operating points whose curves a chart can hold (assumed: what an eye can tell apart)

_T = TypeVar("_T")


@dataclass(frozen=True)
class Charts:
    """What takes longer than the margins themselves, and is drawn.

    Attributes:
        rows: indices of the operating points that have curves.
        latency, period: critical gains over either, a curve for each of ``rows``; None without a bus.
        poles: eigenvalues of the loop from tick to tick, (K, m); None without a bus.
        course: along the motion.
        map: over a slice of the workspace; None for an arm of one joint.
        alike: whether each operating point's joints that the slice leaves alone stand as on the map, the one about
            the vertical aside.
    """

    rows: Sequence[int]
    latency: Curve | None
    period: Curve | None
    poles: Any
    course: Course
    map: Slice | None
    alike: Sequence[bool]

    @property
    def map_stable(self) -> Any:
        """Whether the loop is stable in each pose of the map."""
        return np.ones(0, bool) if self.map is None else self.map.spectral_radius <= 1.0 + STILL


@dataclass(frozen=True)
class Findings:
    """The answer.

    Attributes:
        study: the loop looked at.
        points: margins at each operating point.
        names: of the operating points, e.g. `waypoint 4`.
        remarks: what the linear loop leaves out.
        poses: given on the command line instead of the waypoints, as given.
        charts: None where only the margins were asked for.
    """

    study: Study
    points: Sequence[PointStability]
    names: Sequence[str]
    remarks: Sequence[str]
    poses: Sequence[str] = ()
    charts: Charts | None = None

    @property
    def scenario(self) -> Scenario:
        """The scenario looked at."""
        return self.study.scenario

    @property
    def variant(self) -> str:
        """The variant looked at."""
        return self.study.variant


def find(scenario: Scenario, variant: str | None = None, poses: Sequence[str] = ()) -> tuple[Findings, Points]:
    """Margins at the waypoints, or at ``poses`` (joint angles in rad with commas); and those operating points.

    Raises:
        ScenarioError: no such variant, a pose that does not fit, or a block without a linear model.
        LwaError: the arm or the motion cannot be built.
    """
    study = Study(scenario, default_variant(scenario, variant))
    points = study.resting(np.stack([_pose(text, study.n) for text in poses])) if poses else study.waypoints()
    return Findings(study, at_points(study, points), _names(study, points, poses), remarks(study), poses), points


def with_charts(
    found: Findings,
    points: Points,
    joints: tuple[int, int] | None = None,
    size: int = 50,
    advance: Callable[[], None] = lambda: None,
) -> Findings:
    """The same with all that is drawn.

    Args:
        found: margins.
        points: their operating points.
        joints: indices of the two joints that the map moves.
        size: angles of each of them.
        advance: called after each row of the map, and after each of `CURVES` charts.

    Raises:
        ScenarioError: there are no such joints.
    """
    study = found.study
    rows = sorted({*np.linspace(0, len(points.q) - 1, min(_DRAWN, len(points.q))).round().astype(int).tolist()})
    some = points.part(np.array(rows))
    pair = check_joints(study, joints)

    def done(chart: _T) -> _T:
        advance()
        return chart

    one = None if pair is None else workspace(study, pair, (size, size), advance)
    charts = Charts(
        rows=rows,
        latency=done(None if study.ideal else over_latency(study, some)),
        period=done(None if study.ideal else over_period(study, some)),
        poles=None if study.ideal else np.linalg.eigvals(study.close(study.linear(some)).at_gain(np.ones(len(rows)))),
        course=done(along(study)),
        map=one,
        alike=[pair is not None and _alike(study, q, pair) for q in points.q],
    )
    return Findings(study, found.points, found.names, found.remarks, found.poses, charts)


def check_joints(study: Study, joints: tuple[int, int] | None) -> tuple[int, int] | None:
    """The two joints of the map: those asked for, or a pair that moves the tool in a vertical plane.

    Raises:
        ScenarioError: the arm has no such two joints.
    """
    if joints is None:
        return None if study.n < 2 else default_joints(study)
    if study.n < 2:
        raise ScenarioError(f"--joints {joints[0] + 1},{joints[1] + 1}: a map moves two joints, and the arm has one")
    a, b = joints
    if not (0 <= a < study.n and 0 <= b < study.n and a != b):
        raise ScenarioError(f"--joints {a + 1},{b + 1}: must be two different joints of 1 to {study.n}")
    return joints


def record(found: Findings) -> dict[str, Any]:
    """For `stability.json`: margins, and all that the numbers depend on."""
    scenario = found.scenario
    charts = found.charts
    course = None if charts is None else charts.course
    return {
        "name": scenario.name,
        "variant": found.variant,
        "points": points_as_objects(found),
        "remarks": list(found.remarks),
        "motion": None
        if course is None
        else {
            "worst_t": float(course.t[course.worst]),
            "worst_gain_margin": _finite(course.gain_margin[course.worst]),
            "worst_spectral_radius": _finite(course.spectral_radius[course.worst]),
            "growth_per_period_over_a_cycle": course.floquet,
        },
        "map_joints": None if charts is None or charts.map is None else [j + 1 for j in charts.map.joints],
        "source": scenario.source,
        "scenario": scenario.text,
        "overrides": dict(scenario.overrides),
        "settings": scenario.resolved(found.variant),
        "versions": versions(),
    }


def points_as_objects(found: Findings) -> list[Mapping[str, Any]]:
    """Margins with the names of their points; what is infinite or unknown is None."""
    return [{"name": name, **row} for name, row in zip(found.names, as_object(list(found.points)), strict=True)]


def _names(study: Study, points: Points, poses: Sequence[str]) -> list[str]:
    if poses:
        return [f"pose {k + 1}" for k in range(len(poses))]
    if hasattr(study.settings.trajectory, "waypoints"):
        return [f"waypoint {k + 1}" for k in range(len(points.t))]
    return [f"t = {t:.2f} s" for t in points.t]


def _pose(text: str, n: int) -> Array:
    try:
        pose = np.array([float(part) for part in text.split(",")])
    except ValueError:
        raise ScenarioError(f"--pose {text}: must be {n} angles [rad] with commas, e.g. {_example(n)}") from None
    if len(pose) != n or not np.isfinite(pose).all():
        raise ScenarioError(f"--pose {text}: the arm has {n} joints; give {n} angles [rad], e.g. {_example(n)}")
    return pose


def _example(n: int) -> str:
    return ",".join(["0", *(["0.5"] * (n - 1))])


def _alike(study: Study, q: Array, pair: tuple[int, int]) -> bool:
    """Whether the pose lies on the map: elbow on its side, and the other joints alike.

    The first joint may differ where its axis is vertical, for turning the whole arm changes nothing.
    """
    here = study.waypoints().q[0]
    upright = abs(study.blocks.arm.kinematics.frames(here).z[0, 2]) > 1.0 - 1e-6
    others = [j for j in range(int(upright), study.n) if j not in pair]
    same_side = (q[pair[1]] >= 0) == (here[pair[1]] >= 0)
    return bool(same_side and np.allclose(q[others], here[others], atol=1e-6))


def _finite(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None
