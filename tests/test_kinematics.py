"""Kinematics by two roads: chain against DH and MuJoCo, derivatives against differences, inverse against forward."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lwa4d_sim.chain import Chain, SerialKinematics, bias_from_jacobian, rate_from_jacobian
from lwa4d_sim.dh import DH_7DOF, THESIS_DH_3DOF, dh_forward
from lwa4d_sim.errors import JointLimitError, KinematicsError, ReachError, SingularError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.kinematics import Lwa3Kinematics, SrsKinematics, kinematics_for
from lwa4d_sim.mjcf import chain_of, load_model
from lwa4d_sim.rotations import rotation_matrix

X, Y, Z = np.eye(3)
LIMITS_7 = [np.pi, 2.14, np.pi, 2.18, np.pi, 2.09, 2.96]  # ipa320/schunk_modular_robotics, lwa4d.urdf.xacro


def chain(pos: object, axis: object, tool: object, limits: object) -> Chain:
    pos, axis, upper = np.array(pos, float), np.array(axis, float), np.array(limits, float)
    n = len(pos)
    return Chain(
        names=tuple(f"joint{i + 1}" for i in range(n)),
        pos=pos,
        R=np.tile(np.eye(3), (n, 1, 1)),
        axis=axis,
        anchor=np.zeros((n, 3)),
        slide=np.zeros(n, bool),
        tool_pos=np.array(tool, float),
        tool_R=np.eye(3),
        lower=-upper,
        upper=upper,
    )


def seven() -> Chain:
    pos = [0 * Z, 0.300 * Z, 0 * Z, 0.328 * Z, 0 * Z, 0.320 * Z, 0 * Z]
    return chain(pos, [Z, Y, Z, Y, Z, Y, Z], 0.077 * Z, LIMITS_7)


def three() -> Chain:
    return chain([0 * Z, 0.300 * Z, 0.328 * X], [Z, Y, Y], 0.397 * X, [np.pi, np.inf, 2.18])


def odd(seed: int = 3) -> Chain:
    """Six joints in general position, one of them sliding, with anchors off the link frames."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=(6, 3))
    return Chain(
        names=tuple("abcdef"),
        pos=0.3 * rng.normal(size=(6, 3)),
        R=rotation_matrix(rng.normal(size=(6, 3))),
        axis=axis / np.linalg.norm(axis, axis=1, keepdims=True),
        anchor=0.1 * rng.normal(size=(6, 3)),
        slide=np.arange(6) == 2,
        tool_pos=rng.normal(size=3),
        tool_R=rotation_matrix(rng.normal(size=3)),
        lower=np.full(6, -np.inf),
        upper=np.full(6, np.inf),
    )


def disguised(c: Chain, seed: int = 5) -> Chain:
    """The same arm on a tilted, shifted base with other link frames, some axes reversed, and a bent tool."""
    rng = np.random.default_rng(seed)
    n = len(c.names)
    base, shift = rotation_matrix(rng.normal(size=3)), rng.normal(size=3)
    F = [base.T, *rotation_matrix(rng.normal(size=(n, 3)))]  # new frame of each link, seen from the old one
    sign = np.where(rng.random(n) < 0.5, -1.0, 1.0)
    sign[:2] = [-1.0, 1.0]
    pos = np.array([F[i].T @ c.pos[i] for i in range(n)])
    pos[0] += shift
    return replace(
        c,
        pos=pos,
        R=np.array([F[i].T @ c.R[i] @ F[i + 1] for i in range(n)]),
        axis=np.array([s * F[i + 1].T @ c.axis[i] for i, s in enumerate(sign)]),
        tool_pos=F[n].T @ c.tool_pos,
        tool_R=F[n].T @ c.tool_R @ rotation_matrix(rng.normal(size=3)),
    )


CHAINS = {"three": three(), "seven": seven(), "odd": odd(), "disguised": disguised(seven())}


@pytest.fixture(params=CHAINS)
def arm(request: pytest.FixtureRequest) -> SerialKinematics:
    return SerialKinematics(CHAINS[request.param])


@pytest.fixture(scope="module")
def srs() -> SrsKinematics:
    return SrsKinematics(seven())


