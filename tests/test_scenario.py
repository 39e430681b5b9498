"""Scenarios: what a file may say, what is said about a file that is wrong, and how overrides and variants merge."""

import copy
import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lwa4d_sim.controllers import ComputedTorque, CustomController, PdGravity
from lwa4d_sim.delays import UniformLatency
from lwa4d_sim.errors import ModelError, ReachError, ScenarioError
from lwa4d_sim.estimators import TrueVelocity
from lwa4d_sim.metrics import METRICS
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.schema import json_schema
from lwa4d_sim.settings import IdealLoop, Latencies, SampledLoop, Settings
from lwa4d_sim.trajectories import WaypointMotion

ROOT = Path(__file__).parent.parent
PAGE = ROOT / "docs" / "scenario.md"

SMALL = """\
name: small
arm: lwa4d_3dof
trajectory:
  waypoints: {space: joint, points: [[0, -1, 1]]}
  segment_time: 1.0
controller:
  kind: pd_gravity
  kp: 2.0
  kd: 3.0
"""

FULL: dict[str, Any] = {
    "name": "full",
    "arm": "lwa4d_3dof",
    "initial": {"q": [0.0, -1.0, 1.0]},
    "plant": {
        "timestep": 0.001,
        "integrator": "RK4",
        "payload": {"mass": 1.0, "com": [0.0, 0.0, 0.1], "radius": 0.05},
        "mass_scale": [1.0, 1.1, 0.9],
        "armature": 0.1,
        "friction": {"viscous": [1.0, 1.0, 1.0], "coulomb": 0.5},
        "gravity": [0.0, 0.0, -9.81],
        "disturbances": [{"at": 0.5, "duration": 0.1, "force": [1.0, 0.0, 0.0], "body": "link4"}],
        "seed": 7,
    },
    "trajectory": {
        "kind": "waypoints",
        "waypoints": {"space": "joint", "points": [[0, -1, 1], [0.5, -1, 1]]},
        "segment_time": [1.0, 2.0],
        "profile": "quintic",
        "follow": "joint",
        "elbow": "up",
        "boundary": {"velocity": [[0, 0, 0], [0, 0, 0], [0, 0, 0]]},
    },
    "controller": {
        "kind": "computed_torque",
        "space": "joint",
        "p": 10.0,
        "posture": {"kp": 1.0, "kd": 1.0},
        "model": {"payload": {"mass": 0.5}, "dynamics": "mujoco"},
    },
    "loop": {
        "kind": "sampled",
        "period": 0.01,
        "actuation": "next_sync",
        "velocity": {"kind": "filtered_derivative", "time_constant": 0.01, "runs_on": "held"},
        "latency": {"measurement": 0.001, "command": {"kind": "uniform", "low": 0.0, "high": 0.002}},
        "jitter": {"measurement": 0.0, "command": 0.001},
        "loss": {"measurement": 0.01, "command": {"probability": 0.1, "mean_burst": 3.0}},
        "per_joint": True,
        "phase": 0.002,
        "position_resolution": 1.75e-5,
        "torque_resolution": [0.1, 0.1, 0.1],
        "late_data": {"policy": "ramp", "timeout": 0.05, "ramp_time": 0.2},
    },
    "variants": {"ideal": {"loop": {"kind": "ideal"}}, "can": {}, "slow": {"loop": {"period": 0.02}}},
    "expect": {"ideal": {"stable": True}, "can": {"final_error_max": [0.01, None], "rms_error_min": 0.0}},
}


def load(text: str = SMALL, **overrides: Any) -> Scenario:
    return Scenario.parse(text, source="f.yaml", overrides={key.replace("__", "."): v for key, v in overrides.items()})


def settings_of(text: str = SMALL, **overrides: Any) -> Settings:
    return next(iter(load(text, **overrides).variants.values()))


def refusal(text: str = SMALL, overrides: dict[str, Any] | None = None) -> str:
    with pytest.raises(ScenarioError) as error:
        Scenario.parse(text, source="f.yaml", overrides=overrides)
    message = str(error.value)
    assert message.startswith("f.yaml")
    assert message.isprintable()
    return message


# ---- what is valid ----


