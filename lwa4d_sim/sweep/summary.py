"""What a finished sweep comes to: how many runs are stable, how sure that is, and which run is the worst."""

from typing import Any

from lwa4d_sim.sweep.design import WorstCase
from lwa4d_sim.sweep.file import Sweep
from lwa4d_sim.sweep.folder import Folder
from lwa4d_sim.sweep.search import duration, score
from lwa4d_sim.sweep.statistics import wilson
from lwa4d_sim.sweep.table import columns, metric_of, read


def summarise(sweep: Sweep, folder: Folder) -> dict[str, Any]:
    """Counts, pass rate and worst runs of a finished sweep.

    Returns:
        ``{"name", "folder", "table", "runs", "stable", "errors", "error", "pass_rate": {"estimate", "low", "high"},
        "worst": {NAME: {"run", "point", "metric", "value"}}}``.
    """
    rows = _rows(sweep, folder)
    good = [row for row in rows if row["status"] == "ok"]
    bad = [row for row in rows if row["status"] != "ok"]
    stable = [row for row in good if row["stable"]]
    low, high = wilson(len(stable), len(good))
    return {
        "name": sweep.name,
        "folder": str(folder.path),
        "table": str(folder.table),
        "runs": len(rows),
        "stable": len(stable),
        "errors": len(bad),
        "error": bad[0]["message"] if bad else None,
        "pass_rate": {"estimate": len(stable) / len(good) if good else None, "low": low, "high": high},
        "worst": _worst(sweep, good, stable),
    }


def _rows(sweep: Sweep, folder: Folder) -> list[dict[str, Any]]:
    """The runs, with the columns that are asked for here; with all of them a long sweep takes ten times the memory."""
    design = sweep.settings.design
    measure = design.objective if isinstance(design, WorstCase) else "max_error"
    wanted = {"run", "status", "message", "stable", "unstable_since", "diverged_at", *sweep.axes}
    names = [name for name in columns(folder.table) if name in wanted or metric_of(name) == measure]
    rows: list[dict[str, Any]] = read(folder.table, names).to_pylist()
    return rows


def _worst(sweep: Sweep, good: list[dict[str, Any]], stable: list[dict[str, Any]]) -> dict[str, Any]:
    """The runs worth a look of their own."""
    design = sweep.settings.design
    if isinstance(design, WorstCase):
        if not good:
            return {}
        worst = max(good, key=lambda row: score(row, design.objective, duration(sweep)))
        name = design.objective if worst["stable"] else "unstable_since"
        value = score(worst, name, duration(sweep)) if worst["stable"] else worst.get("unstable_since")
        return {"worst_case": _named(sweep, worst, name, value)}
    found = {}
    measure = "max_error" if "max_error" in sweep.metrics else None
    ranked = [row for row in stable if measure and row.get(measure) is not None]
    if measure and ranked:
        worst = max(ranked, key=lambda row: row[measure])
        found["largest_error"] = _named(sweep, worst, measure, worst[measure])
    if len(stable) < len(good):
        first = next(row for row in good if not row["stable"])
        found["first_unstable"] = _named(sweep, first, "unstable_since", first.get("unstable_since"))
    return found


def _named(sweep: Sweep, row: dict[str, Any], metric: str, value: Any) -> dict[str, Any]:
    return {"run": row["run"], "point": {axis: row[axis] for axis in sweep.axes}, "metric": metric, "value": value}
