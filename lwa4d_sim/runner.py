"""Runs scenarios: one variant, all variants, or many variations of one in lock step."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from lwa4d_sim.assembly import Blocks, build_blocks
from lwa4d_sim.channels import Gate, build_channel
from lwa4d_sim.drives import Drives
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.estimators import Midpoint, TrueSource
from lwa4d_sim.interfaces import NS_PER_S, Array
from lwa4d_sim.loop import ArmSide, Link, simulate
from lwa4d_sim.metrics import deviation
from lwa4d_sim.record import RunLog
from lwa4d_sim.recorder import record
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.settings import CanopenLoop, IdealLoop, SampledLoop

# Numbers of the random streams; a new source of randomness takes a new number and leaves the others' draws alone.
_MEASUREMENT, _COMMAND = 1, 2

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
    gains, belief, seed, and in the loop's latency, jitter, loss and resolutions as long as its phase stays the same;
    not in arm, the model file believed, the rest of the loop, plant step or duration.

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


def run_together(scenarios: Sequence[Scenario], variant: str, threads: int) -> list[RunLog]:
    """Run one variant of some scenarios in lock step; all but the shared settings may differ.

    Raises:
        ScenarioError: settings that fit the schema but not each other, or not the batch.
        ModelError, KinematicsError, TrajectoryError: the arm or the motion cannot be built; the message says where.
        BusError: the drives of a simulated bus cannot be set up.
    """
    canopen = isinstance(scenarios[0].variants[variant].loop, CanopenLoop)
    if canopen and len(scenarios) > 1:
        return [run_together([one], variant, 1)[0] for one in scenarios]  # each has a bus of its own
    blocks = build_blocks(scenarios, variant, threads)
    bus = None
    with blocks.about("loop"):
        if canopen:
            from lwa4d_sim.bus.build import canopen_run  # half a second of imports that only this loop needs

            bus, ticks = canopen_run(blocks)
        else:
            link, drives, source, estimator = _loop(blocks)
            side = ArmSide(blocks.plant, drives, source)
            ticks = simulate(side, blocks.control(estimator), link, blocks.timing, blocks.timestep)
    with blocks.about("trajectory"):
        full = not isinstance(blocks.settings.loop, IdealLoop)
        logs = record(ticks, blocks.infos, blocks.timing, blocks.timestep, blocks.q0, full_ticks=full)
    return logs if bus is None else [bus.annotated(log) for log in logs]


def _loop(blocks: Blocks) -> tuple[Link, Drives, Any, Any]:
    """Link, drives, velocity source and estimator; ideal is the case that costs nothing and holds nothing."""
    timestep, q0, n = blocks.timestep, blocks.q0, blocks.arm.n
    dt = timestep / NS_PER_S
    given = blocks.settings.loop
    loops = [one.loop if isinstance(one.loop, SampledLoop) else SampledLoop(period=dt) for one in blocks.members]
    loop = loops[0]
    up, down = zip(*(one.transports for one in loops), strict=True)
    seeds = [info.seed for info in blocks.infos]
    sync = blocks.timing.period if loop.actuation == "next_sync" else 0
    link = Link(
        build_channel(up, seeds, _MEASUREMENT, n, Gate(1)),
        build_channel(down, seeds, _COMMAND, n, Gate(timestep, sync)),
    )
    drives = Drives(
        blocks.arm.tau_max,
        position_resolution=_resolution([one.position_resolution for one in loops], n, "loop.position_resolution"),
        torque_resolution=_resolution([one.torque_resolution for one in loops], n, "loop.torque_resolution"),
        late=loop.late_data,
        period=loop.period,
        timestep=timestep,
    )
    if isinstance(given, IdealLoop):
        return link, drives, TrueSource(q0), Midpoint(q0, dt)
    source, estimator = loop.velocity.build(q0, loop.period, dt)
    return link, drives, source, estimator


def _resolution(values: Sequence[float | tuple[float, ...]], n: int, key: str) -> Array | None:
    """Steps of each simulation's joints, (1, n) where all are alike, else (N, n); None where none rounds."""
    rows = []
    for value in values if any(value != values[0] for value in values) else values[:1]:
        steps = np.atleast_1d(np.asarray(value, float))
        if len(steps) not in (1, n):
            raise ScenarioError(f"has {len(steps)} values; give one number or one for each of {n} joints", key=key)
        rows.append(np.broadcast_to(steps, (n,)))
    made = np.stack(rows)
    return made if made.any() else None


def _variant(scenario: Scenario, variant: str | None) -> str:
    name = variant or next(iter(scenario.variants))
    if name not in scenario.variants:
        raise ScenarioError(f"{scenario.source}: no variant '{name}'; it has {', '.join(scenario.variants)}")
    return name
