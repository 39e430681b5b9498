"""Batches: outcomes in order, a JUnit file, and one bad scenario never stops the rest."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

from lwa4d_sim.batch import Job, check_writable, describe, find_scenarios, run_files, write_junit
from lwa4d_sim.errors import RecordError, ScenarioError
from lwa4d_sim.results import run_scenario
from lwa4d_sim.scenario import Scenario

ROOT = Path(__file__).parent.parent

SMALL: dict[str, Any] = {
    "name": "small",
    "arm": "lwa4d_3dof",
    "trajectory": {"waypoints": {"space": "joint", "points": [[-1.5, -1.5, 1.5]]}, "segment_time": 0.1},
    "controller": {"kind": "pd_gravity", "kp": 10.0, "kd": 5.0},
}

# Laws of a user that fail in every way a law can.
LAWS = """
import os
import numpy as np
class Law:
    def torque(self, state, ref, model): return 0.0 * state.q
class Raises(Law):
    def torque(self, state, ref, model): raise ZeroDivisionError("my\\nfault")
class Dies(Law):
    def torque(self, state, ref, model): os._exit(9)
class Shape(Law):
    def torque(self, state, ref, model): return [1.0]
class Nan(Law):
    def torque(self, state, ref, model): return state.q * float("nan")
class Huge(Law):
    def torque(self, state, ref, model): return np.full_like(state.q, np.inf)
"""


def write(folder: Path, name: str, **changes: Any) -> Path:
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump({**SMALL, "name": name, **changes}))
    return path


@pytest.fixture
def laws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Name of a module of laws that this process and its workers can import."""
    name = f"laws_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(LAWS)
    monkeypatch.syspath_prepend(str(tmp_path))
    return name


def outcomes(files: list[Path], workers: int = 1, out: Path | None = None) -> list[Job]:
    return list(run_files(files, out, plots=False, workers=workers))


def test_files_are_found_in_order_and_once(tmp_path: Path) -> None:
    b, a = write(tmp_path, "b"), write(tmp_path, "a")
    c = tmp_path / "c.yml"
    c.touch()
    (tmp_path / "notes.txt").touch()
    (tmp_path / "d.yaml").mkdir()
    assert find_scenarios([tmp_path]) == [a, b, c]
    assert find_scenarios([b, tmp_path, b]) == [b, a, c]
    (tmp_path / "x.txt").write_text("name: x")
    assert find_scenarios([tmp_path / "x.txt"]) == [tmp_path / "x.txt"]  # asked for by name


@pytest.mark.parametrize("place", ["nothere", "d.yaml"])
def test_a_place_without_scenarios_is_an_error(place: str, tmp_path: Path) -> None:
    (tmp_path / "d.yaml").mkdir()
    with pytest.raises(ScenarioError, match=place):
        find_scenarios([tmp_path / place])


def test_verdicts(tmp_path: Path) -> None:
    files = [
        write(tmp_path, "passes", expect={"default": {"stable": True}}),
        write(tmp_path, "fails", expect={"default": {"max_error_max": 0.0}}),
        write(tmp_path, "wrong", arm="nothere.xml"),
        write(tmp_path, "diverges", plant={"disturbances": [{"at": 0.05, "force": [1e8, 0, 0]}]}),
        tmp_path / "missing.yaml",
    ]
    jobs = outcomes(files)
    assert [job.verdict for job in jobs] == ["passed", "failed", "error", "passed", "error"]
    assert [job.file for job in jobs] == files
    assert str(jobs[2].error).startswith(f"{files[2]}:1: arm (='nothere.xml'): ")
    assert "No such file" in str(jobs[4].error)
    diverged = jobs[3].summary
    assert diverged is not None
    assert diverged["variants"]["default"]["metrics"]["diverged_at"] < 0.1
    json.dumps(diverged, allow_nan=False)


def test_many_processes_give_what_one_gives(tmp_path: Path) -> None:
    files = [write(tmp_path, f"s{i}", plant={"seed": i}, loop={"jitter": 0.003}) for i in range(2)]
    files.append(write(tmp_path, "bad", controller={"kind": "pid"}))
    serial, parallel = outcomes(files), outcomes(files, workers=2)
    assert [job.error for job in serial] == [job.error for job in parallel]
    assert [job.summary for job in serial] == [job.summary for job in parallel]
    alone = run_scenario(Scenario.load(files[0]))
    assert alone == serial[0].summary


@pytest.mark.parametrize(
    ("law", "words"),
    [
        ("Raises", "ZeroDivisionError: my\\nfault"),
        ("Shape", "returned shape (1,)"),
        ("Missing", "has no attribute 'Missing'"),
    ],
)
def test_a_users_law_that_fails_fails_alone(law: str, words: str, laws: str, tmp_path: Path) -> None:
    bad = write(tmp_path, "bad", controller={"kind": f"{laws}:{law}"})
    jobs = outcomes([bad, write(tmp_path, "good")])
    assert [job.verdict for job in jobs] == ["error", "passed"]
    assert str(jobs[0].error).startswith(str(bad))
    assert words in str(jobs[0].error)
    assert str(jobs[0].error).isprintable()


@pytest.mark.parametrize("law", ["Nan", "Huge"])
def test_a_law_that_answers_nonsense_gives_metrics_without_nan(law: str, laws: str, tmp_path: Path) -> None:
    [job] = outcomes([write(tmp_path, "odd", controller={"kind": f"{laws}:{law}"})])
    assert job.error is None
    json.dumps(job.summary, allow_nan=False)


