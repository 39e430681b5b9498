from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from scipy.spatial.transform import Rotation, Slerp

from lwa4d_sim.arm import load_arm
from lwa4d_sim.errors import JointLimitError, ReachError, SingularError, TrajectoryError
from lwa4d_sim.interfaces import Array, Trajectory
from lwa4d_sim.rotations import to_rpy
from lwa4d_sim.trajectories import THESIS_EXCITATION, Boundary, FourierMotion, WaypointMotion, Waypoints

THESIS_POINTS = ((-0.5, -0.3, 0.6), (-0.5, -0.3, 0.05), (0.5, -0.4, 0.05), (0.5, -0.4, 0.6))
Q3 = np.array([-np.pi / 2, -np.pi / 2, np.pi / 2])
Q7 = np.array([-1.2, 0.5, 0.3, 1.0, 0.2, 0.7, 0.1])
Q2 = np.array([-0.5, 1.0])

THREE, SEVEN, PLANAR = (load_arm(f"lwa4d_{name}").kinematics for name in ("3dof", "7dof", "planar"))

thesis = WaypointMotion(waypoints=Waypoints(space="task", points=THESIS_POINTS), segment_time=5.0)
seven = WaypointMotion(
    waypoints=Waypoints(
        space="task",
        points=((0.3, -0.4, 0.5), (-0.1, -0.5, 0.4), (-0.35, -0.3, 0.5)),
        orientations=((2.9, 0.2, 0.3), (2.5, -0.3, 0.8), (2.9, 0.2, -0.5)),
        arm_angle=0.4,
    ),
    segment_time=(3.0, 2.0, 2.5),
)
seven_points = Waypoints(space="joint", points=((-1.0, 0.9, 0.5, 1.2, 0.5, 0.9, 0.0),))
joint_points = Waypoints(space="joint", points=((-1.0, -0.8, 0.9), (0.2, -1.2, 1.1)))
planar_points = Waypoints(space="joint", points=((0.4, 0.9), (-1.0, 1.4)))
boundary = Boundary(
    velocity=((0.1, 0.0, -0.1), (0.2, -0.1, 0.1), (0.0, 0.0, 0.2)),
    acceleration=((0.0, 0.3, 0.1), (0.2, 0.1, -0.3), (0.1, 0.2, 0.0)),
    jerk=((1.0, 0.0, 0.1), (0.5, -1.0, 0.3), (0.3, 0.2, -1.0)),
)
through = WaypointMotion(waypoints=joint_points, segment_time=(2.0, 1.5), boundary=boundary)

MOTIONS: dict[str, Trajectory] = {
    **{f"3dof-{p}-{f}": replace(thesis, profile=p, follow=f).build(THREE, Q3)
       for p in ("step", "linear", "cubic", "quintic", "septic") for f in ("joint", "task")},
    **{f"7dof-{p}-{f}": replace(seven, profile=p, follow=f).build(SEVEN, Q7)
       for p in ("step", "linear", "quintic") for f in ("joint", "task")},
    "7dof-elbow-down": replace(
        seven, follow="task", elbow="down", waypoints=replace(seven.waypoints, arm_angle=-2.8)
    ).build(SEVEN, Q7),
    "7dof-joint-points": WaypointMotion(waypoints=seven_points, segment_time=2.0, follow="task").build(SEVEN, Q7),
    "planar-joint": WaypointMotion(waypoints=planar_points, segment_time=2.0).build(PLANAR, Q2),
    "planar-task": WaypointMotion(waypoints=planar_points, segment_time=2.0, follow="task").build(PLANAR, Q2),
    "boundary-joint": through.build(THREE, Q3),
    "boundary-task": replace(through, follow="task").build(THREE, Q3),
    "fourier": THESIS_EXCITATION.build(PLANAR, np.zeros(2)),
}  # fmt: skip


@pytest.fixture(params=MOTIONS)
def motion(request: pytest.FixtureRequest) -> Trajectory:
    return MOTIONS[request.param]


def task(*points: tuple[float, ...]) -> Waypoints:
    return Waypoints(space="task", points=points)


def joint(*points: tuple[float, ...]) -> Waypoints:
    return Waypoints(space="joint", points=points)


def inside(motion: Trajectory, per_segment: int = 9) -> Array:
    """Times in every segment, clear of the knots."""
    start = np.concatenate([[0.0], motion.knots[:-1]])
    times = start[:, None] + np.linspace(0.02, 0.98, per_segment) * (motion.knots - start)[:, None]
    return np.asarray(times.ravel())


