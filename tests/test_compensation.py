"""What wins back gain lost to the bus: each block against the plant's own truth, and what it buys."""

import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from gain_limit import critical_gain
from hypothesis import given, settings
from hypothesis import strategies as st
from test_batch_bits import ARMS, LAWS, ROUGH, check, members
from test_batch_bits import scenario as bits_scenario
from test_bus_live import ARM, Rig

from lwa4d_sim.arm import load_arm
from lwa4d_sim.controllers import PdGravity
from lwa4d_sim.controllers.task import operational_space
from lwa4d_sim.dynamics import NominalModel
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import Array, JointReference, JointState, TaskReference
from lwa4d_sim.record import RunLog
from lwa4d_sim.runner import run, run_batch
from lwa4d_sim.scenario import Scenario

PREDICTOR: dict[str, Any] = {"compensation": {"predictor": {}}}
OBSERVER: dict[str, Any] = {"loop.velocity": {"kind": "observer"}}
NEXT_SYNC: dict[str, Any] = {"loop.actuation": "next_sync"}
MILLIDEGREE = 1.7453292519943296e-05  # [rad] the bus's resolution


class Spy:
    """Computed torque that keeps the states it is given."""

    seen: ClassVar[list[JointState]] = []

    def torque(self, state: JointState, ref: Any, model: Any) -> Array:
        self.seen.append(JointState(state.q.copy(), state.dq.copy()))
        terms = model.at(state.q, state.dq)
        a = ref.ddq + 20.0 * (ref.dq - state.dq) + 100.0 * (ref.q - state.q)
        tau: Array = np.einsum("bij,bj->bi", terms.M, a) + terms.h
        return tau


def smooth(arm: str, changes: Mapping[str, Any], seconds: float = 1.0) -> Scenario:
    """Computed torque on a quintic motion at the end of a 10 ms bus, true speeds."""
    q0 = ARMS[arm][0]
    reach = 0.6 if arm == "lwa4d_3dof" else 0.25
    document = {
        "name": "smooth",
        "arm": arm,
        "initial": {"q": q0},
        "trajectory": {
            "waypoints": {"space": "joint", "points": [[angle + reach for angle in q0]]},
            "segment_time": seconds,
            "profile": "quintic",
            "follow": "joint",
        },
        "controller": {"kind": "computed_torque", "p": 10.0},
        "loop": {"kind": "sampled", "velocity": {"kind": "true"}},
    }
    return Scenario.parse(json.dumps(document), overrides=changes)


LATE: dict[str, dict[str, Any]] = {
    "next_sync": {"loop.actuation": "next_sync"},
    "latency": {"loop.latency": {"measurement": 0.0034, "command": 0.0043}},
    "two_periods": {"loop.latency": {"measurement": 0.0084, "command": 0.0117}},
    "old_samples": {"loop.latency": {"measurement": 0.0123, "command": 0.002}, "loop.actuation": "next_sync"},
    "per_joint": {"loop.latency": {"measurement": 0.002, "command": [0.003, 0.003, 0.003]}},
    "closed_form": {"loop.actuation": "next_sync", "controller.model": {"dynamics": "closed_form"}},
}
# from the computation to the instant its command acts [ms]
ACTS = {"next_sync": 10, "latency": 5, "two_periods": 12, "old_samples": 7, "per_joint": 3, "closed_form": 10}


THREE_JOINTS = ("per_joint", "closed_form")


@pytest.mark.parametrize(
    ("arm", "late"), [(arm, late) for arm in ARMS for late in LATE if arm == "lwa4d_3dof" or late not in THREE_JOINTS]
)
def test_the_law_gets_the_state_in_which_its_command_will_act(arm: str, late: str) -> None:
    """Exact model, true speeds at the sample: the prediction is the plant's own state, up to two periods later."""
    Spy.seen.clear()
    law = {"kind": "test_compensation:Spy", "model": LATE[late].get("controller.model", {})}
    changes = {key: value for key, value in LATE[late].items() if not key.startswith("controller")}
    log = run(smooth(arm, {**changes, **PREDICTOR, "controller": law}))
    skipped = len(log.ticks.t) - len(Spy.seen)
    at = np.rint(log.ticks.t[skipped:] / 0.001).astype(int) + ACTS[late]
    given_q, given_dq = (np.stack([state[k][0] for state in Spy.seen]) for k in (0, 1))
    inside = at < len(log.q)
    assert inside.sum() > 90
    np.testing.assert_allclose(given_q[inside], log.q[at[inside]], atol=1e-8)
    np.testing.assert_allclose(given_dq[inside], log.dq[at[inside]], atol=1e-7)
    moved = np.abs(log.q[at[inside]] - log.ticks.q[skipped:][inside]).max()
    assert moved > 1e-3, "the joints move meanwhile"


