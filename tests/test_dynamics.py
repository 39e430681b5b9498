"""Rigid-body terms by several roads: MuJoCo's, the thesis's closed form, Pinocchio's, and finite differences."""

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from lwa4d_sim.arm import ARMS, load_arm
from lwa4d_sim.dynamics import ClosedForm3, Dynamics, NominalModel
from lwa4d_sim.edits import ArmEdits, Payload
from lwa4d_sim.errors import ModelError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.kinematics import kinematics_for
from lwa4d_sim.mjcf import chain_of, load_model

MODELS = Path(__file__).parents[1] / "models"
N = 40
EVERY_ARM = pytest.mark.parametrize("name", list(ARMS))
THREE = pytest.mark.parametrize("name", ["lwa4d_3dof", "lwa4d_3dof_printed"])


def states(n: int, count: int = N) -> tuple[Array, Array]:
    rng = np.random.default_rng(n)
    return rng.uniform(-np.pi, np.pi, (count, n)), rng.normal(size=(count, n)) * 2.0


def nominal(name: str, count: int = N, **edits: Any) -> NominalModel:
    return NominalModel(load_model(name, ArmEdits(**edits)), count)


@EVERY_ARM
def test_pinocchio_agrees(name: str) -> None:
    pinocchio = pytest.importorskip("pinocchio", reason="Pinocchio (package pin) is not installed")
    other = pinocchio.buildModelFromMJCF(str(MODELS / f"{name}.xml"))
    data = other.createData()
    q, dq = states(other.nv)
    terms = nominal(name).at(q, dq)
    M, h, J, x, R, bias = terms.M, terms.h, terms.J, *terms.pose, terms.dJ_dq(dq)
    frame, axes = other.getFrameId("tcp"), pinocchio.ReferenceFrame.LOCAL_WORLD_ALIGNED
    for i in range(N):
        upper = np.triu(pinocchio.crba(other, data, q[i]))
        np.testing.assert_allclose(M[i], upper + np.triu(upper, 1).T, atol=1e-10)
        np.testing.assert_allclose(h[i], pinocchio.nonLinearEffects(other, data, q[i], dq[i]), atol=1e-10)
        np.testing.assert_allclose(J[i], pinocchio.computeFrameJacobian(other, data, q[i], frame, axes), atol=1e-10)
        pinocchio.forwardKinematics(other, data, q[i], dq[i], 0.0 * dq[i])
        pinocchio.updateFramePlacements(other, data)
        np.testing.assert_allclose(x[i], data.oMf[frame].translation, atol=1e-10)
        np.testing.assert_allclose(R[i], data.oMf[frame].rotation, atol=1e-10)
        acceleration = pinocchio.getFrameClassicalAcceleration(other, data, frame, axes)
        np.testing.assert_allclose(bias[i], acceleration.vector, atol=1e-9)


@THREE
@pytest.mark.parametrize("edits", [{}, {"armature": (0.1, 0.2, 0.3)}, {"mass_scale": (1.0, 1.2, 0.7)}, {
    "payload": Payload(mass=1.5)}], ids=["as is", "armature", "mass_scale", "payload"])  # fmt: skip
def test_the_closed_form_agrees(name: str, edits: dict[str, Any]) -> None:
    q, dq = states(3)
    a = nominal(name, **edits).at(q, dq)
    b = ClosedForm3(load_model(name, ArmEdits(**edits))).at(q, dq)
    np.testing.assert_allclose(a.M, b.M, atol=1e-10)
    np.testing.assert_allclose(a.h, b.h, atol=1e-10)
    np.testing.assert_allclose(a.J, b.J, atol=1e-10)
    np.testing.assert_allclose(a.pose.x, b.pose.x, atol=1e-10)
    np.testing.assert_allclose(a.pose.R, b.pose.R, atol=1e-10)
    np.testing.assert_allclose(a.dJ_dq(dq), b.dJ_dq(dq), atol=1e-10)
    np.testing.assert_allclose(a.at(q).h, ClosedForm3(load_model(name, ArmEdits(**edits))).at(q).h, atol=1e-10)


def test_the_printed_arm_has_the_lighter_elbow() -> None:
    physical, printed = (
        nominal(name, 1).at(np.zeros((1, 3))).M[0, 2, 2] for name in ("lwa4d_3dof", "lwa4d_3dof_printed")
    )
    assert printed / physical == pytest.approx(0.76, abs=0.005)  # 24 % less: its inertia stands in the wrong frame


@EVERY_ARM
def test_dynamics_is_the_nominal_model_with_any_leading_axes(name: str) -> None:
    model = load_model(name)
    q, dq = states(model.nv, 6)
    terms, dynamics = NominalModel(model, 6), Dynamics(model)
    at = terms.at(q, dq)
    np.testing.assert_array_equal(dynamics.M(q), at.M)
    np.testing.assert_array_equal(dynamics.h(q, dq), at.h)
    np.testing.assert_array_equal(dynamics.g(q), terms.at(q).h)
    np.testing.assert_array_equal(dynamics.M(q.reshape(2, 3, -1)).reshape(6, model.nv, model.nv), dynamics.M(q))
    np.testing.assert_array_equal(dynamics.h(q[0], dq[0]), dynamics.h(q, dq)[0])
    np.testing.assert_array_equal(dynamics.g(q), dynamics.h(q, 0.0 * q))
    np.testing.assert_array_equal(load_arm(name).dynamics.M(q), dynamics.M(q))


