"""Control laws: one battery over all, and for each what makes it that law."""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lwa4d_sim.arm import load_arm
from lwa4d_sim.controllers import ComputedTorque, CustomController, PdGravity
from lwa4d_sim.controllers.task import LARGEST_DAMPING, SINGULAR_BELOW, Posture, operational_space
from lwa4d_sim.dynamics import NominalModel
from lwa4d_sim.edits import ArmEdits, Friction
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import Array, Controller, JointReference, JointState, TaskReference
from lwa4d_sim.mjcf import load_model
from lwa4d_sim.rotations import rotation_matrix
from lwa4d_sim.runner import run, run_batch
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.yaml_text import parse

DOCUMENT = Path(__file__).parents[1] / "docs" / "controllers.md"
N = 5
Parameters = PdGravity | ComputedTorque
LAWS: list[Parameters] = [
    PdGravity(kp=20.0, kd=5.0),
    PdGravity(space="task", kp=60.0, kd=20.0, posture=Posture(kp=5.0, kd=2.0)),
    ComputedTorque(p=10.0),
    ComputedTorque(space="task", p=10.0, posture=Posture(kp=9.0, kd=6.0)),
]
EVERY_LAW = pytest.mark.parametrize("parameters", LAWS, ids=lambda p: f"{p.kind}-{p.space}")
EVERY_ARM = pytest.mark.parametrize("name", ["lwa4d_3dof", "lwa4d_7dof"])


def build(parameters: Parameters, n: int, count: int = N) -> Controller:
    rows: Any = [parameters] * count
    return type(parameters).build(rows, n, 3 if n < 6 else 6)


def states(n: int, count: int = N) -> JointState:
    """Random states clear of singularities."""
    rng = np.random.default_rng(n)
    q = np.array([-1.5, -1.2, 1.5]) if n == 3 else np.array([-1.5, 0.5, 0.2, 1.5, 0.3, 0.8, 0.2])
    return JointState(q + rng.uniform(-0.3, 0.3, (count, n)), rng.normal(size=(count, n)))


def reached(state: JointState, model: NominalModel) -> tuple[JointReference, TaskReference]:
    """References that the state meets exactly, with no joint acceleration."""
    at = model.at(state.q, state.dq)
    rate, bias, pose = np.einsum("kij,kj->ki", at.J, state.dq), at.dJ_dq(state.dq), at.pose
    task = TaskReference(pose.x, rate[:, :3], bias[:, :3], posture=state.q)
    if state.q.shape[1] >= 6:
        task = TaskReference(pose.x, rate[:, :3], bias[:, :3], pose.R, rate[:, 3:], bias[:, 3:], state.q)
    return JointReference(state.q, state.dq, 0.0 * state.q), task


def reference(parameters: Parameters, state: JointState, model: NominalModel) -> Any:
    joint, task = reached(state, model)
    return joint if parameters.space == "joint" else task


def apart(ref: TaskReference, dx: Array, turn: Array | None = None) -> TaskReference:
    R = ref.R if ref.R is None or turn is None else rotation_matrix(turn) @ ref.R
    return TaskReference(ref.x + dx, ref.dx, ref.ddx, R, ref.w, ref.dw, ref.posture)


