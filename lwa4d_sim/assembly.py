"""Builds the blocks of a scenario and puts them together: the only place where settings become a loop."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from operator import attrgetter
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from lwa4d_sim.channels import Gate
from lwa4d_sim.controllers import CustomController
from lwa4d_sim.controllers.belief import build_beliefs
from lwa4d_sim.drives import Drives
from lwa4d_sim.errors import LwaError, ScenarioError
from lwa4d_sim.estimators import Midpoint, TrueSource
from lwa4d_sim.interfaces import NS_PER_S, Array, Controller, Ns, Trajectory, to_ns
from lwa4d_sim.kinematics import SerialKinematics, kinematics_for
from lwa4d_sim.loop import ArmSide, ControllerSide, Link, Timing, simulate
from lwa4d_sim.mjcf import chain_of, home, load_model, torque_limits
from lwa4d_sim.plant import Plant
from lwa4d_sim.record import RunLog
from lwa4d_sim.recorder import RunInfo, record
from lwa4d_sim.references import ReferenceBlocks, Remembered
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.settings import IdealLoop, SampledLoop, Settings

# A run longer than this many plant steps is taken for a mistake (assumed; 5 h of simulated time at 1 ms).
MAX_STEPS = 20_000_000
# Numbers of the random streams; a new source of randomness takes a new number and leaves the others' draws alone.
_MEASUREMENT, _COMMAND = 1, 2
# What members stepped together have in common, because one loop and one clock drive them all.
_SHARED = ("arm", "loop", "plant.timestep", "plant.integrator", "plant.disturbances")


@dataclass(frozen=True, slots=True)
class _Arm:
    """The arm's paper side, common to all members."""

    kinematics: SerialKinematics
    home: Array
    tau_max: Array

    @property
    def n(self) -> int:
        return len(self.home)

    @property
    def task_size(self) -> int:
        return 3 if self.n < 6 else 6


def run_together(scenarios: Sequence[Scenario], variant: str, threads: int) -> list[RunLog]:
    """Run one variant of some scenarios in lock step; all but the shared settings may differ.

    Raises:
        ScenarioError: settings that fit the schema but not each other, or not the batch.
        ModelError, KinematicsError, TrajectoryError: the arm or the motion cannot be built; the message says where.
    """
    scenario = scenarios[0]
    members = [one.variants[variant] for one in scenarios]
    first = members[0]
    for k, member in enumerate(members):
        for key in _SHARED:
            if attrgetter(key)(member) != attrgetter(key)(first):
                raise ScenarioError(f"{scenario.source}: member {k} of the batch differs in '{key}'; all must share it")

    @contextmanager
    def about(key: str) -> Iterator[None]:
        """Name the place in the file in any error."""
        try:
            yield
        except LwaError as error:
            raise scenario.locate(error, key, variant) from error

    with about("plant.timestep"):
        timestep = _timestep(first)
    with about("arm"):
        load_model(first.arm, base=scenario.folder)  # so that what is wrong from here on is wrong with the changes
    with about("plant"):
        models = [_plant_model(member, scenario.folder) for member in members]
        shared = all(model is models[0] for model in models)
        kinematics = kinematics_for(chain_of(models[0]))
        arm = _Arm(kinematics, home(models[0]), torque_limits(models[0]))
    with about("initial.q"):
        q0 = np.stack([_start(member, arm) for member in members])
    with about("trajectory"):
        trajectories = _trajectories(members, arm, q0, scenario.folder)
    with about("loop.period"):
        timing = _timing(first, timestep, trajectories[0].duration)
    with about("controller"):
        controller = _controller(members, arm)
        beliefs = [member.controller.model for member in members]
        model = build_beliefs(beliefs, first.arm, scenario.folder, threads)
    seeds = [member.plant.seed for member in members]
    with about("plant.disturbances"):
        plant = Plant(models[0] if shared else models, q0, first.plant.disturbances, threads)
    with about("loop"):
        link, drives, source, estimator = _loop(first, arm, q0, timing, timestep, seeds)
    space = first.controller.space
    instant = timing.phase / NS_PER_S if not isinstance(first.loop, IdealLoop) else 0.5 * timestep / NS_PER_S
    references = ReferenceBlocks(trajectories, space, timing.period, instant, timing.ticks)
    control = ControllerSide(estimator, references, controller, model)
    side = ArmSide(plant, drives, source)
    infos = [
        RunInfo(
            name=scenario.name,
            variant=variant,
            seed=seed,
            kinematics=kinematics,
            trajectory=trajectories[k % len(trajectories)],
            tau_max=arm.tau_max,
            scenario=scenarios[k].resolved(variant),
            versions=versions(),
        )
        for k, seed in enumerate(seeds)
    ]
    with about("trajectory"):
        ticks = simulate(side, control, link, timing, timestep)
        return record(ticks, infos, timing, timestep, q0, full_ticks=not isinstance(first.loop, IdealLoop))


def _timestep(settings: Settings) -> Ns:
    timestep = to_ns(settings.plant.timestep)
    if abs(timestep / NS_PER_S - settings.plant.timestep) > 1e-15 or timestep == 0:
        raise ScenarioError(f"{settings.plant.timestep} s is not a whole number of nanoseconds")
    return timestep


