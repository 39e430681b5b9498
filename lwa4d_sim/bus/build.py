"""Builds what a scenario needs on a bus: both sides on the simulated wire, or one of them on a real one."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lwa4d_sim.assembly import Blocks
from lwa4d_sim.bus.arm import BusArm
from lwa4d_sim.bus.checks import check_bus
from lwa4d_sim.bus.connect import Connection
from lwa4d_sim.bus.dictionary import Joint, drive_dictionary
from lwa4d_sim.bus.faults import Faults
from lwa4d_sim.bus.joints import joints_for
from lwa4d_sim.bus.master import Master, Plan
from lwa4d_sim.bus.safety import Envelope, Following
from lwa4d_sim.bus.session import Session
from lwa4d_sim.bus.simulation import STARTUP, Simulation, add_traffic
from lwa4d_sim.bus.wire import BitErrors, Wire
from lwa4d_sim.dynamics import Dynamics
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import NS_PER_S, Estimator, Ns, to_ns
from lwa4d_sim.loop import Tick
from lwa4d_sim.mjcf import joint_facts
from lwa4d_sim.settings import CanopenLoop


def bus_loop(settings: Any) -> CanopenLoop:
    """The CANopen loop of a scenario; for one with another loop, that loop's period and estimator on a default bus."""
    loop = settings.loop
    if isinstance(loop, CanopenLoop):
        return loop
    taken = {key: getattr(loop, key) for key in ("period", "actuation", "velocity") if hasattr(loop, key)}
    return replace(CanopenLoop(), **taken)


def plan_for(blocks: Blocks, loop: CanopenLoop) -> Plan:
    """What the master is to set up."""
    period = to_ns(loop.period)
    return Plan(
        profile=loop.profile,
        joints=_joints(blocks),
        period=period,
        immediate=loop.actuation == "immediate",
        heartbeat=max(1, round(loop.heartbeat * 1000)) if loop.heartbeat else 0,
        deadline=to_ns(loop.deadline) if loop.deadline is not None else Ns(period // 2),
    )


def canopen_run(blocks: Blocks) -> tuple[Simulation, Iterator[Tick]]:
    """Both sides over the simulated wire: the simulation and its running loop, one tick a period."""
    loop = bus_loop(blocks.settings)
    source, estimator = _speed(blocks, loop)
    if loop.noise.per_bit and loop.bit_rate is None:
        raise ScenarioError("needs frames that take time, not bit_rate null", "loop.noise.per_bit")
    errors = BitErrors(probability=loop.noise.per_bit) if loop.noise.per_bit else None
    seed = blocks.infos[0].seed
    plan = plan_for(blocks, loop)
    check_bus(plan, loop.bit_rate, loop.traffic)
    wire = Wire(loop.bit_rate, start=STARTUP, errors=errors, seed=seed, record=True)
    add_traffic(wire, loop.traffic)
    simulation = Simulation(wire, blocks.plant, plan.joints, loop.profile, source)
    _tune(simulation.arm, blocks)
    Faults(simulation, plan, loop.bit_rate, loop.faults)
    control = blocks.control(estimator)
    ticks = simulation.run(plan, control, blocks.timing, with_speed=source is not None, following=_following(blocks))
    return simulation, ticks


def served_arm(blocks: Blocks, bus: Connection, *, epoch: Ns, per_sync: bool) -> BusArm:
    """The arm side on a bus."""
    loop = bus_loop(blocks.settings)
    source, _ = _speed(blocks, loop)
    step = to_ns(loop.period) if per_sync else None
    with blocks.about("loop"):
        joints = _joints(blocks)
    arm = BusArm(blocks.plant, joints, loop.profile, source, lambda node: bus.send, epoch, step)
    _tune(arm, blocks)
    return arm


def driving_session(
    blocks: Blocks, bus: Connection, clock: Callable[[], Ns], *, torque: float = 1.0
) -> tuple[Master, Session]:
    """The controller side on a bus, behind an envelope that lets out a share ``torque`` of the peak torques."""
    loop = bus_loop(blocks.settings)
    source, estimator = _speed(blocks, loop)
    with blocks.about("loop"):
        plan = plan_for(blocks, loop)
        check_bus(plan, loop.bit_rate, loop.traffic)
    master = Master(bus, clock, plan)
    control = blocks.control(estimator)
    guard = Envelope(plan.joints, torque=torque)
    following = _following(blocks)
    return master, Session(master, control, with_speed=source is not None, guard=guard, following=following)


def _following(blocks: Blocks) -> Following | None:
    loop = bus_loop(blocks.settings)
    if loop.following_error is None:
        return None
    names = [joint.name for joint in _joints(blocks)]
    return Following(blocks.infos[0].trajectory, loop.period, loop.following_error, names)


def write_sheets(blocks: Blocks, folder: Path) -> list[Path]:
    """Electronic data sheets of all drives, ``node3.eds`` and so on."""
    profile, paths = bus_loop(blocks.settings).profile, []
    with blocks.about("loop"):
        joints = _joints(blocks)
    folder.mkdir(parents=True, exist_ok=True)
    for joint in joints:
        paths.append(folder / f"node{joint.node}.eds")
        drive_dictionary(profile, joint.node, joint).export_eds(paths[-1], joint.node)
    return paths


def _tune(arm: BusArm, blocks: Blocks) -> None:
    """Tune each drive's own loops for what it moves at the start, the other joints free (assumed).

    On an arm without rotor inertia the joints are so strongly coupled that this serves to stop, not for fine motion.
    """
    inertia = 1 / np.diag(np.linalg.inv(Dynamics(blocks.model).M(blocks.q0[0])))
    for drive, own in zip(arm.drives, inertia.tolist(), strict=True):
        drive.axis.inertia = own


def _joints(blocks: Blocks) -> tuple[Joint, ...]:
    return joints_for(blocks.settings.arm, joint_facts(blocks.model), bus_loop(blocks.settings).nodes)


def _speed(blocks: Blocks, loop: CanopenLoop) -> tuple[Any, Estimator]:
    return loop.velocity.build(blocks.q0, loop.period, blocks.timestep / NS_PER_S)