@pytest.fixture(scope="module")
def lwa3() -> Lwa3Kinematics:
    return Lwa3Kinematics(three())


def in_limits(kinematics: SerialKinematics, count: int, seed: int) -> Array:
    low, high = np.maximum(kinematics.lower, -np.pi), np.minimum(kinematics.upper, np.pi)
    return np.random.default_rng(seed).uniform(low, high, (count, kinematics.n))


def mujoco_model(c: Chain) -> mujoco.MjModel:
    def frame(pos: Array, R: Array) -> str:
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, np.ascontiguousarray(R).ravel())
        return f'pos="{" ".join(map(repr, pos.tolist()))}" quat="{" ".join(map(repr, quat.tolist()))}"'

    xml = f'<site name="tool" {frame(c.tool_pos, c.tool_R)}/>'
    for i in reversed(range(len(c.names))):
        axis, anchor = (" ".join(map(repr, v.tolist())) for v in (c.axis[i], c.anchor[i]))
        kind = "slide" if c.slide[i] else "hinge"
        xml = (
            f'<body {frame(c.pos[i], c.R[i])}><joint type="{kind}" axis="{axis}" pos="{anchor}"/>'
            f'<geom size="0.01" mass="1"/>{xml}</body>'
        )
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{xml}</worldbody></mujoco>")


# forward ------------------------------------------------------------------------------------------------------------


def test_seven_joints_stand_up_at_zero(srs: SrsKinematics) -> None:
    f = srs.frames(np.zeros(7))
    np.testing.assert_allclose(f.a[:, 2], [0, 0.300, 0.300, 0.628, 0.628, 0.948, 0.948], atol=1e-15)
    np.testing.assert_allclose(f.x, [0, 0, 1.025], atol=1e-15)
    np.testing.assert_allclose(f.R, np.eye(3), atol=1e-15)


def test_three_joints_start_where_the_thesis_says(lwa3: Lwa3Kinematics) -> None:
    np.testing.assert_allclose(lwa3.point([-np.pi / 2, -np.pi / 2, np.pi / 2]), [0, -0.397, 0.628], atol=1e-15)
    np.testing.assert_allclose(lwa3.point(np.zeros(3)), [0.725, 0, 0.3], atol=1e-15)


def test_forward_equals_dh(srs: SrsKinematics, lwa3: Lwa3Kinematics) -> None:
    q = in_limits(srs, 500, 1)
    T, pose = dh_forward(DH_7DOF, q), srs.fk(q)
    np.testing.assert_allclose(pose.x, T[:, :3, 3], atol=1e-14)
    np.testing.assert_allclose(pose.R, T[:, :3, :3], atol=1e-14)
    q3 = q[:, :3]
    r = 0.328 * np.cos(q3[:, 1]) + 0.397 * np.cos(q3[:, 1] + q3[:, 2])
    z = 0.300 - 0.328 * np.sin(q3[:, 1]) - 0.397 * np.sin(q3[:, 1] + q3[:, 2])
    expected = np.stack([r * np.cos(q3[:, 0]), r * np.sin(q3[:, 0]), z], axis=1)
    np.testing.assert_allclose(dh_forward(THESIS_DH_3DOF, q3)[:, :3, 3], expected, atol=1e-14)
    np.testing.assert_allclose(lwa3.point(q3), expected, atol=1e-14)


def test_forward_and_jacobian_equal_mujoco(arm: SerialKinematics) -> None:
    model = mujoco_model(arm.chain)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(2)
    for _ in range(20):
        q, dq = rng.uniform(-3, 3, (2, arm.n))
        data.qpos[:], data.qvel[:] = q, dq
        mujoco.mj_forward(model, data)
        f = arm.frames(q)
        np.testing.assert_allclose(f.x, data.site_xpos[0], atol=1e-13)
        np.testing.assert_allclose(f.R, data.site_xmat[0].reshape(3, 3), atol=1e-13)
        np.testing.assert_allclose(f.z, data.xaxis, atol=1e-13)
        np.testing.assert_allclose(f.a[~arm.chain.slide], data.xanchor[~arm.chain.slide], atol=1e-13)
        J, dJ = np.zeros((2, 6, arm.n))
        mujoco.mj_jacSite(model, data, J[:3], J[3:], 0)
        np.testing.assert_allclose(arm.jacobian(q), J, atol=1e-13)
        mujoco.mj_jacDot(model, data, dJ[:3], dJ[3:], data.site_xpos[0], model.site_bodyid[0])
        np.testing.assert_allclose(arm.jacobian_rate(q, dq), dJ, atol=1e-12)
        np.testing.assert_allclose(bias_from_jacobian(J, dq), dJ @ dq, atol=1e-12)


