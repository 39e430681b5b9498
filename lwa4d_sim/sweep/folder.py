"""A sweep from its file to its folder: what is there already is kept, the rest is run, one table comes out."""

import json
import os
import shutil
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lwa4d_sim.errors import RecordError, SweepError
from lwa4d_sim.sweep import table as tables
from lwa4d_sim.sweep.design import WorstCase
from lwa4d_sim.sweep.file import Point, Sweep
from lwa4d_sim.sweep.search import search
from lwa4d_sim.sweep.tasks import FIRST, Cost, cut, groups, task_of, work_off
from lwa4d_sim.sweep.work import Answer, environment
from lwa4d_sim.sweep.workers import Workers

LIMIT = 20_000  # runs, unless the user asks for more
TABLE, PARTS, ABOUT, COPY, WORST = "runs.parquet", "parts", "sweep.json", "sweep.yaml", "worst"
_OURS = (TABLE, PARTS, ABOUT, COPY, WORST, "report.html")  # what a sweep's folder may hold, beside pictures


class Watch:
    """Who is told how far a sweep is; this one does not listen."""

    def begin(self, runs: int, kept: int, cost: Cost, size: int) -> None:
        """``runs`` in all, of which ``kept`` are there; what one costs; on how many processes."""

    def advance(self, runs: int) -> None:
        """So many more runs are done."""


@dataclass(frozen=True)
class Folder:
    """The folder of one sweep's results.

    Attributes:
        path: of the folder.
    """

    path: Path

    @staticmethod
    def open(sweep: Sweep, out: Path, *, fresh: bool) -> "Folder":
        """The sweep's folder, made or found again.

        Raises:
            SweepError: it holds another sweep, or something no sweep wrote.
            RecordError: it cannot be written.
        """
        folder = Folder(out / sweep.name)
        about = {"identity": sweep.identity(), "versions": environment()}
        try:
            if folder.path.exists():
                folder._claim(about, fresh=fresh)
            (folder.path / PARTS).mkdir(parents=True, exist_ok=True)
            for stale in (folder.path / PARTS).glob("*.part"):
                stale.unlink()
            folder._put(COPY, sweep.text)
            folder._put(ABOUT, json.dumps(about, indent=1) + "\n")
        except OSError as error:
            raise RecordError(f"{folder.path}: cannot write results here ({error}); choose another with -o") from error
        return folder

    def _claim(self, about: Mapping[str, Any], *, fresh: bool) -> None:
        foreign = [e.name for e in self.path.iterdir() if e.name not in _OURS and e.suffix not in (".png", ".part")]
        if foreign:
            raise SweepError(f"{self.path}: holds '{foreign[0]}', which no sweep wrote; choose another folder with -o")
        if fresh:
            shutil.rmtree(self.path)
            return
        try:
            before = json.loads((self.path / ABOUT).read_text(encoding="utf-8"))
        except FileNotFoundError:  # nothing there yet, or the disk was full
            before = {} if self.parts() or self.table.exists() else about
        except ValueError:
            before = {}
        if before.get("identity") != about["identity"]:
            raise SweepError(
                f"{self.path}: holds another sweep; throw it away with --fresh, or choose a folder with -o"
            )
        for name, version in about["versions"].items():
            was = before["versions"].get(name)
            if was != version:
                raise SweepError(f"{self.path}: begun with {name} {was}, this is {version}; start again with --fresh")

    def _put(self, name: str, text: str) -> None:
        partial = self.path / f"{name}.part"
        try:
            partial.write_text(text, encoding="utf-8")
            os.replace(partial, self.path / name)
        except OSError:
            partial.unlink(missing_ok=True)
            raise

    @property
    def table(self) -> Path:
        """The finished table."""
        return self.path / TABLE

    def parts(self) -> list[Path]:
        """Finished parts."""
        return sorted((self.path / PARTS).glob("*.parquet"))

    def keep(self, points: Sequence[Point], rows: Sequence[Mapping[str, Any]]) -> None:
        """Write a part.

        Raises:
            RecordError: it cannot be written.
        """
        runs = ",".join(str(point.run) for point in points)
        good = "" if all(row["status"] == "ok" for row in rows) else "-errors"
        # named by its runs, so that no two different parts are named alike, and the same part always is
        name = f"{points[0].run:09d}-{zlib.crc32(runs.encode()):08x}{good}.parquet"
        tables.write(self.path / PARTS / name, tables.part(points, rows))

    def done(self) -> set[int]:
        """Runs that some part holds; those that failed are to be tried again."""
        found: set[int] = set()
        for path in self.parts():
            rows = tables.read(path, ["run", "status"])
            pairs = zip(rows["run"].to_pylist(), rows["status"].to_pylist(), strict=True)
            found.update(run for run, status in pairs if status == "ok")
        return found