@pytest.mark.parametrize("arm", ARMS)
def test_with_an_exact_model_next_sync_gives_the_torques_of_the_immediate_loop(arm: str) -> None:
    """One period earlier, and that one it spends behind closed brakes; the motion begins too gently to tell."""
    late, prompt, bare = (run(smooth(arm, each)) for each in ({**NEXT_SYNC, **PREDICTOR}, {}, NEXT_SYNC))

    def distance(log: RunLog) -> float:
        return float(np.abs(log.ticks.tau[:-1] - prompt.ticks.tau[1:]).max())

    assert distance(late) < 1e-7
    assert distance(bare) > 0.03


def test_without_delay_the_predictor_changes_nothing() -> None:
    """Immediate actuation without latency, and the ideal loop: not a bit."""
    for changes in ({}, {"loop": {"kind": "ideal"}}):
        with_it, without = (run(smooth("lwa4d_3dof", {**changes, **more})) for more in (PREDICTOR, {}))
        np.testing.assert_array_equal(with_it.q, without.q)
        np.testing.assert_array_equal(with_it.ticks.tau, without.ticks.tau)


def test_a_horizon_of_ones_own_is_kept_to() -> None:
    """The default spelt out gives the same bits; none at all is no prediction."""
    own, default, zero, bare = (
        run(smooth("lwa4d_3dof", {**NEXT_SYNC, **more}))
        for more in ({"compensation.predictor.horizon": 0.01}, PREDICTOR, {"compensation.predictor.horizon": 0}, {})
    )
    np.testing.assert_array_equal(own.q, default.q)
    # without any, the reference too is taken at the sample, which here is the instant of computation
    np.testing.assert_array_equal(zero.q, bare.q)


# ---- the state observer ----


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("late", ["next_sync", "two_periods"])
def test_the_observer_finds_the_true_speed(arm: str, late: str) -> None:
    log = run(smooth(arm, {**LATE[late], **OBSERVER}))
    assert np.abs(log.ticks.dq_true).max() > 0.3
    stamps = np.rint((log.ticks.t - log.ticks.age) / 0.001).astype(int)
    known = stamps >= 0
    np.testing.assert_allclose(log.ticks.dq[known], log.dq[stamps[known]], atol=1e-6)
    np.testing.assert_allclose(log.ticks.q[known], log.q[stamps[known]], atol=1e-8)


def speed_noise(kind: str, resolution: float) -> float:
    """Error [rad/s] of a speed estimate from an encoder with steps, on a smooth motion."""
    log = run(smooth("lwa4d_3dof", {"loop.velocity": {"kind": kind}, "loop.position_resolution": resolution}))
    error = log.ticks.dq[20:] - log.ticks.dq_true[20:]
    if kind == "backward_difference":  # half a period late; of the noise only
        middle = log.dq[np.rint(log.ticks.t[20:] / 0.001).astype(int) - 5]
        error = log.ticks.dq[20:] - middle
    return float(np.sqrt(np.mean(error**2)))


@pytest.mark.parametrize("steps", [1, 10])
def test_the_observer_filters_the_encoder_better_than_differences(steps: int) -> None:
    resolution = steps * MILLIDEGREE
    assert speed_noise("observer", resolution) < 0.7 * speed_noise("backward_difference", resolution)


