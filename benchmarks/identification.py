"""Benchmarks of identification: the regressor against Pinocchio's, a whole identification, the design of a motion."""

import tempfile
import time
from dataclasses import replace

import numpy as np

from benchmarks import scale
from lwa4d_sim.console import shipped_scenarios
from lwa4d_sim.errors import LwaError
from lwa4d_sim.identification.experiment import Experiment, noisy
from lwa4d_sim.identification.findings import bias
from lwa4d_sim.identification.regressor import Regressor
from lwa4d_sim.identification.study import convergence, fit_recording, possible
from lwa4d_sim.mjcf import chain_of, load_model, model_path
from lwa4d_sim.scenario import Scenario

SAMPLES = 100_000
SECONDS = 60.0


def regressor() -> tuple[float, float]:
    """100,000 regressors of seven joints / Pinocchio's `computeJointTorqueRegressor` called from Python, both stored.

    Raises:
        LwaError: Pinocchio is not installed.
    """
    try:
        import pinocchio
    except ModuleNotFoundError:
        raise LwaError("the benchmark `regressor` needs Pinocchio: pip install pin") from None
    made = pinocchio.buildModelFromMJCF(str(model_path("lwa4d_7dof")))
    theirs = made[0] if isinstance(made, tuple) else made
    data = theirs.createData()
    model = load_model("lwa4d_7dof")
    ours = Regressor(chain_of(model), model.opt.gravity)
    states = np.random.default_rng(0).uniform(-1.0, 1.0, (3, SAMPLES, 7))

    def loop() -> None:
        out = np.empty((SAMPLES, 7, 70))
        for k, (q, dq, ddq) in enumerate(zip(*states, strict=True)):
            out[k] = pinocchio.computeJointTorqueRegressor(theirs, data, q, dq, ddq)

    pairs = []
    for _ in range(6):  # the first pays for memory that is new to the process
        begin = time.perf_counter()
        ours.torque(*states)
        middle = time.perf_counter()
        loop()
        pairs.append((middle - begin, time.perf_counter() - middle))
    times = np.array(pairs[1:])
    return float(np.median(times[:, 0] / times[:, 1])), float(np.median(times[:, 1]))


def minute() -> tuple[float, float]:
    """Time [s] of identifying the seven-joint arm from a minute at 1 kHz; the data are simulated before."""
    scenario = Scenario.load(
        shipped_scenarios() / "identify_7dof.yaml",
        {"trajectory.duration": SECONDS - 7.0, "variants.ideal.identify.bandwidth": 5.0},
    )
    experiment = Experiment.of(scenario, "ideal")
    recording = noisy(experiment.simulated(), replace(experiment.options.noise, position=1e-5, torque=0.1))
    begin = time.perf_counter()
    found = fit_recording(experiment.problem, recording)
    possible(experiment.problem, found)
    convergence(experiment.problem, found)
    bias(experiment.problem, recording, found)
    taken = time.perf_counter() - begin
    return taken, taken


def design() -> tuple[float, float]:
    """Time [s] of the command `excite` for the seven-joint arm with its usual five harmonics."""
    with tempfile.TemporaryDirectory() as folder:
        taken = scale.timed(*scale.PROGRAM, "excite", "identify_7dof", "-o", folder, cwd=folder)
    return taken, taken