@EVERY_LAW
@EVERY_ARM
def test_battery_over_every_law(name: str, parameters: Parameters) -> None:
    model = NominalModel(load_arm(name).model, N)
    n = load_arm(name).model.nv
    state = states(n)
    ref = reference(parameters, state, model)
    law = build(parameters, n)
    tau = law.torque(state, ref, model)
    assert tau.shape == (N, n)
    assert np.isfinite(tau).all()
    # without any error the torque is the model's alone (the null-space damping of a moving redundant arm left out)
    still = PdGravity if isinstance(parameters, PdGravity) else ComputedTorque
    plain: Any = {"kp": 20.0, "kd": 5.0, "space": parameters.space}
    exact = build(still(**plain), n).torque(state, ref, model)
    at = model.at(state.q, None if still is PdGravity else state.dq)
    expected = at.h
    if still is ComputedTorque and parameters.space == "task" and n > 6:
        # of all torques without tool error it takes one; the others differ by self-motion only
        J, M = at.J, at.M
        np.testing.assert_allclose(
            np.einsum("kij,kj->ki", J, np.linalg.solve(M, (exact - expected)[..., None])[..., 0]), 0.0, atol=1e-9
        )
    np.testing.assert_allclose(exact, expected, atol=1e-9)
    # the arguments are left as they were, and the answer is a new array each time
    again = law.torque(state, ref, model)
    np.testing.assert_array_equal(again, tau)
    assert again is not tau
    # a reference that all simulations share may have a leading axis of one
    first = JointState(state.q[:1], state.dq[:1])
    one = reference(parameters, first, NominalModel(load_arm(name).model, 1))
    shared = law.torque(JointState(np.repeat(first.q, N, 0), np.repeat(first.dq, N, 0)), one, model)
    np.testing.assert_array_equal(shared, np.broadcast_to(shared[0], (N, n)))
    np.testing.assert_allclose(shared[0], tau[0], atol=1e-9)


@EVERY_ARM
def test_joint_laws_are_their_formulas(name: str) -> None:
    arm = load_arm(name)
    n = arm.model.nv
    state, model = states(n), NominalModel(arm.model, N)
    rng = np.random.default_rng(3)
    ref = JointReference(*(rng.normal(size=(N, n)) for _ in range(3)))
    kp, kd = rng.uniform(1.0, 9.0, (2, n))
    e, de = ref.q - state.q, ref.dq - state.dq
    tau = build(PdGravity(kp=tuple(kp), kd=tuple(kd)), n).torque(state, ref, model)
    np.testing.assert_allclose(tau, kp * e + kd * de + arm.dynamics.g(state.q), rtol=1e-12)
    tau = build(ComputedTorque(kp=tuple(kp), kd=tuple(kd)), n).torque(state, ref, model)
    a = ref.ddq + kd * de + kp * e
    expected = np.einsum("kij,kj->ki", arm.dynamics.M(state.q), a) + arm.dynamics.h(state.q, state.dq)
    np.testing.assert_allclose(tau, expected, rtol=1e-9, atol=1e-9)


def test_task_laws_are_their_formulas_on_three_joints() -> None:
    """With a square Jacobian, against the thesis's M J^-1 form with the Jacobian of the kinematics."""
    arm = load_arm("lwa4d_3dof")
    state, model = states(3), NominalModel(arm.model, N)
    rng = np.random.default_rng(4)
    ref = TaskReference(*(rng.normal(size=(N, 3)) for _ in range(3)))
    kp, kd = rng.uniform(1.0, 9.0, (2, 3))
    jacobian: Callable[[Array], Array] = lambda q: arm.kinematics.jacobian(q)[:, :3]  # noqa: E731
    J, step = jacobian(state.q), 1e-6
    rate = (jacobian(state.q + step * state.dq) - jacobian(state.q - step * state.dq)) / (2.0 * step)
    v, bias = (np.einsum("kij,kj->ki", A, state.dq) for A in (J, rate))
    e, de = ref.x - arm.kinematics.fk(state.q).x, ref.dx - v
    tau = build(PdGravity(space="task", kp=tuple(kp), kd=tuple(kd)), 3).torque(state, ref, model)
    np.testing.assert_allclose(tau, np.einsum("kij,ki->kj", J, kp * e + kd * de) + arm.dynamics.g(state.q), rtol=1e-10)
    tau = build(ComputedTorque(space="task", kp=tuple(kp), kd=tuple(kd)), 3).torque(state, ref, model)
    ddq = np.linalg.solve(J, (ref.ddx + kd * de + kp * e - bias)[..., None])[..., 0]
    expected = np.einsum("kij,kj->ki", arm.dynamics.M(state.q), ddq) + arm.dynamics.h(state.q, state.dq)
    np.testing.assert_allclose(tau, expected, rtol=1e-6)


