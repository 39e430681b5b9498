"""The speed and memory table of docs/benchmarks.md: ratios within one run, medians of interleaved pairs.

`live` is no ratio but a minute of real time: cycles that the wall clock missed.

Run with `make bench`, or `python -m benchmarks [NAME...]`.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import can
import mujoco
import numpy as np
from mujoco import rollout
from mujoco.batch import Batch

from benchmarks import identification, scale
from lwa4d_sim.batch import default_workers
from lwa4d_sim.bus.live_run import report
from lwa4d_sim.bus.wire import Wire
from lwa4d_sim.console import shipped_scenarios
from lwa4d_sim.mjcf import load_model
from lwa4d_sim.runner import run, run_batch
from lwa4d_sim.scenario import Scenario

# 20 s, 7 joints, physics 1 ms, control 10 ms, RK4 on both sides
OVERRIDES = {"trajectory.segment_time": 5.0}
STEPS = 20_000


def scenario() -> Scenario:
    return Scenario.load(shipped_scenarios() / "ct7_joint.yaml", OVERRIDES)


def torques() -> np.ndarray:
    """The torques of the sampled run, to be replayed without a controller: (STEPS, 7)."""
    return run(scenario(), "can").tau[:STEPS]


def raw(model: mujoco.MjModel, control: np.ndarray) -> Callable[[], None]:
    """The C loop: `mujoco.rollout` on one thread."""
    data = mujoco.MjData(model)
    state = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    data.qpos[:] = start()
    mujoco.mj_getState(model, data, state, full)
    runner = rollout.Rollout(nthread=0)
    return lambda: void(runner.rollout(model, [data], state[None], control[None]))


def void(_: object) -> None:
    """Throw a result away."""


def start() -> np.ndarray:
    return np.asarray(scenario().variants["can"].initial.q)


def ratio(subject: Callable[[], None], against: Callable[[], None], repeats: int) -> tuple[float, float]:
    """Median over interleaved pairs of the time of ``subject`` over that of ``against``, and the latter's median [s].

    Pairs, because a busy computer changes its speed from second to second but seldom between two neighbours.
    """
    times = np.empty((repeats, 2))
    for function in (subject, against):
        function()
    for pair in times:
        for k, function in enumerate((subject, against)):
            begin = time.perf_counter()
            function()
            pair[k] = time.perf_counter() - begin
    return float(np.median(times[:, 0] / times[:, 1])), float(np.median(times[:, 1]))


def sampled() -> tuple[float, float]:
    model, one = load_model("lwa4d_7dof", timestep=0.001, integrator="RK4"), scenario()
    return ratio(lambda: void(run(one, "can")), raw(model, torques()), 25)


def ideal() -> tuple[float, float]:
    model, one = load_model("lwa4d_7dof", timestep=0.001, integrator="RK4"), scenario()
    return ratio(lambda: void(run(one, "ideal")), raw(model, torques()), 9)


def batch_1024() -> tuple[float, float]:
    """1,024 runs, metrics included, against the threaded C loop of the same steps.

    Of 4 s instead of 20 s, so that it ends within minutes; what a run costs beside its steps weighs five times as much.
    """
    n, steps, threads = 1024, 4_000, default_workers()
    one = Scenario.load(shipped_scenarios() / "ct7_joint.yaml", {"trajectory.segment_time": 1.0})
    members = [{"plant.seed": seed} for seed in range(n)]

    def ours() -> None:
        for log in run_batch(one, members, "can", threads=threads):
            log.metrics()

    model = load_model("lwa4d_7dof", timestep=0.001, integrator="RK4")
    control = np.broadcast_to(run(one, "can").tau[:steps], (n, steps, 7))
    batch = Batch(model, n, threads)
    qpos, qvel = batch.bind("qpos"), batch.bind("qvel")

    def limit() -> None:
        qpos[:], qvel[:] = start(), 0.0
        batch.rollout(steps, control, record=("qpos",))

    return ratio(ours, limit, 3)


def command() -> tuple[float, float]:
    """`lwa4d-sim run --no-plots` of one 20 s scenario against the imports plus the raw stepping."""
    text = scenario().text.split("variants:")[0].replace("segment_time: 3.0", "segment_time: 5.0")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "one.yaml"
        file.write_text(text)
        ours = [sys.executable, "-m", "lwa4d_sim", "run", str(file), "--no-plots", "-o", folder]
        imports = [sys.executable, "-c", "import mujoco, numpy, h5py, yaml"]
        step = raw(load_model("lwa4d_7dof", timestep=0.001, integrator="RK4"), torques())

        def floor() -> None:
            subprocess.run(imports, check=True)
            step()

        return ratio(lambda: void(subprocess.run(ours, check=True, capture_output=True)), floor, 9)


def memory() -> tuple[float, float]:
    """Peak bytes per joint and plant step of a 20 s run with its metrics, worst of ideal and can."""
    worst = 0.0
    for variant in ("ideal", "can"):
        one = scenario()
        run(one, variant).metrics()  # what is loaded once is not the run's
        tracemalloc.start()
        run(one, variant).metrics()
        worst = max(worst, tracemalloc.get_traced_memory()[1] / (STEPS * 7))
        tracemalloc.stop()
    return worst, 1.0


def canopen() -> tuple[float, float]:
    """Wall over simulated time of 20 s with 7 joints, SYNC and 28 PDOs every 10 ms; median of five."""
    one = Scenario.load(shipped_scenarios() / "canopen7_live.yaml", OVERRIDES)
    run(one, "canopen")
    times = []
    for _ in range(5):
        begin = time.perf_counter()
        run(one, "canopen")
        times.append(time.perf_counter() - begin)
    return float(np.median(times)) / 20.0, 20.0


def frame() -> tuple[float, float]:
    """One frame over the timed wire, recorded, against python-can's `virtual`: one station sends, another reads."""
    count = 5_000
    msg = can.Message(arbitration_id=0x183, data=bytes(8), is_extended_id=False)

    def wire() -> None:
        medium = Wire(500_000, record=True)
        sender, reader = medium.port("sender"), medium.port("reader")
        exchange(sender, reader)

    def virtual() -> None:
        with can.Bus("benchmark", interface="virtual") as sender, can.Bus("benchmark", interface="virtual") as reader:
            exchange(sender, reader)

    def exchange(sender: can.BusABC, reader: can.BusABC) -> None:
        for _ in range(count):
            sender.send(msg)
            reader.recv(1.0)

    found, base = ratio(wire, virtual, 9)
    return found, base / count


