"""The folder that the command `stability` writes: data, pictures and a page, whole or not at all."""

import json
from pathlib import Path

from lwa4d_sim.folders import claim, written_whole
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.stability.findings import Findings, record
from lwa4d_sim.stability.map_plot import draw_map
from lwa4d_sim.stability.plots import draw_findings
from lwa4d_sim.stability.report import write_stability_page
from lwa4d_sim.stability.tables import write_tables
from lwa4d_sim.stability.words import details, headline

_OURS = (".csv", ".html", ".json", ".png")  # what such a folder may hold, and what the next one replaces


def claim_for(scenario: Scenario, out: Path) -> Path:
    """The folder for a scenario's results in ``out``, see `folders.claim`."""
    return claim(out / f"{scenario.name}-stability", _OURS)


def write_findings(folder: Path, found: Findings) -> None:
    """Write everything.

    Raises:
        RecordError: something cannot be written.
    """
    with written_whole(folder) as partial:
        data = {**record(found), "verdict": headline(found), "details": details(found)}
        (partial / "stability.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
        charts = found.charts
        if charts is not None:
            write_tables(found, charts, partial)
            figures = draw_findings(found, charts, partial)
            if charts.map is not None:
                figures.insert(
                    sum(c is not None for c in (charts.latency, charts.period)),
                    draw_map(found, charts, charts.map, partial),
                )
            write_stability_page(partial / "report.html", found, figures)
