"""Processes at work on a sweep: any may be killed, and so may the one that waits for them."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from sweep_rig import Here, finish, load, rows, write

from lwa4d_sim.errors import SweepError
from lwa4d_sim.sweep.tasks import task_of
from lwa4d_sim.sweep.work import Task, check_versions, environment, work
from lwa4d_sim.sweep.workers import Processes

ROOT = Path(__file__).parent.parent
LAW = """
import os, pathlib, time
class Law:
    def __init__(self, kp, folder, how):
        self.kp, self.marks, self.how = kp, pathlib.Path(folder), how
        if how == "die" or (how == "die once" and self._first()):
            os.kill(os.getpid(), 9)
        if how == "slow":
            time.sleep(0.5)
    def _first(self):
        try:
            self.marks.joinpath("died").touch(exist_ok=False)
        except FileExistsError:
            return False
        return True
    def torque(self, state, ref, model):
        return self.kp * (ref.q - state.q) - state.dq + model.at(state.q).h
"""


@pytest.fixture
def laws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Name of a module of laws that this process and its workers can import."""
    name = f"laws_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(LAW)
    monkeypatch.syspath_prepend(tmp_path)
    return name


def own(laws: str, folder: Path, how: str) -> dict[str, Any]:
    return {"controller": {"kind": f"{laws}:Law", "kp": 10.0, "folder": str(folder), "how": how}}


def test_processes_give_what_one_gives(tmp_path: Path) -> None:
    path = write(tmp_path)
    expected = finish(path, tmp_path / "one").table.read_bytes()
    assert finish(path, tmp_path / "two", Processes(2)).table.read_bytes() == expected


def test_a_worker_that_is_killed_loses_nothing(laws: str, tmp_path: Path) -> None:
    axes = {"controller.how": {"values": ["", "die once"]}, "controller.kp": {"values": [5, 9]}}
    path = write(tmp_path, own(laws, tmp_path, ""), axes=axes)
    table = rows(finish(path, tmp_path / "out", Processes(2)))
    assert (tmp_path / "died").exists()
    assert [row["status"] for row in table] == ["ok"] * 4


def test_a_run_that_kills_every_worker_is_an_error_row(laws: str, tmp_path: Path) -> None:
    axes = {"controller.how": {"values": ["", "die"]}}
    table = rows(finish(write(tmp_path, own(laws, tmp_path, ""), axes=axes), tmp_path / "out", Processes(2)))
    assert [row["status"] for row in table] == ["ok", "error"]
    assert "was killed 3 times" in table[1]["message"]


def test_an_idle_worker_that_was_killed_is_replaced(tmp_path: Path) -> None:
    sweep = load(write(tmp_path))
    task = task_of(sweep, list(sweep.points(1)))
    with Processes(1) as workers:
        workers.submit(0, task)
        [first] = workers.finished()
        assert first.answer is not None
        for process in workers._idle:
            os.kill(int(process._process.pid or 0), signal.SIGKILL)
            process._process.join()
        workers.submit(1, task)
        [dead] = workers.finished()
        assert dead == (1, None)
        workers.submit(2, task)
        [again] = workers.finished()
        assert again.answer is not None
        assert again.answer.rows == first.answer.rows


def test_a_worker_with_other_software_refuses() -> None:
    with pytest.raises(SweepError, match=r"^w has mujoco 3\.9, this computer has 4\.0; install the same on both$"):
        check_versions({"python": "3.11", "mujoco": "4.0"}, "w", {"python": "3.11", "mujoco": "3.9"})
    check_versions(environment(), "w", environment())


def test_a_task_says_what_software_asks(tmp_path: Path) -> None:
    sweep = load(write(tmp_path))
    task = task_of(sweep, list(sweep.points(1)))
    other = Task(**{**task.__dict__, "versions": {**task.versions, "numpy": "0.1"}})
    with pytest.raises(SweepError, match=r"has numpy .*, this computer has 0\.1"):
        work(other)
    with Processes(1) as workers:
        workers.submit(0, other)
        with pytest.raises(SweepError, match="has numpy"):
            workers.finished()


def command(path: Path, out: Path, *more: str) -> list[str]:
    return [sys.executable, "-m", "lwa4d_sim", "sweep", str(path), "-o", str(out), "--no-plots", *more]


def begun(path: Path, out: Path, laws: Path, *more: str) -> "subprocess.Popen[str]":
    """A sweep on its way, with at least one part finished."""
    environ = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(laws)])}
    process = subprocess.Popen(
        command(path, out, "-j", "2", *more), env=environ, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    deadline = time.monotonic() + 60
    while len(list((out / "s" / "parts").glob("*.parquet"))) < 2:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return process


def slow(laws: str, folder: Path) -> Path:
    """A sweep of 16 runs, each of half a second, one at a time, for they differ in their law."""
    axes = {"controller.kp": {"from": 5, "to": 20, "count": 16}}
    return write(folder, own(laws, folder, "slow"), axes=axes)


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_sweep_goes_on_where_it_was(how: signal.Signals, laws: str, tmp_path: Path) -> None:
    path, out = slow(laws, tmp_path), tmp_path / "out"
    process = begun(path, out, tmp_path)
    group = process.pid
    if how is signal.SIGINT:
        os.killpg(group, how)  # as Ctrl-C does: everybody in the terminal hears it
        _, said = process.communicate(timeout=10)
        assert process.returncode == 130
        assert said.splitlines()[-1] == "lwa4d-sim: interrupted; finished results are kept"
        assert "Traceback" not in said
    else:
        process.kill()
        process.communicate(timeout=10)
    deadline = time.monotonic() + 20
    while subprocess.run(["pgrep", "-g", str(group)], capture_output=True).returncode == 0:  # no worker is left behind
        assert time.monotonic() < deadline
        time.sleep(0.1)
    kept = sum(1 for _ in (out / "s" / "parts").glob("*.parquet"))
    assert kept >= 2
    (tmp_path / "small.yaml").write_text((tmp_path / "small.yaml").read_text())
    here = Here()
    table = rows(finish(path, out, here))
    assert len(table) == 16
    assert {row["status"] for row in table} == {"ok"}
    assert 0 < sum(map(len, here.tasks)) < 16


def test_workers_that_cannot_start_are_told_of_once(tmp_path: Path) -> None:
    """A script without the guard that new processes need: each of them would run it again."""
    path = write(tmp_path)
    paths = [str(ROOT), str(ROOT / "tests")]
    (script := tmp_path / "script.py").write_text(
        f"import sys\nsys.path[:0] = {paths!r}\n"
        "from pathlib import Path\nfrom lwa4d_sim.errors import SweepError\nfrom sweep_rig import finish\n"
        "from lwa4d_sim.sweep.workers import Processes\n"
        f"try:\n    finish(Path({str(path)!r}), Path({str(tmp_path / 'out')!r}), Processes(1))\n"
        "except SweepError as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=60)
    assert done.stdout.startswith(
        "worker processes end as soon as they start; a script of your own must call this under"
    )
    assert len(done.stdout.splitlines()) == 1
