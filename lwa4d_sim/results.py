"""One scenario run to its folder of results, written whole or not at all."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lwa4d_sim.assembly import versions
from lwa4d_sim.expect import evaluate
from lwa4d_sim.folders import claim, written_whole
from lwa4d_sim.mjcf import model_path
from lwa4d_sim.record import RunLog
from lwa4d_sim.runner import measure, run_all
from lwa4d_sim.scenario import Scenario

_OURS = (".gif", ".h5", ".html", ".json", ".png")  # what a run's folder may hold, and what its next run replaces


def run_scenario(scenario: Scenario, out: Path | None = None, *, plots: bool = False) -> dict[str, Any]:
    """Run all variants, check expectations and, with ``out``, write the folder ``out/NAME``.

    Args:
        scenario: what to run.
        out: folder that the scenario's own folder goes into; None writes nothing.
        plots: draw plots and the HTML report as well.

    Returns:
        The summary: ``{"name", "variants": {NAME: {"metrics", "expect": {"passed", "checks"}}}, "folder", ...}``.

    Raises:
        ScenarioError and other LwaErrors: bad input, nothing is written.
        RecordError: the folder cannot be written.
    """
    folder = None if out is None else claim(out / scenario.name, _OURS)
    logs = run_all(scenario)
    summary = summarise(scenario, logs)
    if folder is not None:
        summary["folder"] = str(folder)
        _write(folder, scenario, logs, summary, plots)
    return summary


def summarise(scenario: Scenario, logs: Mapping[str, RunLog]) -> dict[str, Any]:
    """Metrics, expectations and provenance of a finished scenario."""
    variants = {}
    for name, values in measure(logs).items():
        checks = evaluate(scenario.expect.get(name) or {}, values)
        variants[name] = {
            "metrics": values,
            "expect": {"passed": all(check.passed for check in checks), "checks": [asdict(check) for check in checks]},
            "seed": logs[name].seed,
            "stopped": _stopped(logs[name]),
        }
    arms = {arm for one in scenario.variants.values() for arm in (one.arm, one.controller.model.arm) if arm is not None}
    return {
        "name": scenario.name,
        "variants": variants,
        "folder": None,
        "source": scenario.source,
        "scenario": scenario.text,
        "overrides": dict(scenario.overrides),
        "versions": versions(),
        "hashes": {
            "scenario": _hash(scenario.text.encode()),
            "document": _hash(json.dumps(scenario.document, sort_keys=True).encode()),
            "models": {arm: _hash(model_path(arm, scenario.folder).read_bytes()) for arm in sorted(arms)},
        },
    }


def _stopped(log: RunLog) -> dict[str, Any] | None:
    return None if log.stopped is None else dict(zip(("at", "why"), log.stopped, strict=True))


def passed(summary: Mapping[str, Any]) -> bool:
    """Whether every expectation of every variant held."""
    return all(variant["expect"]["passed"] for variant in summary["variants"].values())


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _write(folder: Path, scenario: Scenario, logs: Mapping[str, RunLog], summary: dict[str, Any], plots: bool) -> None:
    with written_whole(folder) as partial:
        for name, log in logs.items():
            log.save(partial / f"{name}.h5")
        (partial / "summary.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
        if plots:
            from lwa4d_sim.report import section_from_folder, write_report  # matplotlib costs half a second to import

            write_report(partial / "report.html", [section_from_folder(partial)])
