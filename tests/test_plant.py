"""The plant: exact motion, brakes, pushes, and a divergence that is seen, timed and never taken for calm."""

import json
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from lwa4d_sim.dynamics import ClosedForm3, NominalModel
from lwa4d_sim.edits import ArmEdits
from lwa4d_sim.errors import ModelError, ScenarioError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import load_model
from lwa4d_sim.plant import SPEED_LIMIT, Disturbance, Plant
from lwa4d_sim.record import RunLog
from lwa4d_sim.runner import run, run_batch
from lwa4d_sim.scenario import Scenario

Q3 = np.array([[-1.5, -1.0, 1.0]])
Q7 = np.array([[-1.5, 0.3, 0.2, 1.5, 0.1, 0.4, 0.2]])


def model(
    name: str = "lwa4d_3dof", *, timestep: float = 0.001, integrator: str = "RK4", **edits: Any
) -> mujoco.MjModel:
    return load_model(name, ArmEdits(**edits), timestep=timestep, integrator=integrator, tool_body=True)


# Shorter than the fall takes to the joint limits, which are springs of the engine and none of the closed form's.
FALL = 0.3  # [s]


def swing(timestep: float, tau: Array, duration: float = FALL, *, integrator: str = "RK4") -> tuple[Array, Array]:
    plant = Plant(model(timestep=timestep, integrator=integrator), Q3)
    q, dq = plant.advance(tau[None, None], round(duration / timestep))
    return q[0], dq[0]


def closed_form_swing(tau: Array, duration: float = FALL) -> Array:
    """The same motion by another road: the closed form, integrated by another method."""
    terms = ClosedForm3(model())

    def derivative(t: float, y: Array) -> Array:
        at = terms.at(y[None, :3], y[None, 3:])
        return np.concatenate([y[3:], np.linalg.solve(at.M[0], tau - at.h[0])])

    found = solve_ivp(derivative, (0.0, duration), [*Q3[0], 0, 0, 0], "DOP853", rtol=1e-12, atol=1e-13)
    return np.asarray(found.y[:, -1])


def test_rk4_is_exact_and_of_fourth_order() -> None:
    tau = np.array([3.0, -40.0, -10.0])
    truth = closed_form_swing(tau)
    errors = [
        np.abs(np.concatenate([part[-1] for part in swing(dt, tau)]) - truth).max() for dt in (0.01, 0.005, 0.001)
    ]
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.3)
    assert errors[2] < 5e-9
    euler = np.abs(swing(0.001, tau, integrator="Euler")[0][-1] - truth[:3]).max()
    assert euler > 1e4 * errors[2]


@pytest.mark.parametrize(("name", "q0"), [("lwa4d_3dof", Q3), ("lwa4d_7dof", Q7)])
def test_energy_is_kept_without_friction(name: str, q0: Array) -> None:
    compiled = model(name)
    plant = Plant(compiled, q0)
    q, dq = plant.advance(np.zeros((1, 1, q0.shape[1])), 300)
    states = [np.concatenate([q0, q[0, ::30]]), np.concatenate([0 * q0, dq[0, ::30]])]
    kinetic = 0.5 * np.einsum(
        "ti,tij,tj->t", states[1], NominalModel(compiled, len(states[0])).at(*states).M, states[1]
    )
    data, potential = mujoco.MjData(compiled), []
    for angles in states[0]:
        data.qpos[:] = angles
        mujoco.mj_kinematics(compiled, data)
        mujoco.mj_comPos(compiled, data)
        potential.append(9.81 * float(compiled.body_mass @ data.xipos[:, 2]))
    energy = kinetic + np.array(potential)
    assert np.ptp(kinetic) > 1.0
    np.testing.assert_allclose(energy, energy[0], atol=1e-7)


@given(cuts=st.lists(st.integers(1, 59), max_size=5, unique=True), seed=st.integers(0, 9))
@settings(max_examples=20, derandomize=True, deadline=None)
def test_stretches_do_not_matter(cuts: list[int], seed: int) -> None:
    """One advance of 60 steps is several shorter ones, bit for bit, pushes and brakes included."""
    rng = np.random.default_rng(seed)
    tau = rng.normal(size=(2, 60, 3)) * 20.0
    tau[0, 10:13] = np.nan
    tau[1, 40:] = np.nan
    push = [Disturbance(at=0.0152, duration=0.02, force=(30.0, 0.0, 10.0))]
    whole, parts = (Plant(model(), np.repeat(Q3, 2, axis=0), push) for _ in range(2))
    q, dq = (a.copy() for a in whole.advance(tau, 60))
    edges = [0, *sorted(cuts), 60]
    pieces = [[a.copy() for a in parts.advance(tau[:, a:b], b - a)] for a, b in pairwise(edges)]
    np.testing.assert_array_equal(np.concatenate([piece[0] for piece in pieces], axis=1), q)
    np.testing.assert_array_equal(np.concatenate([piece[1] for piece in pieces], axis=1), dq)