def test_the_observer_carries_on_through_lost_samples() -> None:
    """With an exact model a lost sample costs it nothing; differences stand still meanwhile."""
    changes = {"loop.loss": {"measurement": {"probability": 0.3, "mean_burst": 3.0}}, "plant.seed": 3}
    errors = {}
    for kind in ("observer", "backward_difference"):
        log = run(smooth("lwa4d_3dof", {**changes, "loop.velocity": {"kind": kind}}))
        assert log.ticks.age.max() > 0.02
        seen = ~np.isnan(log.ticks.dq).any(axis=1)
        errors[kind] = np.abs(log.ticks.dq[seen] - log.ticks.dq_true[seen]).max()
    assert errors["observer"] < 1e-6
    assert errors["backward_difference"] > 0.05
    # nor does the period until its command acts cost anything
    late, prompt = (
        run(smooth("lwa4d_3dof", each)) for each in ({**changes, **OBSERVER, **PREDICTOR, **NEXT_SYNC}, OBSERVER)
    )
    np.testing.assert_allclose(late.ticks.tau[:-1], prompt.ticks.tau[1:], atol=1e-5)


# ---- the disturbance observer ----


def resting(changes: Mapping[str, Any]) -> RunLog:
    """PD+G holding a pose for 3 s."""
    text = json.dumps({
        "name": "rest",
        "arm": "lwa4d_3dof",
        "initial": {"q": [-1.5, -1.2, 1.5]},
        "trajectory": {"waypoints": {"space": "joint", "points": [[-1.5, -1.2, 1.5]]}, "segment_time": 3.0},
        "controller": {"kind": "pd_gravity", "kp": 60.0, "kd": 12.0},
    })  # fmt: skip
    return run(Scenario.parse(text, overrides=changes))


UNKNOWN: dict[str, Any] = {"plant.payload": {"mass": 2.0}}
REJECT: dict[str, Any] = {"compensation": {"disturbance_observer": {"bandwidth": 20.0}}}


@pytest.mark.parametrize("loop", ["sampled", "ideal", "next_sync"])
def test_an_unknown_payload_leaves_no_steady_error(loop: str) -> None:
    ways: dict[str, dict[str, Any]] = {
        "sampled": OBSERVER,
        "ideal": {"loop": {"kind": "ideal"}},
        "next_sync": {**OBSERVER, **NEXT_SYNC},
    }
    bare, with_it = resting({**ways[loop], **UNKNOWN}), resting({**ways[loop], **UNKNOWN, **REJECT})
    assert np.abs(bare.q[-1] - bare.q[0]).max() > 0.1
    assert np.abs(with_it.q[-1] - with_it.q[0]).max() < 1e-5
    # what it found is the payload's weight: the command less what the law would ask for there
    model = load_arm("lwa4d_3dof")
    tool = model.kinematics.jacobian(with_it.q[-1])[2]
    law = model.dynamics.g(with_it.q[-1]) + 60.0 * (with_it.q[0] - with_it.q[-1])
    np.testing.assert_allclose(with_it.tau[-1] - law, 2.0 * 9.81 * tool, atol=1e-3)


def test_the_estimate_rises_with_its_bandwidth() -> None:
    """A push of 10 N m is found as 10 (1 - e^(-K t)), whatever the law and the arm's motion."""
    log = resting({
        "controller": {"kind": "test_compensation:Silent"},
        "loop.velocity": {"kind": "true"},
        "plant.gravity": [0, 0, 0],
        "plant.disturbances": [{"at": 0.1, "duration": 0.4, "torque": [0, 0, 10.0]}],
        "controller.model": {"gravity": [0, 0, 0]},
        "compensation": {"disturbance_observer": {"bandwidth": 8.0}},
    })  # fmt: skip
    t = log.ticks.t - 0.1
    found = -log.ticks.tau[:, 0]
    during = (t >= 0) & (t < 0.4)
    np.testing.assert_allclose(found[during], 10.0 * (1.0 - np.exp(-8.0 * t[during])), atol=0.02)
    np.testing.assert_allclose(log.ticks.tau[:9], 0.0, atol=1e-9)


class Silent:
    """Asks for nothing."""

    def torque(self, state: JointState, ref: Any, model: Any) -> Array:
        return np.zeros_like(state.q)


def test_with_an_exact_model_it_finds_nothing_and_harms_nothing() -> None:
    bare, with_it = (run(smooth("lwa4d_3dof", {**OBSERVER, **NEXT_SYNC, **each})) for each in ({}, REJECT))
    np.testing.assert_allclose(with_it.q, bare.q, atol=1e-4)