def test_what_is_left_out_has_the_documented_default() -> None:
    made = settings_of()
    assert made.loop == SampledLoop(kind="sampled", period=0.01)
    assert made.plant.timestep == 0.001
    assert made.plant.integrator == "RK4"
    assert made.initial.q is None
    assert isinstance(made.trajectory, WaypointMotion)
    assert made.trajectory.profile == "quintic"
    assert made.controller == PdGravity(kp=2.0, kd=3.0)
    assert list(load().variants) == ["default"]


def test_every_key_reaches_its_parameter_class() -> None:
    made = Scenario.parse(yaml.safe_dump(FULL), source="f.yaml").variants["can"]
    loop = made.loop
    assert isinstance(loop, SampledLoop)
    assert isinstance(loop.latency, Latencies)
    assert loop.latency.command == UniformLatency(high=0.002)
    assert made.plant.disturbances[0].force == (1.0, 0.0, 0.0)
    assert isinstance(made.controller, ComputedTorque)
    assert made.controller.model.payload is not None
    assert made.controller.model.payload.mass == 0.5
    assert made.plant.mass_scale == (1.0, 1.1, 0.9)


def test_a_file_is_read_and_its_folder_remembered(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_text(SMALL)
    scenario = Scenario.load(path, {"controller.kp": 5})
    assert (scenario.name, scenario.source, scenario.folder) == ("small", str(path), tmp_path)
    assert scenario.text == SMALL
    assert scenario.overrides == {"controller.kp": 5}
    assert scenario.document["controller"]["kp"] == 5


@pytest.mark.parametrize("value", [np.float64(2.5), np.array([1.0, 2.0, 3.0]), (1, 2, 3), np.int64(4)])
def test_overrides_may_be_numpy_values(value: Any) -> None:
    controller = settings_of(controller__kp=value).controller
    assert isinstance(controller, PdGravity)
    np.testing.assert_array_equal(controller.kp, value)


def test_a_users_own_controller_takes_any_other_key_as_an_option() -> None:
    text = SMALL.replace("kind: pd_gravity", "kind: my.module:Law\n  space: task\n  options: {a: 1}")
    controller = settings_of(text).controller
    assert isinstance(controller, CustomController)
    assert controller.space == "task"
    assert controller.options == {"kp": 2.0, "kd": 3.0, "options": {"a": 1}}


def test_the_json_schema_describes_every_block() -> None:
    text = json.dumps(json_schema())
    for word in ("pd_gravity", "computed_torque", "filtered_derivative", "segment_time", "late_data"):
        assert word in text


# ---- variants and overrides ----


def test_variants_are_laid_over_the_file() -> None:
    scenario = Scenario.parse(yaml.safe_dump(FULL, sort_keys=False), source="f.yaml")
    assert list(scenario.variants) == ["ideal", "can", "slow"]
    can, slow = scenario.variants["can"].loop, scenario.variants["slow"].loop
    assert scenario.variants["ideal"].loop == IdealLoop()
    assert isinstance(can, SampledLoop)
    assert isinstance(slow, SampledLoop)
    assert slow == dataclasses.replace(can, period=0.02)


def test_a_kind_that_was_left_out_still_tells_blocks_apart() -> None:
    text = SMALL + "loop: {period: 0.02}\nvariants:\n  ideal: {loop: {kind: ideal}}\n  late: {loop: {latency: 0.001}}\n"
    variants = load(text).variants
    assert variants["ideal"].loop == IdealLoop()
    assert variants["late"].loop == SampledLoop(period=0.02, latency=0.001)


def test_kind_true_is_a_kind_though_yaml_takes_it_for_a_boolean() -> None:
    loop = settings_of(SMALL + "loop: {velocity: {kind: true}}").loop
    assert isinstance(loop, SampledLoop)
    assert loop.velocity == TrueVelocity()
    assert "must be one of filtered_derivative" in refusal(SMALL + "loop: {velocity: {kind: false}}")


def test_an_override_changes_the_file_for_all_variants_and_one_below_variants_only_that_one() -> None:
    text = SMALL + "variants: {a: {}, b: {controller: {kp: 7}}}\n"
    kp = [getattr(s.controller, "kp", None) for s in load(text, controller__kp=5).variants.values()]
    assert kp == [5, 7]
    periods = [getattr(s.loop, "period", 0) for s in load(text, variants__a__loop__period=0.02).variants.values()]
    assert periods == [0.02, 0.01]


def test_an_empty_variant_may_be_written_as_null_or_as_a_mapping() -> None:
    assert load(SMALL + "variants: {ideal: null, can: {}}\n").variants.keys() == {"ideal", "can"}
    assert load(SMALL + "variants:\nexpect:\n").variants.keys() == {"default"}


def test_an_override_may_add_a_variant_and_a_block() -> None:
    scenario = load(variants__fast__loop__period=0.005, plant__payload={"mass": 2})
    assert list(scenario.variants) == ["fast"]
    assert scenario.variants["fast"].plant.payload is not None


def test_without_variants_expectations_belong_to_default() -> None:
    assert load(SMALL + "expect: {default: {stable: true}}").expect == {"default": {"stable": True}}


# ---- what is wrong, and what is said about it ----

POSITIVE = "must be a number above 0"
GAIN = "must be a number of at least 0, or a list of one or more numbers of at least 0"


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (("kp: 2.0", "kp: -2.0"), f"f.yaml:8: controller.kp (=-2.0): {GAIN}"),
        (("kp: 2.0", "kp: much"), f"f.yaml:8: controller.kp (='much'): {GAIN}"),
        (("kp: 2.0", "kp: true"), f"f.yaml:8: controller.kp (=true): {GAIN}"),
        (("kp: 2.0", "kp:"), f"f.yaml:8: controller.kp (=null): {GAIN}"),
        (("kp: 2.0", "kp: []"), f"f.yaml:8: controller.kp (=[]): {GAIN}"),
        (("kp: 2.0", "kp: {a: 1}"), f"f.yaml:8: controller.kp (a mapping): {GAIN}"),
        (("kp: 2.0", "kp: [1, x, 2]"), "f.yaml:8: controller.kp.1 (='x'): must be a number of at least 0"),
        (("kp: 2.0", "kp: [1,\n  -1]"), "f.yaml:9: controller.kp.1 (=-1): must be a number of at least 0"),
        (("kp: 2.0", "kp: 1e9"), "f.yaml:8: controller.kp (=1000000000.0): must lie within -1e+08 and 1e+08"),
        (("kp: 2.0", "kp: .nan"), "f.yaml:8: controller.kp (=.nan): must be a finite number"),
        (("  kp: 2.0\n", ""), f"f.yaml:6: controller.kp: is missing; it {GAIN}"),
        (
            ("kp: 2.0", "Kp: 2.0"),
            "f.yaml:8: controller.Kp (=2.0): unknown key; did you mean 'kp'? "
            "valid here: kind, space, kp, kd, posture, model",
        ),
        (
            ("kind: pd_gravity", "kind: pid"),
            "f.yaml:7: controller.kind (='pid'): must be one of pd_gravity, computed_torque, package.module:Class",
        ),
        (
            ("  kind: pd_gravity\n", ""),
            "f.yaml:6: controller.kind: is missing; give one of pd_gravity, computed_torque, package.module:Class",
        ),
        (("kind: pd_gravity", "kind: 3"), "f.yaml:7: controller.kind (=3): must be one of pd_gravity, "),
        (("kind: pd_gravity", "kind:"), "f.yaml:7: controller.kind (=null): must be one of pd_gravity, "),
        (("segment_time: 1.0", "segment_time: 0"), f"f.yaml:5: trajectory.segment_time (=0): {POSITIVE}, or a list of"),
        (
            ("segment_time: 1.0", "segment_time: 1e-300"),
            "f.yaml:5: trajectory.segment_time (=1e-300): must be at least",
        ),
        (("segment_time: 1.0", "segment_time: 1e12"), "f.yaml:5: trajectory.segment_time (=1000000000000.0): must lie"),
        (
            ("points: [[0, -1, 1]]", "points: 3"),
            "f.yaml:4: trajectory.waypoints.points (=3): must be a list of one or more lists of one or more numbers",
        ),
        (("points: [[0, -1, 1]]", "points: [[]]"), "f.yaml:4: trajectory.waypoints.points.0 (=[]): must be a list of"),
        (("[[0, -1, 1]]", "[[0, [1], 1]]"), "f.yaml:4: trajectory.waypoints.points.0.1 (=[1]): must be a number"),
        (("space: joint", "space: cartesian"), "f.yaml:4: trajectory.waypoints.space (='cartesian'): must be one of"),
        (("arm: lwa4d_3dof", "arm: 3"), "f.yaml:2: arm (=3): must be text"),
        (("arm: lwa4d_3dof\n", ""), "f.yaml: arm: is missing; it must be text"),
        (("name: small\n", ""), "f.yaml: name: must be text that can name a file"),
        (("name: small", "name: a/b"), "f.yaml:1: name (='a/b'): must be text that can name a file"),
        (("arm: lwa4d_3dof", "arms: lwa4d_3dof"), "f.yaml:2: arms (='lwa4d_3dof'): unknown key; did you mean 'arm'?"),
    ],
)
def test_an_error_names_file_line_key_value_and_rule(edit: tuple[str, str], message: str) -> None:
    assert SMALL.count(edit[0]) == 1
    assert refusal(SMALL.replace(*edit)).startswith(message)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("loop: 3", "f.yaml:10: loop (=3): must be a mapping of kind sampled or ideal"),
        ("loop: [1]", "f.yaml:10: loop (=[1]): must be a mapping of kind sampled or ideal"),
        ("loop:", "f.yaml:10: loop (=null): must be a mapping of kind sampled or ideal"),
        ("initial: x", "f.yaml:10: initial (='x'): must be a mapping (keys: q)"),
        ("initial: {q: 1}", "f.yaml:10: initial.q (=1): must be a list of numbers"),
        ("plant: {seed: 1.5}", "f.yaml:10: plant.seed (=1.5): must be a whole number of at least 0 and below"),
        ("plant: {seed: -1}", "f.yaml:10: plant.seed (=-1): must be a whole number of at least 0 and below"),
        ("plant: {seed: true}", "f.yaml:10: plant.seed (=true): must be a whole number"),
        ("plant: {gravity: [0, 0]}", "f.yaml:10: plant.gravity (=[0, 0]): must be a list of 3 numbers"),
        ("plant: {gravity: [0, 0, 0, 0]}", "f.yaml:10: plant.gravity (=[0, 0, 0, 0]): must be a list of 3 numbers"),
        ("plant: {payload: {mass: -1}}", "f.yaml:10: plant.payload.mass (=-1): must be a number of at least 0"),
        ("plant: {payload: {}}", "f.yaml:10: plant.payload.mass: is missing; it must be a number of at least 0"),
        (
            "plant: {friction: 3}",
            "f.yaml:10: plant.friction (=3): must be 'lwa4d', or a mapping (keys: viscous, coulomb)",
        ),
        (
            "plant: {armature: -1}",
            "f.yaml:10: plant.armature (=-1): must be a number of at least 0, or a list of numbers of at least 0, "
            "or 'lwa4d'",
        ),
        ("plant: {disturbances: {at: 1}}", "f.yaml:10: plant.disturbances (a mapping): must be a list of mappings"),
        ("plant: {disturbances: [{}]}", "f.yaml:10: plant.disturbances.0.at: is missing"),
        (
            "plant:\n  disturbances:\n  - 3",
            "f.yaml:12: plant.disturbances.0 (=3): must be a mapping (keys: at, duration,",
        ),
        ("plant: {integrator: rk4}", "f.yaml:10: plant.integrator (='rk4'): must be one of RK4, Euler, implicit,"),
        ("loop: {period: 0}", f"f.yaml:10: loop.period (=0): {POSITIVE}"),
        ("loop: {per_joint: 1}", "f.yaml:10: loop.per_joint (=1): must be true or false"),
        ("loop: {loss: 1}", "f.yaml:10: loop.loss (=1): must be a number of at least 0 and below 1, or a mapping"),
        ("loop: {loss: {probability: 2}}", "f.yaml:10: loop.loss.probability (=2): must be a number of at least 0 and"),
        (
            "loop: {loss: {probability: 0.9, mean_burst: 1}}",
            "f.yaml:10: loop.loss (a mapping): mean_burst (=1.0) is too short for probability (=0.9)",
        ),
        (
            "loop: {latency: {kind: uniform, low: 2, high: 1}}",
            "f.yaml:10: loop.latency (a mapping): high (=1.0) must not be below low (=2.0)",
        ),
        ("loop: {latency: {kind: uniform}}", "f.yaml:10: loop.latency.high: is missing; it must be a number of at"),
        ("loop: {latency: {kind: gauss}}", "f.yaml:10: loop.latency.kind (='gauss'): must be one of uniform, normal, "),
        (
            "loop: {latency: {measurment: 1}}",
            "f.yaml:10: loop.latency.measurment (=1): unknown key; did you mean 'meas",
        ),
        ("loop: {latency: {command: {}}}", "f.yaml:10: loop.latency.command.kind: is missing; give one of uniform, "),
        ("loop: {velocity: {}}", "f.yaml:10: loop.velocity.kind: is missing; give one of filtered_derivative, true, "),
        (
            "loop: {velocity: {kind: tustin, runs_on: held}}",
            "f.yaml:10: loop.velocity.runs_on (='held'): unknown key; valid here: kind, time_constant",
        ),
        ("loop: {kind: ideal, period: 0.01}", "f.yaml:10: loop.period (=0.01): unknown key; valid here: kind"),
        ("controler: 1", "f.yaml:10: controler (=1): unknown key; did you mean 'controller'?"),
        ("variants: 3", "f.yaml:10: variants (=3): must be a mapping of variant names"),
        ("variants: [a]", 'f.yaml:10: variants (=["a"]): must be a mapping of variant names'),
        ("variants: {a: 3}", "f.yaml:10: variants.a (=3): must be a mapping of overrides, or {}"),
        ("variants: {a/b: {}}", "f.yaml:10: variants.a/b (a mapping): a variant's name must be text that can name a"),
        ('variants: {"a\\nb": {}}', "f.yaml:10: variants.a\\nb (a mapping): a variant's name must be text"),
        ("variants: {'': {}}", "f.yaml:10: variants. (a mapping): a variant's name must be text"),
        ("variants: {a: {name: b}}", "f.yaml:10: variants.a.name (='b'): unknown key; valid here: arm, initial, plant"),
        ("variants: {a: {variants: {}}}", "f.yaml:10: variants.a.variants (a mapping): unknown key; valid here: arm, "),
        ("variants: {a: {controller: 3}}", "f.yaml:10: controller of variant 'a' (=3): must be a mapping of kind"),
        ("expect: 3", "f.yaml:10: expect (=3): must be a mapping of variant names"),
        ("expect: {b: {}}", "f.yaml:10: expect.b (a mapping): no such variant; this scenario has default"),
        ("expect: {default: 3}", "f.yaml:10: expect.default (=3): must be a mapping of expectations"),
        ("expect: {default: {stable: 1}}", "f.yaml:10: expect.default.stable (=1): must be true or false"),
        ("expect: {default: {final_error: 1}}", "f.yaml:10: expect.default.final_error (=1): unknown expectation; did"),
        (
            "expect: {default: {rms_error_max: x}}",
            "f.yaml:10: expect.default.rms_error_max (='x'): must be a number, or",
        ),
        ("1: 2", "f.yaml:10: the key '1' must be plain text"),
        ("<<: {a: 1}", "f.yaml:10: << (a mapping): unknown key"),
        ('"a\\nb": 1', "f.yaml:10: a\\nb (=1): unknown key"),
    ],
)
def test_a_wrong_line_is_named(text: str, message: str) -> None:
    found = refusal(SMALL + text)
    assert found.startswith(message), found


