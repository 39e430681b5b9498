"""Fourier motions with leads, and excitations found within an arm's limits."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from lwa4d_sim.arm import ARMS, load_arm
from lwa4d_sim.chain import SerialKinematics
from lwa4d_sim.edits import ArmEdits
from lwa4d_sim.errors import IdentificationError, LwaError, RecordError
from lwa4d_sim.excitation.clearance import Clearance
from lwa4d_sim.excitation.design import Excitation, ExcitationWish, optimise
from lwa4d_sim.excitation.information import Information
from lwa4d_sim.excitation.limits import known_speeds, limits_of, predicted_torque
from lwa4d_sim.excite_cli import excite
from lwa4d_sim.interfaces import Array, JointReference
from lwa4d_sim.mjcf import chain_of, home, load_model
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.trajectories import THESIS_EXCITATION, FourierMotion

PLANAR = load_arm("lwa4d_planar").kinematics
THREE = load_model("lwa4d_3dof", ArmEdits(armature="lwa4d", friction="lwa4d"))
SPEED = ARMS["lwa4d_3dof"].velocity_max
SHORT = ExcitationWish(harmonics=3, period=6.0, periods=2, lead_in=3.0, lead_out=1.0, iterations=100)

amplitude = st.floats(-1.0, 1.0)
time = st.floats(0.2, 5.0)


# leads


@given(
    a=st.tuples(st.tuples(amplitude, amplitude), st.tuples(amplitude, amplitude)),
    b=st.tuples(st.tuples(amplitude, amplitude), st.tuples(amplitude, amplitude)),
    offset=st.tuples(amplitude, amplitude),
    q0=st.tuples(amplitude, amplitude),
    lead_in=time,
    lead_out=time,
)
def test_leads_start_and_end_at_rest_without_a_jump(
    a: Any, b: Any, offset: Any, q0: Any, lead_in: float, lead_out: float
) -> None:
    motion = FourierMotion(a=a, b=b, offset=offset, omega=1.3, duration=4.0, lead_in=lead_in, lead_out=lead_out)
    running = motion.build(PLANAR, np.array(q0))
    np.testing.assert_allclose(running.knots, np.cumsum([lead_in, 4.0, lead_out]))
    first, last = running.joint(np.zeros(1)), running.joint(running.knots[-1:])
    np.testing.assert_array_equal(first.q[0], q0)
    for rest in (first.dq, first.ddq, last.dq, last.ddq):
        np.testing.assert_array_equal(rest, 0.0)
    # a quintic over 0.2 s from rest to speed 2 at distance 4 has jerks up to 60 * 4 / 0.2^3 and 36 * 2 / 0.2^2, and
    # its fourth derivative is 6 / 0.2 times that; in 1e-9 s its acceleration thus changes by less than 1e-4
    for knot in running.knots:
        before, after = (running.joint(np.array([knot + shift])) for shift in (-1e-9, 1e-9))
        if knot < running.knots[-1]:
            for one, other in zip(before, after, strict=True):
                np.testing.assert_allclose(one, other, atol=2e-4)
        np.testing.assert_allclose(before.ddq, after.ddq, atol=2e-4)


@pytest.mark.parametrize("part", [0, 1, 2])
def test_rates_of_leads_are_derivatives(part: int) -> None:
    motion = replace(THESIS_EXCITATION, lead_in=3.0, lead_out=2.0, duration=6.0)
    running = motion.build(PLANAR, np.array([0.4, -0.3]))
    t = np.array([0.7, 1.9]) + [0.0, 3.0, 9.0][part]
    t = np.minimum(t, running.duration - 0.1)
    h = 1e-4
    low, mid, high = (running.joint(t + shift) for shift in (-h, 0.0, h))
    np.testing.assert_allclose((high.q - low.q) / (2 * h), mid.dq, atol=1e-6)  # h^2 times a jerk below 100
    np.testing.assert_allclose((high.dq - low.dq) / (2 * h), mid.ddq, atol=1e-5)


def test_braking_ends_near_the_series_end() -> None:
    motion = replace(THESIS_EXCITATION, duration=5.0, lead_out=2.0)
    running = motion.build(PLANAR, np.zeros(2))
    end = running.joint(np.array([5.0]))
    last = running.joint(np.array([7.0]))
    np.testing.assert_allclose(last.q, end.q + end.dq * 2.0 / 2.0, atol=1e-12)


def test_without_leads_the_motion_has_the_bits_of_its_formula() -> None:
    motion = replace(THESIS_EXCITATION, omega=1.7, offset=(0.3, -0.2))
    t = np.linspace(0.0, 19.999, 777)
    a, b, k = np.array(motion.a), np.array(motion.b), 1.7 * np.arange(1, 6)
    sin, cos = np.sin(t[:, None] * k), np.cos(t[:, None] * k)
    running = motion.build(PLANAR, np.array([1.0, 2.0]))
    np.testing.assert_array_equal(running.knots, [20.0])
    for found, expected in zip(
        running.joint(t),
        ([0.3, -0.2] + (sin / k) @ a.T - (cos / k) @ b.T, cos @ a.T + sin @ b.T, (cos * k) @ b.T - (sin * k) @ a.T),
        strict=True,
    ):
        np.testing.assert_array_equal(found, expected)


# distances

BALLS = """
<mujoco>
  <worldbody>
    {floor}
    <body name="one" pos="0 0 0"><joint name="j1" axis="0 1 0"/>
      <geom type="sphere" pos="0.3 0 0" size="0.05"/>
      <body name="two" pos="1 0 0"><joint name="j2" axis="0 1 0"/>
        <geom type="sphere" size="0.05"/>
        <body name="three" pos="1 0 0"><joint name="j3" axis="0 1 0"/>
          <geom type="sphere" pos="0.5 0 0" size="0.1"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="j1"/><motor joint="j2"/><motor joint="j3"/></actuator>
