"""The command `identify`, end to end: the thesis's case, arms with friction, the bus, logs, files, and bad input."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lwa4d_sim import Scenario
from lwa4d_sim.identification.estimate import INTERVAL
from lwa4d_sim.identification.experiment import Experiment, noisy
from lwa4d_sim.identification.findings import covered, validate
from lwa4d_sim.identification.study import fit_recording, possible
from lwa4d_sim.mjcf import load_model

ROOT = Path(__file__).parent.parent
SCENARIOS = ROOT / "scenarios"


def command(*words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "lwa4d_sim", *words], capture_output=True, text=True, cwd=cwd, check=False, timeout=120
    )


def answer(*words: str, cwd: Path) -> Any:
    done = command("identify", *words, "--json", cwd=cwd)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


REAL = {"p1": 0.56644, "p2": 0.16151, "p3": 0.26043, "p4": 20.5931, "p5": 7.78914}  # thesis, Table 5.4


def test_thesis_s_five_parameters_from_ideal_data(tmp_path: Path) -> None:
    found = answer("identify_planar", "--no-plots", cwd=tmp_path)
    assert list(found["parameters"]) == list(REAL)
    for name, row in found["parameters"].items():
        assert row["truth"] == pytest.approx(REAL[name], rel=3e-4)  # the thesis rounds the inertias to four places
        assert row["estimate"] == pytest.approx(row["truth"], rel=1e-5)
    assert max(found["validation"]["nrmse"]) < 1e-4
    assert load_model(str(tmp_path / found["folder"] / "identified.xml")).nv == 2


def test_thesis_s_five_parameters_through_the_bus(tmp_path: Path) -> None:
    """Within a hundredth of a per cent, or the interval holds the truth; the thesis, without a bus, was 14 % off."""
    found = answer("identify_planar_can", "--no-plots", cwd=tmp_path)
    for row in found["parameters"].values():
        wrong = abs(row["estimate"] - row["truth"])
        assert wrong < 1e-4 * row["truth"] or wrong < INTERVAL * row["std_error"]
        assert row["std_error"] < 1e-3 * row["truth"]
    assert max(found["validation"]["nrmse"]) < 2e-3
    ignored = found["bias"]["torque taken as sampled, not held"]
    assert max(abs(ignored[name] / row["truth"]) for name, row in found["parameters"].items()) > 0.01
    tried = found["tried"]
    assert tried["identified"]["rms_error"] < 0.5 * tried["nominal"]["rms_error"]


@pytest.mark.parametrize("name", ["identify_3dof", "identify_7dof"])
@pytest.mark.parametrize(("variant", "bound"), [("ideal", 1e-3), ("can", 2e-2)])
def test_torque_of_an_unseen_motion(name: str, variant: str, bound: float, tmp_path: Path) -> None:
    """Rotors, friction and a payload that the nominal arm does not know; validation on another motion."""
    experiment = Experiment.of(Scenario.load(SCENARIOS / f"{name}.yaml"), variant)
    options, problem = experiment.options, experiment.problem
    found = fit_recording(problem, noisy(experiment.simulated(), options.noise))
    identified = possible(problem, found)
    model = tmp_path / "identified.xml"
    experiment.write(identified, model)
    unseen = noisy(experiment.simulated(options.validation), options.noise, 1)
    checked = validate(problem, unseen, found, identified, load_model(str(model)))
    assert (checked.nrmse["estimate"] < bound).all()
    assert (checked.nrmse["identified"] < bound).all()
    assert (checked.nrmse["nominal"] > 0.25).all()
    truth = problem.value(experiment.truth())
    z = (found.estimate.x - truth) / found.std_error
    assert np.abs(z).max() < 4.5  # of 25 or 69 normal numbers one beyond that comes once in 2,000 runs


@pytest.mark.parametrize(("name", "repeats"), [("identify_3dof", 400), ("identify_7dof", 60)])
def test_intervals_hold_the_truth_in_95_per_cent_of_repeats(name: str, repeats: int) -> None:
    """Pooled over parameters to 1.5 %, and each within what chance allows (6 standard deviations of a binomial)."""
    experiment = Experiment.of(Scenario.load(SCENARIOS / f"{name}.yaml"), "can")
    problem, noise = experiment.problem, experiment.options.noise
    clean = experiment.simulated()
    found = fit_recording(problem, noisy(clean, noise))
    share = covered(problem, clean, noise, found, problem.value(experiment.truth()), repeats)
    assert share.mean() == pytest.approx(0.95, abs=0.015)
    assert np.abs(share - 0.95).max() < 6.0 * np.sqrt(0.95 * 0.05 / repeats)