def test_point_equals_fk_for_any_shape(arm: SerialKinematics) -> None:
    q = np.random.default_rng(4).uniform(-4, 4, (3, 3001, arm.n))  # more than one chunk
    np.testing.assert_allclose(arm.point(q), arm.fk(q).x, atol=1e-13)
    np.testing.assert_array_equal(arm.point(q[0, 0]), arm.point(q)[0, 0])
    assert arm.point(q[:, :0]).shape == (3, 0, 3)


def test_derivatives_equal_differences(arm: SerialKinematics) -> None:
    rng = np.random.default_rng(6)
    q, dq = rng.uniform(-3, 3, (2, 10, arm.n))
    h = 1e-6
    plus, minus, R = arm.fk(q + h * dq), arm.fk(q - h * dq), arm.fk(q).R
    v = (arm.jacobian(q) @ dq[..., None])[..., 0]
    np.testing.assert_allclose(v[:, :3], (plus.x - minus.x) / (2 * h), atol=1e-7)
    spin = (plus.R - minus.R) / (2 * h) @ R.swapaxes(-1, -2)
    np.testing.assert_allclose(v[:, 3:], np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], -1), atol=1e-7)
    dJ = (arm.jacobian(q + h * dq) - arm.jacobian(q - h * dq)) / (2 * h)
    np.testing.assert_allclose(arm.jacobian_rate(q, dq), dJ, atol=1e-7)
    np.testing.assert_allclose(bias_from_jacobian(arm.jacobian(q), dq), (dJ @ dq[..., None])[..., 0], atol=1e-7)


def test_rate_and_bias_take_leading_axes(arm: SerialKinematics) -> None:
    q, dq = np.random.default_rng(7).normal(size=(2, 2, 3, arm.n))
    J = arm.jacobian(q)
    expected = [[rate_from_jacobian(J[i, j], dq[i, j]) @ dq[i, j] for j in range(3)] for i in range(2)]
    np.testing.assert_allclose(bias_from_jacobian(J, dq), expected, atol=1e-12)


def test_singular_values(srs: SrsKinematics, lwa3: Lwa3Kinematics) -> None:
    q = in_limits(srs, 50, 8)
    J = srs.jacobian(q)
    np.testing.assert_allclose(srs.manipulability(q), np.sqrt(np.linalg.det(J @ J.swapaxes(-1, -2))), rtol=1e-9)
    np.testing.assert_allclose(srs.singularity(q) ** 2, np.linalg.eigvalsh(J @ J.swapaxes(-1, -2))[:, 0], atol=1e-12)
    assert srs.singularity(np.zeros(7)) < 1e-15
    assert lwa3.singularity([0.3, -0.4, 0.0]) < 1e-15  # stretched
    assert lwa3.singularity([0.3, -0.4, 1.0]) > 0.1


def test_wrong_number_of_joints(arm: SerialKinematics) -> None:
    with pytest.raises(KinematicsError, match=rf"q has shape \(2, 9\); its last axis must hold the {arm.n} joints"):
        arm.fk(np.zeros((2, 9)))