def run_sweep(
    sweep: Sweep, out: Path, workers: Workers, *, limit: int = LIMIT, fresh: bool = False, watch: Watch | None = None
) -> Folder:
    """Run what is not there yet and write the table.

    Args:
        sweep: what to run.
        out: folder that the sweep's own folder goes into.
        workers: where.
        limit: most runs.
        fresh: throw away what the folder holds.
        watch: told how far it is.

    Raises:
        SweepError: too many runs, another sweep's folder, or the workers are gone; finished parts are kept.
        RecordError: something cannot be written; finished parts are kept.
        ScenarioError: axis values that do not fit the scenario; nothing is written.
    """
    watch = watch or Watch()
    sweep.check_first()
    if sweep.count > limit:
        raise SweepError(_too_many(sweep, limit, workers))
    if isinstance(sweep.settings.design, WorstCase):
        for corner in sweep.points():
            sweep.check_point(corner)
        folder = Folder.open(sweep, out, fresh=fresh)
        points = search(sweep, _evaluator(sweep, folder, workers, watch))
    else:
        points = list(sweep.points())
        parts = groups(sweep, points)
        folder = Folder.open(sweep, out, fresh=fresh)
        done = folder.done()
        left = [[point for point in part if point.run not in done] for part in parts]
        _run(sweep, folder, [part for part in left if part], len(points), workers, watch)
    tables.write(folder.table, tables.merge(folder.parts(), points))
    return folder


def _run(sweep: Sweep, folder: Folder, parts: list[list[Point]], total: int, workers: Workers, watch: Watch) -> None:
    """Run groups of points; the first few tell how many to put together."""
    if not parts:
        return
    left = sum(map(len, parts))
    first = parts[0][:FIRST]
    by_run = {point.run: point for part in parts for point in part}
    cost = None
    for answer in work_off([task_of(sweep, first)], workers):
        _keep(folder, by_run, answer)
        cost = Cost.of(answer) if cost is None else cost
    assert cost is not None
    watch.begin(total, total - left, cost, workers.size)
    watch.advance(len(first))
    rest = [part for part in (parts[0][FIRST:], *parts[1:]) if part]
    pieces = cut(rest, cost.together(left - len(first), workers.size))
    for answer in work_off((task_of(sweep, piece) for piece in pieces), workers):
        _keep(folder, by_run, answer)
        watch.advance(len(answer.rows))


def _keep(folder: Folder, points: Mapping[int, Point], answer: Answer) -> None:
    folder.keep([points[row["run"]] for row in answer.rows], answer.rows)


def _evaluator(
    sweep: Sweep, folder: Folder, workers: Workers, watch: Watch
) -> Callable[[Sequence[Point]], list[Mapping[str, Any]]]:
    """A function that gives the rows of some points, from the parts where they are there."""
    kept: dict[int, Mapping[str, Any]] = {}
    for path in folder.parts():
        kept.update({row["run"]: row for row in tables.read(path).to_pylist() if row["status"] == "ok"})
    begun = False

    def evaluate(points: Sequence[Point]) -> list[Mapping[str, Any]]:
        nonlocal begun
        new = [point for point in points if point.run not in kept]
        by_run = {point.run: point for point in new}
        size = -(-len(new) // workers.size)
        pieces = cut(groups(sweep, new), max(1, min(size, 64)))
        for answer in work_off((task_of(sweep, piece) for piece in pieces), workers):
            if not begun:
                begun = True
                watch.begin(sweep.count, len(kept), Cost.of(answer), workers.size)
            _keep(folder, by_run, answer)
            made = tables.part([by_run[row["run"]] for row in answer.rows], answer.rows).to_pylist()
            kept.update({row["run"]: row for row in made})
            watch.advance(len(answer.rows))
        return [kept[point.run] for point in points]

    return evaluate


def _too_many(sweep: Sweep, limit: int, workers: Workers) -> str:
    """Why not, and what it would cost."""
    points = list(sweep.points(FIRST))
    part = groups(sweep, points)[0]
    [answer, *_] = work_off([task_of(sweep, part)], workers)
    seconds = Cost.of(answer).seconds * sweep.count / workers.size
    many = f"{sweep.count:,} runs are more than the limit of {limit:,}"
    return (
        f"{sweep.source}: {many}; they take about {spell(seconds)} on {processes(workers.size)}; raise it with --limit"
    )


def processes(size: int) -> str:
    """1 process, 2 processes."""
    return f"{size} process{'' if size == 1 else 'es'}"


def spell(seconds: float) -> str:
    """A duration in words, to two digits or so."""
    for unit, name in ((86_400, "days"), (3_600, "h"), (60, "min")):
        if seconds >= 1.5 * unit:
            value = seconds / unit
            return f"{value:.1f} {name}" if value < 10 else f"{value:.0f} {name}"
    return f"{max(1.0, seconds):.0f} s"
