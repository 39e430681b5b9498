"""What runs must have in common to be stepped together: one loop and one clock drive them all."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from lwa4d_sim.compensation import Compensation
from lwa4d_sim.controllers import CustomController
from lwa4d_sim.interfaces import Ns, to_ns
from lwa4d_sim.settings import CanopenLoop, SampledLoop, Settings
from lwa4d_sim.trajectories import FourierMotion, WaypointMotion


def natural_phase(loop: SampledLoop, timestep: Ns) -> Ns:
    """From a sample to the computation [ns], on the plant's grid; with a long latency it may exceed the period."""
    seconds = loop.transports[0].usual_longest if loop.phase is None else loop.phase
    return Ns(-(-to_ns(seconds) // timestep) * timestep)


def common(settings: Settings) -> Mapping[str, Any]:
    """By key, what all members of a batch must share.

    Transport may differ, for every member has a queue of its own, as long as all controllers compute at the same
    instant; so may resolutions.
    """
    plant, loop = settings.plant, settings.loop
    shared: dict[str, Any] = {
        "arm": settings.arm,
        "loop": loop,
        "plant.timestep": plant.timestep,
        "plant.integrator": plant.integrator,
        "plant.disturbances": plant.disturbances,
        "compensation": _switches(settings.compensation),
        "controller.model.arm": settings.controller.model.arm,
        "controller.schedule": getattr(settings.controller, "schedule", None),
    }
    if isinstance(loop, SampledLoop):
        shared["loop"] = replace(
            loop,
            latency=0.0,
            jitter=0.0,
            loss=0.0,
            per_joint=False,
            phase=None,
            position_resolution=0.0,
            torque_resolution=0.0,
        )
        timestep, period = to_ns(plant.timestep), to_ns(loop.period)
        shared["loop.phase"] = natural_phase(loop, timestep) % period if timestep and period else 0
    return shared


def _switches(compensation: Compensation | None) -> tuple[bool, bool]:
    """Which blocks are on; their parameters may differ."""
    blocks = compensation or Compensation()
    return blocks.predictor is not None, blocks.disturbance_observer is not None


def group(settings: Settings, run: int) -> str:
    """Runs of the same group may be stepped together; ``run`` tells apart those that never can.

    Beside what `common` names these are the things a batch refuses: another length, another law, another model's shape.
    """
    if isinstance(settings.loop, CanopenLoop):
        return f"run {run}"
    motion, law = settings.trajectory, settings.controller
    if isinstance(motion, WaypointMotion):
        timing: Any = (motion.segment_time, len(motion.waypoints.points))
    elif isinstance(motion, FourierMotion):
        timing = (motion.lead_in, motion.duration, motion.lead_out)
    else:
        timing = motion
    plain = ("payload", "friction", "armature")
    shape = [getattr(arm, name) is None for arm in (settings.plant, law.model) for name in plain]
    own = law if isinstance(law, CustomController) else (type(law).__name__, law.space)
    closed = law.model if law.model.dynamics == "closed_form" else None
    return repr((dict(common(settings)), type(motion).__name__, timing, shape, own, closed))


def pace(settings: Settings) -> tuple[float, float]:
    """Runs of the same pace cost least together: where arrivals differ, a period is stepped in pieces."""
    loop = settings.loop
    if not isinstance(loop, SampledLoop):
        return 0.0, 0.0
    up, down = loop.transports
    return down.usual_longest, up.usual_longest
