"""Builds the blocks of a scenario: the only place where settings become objects."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from lwa4d_sim.controllers import CustomController, PdGravity
from lwa4d_sim.controllers.belief import build_beliefs
from lwa4d_sim.errors import LwaError, ScenarioError
from lwa4d_sim.interfaces import NS_PER_S, Array, Controller, Estimator, Ns, Trajectory, to_ns
from lwa4d_sim.kinematics import SerialKinematics, kinematics_for
from lwa4d_sim.lateness import compensator, computing_phase, loop_delay, reference_instants
from lwa4d_sim.lockstep import common
from lwa4d_sim.loop import ControllerSide, Timing
from lwa4d_sim.mjcf import chain_of, home, load_model, torque_limits
from lwa4d_sim.plant import Plant
from lwa4d_sim.recorder import RunInfo
from lwa4d_sim.references import ReferenceBlocks, Remembered
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.settings import IdealLoop, SampledLoop, Settings

# A run longer than this many plant steps is taken for a mistake (assumed; 5 h of simulated time at 1 ms).
MAX_STEPS = 20_000_000


@dataclass(frozen=True, slots=True)
class PaperArm:
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Blocks:
    """What a scenario's variant is made of, before a link joins its two sides.

    Attributes:
        scenario, variant: where it comes from.
        settings: of the first member; the shared ones hold for all.
        members: settings of each.
        arm: the arm on paper.
        model: the first member's plant as MuJoCo knows it.
        plant: the arm.
        q0: start positions (N, n) [rad].
        control: makes the controller side from an estimator.
        timing: instants of a period.
        timestep: plant step [ns].
        infos: one for each member.
    """

    scenario: Scenario
    variant: str
    settings: Settings
    members: Sequence[Settings]
    arm: PaperArm
    model: mujoco.MjModel
    plant: Plant
    q0: Array
    control: Callable[[Estimator], ControllerSide]
    timing: Timing
    timestep: Ns
    infos: list[RunInfo]

    @contextmanager
    def about(self, key: str) -> Iterator[None]:
        """Name the place in the file in any error."""
        with _about(self.scenario, self.variant, key):
            yield


@contextmanager
def _about(scenario: Scenario, variant: str, key: str) -> Iterator[None]:
    try:
        yield
    except LwaError as error:
        raise scenario.locate(error, key, variant) from error


def build_blocks(scenarios: Sequence[Scenario], variant: str, threads: int) -> Blocks:
    """Everything but the link.

    Raises:
        ScenarioError: settings that fit the schema but not each other, or not the batch.
        ModelError, KinematicsError, TrajectoryError: the arm or the motion cannot be built; the message says where.
    """
    scenario = scenarios[0]
    members = [one.variants[variant] for one in scenarios]
    first = members[0]
    shared = common(first)
    for k, member in enumerate(members):
        for key, value in common(member).items() if member is not first else ():
            if value != shared.get(key):
                raise ScenarioError(f"{scenario.source}: member {k} of the batch differs in '{key}'; all must share it")

    def about(key: str) -> AbstractContextManager[None]:
        return _about(scenario, variant, key)

    with about("plant.timestep"):
        timestep = _timestep(first)
    with about("arm"):
        load_model(first.arm, base=scenario.folder)  # so that what is wrong from here on is wrong with the changes
    with about("plant"):
        models = [_plant_model(member, scenario.folder) for member in members]
        one_model = all(model is models[0] for model in models)
        kinematics = kinematics_for(chain_of(models[0]))
        arm = PaperArm(kinematics, home(models[0]), torque_limits(models[0]))
    with about("initial.q"):
        q0 = np.stack([_start(member, arm) for member in members])
    with about("trajectory"):
        trajectories = _trajectories(members, arm, q0, scenario.folder)
    with about("loop.period"):
        timing = _timing(first, timestep, trajectories[0].duration)
    with about("controller"):
        controller = build_controller(members, arm)
        beliefs = [member.controller.model for member in members]
        model = build_beliefs(beliefs, first.arm, scenario.folder, threads)
    with about("plant.disturbances"):
        plant = Plant(models[0] if one_model else models, q0, first.plant.disturbances, threads)
    space = first.controller.space
    with about("compensation"):
        instants = reference_instants(members)
    references = ReferenceBlocks(trajectories, space, timing.period, instants, timing.ticks)

    def control(estimator: Estimator) -> ControllerSide:
        between = compensator(members, estimator, model, arm.tau_max)
        return ControllerSide(estimator, references, controller, model, between)

    infos = [
        RunInfo(
            name=scenario.name,
            variant=variant,
            seed=member.plant.seed,
            kinematics=kinematics,
            trajectory=trajectories[k % len(trajectories)],
            tau_max=arm.tau_max,
            scenario=scenarios[k].resolved(variant),
            versions=versions(),
        )
        for k, member in enumerate(members)
    ]
    return Blocks(
        scenario=scenario,
        variant=variant,
        settings=first,
        members=members,
        arm=arm,
        model=models[0],
        plant=plant,
        q0=q0,
        control=control,
        timing=timing,
        timestep=timestep,
        infos=infos,
    )


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


def _start(settings: Settings, arm: PaperArm) -> Array:
    if settings.initial.q is None:
        return arm.home
    if len(settings.initial.q) != arm.n:
        raise ScenarioError(f"has {len(settings.initial.q)} values, the arm has {arm.n} joints")
    return np.asarray(settings.initial.q)


def _trajectories(members: Sequence[Settings], arm: PaperArm, q0: Array, folder: Path) -> list[Trajectory]:
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
    phase = computing_phase(loop, period, timestep) if isinstance(loop, SampledLoop) else 0
    return Timing(period, Ns(phase), ticks)


def build_controller(members: Sequence[Settings], arm: PaperArm) -> Controller:
    """The control law of some members, one row of gains each.

    Raises:
        ScenarioError: they differ in kind or space, or the gains do not fit the arm.
    """
    parameters = [member.controller for member in members]
    first = parameters[0]
    if any(type(p) is not type(first) or p.space != first.space for p in parameters):
        raise ScenarioError("all members of a batch must share the kind and space of the controller")
    if isinstance(first, CustomController):
        if any(p != first for p in parameters):
            raise ScenarioError("all members of a batch must share a controller of your own")
        return first.create()
    if isinstance(first, PdGravity):
        rows = [one for one in parameters if isinstance(one, PdGravity)]
        return PdGravity.build(rows, arm.n, arm.task_size, [loop_delay(member) for member in members])
    build: Any = type(first).build  # the parameters are all of this one type, which mypy cannot know
    made: Controller = build(parameters, arm.n, arm.task_size)
    return made


@cache
def _installed(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "unknown"


def versions() -> dict[str, str]:
    """Versions of the software that a run's numbers depend on."""
    return {package: _installed(package) for package in ("lwa4d_sim", "mujoco", "numpy")}
