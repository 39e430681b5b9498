"""The runner: what fits the schema but not each other, arms of one's own, batches of many, motions of other kinds."""

from pathlib import Path

import numpy as np
import pytest
from planar_rig import THESIS_MOTION

from lwa4d_sim.arm import load_arm
from lwa4d_sim.errors import KinematicsError, LwaError, ModelError, ScenarioError, TrajectoryError
from lwa4d_sim.kinematics import SrsKinematics
from lwa4d_sim.runner import LEAST_CHUNK, run, run_batch
from lwa4d_sim.scenario import Scenario

BASE = """
name: short
arm: lwa4d_3dof
trajectory:
  waypoints: {space: joint, points: [[-1.5, -1.4, 1.4]]}
  segment_time: 0.2
controller: {kind: computed_torque, p: 10}
"""

ARM = """
<mujoco model="scara">
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body name="column"><joint name="lift" type="slide" axis="0 0 1" range="0 0.4" limited="true"/>
      <inertial pos="0 0 0" mass="3" diaginertia="0.02 0.02 0.02"/>
      <body name="upper" pos="0.1 0 0.5"><joint name="shoulder" axis="0 0 1"/>
        <inertial pos="0.15 0 0" mass="2" diaginertia="0.01 0.02 0.02"/>
        <body name="fore" pos="0.3 0 0"><joint name="elbow" axis="0 0 1"/>
          <inertial pos="0.1 0 0" mass="1" diaginertia="0.005 0.01 0.01"/>
          <body name="hand" pos="0.2 0 0"><site name="tcp" pos="0.02 0 -0.1"/></body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="m1" joint="lift" ctrlrange="-200 200" ctrllimited="true"/>
    <motor name="m2" joint="shoulder" ctrlrange="-50 50" ctrllimited="true"/>
    <motor name="m3" joint="elbow" ctrlrange="-20 20" ctrllimited="true"/>
  </actuator>
</mujoco>
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "scara.xml").write_text(ARM)
    return tmp_path


def test_an_arm_of_ones_own_runs(folder: Path) -> None:
    """A sliding joint, MuJoCo's default integrator in the file, a path relative to the scenario, task-space steps."""
    (folder / "own.yaml").write_text(
        """
name: own
arm: scara.xml
trajectory:
  waypoints: {space: task, points: [[0.5, 0.2, 0.55], [0.35, -0.3, 0.45]]}
  segment_time: 1.0
  profile: quintic
  follow: task
controller: {kind: computed_torque, space: task, p: 12}
variants:
  ideal: {loop: {kind: ideal}}
  can: {}
"""
    )
    scenario = Scenario.load(folder / "own.yaml")
    ideal, can = run(scenario, "ideal"), run(scenario, "can")
    assert ideal.metrics()["stable"]
    assert can.metrics()["stable"]
    assert max(ideal.metrics()["final_error"]) < 1e-5
    assert ideal.x[-1] == pytest.approx([0.35, -0.3, 0.45], abs=1e-5)
    assert can.x[-1] == pytest.approx([0.35, -0.3, 0.45], abs=0.01)  # the lag of 10 ms at half a metre a second
    arm = load_arm(str(folder / "scara.xml"))
    np.testing.assert_allclose(arm.kinematics.point(can.q), can.x, atol=1e-12)


