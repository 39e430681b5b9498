"""A sweep on a Dask cluster of real processes: the same table, whatever is killed on the way."""

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from sweep_rig import finish, rows, write

from lwa4d_sim.errors import SweepError
from lwa4d_sim.sweep import cluster as sweep_cluster
from lwa4d_sim.sweep.cluster import Cluster
from lwa4d_sim.sweep.work import environment

pytestmark = pytest.mark.slow  # a cluster needs some seconds to start
ROOT = Path(__file__).parent.parent
LAW = """
import time
class Slow:
    def __init__(self, kp):
        self.kp = kp
        time.sleep(0.3)
    def torque(self, state, ref, model):
        return self.kp * (ref.q - state.q) - state.dq + model.at(state.q).h
"""
SLOW = {"controller": {"kind": "slow_law_of_cluster:Slow", "kp": 10.0}}
AXES = {"controller.kp": {"from": 5, "to": 20, "count": 40}}


class Dask:
    """A scheduler and some workers, each a process group of its own."""

    def __init__(self, folder: Path, workers: int) -> None:
        self._folder = folder
        (folder / "slow_law_of_cluster.py").write_text(LAW)
        self.environ = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join([str(ROOT), str(folder)]),
            "DASK_DISTRIBUTED__WORKER__DAEMON": "false",
        }
        self._file = folder / "scheduler.json"
        self.scheduler = self._start("scheduler", "--port", "0", "--host", "127.0.0.1", "--no-dashboard")
        self._wait(self._file.exists)
        self.workers = [self.worker(k) for k in range(workers)]
        self.address = self._address()

    def worker(self, k: int) -> "subprocess.Popen[bytes]":
        place = str(self._folder / str(k))
        return self._start("worker", "--nthreads", "1", "--no-dashboard", "--local-directory", place)

    def _start(self, *what: str) -> "subprocess.Popen[bytes]":
        command = [sys.executable, "-m", "dask", *what, "--scheduler-file", str(self._file)]
        with (self._folder / "dask.log").open("ab") as log:
            return subprocess.Popen(command, env=self.environ, stdout=log, stderr=log, start_new_session=True)

    def _address(self) -> str:
        address: str = json.loads(self._file.read_text())["address"]
        return address

    @staticmethod
    def _wait(ready: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 60
        while not ready():
            assert time.monotonic() < deadline
            time.sleep(0.1)

    def ready(self, count: int) -> None:
        """Wait for so many workers."""
        import distributed

        client: Any = distributed.Client  # which has no types
        with client(self.address, set_as_default=False) as there:
            there.wait_for_workers(count, timeout=60)

    def end(self) -> None:
        for process in (*self.workers, self.scheduler):
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[Dask]:
    made = Dask(tmp_path, 2)
    try:
        made.ready(2)
        yield made
    finally:
        made.end()


def begun(dask: Dask, path: Path, out: Path) -> "subprocess.Popen[str]":
    """A sweep on its way on the cluster, with some parts finished."""
    sweep = ["sweep", str(path), "-o", str(out), "--no-plots", "--cluster", dask.address]
    command = [sys.executable, "-m", "lwa4d_sim", *sweep]
    process = subprocess.Popen(command, env=dask.environ, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    deadline = time.monotonic() + 60
    while len(list((out / "s" / "parts").glob("*.parquet"))) < 2:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return process


def test_a_cluster_gives_the_same_table_and_other_software_is_refused(
    dask: Dask, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path)
    expected = finish(path, tmp_path / "here").table.read_bytes()
    assert finish(path, tmp_path / "there", Cluster(dask.address)).table.read_bytes() == expected
    real = environment()
    monkeypatch.setattr(sweep_cluster, "environment", Fake({**real, "mujoco": "9.9"}))
    with pytest.raises(SweepError, match=rf"^worker tcp://.* has mujoco {real['mujoco']}, this computer has 9\.9; "):
        finish(path, tmp_path / "never", Cluster(dask.address))
    assert not (tmp_path / "never").exists()


class Fake:
    """Versions of this computer alone: what is sent to a worker answers with the worker's own."""

    def __init__(self, versions: dict[str, str]) -> None:
        self._versions = versions

    def __call__(self) -> dict[str, str]:
        return self._versions

    def __reduce__(self) -> Any:
        return getattr, (sys.modules[environment.__module__], "environment")


def test_a_worker_or_the_client_killed_loses_nothing(
    dask: Dask, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    path, out = write(tmp_path, SLOW, axes=AXES), tmp_path / "out"
    client = begun(dask, path, out)
    os.killpg(dask.workers[0].pid, signal.SIGKILL)  # with its nanny, so that nobody starts it anew
    time.sleep(1.0)
    client.kill()
    client.communicate()
    kept = {part.name: part.read_bytes() for part in (out / "s" / "parts").glob("*.parquet")}
    assert 2 <= len(kept) < 40
    second = begun(dask, path, out)
    dask.workers.append(dask.worker(7))
    _, said = second.communicate(timeout=120)
    assert second.returncode == 0, said
    assert f"40 runs, {len(rows_of(kept))} of them are there" in said
    assert {row["status"] for row in rows(finish(path, out))} == {"ok"}
    for name, content in kept.items():
        assert (out / "s" / "parts" / name).read_bytes() == content


def rows_of(parts: dict[str, bytes]) -> list[Any]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    return [row for content in parts.values() for row in pq.ParquetFile(pa.BufferReader(content)).read().to_pylist()]


def test_a_dead_scheduler_is_one_line_within_ten_seconds(dask: Dask, tmp_path: Path) -> None:
    path, out = write(tmp_path, SLOW, axes=AXES), tmp_path / "out"
    process = begun(dask, path, out)
    os.killpg(dask.scheduler.pid, signal.SIGKILL)
    start = time.monotonic()
    _, said = process.communicate(timeout=30)
    assert time.monotonic() - start < 10
    assert process.returncode == 2
    told = [line for line in said.splitlines() if not line.startswith("40 runs")]
    kept = "finished parts are kept, the same command goes on from there"
    assert told == [f"lwa4d-sim: cluster {dask.address}: the scheduler is gone; {kept}"]
    start = time.monotonic()
    with pytest.raises(SweepError, match=rf"^cluster {dask.address}: no Dask scheduler answers there within 6 s$"):
        finish(path, out, Cluster(dask.address))
    assert time.monotonic() - start < 10


@pytest.mark.parametrize("address", ["foo://bar", "http://x:80", "garbage", "", "tcp://no such host:1"])
def test_an_address_that_is_none(address: str) -> None:
    with pytest.raises(SweepError, match="must be an address such as tcp://host:8786"), Cluster(address):
        pass


def test_a_scheduler_without_workers_says_how_to_start_some(tmp_path: Path) -> None:
    made = Dask(tmp_path, 0)
    try:
        words = f"has no workers; start some: dask worker {made.address}"
        with pytest.raises(SweepError, match=words), Cluster(made.address):
            pass
    finally:
        made.end()


def test_what_listens_but_is_no_scheduler(tmp_path: Path) -> None:
    path = write(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        command = [sys.executable, "-m", "lwa4d_sim", "sweep", str(path), "-o", str(tmp_path), "--cluster", address]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert done.stderr == f"lwa4d-sim: cluster {address}: no Dask scheduler answers there within 6 s\n"
