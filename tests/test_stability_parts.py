"""The pieces of the analysis, each against the block it stands for: estimators, arm, control law, maps."""

from copy import copy
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from stability_rig import limits, pd

from lwa4d_sim.arm import load_arm
from lwa4d_sim.dynamics import ClosedForm3, NominalModel
from lwa4d_sim.edits import ArmEdits, Friction
from lwa4d_sim.estimators import (
    BackwardDifferenceVelocity,
    FilteredDerivative,
    KalmanVelocity,
    TrueVelocity,
    TustinVelocity,
)
from lwa4d_sim.interfaces import Array, Measurement, Ns, to_ns
from lwa4d_sim.mjcf import load_model
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.stability.filters import filter_of
from lwa4d_sim.stability.linear import Linear, linearise_arm, rows_needed
from lwa4d_sim.stability.maps import default_joints, workspace
from lwa4d_sim.stability.sampled import continuous_part
from lwa4d_sim.stability.study import Study

SHIPPED = Path(__file__).parent.parent / "scenarios"

# Estimators -----------------------------------------------------------------------------------------------------------

periods = st.floats(0.001, 0.05)
constants = st.floats(0.002, 0.1)
samples = arrays(float, st.tuples(st.integers(2, 30), st.just(2)), elements=st.floats(-2, 2))  # q and the drive's v
velocities = st.one_of(
    st.just(TrueVelocity()),
    st.just(BackwardDifferenceVelocity()),
    st.builds(FilteredDerivative, time_constant=constants, runs_on=st.sampled_from(["continuous", "held"])),
    st.builds(TustinVelocity, time_constant=constants),
    st.builds(KalmanVelocity, acceleration=st.floats(0.1, 100), position=st.floats(1e-5, 1e-2)),
)


@settings(max_examples=150, deadline=None)
@given(velocity=velocities, period=periods, y=samples)
def test_filters_are_the_estimators(velocity: Any, period: float, y: Array) -> None:
    """Same outputs for any samples that begin at rest at zero."""
    tick = to_ns(period)
    period = tick * 1e-9
    y[0] = 0.0
    _, estimator = velocity.build(np.zeros((1, 1)), period, period / 4)
    filter_ = filter_of(velocity, period)
    z = np.zeros(len(filter_.A))
    found, expected = [], []
    for k, sample in enumerate(y):
        meas = Measurement(np.full((1, 1), k * tick), sample[None, :1].copy(), sample[None, 1:].copy())
        state = estimator.update(meas, Ns(k * tick))
        expected.append([state.q[0, 0], state.dq[0, 0]])
        found.append(filter_.C @ z + filter_.D @ sample)
        z = filter_.A @ z + filter_.B @ sample
    size = max(1.0, float(np.abs(expected).max()))
    np.testing.assert_allclose(found, expected, atol=1e-12 * size)


@settings(max_examples=40, deadline=None)
@given(T=constants, steps=st.integers(1, 12), c=arrays(float, 3, elements=st.floats(-2, 2)))
def test_the_filter_in_the_drive_is_that_of_the_loop(T: float, steps: int, c: Array) -> None:
    """One joint on a cubic that begins at rest: the drive's source and the loop's differential equation agree."""
    dt = 0.001
    shapes = (1, 2, 2), (1, 2, 1), (1, 1, 2), (1, 1, 2), (1, 2, 2), (1, 2, 1)
    rest = Linear.of([np.zeros(shape) for shape in shapes])
    A, _, H = continuous_part(rest, T)
    joined = np.zeros((6, 6))  # q, dq, ddq, dddq, and the two lags
    joined[0, 1] = joined[1, 2] = joined[2, 3] = 1.0
    joined[4:, 0], joined[4:, 4:] = A[0, 2:, 0], A[0, 2:, 2:]
    source, _ = FilteredDerivative(time_constant=T).build(np.full((1, 1), c[0]), steps * dt, dt)
    assert source is not None
    start = np.array([c[0], 0.0, c[1], c[2], c[0], c[0]])
    motion = np.array([expm(joined * i * dt) @ start for i in range(1, 3 * steps + 1)])
    for part in motion.reshape(3, steps, 6):
        source.observe(part[None, :, :1], part[None, :, 1:2])
        expected = H[0, 1] @ part[-1, [0, 1, 4, 5]]
        assert source.read()[0, 0] == pytest.approx(expected, abs=1e-9)


# Arm and law ----------------------------------------------------------------------------------------------------------


def somewhere(n: int, count: int = 5) -> tuple[Array, Array, Array]:
    """Some angles, speeds and accelerations, each (count, n)."""
    rng = np.random.default_rng(n)
    return rng.uniform(-2, 2, (count, n)), rng.uniform(-1.5, 1.5, (count, n)), rng.uniform(-3, 3, (count, n))


@pytest.mark.parametrize("name", ["lwa4d_3dof", "lwa4d_7dof"])
def test_the_arm_is_that_of_mujoco(name: str) -> None:
    """One step of semi-implicit Euler is linear in A and B; MuJoCo differentiates its own step."""
    edits = ArmEdits(armature=0.02, friction=Friction(viscous=0.3))
    model = load_model(name, edits, timestep=0.001, integrator="Euler")
    model = copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    model.actuator_ctrllimited = 0
    n, h = model.nv, model.opt.timestep
    q, dq, ddq = somewhere(n)
    A, B = linearise_arm(NominalModel(model, rows_needed(len(q), n)), q, dq, ddq)
    data = mujoco.MjData(model)
    for i in range(len(q)):
        data.qpos, data.qvel, data.qacc = q[i], dq[i], ddq[i]
        mujoco.mj_inverse(model, data)
        data.ctrl = data.qfrc_inverse
        step, push = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, n))
        mujoco.mjd_transitionFD(model, data, 1e-6, 1, step, push, None, None)
        speed = np.hstack([np.zeros((n, n)), np.eye(n)])
        after = speed + h * A[i, n:]
        np.testing.assert_allclose(step, np.vstack([np.eye(n, 2 * n) + h * after, after]), atol=1e-7)
        np.testing.assert_allclose(push, np.vstack([h * h * B[i, n:], h * B[i, n:]]), rtol=1e-6, atol=1e-9)