def test_task_law_turns_the_tool_the_short_way() -> None:
    """An orientation error of 0.1 rad about an axis asks for Kp times 0.1 about that axis, and for nothing else."""
    arm = load_arm("lwa4d_7dof")
    state = JointState(states(7).q, np.zeros((N, 7)))
    model = NominalModel(arm.model, N)
    turn, dx = np.array([0.06, -0.08, 0.0]), np.array([0.01, 0.02, -0.03])
    ref = apart(reached(state, model)[1], dx, turn)
    kp = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    at = model.at(state.q)
    J, M, g = at.J, at.M, at.h
    wrench = np.array(kp) * np.concatenate([dx, turn])
    tau = build(PdGravity(space="task", kp=kp, kd=0.0), 7).torque(state, ref, model)
    np.testing.assert_allclose(tau - g, np.einsum("kij,i->kj", J, wrench), atol=1e-10)
    tau = build(ComputedTorque(space="task", kp=kp, kd=0.0), 7).torque(state, ref, model)
    acceleration = np.einsum("kij,kj->ki", J, np.linalg.solve(M, (tau - g)[..., None])[..., 0])
    np.testing.assert_allclose(acceleration, np.broadcast_to(wrench, (N, 6)), atol=1e-9)


@pytest.mark.parametrize("make", [PdGravity, ComputedTorque])
def test_posture_is_felt_by_no_task_axis(make: Any) -> None:
    arm = load_arm("lwa4d_7dof")
    state, model = states(7), NominalModel(arm.model, N)
    ref = apart(reached(state, model)[1], np.array([0.02, 0.0, -0.01]))
    ref = TaskReference(ref.x, ref.dx, ref.ddx, ref.R, ref.w, ref.dw, state.q + 0.3)
    without = build(make(space="task", kp=50.0, kd=10.0), 7).torque(state, ref, model)
    posture = Posture(kp=(9.0, 8.0, 7.0, 6.0, 5.0, 4.0, 3.0), kd=6.0)
    null = build(make(space="task", kp=50.0, kd=10.0, posture=posture), 7).torque(state, ref, model) - without
    assert np.abs(null).max(axis=1).min() > 0.01
    at = model.at(state.q)
    acceleration = np.linalg.solve(at.M, null[..., None])
    np.testing.assert_allclose(at.J @ acceleration, 0.0, atol=1e-10)
    # and along the one self-motion it pulls towards the posture and brakes
    direction = np.linalg.svd(at.J)[2][:, -1]
    pull = np.array(posture.kp) * 0.3 - 6.0 * state.dq
    weight = np.eye(7) if make is PdGravity else at.M
    asked = np.einsum("ki,kij,kj->k", direction, np.broadcast_to(weight, (N, 7, 7)), pull)
    np.testing.assert_allclose(np.einsum("ki,ki->k", direction, null), asked, rtol=1e-9)


@EVERY_ARM
def test_torque_stays_finite_at_a_singularity(name: str) -> None:
    arm = load_arm(name)
    n = arm.model.nv
    q = np.zeros((1, n))  # stretched out
    model = NominalModel(arm.model, 1)
    assert arm.kinematics.singularity(q)[0] < 1e-12
    state = JointState(q, np.ones((1, n)))
    ref = apart(reached(state, model)[1], np.array([-0.1, 0.1, -0.1]))
    for parameters in LAWS:
        if parameters.space == "task":
            tau = build(parameters, n, 1).torque(state, ref, model)
            assert np.isfinite(tau).all()
            assert np.abs(tau).max() < 1e4
    # the same demand ever nearer: no jump, and no growth beyond the damping's bound
    sizes = []
    for bend in np.geomspace(1e-8, 0.3, 200):
        q[0, 2 if n == 3 else 3] = bend
        tau = build(ComputedTorque(space="task", p=10.0), n, 1).torque(JointState(q, 0 * q), ref, model)
        sizes.append(np.abs(tau - model.at(q).h).max())
    assert max(sizes) < 1e4
    assert np.abs(np.diff(np.log(sizes))).max() < 0.5


