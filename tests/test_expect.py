"""Expectations: which may be asked, and when they hold."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lwa4d_sim.expect import check_expectations, evaluate
from lwa4d_sim.metrics import FLAGS, METRICS

NUMBERS = st.floats(-1e6, 1e6)


def holds(rule: dict[str, Any], values: dict[str, Any]) -> bool:
    [outcome] = evaluate(rule, values)
    return outcome.passed


@pytest.mark.parametrize("metric", [name for name in METRICS if name not in FLAGS])
@pytest.mark.parametrize("side", ["max", "min"])
@pytest.mark.parametrize("bound", [1, 0.5, [1.0, None], [1]])
def test_every_metric_may_be_bounded_on_either_side(metric: str, side: str, bound: Any) -> None:
    assert check_expectations(f"{metric}_{side}", bound) is None


@pytest.mark.parametrize(
    ("key", "bound", "words"),
    [
        ("stable", 1, "must be true or false"),
        ("stable", None, "must be true or false"),
        ("stable_max", True, "did you mean 'stable'?"),
        ("final_error", 0.1, "did you mean 'final_error_m"),
        ("finalerror_max", 0.1, "did you mean 'final_error_max'?"),
        (
            "xyzzy",
            1,
            "unknown expectation; valid here: stable, stopped, or one of these followed by _max or _min: unstable_",
        ),
        ("", 1, "unknown expectation"),
        ("_max", 1, "unknown expectation"),
        ("rms_error_max", "0.1", "must be a number, or a list"),
        ("rms_error_max", True, "must be a number, or a list"),
        ("rms_error_max", [], "must be a number, or a list"),
        ("rms_error_max", [[1]], "must be a number, or a list"),
        ("rms_error_max", [True], "must be a number, or a list"),
        ("rms_error_max", {}, "must be a number, or a list"),
    ],
)
def test_what_cannot_be_asked_is_refused_with_what_can(key: str, bound: Any, words: str) -> None:
    assert words in str(check_expectations(key, bound))


@pytest.mark.parametrize(
    ("rule", "values", "passed"),
    [
        ({"stable": True}, {"stable": True}, True),
        ({"stable": False}, {"stable": True}, False),
        ({"stable": True}, {}, False),
        ({"rms_error_max": 1.0}, {"rms_error": 1.0}, True),
        ({"rms_error_max": 1.0}, {"rms_error": 1.1}, False),
        ({"rms_error_min": 1.0}, {"rms_error": 1.0}, True),
        ({"rms_error_min": 1.0}, {"rms_error": 0.9}, False),
        ({"rms_error_max": 1.0}, {"rms_error": None}, False),
        ({"rms_error_min": 1.0}, {"rms_error": None}, False),
        ({"rms_error_max": 1.0}, {}, False),
        ({"final_error_max": 1.0}, {"final_error": [0.5, 1.0]}, True),
        ({"final_error_max": 1.0}, {"final_error": [0.5, 1.1]}, False),
        ({"final_error_max": 1.0}, {"final_error": [0.5, None]}, False),
        ({"final_error_max": [1.0, 2.0]}, {"final_error": [1.0, 2.0]}, True),
        ({"final_error_max": [1.0, 2.0]}, {"final_error": [2.0, 1.0]}, False),
        ({"final_error_max": [1.0, None]}, {"final_error": [1.0, 99.0]}, True),
        ({"final_error_max": [1.0, None]}, {"final_error": [1.0, None]}, True),
        ({"final_error_max": [1.0]}, {"final_error": [1.0, 1.0]}, False),
        ({"final_error_max": [1.0, 1.0]}, {"final_error": [1.0]}, False),
        ({"data_age_max_max": 0.02}, {"data_age_max": 0.01}, True),
    ],
)
def test_when_an_expectation_holds(rule: dict[str, Any], values: dict[str, Any], passed: bool) -> None:
    assert holds(rule, values) is passed


@settings(deadline=None, derandomize=True, max_examples=100)
@given(st.lists(NUMBERS, min_size=1, max_size=5), NUMBERS)
def test_a_single_bound_is_a_list_of_it_and_the_sides_mirror_each_other(values: list[float], bound: float) -> None:
    found = {"final_error": values}
    upper = holds({"final_error_max": bound}, found)
    assert upper == holds({"final_error_max": [bound] * len(values)}, found) == (max(values) <= bound)
    assert upper == holds({"final_error_min": -bound}, {"final_error": [-v for v in values]})


def test_outcomes_tell_what_was_asked_and_found_in_the_order_asked() -> None:
    rules = {"stable": True, "rms_error_max": 0.1, "peak_torque_min": [1, None]}
    outcomes = evaluate(rules, {"stable": True, "rms_error": 0.2, "peak_torque": [2.0, 0.0]})
    assert [(o.key, o.bound, o.value, o.passed) for o in outcomes] == [
        ("stable", True, True, True),
        ("rms_error_max", 0.1, 0.2, False),
        ("peak_torque_min", [1, None], [2.0, 0.0], True),
    ]


def test_a_run_that_was_stopped_fails_unless_that_is_expected() -> None:
    values = {"stable": True, "stopped": True}
    assert [outcome.passed for outcome in evaluate({"stable": True}, values)] == [False, True]
    assert [outcome.passed for outcome in evaluate({"stable": True, "stopped": True}, values)] == [True, True]
    assert evaluate({}, values) == []
    assert [outcome.key for outcome in evaluate({"stable": True}, {"stable": True, "stopped": False})] == ["stable"]