def test_brakes_hold_and_release() -> None:
    plant = Plant(model(), np.repeat(Q3, 3, axis=0))
    q, dq = plant.advance(None, 20)
    np.testing.assert_array_equal(q, np.broadcast_to(Q3, (3, 20, 3)))
    np.testing.assert_array_equal(dq, 0.0)
    tau = np.zeros((3, 30, 3))
    tau[0] = np.nan  # all closed
    tau[1, 10:20, 1] = np.nan  # one joint's brake is the arm's brake
    q, dq = (a.copy() for a in plant.advance(tau, 30))
    np.testing.assert_array_equal(q[0], np.broadcast_to(Q3, (30, 3)))
    np.testing.assert_array_equal(q[1, :10], q[2, :10])
    np.testing.assert_array_equal(q[1, 10:20], np.broadcast_to(q[1, 9], (10, 3)))
    np.testing.assert_array_equal(dq[1, 10:20], 0.0)
    assert np.abs(dq[1, 9]).max() > 0.01
    assert np.abs(dq[1, 20:]).min(axis=0)[1] > 0.0
    # released, it starts again from rest where it stood
    again = Plant(model(), q[1:2, 19])
    np.testing.assert_array_equal(again.advance(np.zeros((1, 1, 3)), 10)[0], q[1:2, 20:])


def pushed(push: Disturbance, steps: int, *, gravity: bool = False) -> tuple[Array, Array]:
    edits: dict[str, Any] = {} if gravity else {"gravity": (0.0, 0.0, 0.0)}
    q, dq = Plant(model(**edits), Q3, [push]).advance(np.zeros((1, 1, 3)), steps)
    return np.concatenate([Q3, q[0]]), np.concatenate([0 * Q3, dq[0]])