# seven joints -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("c", [seven(), disguised(seven())], ids=["plain", "disguised"])
def test_every_branch_reaches_the_pose(c: Chain) -> None:
    srs = kinematics_for(c)
    assert isinstance(srs, SrsKinematics)
    q = np.random.default_rng(9).uniform(-np.pi, np.pi, (10_000, 7))
    pose, psi = srs.fk(q), srs.arm_angle_of(q)
    branches = srs.ik_branches(pose.x, pose.R, psi)
    assert branches.shape == (10_000, 8, 7)
    back = srs.fk(branches)
    np.testing.assert_allclose(back.x, np.broadcast_to(pose.x[:, None], back.x.shape), atol=1e-9)
    np.testing.assert_allclose(back.R, np.broadcast_to(pose.R[:, None], back.R.shape), atol=1e-9)
    # all branches keep the elbow, so the arm angle; they differ by at least the smallest of three flips
    turn = np.angle(np.exp(1j * (srs.arm_angle_of(branches) - psi[:, None])))
    np.testing.assert_allclose(turn, 0.0, atol=1e-9)
    pairs = [(i, j) for i in range(8) for j in range(i)]
    gap = np.array([np.abs(branches[:, i] - branches[:, j]).max(-1) for i, j in pairs])
    assert (gap > 1e-4).all()
    # and one of them is the configuration that we started from
    apart = np.abs(np.angle(np.exp(1j * (branches - q[:, None])))).max(-1).min(-1)
    np.testing.assert_allclose(apart, 0.0, atol=1e-8)
    np.testing.assert_allclose(np.abs(branches).max(), np.pi, rtol=1e-3)


def test_branch_order(srs: SrsKinematics) -> None:
    b = srs.ik_branches(*srs.fk([0.3, 0.5, 0.2, 1.0, 0.1, 0.7, 0.3]), arm_angle=0.4)
    signs = np.sign(b[:, [1, 3, 5]])
    bits = np.array([[i >> 2, (i >> 1) & 1, i & 1] for i in range(8)])
    np.testing.assert_array_equal(signs, 1 - 2 * bits)


def test_arm_angle_turns_the_elbow(srs: SrsKinematics) -> None:
    shoulder = np.array([0, 0, 0.3])
    pose = srs.fk([0.4, 0.6, -0.3, 1.2, 0.5, 0.9, -0.2])
    wrist = pose.x - 0.077 * pose.R[:, 2]
    u = (wrist - shoulder) / np.linalg.norm(wrist - shoulder)
    above = Z - (Z @ u) * u
    above /= np.linalg.norm(above)
    for psi in (0.0, 0.7, -2.0, np.pi):
        for q in srs.ik_branches(*pose, arm_angle=psi):
            offset = srs.frames(q).a[3] - shoulder
            offset -= (offset @ u) * u
            np.testing.assert_allclose(
                offset / np.linalg.norm(offset), np.cos(psi) * above + np.sin(psi) * np.cross(u, above), atol=1e-12
            )
            assert abs(np.angle(np.exp(1j * (srs.arm_angle_of(q) - psi)))) < 1e-12


def test_elbow_down_is_half_a_turn(srs: SrsKinematics) -> None:
    pose = srs.fk([0.4, 0.9, 0.0, 0.8, 0.0, 0.5, 0.0])
    up, down = srs.ik(*pose), srs.ik(*pose, elbow="down")
    assert srs.frames(up).a[3, 2] > srs.frames(down).a[3, 2]
    np.testing.assert_array_equal(down, srs.ik(*pose, arm_angle=np.pi))


def test_vertical_shoulder_wrist_line_has_another_reference(srs: SrsKinematics) -> None:
    x, R = np.array([0, 0, 0.8]), np.eye(3)
    for tilt in (0.0, 0.9e-6):  # a wrist 0.423 m above the shoulder, and one a hair beside it
        q = srs.ik(x + 0.423 * tilt * Y, R, arm_angle=0.0)
        elbow = srs.frames(q).a[3]
        assert elbow[0] > 0.1
        assert abs(elbow[1]) < 1e-6
        assert abs(srs.arm_angle_of(q)) < 1e-9


def test_configuration_comes_back(srs: SrsKinematics) -> None:
    q = in_limits(srs, 5000, 10)
    back = srs.ik(*srs.fk(q), arm_angle=srs.arm_angle_of(q), near=q)
    np.testing.assert_allclose(back, q, atol=1e-8)


def test_straight_elbow_comes_back(srs: SrsKinematics) -> None:
    q = np.array([0.3, 0.8, -0.4, 0.0, 0.6, 0.9, 0.2])
    np.testing.assert_allclose(srs.ik(*srs.fk(q), arm_angle=srs.arm_angle_of(q), near=q), q, atol=1e-7)
    np.testing.assert_allclose(srs.arm_angle_of(q), srs.arm_angle_of(q + 1e-9 * np.eye(7)[3]), atol=1e-6)


