"""Regressor, base parameters, equations, fits and intervals, each against another road to the same numbers."""

from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planar_rig import THESIS_MOTION

from lwa4d_sim import Scenario, run
from lwa4d_sim.arm import ARMS
from lwa4d_sim.edits import ArmEdits, Friction
from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.identification.base import base_of, random_regressor
from lwa4d_sim.identification.equations import bump, equations
from lwa4d_sim.identification.estimate import fit, recursive
from lwa4d_sim.identification.friction import friction_of
from lwa4d_sim.identification.inertia import from_pseudo_inertia, pseudo_inertia, standard_parameters
from lwa4d_sim.identification.options import Identify
from lwa4d_sim.identification.parameters import unknowns_of
from lwa4d_sim.identification.regressor import Regressor
from lwa4d_sim.identification.sets import base_set, thesis_set
from lwa4d_sim.identification.smooth import Spline
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import chain_of, load_model, model_path
from lwa4d_sim.recordings.recording import Recording

NAMES = tuple(ARMS)


def states(n: int, count: int = 60, seed: int = 0) -> Array:
    """Positions, speeds and accelerations within all joint limits (3, count, n)."""
    return np.random.default_rng(seed).uniform(-0.9, 0.9, (3, count, n))


def inverse_dynamics(model: Any, q: Array, dq: Array, ddq: Array) -> Array:
    data = mujoco.MjData(model)
    tau = np.empty_like(q)
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], dq[k], ddq[k]
        mujoco.mj_inverse(model, data)
        tau[k] = data.qfrc_inverse + data.qfrc_constraint  # an end stop is no part of the law
    return tau


def regressor_of(model: Any) -> Regressor:
    return Regressor(chain_of(model), model.opt.gravity)


@pytest.mark.parametrize("name", NAMES)
def test_regressor_times_parameters_is_mujoco_s_inverse_dynamics(name: str) -> None:
    model = load_model(name)
    q, dq, ddq = states(model.nv)
    tau = regressor_of(model).torque(q, dq, ddq) @ standard_parameters(model).ravel()
    np.testing.assert_allclose(tau, inverse_dynamics(model, q, dq, ddq), rtol=0, atol=1e-9)