# ---- gains that follow the inertia, and the damping limit ----


def pd_law(n: int, delay: float = 0.0, **parameters: Any) -> tuple[Any, NominalModel]:
    arm = load_arm("lwa4d_3dof" if n == 3 else "lwa4d_7dof").model
    return PdGravity.build([PdGravity(**parameters)], n, 3 if n == 3 else 6, [delay]), NominalModel(arm, 1)


def response(law: Any, model: Any, q: Array, error: Array, rate: Array) -> Array:
    """Torque (n,) beyond gravity for an error and a rate of the joints."""
    ref = JointReference(q + error, rate, np.zeros_like(q))
    tau = law.torque(JointState(q, np.zeros_like(q)), ref, model)
    found: Array = (tau - model.at(q).h)[0]
    return found


POSES = {
    3: [[0.3, -1.1, 0.9], [2.1, 0.4, -1.7]],
    7: [[-1.5, 0.3, 0.2, 1.5, 0.1, 0.4, 0.2], [0.3, 0.9, -1, 0.7, 2, 1, 1]],
}
EVERY_POSE = [(n, np.array([q])) for n, poses in POSES.items() for q in poses]


@pytest.mark.parametrize(("n", "q"), EVERY_POSE)
def test_scheduled_with_the_inertia_one_gain_is_one_dynamics_at_all_poses(n: int, q: Array) -> None:
    law, model = pd_law(n, schedule="inertia", kp=7.0, kd=3.0)
    error, rate = np.linspace(-0.2, 0.3, n)[None], np.linspace(1.0, -1.0, n)[None]
    tau = response(law, model, q, error, rate)
    np.testing.assert_allclose(np.linalg.solve(model.at(q).M[0], tau), 7.0 * error[0] + 3.0 * rate[0], atol=1e-9)
    law, model = pd_law(n, schedule="diagonal", kp=7.0, kd=3.0)
    expected = np.diag(model.at(q).M[0]) * (7.0 * error[0] + 3.0 * rate[0])
    np.testing.assert_allclose(response(law, model, q, error, rate), expected, atol=1e-9)


@pytest.mark.parametrize(("n", "q"), EVERY_POSE)
def test_in_task_space_the_tool_is_the_mass(n: int, q: Array) -> None:
    """With `inertia` the tool accelerates by Kp e + Kd de along every axis (operational space)."""
    law, model = pd_law(n, space="task", schedule="inertia", kp=5.0, kd=2.0)
    terms = model.at(q)
    pose, M, h, J = terms.pose, terms.M, terms.h, terms.J
    m = 3 if n == 3 else 6
    step, speed = np.array([[0.01, -0.02, 0.03]]), np.array([[0.1, 0.2, -0.3]])
    turn = {} if n == 3 else {"R": pose.R, "w": np.zeros((1, 3)), "dw": np.zeros((1, 3))}
    ref = TaskReference(pose.x + step, speed, np.zeros((1, 3)), **turn)
    tau = law.torque(JointState(q, np.zeros_like(q)), ref, model) - h
    found = J[0, :m] @ np.linalg.solve(M[0], tau[0])
    assert np.linalg.svd(J[0, :m], compute_uv=False)[-1] > 0.03, "no damped inverse here"
    np.testing.assert_allclose(found[:3], 5.0 * step[0] + 2.0 * speed[0], atol=1e-9)
    np.testing.assert_allclose(found[3:], 0.0, atol=1e-9)
    with_diagonal, _ = pd_law(n, space="task", schedule="diagonal", kp=5.0, kd=2.0)
    Lambda = np.linalg.inv(operational_space(J[:, :m], M).mobility)[0]
    force = np.diag(Lambda)[:3] * (5.0 * step[0] + 2.0 * speed[0])
    expected = J[0, :3].T @ force
    tau = with_diagonal.torque(JointState(q, np.zeros_like(q)), ref, model) - h
    np.testing.assert_allclose(tau[0], expected, atol=1e-8)


def damping_matrix(law: Any, model: Any, q: Array) -> Array:
    n = q.shape[1]
    return np.stack([response(law, model, q, np.zeros((1, n)), row[None]) for row in np.eye(n)], axis=1)