def live() -> tuple[float, float]:
    """Cycles of 10 ms missed by `bus serve` and `bus drive` as two processes over udp_multicast for 60 s."""
    bus = ["-i", "udp_multicast", "-c", f"239.74.163.8:{20_000 + os.getpid() % 20_000}"]
    program = [sys.executable, "-m", "lwa4d_sim", "bus"]
    serve = [*program, "serve", "canopen7_live", *bus]
    with subprocess.Popen(serve, stdout=subprocess.PIPE, text=True) as arm:
        assert arm.stdout is not None
        arm.stdout.readline()
        drive = [*program, "drive", "canopen7_live", *bus, "--arm", "--json", "--seconds", "60"]
        done = subprocess.run(drive, capture_output=True, text=True)
        arm.send_signal(signal.SIGINT)
    found = json.loads(done.stdout)
    print(report(found) + "\n")
    return (found["missed"] if found["ended"] == "done" else float("inf")), found["lateness"]["p99"]


BENCHMARKS: dict[str, tuple[Callable[[], tuple[float, float]], str, float]] = {
    "sampled": (sampled, "one 20 s sampled run / raw C loop", 1.5),
    "ideal": (ideal, "one 20 s ideal run / raw C loop", 5.0),
    "batch": (batch_1024, "1,024 sampled runs in one batch / raw threaded loop", 1.25),
    "command": (command, "lwa4d-sim run --no-plots / imports and raw loop", 2.5),
    "memory": (memory, "peak bytes per joint and plant step", 40.0),
    "canopen": (canopen, "20 s over the CANopen cycle: wall / simulated time", 0.1),
    "frame": (frame, "a frame on the timed wire / on python-can's virtual", 1.0),
    "chart": (scale.chart, "32 x 32 chart of 20 s runs / raw threaded loop", 1.25),
    "processes": (scale.processes, "the same chart / 1,024 lwa4d-sim run processes", 0.1),
    "linear": (scale.linear, "a run more at 16,384 / at 64 to 4,096", 1.2),
    "flat": (scale.flat, "peak memory with 16,384 runs / with 64", 1.3),
    "workers": (scale.workers, "a sweep on two Dask workers / on one", 0.59),
    "pose": (scale.pose, "stability of one pose, milliseconds", 1.0),
    "map": (scale.workspace_map, "critical gains of 50 x 50 poses of 7 joints, seconds", 10.0),
    "regressor": (identification.regressor, "100,000 7-joint regressors / Pinocchio from Python", 3.0),
    "minute": (identification.minute, "7 joints identified from 60 s at 1 kHz, seconds", 30.0),
    "design": (identification.design, "a motion of 7 joints and 5 harmonics found, seconds", 180.0),
    "live": (live, "cycles missed in 60 s of bus serve and bus drive", 0.0),
}


def main() -> None:
    names = sys.argv[1:] or list(BENCHMARKS)
    print(f"MuJoCo {mujoco.__version__}, {default_workers()} processors\n")
    print(
        f"| {'what':52} | {'limit':>6} | {'found':>6} | {'base [s]':>8} |\n|{'-' * 54}|{'-' * 8}|{'-' * 8}|{'-' * 10}|"
    )
    for name in names:
        function, what, limit = BENCHMARKS[name]
        found, base = function()
        print(f"| {what:52} | {limit:6.2f} | {found:6.3g} | {base:8.3g} |", flush=True)


if __name__ == "__main__":
    main()
