"""Benchmarks of many runs and of the stability analysis: what a chart costs, and how cost grows."""

import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from mujoco.batch import Batch

from lwa4d_sim.batch import default_workers
from lwa4d_sim.console import shipped_scenarios
from lwa4d_sim.mjcf import load_model
from lwa4d_sim.runner import run
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.stability.maps import workspace
from lwa4d_sim.stability.study import Study

PROGRAM = [sys.executable, "-m", "lwa4d_sim"]
CHART, RUNS, STEPS = "gain_latency", 1024, 20_000
_SAMPLE = 16  # of the separate processes that are timed, in place of all 1,024
_TOGETHER = 128  # arms whose states are recorded at once, as a sweep's tasks do


def timed(*command: str, cwd: str) -> float:
    begin = time.perf_counter()
    subprocess.run(command, check=True, capture_output=True, cwd=cwd)
    return time.perf_counter() - begin


def raw_chart() -> float:
    """Wall time [s] of `Batch.rollout` on all processors for as many steps of the chart's arm."""
    scenario = Scenario.load(shipped_scenarios() / "pd_joint_p1.25.yaml")
    settings = scenario.variants["can"]
    model = load_model(settings.arm, timestep=0.001, integrator="RK4")
    start = np.asarray(settings.initial.q)
    control = np.broadcast_to(run(scenario, "can").tau[:STEPS], (_TOGETHER, STEPS, 3))
    batch = Batch(model, _TOGETHER, default_workers())
    qpos, qvel = batch.bind("qpos"), batch.bind("qvel")
    begin = time.perf_counter()
    for _ in range(RUNS // _TOGETHER):
        qpos[:], qvel[:] = start, 0.0
        batch.rollout(STEPS, control, record=("qpos",))
    return time.perf_counter() - begin


def chart() -> tuple[float, float]:
    """The shipped 32 x 32 sweep as a command, table only, between two rounds of raw stepping."""
    with tempfile.TemporaryDirectory() as folder:
        before = raw_chart()
        ours = timed(*PROGRAM, "sweep", CHART, "--no-plots", "-o", folder, cwd=folder)
        base = 0.5 * (before + raw_chart())
    return ours / base, base


def processes() -> tuple[float, float]:
    """The sweep as it is / 1,024 `lwa4d-sim run` as they are, as many at a time as processors; a sample is timed."""
    with tempfile.TemporaryDirectory() as folder:
        ours = timed(*PROGRAM, "sweep", CHART, "-o", folder, cwd=folder)
        command = [*PROGRAM, "run", "pd_joint_p1.25", "--set", "variants={can: {}}", "--set", "expect={}"]
        begin = time.perf_counter()
        for first in range(0, _SAMPLE, default_workers()):
            group = [
                subprocess.Popen([*command, "-o", f"{folder}/{first + k}"], stdout=subprocess.DEVNULL)
                for k in range(default_workers())
            ]
            assert not any(process.wait() for process in group)
        separate = (time.perf_counter() - begin) * RUNS / _SAMPLE
    return ours / separate, separate


def _many(folder: str, count: int) -> tuple[float, float]:
    """Processor time a run [s] and peak memory of the largest process [B] of a sweep of short runs."""
    name = f"many_{count}"
    (Path(folder) / f"{name}.yaml").write_text(
        f"name: {name}\nscenario: pd_joint_p1.25\nvariant: can\nset: {{trajectory.segment_time: 0.05}}\n"
        f"design: {{kind: random, samples: {count}, seed: 1}}\n"
        "axes: {p: {from: 0.5, to: 1.5, keys: {controller.kp: 1, controller.kd: 1.6667}}}\n"
    )
    code = (
        "import resource, subprocess, sys; subprocess.run(sys.argv[1:], check=True, capture_output=True);"
        "u = resource.getrusage(resource.RUSAGE_CHILDREN); print(u.ru_utime + u.ru_stime, u.ru_maxrss)"
    )
    command = [sys.executable, "-c", code, *PROGRAM, "sweep", f"{name}.yaml", "--no-plots", "-o", "runs"]
    done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=folder)
    seconds, peak = map(float, done.stdout.split())
    return seconds, peak * 1024


def linear() -> tuple[float, float]:
    """Processor time of a further run between 8,192 and 16,384 runs / between 64 and 4,096."""
    with tempfile.TemporaryDirectory() as folder:
        times = {count: _many(folder, count)[0] for count in (64, 4096, 8192, 16384)}
    early = (times[4096] - times[64]) / (4096 - 64)
    late = (times[16384] - times[8192]) / (16384 - 8192)
    return late / early, early


def flat() -> tuple[float, float]:
    """Peak memory of the largest process with 16,384 runs / with 64."""
    with tempfile.TemporaryDirectory() as folder:
        few, many = _many(folder, 64)[1], _many(folder, 16384)[1]
    return many / few, few / 1e6


@contextmanager
def dask(workers: int) -> Iterator[str]:
    """Address of a scheduler with so many workers of one thread."""
    module = "from distributed.cli.dask_{0} import main; main()"
    ports = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--no-show"]
    scheduler = subprocess.Popen(
        [sys.executable, "-c", module.format("scheduler"), *ports], stderr=subprocess.PIPE, text=True
    )
    assert scheduler.stderr is not None
    address = next(found[0] for line in scheduler.stderr if (found := re.search(r"tcp://[\d.]+:\d+", line)))
    single = ["--nthreads", "1", "--no-nanny", "--no-dashboard"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    started = [
        subprocess.Popen(
            [sys.executable, "-c", module.format("worker"), address, *single],
            stderr=subprocess.DEVNULL,
            env=environment,
            text=True,
        )
        for _ in range(workers)
    ]
    try:
        from distributed import Client

        connect: Any = Client  # it has no types
        with connect(address) as client:
            client.wait_for_workers(workers)
            client.run(_import_everything)  # the first task would wait for that
        yield address
    finally:
        everyone: list[subprocess.Popen[str]] = [*started, scheduler]
        for process in everyone:
            process.terminate()
            process.wait()
        scheduler.stderr.close()


def _import_everything() -> None:
    import lwa4d_sim.runner  # noqa: F401


def workers() -> tuple[float, float]:
    """A quarter of the chart on two Dask workers / on one."""
    text = (shipped_scenarios().parent / "sweeps" / f"{CHART}.yaml").read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "quarter.yaml").write_text(text.replace("count: 32", "count: 16"))
        times = []
        for count in (1, 2):
            with dask(count) as address:
                command = [*PROGRAM, "sweep", "quarter.yaml", "--no-plots", "--cluster", address, "-o", str(count)]
                times.append(timed(*command, cwd=folder))
    return times[1] / times[0], times[0]


def pose() -> tuple[float, float]:
    """Milliseconds for one pose of the 3-DOF arm: linearised, closed, spectral radius. A study is made once."""
    study = Study(Scenario.load(shipped_scenarios() / "pd_joint_p1.25.yaml"), "can")
    q = study.waypoints().q[:1]
    one, row = np.ones(1), np.arange(1)
    times = []
    for _ in range(300):
        begin = time.perf_counter()
        study.close(study.linear(study.resting(q))).radius(row, one)
        times.append(time.perf_counter() - begin)
    return 1e3 * float(np.median(times)), 1e-3


def workspace_map() -> tuple[float, float]:
    """Seconds for critical gains and modes at 50 x 50 poses of the 7-DOF arm under PD+G."""
    study = Study(Scenario.load(shipped_scenarios() / "pd7_joint.yaml"), "can")
    begin = time.perf_counter()
    workspace(study)
    return time.perf_counter() - begin, 1.0