def present(value: Array | None) -> Array:
    assert value is not None
    return value


def rate(f: Callable[[Array], Array], t: Array, h: float = 2e-3) -> Array:
    """Five-point difference of f, whose answers have axis 0 for time."""
    return np.asarray((f(t - 2 * h) - 8 * f(t - h) + 8 * f(t + h) - f(t + 2 * h)) / (12 * h))


def test_joint_rates_are_derivatives(motion: Trajectory) -> None:
    t = inside(motion)
    ref = motion.joint(t)
    np.testing.assert_allclose(ref.dq, rate(lambda t: motion.joint(t).q, t), rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(ref.ddq, rate(lambda t: motion.joint(t).dq, t), rtol=1e-5, atol=1e-6)


def test_task_rates_are_derivatives(motion: Trajectory) -> None:
    t = inside(motion)
    ref = motion.task(t)
    np.testing.assert_allclose(ref.dx, rate(lambda t: motion.task(t).x, t), rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(ref.ddx, rate(lambda t: motion.task(t).dx, t), rtol=1e-6, atol=1e-6)
    if ref.R is not None:
        spin = rate(lambda t: present(motion.task(t).R), t) @ np.swapaxes(ref.R, -1, -2)  # skew(w)
        w = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=-1)
        np.testing.assert_allclose(present(ref.w), w, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(present(ref.dw), rate(lambda t: present(motion.task(t).w), t), rtol=1e-6, atol=1e-6)


def test_joint_and_task_are_the_same_motion(motion: Trajectory) -> None:
    kinematics, t = motion.kinematics, np.concatenate([[-1.0, 0.0], inside(motion), motion.knots, [1e3]])  # type: ignore[attr-defined]
    joint, task = motion.joint(t), motion.task(t)
    pose = kinematics.fk(joint.q)
    np.testing.assert_allclose(pose.x, task.x, atol=1e-9)
    J = kinematics.jacobian(joint.q)
    v = np.einsum("kij,kj->ki", J, joint.dq)
    a = np.einsum("kij,kj->ki", J, joint.ddq) + np.einsum(
        "kij,kj->ki", kinematics.jacobian_rate(joint.q, joint.dq), joint.dq
    )
    np.testing.assert_allclose(v[:, :3], task.dx, atol=1e-9)
    np.testing.assert_allclose(a[:, :3], task.ddx, atol=1e-8)
    if task.R is not None:
        np.testing.assert_allclose(pose.R, task.R, atol=1e-9)
        np.testing.assert_allclose(v[:, 3:], present(task.w), atol=1e-9)
        np.testing.assert_allclose(a[:, 3:], present(task.dw), atol=1e-8)


def test_any_order_and_block_gives_the_same_samples(motion: Trajectory) -> None:
    t = inside(motion)
    shuffled = np.random.default_rng(0).permutation(len(t))
    np.testing.assert_allclose(motion.joint(t[shuffled]).q, motion.joint(t).q[shuffled], atol=1e-12)
    np.testing.assert_allclose(motion.joint(t[3:4]).dq, motion.joint(t).dq[3:4], atol=1e-9)


def test_it_rests_after_the_end(motion: Trajectory) -> None:
    assert motion.duration == motion.knots[-1]
    t = motion.duration + np.array([0.0, 1e-9, 1.0, 1e4])
    joint, task = motion.joint(t), motion.task(t)
    for still in (joint.dq, joint.ddq, task.dx, task.ddx, task.w, task.dw):
        assert still is None or not still.any()
    last = motion.joint(np.array([motion.duration - 1e-7]))
    np.testing.assert_allclose(joint.q, np.broadcast_to(last.q, joint.q.shape), atol=1e-5)


@pytest.mark.parametrize("follow", ["joint", "task"])
@pytest.mark.parametrize("profile", ["linear", "cubic", "quintic", "septic"])
def test_the_thesis_motion_passes_its_waypoints(profile: str, follow: str) -> None:
    motion = MOTIONS[f"3dof-{profile}-{follow}"]
    np.testing.assert_array_equal(motion.knots, [5, 10, 15, 20])
    np.testing.assert_allclose(motion.task(motion.knots).x, THESIS_POINTS, atol=1e-12)
    np.testing.assert_allclose(motion.joint(np.zeros(1)).q[0], Q3, atol=1e-12)
    if profile != "linear":
        before = motion.knots[:, None] - [1e-6, 0.0]
        assert np.abs(motion.joint(before.ravel()).dq).max() < 1e-4
        ddq = np.abs(motion.joint(before.ravel()).ddq).max()
        assert ddq > 0.1 if profile == "cubic" else ddq < 1e-4


@pytest.mark.parametrize("name", ["3dof", "7dof"])
def test_a_step_is_asked_at_the_start_of_its_segment(name: str) -> None:
    motion, smooth = MOTIONS[f"{name}-step-joint"], MOTIONS[f"{name}-quintic-joint"]
    waypoints = smooth.joint(motion.knots).q
    starts = np.array([0.0, *motion.knots[:-1]])
    for t in (starts, motion.knots - 1e-6):
        np.testing.assert_allclose(motion.joint(t).q, waypoints, atol=1e-12)
        np.testing.assert_allclose(MOTIONS[f"{name}-step-task"].joint(t).q, waypoints, atol=1e-9)
    t = np.linspace(0, 20, 101)
    assert not motion.joint(t).dq.any()
    assert not motion.joint(t).ddq.any()
    np.testing.assert_allclose(MOTIONS[f"{name}-step-task"].joint(t).dq, 0.0, atol=1e-12)


def test_time_laws_agree_with_their_formulas() -> None:
    s = np.linspace(0, 1, 21)
    laws = {
        "linear": s,
        "cubic": 3 * s**2 - 2 * s**3,
        "quintic": 10 * s**3 - 15 * s**4 + 6 * s**5,
        "septic": 35 * s**4 - 84 * s**5 + 70 * s**6 - 20 * s**7,
    }
    x0 = THREE.fk(Q3).x
    for profile, law in laws.items():
        x = MOTIONS[f"3dof-{profile}-task"].task(5.0 * s).x
        np.testing.assert_allclose(x, x0 + law[:, None] * (THESIS_POINTS[0] - x0), atol=1e-12)


def test_orientation_turns_as_scipy_slerp() -> None:
    motion = MOTIONS["7dof-linear-task"]
    knots = np.array([0.0, *motion.knots])
    R = present(motion.task(knots).R)
    np.testing.assert_allclose(R[0], SEVEN.fk(Q7).R, atol=1e-14)
    np.testing.assert_allclose(to_rpy(R[1:]), np.array(seven.waypoints.orientations), atol=1e-12)
    t = np.linspace(0, motion.duration, 50)
    np.testing.assert_allclose(
        present(motion.task(t).R), Slerp(knots, Rotation.from_matrix(R))(t).as_matrix(), atol=1e-12
    )


def test_one_orientation_serves_all_points() -> None:
    points = {**vars(seven.waypoints), "orientations": (2.9, 0.2, 0.3)}
    flat = replace(seven, waypoints=Waypoints(**points)).build(SEVEN, Q7)
    rows = replace(seven, waypoints=Waypoints(**{**points, "orientations": ((2.9, 0.2, 0.3),)})).build(SEVEN, Q7)
    R = present(flat.task(flat.knots).R)
    np.testing.assert_allclose(to_rpy(R), np.tile([2.9, 0.2, 0.3], (3, 1)), atol=1e-12)
    np.testing.assert_array_equal(R, present(rows.task(flat.knots).R))


def test_the_arm_angle_goes_from_that_of_the_start_to_the_asked_one() -> None:
    motion = MOTIONS["7dof-quintic-task"]
    t = np.array([0.0, *motion.knots])
    joint, task = motion.joint(t), motion.task(t)
    np.testing.assert_allclose(joint.q[0], Q7, atol=1e-9)
    np.testing.assert_allclose(joint.q, present(task.posture), atol=1e-9)
    np.testing.assert_allclose(SEVEN.arm_angle_of(joint.q)[1:], 0.4, atol=1e-9)  # type: ignore[attr-defined]
    down = MOTIONS["7dof-elbow-down"].joint(t[1:]).q
    np.testing.assert_allclose(np.cos(SEVEN.arm_angle_of(down) + 2.8), -1.0, atol=1e-9)  # type: ignore[attr-defined]


@pytest.mark.parametrize("follow", ["joint", "task"])
@pytest.mark.parametrize("given", [1, 2, 3])
def test_boundary_derivatives_are_met_at_every_knot(given: int, follow: Any) -> None:
    names = ("velocity", "acceleration", "jerk")
    asked = {name: getattr(boundary, name) for name in names[:given]}
    motion = replace(through, boundary=Boundary(**asked), follow=follow).build(THREE, Q3)
    curve = motion.joint if follow == "joint" else motion.task
    knots = np.array([0.0, 2.0, 3.5])
    for t in (knots[:-1], knots[1:] - 1e-9):  # the start and the end of each segment
        rows = slice(None, -1) if t[0] == 0.0 else slice(1, None)
        ref = curve(t)
        for field, name in zip(("dq", "ddq") if follow == "joint" else ("dx", "ddx"), names[:given], strict=False):
            np.testing.assert_allclose(getattr(ref, field), np.array(asked[name])[rows], atol=1e-7)
    if given == 3:
        h = 1e-3
        for k, t0 in enumerate(knots[:-1]):
            a = getattr(curve(t0 + h * np.arange(5)), "ddq" if follow == "joint" else "ddx")
            jerk = np.array([-25, 48, -36, 16, -3]) @ a / (12 * h)  # one-sided, fourth order
            np.testing.assert_allclose(jerk, np.array(asked["jerk"])[k], atol=1e-6)


def test_degree_follows_from_the_boundary_derivatives() -> None:
    for given, degree in ((1, 3), (2, 5), (3, 7)):
        b = Boundary(**dict(list(vars(boundary).items())[:given]))
        q = replace(through, boundary=b).build(THREE, Q3).joint(np.linspace(0, 1.999, 40)).q
        differences = [np.abs(np.diff(q[:, 0], k)).max() for k in (degree, degree + 1)]  # even samples: only one is 0
        assert differences[0] > 1e-9
        assert differences[1] < 1e-12


def test_a_path_the_arm_cannot_follow_says_when() -> None:
    outwards = Boundary(velocity=((0.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 0.0)))
    far = replace(thesis, waypoints=task((0.0, -0.6, 0.3), (0.2, -0.6, 0.3)), segment_time=1.0, boundary=outwards)
    far = replace(far, follow="task")
    across = replace(thesis, waypoints=task((-0.4, -0.03, 0.3), (0.4, -0.03, 0.3)), follow="task", profile="linear")
    t = np.arange(0.0, 9.0, 0.01)
    for parameters, error in ((far, ReachError), (across, JointLimitError)):  # across: closer than the elbow can fold
        motion = parameters.build(THREE, Q3)
        x = motion.task(t).x  # the path itself exists
        with pytest.raises(error, match=r"task path at t = (\S+) s: ") as caught:
            motion.joint(t)
        k = int(np.argmin(np.abs(t - float(str(caught.value).split()[5]))))
        motion.joint(t[:k])
        with pytest.raises(error):
            THREE.ik(x[k], near=Q3)


def test_a_singular_arm_matters_only_in_motion() -> None:
    stretched = Waypoints(space="joint", points=((0.0, 0.0, 0.0),))  # its Jacobian is singular to the last bit
    step = WaypointMotion(waypoints=stretched, segment_time=1.0, profile="step", follow="task").build(THREE, Q3)
    assert not step.joint(np.linspace(0, 2, 5)).dq.any()
    start = WaypointMotion(waypoints=stretched, segment_time=1.0, profile="linear", follow="task")
    with pytest.raises(SingularError, match=r"task path at t = 0 s: the arm is singular"):
        replace(start, waypoints=joint_points).build(THREE, np.zeros(3)).joint(np.zeros(1))


def test_a_start_on_the_other_elbow_is_refused_when_joints_are_asked() -> None:
    motion = replace(thesis, waypoints=task((0.0, -0.5, 0.5)), follow="task", elbow="down").build(THREE, Q3)
    motion.task(np.zeros(1))
    with pytest.raises(
        TrajectoryError, match=r"t = 0 s: the joints would jump.*elbow = 'down'.*choose the other elbow"
    ):
        motion.joint(np.zeros(1))


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"waypoints": task((0.4, 0.0, 0.3), (1.0, 0.0, 0.3))}, ReachError, r"^waypoint 2 \(1, 0, 0\.3\): "),
        ({"waypoints": task((0.0, 0.0, -0.425))}, JointLimitError, r"^waypoint 1 \(0, 0, -0\.425\): "),
        ({"waypoints": task((0.4, 0.0))}, TrajectoryError,
         r"waypoints\.points, row 1 \(=\(0\.4, 0\.0\)\): must hold 3 numbers \(x, y, z\)"),
        ({"waypoints": joint((0.0, 0.0, 0.0), (0.4, 0.0))}, TrajectoryError,
         r"waypoints\.points, row 2 .*3 numbers \(one angle per joint\)"),
        ({"waypoints": replace(joint_points, arm_angle=1.0)}, TrajectoryError, "belong to task points"),
        ({"waypoints": replace(thesis.waypoints, orientations=(0.0, 0.0, 0.0))}, TrajectoryError,
         "need an arm with at least 6 joints; this one has 3"),
        ({"segment_time": (1.0, 2.0)}, TrajectoryError, "segment_time has 2 entries; valid: one .* 4 segments"),
        ({"segment_time": -1.0}, TrajectoryError, r"T \(=-1\.0\) must be a positive time"),
        ({"boundary": boundary, "profile": "step"}, TrajectoryError, "need a polynomial profile .* not 'step'"),
        ({"boundary": boundary, "profile": "linear"}, TrajectoryError, "need a polynomial profile .* not 'linear'"),
        ({"boundary": boundary}, TrajectoryError, r"boundary\.velocity has 3 rows; it must have 5"),
        ({"boundary": Boundary(velocity=((0.0,),) * 5)}, TrajectoryError,
         r"boundary\.velocity, row 1 .*3 numbers \(joint space"),
        ({"boundary": replace(boundary, acceleration=None)}, TrajectoryError,
         r"boundary\.jerk needs boundary\.acceleration"),
    ],
)  # fmt: skip
def test_waypoints_that_do_not_fit_are_named(changes: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        replace(thesis, **changes).build(THREE, Q3)


def test_a_seven_joint_arm_needs_orientations() -> None:
    def build(**changes: Any) -> None:
        replace(seven, waypoints=replace(seven.waypoints, **changes)).build(SEVEN, Q7)

    with pytest.raises(TrajectoryError, match=r"waypoints\.orientations is missing: an arm with 7 joints"):
        build(orientations=None)
    with pytest.raises(TrajectoryError, match=r"waypoints\.orientations has 2 rows; valid: 1, or 3"):
        build(orientations=((0.0, 0.0, 0.0),) * 2)
    with pytest.raises(TrajectoryError, match=r"waypoints\.orientations, row 1 .*\(roll, pitch, yaw\)"):
        build(orientations=(0.0, 0.0))


def test_fourier_is_its_formula() -> None:
    motion = replace(THESIS_EXCITATION, omega=1.7, offset=(0.3, -0.2)).build(PLANAR, np.zeros(2))
    for t in (0.0, 0.4, 3.3):
        for i in range(2):
            expected = (0.3, -0.2)[i] + sum(
                THESIS_EXCITATION.a[i][k - 1] / (k * 1.7) * np.sin(k * 1.7 * t)
                - THESIS_EXCITATION.b[i][k - 1] / (k * 1.7) * np.cos(k * 1.7 * t)
                for k in range(1, 6)
            )
            assert motion.joint(np.array([t])).q[0, i] == pytest.approx(expected, abs=1e-14)
    np.testing.assert_allclose(
        motion.joint(np.zeros(1)).dq[0], np.sum(THESIS_EXCITATION.a, axis=1), atol=1e-14
    )  # so it starts in motion


def test_fourier_rows_must_fit_the_arm() -> None:
    with pytest.raises(TrajectoryError, match="a has 2 rows; it must have 3"):
        THESIS_EXCITATION.build(THREE, Q3)
    with pytest.raises(TrajectoryError, match=r"b, row 1 .*must hold 1 numbers"):
        FourierMotion(a=((1.0,),), b=((1.0, 2.0),), duration=1.0).build(PLANAR, np.zeros(1))
    with pytest.raises(TrajectoryError, match=r"offset, row 1 .*must hold 2 numbers"):
        replace(THESIS_EXCITATION, offset=(1.0,)).build(PLANAR, np.zeros(2))


def test_yaml_shapes_are_the_schema() -> None:
    adapter: TypeAdapter[WaypointMotion] = TypeAdapter(WaypointMotion)
    data: dict[str, Any] = {
        "waypoints": {"space": "task", "points": [list(p) for p in THESIS_POINTS]},
        "segment_time": 5,
        "profile": "quintic",
        "follow": "joint",
        "elbow": "up",
    }
    assert adapter.validate_python(data) == thesis
    for orientations in ([1, 2, 3], [[1, 2, 3]], [[1, 2, 3], [4, 5, 6]]):
        data["waypoints"]["orientations"] = orientations
        adapter.validate_python(data)
    for wrong in ({"segment_times": 5}, {"segment_time": 0}, {"segment_time": [1, -1]}, {"profile": "jump"},
                  {"waypoints": {"space": "task", "points": []}},
                  {"waypoints": {"space": "task", "points": [[0.0, float("nan"), 1.0]]}}):  # fmt: skip
        with pytest.raises(ValidationError):
            adapter.validate_python({**data, **wrong})