@pytest.mark.parametrize("size", [1e-3, 1e-6, 1e-8, 1e-12])
@pytest.mark.parametrize("joint", [1, 3, 5])
def test_pose_is_exact_near_singularities(srs: SrsKinematics, joint: int, size: float) -> None:
    q = in_limits(srs, 200, 11)
    q[:, joint] = size
    pose = srs.fk(q)
    back = srs.fk(srs.ik_branches(*pose, arm_angle=srs.arm_angle_of(q), near=q))
    np.testing.assert_allclose(back.x, np.broadcast_to(pose.x[:, None], back.x.shape), atol=1e-9)
    np.testing.assert_allclose(back.R, np.broadcast_to(pose.R[:, None], back.R.shape), atol=2e-9)


def test_limits_filter_the_branches() -> None:
    upper = np.array([2.4, 2.14, np.pi, 2.18, np.pi, 2.09, 2.0])
    srs = SrsKinematics(replace(seven(), lower=-upper * [1, 1, 1, 0.1, 1, 1, 1], upper=upper))
    q, near = in_limits(srs, 2000, 12), in_limits(srs, 2000, 13)
    pose, psi = srs.fk(q), srs.arm_angle_of(q)
    turns = srs.ik_branches(*pose, arm_angle=psi)[..., None] + 2 * np.pi * np.arange(-1, 2)  # (2000, 8, 7, 3)
    allowed = (turns <= srs.upper[:, None] + 1e-9) & (turns >= srs.lower[:, None] - 1e-9)
    assert 0.1 < allowed.any(-1).all(-1).mean() < 0.5  # the filter has work to do, and leaves a choice
    for start, weight in ((None, 1.0 / upper), (near, np.ones(7))):
        distance = np.abs(turns - (0.0 if start is None else start[:, None, :, None])).min(
            -1, where=allowed, initial=np.inf
        )
        size = (distance * weight).max(-1) if start is None else (distance**2).sum(-1)
        chosen = srs.ik(*pose, arm_angle=psi, near=start)
        assert ((chosen <= srs.upper) & (chosen >= srs.lower)).all()
        np.testing.assert_allclose(srs.fk(chosen).x, pose.x, atol=1e-9)
        got = np.abs(chosen * weight).max(-1) if start is None else ((chosen - near) ** 2).sum(-1)
        np.testing.assert_allclose(got, size.min(-1), atol=1e-5)


def test_whole_turns_within_wide_limits() -> None:
    srs = SrsKinematics(replace(seven(), lower=np.full(7, -7.0), upper=np.full(7, 7.0)))
    q = np.array([4.0, 0.5, -4.5, 1.0, 6.0, 0.7, -5.5])
    np.testing.assert_allclose(srs.ik(*srs.fk(q), arm_angle=srs.arm_angle_of(q), near=q), q, atol=1e-12)
    shifted = SrsKinematics(replace(seven(), lower=np.full(7, 1.0), upper=np.full(7, 1.0 + 2 * np.pi)))
    back = shifted.ik(*srs.fk(q), arm_angle=srs.arm_angle_of(q))
    assert (back >= 1.0).all()
    np.testing.assert_allclose(shifted.fk(back).x, srs.fk(q).x, atol=1e-12)


def test_path_is_continuous(srs: SrsKinematics) -> None:
    s = np.linspace(0.0, 1.0, 1000)[:, None]
    q = (1 - s) * [0.3, 0.5, 0.2, 1.0, 0.1, 0.7, 0.3] + s * [1.3, -0.9, 1.2, 1.5, -1.0, -0.7, 0.9]  # crosses q2, q6 = 0
    pose, psi = srs.fk(q), srs.arm_angle_of(q)
    np.testing.assert_allclose(srs.ik_path(*pose, arm_angle=psi, near=q[0]), q, atol=1e-7)


