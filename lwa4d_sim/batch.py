"""Many scenarios on many processes: outcomes in the order asked, a JUnit file; one bad file never stops the rest."""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from lwa4d_sim.documents import one_line
from lwa4d_sim.errors import LwaError, RecordError, ScenarioError
from lwa4d_sim.results import passed, run_scenario
from lwa4d_sim.scenario import Scenario


@dataclass(frozen=True, slots=True)
class Job:
    """One scenario's outcome: a summary, or the one line that says why there is none."""

    file: Path
    seconds: float
    summary: dict[str, Any] | None
    error: str | None = None

    @property
    def verdict(self) -> str:
        """passed, failed or error."""
        if self.summary is None:
            return "error"
        return "passed" if passed(self.summary) else "failed"


def find_scenarios(places: Sequence[Path]) -> list[Path]:
    """Scenario files: each file given, and every .yaml and .yml directly in each folder given.

    Raises:
        ScenarioError: a place does not exist, or a folder holds no scenario.
    """
    files: list[Path] = []
    for place in places:
        if place.is_dir():
            found = sorted(p for p in place.iterdir() if p.suffix in (".yaml", ".yml") and p.is_file())
            if not found:
                raise ScenarioError(f"{place}: holds no .yaml file")
            files += found
        elif place.exists():
            files.append(place)
        else:
            raise ScenarioError(f"{place}: no such file or folder")
    return list(dict.fromkeys(files))


def run_files(files: Sequence[Path], out: Path | None, *, plots: bool, workers: int) -> Iterator[Job]:
    """Run scenario files on ``workers`` processes; yields outcomes in the order of ``files``.

    Raises:
        ScenarioError: two of them would write the same folder.
    """
    if out is not None:
        _check_names(files)
    if workers <= 1 or len(files) <= 1:
        yield from (_run_file(file, out, plots) for file in files)
        return
    pool, futures = _submit(files, out, plots, min(workers, len(files)))
    with pool:
        try:
            for file, future in zip(files, futures, strict=True):
                try:
                    yield future.result()
                except BrokenExecutor:  # some worker was killed, and took the pool with it: the file gets its own
                    yield _run_alone(file, out, plots)
        except BaseException:  # interrupted, or nobody wants the rest
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _submit(
    files: Sequence[Path], out: Path | None, plots: bool, workers: int
) -> tuple[ProcessPoolExecutor, list[Future[Job]]]:
    """Processes at work on ``files``. They leave Ctrl-C to this one, so that what they write is whole."""
    with deaf():
        # spawned, because a forked copy of a process with running threads may hang
        pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"))
        return pool, [pool.submit(_run_file, file, out, plots) for file in files]


@contextmanager
def deaf() -> Iterator[None]:
    """Processes started in here do not hear Ctrl-C: ignoring it is inherited."""
    # only the main thread hears of Ctrl-C and may say what to do about it
    heard = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, signal.SIG_IGN) if heard else None
    try:
        yield
    finally:
        if heard:
            signal.signal(signal.SIGINT, before)


def _run_alone(file: Path, out: Path | None, plots: bool) -> Job:
    pool, [future] = _submit([file], out, plots, 1)
    with pool:
        try:
            return future.result()
        except BrokenExecutor:
            return Job(file, 0.0, None, f"{file}: the process that ran it was killed; is there enough memory?")


def _run_file(file: Path, out: Path | None, plots: bool) -> Job:
    start = time.perf_counter()
    try:
        summary = run_scenario(Scenario.load(file), out, plots=plots)
    except Exception as error:  # a user's own controller may raise anything; the others still run
        kind = "" if isinstance(error, LwaError) else f"{file}: {type(error).__name__}: "
        return Job(file, time.perf_counter() - start, None, one_line(f"{kind}{error}"))
    return Job(file, time.perf_counter() - start, summary)


def _check_names(files: Sequence[Path]) -> None:
    seen: dict[str, Path] = {}
    for file in files:
        try:
            name = Scenario.load(file).name
        except LwaError:
            continue  # told when its turn comes
        if name in seen:
            raise ScenarioError(f"{seen[name]} and {file} are both named '{name}' and would share one folder")
        seen[name] = file


def default_workers() -> int:
    """Processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_writable(path: Path) -> None:
    """Make sure that a file can be written, before hours of work.

    Raises:
        RecordError: it cannot.
    """
    partial = _partial(path)
    if path.is_dir():
        raise RecordError(f"{path}: cannot write this file (it is a folder)")
    try:
        partial.touch()
        partial.unlink()
    except OSError as error:
        raise RecordError(f"{path}: cannot write this file ({error.strerror})") from error


def _partial(path: Path) -> Path:
    """What a file is called until it is whole."""
    return path.with_name(f"{path.name}.part")


def write_junit(path: Path, jobs: Sequence[Job]) -> None:
    """JUnit XML: a suite per file, a case per variant; failed expectations are failures, bad input is an error.

    Raises:
        RecordError: the file cannot be written.
    """
    root = ElementTree.Element("testsuites", name="lwa4d-sim")
    for job in jobs:
        cases = [] if job.summary is None else list(job.summary["variants"].items())
        suite = ElementTree.SubElement(
            root,
            "testsuite",
            name=str(job.file),
            tests=str(max(1, len(cases))),
            failures=str(sum(not variant["expect"]["passed"] for _, variant in cases)),
            errors=str(int(job.summary is None)),
            time=f"{job.seconds:.3f}",
        )
        if job.summary is None:
            case = ElementTree.SubElement(suite, "testcase", classname=job.file.stem, name="load")
            ElementTree.SubElement(case, "error", message=_printable(job.error or ""))
        for name, variant in cases:
            case = ElementTree.SubElement(suite, "testcase", classname=job.file.stem, name=name)
            broken = [describe(check) for check in variant["expect"]["checks"] if not check["passed"]]
            if broken:
                ElementTree.SubElement(case, "failure", message=_printable("; ".join(broken)))
    partial = _partial(path)
    try:
        ElementTree.ElementTree(root).write(partial, encoding="utf-8", xml_declaration=True)
        os.replace(partial, path)
    except OSError as error:
        with suppress(OSError):
            partial.unlink()
        raise RecordError(f"{path}: cannot write the JUnit file ({error.strerror})") from error


def describe(check: dict[str, Any]) -> str:
    """One checked expectation in words: what was asked and what was found."""
    return f"{check['key']}: asked {check['bound']}, found {_rounded(check['value'])}"


def _rounded(value: Any) -> Any:
    if isinstance(value, list):
        return [_rounded(v) for v in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


def _printable(text: str) -> str:
    """XML 1.0 has no control characters."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