@settings(max_examples=40, deadline=None)
@given(
    st.sampled_from(EVERY_POSE),
    st.floats(0.05, 1.5),
    st.floats(0.005, 0.05),
    st.lists(st.floats(0.0, 40.0), min_size=7, max_size=7),
    st.sampled_from(["none", "diagonal", "inertia"]),
)
def test_the_damping_limit_holds_in_every_direction(
    pose: tuple[int, Array], beta: float, delay: float, kd: list[float], schedule: str
) -> None:
    n, q = pose
    gains: dict[str, Any] = {"schedule": schedule, "kp": 0.0, "kd": tuple(kd[:n])}
    law, model = pd_law(n, delay, damping_limit=beta, **gains)
    free, _ = pd_law(n, delay, **gains)
    M = model.at(q).M[0]
    D, unlimited = damping_matrix(law, model, q), damping_matrix(free, model, q)
    found, before = (np.sort(np.linalg.eigvals(np.linalg.solve(M, each)).real) for each in (D, unlimited))
    bound = beta / delay
    np.testing.assert_allclose(found, np.minimum(before, bound), atol=1e-6 * max(bound, before.max()))
    if before.max() < bound * (1 - 1e-9):
        np.testing.assert_array_equal(D, unlimited)


def test_the_delay_that_limits_the_damping_is_the_loops() -> None:
    """Period 10 ms: half of it, the filter's 2 T, the wait for the SYNC; less what a predictor makes up for."""
    from lwa4d_sim.lateness import loop_delay

    expected: list[tuple[dict[str, Any], float]] = [
        ({"loop": {"kind": "ideal"}}, 0.0),
        ({}, 0.005),
        (NEXT_SYNC, 0.015),
        ({**NEXT_SYNC, **PREDICTOR}, 0.005),
        ({**NEXT_SYNC, "compensation.predictor.horizon": 0.004}, 0.011),
        ({"loop.velocity": {"kind": "filtered_derivative"}}, 0.025),
        ({"loop.velocity": {"kind": "filtered_derivative", "runs_on": "held"}}, 0.03),
        ({"loop.velocity": {"kind": "tustin", "time_constant": 0.003}}, 0.011),
        ({"loop.velocity": {"kind": "backward_difference"}}, 0.01),
        ({**OBSERVER, "loop.latency": {"measurement": 0.0123, "command": 0.002}}, 0.02),
        ({"loop.latency": {"command": [0.001, 0.004, 0.002]}}, 0.009),
        ({"loop.latency": {"kind": "uniform", "low": 0.002, "high": 0.004}, "loop.jitter": 0.002}, 0.009),
        ({"loop": {"kind": "canopen"}}, 0.035),
    ]
    for changes, delay in expected:
        made = smooth("lwa4d_3dof", changes).variants["default"]
        assert loop_delay(made) == pytest.approx(delay, abs=1e-12), changes


# ---- the parts together ----


@pytest.mark.parametrize("arm", ARMS)
def test_members_of_a_batch_have_the_bits_of_single_runs(arm: str) -> None:
    """On a link that loses and overtakes, joint by joint, with parameters of each member's own."""
    changes = [
        {
            **member,
            "compensation": {
                "predictor": {} if k % 2 else {"horizon": 0.001 * (k % 30)},
                "disturbance_observer": {"bandwidth": 2.0 + k % 7},
            },
            "controller.damping_limit": None if k % 3 == 0 else 0.2 + 0.1 * (k % 5),
            **OBSERVER,
        }
        for k, member in enumerate(members(arm))
    ]
    logs = check(bits_scenario(arm, LAWS["pd_joint"], ROUGH), changes)
    assert len({log.events for log in logs}) > 1


def test_members_may_differ_in_latency() -> None:
    law = {**LAWS["pd_joint"], "schedule": "diagonal"}
    changes = [
        {**member, "loop.latency": {"command": 0.0007 * k}, "compensation": {"predictor": {}}}
        for k, member in enumerate(members("lwa4d_3dof", 20))
    ]
    check(bits_scenario("lwa4d_3dof", law, {"velocity": {"kind": "observer"}}), changes, alone=(0, 1, 19))


