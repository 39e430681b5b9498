"""Expectations of a scenario: which metrics must hold, within which bounds."""

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from lwa4d_sim.metrics import FLAGS, METRICS

_SIDES = ("max", "min")


@dataclass(frozen=True, slots=True)
class Outcome:
    """One expectation checked: its key, bound, the value found and whether it holds."""

    key: str
    bound: Any
    value: Any
    passed: bool


def check_expectations(key: str, bound: Any) -> str | None:
    """What is wrong with an expectation, or None: `stable: true`, `METRIC_max: bound` or `METRIC_min: bound`."""
    if key in FLAGS:
        return None if isinstance(bound, bool) else "must be true or false"
    metric = _metric(key)
    if metric is None:
        numeric = [name for name in METRICS if name not in FLAGS]
        close = difflib.get_close_matches(
            key, [*FLAGS, *(f"{name}_{side}" for name in numeric for side in _SIDES)], n=1
        )
        hint = f"did you mean '{close[0]}'? " if close else ""
        rest = f"one of these followed by _max or _min: {', '.join(numeric)}"
        return f"unknown expectation; {hint}valid here: {', '.join(FLAGS)}, or {rest}"
    bounds = bound if isinstance(bound, list) else [bound]
    if not bounds or not all(b is None or (isinstance(b, (int, float)) and not isinstance(b, bool)) for b in bounds):
        return "must be a number, or a list of numbers (null skips an entry)"
    return None


def evaluate(rules: Mapping[str, Any], values: Mapping[str, Any]) -> list[Outcome]:
    """Check ``rules`` against the metrics ``values``. A metric that does not exist fails its bound.

    A run of which anything is expected is not to be stopped by its master, unless the rules say so.
    """
    outcomes = []
    if rules and values.get("stopped"):
        rules = {"stopped": False, **rules}
    for key, bound in rules.items():
        if key in FLAGS:
            outcomes.append(Outcome(key, bound, values.get(key), values.get(key) == bound))
            continue
        metric = _metric(key)
        value = values.get(metric or key)
        outcomes.append(Outcome(key, bound, value, _within(value, bound, key.endswith("_max"))))
    return outcomes


def _metric(key: str) -> str | None:
    name, _, side = key.rpartition("_")
    return name if side in _SIDES and name in METRICS and name not in FLAGS else None


def _within(value: Any, bound: Any, upper: bool) -> bool:
    values = value if isinstance(value, list) else [value]
    bounds = bound if isinstance(bound, list) else [bound] * len(values)
    if len(bounds) != len(values):
        return False
    pairs = [(v, b) for v, b in zip(values, bounds, strict=True) if b is not None]
    return all(v is not None and (v <= b if upper else v >= b) for v, b in pairs)
