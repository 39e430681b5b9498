"""Refuses what a bus cannot carry before anything starts: too short a period, too low a bit rate, a sender too many."""

from collections.abc import Iterable

from lwa4d_sim.bus.commission import interpolation_period
from lwa4d_sim.bus.master import MASTER_NODE, Plan
from lwa4d_sim.bus.options import Traffic
from lwa4d_sim.bus.response import Stream, utilisation
from lwa4d_sim.bus.stations import LAYOUTS
from lwa4d_sim.bus.watch import HEARTBEATS, SYNC
from lwa4d_sim.errors import BusError, ScenarioError
from lwa4d_sim.interfaces import NS_PER_S, Ns, to_ns

SPORADIC = (0x080, 0x580, 0x600)  # EMCY, SDO answer and request: CiA 301, predefined connection set
MEASURED = "SYNC and measurements"  # frames that must be there by the deadline


def check_bus(plan: Plan, bit_rate: int | None, traffic: Iterable[Traffic]) -> None:
    """Whether every frame finds its place.

    Args:
        plan: what the master is to set up.
        bit_rate: [bit/s], None when frames take no time.
        traffic: frames of other stations.

    Raises:
        ScenarioError: with figures.
    """
    try:
        interpolation_period(plan.period)
    except BusError as error:
        raise ScenarioError(str(error), "loop.period") from error
    if plan.deadline >= plan.period:
        raise ScenarioError(f"must be below the period of {plan.period / NS_PER_S:g} s", "loop.deadline")
    patience = HEARTBEATS * plan.heartbeat * 1_000_000
    if 0 < patience <= plan.period:
        raise ScenarioError(
            f"the master sends one a cycle at most, and a drive waits for {HEARTBEATS} of these times: "
            f"must be 0 or above {plan.period / HEARTBEATS / NS_PER_S:.4g} s",
            "loop.heartbeat",
        )
    mine, others = arm_streams(plan), [Stream(can_id=one.id, period=to_ns(one.period), dlc=one.size) for one in traffic]
    # EMCY and SDO have no period, but their identifiers are taken too
    seen = {stream.can_id for stream in mine} | {base + joint.node for joint in plan.joints for base in SPORADIC}
    for i, stream in enumerate(others):
        if stream.can_id in seen:
            raise ScenarioError(f"identifier 0x{stream.can_id:03X} has a sender already", f"loop.traffic.{i}.id")
        seen.add(stream.can_id)
    if bit_rate is None:
        return
    load = utilisation([*mine, *others], bit_rate)
    if load > 1:
        raise ScenarioError(
            f"{len(plan.joints)} drives every {plan.period / 1e6:g} ms take up to {100 * load:.0f} % of the bus at "
            f"{bit_rate} bit/s; at least {1000 * -(-load * bit_rate // 1000):.0f} bit/s, or a longer period",
            "loop.bit_rate",
        )
    needed = sum(stream.longest for stream in mine if stream.name == MEASURED) * NS_PER_S // bit_rate
    if needed > plan.deadline:
        raise ScenarioError(
            f"SYNC and measurements of {len(plan.joints)} drives take up to {needed / 1e6:.1f} ms at {bit_rate} bit/s, "
            f"and the controller waits for {plan.deadline / 1e6:g} ms only",
            "loop.deadline",
        )


def arm_streams(plan: Plan) -> list[Stream]:
    """What master and drives send."""
    layout, streams = LAYOUTS[plan.profile], [Stream(can_id=SYNC, period=plan.period, dlc=0, name=MEASURED)]
    for joint in plan.joints:
        node = joint.node
        for base, name, pdos in ((0x180, MEASURED, layout.transmit), (0x200, "set-points", layout.receive)):
            for i, items in enumerate(pdos):
                size = sum(bits for _, _, bits, _ in items) // 8
                streams.append(Stream(can_id=base + 0x100 * i + node, period=plan.period, dlc=size, name=name))
    if plan.heartbeat:
        beat = Ns(plan.heartbeat * 1_000_000)
        nodes = [MASTER_NODE, *(joint.node for joint in plan.joints)]
        streams += [Stream(can_id=0x700 + node, period=beat, dlc=1) for node in nodes]
    return streams