def test_path_through_a_straight_wrist_keeps_the_roll(srs: SrsKinematics) -> None:
    s = np.linspace(-0.5, 0.5, 101)[:, None]
    q = np.array([0.3, 0.5, 0.2, 1.0, 0.1, 0.0, 0.3]) + s * Y[[0, 0, 0, 0, 0, 1, 0]]  # q6 is exactly 0 in the middle
    assert q[50, 5] == 0.0
    pose, psi = srs.fk(q), srs.arm_angle_of(q)
    np.testing.assert_allclose(srs.ik_path(*pose, arm_angle=psi, near=q[0]), q, atol=1e-9)
    with pytest.raises(SingularError, match=r"\(51 of 101\) leaves joints 'joint5' and 'joint7'"):
        srs.ik(*pose, arm_angle=psi)
    with pytest.raises(KinematicsError, match=r"elbow \(='left'\)"):
        srs.ik_path(*pose, elbow="left")  # type: ignore[arg-type]


def test_near_and_arm_angle_broadcast(srs: SrsKinematics) -> None:
    pose = srs.fk([0.4, 0.6, -0.3, 1.2, 0.5, 0.9, -0.2])
    assert srs.ik_branches(*pose, arm_angle=np.zeros((4, 5))).shape == (4, 5, 8, 7)
    assert srs.ik(*pose, near=np.zeros((6, 7))).shape == (6, 7)


# errors -------------------------------------------------------------------------------------------------------------


def test_errors_of_seven_joints(srs: SrsKinematics) -> None:
    R = np.eye(3)
    with pytest.raises(
        ReachError, match=r"target \(1, 0, 1\) m \(2 of 2\): the wrist would be 1\.17819 m .* 0\.008 to 0\.648"
    ):
        srs.ik([[0.3, 0.0, 0.8], [1.0, 0.0, 1.0]], R)
    with pytest.raises(ReachError, match="would be nan m"):
        srs.ik([np.nan, 0.0, 0.8], R)
    with pytest.raises(KinematicsError, match="needs an orientation R"):
        srs.ik([0.3, 0.0, 0.8])
    with pytest.raises(KinematicsError, match="R must hold rotation matrices"):
        srs.ik([0.3, 0.0, 0.8], np.diag([1.0, 1.0, -1.0]))
    with pytest.raises(KinematicsError, match=r"elbow \(='left'\) must be 'up' or 'down'"):
        srs.ik([0.3, 0.0, 0.8], R, elbow="left")  # type: ignore[arg-type]
    with pytest.raises(JointLimitError, match=r"'joint6' \(=2\.73149 rad\) must be in \[-2\.09, 2\.09\].*closest of 8"):
        srs.ik([0.2, 0.0, 0.1], R)
    with pytest.raises(KinematicsError, match=r"this inverse needs 7 turning joints; the chain has \('joint1', "):
        SrsKinematics(three())


@pytest.mark.parametrize("c", [seven(), disguised(seven())], ids=["plain", "disguised"])
def test_coinciding_axes_need_near(c: Chain) -> None:
    srs = SrsKinematics(c)
    for joint, rolls in ((1, [0, 2]), (5, [4, 6])):
        q = np.array([0.4, 0.6, -0.3, 1.2, 0.5, 0.9, -0.2])
        q[joint] = 0.0
        pose, psi = srs.fk(q), srs.arm_angle_of(q)
        with pytest.raises(
            SingularError, match=f"'joint{rolls[0] + 1}' and 'joint{rolls[1] + 1}', whose axes coincide"
        ):
            srs.ik(*pose, arm_angle=psi)
        near = q + 0.1 * np.arange(7)
        back = srs.ik(*pose, arm_angle=psi, near=near)
        assert abs(back[rolls[0]] - near[rolls[0]]) < 1e-9
        np.testing.assert_allclose(srs.fk(back).x, pose.x, atol=1e-9)
        np.testing.assert_allclose(srs.fk(back).R, pose.R, atol=1e-9)
        np.testing.assert_allclose(np.delete(back, rolls), np.delete(q, rolls), atol=1e-9)


def test_wrist_at_the_shoulder() -> None:
    c = seven()
    pos = c.pos.copy()
    pos[5, 2] = 0.328  # a forearm as long as the upper arm
    with pytest.raises(SingularError, match="the wrist is at the shoulder"):
        SrsKinematics(replace(c, pos=pos)).ik([0, 0, 0.377], np.eye(3))


