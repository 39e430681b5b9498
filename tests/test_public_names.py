"""The names other people's code may lean on: they exist, and are what they are said to be."""

import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lwa4d_sim
from lwa4d_sim import errors

ROOT = Path(__file__).parent.parent

TEXT = """\
name: x
arm: lwa4d_3dof
trajectory: {waypoints: {space: joint, points: [[-1.5, -1.5, 1.5], [-1.5, -1.4, 1.4]]}, segment_time: 0.1}
controller: {kind: pd_gravity, kp: 10, kd: 5}
variants: {ideal: {loop: {kind: ideal}}, can: {}}
"""

MODULES = [info.name for info in pkgutil.walk_packages(lwa4d_sim.__path__, "lwa4d_sim.") if "__main__" not in info.name]


@pytest.mark.parametrize("name", ["lwa4d_sim", *MODULES])
def test_all_is_sorted_and_real(name: str) -> None:
    module = importlib.import_module(name)
    names = getattr(module, "__all__", [])
    assert list(names) == sorted(set(names))
    for public in names:
        assert getattr(module, public) is not None


def test_the_package_offers_these_names_and_no_others() -> None:
    assert lwa4d_sim.__all__ == ["RunLog", "Scenario", "run"]
    from lwa4d_sim.record import RunLog
    from lwa4d_sim.runner import run
    from lwa4d_sim.scenario import Scenario

    assert (lwa4d_sim.RunLog, lwa4d_sim.Scenario, lwa4d_sim.run) == (RunLog, Scenario, run)
    with pytest.raises(AttributeError, match="module 'lwa4d_sim' has no attribute 'Runlog'"):
        lwa4d_sim.Runlog  # noqa: B018
    star: dict[str, Any] = {}
    exec("from lwa4d_sim import *", star)
    assert star.keys() - {"__builtins__"} == set(lwa4d_sim.__all__)


def test_what_is_told_to_type_checkers_is_what_is_there() -> None:
    import ast

    tree = ast.parse((ROOT / "lwa4d_sim/__init__.py").read_text())
    told = {
        alias.name: node.module
        for outer in tree.body
        if isinstance(outer, ast.If)
        for node in outer.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert told == lwa4d_sim._HOMES
    assert sorted(told) == lwa4d_sim.__all__


def test_the_version_is_the_projects() -> None:
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert lwa4d_sim.__version__ == project["version"]


def test_every_script_of_the_project_exists() -> None:
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for target in project["scripts"].values():
        module, _, name = target.partition(":")
        assert callable(getattr(importlib.import_module(module), name))


def test_a_log_has_what_the_readme_promises() -> None:
    scenario = lwa4d_sim.Scenario.parse(TEXT, overrides={"controller.kp": 12.0})
    log = lwa4d_sim.run(scenario, variant="can")
    T, K = 201, 20
    assert log.t.shape == (T,)
    assert log.q.shape == log.dq.shape == log.tau.shape == (T, 3)
    assert log.x.shape == log.x_ref.shape == (T, 3)
    assert log.ticks.q.shape == log.ticks.dq.shape == log.ticks.tau.shape == (K, 3)
    assert log.metrics().keys() >= {
        "final_error",
        "max_error",
        "rms_error",
        "settling_time",
        "stable",
        "saturation_fraction",
    }
    assert len(log.metrics()["final_error"]) == 2
    assert log.scenario["controller"]["kp"] == 12.0
    first = lwa4d_sim.run(scenario)
    assert first.variant == "ideal"
    np.testing.assert_array_equal(lwa4d_sim.run(scenario, "can").q, log.q)


def test_a_variant_that_does_not_exist_is_named_with_those_that_do() -> None:
    with pytest.raises(errors.ScenarioError, match="no variant 'cna'; it has ideal, can"):
        lwa4d_sim.run(lwa4d_sim.Scenario.parse(TEXT), "cna")


def test_load_arm_gives_model_kinematics_and_dynamics() -> None:
    from lwa4d_sim.arm import load_arm

    arm = load_arm("lwa4d_7dof")
    assert arm.model.nv == 7
    assert arm.kinematics.fk(np.zeros(7)).x.shape == (3,)
    assert arm.dynamics.M(np.zeros(7)).shape == (7, 7)


def test_errors_form_one_tree_as_drawn() -> None:
    """Every error is an LwaError and a builtin one too, and the drawing in the docstring has them all."""
    found = {name: cls for name, cls in vars(errors).items() if isinstance(cls, type)}
    for name, cls in found.items():
        assert issubclass(cls, errors.LwaError)
        assert name in str(errors.__doc__)
        if cls is not errors.LwaError:
            assert issubclass(cls, (ValueError, OSError))


def test_the_package_can_be_used_from_anywhere(tmp_path: Path) -> None:
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r})\nfrom lwa4d_sim import Scenario, run\n"
    code += f"print(len(run(Scenario.parse({TEXT!r})).t))"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("201\n", "")
