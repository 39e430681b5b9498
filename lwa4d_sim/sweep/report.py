"""The page about a finished sweep: figures, percentiles, and the worst runs once more in full, one click away."""

import shlex
import shutil
from collections.abc import Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from lwa4d_sim.metrics import FLAGS, METRICS
from lwa4d_sim.page import write_page
from lwa4d_sim.results import run_scenario
from lwa4d_sim.sweep.design import RangeAxis, WorstCase
from lwa4d_sim.sweep.file import Sweep
from lwa4d_sim.sweep.folder import WORST, Folder
from lwa4d_sim.sweep.plots import Curve, Runs, draw_sweep
from lwa4d_sim.sweep.table import made, metric_of, read
from lwa4d_sim.sweep.work import environment

_PERCENTILES = (0, 50, 95, 99, 100)


def report(sweep: Sweep, folder: Folder, summary: Mapping[str, Any], boundary: Curve | None = None) -> Path:
    """Write the page and the worst runs' own reports.

    Args:
        sweep: what was run.
        folder: where its table is.
        summary: see `sweep.summary.summarise`.
        boundary: a curve over the maps; see `sweep.plots.draw_heat_map`.

    Raises:
        RecordError: something cannot be written.
    """
    for old in folder.path.glob("*.png"):
        old.unlink()
    runs = _runs(sweep, folder)
    path = folder.path / "report.html"
    write_page(
        path,
        "sweep.html.j2",
        summary=summary,
        headline=_headline(summary),
        figures=draw_sweep(runs, folder.path, boundary) if len(runs.stable) else [],
        percentiles=_percentiles(runs),
        worst=_worst(sweep, folder, summary),
        command=f"lwa4d-sim sweep {shlex.quote(sweep.source)}",
        versions=environment(),
        table=folder.table.name,
        source=sweep.source,
        text=sweep.text,
    )
    return path


def _headline(summary: Mapping[str, Any]) -> str:
    made = summary["runs"] - summary["errors"]
    if not made:
        return "No run could be made."
    if summary["stable"] == made:
        return f"All {made:,} runs are stable."
    return f"{summary['stable']:,} of {made:,} runs are stable ({100 * summary['stable'] / made:.1f} %)."


def _runs(sweep: Sweep, folder: Folder) -> Runs:
    """The runs that could be made."""
    table = made(read(folder.table))
    axes: dict[str, Any] = {}
    for name in sweep.axes:
        values = table[name].to_pylist()
        plain = all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values)
        axes[name] = np.asarray(values, float) if plain else [str(value) for value in values]
    own = [c for c in table.column_names if metric_of(c) in METRICS and c not in FLAGS and c not in axes]
    metrics = {name: np.array(table[name].to_numpy(zero_copy_only=False), float) for name in own}
    log = frozenset(name for name, axis in sweep.axes.items() if isinstance(axis, RangeAxis) and axis.scale == "log")
    return Runs(sweep.name, axes, np.array(table["stable"].to_pylist(), bool), metrics, log)


def _percentiles(runs: Runs) -> list[tuple[str, str, list[float]]]:
    out = []
    for name, values in runs.metrics.items():
        known = values[runs.stable & np.isfinite(values)]
        if known.size:
            out.append((name, METRICS[metric_of(name)][0], np.percentile(known, _PERCENTILES).tolist()))
    return out


def _worst(sweep: Sweep, folder: Folder, summary: Mapping[str, Any]) -> dict[str, str]:
    """Run the worst runs once more in full; links to their reports by name."""
    shutil.rmtree(folder.path / WORST, ignore_errors=True)
    links = {}
    for name, run in summary["worst"].items():
        if isinstance(sweep.settings.design, WorstCase):
            point = sweep.point(run["run"], tuple(run["point"].values()))
        else:
            point = next(islice(sweep.points(), run["run"], None))
        scenario = sweep.check_point(point)
        # the expectations were made for other settings
        run_scenario(replace(scenario, name=name, expect={}), folder.path / WORST, plots=True)
        links[name] = f"{WORST}/{name}/report.html"
    return links