def test_damping_is_exactly_zero_away_from_singularities() -> None:
    arm = load_arm("lwa4d_3dof")
    q = np.array([[0.3, -1.0, angle] for angle in (1.5, 1e-3)])
    M, J = arm.dynamics.M(q), arm.kinematics.jacobian(q)[:, :3]
    smallest = np.linalg.svd(J, compute_uv=False)[:, -1]
    assert smallest[0] > SINGULAR_BELOW > smallest[1]
    space = operational_space(J, M)
    plain = J @ np.linalg.solve(M, np.swapaxes(J, 1, 2))
    np.testing.assert_array_equal(space.mobility[0], plain[0])
    closeness = 1.0 - (smallest[1] / SINGULAR_BELOW) ** 2
    extra = LARGEST_DAMPING * closeness * np.trace(plain[1]) / 3.0
    np.testing.assert_allclose(space.mobility[1] - plain[1], extra * np.eye(3), atol=1e-12)


def document(controller: dict[str, Any], **blocks: Any) -> str:
    return json.dumps({
        "name": "law", "arm": "lwa4d_3dof", "initial": {"q": [-1.5, -1.2, 1.5]},
        "trajectory": {"waypoints": {"space": "joint", "points": [[-1.45, -1.15, 1.45]]}, "segment_time": 0.6,
                       "profile": "step", "follow": "joint"},
        "controller": controller, "loop": {"kind": "ideal"}, **blocks,
    })  # fmt: skip


@pytest.mark.parametrize("p", [5.0, 10.0, 20.0])
def test_computed_torque_has_the_error_dynamics_it_promises(p: float) -> None:
    log = run(Scenario.parse(document({"kind": "computed_torque", "p": p})))
    e0 = np.array([0.05, 0.05, -0.05])
    decay = (1.0 + p * log.t) * np.exp(-p * log.t)
    np.testing.assert_allclose(np.array([-1.45, -1.15, 1.45]) - log.q, e0 * decay[:, None], atol=1e-4 * 0.05)


def test_computed_torque_in_task_space_has_them_at_the_tool() -> None:
    text = document({"kind": "computed_torque", "space": "task", "p": 10.0})
    overrides = {"trajectory.waypoints": {"space": "task", "points": [[0.05, -0.35, 0.6]]}, "trajectory.follow": "task"}
    log = run(Scenario.parse(text, overrides=overrides))
    decay = (1.0 + 10.0 * log.t) * np.exp(-10.0 * log.t)
    e0 = log.x_ref[-1] - log.x[0]
    assert np.linalg.norm(e0) > 0.05
    np.testing.assert_allclose(log.x_ref[-1] - log.x, e0 * decay[:, None], atol=1e-4 * float(np.linalg.norm(e0)))


def test_the_two_spaces_agree_on_a_path_that_both_follow() -> None:
    """On a joint-space quintic with a perfect model both computed torques track it, so they are the same motion."""
    moves = {"trajectory.profile": "quintic", "trajectory.waypoints.points": [[-1.2, -0.9, 1.2]]}
    joint, task = (
        run(Scenario.parse(document({"kind": "computed_torque", "space": space, "p": 10.0}), overrides=moves))
        for space in ("joint", "task")
    )
    assert np.abs(joint.q[-1] - joint.q[0]).min() > 0.2
    np.testing.assert_allclose(task.q, joint.q, atol=1e-6)
    np.testing.assert_allclose(task.tau, joint.tau, atol=1e-2)


def test_gravity_compensation_holds_against_gravity() -> None:
    still = {"trajectory.waypoints.points": [[-1.5, -1.2, 1.5]]}
    log = run(Scenario.parse(document({"kind": "pd_gravity", "kp": 20.0, "kd": 5.0}), overrides=still))
    np.testing.assert_allclose(log.q, np.broadcast_to(log.q[0], log.q.shape), atol=1e-9)
    assert np.abs(log.tau[0]).max() > 5.0


def test_a_wrong_belief_is_a_steady_error_of_its_own_size() -> None:
    """Payload unknown to the controller: at rest Kp e equals the gravity torque that it does not know."""
    law = {"kind": "pd_gravity", "kp": 200.0, "kd": 60.0}
    blocks = {"plant": {"payload": {"mass": 2.0}}}
    still = {"trajectory.waypoints.points": [[-1.5, -1.2, 1.5]], "trajectory.segment_time": 4.0}
    log = run(Scenario.parse(document(law, **blocks), overrides=still))
    tool = load_arm("lwa4d_3dof").kinematics.jacobian(log.q[-1])[2]
    np.testing.assert_allclose(200.0 * (log.q[-1] - log.q[0]), -2.0 * 9.81 * tool, atol=1e-3)
    known = run(Scenario.parse(document({**law, "model": blocks["plant"]}, **blocks), overrides=still))
    np.testing.assert_allclose(known.q[-1], known.q[0], atol=1e-8)


