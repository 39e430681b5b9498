"""Runs scenarios: one variant, all variants, or many variations of one in lock step."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from lwa4d_sim.assembly import run_together
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.metrics import deviation
from lwa4d_sim.record import RunLog
from lwa4d_sim.scenario import Scenario

# Runs stepped together share this much memory for their records (assumed: what any machine can spare; 230 runs of 20 s,
# 7 joints and 1 ms). Few runs would waste threads, so there are never fewer than the second number.
RECORD_BUDGET, LEAST_CHUNK = 768_000_000, 16


def run(scenario: Scenario, variant: str | None = None) -> RunLog:
    """Run one variant of a scenario.

    Args:
        scenario: the scenario.
        variant: its name; default the first.

    Raises:
        ScenarioError: no such variant, or settings that fit the schema but not each other.
        ModelError, KinematicsError, TrajectoryError: the arm or the motion cannot be built; the message says where.
    """
    name = _variant(scenario, variant)
    return run_together([scenario], name, threads=1)[0]


def run_all(scenario: Scenario) -> dict[str, RunLog]:
    """Run every variant, in the file's order."""
    return {name: run(scenario, name) for name in scenario.variants}


def measure(logs: Mapping[str, RunLog]) -> dict[str, dict[str, Any]]:
    """Metrics of each variant; beside a variant called `ideal` the others also get their `deviation` from it."""
    values = {name: log.metrics() for name, log in logs.items()}
    if "ideal" in logs:
        for name, log in logs.items():
            if name != "ideal":
                values[name] = {**values[name], "deviation": deviation(log, logs["ideal"])}
    return values


def run_batch(
    scenario: Scenario,
    members: Sequence[Mapping[str, Any]],
    variant: str | None = None,
    *,
    threads: int = 0,
) -> Iterator[RunLog]:
    """Run many variations of one scenario in lock step and hand out their logs in order.

    Every member equals the run of the same settings alone, bit for bit. Members may differ in start, plant, motion,
    gains, belief and seed, not in arm, loop, plant step or duration.

    Args:
        scenario: the scenario.
        members: overrides by dotted key, one mapping per run.
        variant: which variant; default the first.
        threads: threads to step on (0: all CPUs).

    Yields:
        One log per member. Only a part of them exists at a time (`RECORD_BUDGET`) if the caller lets go of them.
    """
    name = _variant(scenario, variant)
    size = LEAST_CHUNK
    start = 0
    while start < len(members):
        chunk = [scenario.changed(member, name) for member in members[start : start + size]]
        start += size
        for log in run_together(chunk, name, threads):
            whole = 3 * log.q[0].nbytes * log.step_at(log.knots[-1])  # even where this one run was cut short
            size = max(LEAST_CHUNK, RECORD_BUDGET // whole)
            yield log


def _variant(scenario: Scenario, variant: str | None) -> str:
    name = variant or next(iter(scenario.variants))
    if name not in scenario.variants:
        raise ScenarioError(f"{scenario.source}: no variant '{name}'; it has {', '.join(scenario.variants)}")
    return name