def test_a_worker_that_dies_takes_no_other_scenario_with_it(laws: str, tmp_path: Path) -> None:
    files = [write(tmp_path, name) for name in ("a", "c")]
    files.insert(1, write(tmp_path, "b", controller={"kind": f"{laws}:Dies"}))
    jobs = outcomes(files, workers=2)
    assert [job.verdict for job in jobs] == ["passed", "error", "passed"]
    assert jobs[1].error == f"{files[1]}: the process that ran it was killed; is there enough memory?"


def test_results_are_kept_where_asked_and_nowhere_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    files = [write(tmp_path, "a"), write(tmp_path, "b")]
    outcomes(files)
    assert list(Path().iterdir()) == []
    outcomes(files, out=Path("out"))
    assert sorted(str(path) for path in Path().glob("*/*/*")) == [
        f"out/{name}/{file}" for name in "ab" for file in ("default.h5", "summary.json")
    ]


def test_two_scenarios_of_one_name_cannot_share_a_folder(tmp_path: Path) -> None:
    files = [write(tmp_path, "a"), tmp_path / "twin.yaml", tmp_path / "bad.yaml"]
    files[1].write_text(files[0].read_text())
    files[2].write_text("name: [")
    with pytest.raises(ScenarioError, match=r"a\.yaml and .*twin\.yaml are both named 'a'"):
        outcomes(files, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert [job.verdict for job in outcomes(files)] == ["passed", "passed", "error"]


def test_the_junit_file_counts_and_tells(tmp_path: Path) -> None:
    files = [
        write(tmp_path, "passes", variants={"a": {}, "b": {}}),
        write(tmp_path, "fails", expect={"default": {"max_error_max": 0.0, "rms_error_max": 0.0}}),
        write(tmp_path, "wrong", arm="<&\x1b\x00.xml"),
    ]
    path = tmp_path / "junit.xml"
    write_junit(path, outcomes(files))
    passes, fails, wrong = ElementTree.parse(path).getroot()
    assert [suite.get("name") for suite in (passes, fails, wrong)] == [str(file) for file in files]
    assert [suite.get("tests") for suite in (passes, fails, wrong)] == ["2", "1", "1"]
    assert [suite.get("failures") for suite in (passes, fails, wrong)] == ["0", "1", "0"]
    assert [suite.get("errors") for suite in (passes, fails, wrong)] == ["0", "0", "1"]
    assert [case.get("name") for case in passes] == ["a", "b"]
    failure = fails[0].find("failure")
    assert failure is not None
    assert "max_error_max: asked 0.0, found" in str(failure.get("message"))
    assert "rms_error_max" in str(failure.get("message"))
    error = wrong[0].find("error")
    assert error is not None
    assert "<&\\x1b" in str(error.get("message"))
    assert sorted(entry.name for entry in tmp_path.iterdir() if "junit" in entry.name) == ["junit.xml"]


@pytest.mark.parametrize("place", ["missing/j.xml", "file/j.xml", "folder"])
def test_a_junit_file_that_cannot_be_written_is_told_before_the_work_and_after(place: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    with pytest.raises(RecordError, match="cannot write this file"):
        check_writable(tmp_path / place)
    with pytest.raises(RecordError, match="cannot write the JUnit file"):
        write_junit(tmp_path / place, [])
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["file", "folder"]


def test_looking_whether_a_file_can_be_written_leaves_it_alone(tmp_path: Path) -> None:
    path = tmp_path / "j.xml"
    check_writable(path)
    assert not path.exists()
    path.write_text("old")
    check_writable(path)
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["j.xml"]


def test_an_outcome_is_described_with_few_digits() -> None:
    check = {"key": "final_error_max", "bound": [0.1, None], "value": [0.123456789, None], "passed": False}
    assert describe(check) == "final_error_max: asked [0.1, None], found [0.1235, None]"
    assert (
        describe({"key": "stable", "bound": True, "value": False, "passed": False}) == "stable: asked True, found False"
    )


def test_nobody_need_read_to_the_end(tmp_path: Path) -> None:
    files = [write(tmp_path, f"s{i}") for i in range(4)]
    jobs = run_files(files, None, plots=False, workers=2)
    assert next(jobs).verdict == "passed"
    jobs.close()  # type: ignore[attr-defined]


@pytest.mark.parametrize("workers", [1, 2])
def test_ctrl_c_ends_a_batch_in_one_line_and_keeps_what_is_whole(workers: int, tmp_path: Path) -> None:
    (tmp_path / "all").mkdir()
    write(tmp_path / "all", "a")
    for name in ("b", "c"):
        write(tmp_path / "all", name, trajectory={**SMALL["trajectory"], "segment_time": 30.0})
    command = [sys.executable, "-m", "lwa4d_sim", "batch", "all", "-j", str(workers), "-o", "out"]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(command, cwd=tmp_path, env=environment, start_new_session=True, **pipes)
    until = time.monotonic() + 60
    while not (tmp_path / "out/a").exists() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to the workers as well
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (130, "", "lwa4d-sim: interrupted; finished results are kept\n")
    kept = {folder.name: {file.name for file in folder.iterdir()} for folder in (tmp_path / "out").iterdir()}
    assert kept.keys() >= {"a"}
    assert all(files == {"default.h5", "summary.json"} for files in kept.values())
