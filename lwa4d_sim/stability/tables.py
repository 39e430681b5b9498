"""The data behind the pictures of a stability analysis, as CSV files whose headings name the units."""

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lwa4d_sim.interfaces import Array
from lwa4d_sim.stability.analysis import Curve
from lwa4d_sim.stability.findings import Charts, Findings
from lwa4d_sim.stability.maps import Slice
from lwa4d_sim.stability.motion import Course


def write_tables(found: Findings, charts: Charts, folder: Path) -> None:
    """Write a CSV file for each picture; `inf` is no limit, an empty cell no number."""
    names = [found.names[k] for k in charts.rows]
    for curve, stem, what in (
        (charts.latency, "latency", "extra latency of the commands [s]"),
        (charts.period, "period", "control period [s]"),
    ):
        if curve is not None:
            _write(folder / f"{stem}.csv", [what, *_over("critical factor on all gains", names)], _curve(curve))
    if charts.poles is not None:
        heading = ["operating point", "real part [1]", "imaginary part [1]"]
        _write(folder / "eigenvalues.csv", heading, _poles(charts.poles, names))
    joints = range(1, found.study.n + 1)
    shares = [f"share of joint {j} [1]" for j in joints]
    _write(
        folder / "modes.csv",
        ["operating point", "critical factor on all gains [1]", "frequency [Hz]", *shares],
        (
            [name, p.gain_margin, p.mode.frequency, *p.mode.share]
            for name, p in zip(found.names, found.points, strict=True)
        ),
    )
    angles = [f"q{j} [rad]" for j in joints]
    _write(
        folder / "motion.csv",
        ["time [s]", *angles, "spectral radius [1]", "critical factor on all gains [1]"],
        _course(charts.course),
    )
    if charts.map is not None:
        a, b = charts.map.joints
        heading = [f"q{a + 1} [rad]", f"q{b + 1} [rad]", "x [m]", "y [m]", "z [m]"]
        heading += ["critical factor on all gains [1]", "frequency [Hz]", "joint that moves most"]
        _write(folder / "workspace.csv", heading, _map(charts.map))


def _over(what: str, names: Sequence[str]) -> list[str]:
    return [f"{what} at {name} [1]" for name in names]


def _curve(curve: Curve) -> Array:
    return np.column_stack([curve.x, curve.critical])


def _poles(poles: Any, names: Sequence[str]) -> Iterable[list[Any]]:
    for name, values in zip(names, poles, strict=True):
        yield from ([name, value.real, value.imag] for value in values)


def _modes(found: Findings) -> Iterable[list[Any]]:
    for name, point in zip(found.names, found.points, strict=True):
        yield [name, point.gain_margin, point.mode.frequency, *point.mode.share]


def _course(course: Course) -> Array:
    return np.column_stack([course.t, course.q, course.spectral_radius, course.gain_margin])


def _map(one: Slice) -> Iterable[list[Any]]:
    for i, first in enumerate(one.first):
        for k, second in enumerate(one.second):
            joint = int(one.limiting[i, k])
            yield [
                first,
                second,
                *one.x[i, k],
                one.gain_margin[i, k],
                one.frequency[i, k],
                joint + 1 if joint >= 0 else "",
            ]


def _write(path: Path, heading: Sequence[str], rows: Iterable[Iterable[Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow(heading)
        table.writerows([_cell(value) for value in row] for row in rows)


def _cell(value: Any) -> Any:
    if isinstance(value, float):  # NumPy's too
        return "" if np.isnan(value) else f"{value:.10g}"
    return value
