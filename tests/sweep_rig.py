"""What the tests of sweeps share: small files, a worker without a process, and the table of a finished sweep."""

import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from lwa4d_sim.errors import SweepError
from lwa4d_sim.sweep.file import Sweep
from lwa4d_sim.sweep.folder import Folder, run_sweep
from lwa4d_sim.sweep.work import Task, work
from lwa4d_sim.sweep.workers import Done, Workers

SCENARIO: dict[str, Any] = {
    "name": "small",
    "arm": "lwa4d_3dof",
    "initial": {"q": [-1.5, -1.2, 1.5]},
    "trajectory": {
        "waypoints": {"space": "joint", "points": [[-1.4, -1.1, 1.6], [-1.5, -1.2, 1.5]]},
        "segment_time": 0.05,
    },
    "controller": {"kind": "pd_gravity", "kp": 20.0, "kd": 5.0},
    "loop": {"period": 0.01},
    "variants": {"can": {}, "late": {"loop": {"actuation": "next_sync"}}, "ideal": {"loop": {"kind": "ideal"}}},
}
AXES: dict[str, Any] = {
    "p": {"from": 10, "to": 40, "count": 4, "keys": {"controller.kp": 1, "controller.kd": 0.25}},
    "loop.latency": {"from": 0, "to": 0.012, "count": 3},
    "plant.payload.mass": {"values": [0.1, 2]},
}


def write(folder: Path, changes: dict[str, Any] | None = None, /, **keys: Any) -> Path:
    """A sweep file (JSON is YAML) and its changed scenario in ``folder``; a key given as None is left out."""
    (folder / "small.yaml").write_text(json.dumps({**SCENARIO, **(changes or {})}))
    document = {"name": "s", "scenario": "small.yaml", "axes": AXES, **keys}
    path = folder / "sweep.yaml"
    path.write_text(json.dumps({key: value for key, value in document.items() if value is not None}, indent=0))
    return path


def load(path: Path) -> Sweep:
    return Sweep.load(path, path.parent / "shipped")


class Here:
    """A worker without a process.

    Args:
        size: what it says about itself, which decides how runs are cut into tasks.
        stop: after how many tasks it is interrupted, as by Ctrl-C.
        deaths: how many times the task with a run dies.
    """

    def __init__(self, size: int = 1, stop: int | None = None, deaths: dict[int, int] | None = None) -> None:
        self.size, self._stop, self._deaths = size, stop, dict(deaths or {})
        self.tasks: list[list[int]] = []
        self._held: list[tuple[int, Task]] = []

    @property
    def room(self) -> int:
        return self.size - len(self._held)

    def submit(self, ticket: int, task: Task) -> None:
        self._held.append((ticket, task))

    def finished(self) -> list[Done]:
        if self._stop is not None and len(self.tasks) >= self._stop:
            raise KeyboardInterrupt
        ticket, task = self._held.pop()  # the last one in: answers need not come in order
        runs = [run for run, _ in task.runs]
        self.tasks.append(runs)
        for run in runs:
            if self._deaths.get(run, 0):
                self._deaths[run] -= 1
                return [Done(ticket, None)]
        return [Done(ticket, work(task))]

    def __enter__(self) -> "Here":
        return self

    def __exit__(self, *why: Any) -> None:
        pass


def finish(path: Path, out: Path, workers: Workers | None = None, **options: Any) -> Folder:
    with workers or Here() as hands:
        return run_sweep(load(path), out, hands, **options)


def rows(folder: Folder) -> list[dict[str, Any]]:
    table: list[dict[str, Any]] = pq.ParquetFile(folder.table).read().to_pylist()
    return table


__all__ = ["AXES", "SCENARIO", "Here", "SweepError", "finish", "load", "rows", "write"]
