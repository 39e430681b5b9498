"""What a worker does: runs some points of a sweep in lock step and answers with a row for each."""

import json
import platform
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from lwa4d_sim.assembly import versions
from lwa4d_sim.documents import one_line
from lwa4d_sim.errors import LwaError, SweepError
from lwa4d_sim.record import RunLog
from lwa4d_sim.runner import run_together
from lwa4d_sim.scenario import Scenario


@dataclass(frozen=True, kw_only=True)
class Task:
    """Some runs that can be stepped together, as plain data that travels to any computer.

    Attributes:
        text, source, folder, overrides: of the scenario.
        variant: of the scenario.
        metrics: asked for.
        runs: (number, overrides) of each.
        versions: of the software that asks.
    """

    text: str
    source: str
    folder: str
    overrides: Mapping[str, Any]
    variant: str
    metrics: tuple[str, ...]
    runs: tuple[tuple[int, Mapping[str, Any]], ...]
    versions: Mapping[str, str]

    def part(self, start: int, stop: int) -> "Task":
        """The same for some of its runs."""
        return Task(**{**self.__dict__, "runs": self.runs[start:stop]})


@dataclass(frozen=True, slots=True)
class Answer:
    """Rows of a task's runs, in their order, what they cost [s], and the memory of one record [bytes]."""

    rows: tuple[Mapping[str, Any], ...]
    seconds: float
    record: int


def environment() -> dict[str, str]:
    """Versions that a row's numbers may depend on."""
    return {"python": ".".join(platform.python_version_tuple()[:2]), **versions()}


def check_versions(asked: Mapping[str, str], who: str, found: Mapping[str, str]) -> None:
    """Compare a worker's software with that of the one who asks.

    Raises:
        SweepError: something differs; names both.
    """
    for name, version in asked.items():
        if found.get(name) != version:
            raise SweepError(
                f"{who} has {name} {found.get(name)}, this computer has {version}; install the same on both"
            )


def work(task: Task) -> Answer:
    """Run a task.

    Raises:
        SweepError: this worker's software is not that of the one who asks.
    """
    check_versions(task.versions, f"worker on {platform.node()}", environment())
    start = time.perf_counter()
    scenario = _scenario(task.text, task.source, task.folder, json.dumps(dict(task.overrides)))
    rows, record = _rows(task, scenario)
    return Answer(tuple(rows), time.perf_counter() - start, record)


@lru_cache(maxsize=4)
def _scenario(text: str, source: str, folder: str, overrides: str) -> Scenario:
    """The scenario of a sweep's tasks, read once in each worker."""
    return Scenario.parse(text, source=source, folder=Path(folder), overrides=json.loads(overrides))


def _rows(task: Task, scenario: Scenario) -> tuple[list[Mapping[str, Any]], int]:
    try:
        logs = run_together([scenario.changed(own, task.variant) for _, own in task.runs], task.variant, threads=1)
    except Exception as error:  # a user's own controller may raise anything
        if len(task.runs) == 1:
            return [failure(task.runs[0][0], _reason(error))], 0
        # one of them spoils it for all: each by itself, with the same bits
        alone = [_rows(task.part(k, k + 1), scenario) for k in range(len(task.runs))]
        return [row for rows, _ in alone for row in rows], max(record for _, record in alone)
    return [
        {"run": run, **_measured(log, task.metrics), "status": "ok", "message": ""}
        for (run, _), log in zip(task.runs, logs, strict=True)
    ], max(log.q.nbytes for log in logs) * 3


def _reason(error: Exception) -> str:
    return one_line(str(error) if isinstance(error, LwaError) else f"{type(error).__name__}: {error}")


def _measured(log: RunLog, names: Sequence[str]) -> dict[str, Any]:
    values = log.metrics()
    return {name: values[name] for name in names}


def failure(run: int, message: str) -> dict[str, Any]:
    """The row of a run that could not be made."""
    return {"run": run, "status": "error", "message": message}
