"""One self-contained HTML page about one or several finished scenarios."""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from lwa4d_sim.drawing import Picture
from lwa4d_sim.errors import RecordError
from lwa4d_sim.expect import Outcome
from lwa4d_sim.metrics import METRICS
from lwa4d_sim.page import number, write_page
from lwa4d_sim.plots import draw_all, pictures
from lwa4d_sim.record import RunLog
from lwa4d_sim.verdict import Run, headline, remarks

_T = TypeVar("_T")
_KINDS: Mapping[type, str] = {dict: "a mapping", list: "a list", str: "text", bool: "true or false"}


@dataclass(frozen=True, kw_only=True)
class Section:
    """One scenario on the page.

    Attributes:
        title: usually the scenario's name.
        runs: each variant.
        scenario: text of the scenario file.
        source: that file.
        overrides: by dotted key, as given on the command line.
        versions: of the software.
        figures: to embed, in order.
    """

    title: str
    runs: Mapping[str, Run]
    scenario: str = ""
    source: str = "scenario.yaml"
    overrides: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    figures: Sequence[Picture] = ()

    @property
    def outcomes(self) -> list[tuple[str, Outcome]]:
        """(variant, expectation checked), of all variants."""
        return [(name, outcome) for name, run in self.runs.items() for outcome in run.outcomes]

    @property
    def failed(self) -> int:
        """Number of expectations that do not hold."""
        return sum(not outcome.passed for _, outcome in self.outcomes)

    @property
    def verdict(self) -> str:
        """passed, failed, or none where nothing is expected."""
        return "none" if not self.outcomes else "failed" if self.failed else "passed"

    @property
    def badge(self) -> str:
        """The verdict in words."""
        n = len(self.outcomes)
        if not n:
            return "no expectations"
        met = f"{n} expectation{'s' if n > 1 else ''}"
        return f"{self.failed} of {met} failed" if self.failed else f"{met} met"

    @property
    def headline(self) -> str:
        """What happened, in one sentence."""
        return headline(self.runs)

    @property
    def remarks(self) -> list[str]:
        """What else the numbers say."""
        return remarks(self.runs)

    @property
    def metrics(self) -> list[tuple[str, str, str, list[Any]]]:
        """(name, unit, meaning, value of each variant) of every metric that some variant has."""
        columns = [run.metrics for run in self.runs.values()]
        return [
            (name, unit, meaning, [column.get(name) for column in columns])
            for name, (unit, meaning) in METRICS.items()
            if any(name in column for column in columns)
        ]

    @property
    def events(self) -> list[tuple[float, str, str]]:
        """(time [s], variant, text), in order of time."""
        return sorted((t, name, text) for name, run in self.runs.items() for t, text in run.events)

    @property
    def command(self) -> str:
        """The command line that gives these numbers again."""
        changes = [f"--set {shlex.quote(f'{key}={json.dumps(value)}')}" for key, value in self.overrides.items()]
        return " ".join(["lwa4d-sim run", shlex.quote(self.source), *changes])


def section_from_folder(folder: Path) -> Section:
    """What a finished run's folder holds; figures are drawn into it if it has none.

    Raises:
        RecordError: something is missing or malformed; the message names it.
    """
    path = folder / "summary.json"
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RecordError(f"{folder}: not a finished run: cannot read summary.json ({error.strerror})") from error
    except ValueError as error:
        raise RecordError(f"{path}: not valid JSON ({error})") from error
    variants = _entry(summary, "variants", dict, path)
    if not variants:
        raise RecordError(f"{path}: 'variants' is empty; a run has at least one")
    logs = {name: RunLog.load(folder / f"{name}.h5") for name in variants}
    runs = {}
    for name, variant in variants.items():
        at = f"{path}: variant '{name}'"
        checks = _entry(_entry(variant, "expect", dict, at), "checks", list, at)
        outcomes = [
            Outcome(_entry(c, "key", str, at), c.get("bound"), c.get("value"), _entry(c, "passed", bool, at))
            for c in checks
        ]
        runs[name] = Run.of(logs[name], _entry(variant, "metrics", dict, at), outcomes)
    return Section(
        title=_entry(summary, "name", str, path),
        runs=runs,
        scenario=_entry(summary, "scenario", str, path),
        source=_entry(summary, "source", str, path),
        overrides=_entry(summary, "overrides", dict, path),
        versions=_entry(summary, "versions", dict, path),
        figures=pictures(folder) or [*draw_all(logs, folder), *_buses(logs, folder)],
    )


def _buses(logs: Mapping[str, RunLog], folder: Path) -> list[Picture]:
    if all(log.frames is None for log in logs.values()):
        return []
    from lwa4d_sim.bus_plots import draw_buses  # and with it python-can

    return draw_buses(logs, folder)


def _entry(data: Any, key: str, kind: type[_T], where: Any) -> _T:
    value = data.get(key) if isinstance(data, dict) else None
    if not isinstance(value, kind):
        raise RecordError(f"{where}: '{key}' is missing or not {_KINDS[kind]}; run the scenario again")
    return value


def write_report(path: Path, sections: Sequence[Section]) -> None:
    """Write the page, whole or not at all.

    Raises:
        RecordError: a figure cannot be read or the page cannot be written.
    """
    write_page(path, "report.html.j2", filters={"bound": bound}, sections=sections)


def bound(outcome: Outcome) -> str:
    """An expectation as people write it: final_error ≤ 0.01 m."""
    name, _, side = outcome.key.rpartition("_")
    if name not in METRICS or side not in ("max", "min"):
        return f"{outcome.key} = {number(outcome.bound)}"
    return f"{name} {'≤' if side == 'max' else '≥'} {number(outcome.bound)} {METRICS[name][0]}".rstrip()