def test_a_tap_on_the_tool_gives_its_momentum() -> None:
    force = (20.0, -30.0, 40.0)
    _, dq = pushed(Disturbance(at=0.005, duration=0.001, force=force), 10)
    np.testing.assert_array_equal(dq[:6], 0.0)
    terms = ClosedForm3(model()).at(Q3)
    expected = np.linalg.solve(terms.M[0], terms.J[0, :3].T @ np.array(force)) * 0.001
    np.testing.assert_allclose(dq[6], expected, rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize(("wrench", "rows"), [("force", slice(0, 3)), ("torque", slice(3, 6))])
def test_a_long_push_acts_at_the_moving_tool(wrench: Any, rows: slice) -> None:
    vector = np.array([5.0, -8.0, 6.0])
    given: Any = {wrench: tuple(vector)}
    q, dq = pushed(Disturbance(at=0.0, **given), 150, gravity=True)
    terms = ClosedForm3(model())

    def derivative(t: float, y: Array) -> Array:
        at = terms.at(y[None, :3], y[None, 3:])
        return np.concatenate([y[3:], np.linalg.solve(at.M[0], at.J[0, rows].T @ vector - at.h[0])])

    found = solve_ivp(derivative, (0.0, 0.15), [*Q3[0], 0, 0, 0], "DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(np.concatenate([q[-1], dq[-1]]), found, atol=1e-8)


def test_a_push_on_a_named_body_acts_at_its_centre_of_mass() -> None:
    _, dq = pushed(Disturbance(at=0.0, duration=0.001, force=(0.0, 0.0, 50.0), body="link4"), 1)
    compiled = model()
    data, J = mujoco.MjData(compiled), np.zeros((3, 3))
    data.qpos[:] = Q3[0]
    mujoco.mj_forward(compiled, data)
    mujoco.mj_jacBodyCom(compiled, data, J, None, compiled.body("link4").id)
    expected = np.linalg.solve(ClosedForm3(compiled).at(Q3).M[0], J.T @ [0.0, 0.0, 50.0]) * 0.001
    np.testing.assert_allclose(dq[1], expected, rtol=2e-3, atol=1e-6)


def test_pushes_start_and_end_on_the_grid_and_add_up() -> None:
    _, dq = pushed(Disturbance(at=0.0101, duration=0.0031, force=(0.0, 10.0, 0.0)), 20)
    kicked = np.abs(np.diff(dq[:, 0])) > 1e-4
    np.testing.assert_array_equal(np.flatnonzero(kicked), [11, 12, 13])  # 10.1 up to 13.2 ms, rounded up
    half = Disturbance(at=0.002, duration=0.003, force=(0.0, 10.0, 0.0))
    edits = model(gravity=(0.0, 0.0, 0.0))
    two = Plant(edits, Q3, [half, half]).advance(np.zeros((1, 1, 3)), 10)[0]
    one = Plant(edits, Q3, [Disturbance(at=0.002, duration=0.003, force=(0.0, 20.0, 0.0))]).advance(
        np.zeros((1, 1, 3)), 10
    )
    np.testing.assert_array_equal(two, one[0])


def test_an_unknown_body_is_named_with_those_there_are() -> None:
    with pytest.raises(ModelError, match="no body 'hand' in the model; its bodies are link1, link2, link4"):
        Plant(load_model("lwa4d_3dof"), Q3, [Disturbance(at=0.0, body="hand")])


def test_the_engines_own_warnings_are_a_divergence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any) -> None:
    monkeypatch.chdir(tmp_path)
    plant = Plant(model(), np.repeat(Q3, 3, axis=0))
    plant.advance(np.zeros((3, 1, 3)), 5)
    assert plant.diverged() is None
    plant.dq[1] = 1e200  # the next step overflows
    plant.advance(np.zeros((3, 1, 3)), 5)
    np.testing.assert_array_equal(plant.diverged(), [False, True, False])
    assert plant.running.tolist() == [True, False, True]
    q, dq = plant.advance(np.ones((3, 1, 3)), 5)  # the lost arm stands, the others go on as one that is alone
    np.testing.assert_array_equal(dq[1], 0.0)
    np.testing.assert_array_equal(q[0], q[2])
    alone = Plant(model(), Q3)
    alone.advance(np.zeros((1, 1, 3)), 10)
    np.testing.assert_array_equal(q[:1], alone.advance(np.ones((1, 1, 3)), 5)[0])
    out = capfd.readouterr()
    assert out.out + out.err == ""
    assert list(tmp_path.iterdir()) == []  # MuJoCo would leave a log file


def test_speed_and_request_are_a_divergence() -> None:
    plant = Plant(model(), np.repeat(Q3, 3, axis=0))
    plant.dq[0, 1] = -1.01 * SPEED_LIMIT
    np.testing.assert_array_equal(plant.diverged(), [True, False, False])
    plant.give_up(np.array([False, False, True]))
    np.testing.assert_array_equal(plant.diverged(), [False, False, True])
    plant.dq[1, 0] = np.nan
    np.testing.assert_array_equal(plant.diverged(), [False, True, False])


def scenario(arm: str = "lwa4d_7dof", **overrides: Any) -> Scenario:
    q0 = Q7[0] if arm != "lwa4d_3dof" else Q3[0]
    document = {
        "name": "wild",
        "arm": arm,
        "initial": {"q": q0.tolist()},
        "trajectory": {
            "waypoints": {"space": "joint", "points": [(q0 + 0.2).tolist()]},
            "segment_time": 0.5,
            "profile": "step",
            "follow": "joint",
        },
        "controller": {"kind": "computed_torque", "kp": 100.0, "kd": 20.0},
    }
    return Scenario.parse(json.dumps(document), overrides=overrides)


def check_diverged(log: RunLog) -> None:
    """The record ends where the motion left all bounds, and says so."""
    assert log.diverged_at is not None
    assert log.t[-1] == pytest.approx(log.diverged_at - log.timestep / 1e9, abs=1e-12)
    assert log.events[-1] == (log.diverged_at, "diverged")
    for signal in (log.q, log.dq, log.tau):
        assert np.isfinite(signal).all()
    assert np.abs(log.dq).max() < SPEED_LIMIT
    assert np.abs(log.dq[-1]).max() > 0.3 * SPEED_LIMIT  # not calm: it did not go back to its start
    metrics = log.metrics()
    assert metrics["stable"] is False
    assert metrics["diverged_at"] == log.diverged_at


WILD = {"controller.kp": 1e6, "controller.kd": 1e3}


@pytest.mark.parametrize("integrator", ["RK4", "Euler"])
@pytest.mark.parametrize("space", ["joint", "task"])
def test_an_absurd_gain_diverges_and_is_reported(space: str, integrator: str) -> None:
    long: dict[str, Any] = {"trajectory.segment_time": 2.0, "plant.integrator": integrator}
    check_diverged(run(scenario(**{**WILD, "controller.space": space, **long})))


def test_a_diverging_member_leaves_the_others_alone() -> None:
    members: list[dict[str, Any]] = [{}, WILD, {"controller.kp": 120.0}, {"controller.kd": 1e5}]
    logs = list(run_batch(scenario(), members))
    assert [log.diverged_at is not None for log in logs] == [False, True, False, True]
    for log, member in zip(logs, members, strict=True):
        alone = run(scenario(**member))
        assert log.diverged_at == alone.diverged_at
        assert log.events == alone.events
        for name in ("q", "dq", "tau"):
            np.testing.assert_array_equal(getattr(log, name), getattr(alone, name))
        np.testing.assert_array_equal(log.ticks.tau, alone.ticks.tau)


@pytest.mark.parametrize("loop", ["ideal", "sampled"])
@pytest.mark.parametrize("space", ["joint", "task"])
def test_a_motor_without_limit_overflows_in_peace(tmp_path: Path, space: str, loop: str) -> None:
    """No torque limit and gains up to the end of the numbers: no exception, no warning, no NaN in the record."""
    shipped = (Path(__file__).parents[1] / "models" / "lwa4d_7dof.xml").read_text()
    path = tmp_path / "free.xml"
    path.write_text(re.sub(r'(ctrl|force|actuatorfrc)range="[^"]*"', "", shipped))
    for kp in (1e6, 1e8):
        overrides = {"controller.kp": kp, "controller.kd": kp / 1e3, "controller.space": space, "loop": {"kind": loop}}
        log = run(scenario(str(path), **overrides))
        assert log.diverged_at is not None
        assert log.diverged_at < 0.4
        for signal in (log.q, log.dq, log.tau, log.ticks.q):
            assert np.isfinite(signal).all()


BROKEN = """
import numpy as np

class Broken:
    def __init__(self):
        self.calls = 0

    def torque(self, state, ref, model):
        self.calls += 1
        tau = model.at(state.q).h
        tau[0] = np.nan if self.calls > 5 else tau[0]
        return tau
"""


def test_a_torque_that_is_no_number_is_no_closed_brake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "broken_law.py").write_text(BROKEN)
    monkeypatch.syspath_prepend(tmp_path)
    custom: dict[str, Any] = {"controller": {"kind": "broken_law:Broken"}}
    log = run(scenario(**custom))
    assert log.diverged_at == pytest.approx(0.06)
    assert log.metrics()["stable"] is False
    lost, kept = run_batch(scenario(**custom), [{"plant.seed": 0}, {"plant.seed": 1}])
    assert lost.diverged_at == log.diverged_at
    assert kept.diverged_at is None
    assert kept.tau.any()


