"""Tuned gains keep what was asked, are the best of their kind, and come back as a scenario that runs."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from test_cli import Result, refused
from test_cli import call as call  # a fixture

from lwa4d_sim.console import shipped_scenarios
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.stability.study import Study
from lwa4d_sim.stability.tracking import tracking
from lwa4d_sim.tuning import Wish, tune
from lwa4d_sim.yaml_text import dump, parse


def shipped(name: str, changes: dict[str, Any] | None = None) -> Scenario:
    return Scenario.load(shipped_scenarios() / f"{name}.yaml", changes)


def margins(scenario: Scenario, variant: str, overrides: Any) -> tuple[float, float]:
    """Smallest gain and delay margin over the waypoints, of a scenario that is built anew."""
    study = Study(scenario.changed(overrides, variant), variant)
    linear = study.linear(study.waypoints())
    return float(study.gain_margin(study.close(linear)).min()), float(study.delay_margin(linear).min())


@pytest.mark.parametrize(
    ("name", "variant", "wish"),
    [
        ("pd_joint_p2.5", "can", Wish()),
        ("pd_joint_p2.5", "can", Wish(gain_margin=1.5, delay_margin=0.02)),
        ("pd_joint_p1.25_next_sync", "next_sync", Wish(gain_margin=1.3)),
        ("pd_task_p40", "can", Wish(gain_margin=3.0)),
        ("ct_joint_T1.5", "can", Wish()),
        ("ct7_joint", "next_sync", Wish(delay_margin=0.01)),
        ("comp_pd_joint_p3", "next_sync", Wish()),
    ],
)
def test_one_gain_is_the_largest_that_keeps_the_margins(name: str, variant: str, wish: Wish) -> None:
    scenario = shipped(name)
    variant = variant if variant in scenario.variants else list(scenario.variants)[-1]
    found = tune(scenario, variant, wish)
    gain, delay = margins(scenario, variant, found.overrides)
    assert (gain, delay) == pytest.approx((found.gain_margin, found.delay_margin))
    assert gain >= wish.gain_margin * (1 - 1e-5)
    assert delay >= wish.delay_margin - 1e-6
    # one of the two is used up
    assert gain < wish.gain_margin * 1.001 or delay < wish.delay_margin + 1e-5


@pytest.mark.slow
def test_more_freedom_is_a_faster_loop() -> None:
    scenario = shipped("pd_joint_p2.5")
    bandwidths = []
    for gains in ("one", "two", "joints"):
        wish = Wish(gains=gains, delay_margin=0.005)
        found = tune(scenario, "can", wish)
        gain, delay = margins(scenario, "can", found.overrides)
        assert gain >= wish.gain_margin * (1 - 1e-5)
        assert delay >= wish.delay_margin - 1e-6
        assert gains == "one" or found.after.peak[0] <= wish.peak * (1 + 1e-6)
        bandwidths.append(float(found.after.bandwidth[0]))
    assert bandwidths[0] < bandwidths[1] < bandwidths[2]


@pytest.mark.slow
def test_the_least_error_is_less_and_keeps_the_margins() -> None:
    scenario = shipped("ct_joint_T1.5")
    found = tune(scenario, "can", Wish(gains="two", objective="error"))
    assert margins(scenario, "can", found.overrides)[0] >= 2.0 * (1 - 1e-5)
    one = tune(scenario, "can", Wish())
    errors = [_rms_error(scenario, each.overrides) for each in (found, one)]
    assert errors[0] < errors[1] < _rms_error(scenario, {})


def _rms_error(scenario: Scenario, overrides: Any) -> float:
    from lwa4d_sim.runner import run

    return float(run(scenario.changed(overrides, "can"), "can").metrics()["rms_error"])


def test_a_workspace_asks_for_less_than_its_best_pose() -> None:
    scenario = shipped("pd_joint_p2.5")
    narrow, wide = (tune(scenario, "can", Wish(workspace=workspace)) for workspace in (False, True))
    assert wide.overrides["controller.kp"] < narrow.overrides["controller.kp"]


@pytest.mark.parametrize("p", [3.0, 10.0, 25.0])
def test_bandwidth_in_closed_form(p: float) -> None:
    """Computed torque without a bus is (p / (s + p))^2 in every joint: -3 dB at p sqrt(sqrt(2) - 1), no peak."""
    study = Study(shipped("ct_joint_T1.5", {"controller.p": p}), "ideal")
    linear = study.linear(study.waypoints())
    found = tracking(study.close(linear), (linear.law - linear.bare)[:, :, :3])
    np.testing.assert_allclose(found.bandwidth, p * math.sqrt(math.sqrt(2.0) - 1.0) / (2.0 * math.pi), rtol=2e-3)
    np.testing.assert_allclose(found.peak, 1.0, atol=1e-3)


def test_margins_that_no_gains_keep_are_refused() -> None:
    with pytest.raises(ScenarioError, match="no factor on these gains bears a gain margin of 900 and 0 ms more delay"):
        tune(shipped("pd7_joint"), "can", Wish(gain_margin=900.0))


# The command -------------------------------------------------------------------------------------------------------


def test_the_command_writes_a_scenario_that_runs_and_keeps_its_promise(
    call: Callable[..., Result], tmp_path: Path
) -> None:
    done = call("tune", "pd_joint_p2.5", "--json", "-o", str(tmp_path))
    assert done.code == 0, done.err
    answer = json.loads(done.out)
    assert answer["variant"] == "can"
    assert answer["before"]["metrics"]["stable"] is False
    assert answer["after"]["metrics"]["stable"] is True
    assert answer["gain_margin"] == pytest.approx(2.0, rel=1e-4)
    tuned = Scenario.load(answer["file"])
    assert tuned.variants["can"].controller.kp == answer["gains"]["controller.kp"]  # type: ignore[union-attr]
    assert margins(tuned, "can", {})[0] == pytest.approx(2.0, rel=1e-4)
    assert call("run", answer["file"], "--no-plots", "-o", str(tmp_path)).code == 0


def test_relative_paths_still_lead_somewhere(call: Callable[..., Result], tmp_path: Path) -> None:
    folder = tmp_path / "deep" / "er"
    folder.mkdir(parents=True)
    text = (Path(__file__).parent.parent / "models" / "lwa4d_3dof.xml").read_text()
    (folder / "arm.xml").write_text(text)
    (folder / "own.yaml").write_text(
        "name: own\narm: arm.xml\ntrajectory: {waypoints: {space: joint, points: [[0, -1, 1]]}, segment_time: 1}\n"
        "controller: {kind: computed_torque, p: 5}\n"
    )
    done = call("tune", str(folder / "own.yaml"), "-o", str(tmp_path / "out"))
    assert done.code == 0, done.err
    assert "bears 2.00 times these gains" in done.out
    assert call("run", str(tmp_path / "out" / "own_tuned.yaml"), "--no-plots", "-o", str(tmp_path)).code == 0


@pytest.mark.parametrize(
    ("arguments", "rule"),
    [
        (["pd_joint_p2.5", "--gain-margin", "0.5"], "--gain-margin (=0.5): must be from 1 to 1000"),
        (["pd_joint_p2.5", "--gain-margin", "nan"], "--gain-margin (=nan): must be from 1 to 1000"),
        (["pd_joint_p2.5", "--delay-margin", "-1"], "--delay-margin (=-1): must be from 0 to 0.1"),
        (
            ["pd_joint_p2.5", "--variant", "ideal"],
            "a loop without a bus has no largest gain; choose a variant with a bus",
        ),
        (["pd_joint_p2.5", "--variant", "x"], "no variant 'x'; it has ideal, can"),
        (["pd_joint_p2.5", "--gains", "three"], "three"),
        (["nothing.yaml"], "nothing.yaml: cannot read the scenario"),
        (["pd_joint_p2.5", "--set", "controller={kind: 'decimal:Decimal'}"], "decimal:Decimal has no method torque"),
        (["pd_joint_p2.5", "--set", "controller.kd=0"], "kp and kd must be above 0 to be tuned"),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(
    arguments: list[str],
    rule: str,
    call: Callable[..., Result],
    tmp_path: Path,
) -> None:
    refused(call("tune", *arguments, "-o", str(tmp_path)), rule)
    assert not list(tmp_path.iterdir())


def test_a_file_that_cannot_be_written_is_named(call: Callable[..., Result], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    refused(call("tune", "pd_joint_p2.5", "-o", str(tmp_path / "file")), "cannot write the scenario")


def test_a_file_of_ones_own_is_left_alone(call: Callable[..., Result], tmp_path: Path) -> None:
    (path := tmp_path / "pd_joint_p2.5_tuned.yaml").write_text("# my own gains\n")
    refused(call("tune", "pd_joint_p2.5", "-o", str(tmp_path)), "was not made by this command; choose another folder")
    assert path.read_text() == "# my own gains\n"


_plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


@given(st.dictionaries(st.text(), _plain, max_size=4))
@example({"0E0": "1e3", "a": 1e300})  # numbers of YAML 1.2, text in 1.1
def test_what_is_dumped_is_read_back(document: dict[str, Any]) -> None:
    assert parse(dump(document), "test")[0] == document