def _plant_model(settings: Settings, folder: Path) -> mujoco.MjModel:
    plant = settings.plant
    return load_model(
        settings.arm,
        plant,
        timestep=plant.timestep,
        integrator=plant.integrator,
        base=folder,
        tool_body=any(disturbance.body is None for disturbance in plant.disturbances),
    )


def _start(settings: Settings, arm: _Arm) -> Array:
    if settings.initial.q is None:
        return arm.home
    if len(settings.initial.q) != arm.n:
        raise ScenarioError(f"has {len(settings.initial.q)} values, the arm has {arm.n} joints")
    return np.asarray(settings.initial.q)


def _trajectories(members: Sequence[Settings], arm: _Arm, q0: Array, folder: Path) -> list[Trajectory]:
    """One trajectory a member, or a single one that all share."""
    same = all(member.trajectory == members[0].trajectory for member in members) and (q0 == q0[0]).all()
    built: list[Trajectory] = [
        member.trajectory.build(arm.kinematics, q0[k], folder)
        for k, member in enumerate(members[:1] if same else members)
    ]
    if same and len(members) > 1:
        built = [Remembered(built[0])]
    if any(trajectory.duration != built[0].duration for trajectory in built):
        raise ScenarioError("all members of a batch must have the same duration")
    return built


def _timing(settings: Settings, timestep: Ns, duration: float) -> Timing:
    loop = settings.loop
    period = timestep if isinstance(loop, IdealLoop) else to_ns(loop.period)
    if period % timestep or period == 0:
        whole = max(1, round(period / timestep)) * timestep / NS_PER_S
        raise ScenarioError(
            f"{period / NS_PER_S} s is not a whole multiple of the plant step {timestep / NS_PER_S} s; nearest: {whole}"
        )
    ticks = -(-to_ns(duration) // period)
    if ticks * period // timestep > MAX_STEPS:
        raise ScenarioError(
            f"{duration} s at a plant step of {timestep / NS_PER_S} s are more than {MAX_STEPS} steps", key="trajectory"
        )
    if ticks == 0:
        raise ScenarioError("the motion lasts no time at all", key="trajectory")
    phase = 0 if isinstance(loop, IdealLoop) else _phase(loop, period, timestep)
    return Timing(period, Ns(phase), ticks)


def _phase(loop: SampledLoop, period: int, timestep: int) -> int:
    """From sample to computation, on the plant's grid and within one period."""
    seconds = loop.transports[0].usual_longest if loop.phase is None else loop.phase
    phase = -(-to_ns(seconds) // timestep) * timestep
    if loop.phase is not None and phase >= period:
        raise ScenarioError(f"phase {loop.phase} s must be shorter than the period {loop.period} s", key="loop.phase")
    return phase % period


def _controller(members: Sequence[Settings], arm: _Arm) -> Controller:
    parameters = [member.controller for member in members]
    first = parameters[0]
    if any(type(p) is not type(first) or p.space != first.space for p in parameters):
        raise ScenarioError("all members of a batch must share the kind and space of the controller")
    if isinstance(first, CustomController):
        if any(p != first for p in parameters):
            raise ScenarioError("all members of a batch must share a controller of your own")
        return first.create()
    build: Any = type(first).build  # the parameters are all of this one type, which mypy cannot know
    made: Controller = build(parameters, arm.n, arm.task_size)
    return made


def _loop(
    settings: Settings, arm: _Arm, q0: Array, timing: Timing, timestep: Ns, seeds: Sequence[int]
) -> tuple[Link, Drives, Any, Any]:
    """Link, drives, velocity source and estimator; ideal is the case that costs nothing and holds nothing."""
    dt = timestep / NS_PER_S
    ideal = isinstance(settings.loop, IdealLoop)
    loop = settings.loop if isinstance(settings.loop, SampledLoop) else SampledLoop(period=dt)
    up, down = loop.transports
    sync = timing.period if loop.actuation == "next_sync" else 0
    link = Link(up.build(seeds, _MEASUREMENT, arm.n, Gate(1)), down.build(seeds, _COMMAND, arm.n, Gate(timestep, sync)))
    drives = Drives(
        arm.tau_max,
        position_resolution=_resolution(loop.position_resolution, arm.n, "loop.position_resolution"),
        torque_resolution=_resolution(loop.torque_resolution, arm.n, "loop.torque_resolution"),
        late=loop.late_data,
        period=loop.period,
        timestep=timestep,
    )
    if ideal:
        return link, drives, TrueSource(q0), Midpoint(q0, dt)
    source, estimator = loop.velocity.build(q0, loop.period, dt)
    return link, drives, source, estimator


def _resolution(value: Any, n: int, key: str) -> Array | None:
    steps = np.atleast_1d(np.asarray(value, float))
    if len(steps) not in (1, n):
        raise ScenarioError(f"has {len(steps)} values; give one number or one for each of {n} joints", key=key)
    return np.broadcast_to(steps, (n,)).copy() if steps.any() else None


@cache
def _installed(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"


def versions() -> dict[str, str]:
    """Versions of the software that a run's numbers depend on."""
    return {package: _installed(package) for package in ("lwa4d_sim", "mujoco", "numpy")}