</mujoco>
"""


def balls(tmp_path: Path, floor: str = "") -> Any:
    path = tmp_path / "balls.xml"
    path.write_text(BALLS.format(floor=floor))
    return load_model(str(path))


def by_hand(q: Array) -> float:
    """Distance of the first and the third link's balls; axes along +y turn x towards -z."""
    first = 0.3 * np.exp(-1j * q[0])
    third = np.exp(-1j * q[0]) + np.exp(-1j * (q[0] + q[1])) + 0.5 * np.exp(-1j * q.sum())
    return float(abs(third - first) - 0.15)


def test_distances_and_slopes_are_those_of_trigonometry(tmp_path: Path) -> None:
    clearance = Clearance(balls(tmp_path))
    assert [clearance.name(k) for k in range(len(clearance.pairs))] == ["one - three"]
    q = np.random.default_rng(0).uniform(-3.0, 3.0, (40, 3))
    near = clearance.near(q, 10.0)
    np.testing.assert_array_equal(near.sample, np.arange(40))
    np.testing.assert_allclose(near.distance, [by_hand(one) for one in q], atol=1e-12)
    assert (near.distance < 0.0).any()  # hand-made collisions are among them
    h = 1e-6
    slopes = [[(by_hand(one + h * e) - by_hand(one - h * e)) / (2 * h) for e in np.eye(3)] for one in q]
    np.testing.assert_allclose(near.slope, slopes, atol=1e-8)
    distance, pair = clearance.nearest(q, 10.0)
    assert pair == "one - three"
    assert distance == pytest.approx(min(map(by_hand, q)), abs=1e-12)


def test_a_folded_arm_collides_and_a_straight_one_does_not(tmp_path: Path) -> None:
    clearance = Clearance(balls(tmp_path))
    folded = np.array([[0.0, 2.659, 2.434]])  # the third ball lies in the first
    assert by_hand(folded[0]) < 0.0
    assert clearance.nearest(folded, 1.0)[0] < 0.0
    assert clearance.nearest(np.zeros((1, 3)), 1.0) == (1.0, None)


def test_the_floor_counts_and_what_overlaps_always_is_named(tmp_path: Path) -> None:
    model = balls(tmp_path, '<geom type="plane" pos="0 0 -0.6" size="1 1 1"/>')
    clearance = Clearance(model)
    distance, pair = clearance.nearest(np.array([[0.0, 0.0, np.pi / 2]]), 1.0)  # third ball 0.5 below, radius 0.1
    assert pair == "world - three"
    assert distance == pytest.approx(0.0, abs=1e-12)
    assert clearance.left_out == []
    model.geom_size[model.ngeom - 1] = 9.0  # a ball so large that it is in everything always
    assert Clearance(model).left_out == ["one - three", "world - three"]