@EVERY_ARM
def test_inertia_is_symmetric_positive_and_the_coriolis_matrix_skew(name: str) -> None:
    model = load_model(name)
    q, dq = states(model.nv)
    dynamics, step = Dynamics(model), 1e-5
    M = dynamics.M(q)
    np.testing.assert_allclose(M, np.swapaxes(M, 1, 2), atol=1e-13)
    assert np.linalg.eigvalsh(M).min() > 0
    # dq^T (dM - 2 C) dq = 0, with dM along the motion by central differences
    dM = (dynamics.M(q + step * dq) - dynamics.M(q - step * dq)) / (2.0 * step)
    coriolis = dynamics.h(q, dq) - dynamics.g(q)
    power = np.einsum("ki,kij,kj->k", dq, dM, dq)
    assert np.abs(power).max() > 0.1
    np.testing.assert_allclose(power, 2.0 * np.einsum("ki,ki->k", dq, coriolis), atol=1e-6)
    np.testing.assert_allclose(dynamics.h(q, 2.0 * dq) - dynamics.g(q), 4.0 * coriolis, atol=1e-9)  # quadratic in dq


@EVERY_ARM
def test_gravity_is_the_slope_of_the_potential(name: str) -> None:
    model = load_model(name)
    data = mujoco.MjData(model)

    def potential(q: Array) -> float:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        return -float(model.body_mass @ data.xipos @ model.opt.gravity)

    q, _ = states(model.nv, 5)
    g, step = Dynamics(model).g(q), 1e-5
    for i, j in np.ndindex(q.shape):
        slope = (potential(q[i] + step * np.eye(model.nv)[j]) - potential(q[i] - step * np.eye(model.nv)[j])) / (
            2 * step
        )
        assert g[i, j] == pytest.approx(slope, abs=1e-7)


@EVERY_ARM
def test_tool_terms_are_those_of_the_kinematics(name: str) -> None:
    model = load_model(name)
    q, dq = states(model.nv)
    kinematics = kinematics_for(chain_of(model))
    terms = NominalModel(model, N).at(q, dq)
    np.testing.assert_allclose(terms.pose.x, kinematics.fk(q).x, atol=1e-12)
    np.testing.assert_allclose(terms.pose.R, kinematics.fk(q).R, atol=1e-12)
    np.testing.assert_allclose(terms.J, kinematics.jacobian(q), atol=1e-12)
    step = 1e-6
    ahead, behind = kinematics.jacobian(q + step * dq), kinematics.jacobian(q - step * dq)
    rate = np.einsum("kij,kj->ki", ahead - behind, dq) / (2.0 * step)
    assert np.abs(rate).max() > 1.0
    np.testing.assert_allclose(terms.dJ_dq(dq), rate, atol=1e-7)


@THREE
def test_the_closed_forms_bias_acceleration_by_differences(name: str) -> None:
    q, dq = states(3)
    terms, step = ClosedForm3(load_model(name)), 1e-6
    rate = np.einsum("kij,kj->ki", terms.at(q + step * dq).J - terms.at(q - step * dq).J, dq) / (2.0 * step)
    np.testing.assert_allclose(terms.at(q).dJ_dq(dq), rate, atol=1e-7)


def test_terms_may_be_asked_in_any_order_and_twice() -> None:
    q, dq = states(7, 4)
    model = nominal("lwa4d_7dof", 4)
    at = model.at(q, dq)
    J, M, h, x = at.J, at.M, at.h, at.pose.x  # each binds its fields on first use
    other = model.at(q[::-1], dq[::-1])
    np.testing.assert_array_equal(other.pose.x, x[::-1])
    np.testing.assert_array_equal(other.h, h[::-1])
    np.testing.assert_array_equal(other.M, M[::-1])
    np.testing.assert_array_equal(other.J, J[::-1])
    np.testing.assert_array_equal(model.at(q, dq).J, J)


def test_members_of_a_batch_believe_different_things() -> None:
    models = [load_model("lwa4d_3dof", ArmEdits(mass_scale=scale)) for scale in (1.0, 1.5)]
    q = np.repeat(states(3, 1)[0], 2, axis=0)
    at = NominalModel(models, 2).at(q)
    np.testing.assert_allclose(at.h[1], 1.5 * at.h[0], rtol=1e-12)
    np.testing.assert_allclose(at.M[1], 1.5 * at.M[0], atol=1e-14)


def test_the_closed_form_says_what_it_cannot_describe() -> None:
    with pytest.raises(ModelError, match="describes the 3-DOF arm; this model has 7 joints"):
        ClosedForm3(load_model("lwa4d_7dof"))
    for edits in (
        ArmEdits(payload=Payload(mass=1.0, com=(0.05, 0.0, 0.0))),
        ArmEdits(payload=Payload(mass=1.0, com=(0.0, 0.02, 0.0))),
        ArmEdits(gravity=(1.0, 0.0, -9.81)),
    ):
        with pytest.raises(
            ModelError, match="gravity along z and every link's mass on the link's axis; use dynamics: mujoco"
        ):
            ClosedForm3(load_model("lwa4d_3dof", edits))