# three joints -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("c", [three(), disguised(three())], ids=["plain", "disguised"])
def test_both_elbows_come_back(c: Chain) -> None:
    free = replace(c, lower=np.full(3, -np.inf), upper=np.full(3, np.inf))
    arm = kinematics_for(free)
    assert isinstance(arm, Lwa3Kinematics)
    x = arm.point(np.random.default_rng(14).uniform(-np.pi, np.pi, (10_000, 3)))
    both = arm.ik_branches(x)
    np.testing.assert_allclose(arm.point(both), np.broadcast_to(x[:, None], (10_000, 2, 3)), atol=1e-12)
    assert (np.abs(both[:, 0] - both[:, 1]).max(-1) > 1e-4).all()
    np.testing.assert_allclose(arm.point(arm.ik(x, elbow="down")), x, atol=1e-12)


def test_up_is_the_plus_branch(lwa3: Lwa3Kinematics) -> None:
    q = np.array([-np.pi / 2, -np.pi / 2, np.pi / 2])
    np.testing.assert_allclose(lwa3.ik(lwa3.point(q)), q, atol=1e-12)
    x = np.array([-0.5, -0.3, 0.05])
    up, down = lwa3.ik(x), lwa3.ik(x, elbow="down")
    assert up[2] > 0 > down[2]
    assert lwa3.frames(up).a[2, 2] > lwa3.frames(down).a[2, 2]
    np.testing.assert_array_equal(lwa3.ik_branches(x), [up, down])


@settings(derandomize=True, max_examples=200, deadline=None)
@given(
    d=st.floats(0.0690001, 0.725),
    pitch=st.floats(-1.57, 1.57),
    turn=st.floats(-3.14, 3.14),
    elbow=st.sampled_from(["up", "down"]),
)
def test_inverse_then_forward_in_reach(d: float, pitch: float, turn: float, elbow: str) -> None:
    arm = Lwa3Kinematics(replace(three(), lower=np.full(3, -np.inf), upper=np.full(3, np.inf)))
    x = np.array([0, 0, 0.3]) + d * np.array(
        [np.cos(pitch) * np.cos(turn), np.cos(pitch) * np.sin(turn), np.sin(pitch)]
    )
    np.testing.assert_allclose(arm.point(arm.ik(x, elbow=elbow)), x, atol=1e-12)  # type: ignore[arg-type]


@pytest.mark.parametrize("short", [0.0, 1e-15, 1e-12, 1e-9, 1e-6, -5e-10])
def test_edge_of_reach(lwa3: Lwa3Kinematics, short: float) -> None:
    x = np.array([0.725 - short, 0.0, 0.3])
    np.testing.assert_allclose(lwa3.point(lwa3.ik(x)), x, atol=max(1e-14, -1.1 * short))


def test_errors_of_three_joints(lwa3: Lwa3Kinematics) -> None:
    with pytest.raises(ReachError, match=r"target \(2, 0, 0\) m: the target would be 2\.02237 m .* 0\.069 to 0\.725 m"):
        lwa3.ik([2.0, 0.0, 0.0])
    with pytest.raises(ReachError, match=r"0\.05 m from the shoulder"):
        lwa3.ik([0.05, 0.0, 0.3])
    with pytest.raises(SingularError, match="'joint1', on whose axis it lies, undefined; valid with near"):
        lwa3.ik([0.0, 0.0, 0.8])
    with pytest.raises(KinematicsError, match="R must be None and arm_angle 0"):
        lwa3.ik([0.3, 0.0, 0.8], np.eye(3))
    with pytest.raises(JointLimitError, match=r"'joint3' \(=2\.[0-9]+ rad\) must be in \[-2\.18, 2\.18\]"):
        lwa3.ik([0.2, 0.0, 0.3])
    with pytest.raises(KinematicsError, match="not a base turn and two parallel pitch axes in one plane"):
        Lwa3Kinematics(replace(three(), tool_pos=np.array([0.397, 0.01, 0.0])))


def test_near_fills_in_the_base_turn(lwa3: Lwa3Kinematics) -> None:
    q = lwa3.ik([0.0, 0.0, 0.8], near=[0.7, 0.0, 0.0])
    assert q[0] == 0.7
    np.testing.assert_allclose(lwa3.point(q), [0, 0, 0.8], atol=1e-12)