def test_joints_about_one_point_are_a_wrist() -> None:
    model = load_model("lwa4d_7dof")
    clearance = Clearance(model)
    pairs = {clearance.name(k) for k in range(len(clearance.pairs))}
    assert {"link2 - link4", "link1 - link4", "link4 - link7", "world - link2"} <= pairs
    assert not {"link1 - link3", "link3 - link5", "link5 - link7", "link3 - link4", "world - link1"} & pairs


# information


@pytest.fixture(scope="module")
def states() -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(3)
    q, dq, ddq = rng.uniform(-1.0, 1.0, (3, 30, 3))
    return q, 0.4 * dq, ddq


def test_slopes_of_information_and_torque_are_differences(states: tuple[Array, Array, Array]) -> None:
    information = Information(THREE, np.array([300.0, 200.0, 100.0]), SPEED)
    Y = information.columns(*states)
    slopes = information.slopes(*states, Y, counted=25)
    h = 1e-5
    for kind in range(3):
        for t, k in ((0, 0), (7, 1), (24, 2), (28, 1)):
            moved = [[x.copy() for x in states] for _ in range(2)]
            for side, sign in zip(moved, (1.0, -1.0), strict=True):
                side[kind][t, k] += sign * h
            high, low = (information.columns(*side) for side in moved)
            expected = (information.of(high[:25]) - information.of(low[:25])) / (2 * h)
            assert slopes.log_det[kind, t, k] == pytest.approx(expected, abs=2e-4)  # of values up to 10
            difference = (information.torque(high) - information.torque(low))[t] / (2 * h)
            np.testing.assert_allclose(slopes.torque[kind, t, :, k], difference, rtol=1e-3, atol=1e-3)


def test_the_regressor_and_mujoco_predict_the_same_torque(states: tuple[Array, Array, Array]) -> None:
    q, _, ddq = states
    fast = 0.3 * np.where(ddq > 0.0, -1.0, 1.0)  # where tanh(dq / turn) is 1 to 1e-6
    information = Information(THREE, np.ones(3), SPEED)
    tau = information.torque(information.columns(q, fast, ddq))
    np.testing.assert_allclose(tau, predicted_torque(THREE, q, fast, ddq), atol=1e-3)


def test_information_is_singular_at_rest_and_does_not_depend_on_the_torque_unit_s_shift(
    states: tuple[Array, Array, Array],
) -> None:
    q, dq, ddq = states
    still = np.zeros_like(q)
    one, other = (Information(THREE, scale * np.ones(3), SPEED) for scale in (1.0, 7.0))
    assert one.of(one.columns(q, still, still)) < one.of(one.columns(q, dq, ddq)) - 100.0
    assert one.of(one.columns(q, dq, ddq)) == pytest.approx(other.of(other.columns(q, dq, ddq)), rel=1e-9)


# designs


@pytest.fixture(scope="module")
def found() -> Excitation:
    return optimise(THREE, home(THREE), SPEED, SHORT)


def sampled(one: Excitation) -> JointReference:
    running = one.motion.build(SerialKinematics(chain_of(THREE)), one.start)
    return running.joint(np.arange(0.0, running.duration, 0.001))


def test_every_limit_is_kept_at_1_khz(found: Excitation) -> None:
    q, dq, ddq = sampled(found)
    assert len(q) == 16_000
    assert (np.abs(dq) <= 0.95 * SPEED).all()
    assert (q >= THREE.jnt_range[:, 0] + 0.05).all()
    assert (q <= THREE.jnt_range[:, 1] - 0.05).all()
    # not the road of the search: inverse dynamics and friction; the lowest points of the forearm's cylinders and ball
    data = mujoco.MjData(THREE)
    body = THREE.body("link4").id
    first, count = THREE.body_geomadr[body], THREE.body_geomnum[body]
    geoms = slice(first, first + count)
    cylinder = THREE.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_CYLINDER
    radius, half = THREE.geom_size[geoms, 0], np.where(cylinder, THREE.geom_size[geoms, 1], 0.0)
    tau, lowest, own = np.empty_like(q), np.inf, np.zeros(3)
    for k in range(len(q)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], dq[k], ddq[k]
        mujoco.mj_kinematics(THREE, data)
        mujoco.mj_comPos(THREE, data)
        mujoco.mj_comVel(THREE, data)
        mujoco.mj_rne(THREE, data, 1, own)
        tau[k] = own + THREE.dof_armature * ddq[k]
        axis, height = data.geom_xmat[geoms, 8], data.geom_xpos[geoms, 2]  # 8: z of the geom's own z axis
        tilt = np.where(cylinder, np.sqrt(np.maximum(0.0, 1.0 - axis**2)), 1.0)
        lowest = min(lowest, (height - half * np.abs(axis) - radius * tilt).min())
    tau += THREE.dof_damping * dq + THREE.dof_frictionloss * np.sign(dq)
    assert (np.abs(tau) <= 0.8 * np.array([372.0, 372.0, 176.0])).all()
    table = [one.reached or 0.0 for one in found.after.room if one.what == "torque"]
    one_period = np.r_[0:9000, 15_000:16_000]  # what is checked; the second period is like the first
    np.testing.assert_allclose(np.abs(tau[one_period]).max(axis=0), table, rtol=1e-9)
    assert lowest >= -0.02 + 0.02  # the floor lies at -0.02