def test_members_have_the_same_blocks() -> None:
    made = bits_scenario("lwa4d_3dof", LAWS["pd_joint"], {})
    for change in (PREDICTOR, REJECT):
        with pytest.raises(ScenarioError, match="member 1 of the batch differs in 'compensation'"):
            list(run_batch(made, [{}, change]))
    with pytest.raises(ScenarioError, match=r"member 1 of the batch differs in 'controller\.schedule'"):
        list(run_batch(made, [{}, {"controller.schedule": "inertia"}]))


def test_over_a_bus_that_costs_nothing_it_is_the_sampled_loop() -> None:
    blocks = {"compensation": {"predictor": {}, "disturbance_observer": {"bandwidth": 20.0}}, **UNKNOWN}
    velocity = {"kind": "observer"}
    sampled = {**NEXT_SYNC, **OBSERVER, "loop.position_resolution": MILLIDEGREE}
    canopen = {"loop": {"kind": "canopen", "bit_rate": None, "velocity": velocity}}
    one, other = (run(smooth("lwa4d_3dof", {**blocks, **each})) for each in (sampled, canopen))
    assert np.abs(one.q[-1] - one.q[0]).max() > 0.5
    np.testing.assert_allclose(other.q, one.q, atol=5e-4)  # torques are per mille of 372 N m there
    real = run(smooth("lwa4d_3dof", {**blocks, "loop": {"kind": "canopen", "velocity": velocity}}))
    np.testing.assert_allclose(real.q, other.q, atol=5e-4)


def test_a_lost_arm_stays_lost_without_a_warning() -> None:
    blocks = {"compensation": {"predictor": {}, "disturbance_observer": {"bandwidth": 200.0}}}
    changes = {**blocks, **OBSERVER, **NEXT_SYNC, "controller": {"kind": "pd_gravity", "kp": 4e3, "kd": 4e3}}
    log = run(smooth("lwa4d_7dof", changes))
    assert not log.metrics()["stable"]


def test_a_live_run_has_it_too(tmp_path: Path) -> None:
    """What drives a real bus, here over the simulated wire: the speed is the model's, not the drives' own."""
    path = tmp_path / "fast.yaml"
    blocks = "compensation: {predictor: {}, disturbance_observer: {bandwidth: 10}}\n"
    text = ARM.replace("PERIOD", "0.01").replace("DEADLINE", "0.005") + blocks
    path.write_text(text.replace("heartbeat: 0.5", "heartbeat: 0.5, velocity: {kind: observer}"))
    rig = Rig(path)
    assert rig.live.run(150, bool) == "done"
    log = rig.live.record()
    slope = (log.q[2:] - log.q[:-2]) / 0.02
    assert np.abs(slope).max() > 0.1
    np.testing.assert_allclose(log.dq[1:-1], slope, atol=6e-3)  # a millidegree a period is 1.7e-3 rad/s
    assert np.abs(log.q[1:] - log.ticks.q_ref[1:]).max() < 4e-3, "7.6e-3 without the blocks"


MISTAKES = [
    ("controller.schedule", "full", "must be one of none, diagonal, inertia"),
    ("controller.damping_limit", 0, "must be a number above 0"),
    ("controller.damping_limit", "much", "must be a number above 0"),
    ("compensation", True, r"must be a mapping \(keys: predictor, disturbance_observer\)"),
    ("compensation.predictor.horizon", -0.01, "must be a number of at least 0"),
    ("compensation.predictor", 0.01, r"must be a mapping \(keys: horizon\)"),
    ("compensation.predictor.horizn", 0.01, "unknown key; did you mean 'horizon'"),
    ("compensation.disturbance_observer.bandwidth", 0, "must be a number above 0"),
    ("compensation.disturbance_observer", {}, "is missing; it must be a number above 0"),
    ("compensation.smith", {}, "unknown key; valid here: predictor, disturbance_observer"),
    ("loop.velocity", {"kind": "observer", "acceleration": 0}, "must be a number above 0"),
    ("loop.velocity", {"kind": "observer", "noise": 1}, "unknown key"),
    ("loop.velocity", {"kind": "observed"}, "must be one of .*, observer"),
]


