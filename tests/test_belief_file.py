"""A controller that believes a model file of its own, and all who must know about it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lwa4d_sim.assembly import build_blocks
from lwa4d_sim.edits import ArmEdits, Payload
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.identification.inertia import standard_parameters
from lwa4d_sim.identification.model_file import write_model
from lwa4d_sim.mjcf import load_model, model_path
from lwa4d_sim.results import run_scenario
from lwa4d_sim.runner import run, run_batch
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.stability.study import Study
from lwa4d_sim.sweep.file import Sweep
from lwa4d_sim.tuned_file import tuned_document
from lwa4d_sim.tuning import Tuned

REAL = ArmEdits(mass_scale=1.2, payload=Payload(mass=1.5, com=(0.0, 0.02, 0.05)), armature=0.05)
CHANGES: dict[str, Any] = {
    "mass_scale": 1.2,
    "payload": {"mass": 1.5, "com": [0.0, 0.02, 0.05]},
    "armature": 0.05,
}
SCENARIO: dict[str, Any] = {
    "name": "believer",
    "arm": "lwa4d_3dof",
    "plant": CHANGES,
    "trajectory": {
        "waypoints": {"space": "joint", "points": [[-1.4, -1.1, 1.6]]},
        "segment_time": 0.2,
    },
    "controller": {"kind": "computed_torque", "p": 10, "model": {"arm": "believed/identified.xml"}},
    "loop": {"period": 0.01, "velocity": {"kind": "observer"}},
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A scenario's folder, not the working one, with the file that it names."""
    model = load_model("lwa4d_3dof", REAL)
    (tmp_path / "believed").mkdir()
    zero = np.zeros(3)
    write_model(
        model_path("lwa4d_3dof"),
        tmp_path / "believed" / "identified.xml",
        pi=standard_parameters(model),
        armature=np.full(3, 0.05),
        viscous=zero,
        coulomb=zero,
        about="the plant of a test",
    )
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    return tmp_path


def scenario(folder: Path, **controller: Any) -> Scenario:
    document = {**SCENARIO, "controller": {**SCENARIO["controller"], **controller}}
    (folder / "s.yaml").write_text(json.dumps(document, indent=0))
    return Scenario.load(folder / "s.yaml")


def test_believing_the_file_is_believing_what_it_was_made_from(folder: Path) -> None:
    """Two roads: parameters through a file, or changes to the shipped model; and a wrong belief to tell them from."""
    own = run(scenario(folder), "default")
    same = run(scenario(folder, model=CHANGES), "default")
    nominal = run(scenario(folder, model={}), "default")
    np.testing.assert_allclose(own.q, same.q, atol=1e-10)
    errors = [one.metrics()["rms_error"] for one in (own, nominal)]
    assert errors[0] < 0.5 * errors[1]  # what is left is the bus


def test_changes_come_on_top_of_the_file(folder: Path) -> None:
    lighter = run(scenario(folder, model={"arm": "believed/identified.xml", "gravity": [0, 0, 0]}), "default")
    same = run(scenario(folder, model={**CHANGES, "gravity": [0, 0, 0]}), "default")
    np.testing.assert_allclose(lighter.q, same.q, atol=1e-10)


@pytest.mark.parametrize(
    ("model", "words"),
    [
        ({"arm": "nowhere.xml"}, r"s\.yaml:\d+: controller\.model\.arm \(='nowhere\.xml'\): .*no such file"),
        ({"arm": "lwa4d_7dof"}, r"controller\.model\.arm \(='lwa4d_7dof'\): has 7 joints, the arm lwa4d_3dof has 3"),
        ({"arm": "s.yaml"}, r"controller\.model\.arm \(='s\.yaml'\): "),
        ({"arm": 7}, r"controller\.model\.arm"),
    ],
)
def test_a_file_that_does_not_fit_is_one_clear_line(model: dict[str, Any], words: str, folder: Path) -> None:
    with pytest.raises(ScenarioError, match=words) as caught:
        build_blocks([scenario(folder, model=model)], "default", 1)
    assert "\n" not in str(caught.value)


def test_a_change_that_does_not_fit_the_file_is_not_the_files_fault(folder: Path) -> None:
    with pytest.raises(ValueError, match="armature has 2 values for 3 joints") as caught:
        build_blocks([scenario(folder, model={"arm": "believed/identified.xml", "armature": [0, 0]})], "default", 1)
    assert "model.arm" not in str(caught.value)


def test_the_linear_loop_believes_it_too(folder: Path) -> None:
    def slopes(**model: Any) -> Any:
        study = Study(scenario(folder, model=model), "default")
        return study.linear(study.waypoints())

    own, same, nominal = slopes(arm="believed/identified.xml"), slopes(**CHANGES), slopes()
    for field in ("law", "A_model"):
        np.testing.assert_allclose(getattr(own, field), getattr(same, field), rtol=1e-6, atol=1e-6)
        assert np.abs(getattr(own, field) - getattr(nominal, field)).max() > 1.0


def test_results_name_the_file_that_was_believed(folder: Path) -> None:
    hashes = run_scenario(scenario(folder))["hashes"]["models"]
    assert hashes.keys() == {"lwa4d_3dof", "believed/identified.xml"}


def test_a_sweep_is_another_one_when_the_file_changes(folder: Path) -> None:
    scenario(folder)
    (folder / "sweep.yaml").write_text(
        json.dumps({"name": "s", "scenario": "s.yaml", "axes": {"controller.p": {"values": [5, 10]}}})
    )
    before = Sweep.load(folder / "sweep.yaml", folder).identity()
    assert Sweep.load(folder / "sweep.yaml", folder).identity() == before
    file = folder / "believed" / "identified.xml"
    file.write_text(file.read_text().replace("the plant of a test", "another"))
    assert Sweep.load(folder / "sweep.yaml", folder).identity() != before


def test_a_tuned_scenario_finds_the_file_from_anywhere(folder: Path) -> None:
    nothing: Any = None
    tuned = Tuned({"controller.p": 5.0}, nothing, nothing, 1.0, 1.0, 0)
    model = tuned_document(scenario(folder), "default", tuned, "other")["controller"]["model"]
    assert model["arm"] == str((folder / "believed" / "identified.xml").resolve())
    shipped = tuned_document(scenario(folder, model={"arm": "lwa4d_3dof"}), "default", tuned, "other")
    assert shipped["controller"]["model"]["arm"] == "lwa4d_3dof"


def test_runs_that_believe_different_files_are_not_one_batch(folder: Path) -> None:
    with pytest.raises(ScenarioError, match=r"differs in 'controller\.model\.arm'"):
        list(run_batch(scenario(folder), [{}, {"controller.model.arm": "lwa4d_3dof"}]))