@pytest.mark.parametrize(
    ("overrides", "error", "says"),
    [
        ({"loop.period": 0.0105}, ScenarioError, "0.0105 s is not a whole multiple of the plant step 0.001 s"),
        ({"loop.period": 0.0001}, ScenarioError, "not a whole multiple"),
        ({"plant.timestep": 1e-10}, ScenarioError, "not a whole number of nanoseconds"),
        ({"initial.q": [0, 0]}, ScenarioError, "has 2 values, the arm has 3 joints"),
        ({"loop.phase": 0.01}, ScenarioError, "must be shorter than the period"),
        ({"loop.position_resolution": [1e-5, 1e-5]}, ScenarioError, "one for each of 3 joints"),
        ({"controller.p": None, "controller.kp": [1, 2], "controller.kd": 1}, ScenarioError, "one for each of 3 axes"),
        ({"trajectory.segment_time": 1e7}, ScenarioError, "are more than 20000000 steps"),
        ({"arm": "nothing.xml"}, ModelError, "no such file"),
        ({"plant.armature": [1.0]}, ModelError, "armature has 1 values for 3 joints"),
        ({"trajectory.waypoints": {"space": "task", "points": [[2, 0, 0]]}}, KinematicsError, "waypoint 1 (2, 0, 0)"),
        ({"trajectory": {"kind": "sampled", "file": "none.csv"}}, TrajectoryError, "none.csv"),
        ({"plant.disturbances": [{"at": 0.1, "body": "head"}]}, ModelError, "no body 'head'"),
    ],
)
def test_what_does_not_fit_is_named_with_its_place(overrides: object, error: type[LwaError], says: str) -> None:
    assert isinstance(overrides, dict)
    with pytest.raises(error) as caught:
        run(Scenario.parse(BASE, source="short.yaml", overrides=overrides))
    assert says in str(caught.value)
    assert str(caught.value).startswith("short.yaml")
    assert "\n" not in str(caught.value)


def test_unknown_variant() -> None:
    with pytest.raises(ScenarioError, match=r"no variant 'can'; it has default"):
        run(Scenario.parse(BASE), "can")


def test_a_batch_larger_than_a_chunk_keeps_its_order() -> None:
    scenario = Scenario.parse(BASE)
    ends = [[-1.5 + 0.01 * k, -1.4, 1.4] for k in range(LEAST_CHUNK + 3)]
    logs = list(run_batch(scenario, [{"trajectory.waypoints.points": [q]} for q in ends], threads=2))
    assert len(logs) == len(ends)
    for end, log in zip(ends, logs, strict=True):
        assert log.ticks.q_ref[-1] == pytest.approx(end, abs=1e-3)
        assert log.scenario["trajectory"]["waypoints"]["points"] == [end]


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        ({"loop.period": 0.02}, "differs in 'loop'"),
        ({"arm": "lwa4d_3dof_printed"}, "differs in 'arm'"),
        ({"trajectory.segment_time": 0.3}, "same duration"),
        ({"controller.space": "task"}, "share the kind and space"),
    ],
)
def test_members_that_cannot_be_stepped_together(overrides: dict[str, object], says: str) -> None:
    with pytest.raises(ScenarioError, match=says):
        list(run_batch(Scenario.parse(BASE), [{}, overrides]))


def test_identification_motion_runs_on_the_planar_arm() -> None:
    """The thesis's excitation (section 5.1.3) under its PD gains, from a start off the reference."""
    text = (
        """
name: excitation
"""
        + THESIS_MOTION
        + """  duration: 4.0
controller: {kind: pd_gravity, kp: 30, kd: 5}
loop: {kind: ideal}
"""
    )
    log = run(Scenario.parse(text))
    assert log.metrics()["stable"]
    assert log.q.shape == (4001, 2)
    assert np.abs(log.ticks.q_ref - log.ticks.q_true)[-1].max() < 0.2


def test_the_python_names_of_the_design() -> None:
    import lwa4d_sim

    log = lwa4d_sim.run(lwa4d_sim.Scenario.parse(BASE), None)
    assert log.t.shape == (201,)
    assert log.q.shape == log.dq.shape == log.tau.shape == (201, 3)
    assert log.x.shape == (201, 3)
    assert log.ticks.q.shape == log.ticks.dq.shape == log.ticks.tau.shape == (20, 3)
    arm = load_arm("lwa4d_7dof")
    q = np.array([0.1, 0.4, -0.2, 1.0, 0.3, -0.5, 0.2])
    assert arm.dynamics.M(q).shape == (7, 7)
    assert arm.dynamics.h(q, 0 * q) == pytest.approx(arm.dynamics.g(q))
    kinematics = arm.kinematics
    assert isinstance(kinematics, SrsKinematics)
    again = kinematics.ik(*kinematics.fk(q), arm_angle=kinematics.arm_angle_of(q), near=q)
    assert again == pytest.approx(q)
    assert kinematics.jacobian(q).shape == (6, 7)
