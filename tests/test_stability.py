"""Where loops turn unstable: the analysis against an independent program, and against simulation."""

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stability_rig import STEP, compare, limits, margins, pd, predicted, simulated
from test_docs import VALIDATION, WAYPOINTS, spectral_radius, table
from test_thesis import CRITICAL

from lwa4d_sim.arm import load_arm
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.stability.study import Study

SHIPPED = Path(__file__).parent.parent / "scenarios"
ARMS = ["lwa4d_3dof_printed", "lwa4d_3dof"]
PLACES = ["continuous", "held"]
ACTUATIONS = ["immediate", "next_sync"]

# Gains from which all limits are searched: stable at every waypoint (too weak ones are not, see below).
START = {"joint": 0.5, "task": 18.0}


@pytest.mark.parametrize(("arm", "runs_on"), list(CRITICAL))
def test_gain_limits_of_the_thesis(arm: str, runs_on: str) -> None:
    found = 0.5 * margins(limits(arm, pd("joint", 0.5), runs_on=runs_on))
    np.testing.assert_allclose(found, CRITICAL[arm, runs_on], rtol=1e-3)


@pytest.mark.parametrize("space", list(START))
def test_gain_limits_of_the_page(space: str) -> None:
    """The second program for those in joint space is test_docs.py::test_gain_limits_by_eigenvalues."""
    rows = table(VALIDATION, {"joint": "arm", "task": "arm, task space"}[space])
    assert {tuple(row[:3]) for row in rows} == {
        (f"`{arm}`", *how) for arm in ARMS for how in product(PLACES, ACTUATIONS)
    }
    for row in rows:
        study = limits(row[0].strip("`"), pd(space, START[space]), runs_on=row[1], actuation=row[2])
        digits = len(row[3].split(".")[1])
        assert row[3:] == [f"{p:.{digits}f}" for p in START[space] * margins(study)]


@pytest.mark.parametrize("row", table(VALIDATION, "arm"), ids=lambda row: " ".join(row[:3]))
def test_spectral_radius_of_two_programs(row: list[str]) -> None:
    """Not only at the limit: the whole loop is the same."""
    name = row[0].strip("`")
    arm = load_arm(name)
    poses = arm.kinematics.ik(WAYPOINTS, elbow="up")
    study = limits(name, pd("joint", 1.0), runs_on=row[1], actuation=row[2])
    loop = study.close(study.linear(study.waypoints()))
    for p in (0.3, 1.0, 2.5, 6.0):
        expected = [spectral_radius(arm, q, p, row[1], row[2]) for q in poses]
        np.testing.assert_allclose(loop.radius(np.arange(4), np.full(4, p)), expected, rtol=1e-7)


@pytest.mark.parametrize("actuation", ACTUATIONS)
@pytest.mark.parametrize("runs_on", PLACES)
@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("space", list(START))
def test_limits_in_simulation(space: str, arm: str, runs_on: str, actuation: str) -> None:
    compare(limits(arm, pd(space, START[space]), runs_on=runs_on, actuation=actuation))


@pytest.mark.parametrize("actuation", ACTUATIONS)
@pytest.mark.parametrize("space", list(START))
def test_limits_of_computed_torque_in_simulation(space: str, actuation: str) -> None:
    compare(limits("lwa4d_3dof", f"{{kind: computed_torque, space: {space}, p: 8}}", actuation=actuation))


@pytest.mark.parametrize("changes", [{}, {"plant.armature": "lwa4d", "controller.model.armature": "lwa4d"}])
@pytest.mark.parametrize("name", ["ct7_joint", "pd7_joint", "pd7_task"])
def test_limits_of_seven_joints_in_simulation(name: str, changes: dict[str, Any]) -> None:
    study = Study(Scenario.load(SHIPPED / f"{name}.yaml", {"plant.timestep": STEP, **changes}), "can")
    compare(study)


def test_late_gravity_compensation_needs_some_gain() -> None:
    """A loop may have a lower limit: upright, g(q) of a period ago drives the arm more than weak gains brake it."""
    study = limits("lwa4d_3dof", pd("task", 20.0), actuation="next_sync")
    loop = study.close(study.linear(study.waypoints()))
    up, strong, weak = [3], [1.0], [0.15]
    assert loop.radius(np.array(up), np.array(strong))[0] < 1 < loop.radius(np.array(up), np.array(weak))[0]
    calm, grown = simulated(study, up * 2, strong + weak)
    assert np.abs(calm[-50:]).max() < 0.5 * np.abs(calm[:50]).max()
    assert np.abs(grown[-50:]).max() > 1.5 * np.abs(grown[:50]).max()
    expected = predicted(study, up, weak)[0]
    np.testing.assert_allclose(grown, expected, atol=1e-3 * np.abs(expected).max())