def gravity_slope(q: Array) -> Array:
    """dg/dq (3, 3) of the three-joint arm, differentiated by hand (thesis, section 4.2, corrected: docs/errata.md)."""
    m2, m3, l2, lc2, lc3 = 4.8, 4.0, 0.328, 0.164, 0.1985
    s2, s23 = np.sin(q[1]), np.sin(q[1] + q[2])
    far = 9.81 * m3 * lc3 * s23
    return np.array([[0, 0, 0], [0, far + 9.81 * (m3 * l2 + m2 * lc2) * s2, far], [0, far, far]])


@pytest.mark.parametrize("kind", ["pd_gravity", "computed_torque"])
@pytest.mark.parametrize("space", ["joint", "task"])
def test_slopes_of_the_laws_at_rest(space: str, kind: str) -> None:
    """With no error and no speed the law's derivatives are matrices one can write down."""
    kp, kd = 30.0, 7.0
    study = limits("lwa4d_3dof", f"{{kind: {kind}, space: {space}, kp: {kp}, kd: {kd}}}")
    points = study.waypoints()
    linear = study.linear(points)
    arm, closed = load_arm("lwa4d_3dof"), ClosedForm3(load_model("lwa4d_3dof"))
    for i, q in enumerate(points.q):
        shape = np.eye(3)
        if space == "task":
            J = arm.kinematics.jacobian(q)[:3]
            shape = J.T @ J if kind == "pd_gravity" else np.eye(3)  # M J^-1 K J is M K for one number K
        if kind == "computed_torque":
            shape = closed.at(q[None]).M[0] @ shape
        slope = gravity_slope(q)
        np.testing.assert_allclose(linear.law[i], np.hstack([slope - kp * shape, -kd * shape]), atol=1e-8)
        np.testing.assert_allclose(linear.bare[i], np.hstack([slope, np.zeros((3, 3))]), atol=1e-8)


def test_slopes_of_computed_torque_in_motion() -> None:
    """Along a motion M and h have slopes of their own; a five-point rule on the closed form is the other road."""
    study = Study(Scenario.load(SHIPPED / "ct_joint_T1.5.yaml"), "can")
    points = study.along(np.array([0.4, 2.0, 3.3]))
    closed = ClosedForm3(load_model(study.settings.arm))
    kp, kd = study.settings.controller.gains  # type: ignore[union-attr]

    def law(i: int, x: Array) -> Array:
        q, dq = x[None, :3], x[None, 3:]
        terms = closed.at(q, dq)
        a = points.ref.ddq[i] + kd * (points.ref.dq[i] - dq) + kp * (points.ref.q[i] - q)
        torque: Array = (terms.M @ a[..., None])[0, :, 0] + terms.h[0]
        return torque

    found = study.linear(points).law
    h = 1e-3
    assert np.abs(points.dq).min(axis=1).max() > 0.1, "in motion"
    for i in range(3):
        x = np.concatenate([points.q[i], points.dq[i]])
        columns = [
            (8 * (law(i, x + h * e) - law(i, x - h * e)) - law(i, x + 2 * h * e) + law(i, x - 2 * h * e)) / (12 * h)
            for e in np.eye(6)
        ]
        np.testing.assert_allclose(found[i], np.stack(columns, axis=1), atol=1e-8)


# Maps -----------------------------------------------------------------------------------------------------------------


def test_a_map_holds_what_each_pose_has() -> None:
    study = limits("lwa4d_3dof", pd("joint", 0.5))
    assert default_joints(study) == (1, 2)
    rows = workspace(study, size=(4, 5))
    assert rows.first[-1] == pytest.approx(0.5692036732051036)  # the joint's stop
    np.testing.assert_allclose(rows.second[[0, -1]], [0.0, 2.18], atol=1e-12)  # the waypoint's side of the elbow
    for i, a in enumerate(rows.first):
        for j, b in enumerate(rows.second):
            q = np.array([study.waypoints().q[0, 0], a, b])
            loop = study.close(study.linear(study.resting(q)))
            margin = study.gain_margin(loop)[0]
            assert rows.gain_margin[i, j] == pytest.approx(margin, rel=1e-9)
            mode = study.mode(loop, 0, margin)
            assert rows.frequency[i, j] == pytest.approx(mode.frequency, rel=1e-6)
            assert rows.limiting[i, j] == np.argmax(mode.share)
            np.testing.assert_allclose(rows.x[i, j], load_arm("lwa4d_3dof").kinematics.fk(q).x, atol=1e-12)
    assert np.ptp(rows.gain_margin) > 1, "a map of one colour would tell nothing"


@pytest.mark.parametrize("name", ["pd_joint_p1.25", "pd_task_p20", "pd7_joint", "ct7_joint"])
def test_turning_the_base_changes_nothing(name: str) -> None:
    study = Study(Scenario.load(SHIPPED / f"{name}.yaml"), "can")
    q = np.repeat(study.waypoints().q[1:2], 3, axis=0)
    q[:, 0] = -1.0, 0.3, 2.5
    margin = study.gain_margin(study.close(study.linear(study.resting(q))))
    np.testing.assert_allclose(margin, margin[0], rtol=1e-7)
