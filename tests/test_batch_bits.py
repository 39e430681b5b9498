"""A run is the same bits alone, as any member of any batch, and on any number of threads."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.record import RunLog
from lwa4d_sim.runner import run, run_batch
from lwa4d_sim.scenario import Scenario

SIZE = 64
ALONE = (0, 1, 17, 63)  # members that are also run by themselves
ARMS: dict[str, tuple[list[float], float]] = {
    "lwa4d_3dof": ([-1.5, -1.2, 1.5], 0.1),
    "lwa4d_7dof": ([-1.5, 0.3, 0.2, 1.5, 0.1, 0.4, 0.2], 0.1),
}
LAWS: dict[str, dict[str, Any]] = {
    "pd_joint": {"kind": "pd_gravity", "space": "joint", "kp": 20.0, "kd": 5.0},
    "pd_task": {"kind": "pd_gravity", "space": "task", "kp": 60.0, "kd": 20.0, "posture": {"kp": 5.0, "kd": 2.0}},
    "ct_joint": {"kind": "computed_torque", "space": "joint", "kp": 100.0, "kd": 20.0},
    "ct_task": {"kind": "computed_torque", "space": "task", "kp": 100.0, "kd": 20.0, "posture": {"kp": 9.0, "kd": 6.0}},
    "closed_form_task": {
        "kind": "computed_torque", "space": "task", "kp": 100.0, "kd": 20.0, "model": {"dynamics": "closed_form"}
    },
}  # fmt: skip
# latencies long enough to overtake each other and to leave some arms without a first command for several periods
ROUGH: dict[str, Any] = {
    "latency": {
        "measurement": {"kind": "uniform", "low": 0.0, "high": 0.012},
        "command": {"kind": "exponential", "minimum": 0.001, "tail": 0.004},
    },
    "jitter": 0.002,
    "loss": {"probability": 0.25, "mean_burst": 2.0},
    "per_joint": True,
}


def scenario(arm: str, law: dict[str, Any], loop: dict[str, Any], plant: dict[str, Any] | None = None) -> Scenario:
    q0, reach = ARMS[arm]
    document = {
        "name": "bits",
        "arm": arm,
        "initial": {"q": q0},
        "plant": {"timestep": 0.001, **(plant or {})},
        "trajectory": {
            "waypoints": {"space": "joint", "points": [[angle + reach for angle in q0]]},
            "segment_time": 0.1,
            "profile": "quintic",
            "follow": "joint",
        },
        "controller": law,
        "loop": loop,
    }
    return Scenario.parse(json.dumps(document))


def members(arm: str, size: int = SIZE) -> list[dict[str, Any]]:
    rng = np.random.default_rng(11)
    q0 = np.array(ARMS[arm][0])
    return [
        {
            "plant.seed": k,
            "plant.payload": {"mass": 0.4 * (1 + k % 8)},
            "controller.kp": float(rng.uniform(5.0, 120.0)),
            "initial.q": (q0 + rng.uniform(-0.1, 0.1, len(q0))).tolist(),
        }
        for k in range(size)
    ]


def check_same(a: RunLog, b: RunLog) -> None:
    for name in ("q", "dq", "tau", "t"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    for name in ("t", "q", "dq", "tau", "age", "q_true", "dq_true", "q_ref"):
        np.testing.assert_array_equal(getattr(a.ticks, name), getattr(b.ticks, name), err_msg=f"ticks.{name}")
    assert a.events == b.events
    assert a.diverged_at == b.diverged_at


def check(made: Scenario, changes: Sequence[dict[str, Any]], alone: Sequence[int] = ALONE) -> list[RunLog]:
    logs = list(run_batch(made, changes, threads=2))
    for k in alone:
        single = Scenario.parse(made.text, overrides=changes[k])
        check_same(run(single), logs[k])
    assert len({log.q.tobytes() for log in logs}) == len(logs)  # the members do differ
    return logs


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("arm", ARMS)
def test_every_law_on_a_rough_link(arm: str, law: str) -> None:
    if law == "closed_form_task" and arm != "lwa4d_3dof":
        pytest.skip("the closed form describes the 3-DOF arm")
    logs = check(scenario(arm, LAWS[law], ROUGH), members(arm))
    assert len({log.events for log in logs}) > 1  # the brakes were released at different instants
    assert np.nanmax([log.ticks.age for log in logs]) > 0.012


@pytest.mark.parametrize(
    "velocity",
    [
        {"kind": "filtered_derivative", "runs_on": "held"},
        {"kind": "backward_difference"},
        {"kind": "tustin"},
        {"kind": "kalman"},
        {"kind": "true"},
    ],
    ids=str,
)
@pytest.mark.parametrize("per_joint", [False, True])
def test_every_estimator_on_a_rough_link(velocity: dict[str, Any], per_joint: bool) -> None:
    loop = {**ROUGH, "velocity": velocity, "per_joint": per_joint}
    check(scenario("lwa4d_3dof", LAWS["ct_joint"], loop), members("lwa4d_3dof", 8), alone=(0, 1, 7))


@pytest.mark.parametrize("policy", ["zero", "ramp", "stop"])
def test_every_late_data_policy(policy: str) -> None:
    loop = {**ROUGH, "loss": 0.5, "actuation": "next_sync", "late_data": {"policy": policy, "timeout": 0.012}}
    logs = check(scenario("lwa4d_3dof", LAWS["pd_joint"], loop), members("lwa4d_3dof", 16), alone=(0, 1, 7))
    if policy == "stop":
        assert any(log.events[-1][1] == "brakes closed" for log in logs)


def test_friction_and_limits_whose_solver_remembers() -> None:
    """Coulomb friction and joint limits are found by iteration from the last solution: stretches must not show."""
    plant = {"friction": "lwa4d", "armature": "lwa4d"}
    made = scenario("lwa4d_7dof", LAWS["pd_joint"], {**ROUGH, "late_data": {"policy": "stop", "timeout": 0.03}}, plant)
    check(made, members("lwa4d_7dof", 16), alone=(0, 1, 7))


@pytest.mark.parametrize("arm", ARMS)
def test_any_number_of_threads(arm: str) -> None:
    made, changes = scenario(arm, LAWS["ct_task"], ROUGH), members(arm, 16)
    one = list(run_batch(made, changes, threads=1))
    for threads in (0, 2, 3, 16):
        for a, b in zip(one, run_batch(made, changes, threads=threads), strict=True):
            check_same(a, b)


def test_the_ideal_loop_too() -> None:
    check(scenario("lwa4d_7dof", LAWS["ct_task"], {"kind": "ideal"}), members("lwa4d_7dof", 8), alone=(0, 7))


def test_pieces_of_a_long_batch_and_the_order_of_its_members() -> None:
    made = scenario("lwa4d_3dof", LAWS["pd_joint"], ROUGH)
    changes = members("lwa4d_3dof", 70)  # more than are stepped at a time
    logs = list(run_batch(made, changes))
    for log, other in zip(reversed(logs), run_batch(made, changes[::-1]), strict=True):
        check_same(log, other)


def test_same_seed_same_bits_other_seed_other_bits() -> None:
    made = scenario("lwa4d_3dof", LAWS["pd_joint"], ROUGH, {"seed": 5})
    check_same(run(made), run(made))
    other = Scenario.parse(made.text, overrides={"plant.seed": 6})
    assert not np.array_equal(run(made).q, run(other).q)


TRANSPORTS: list[dict[str, Any]] = [
    {"latency": 0.0},
    {"latency": 0.0035},
    {"latency": 0.012},
    {"latency": 0.0007},
]
MIXED: list[dict[str, Any]] = [
    *TRANSPORTS,
    {"latency": [0.001, 0.009, 0.0]},
    {"latency": 0.002, "jitter": 0.004},
    {"latency": {"kind": "exponential", "minimum": 0.001, "tail": 0.004}, "loss": 0.3},
    {"latency": {"kind": "trace", "values": [0.001, 0.015, 0.0]}, "loss": {"probability": 0.2, "mean_burst": 3.0}},
    {"latency": {"kind": "uniform", "high": 0.02}, "per_joint": True, "loss": 0.1},
    {"latency": {"kind": "normal", "mean": 0.004, "std": 0.002}, "per_joint": True},
    {"position_resolution": 1e-4, "torque_resolution": 0.05},
    {"position_resolution": [1e-3, 0.0, 1e-4]},
]


def transported(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    base = members("lwa4d_3dof", len(rows))
    return [
        {**one, **{f"loop.{key}": value for key, value in row.items()}} for one, row in zip(base, rows, strict=True)
    ]


@pytest.mark.parametrize("actuation", ["immediate", "next_sync"])
@pytest.mark.parametrize("phase", [None, 0.004])
def test_members_of_one_batch_may_differ_in_constant_latency(actuation: str, phase: float | None) -> None:
    loop = {"actuation": actuation, "phase": phase, "late_data": {"policy": "ramp", "timeout": 0.011}}
    made = scenario("lwa4d_3dof", LAWS["pd_joint"], loop)
    check(made, transported(TRANSPORTS * 2), alone=range(8))


@pytest.mark.parametrize("velocity", ["filtered_derivative", "backward_difference", "kalman"])
def test_members_of_one_batch_may_differ_in_measurement_latency(velocity: str) -> None:
    loop = {"phase": 0.002, "velocity": {"kind": velocity}}
    rows = [{"latency": {"measurement": up, "command": down}} for up in (0.0, 0.0015, 0.013) for down in (0.0, 0.004)]
    check(scenario("lwa4d_3dof", LAWS["ct_joint"], loop), transported(rows), alone=range(6))


def test_members_of_one_batch_may_differ_in_laws_loss_and_resolutions() -> None:
    made = scenario("lwa4d_3dof", LAWS["pd_joint"], {"late_data": {"policy": "zero", "timeout": 0.015}})
    check(made, transported(MIXED), alone=range(len(MIXED)))


def test_members_with_another_phase_or_period_are_refused() -> None:
    made = scenario("lwa4d_3dof", LAWS["pd_joint"], {})
    with pytest.raises(ScenarioError, match=r"member 1 of the batch differs in 'loop\.phase'"):
        list(run_batch(made, [{}, {"loop.latency": {"measurement": 0.003}}]))
    with pytest.raises(ScenarioError, match="member 1 of the batch differs in 'loop'"):
        list(run_batch(made, [{}, {"loop.period": 0.005}]))
    list(run_batch(made, [{}, {"loop.latency": {"measurement": 0.01}}]))  # a whole period later: the same phase
