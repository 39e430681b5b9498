"""Builds what a scenario needs on a bus: both sides on the simulated wire, or one of them on a real one."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from lwa4d_sim.assembly import Blocks
from lwa4d_sim.bus.arm import BusArm
from lwa4d_sim.bus.connect import Connection
from lwa4d_sim.bus.dictionary import Joint
from lwa4d_sim.bus.joints import joints_for
from lwa4d_sim.bus.master import Master, Plan
from lwa4d_sim.bus.options import FIRST_NODE
from lwa4d_sim.bus.safety import Envelope
from lwa4d_sim.bus.session import Session
from lwa4d_sim.bus.simulation import STARTUP, Simulation, add_traffic
from lwa4d_sim.bus.wire import BitErrors, Wire
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


def plan_for(blocks: Blocks, loop: CanopenLoop, *, enable: bool = True) -> Plan:
    """What the master is to set up."""
    period = to_ns(loop.period)
    return Plan(
        profile=loop.profile,
        joints=_joints(blocks),
        period=period,
        immediate=loop.actuation == "immediate",
        heartbeat=round(loop.heartbeat * 1000),
        deadline=to_ns(loop.deadline) if loop.deadline is not None else Ns(period // 2),
        enable=enable,
    )


def canopen_run(blocks: Blocks) -> tuple[Simulation, Iterator[Tick]]:
    """Both sides over the simulated wire: the simulation and its running loop, one tick a period."""
    loop = bus_loop(blocks.settings)
    source, estimator = _speed(blocks, loop)
    errors = BitErrors(probability=loop.noise.per_bit) if loop.noise.per_bit else None
    seed = blocks.infos[0].seed
    wire = Wire(loop.bit_rate, start=STARTUP, errors=errors, seed=seed, record=True)
    add_traffic(wire, loop.traffic)
    plan = plan_for(blocks, loop)
    simulation = Simulation(wire, blocks.plant, plan.joints, loop.profile, source)
    control = blocks.control(estimator)
    return simulation, simulation.run(plan, control, blocks.timing, with_speed=source is not None)


def served_arm(blocks: Blocks, bus: Connection, *, epoch: Ns, per_sync: bool) -> BusArm:
    """The arm side on a bus."""
    loop = bus_loop(blocks.settings)
    source, _ = _speed(blocks, loop)
    step = to_ns(loop.period) if per_sync else None
    return BusArm(blocks.plant, _joints(blocks), FIRST_NODE, loop.profile, source, lambda node: bus.send, epoch, step)


def driving_session(
    blocks: Blocks, bus: Connection, clock: Callable[[], Ns], *, enable: bool
) -> tuple[Master, Session]:
    """The controller side on a bus, behind the safety envelope."""
    loop = bus_loop(blocks.settings)
    source, estimator = _speed(blocks, loop)
    plan = plan_for(blocks, loop, enable=enable)
    master = Master(bus, clock, plan)
    control = blocks.control(estimator)
    return master, Session(master, control, with_speed=source is not None, guard=Envelope(plan.joints))


def _joints(blocks: Blocks) -> tuple[Joint, ...]:
    return joints_for(blocks.settings.arm, joint_facts(blocks.model))


def _speed(blocks: Blocks, loop: CanopenLoop) -> tuple[Any, Estimator]:
    return loop.velocity.build(blocks.q0, loop.period, blocks.timestep / NS_PER_S)