@pytest.mark.parametrize(("key", "value", "rule"), MISTAKES)
def test_bad_input_is_named(key: str, value: Any, rule: str) -> None:
    base = bits_scenario("lwa4d_3dof", LAWS["pd_joint"], {})
    with pytest.raises(ScenarioError, match=rf"^scenario.*{key.rsplit('.', 1)[0]}.*: {rule}") as caught:
        Scenario.parse(base.text, overrides={key: value})
    assert "\n" not in str(caught.value)


def test_a_predictor_needs_to_know_when_commands_act() -> None:
    canopen = {"kind": "canopen", "actuation": "immediate", "velocity": {"kind": "observer"}}
    with pytest.raises(ScenarioError, match=r"compensation\.predictor.*: horizon is needed where a command acts when"):
        run(smooth("lwa4d_3dof", {**PREDICTOR, "loop": canopen}))
    given = {"compensation.predictor.horizon": 0.003}
    log = run(smooth("lwa4d_3dof", {**given, "loop": canopen}))
    assert log.metrics()["stable"]


def test_a_variant_switches_it_on_and_off() -> None:
    text = json.loads(bits_scenario("lwa4d_3dof", LAWS["pd_joint"], {}).text)
    text["compensation"] = {"predictor": {}, "disturbance_observer": {"bandwidth": 5.0}}
    text["variants"] = {
        "both": {},
        "one": {"compensation": {"predictor": None}},
        "none": {"compensation": None},
    }
    made = Scenario.parse(json.dumps(text)).variants
    assert [bool(each.compensation and each.compensation.predictor) for each in made.values()] == [True, False, False]
    assert made["one"].compensation is not None
    assert made["none"].compensation is None


# ---- what it buys ----

# The gain p at which PD+G with kd = 5/3 kp loses stability at waypoints 1 to 4, found by simulation to 0.5 %.
CONFIGURATIONS: dict[str, dict[str, Any]] = {
    "none": {},
    "predictor": PREDICTOR,
    "observer": OBSERVER,
    "both": {**PREDICTOR, **OBSERVER},
    "inertia": {"controller.schedule": "inertia"},
    "inertia, both": {"controller.schedule": "inertia", **PREDICTOR, **OBSERVER},
}
CRITICAL: dict[tuple[str, str], tuple[float, ...]] = {
    ("lwa4d_3dof_printed", "none"): (1.850, 2.230, 1.300, 0.904),
    ("lwa4d_3dof_printed", "predictor"): (3.190, 3.845, 2.230, 1.575),
    ("lwa4d_3dof_printed", "observer"): (3.308, 3.946, 2.288, 1.633),
    ("lwa4d_3dof_printed", "both"): (6.631, 7.952, 4.587, 3.274),
    ("lwa4d_3dof", "none"): (2.646, 3.044, 2.084, 1.685),
    ("lwa4d_3dof", "both"): (9.487, 10.857, 7.433, 6.071),
    ("lwa4d_3dof", "inertia"): (33.14, 33.48, 33.66, 33.14),
    ("lwa4d_3dof", "inertia, both"): (120.0, 120.0, 120.0, 120.0),
}


@pytest.mark.parametrize(("arm", "blocks"), list(CRITICAL))
def test_critical_gains(arm: str, blocks: str) -> None:
    for waypoint, expected in enumerate(CRITICAL[arm, blocks]):
        narrow = {"low": 0.97 * expected, "high": 1.03 * expected, "rounds": 1, "width": 3}
        found = critical_gain(arm, waypoint, CONFIGURATIONS[blocks], **narrow)  # type: ignore[arg-type]
        assert found == pytest.approx(expected, rel=0.02), waypoint


def test_the_critical_gains_are_ordered() -> None:
    """Each block wins gain back, both together more; scheduled gains are alike at all poses."""
    for arm in ("lwa4d_3dof_printed", "lwa4d_3dof"):
        none, both = CRITICAL[arm, "none"], CRITICAL[arm, "both"]
        assert all(b > 3.4 * a for a, b in zip(none, both, strict=True))
    for a, b in itertools.pairwise(CRITICAL["lwa4d_3dof", "inertia"]):
        assert a == pytest.approx(b, rel=0.02)