@pytest.mark.parametrize("text", ["", "# nothing", "3", "[1, 2]", "text", "null", "---\n"])
def test_a_file_that_is_no_mapping_is_refused(text: str) -> None:
    assert refusal(text).startswith("f.yaml: must be a mapping with the keys name, arm, initial, plant, trajectory, ")


@pytest.mark.parametrize(
    "name",
    [
        "",
        " ",
        ".",
        "..",
        ".hidden",
        "a/b",
        "a\\b",
        "a:b",
        "a\tb",
        "a\nb",
        "a ",
        " a",
        "x" * 201,
        "é" * 101,
        "\u202e",
        1,
        None,
        True,
        1.5,
        [],
        {},
        ["a"],
    ],
)
def test_a_name_must_be_able_to_name_a_folder(name: Any) -> None:
    assert "must be text that can name a file" in refusal(overrides={"name": name})


@pytest.mark.parametrize("name", ["ü", "pd_joint_p2.5", "-x", "x" * 200, "漢字", "a b"])
def test_other_names_are_fine(name: str) -> None:
    assert load(name=name).name == name


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"controller.kp": -1}, f"f.yaml: controller.kp (=-1, overridden): {GAIN}"),
        ({"controller.kpp": 1}, "f.yaml: controller.kpp (=1, overridden): unknown key; did you mean 'kp'?"),
        ({"controller.kp": float("nan")}, "f.yaml: controller.kp: must be a finite number"),
        ({"controller.kp": object()}, "f.yaml: controller.kp: a object cannot stand in a scenario"),
        ({"controller": 3}, "f.yaml: controller (=3, overridden): must be a mapping of kind"),
        ({"controller": {"kp": -1}}, f"f.yaml: controller.kp (=-1, overridden): {GAIN}"),
        ({"controller.kp.x": 3}, "f.yaml: controller.kp.x: 'x' cannot be set inside the value 2.0"),
        ({"trajectory.waypoints.points.1": [0, 0, 0]}, "f.yaml: trajectory.waypoints.points.1: '1' must be a position"),
        (
            {"trajectory.waypoints.points.0.1": "x"},
            "f.yaml: trajectory.waypoints.points.0.1 (='x', overridden): must be",
        ),
        ({"": 1}, "f.yaml:  (=1, overridden): unknown key"),
        ({".": 1}, "f.yaml:  (a mapping): unknown key"),
        ({"a..b": 1}, "f.yaml: a (a mapping): unknown key"),
        ({"a\nb": 1}, "f.yaml: a\\nb (=1, overridden): unknown key"),
        ({".".join(1000 * "a"): 1}, "f.yaml: 'a.a.a"),
        ({"variants": {"a": None, "b": 3}}, "f.yaml: variants.b (=3, overridden): must be a mapping of overrides"),
        ({"loop.period": 0, "loop.kind": "sampled"}, f"f.yaml: loop.period (=0, overridden): {POSITIVE}"),
        ({"variants.can.loop.period": -1}, f"f.yaml: loop.period of variant 'can' (=-1, overridden): {POSITIVE}"),
    ],
)
def test_an_override_is_checked_like_the_file(overrides: dict[str, Any], message: str) -> None:
    found = refusal(overrides=overrides)
    assert found.startswith(message), found


