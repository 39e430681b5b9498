"""The JSON schema that editors get: what the loader takes passes it, what it refuses does not."""

from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from lwa4d_sim.console import shipped_scenarios
from lwa4d_sim.schema import json_schema
from lwa4d_sim.yaml_text import parse

SCENARIOS = sorted(shipped_scenarios().glob("*.yaml"))


def document(file: Path) -> dict[str, Any]:
    text: dict[str, Any] = parse(file.read_text(), file.name)[0]
    return text


@pytest.fixture(scope="module")
def validator() -> Draft202012Validator:
    schema = json_schema()
    Draft202012Validator.check_schema(schema)
    return Draft202012Validator(schema)


@pytest.mark.parametrize("file", SCENARIOS, ids=lambda file: file.stem)
def test_shipped_scenarios_pass(validator: Draft202012Validator, file: Path) -> None:
    validator.validate(document(file))


@pytest.mark.parametrize(
    "change",
    [
        {"controler": {}},
        {"controller": {"kind": "pd_gravity", "kp": 1, "kdd": 2}},
        {"controller": {"kind": "sliding_mode", "kp": 1}},
        {"loop": {"kind": "sampled", "period": -0.01}},
        {"plant": {"timestep": "fast"}},
        {"variants": {"can": {"expect": {}}}},
        {"expect": {"can": {"final_eror_max": 0.1}}},
        {"expect": {"can": {"stable": "yes"}}},
    ],
)
def test_mistakes_do_not(validator: Draft202012Validator, change: dict[str, Any]) -> None:
    assert not validator.is_valid({**document(SCENARIOS[0]), **change})


def test_a_controller_of_ones_own_takes_any_key(validator: Draft202012Validator) -> None:
    validator.validate({**document(SCENARIOS[0]), "controller": {"kind": "lab.laws:Mine", "anything": [1, 2]}})