@pytest.mark.parametrize(
    "change",
    [
        {"plant.disturbances": [{"at": 0.0, "force": [0.0, 0.0, 50.0]}]},
        {"plant.disturbances": [{"at": 0.0, "force": [0.0, 0.0, 50.0], "body": "link4"}]},
        {"plant.timestep": 0.002},
    ],
)
def test_a_batch_refuses_to_mix_what_its_members_share(change: dict[str, Any]) -> None:
    with pytest.raises(ScenarioError, match="member 1 of the batch differs in"):
        list(run_batch(scenario(), [{}, change]))


def test_single_brakes_make_the_seven_joint_arm_the_three_joint_arm() -> None:
    """The others feel a held joint as part of its link, and a released one moves on from where it stood."""
    free, held = [0, 1, 3], np.array([False, False, True, False, True, True, True])
    q3 = np.array([[0.3, -1.1, 0.9]])
    q7 = np.zeros((1, 7))
    q7[:, free] = q3 + np.array([0.0, np.pi / 2, 0.0])
    three = Plant(load_model("lwa4d_3dof", timestep=0.001, integrator="RK4"), q3)
    seven = Plant(load_model("lwa4d_7dof", timestep=0.001, integrator="RK4"), q7)
    seven.hold(held)
    tau3, tau7 = np.array([[[2.0, -20.0, -4.0]]]), np.zeros((1, 1, 7))
    tau7[0, 0, free] = tau3[0, 0]
    for _ in range(15):
        q, dq = three.advance(tau3, 10)
        p, dp = seven.advance(tau7, 10)
    np.testing.assert_allclose(p[:, :, free], q + np.array([0.0, np.pi / 2, 0.0]), atol=1e-5)
    np.testing.assert_allclose(dp[:, :, free], dq, atol=1e-4)
    assert np.abs(dq).max() > 1.0, "it moved"
    np.testing.assert_array_equal(p[:, :, held], 0.0)
    seven.hold(np.zeros(7, bool))
    p, dp = seven.advance(tau7, 10)
    assert np.abs(p[:, -1][:, held]).max() > 1e-6