def test_a_variants_error_points_to_the_line_the_value_comes_from() -> None:
    text = SMALL + "loop:\n  period: 0.01\nvariants:\n  a: {}\n  b:\n    loop:\n      period: x\n"
    assert refusal(text).startswith("f.yaml:16: loop.period of variant 'b' (='x'): must be")
    base = text.replace("0.01", "y").replace("period: x", "phase: 0.0")
    assert refusal(base).startswith("f.yaml:11: loop.period of variant 'a' (='y'): must be")


def test_an_error_of_a_block_is_placed_in_the_file_and_keeps_its_class() -> None:
    scenario = load(SMALL + "variants: {can: {}}\n", controller__kd=4.0)
    reach = scenario.locate(ReachError("too\nfar"), "trajectory", "can")
    assert type(reach) is ReachError
    assert str(reach) == "f.yaml:3: trajectory of variant 'can': too\\nfar"
    assert str(scenario.locate(ModelError("no motors"), "arm", None)) == "f.yaml:2: arm (='lwa4d_3dof'): no motors"
    known = scenario.locate(ScenarioError("wrong", key="controller.kd"), "controller", None)
    assert str(known) == "f.yaml: controller.kd (=4.0, overridden): wrong"


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda path: None, "No such file or directory"),
        (lambda path: path.mkdir(), "Is a directory"),
        (lambda path: path.write_bytes(b"\xff\xfe\x00name"), "it is not a text file (UTF-8)"),
        (lambda path: path.symlink_to(path), "Too many levels of symbolic links"),
    ],
)
def test_a_file_that_cannot_be_read_says_why(make: Any, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    make(path)
    with pytest.raises(ScenarioError) as error:
        Scenario.load(path)
    assert str(error.value) == f"{path}: cannot read the scenario: {reason}"


def test_an_endless_file_is_given_up() -> None:
    with pytest.raises(ScenarioError, match="not valid YAML"):
        Scenario.load("/dev/zero")


def test_a_file_below_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "f").write_text(SMALL)
    with pytest.raises(ScenarioError, match="Not a directory"):
        Scenario.load(tmp_path / "f" / "x.yaml")