def test_gains_of_the_wrong_length_are_errors() -> None:
    for make, key in ((PdGravity, "kp"), (ComputedTorque, "kd")):
        gains: Any = {"kp": 1.0, "kd": 1.0, key: (1.0, 2.0)}
        with pytest.raises(ScenarioError, match="has 2 values; give one number or one for each of 3 axes") as caught:
            build(make(**gains), 3)
        assert caught.value.key == f"controller.{key}"
    with pytest.raises(ScenarioError, match="has 2 values; give one number or one for each of 7 axes") as caught:
        build(PdGravity(space="task", kp=1.0, kd=1.0, posture=Posture(kd=(1.0, 2.0))), 7)
    assert caught.value.key == "controller.posture.kd"
    text = document({"kind": "pd_gravity", "space": "task", "kp": [1.0] * 4, "kd": 1.0})
    with pytest.raises(
        ScenarioError, match=r"scenario:1: controller\.kp .*has 4 values; give one number or one for each of 3 axes"
    ):
        run(Scenario.parse(text))


def test_gains_may_differ_within_a_batch() -> None:
    rows = [PdGravity(kp=1.0, kd=0.0), PdGravity(kp=(1.0, 2.0, 3.0), kd=1.0)]
    model = NominalModel(load_arm("lwa4d_3dof").model, 2)
    state = JointState(np.zeros((2, 3)), np.ones((2, 3)))
    ref = JointReference(np.ones((1, 3)), np.zeros((1, 3)), np.zeros((1, 3)))
    tau = PdGravity.build(rows, 3, 3).torque(state, ref, model) - model.at(state.q).h
    np.testing.assert_allclose(tau, [[1.0, 1.0, 1.0], [0.0, 1.0, 2.0]], atol=1e-12)


def test_friction_fed_forward_is_the_models_at_the_desired_speed() -> None:
    edits = ArmEdits(friction=Friction(viscous=(3.0, 2.0, 1.0), coulomb=(5.0, 4.0, 0.0)))
    model = NominalModel(load_model("lwa4d_3dof", edits), N)
    state = states(3)
    ref = JointReference(state.q, np.full((N, 3), -0.2), 0.0 * state.q)
    plain, fed = (build(ComputedTorque(p=10.0, friction=on), 3).torque(state, ref, model) for on in (False, True))
    np.testing.assert_allclose(fed - plain, np.full((N, 3), [-0.6 - 5.0, -0.4 - 4.0, -0.2]), atol=1e-12)
    assert not model.friction(np.zeros((N, 3))).any()
    with pytest.raises(ValueError, match="joint space only"):
        ComputedTorque(space="task", p=10.0, friction=True)


def test_friction_fed_forward_follows_better() -> None:
    """With the drivetrain's friction, 44 N m at the shoulder, the error falls to less than a tenth."""
    errors = {}
    for on in (False, True):
        log = run(Scenario.parse(FRICTION, overrides={"controller.friction": on}))
        errors[on] = log.metrics()["rms_error"]
    assert errors[True] < 0.1 * errors[False]


FRICTION = """
name: friction
arm: lwa4d_3dof
plant: {armature: lwa4d, friction: lwa4d}
trajectory:
  waypoints: {space: joint, points: [[-1.0, -1.2, 1.2], [-1.5, -1.5, 1.5]]}
  segment_time: 2.0
controller: {kind: computed_torque, p: 15, model: {armature: lwa4d, friction: lwa4d}}
"""


def test_computed_torque_wants_its_gains_one_way() -> None:
    assert ComputedTorque(p=3.0).gains == (9.0, 6.0)
    assert ComputedTorque(kp=1.0, kd=2.0).gains == (1.0, 2.0)
    wrongs: list[dict[str, Any]] = [
        {},
        {"p": 1.0, "kp": 1.0, "kd": 1.0},
        {"p": 1.0, "kd": 1.0},
        {"kp": 1.0},
        {"kd": 1.0},
    ]
    for wrong in wrongs:
        with pytest.raises(ValueError, match="give either p, or both kp and kd"):
            ComputedTorque(**wrong)