def test_path_around_the_base_unwinds() -> None:
    free = Lwa3Kinematics(replace(three(), lower=np.full(3, -np.inf), upper=np.full(3, np.inf)))
    turn = np.linspace(0.0, 10.0, 200)
    x = np.stack([0.5 * np.cos(turn), 0.5 * np.sin(turn), np.full(200, 0.4)], axis=1)
    np.testing.assert_allclose(free.ik_path(x)[:, 0], turn, atol=1e-12)
    np.testing.assert_allclose(free.ik_path(x, near=[2 * np.pi, 0, 0])[:, 0], turn + 2 * np.pi, atol=1e-12)


# any chain ----------------------------------------------------------------------------------------------------------


def test_numeric_inverse_of_a_general_chain() -> None:
    arm = kinematics_for(odd())
    assert type(arm) is SerialKinematics
    pose = arm.fk(np.random.default_rng(15).uniform(-1, 1, (2, 10, 6)))
    back = arm.fk(arm.ik(*pose))
    np.testing.assert_allclose(back.x, pose.x, atol=1e-9)
    np.testing.assert_allclose(back.R, pose.R, atol=1e-9)
    np.testing.assert_allclose(arm.fk(arm.ik(pose.x)).x, pose.x, atol=1e-9)
    assert arm.ik_branches(*pose).shape == (2, 10, 1, 6)


def test_numeric_inverse_respects_limits_and_near() -> None:
    arm = SerialKinematics(seven())  # the closed form's arm, on the other road
    q = in_limits(arm, 100, 16)
    pose = arm.fk(q)
    back = arm.ik(*pose)
    assert (np.abs(back) <= arm.upper).all()
    np.testing.assert_allclose(arm.fk(back).x, pose.x, atol=1e-9)
    np.testing.assert_array_equal(back, arm.ik(*pose))
    np.testing.assert_allclose(arm.ik(*pose, near=q), q, atol=1e-9)


def test_numeric_inverse_says_when_it_fails() -> None:
    arm = SerialKinematics(seven())
    with pytest.raises(ReachError, match=r"target \(2, 0, 0\) m: none of 13 starts .* at most 1e-09 is valid"):
        arm.ik([2.0, 0.0, 0.0], np.eye(3))
    with pytest.raises(KinematicsError, match=r"elbow \(='down'\).*choose the posture with near"):
        arm.ik([0.3, 0.0, 0.8], np.eye(3), elbow="down")


def test_other_shapes_get_the_numeric_inverse() -> None:
    bent = seven()
    pos = bent.pos.copy()
    pos[3, 0] = 0.01  # an elbow offset
    assert type(kinematics_for(replace(bent, pos=pos))) is SerialKinematics
    assert type(kinematics_for(replace(three(), axis=np.array([Z, Y, X])))) is SerialKinematics
    assert type(kinematics_for(replace(three(), slide=np.array([False, False, True])))) is SerialKinematics


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("lwa4d_3dof", Lwa3Kinematics),
        ("lwa4d_3dof_printed", Lwa3Kinematics),
        ("lwa4d_7dof", SrsKinematics),
        ("lwa4d_planar", SerialKinematics),
    ],
)
def test_shipped_arms(name: str, kind: type[SerialKinematics]) -> None:
    arm = kinematics_for(chain_of(load_model(name)))
    assert type(arm) is kind
    q = in_limits(arm, 300, 17)
    pose = arm.fk(q)
    if isinstance(arm, SrsKinematics):
        np.testing.assert_allclose(pose.x, dh_forward(DH_7DOF, q)[:, :3, 3], atol=1e-12)
        np.testing.assert_allclose(arm.ik(*pose, arm_angle=arm.arm_angle_of(q), near=q), q, atol=1e-8)
        return
    np.testing.assert_allclose(arm.fk(arm.ik_branches(pose.x)[..., 0, :]).x, pose.x, atol=1e-9)
    if arm.n == 3:
        np.testing.assert_allclose(pose.x, dh_forward(THESIS_DH_3DOF, q)[:, :3, 3], atol=1e-12)