def test_the_table_of_limits_is_that_of_the_motion(found: Excitation) -> None:
    q, dq, _ = sampled(found)
    rows = {(one.what, one.where): one for one in found.after.room}
    for j, name in enumerate(("joint1", "joint2", "joint4")):
        assert rows["speed", name].reached == pytest.approx(np.abs(dq[:, j]).max(), abs=1e-9)
        assert rows["speed", name].left >= 0.0
        assert rows["position", name].left == pytest.approx(
            min(q[:, j].min() - THREE.jnt_range[j, 0], THREE.jnt_range[j, 1] - q[:, j].max()) - 0.05, abs=1e-9
        )
    assert sum(one.what == "distance" for one in found.after.room) == 1


def test_the_search_tells_more_than_chance(found: Excitation) -> None:
    assert found.after.log_det > found.before.log_det + 10.0
    assert found.gain == pytest.approx(np.exp((found.after.log_det - found.before.log_det) / 50))
    assert found.parameters == 25
    assert found.after.condition < found.before.condition
    # the same by another road: singular values of the columns scaled to length 1
    q, dq, ddq = (x[3000:9000:10] for x in sampled(found))
    information = Information(THREE, 0.8 * np.array([372.0, 372.0, 176.0]), 0.95 * SPEED)
    Y = information.columns(q, dq, ddq)[..., information.base].reshape(-1, 25)
    values = np.linalg.svd(Y / np.linalg.norm(Y, axis=0), compute_uv=False)
    assert found.after.condition == pytest.approx(values[0] / values[-1], rel=1e-6)


def test_coefficients_are_rounded_and_seeds_repeat(found: Excitation) -> None:
    values = np.concatenate([np.ravel(found.motion.a), np.ravel(found.motion.b), np.ravel(found.motion.offset or ())])
    np.testing.assert_array_equal(values, np.round(values, 4))
    few = replace(SHORT, period=2.0, lead_in=1.0, lead_out=0.5, iterations=3)
    first, second = (optimise(THREE, home(THREE), SPEED, few) for _ in range(2))
    assert first == replace(second, start=first.start)
    assert optimise(THREE, home(THREE), SPEED, replace(few, seed=1)).motion != first.motion


def test_the_floor_is_kept_away_from_where_a_search_without_it_would_go(tmp_path: Path) -> None:
    wish = replace(SHORT, clearance=0.05)
    model, deep = (balls(tmp_path, f'<geom type="plane" pos="0 0 {z}" size="1 1 1"/>') for z in (-0.3, -9.0))
    kept, free = (optimise(one, np.zeros(3), np.ones(3), wish) for one in (model, deep))
    running = [one.motion.build(SerialKinematics(chain_of(model)), np.zeros(3)) for one in (kept, free)]
    lowest = []
    for one in running:
        q = one.joint(np.arange(0.0, one.duration, 0.01)).q.cumsum(axis=1)
        height = -np.cumsum(np.sin(q) * [1.0, 1.0, 0.5], axis=1)
        lowest.append(min(height[:, 2].min() - 0.1, height[:, 0].min() - 0.05))  # third ball, and the second
    assert lowest[0] >= -0.25
    assert lowest[1] < -0.25