# ---- fuzz: it loads, or one line says what is wrong ----

FUZZ = settings(
    deadline=None,
    derandomize=True,
    max_examples=250,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)


def paths_in(node: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """The path of every value in a document."""
    items: Any = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from paths_in(value, (*path, key))


PATHS = list(paths_in(FULL))
WORDS = st.sampled_from([str(path[-1]) for path in PATHS] + ["kind", "ideal", "lwa4d", "tustin", "uniform", "a.b:C"])
VALUES: st.SearchStrategy[Any] = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.sampled_from([0, 1, -1, 10**400, 1e308, -1e-320, 2**63, float("inf"), float("nan")])
    | st.floats()
    | st.text(max_size=5)
    | WORDS,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(WORDS | st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)


def loads_or_refuses(text: str, overrides: dict[str, Any] | None = None) -> None:
    try:
        scenario = Scenario.parse(text, source="f.yaml", overrides=overrides)
    except ScenarioError as error:
        message = str(error)
    else:
        assert scenario.variants
        json.dumps(scenario.document, allow_nan=False)
        message = "f.yaml"
    assert message.startswith("f.yaml")
    assert message.isprintable(), message


def replaced(path: tuple[str | int, ...], change: Any) -> Any:
    """A copy of the full document with ``change(parent, key)`` done to one place."""
    document = copy.deepcopy(FULL)
    parent: Any = document
    for part in path[:-1]:
        parent = parent[part]
    change(parent, path[-1])
    return document


@FUZZ
@given(st.text(max_size=60))
def test_fuzz_any_text(text: str) -> None:
    loads_or_refuses(text)
    loads_or_refuses(SMALL + text)


@FUZZ
@given(st.sampled_from(PATHS), VALUES)
def test_fuzz_any_value_at_any_key(path: tuple[str | int, ...], value: Any) -> None:
    document = replaced(path, lambda parent, key: parent.__setitem__(key, value))
    loads_or_refuses(yaml.safe_dump(document, allow_unicode=True, sort_keys=False))


@FUZZ
@given(
    st.lists(st.tuples(st.sampled_from(PATHS), st.integers(0, 4), WORDS | st.text(max_size=4)), min_size=1, max_size=3)
)
def test_fuzz_mutations(changes: list[tuple[tuple[str | int, ...], int, str]]) -> None:
    document: Any = copy.deepcopy(FULL)
    for path, kind, word in changes:
        parent = document
        for part in path[:-1]:
            try:
                parent = parent[part]
            except (KeyError, IndexError, TypeError):
                break
        mutate(parent, path[-1], kind, word)
    loads_or_refuses(yaml.safe_dump(document, sort_keys=False, allow_unicode=True))


def mutate(parent: Any, key: Any, kind: int, word: str) -> None:
    """Delete, rename, retype, wrap or add, where the place still exists."""
    if isinstance(parent, dict) and key in parent:
        value = parent[key]
        if kind in (0, 1):
            del parent[key]
        if kind == 1:
            parent[word] = value
        if kind == 2:
            parent[key] = str(value)
        if kind == 3:
            parent[key] = [value]
        if kind == 4:
            parent[key] = {word: value}
    elif isinstance(parent, list):
        parent.append(word)


@FUZZ
@given(
    st.dictionaries(st.sampled_from([".".join(map(str, p)) for p in PATHS]) | st.text(max_size=8), VALUES, max_size=3)
)
def test_fuzz_overrides(overrides: dict[str, Any]) -> None:
    loads_or_refuses(SMALL, overrides)
    loads_or_refuses(yaml.safe_dump(FULL), overrides)


@FUZZ
@given(st.sampled_from([path for path in PATHS if path[0] not in ("variants", "expect")]))
def test_fuzz_leaving_out_a_key_names_it_or_does_no_harm(path: tuple[str | int, ...]) -> None:
    """What is missing is named by its path; nothing else is blamed."""
    document = replaced(path, lambda parent, key: parent.pop(key))
    try:
        Scenario.parse(yaml.safe_dump(document, sort_keys=False), source="f.yaml")
    except ScenarioError as error:
        message = str(error)
        assert any(str(part) in message for part in path)


# ---- the page ----


def parameter_classes() -> dict[Any, None]:
    """Every class a scenario is made of, found the way the schema finds them."""
    from lwa4d_sim.schema import _fields, _items, _members

    found: dict[Any, None] = {}
    waiting: list[Any] = [Settings]
    while waiting:
        member = waiting.pop(0)
        cls: Any = member
        if dataclasses.is_dataclass(member) and cls not in found:
            found[cls] = None
            for annotation in _fields(cls).values():
                waiting += _members(annotation)
        waiting += _items((member,), 0)
    return found


def test_the_page_has_a_row_for_every_field_of_every_class() -> None:
    sections = re.split(r"^#+ ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    classes = parameter_classes()
    assert len(classes) > 20
    for cls in classes:
        mine = [section for section in sections if f"<!-- {cls.__name__} -->" in section]
        assert mine, f"docs/scenario.md has no section marked <!-- {cls.__name__} -->"
        for field in dataclasses.fields(cls):
            row = re.compile(rf"^\| `{field.name}` \|", re.MULTILINE)
            assert any(row.search(section) for section in mine), f"docs/scenario.md lacks {cls.__name__}.{field.name}"


def test_the_page_names_no_key_that_does_not_exist() -> None:
    fields = {field.name for cls in parameter_classes() for field in dataclasses.fields(cls)}
    top = {"variants", "expect"}
    text = PAGE.read_text(encoding="utf-8")
    named = set(re.findall(r"^\| `([a-z_A-Z]+)` \|", text.split("## Expectations")[0], flags=re.MULTILINE))
    assert named <= fields | top


def test_the_page_names_every_metric_and_every_kind() -> None:
    text = PAGE.read_text(encoding="utf-8")
    for metric, (unit, _) in METRICS.items():
        assert f"| `{metric}` | {unit or '-'} |" in text, metric
    for choice in re.findall(r'"const": "([a-z_]+)"', json.dumps(json_schema())):
        assert f"`{choice}`" in text, choice


def test_the_defaults_on_the_page_are_those_of_the_classes() -> None:
    sections = re.split(r"^#+ ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    for cls in parameter_classes():
        for field in dataclasses.fields(cls):
            if field.name == "kind" or not isinstance(field.default, (int, float, str)):
                continue
            word = str(field.default).lower() if isinstance(field.default, bool) else f"{field.default}"
            rows = [
                row.split("|")[4].strip().strip("`")
                for section in sections
                if f"<!-- {cls.__name__} -->" in section
                for row in section.splitlines()
                if row.startswith(f"| `{field.name}` |")
            ]
            assert any(row == word or _number(row) == _number(word) != None for row in rows), (cls, field.name, rows)  # noqa: E711


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def test_the_examples_on_the_page_are_valid() -> None:
    blocks = re.findall(r"```yaml\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert len(blocks) >= 3
    for block in blocks:
        base = yaml.safe_load(SMALL)
        Scenario.parse(yaml.safe_dump({**base, **yaml.safe_load(block)}), source="docs/scenario.md")


def test_an_override_of_a_block_that_the_file_leaves_out_does_not_reach_a_variant_of_another_kind() -> None:
    document = yaml.safe_load(SMALL)
    text = json.dumps({**document, "variants": {"ideal": {"loop": {"kind": "ideal"}}, "can": {}}})
    made = Scenario.parse(text, overrides={"loop.latency": 0.002})
    assert made.variants["can"].loop == SampledLoop(latency=0.002)
    assert made.variants["ideal"].loop == IdealLoop()