def test_armature_and_viscous_friction_complete_inverse_dynamics() -> None:
    edits = ArmEdits(armature=(0.3, 0.2, 0.1), friction=Friction(viscous=(3.0, 2.0, 1.0)), payload=None)
    model = load_model("lwa4d_3dof", edits)
    u = unknowns_of(model, ("viscous", "armature"))
    q, dq, ddq = states(3)
    Y = np.zeros((len(q), 3, len(u.names)))
    Y[..., :30] = regressor_of(model).torque(q, dq, ddq)
    Y[:, np.arange(3), u.columns("viscous")], Y[:, np.arange(3), u.columns("armature")] = dq, ddq
    np.testing.assert_allclose(Y @ u.values(model), inverse_dynamics(model, q, dq, ddq), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_regressor_is_pinocchio_s(name: str) -> None:
    pinocchio = pytest.importorskip("pinocchio", reason="needs Pinocchio: pip install pin")
    made = pinocchio.buildModelFromMJCF(str(model_path(name)))
    other = made[0] if isinstance(made, tuple) else made
    model, data = load_model(name), other.createData()
    q, dq, ddq = states(model.nv, 40, seed=1)
    Y = regressor_of(model).torque(q, dq, ddq)
    for k in range(len(q)):
        theirs = pinocchio.computeJointTorqueRegressor(other, data, q[k], dq[k], ddq[k])
        np.testing.assert_allclose(Y[k], theirs, rtol=0, atol=1e-9)


SLIDING = """
<mujoco><option gravity="1 2 -9"/><worldbody>
 <body pos="0.1 0 0.3" quat="0.9 0.1 0.3 0.2"><joint name="a" axis="1 0.2 0" pos="0.05 0.1 -0.02"/>
  <inertial pos="0.1 0.2 0.3" mass="2" fullinertia="0.05 0.06 0.07 0.01 -0.004 0.002"/>
  <body pos="0.2 0.1 0" euler="10 20 30"><joint name="b" type="slide" axis="0 1 1"/>
   <inertial pos="0 0.1 0" mass="1" diaginertia="0.02 0.03 0.04"/>
   <body pos="0 0 0.4"><joint name="c" axis="0 0 1" pos="0.1 0 0"/>
    <inertial pos="0.05 0 0.1" mass="1.5" diaginertia="0.01 0.03 0.025"/>
    <body pos="0 0.2 0"><geom size="0.05" mass="0.7"/></body></body></body></body></worldbody>
 <actuator><motor joint="a" ctrlrange="-9 9"/><motor joint="b" ctrlrange="-9 9"/>
  <motor joint="c" ctrlrange="-9 9"/></actuator>
</mujoco>"""


def test_any_chain_with_sliding_joints_shifted_axes_and_welded_bodies() -> None:
    model = mujoco.MjModel.from_xml_string(SLIDING)
    q, dq, ddq = states(3)
    tau = regressor_of(model).torque(q, dq, ddq) @ standard_parameters(model).ravel()
    np.testing.assert_allclose(tau, inverse_dynamics(model, q, dq, ddq), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_momentum_changes_by_torque_and_slope_of_the_lagrangian(name: str) -> None:
    """d/dt p = tau + dL/dq along any motion: two regressors against the third, by central differences."""
    model = load_model(name)
    regressor, pi = regressor_of(model), np.random.default_rng(2).normal(size=10 * model.nv)
    q, dq, ddq = states(model.nv, seed=3)
    h = 1e-5
    ahead, behind = (regressor.momentum(q + s * h * dq, dq + s * h * ddq)[0] @ pi for s in (1.0, -1.0))
    slope = regressor.momentum(q, dq)[1] @ pi
    tau = regressor.torque(q, dq, ddq) @ pi
    np.testing.assert_allclose((ahead - behind) / (2.0 * h), tau + slope, atol=1e-7)


def test_states_of_the_wrong_shape_are_refused() -> None:
    with pytest.raises(IdentificationError, match=r"\(4, 2\).*3 joints"):
        regressor_of(load_model("lwa4d_3dof")).torque(*np.zeros((3, 4, 2)))


@given(st.lists(st.floats(-1, 1), min_size=10, max_size=10))
def test_pseudo_inertia_and_back(numbers: list[float]) -> None:
    pi = np.array(numbers)
    np.testing.assert_allclose(from_pseudo_inertia(pseudo_inertia(pi)), pi, atol=1e-12)


@pytest.mark.parametrize(("name", "count"), [("lwa4d_planar", 6), ("lwa4d_3dof", 15), ("lwa4d_7dof", 43)])
def test_base_parameters_are_as_many_as_the_rank_and_give_the_same_torque(name: str, count: int) -> None:
    """43 is what is known of a seven-joint arm on a vertical first axis (Gautier's rules for revolute joints)."""
    u = unknowns_of(load_model(name), ())
    base, Y = base_of(u), random_regressor(u, seed=7)
    flat = Y.reshape(-1, Y.shape[-1])
    assert len(base.names) == count == np.linalg.matrix_rank(flat)
    np.testing.assert_allclose(Y[..., base.columns] @ base.combine, Y, rtol=0, atol=1e-9)


def test_base_parameters_in_words() -> None:
    base = base_of(unknowns_of(load_model("lwa4d_planar"), ("viscous", "armature")))
    assert base.words[:3] == (
        "link2.hx",
        "link2.hz + 0.328 link4.m",
        "link2.Iyy + 0.1076 link4.m + joint2.armature",
    )
    assert base.names[-1] == "joint4.armature"  # the motor sits on the link before it: the elbow's rotor is told apart
    assert "link2.m" in base.unseen


def test_known_unknowns_take_no_part() -> None:
    u = unknowns_of(load_model("lwa4d_planar"), ())
    base = base_of(u, ("link4.m",))
    assert "link4.m" not in " ".join(base.words)


def test_thesis_set_is_the_thesis_s_regressor() -> None:
    """Against eq. 5.2 written out; y25 of the printed eq. 5.3 is 0 where eq. 5.2 has cos(theta2 + theta4)."""
    model = load_model("lwa4d_planar")
    u = unknowns_of(model, ())
    made = thesis_set(u, (), u.values(model))
    q, dq, ddq = states(2)
    still = Regressor(u.chain, np.zeros(3))
    Y, Y0 = regressor_of(model).torque(q, dq, ddq), still.torque(q, dq, ddq)
    c2, c4, s4, c24 = np.cos(q[:, 0]), np.cos(q[:, 1]), np.sin(q[:, 1]), np.cos(q.sum(axis=1))
    (d2, d4), (a2, a4), zero = dq.T, ddq.T, np.zeros(len(q))
    first = [a2, a2 + a4, 2 * c4 * a2 + c4 * a4 - 2 * s4 * d2 * d4 - s4 * d4**2, c2, c24]
    second = [zero, a2 + a4, c4 * a2 + s4 * d2**2, zero, c24]
    expected = np.stack([np.stack(first, axis=-1), np.stack(second, axis=-1)], axis=1)
    np.testing.assert_allclose(made.columns(Y, Y - Y0), expected, atol=1e-12)
    values = made.combine @ u.values(model)
    np.testing.assert_allclose(values, [0.56644, 0.16151, 0.26043, 20.5931, 7.78914], rtol=3e-4)


def test_thesis_set_is_for_the_planar_arm_only() -> None:
    u = unknowns_of(load_model("lwa4d_3dof"), ())
    with pytest.raises(IdentificationError, match=r"lwa4d_planar.*use base"):
        thesis_set(u, (), np.zeros(len(u.names)))


def test_spline_keeps_slow_motion_and_its_adjoint_is_its_transpose() -> None:
    t = np.linspace(0.0, 4.0, 400)
    spline = Spline.through(t, np.sin(3.0 * t), 0.03)
    inner = np.linspace(0.2, 3.8, 50)
    for order, exact in enumerate((np.sin(3.0 * inner), 3.0 * np.cos(3.0 * inner), -9.0 * np.sin(3.0 * inner))):
        np.testing.assert_allclose(spline.at(inner, order), exact, atol=1e-5 * 30**order)
    rng = np.random.default_rng(0)
    noise, weights = rng.normal(size=len(t)), rng.normal(size=len(inner))
    moved = spline.refit(noise).at(inner, 1) @ weights
    np.testing.assert_allclose(moved, noise @ spline.adjoint((inner, 1, weights)), rtol=1e-9)


def test_spline_knows_how_noisy_its_samples_are_and_leaves_out_what_is_missing() -> None:
    t = np.linspace(0.0, 20.0, 2000)
    values = np.sin(t) + 1e-3 * np.random.default_rng(0).normal(size=len(t))
    values[100:110] = np.nan
    spline = Spline.through(t, values, 0.05)
    assert spline.noise == pytest.approx(1e-3, rel=0.06)
    assert len(spline.t) == 1990
    with pytest.raises(IdentificationError, match="too few"):
        Spline.through(t[:15], values[:15], 0.05)


def test_bump_has_integral_one_and_half_the_power_at_the_bandwidth() -> None:
    from lwa4d_sim.identification.equations import WIDTH

    x = np.linspace(-2.0, 2.0, 4001)
    phi = np.nan_to_num(bump(0)(x))
    assert np.trapezoid(phi, x) == pytest.approx(1.0, abs=1e-9)
    spectrum = np.trapezoid(phi * np.cos(2.0 * np.pi * WIDTH * x), x)
    assert spectrum**2 == pytest.approx(0.5, abs=1e-3)


def planar(loop: str, seconds: float = 8.0, plant: str = "{}") -> Any:
    """A short run of the planar arm."""
    text = (
        f"""
name: short
plant: {plant}
"""
        + THESIS_MOTION
        + f"""  duration: {seconds}
  lead_in: 1.0
controller: {{kind: pd_gravity, space: joint, kp: [30.0, 5.0], kd: [4.0, 0.5]}}
loop: {loop}
"""
    )
    return run(Scenario.parse(text))


def recording_of(log: Any, stamps: str = "plant") -> Recording:
    """Positions and held torques of a run, taken by hand: plant steps, or ticks of a loop without latency."""
    if stamps == "plant":
        t, q, tau, end = log.t[:-1], log.q[:-1], log.tau[:-1], log.t[-1]
    else:
        t, q, tau = log.ticks.t, log.ticks.q, log.ticks.tau
        end = t[-1] + 1e-9 * log.period
    times = np.repeat(t[:, None], q.shape[1], axis=1)
    none = np.zeros(q.shape[1])
    return Recording(
        joints=("joint2", "joint4"),
        t=times,
        q=q,
        since=times,
        tau=tau,
        position_step=none,
        torque_step=none,
        end=float(end),
        source="by hand",
    )


@pytest.fixture(scope="module")
def held() -> Recording:
    return recording_of(planar("{kind: sampled, period: 0.01}"), "ticks")


@pytest.fixture(scope="module")
def ideal() -> Recording:
    return recording_of(planar("{kind: ideal}"))


@pytest.mark.parametrize(("data", "bound"), [("ideal", 1e-6), ("held", 2e-4)])
def test_equations_hold_for_the_true_parameters(data: str, bound: float, request: pytest.FixtureRequest) -> None:
    """With the plant's parameters both sides agree: to rounding of sums, or for a held torque to the spline's error."""
    model = load_model("lwa4d_planar")
    u = unknowns_of(model, ("coulomb",))
    made = equations(request.getfixturevalue(data), u, 5.0, friction_of(model), np.zeros(2))
    wrong = made.b - made.Y @ u.values(model)
    assert (np.sqrt((wrong**2).mean(axis=0)) < bound * made.b.std(axis=0)).all()


def test_a_gap_leaves_out_the_windows_it_touches_and_no_other(held: Recording) -> None:
    from dataclasses import replace

    model = load_model("lwa4d_planar")
    u = unknowns_of(model, ())
    friction, none = friction_of(model), np.zeros(2)
    whole = equations(held, u, 5.0, friction, none)
    tau, q = held.tau.copy(), held.q.copy()
    tau[300:305, 1], q[500:520, 0] = np.nan, np.nan
    cut = equations(replace(held, tau=tau, q=q), u, 5.0, friction, none)
    gone = np.setdiff1d(np.round(whole.t, 9), np.round(cut.t, 9))
    assert len(gone) > 0
    assert ((np.abs(gone - 3.02) < 0.2) | (np.abs(gone - 5.1) < 0.3)).all()
    x = u.values(model)
    # the spline feels the gap for a while, by a factor 0.4 less every knot; without the margin it is 0.002 N m
    assert np.abs(cut.b - cut.Y @ x).max() < 5e-4


@pytest.mark.parametrize(("change", "message"), [("short", "too short"), ("joints", "has 2 joints, the arm has 3")])
def test_data_that_cannot_serve(change: str, message: str, held: Recording) -> None:
    from dataclasses import replace

    model = load_model("lwa4d_3dof" if change == "joints" else "lwa4d_planar")
    if change == "short":
        held = replace(held, t=held.t[:50], q=held.q[:50], since=held.since[:50], tau=held.tau[:50], end=0.5)
    with pytest.raises(IdentificationError, match=message):
        equations(held, unknowns_of(model, ()), 5.0, friction_of(model), np.zeros(model.nv))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_recursive_least_squares_ends_where_the_batch_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    Y, x = rng.normal(size=(80, 2, 4)), rng.normal(size=4)
    b = Y @ x + 0.1 * rng.normal(size=(80, 2))
    batch = fit(Y, b, np.zeros(4), np.ones(4))
    *_, last = recursive(Y, b, batch.weights)
    np.testing.assert_allclose(last, batch.x, rtol=1e-5, atol=1e-7)
    normal = sum(y.T @ np.diag(batch.weights) @ y for y in Y)
    right = sum(y.T @ (batch.weights * v) for y, v in zip(Y, b, strict=True))
    np.testing.assert_allclose(batch.x, np.linalg.solve(normal, right), rtol=1e-8)  # eq. 4.29, weighted
    np.testing.assert_allclose(np.einsum("rwn,wn->r", batch.gain, b), batch.x, rtol=1e-8)


def test_what_data_do_not_tell_has_no_number() -> None:
    rng = np.random.default_rng(0)
    Y = rng.normal(size=(100, 2, 3))
    Y[..., 2] = 2.0 * Y[..., 1]
    found = fit(Y, Y @ np.ones(3), np.array([0.0, 0.0, 5.0]), np.ones(3))
    assert found.lost.tolist() == [False, True, True]
    assert np.isnan(found.x[1:]).all()
    assert np.isfinite(found.x[0])
    np.testing.assert_allclose(Y @ found.nearest, Y @ np.ones(3), atol=1e-9)  # the sum of the two is told all the same
    with pytest.raises(IdentificationError, match="too few"):
        fit(Y[:2], np.ones((2, 2)), np.zeros(3), np.ones(3))


def test_total_least_squares_has_no_bias_where_the_ordinary_has() -> None:
    """Noise of variance s^2 on a column of variance 1 draws its estimate to 1 / (1 + s^2); total undoes that."""
    rng = np.random.default_rng(0)
    true, noise = rng.normal(size=(20000, 1, 2)), 0.3 * rng.normal(size=(20000, 1, 2))
    noise[..., 1] = 0.0
    Y, b = true + noise, true @ np.array([2.0, -1.0]) + 3.0 * rng.normal(size=(20000, 1))
    plain = fit(Y, b, np.zeros(2), np.ones(2))
    assert plain.x[0] == pytest.approx(2.0 / 1.09, rel=0.03)
    spread = np.diag([0.09, 0.0, 0.0]) * 20000 * plain.weights[0]  # of b it need not know
    np.testing.assert_allclose(fit(Y, b, np.zeros(2), np.ones(2), "total", spread).x, [2.0, -1.0], rtol=0.04)


def test_unknown_names_are_refused_with_those_that_exist() -> None:
    from lwa4d_sim.identification.problem import Problem

    with pytest.raises(IdentificationError, match=r"there are link2\.m, "):
        Problem.of(Identify(known={"link9.m": 1.0}), load_model("lwa4d_planar"))


def test_base_set_gives_the_torque_of_its_unknowns() -> None:
    u = unknowns_of(load_model("lwa4d_3dof"), ("viscous", "armature"))
    made = base_set(u, ())
    x = np.random.default_rng(0).normal(size=len(made.names))
    np.testing.assert_allclose(made.combine @ made.unknowns(x), x, rtol=0, atol=1e-9)
    Y = random_regressor(u)
    np.testing.assert_allclose(made.columns(Y, 0.0 * Y) @ x, Y @ made.unknowns(x), atol=1e-8)
