"""What a drive knows about its joint, from the arm's own numbers."""

import math
from collections.abc import Sequence

from lwa4d_sim.arm import ARMS, MODULES
from lwa4d_sim.bus.dictionary import Joint
from lwa4d_sim.bus.options import FIRST_NODE
from lwa4d_sim.errors import BusError, ScenarioError

# [rad/s^2], schunk_lwa4d, config/arm_cartesian_controller.yaml ("taken from MTS"), joint 1 to 7
ACCELERATION = (2.79, 2.79, 2.65, 2.65, 2.79, 8.73, 8.73)
# [N m/A] at the joint, identified on ERB modules (OTFCtrlModRob, init_SchunkModDB.m); assumed for the others
TORQUE_CONSTANT = 10.0
# For an arm that is not the LWA4D (assumed).
OTHER_SPEED, OTHER_ACCELERATION = math.pi, 10.0


Facts = Sequence[tuple[str, tuple[float, float] | None, float]]


def joints_for(arm: str, facts: Facts, nodes: Sequence[int] | None = None) -> tuple[Joint, ...]:
    """Constants of each joint of an arm.

    Args:
        arm: name of a shipped arm, or anything else.
        facts: name, position limits [rad] or None, and peak torque [N m] of each joint.
        nodes: node id of each joint; default the real arm's, for another arm 3 and up.

    Raises:
        ScenarioError: not one node a joint.
        BusError: a joint without a torque limit, in whose per mille the drive could count.
    """
    numbers = [link.joint for link in ARMS[arm].links] if arm in ARMS else None
    if nodes is not None and (len(nodes) != len(facts) or len(set(nodes)) != len(nodes)):
        raise ScenarioError(f"must be {len(facts)} different node ids, one for each joint", key="loop.nodes")
    made = []
    for k, (name, limits, peak) in enumerate(facts):
        if not math.isfinite(peak):
            raise BusError(f"joint '{name}' has no torque limit (ctrlrange), so a drive cannot count its torque")
        module = numbers[k] - 1 if numbers is not None else None
        low, high = limits if limits is not None else (None, None)
        made.append(
            Joint(
                name=name,
                low=low,
                high=high,
                speed=MODULES[module].velocity_max if module is not None else OTHER_SPEED,
                acceleration=ACCELERATION[module] if module is not None else OTHER_ACCELERATION,
                torque=peak,
                torque_constant=TORQUE_CONSTANT,
                node=nodes[k] if nodes is not None else FIRST_NODE + (k if module is None else module),
            )
        )
    return tuple(made)