# bad input


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: replace(SHORT, harmonics=0), r"harmonics \(=0\): must be from 1 to 20"),
        (lambda: replace(SHORT, period=float("nan")), r"period \(=nan\): must be"),
        (lambda: replace(SHORT, period=0.2), r"period \(=0\.2 s\): must be at least 0\.24 s for 3 harmonics"),
        (lambda: known_speeds("arm.xml", None, 2), r"speed limits of 'arm\.xml' are not known"),
        (lambda: known_speeds("arm.xml", [1.0, 2.0], 3), r"must be one number above 0 \[rad/s\], or 3 of them"),
        (lambda: known_speeds("arm.xml", [0.0], 3), r"must be one number above 0"),
        (lambda: optimise(THREE, np.array([3.14, 0, 0]), SPEED, SHORT), r"not safe: position of joint1 is 3\.14"),
        (lambda: optimise(THREE, np.array([0, 0.4, 1.2]), SPEED, SHORT), r"not safe: distance of "),
        (
            lambda: optimise(THREE, np.array([0, 0, 0.0]), SPEED, replace(SHORT, torque_share=0.05)),
            r"not safe: torque of joint2",
        ),
    ],
)
def test_what_cannot_be_is_named(make: Callable[[], object], message: str) -> None:
    with pytest.raises(IdentificationError, match=message):
        make()


def test_limits_take_their_margins_off() -> None:
    limits = limits_of(THREE, np.ones(3), position_margin=0.1, speed_share=0.5, torque_share=0.25, clearance=0.03)
    np.testing.assert_allclose(limits.upper, THREE.jnt_range[:, 1] - 0.1)
    np.testing.assert_allclose(limits.lower, THREE.jnt_range[:, 0] + 0.1)
    np.testing.assert_allclose(limits.speed, 0.5)
    np.testing.assert_allclose(limits.torque, [93.0, 93.0, 44.0])


# the command

SCENARIO = """
name: small
arm: own.xml
initial: {q: [0, 0, 0]}
trajectory: {kind: sampled, file: nowhere.csv}
controller: {kind: computed_torque, p: 5}
variants:
  ideal: {loop: {kind: ideal}}
  can: {initial: {q: [0.1, 0.2, 0.3]}}
expect:
  can: {stable: true}
"""
FAST = ("--harmonics", "2", "--period", "4", "--iterations", "60", "--speed", "2")


@pytest.fixture
def command(tmp_path: Path) -> Callable[..., Any]:
    app = typer.Typer()
    app.command()(excite)
    (tmp_path / "own.xml").write_text(BALLS.format(floor=""))
    (tmp_path / "small.yaml").write_text(SCENARIO)

    def run(*arguments: str) -> Any:
        out = ("-o", str(tmp_path / "out"))
        return CliRunner().invoke(app, [str(tmp_path / "small.yaml"), *out, *arguments])

    return run


def test_the_command_writes_a_scenario_that_loads(command: Callable[..., Any], tmp_path: Path) -> None:
    done = command(*FAST, "--json")
    assert done.exit_code == 0, done.output
    answer = json.loads(done.output)
    assert answer["variant"] == "can"
    assert answer["after"]["log_det"] > answer["before"]["log_det"]
    assert {row["what"] for row in answer["limits"]} == {"speed", "distance"}
    assert "no end stops limit j1, j2, j3" in answer["remarks"]
    assert "no torque limits j1, j2, j3" in answer["remarks"]
    made = Scenario.load(answer["file"])
    assert made.name == "excite_small"
    assert list(made.variants) == ["ideal", "can"]
    assert made.expect == {}
    settings_found = made.variants["can"]
    assert settings_found.arm == str(tmp_path / "own.xml")
    assert settings_found.initial.q == (0.1, 0.2, 0.3)
    motion = settings_found.trajectory
    assert isinstance(motion, FourierMotion)
    assert (motion.duration, motion.lead_in, motion.lead_out) == (8.0, 2.0, 0.8)
    assert motion.omega == pytest.approx(np.pi / 2)
    again = command(*FAST)  # replaces its own file
    assert again.exit_code == 0
    assert "room left" in again.output


def test_the_command_refuses_in_one_line(command: Callable[..., Any], tmp_path: Path) -> None:
    def refused(*arguments: str) -> LwaError:
        done = command(*arguments)
        assert isinstance(done.exception, LwaError)
        assert "\n" not in str(done.exception)
        return done.exception

    assert "must be numbers" in str(refused("--speed", "fast"))
    assert "are not known" in str(refused("--period", "4"))
    assert "initial.q of variant 'can'" in str(refused(*FAST, "--set", "variants.can.initial.q=[0, 0]"))
    assert "no variant 'bus'" in str(refused(*FAST, "--variant", "bus"))
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "excite_small.yaml").write_text("mine")
    assert isinstance(refused(*FAST), RecordError)
    assert (tmp_path / "out" / "excite_small.yaml").read_text() == "mine"