def block(language: str) -> str:
    found = re.search(rf"```{language}\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    assert found is not None
    return found[1]


@pytest.fixture
def laws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Makes a module `my_laws` of a text."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "my_laws", raising=False)

    def write(text: str) -> None:
        (tmp_path / "my_laws.py").write_text(text)

    return write


def test_the_pages_own_controller_runs(laws: Callable[[str], None]) -> None:
    code = block("python")
    assert sum(bool(line.strip()) for line in code.splitlines()) <= 10
    laws(code)
    controller: Any = parse(block("yaml"), "page")[0]["controller"]
    blocks = {"plant": {"payload": {"mass": 2.0}}, "loop": {"period": 0.01}}
    still = {"trajectory.waypoints.points": [[-1.5, -1.2, 1.5]], "trajectory.segment_time": 2.5}
    mine = run(Scenario.parse(document(controller, **blocks), overrides=still))
    plain = run(Scenario.parse(document({"kind": "pd_gravity", "kp": 60.0, "kd": 15.0}, **blocks), overrides=still))
    assert mine.metrics()["stable"]
    # the payload is unknown to both; only the integral takes the error away
    assert np.abs(plain.q[-1] - plain.q[0]).max() > 0.05
    assert np.abs(mine.q[-1] - mine.q[0]).max() < 0.1 * np.abs(plain.q[-1] - plain.q[0]).max()


TWIN = """
class Twin:
    def __init__(self, kp, kd):
        self.kp, self.kd = kp, kd

    def torque(self, state, ref, model):
        g = model.at(state.q).h
        return self.kp * (ref.q - state.q) + self.kd * (ref.dq - state.dq) + g

class Flat(Twin):
    def torque(self, state, ref, model):
        return super().torque(state, ref, model)[0]

class Silent:
    pass
"""


def test_a_copy_of_a_shipped_law_gives_its_bits(laws: Callable[[str], None]) -> None:
    laws(TWIN)
    blocks = {"loop": {"latency": {"kind": "uniform", "high": 0.008}, "loss": 0.2}}
    changes = [{"plant.seed": k} for k in range(3)]
    texts = [document({"kind": kind, "kp": 20.0, "kd": 5.0}, **blocks) for kind in ("my_laws:Twin", "pd_gravity")]
    logs, shipped = (list(run_batch(Scenario.parse(text), changes)) for text in texts)
    for a, b in zip(logs, shipped, strict=True):
        np.testing.assert_array_equal(a.q, b.q)
        np.testing.assert_array_equal(a.tau, b.tau)


@pytest.mark.parametrize(
    ("controller", "message"),
    [
        (
            {"kind": "my_laws:Flat", "kp": 1.0, "kd": 1.0},
            r"torque\(\) of my_laws:Flat returned shape \(3,\); must be \(1, 3\)",
        ),
        ({"kind": "my_laws:Silent"}, r"my_laws:Silent has no method torque\(state, ref, model\)"),
        ({"kind": "my_laws:Nobody"}, r"has no attribute 'Nobody'; give package.module:Class"),
        ({"kind": "no_such_module:Law"}, r"No module named 'no_such_module'"),
        ({"kind": "my_laws:Twin", "kp": 1.0}, r"cannot be made from \{'kp': 1.0\}: .*missing 1 required .*'kd'"),
    ],
)
def test_errors_of_your_own_controller(laws: Callable[[str], None], controller: dict[str, Any], message: str) -> None:
    laws(TWIN)
    with pytest.raises(ScenarioError, match=message) as caught:
        run(Scenario.parse(document(controller)))
    assert "controller.kind" in str(caught.value)


def test_options_reach_the_class_by_name(laws: Callable[[str], None]) -> None:
    laws(TWIN)
    law: Any = CustomController(kind="my_laws:Twin", options={"kp": 2.0, "kd": 3.0}).create()
    assert (law.law.kp, law.law.kd) == (2.0, 3.0)
