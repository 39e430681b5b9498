"""When a scenario's samples are taken and its torques act, as they do and as the controller believes."""

from typing import Any

import numpy as np

from lwa4d_sim.assembly import build_blocks
from lwa4d_sim.channels import Transport
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.estimators import kalman_gain
from lwa4d_sim.frame_log import FrameLog
from lwa4d_sim.interfaces import NS_PER_S, Array, Ns
from lwa4d_sim.lateness import horizons, schedule_of
from lwa4d_sim.observers import ObserverVelocity
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.settings import CanopenLoop, SampledLoop, Settings
from lwa4d_sim.stability.assist import Assist
from lwa4d_sim.stability.sampled import Instants

# A latency this close to a whole number of periods is that number; arrival at the very instant counts as arrived.
_SAME = 1e-9
_RPDO1 = 0x200  # base of its identifiers (CiA 301, 7.3.5); with both profiles it carries the torque
_CYCLES = 25  # of the simulated bus, to see when its set-points arrive (assumed; its timing repeats every cycle)


def instants_of(loop: SampledLoop, n: int, *, extra: float = 0.0) -> Instants:
    """Instants of a sampled loop; of a random latency the mean, of jitter the middle.

    Times are not rounded to plant steps, as a simulation's are.

    Args:
        loop: settings of a sampled loop.
        n: number of joints.
        extra: latency added to the commands [s].
    """
    up, down = loop.transports
    phase = up.usual_longest % loop.period if loop.phase is None else loop.phase
    arrives = _mean(up, n) - phase
    old = np.maximum(0, np.ceil(arrives / loop.period - _SAME)).astype(np.int64)
    acts = phase + _mean(down, n) + extra
    if loop.actuation == "next_sync":
        acts = (np.floor(acts / loop.period + _SAME) + 1.0) * loop.period
    return Instants(loop.period, old, acts)


def is_random(loop: Any) -> bool:
    """Whether the loop's delays vary, so that a constant one stands for them."""
    return isinstance(loop, SampledLoop) and any(
        bool(t.jitter) or bool(t.loss.probability) or not isinstance(t.latency, (int, float, tuple))
        for t in loop.transports
    )


def _mean(transport: Transport, n: int) -> Array:
    """Mean latency of each joint [s]."""
    latency = transport.latency
    if isinstance(latency, (int, float, tuple)):
        base = np.asarray(latency, float)
    elif hasattr(latency, "values"):
        base = np.asarray(np.mean(latency.values))
    else:  # every law draws; a million draws know the mean to a thousandth of the deviation
        base = np.asarray(latency.draw(np.random.default_rng(0), (1_000_000,)).mean())
    return np.broadcast_to(base + 0.5 * transport.jitter, (n,))


def bus_instants(loop: CanopenLoop, arrivals: Array, *, extra: float = 0.0) -> Instants:
    """Instants of a CANopen cycle whose torques arrive ``arrivals`` (n,) [s] after the SYNC.

    With ``next_sync`` all drives latch and act at the SYNC. With ``immediate`` each acts when its own frame has come:
    the joints' skew.
    """
    acts = arrivals + extra
    if loop.actuation == "next_sync":
        acts = (np.floor(acts / loop.period + _SAME) + 1.0) * loop.period
    return Instants(loop.period, np.zeros(len(arrivals), np.int64), acts)


def bus_arrivals(scenario: Scenario, variant: str) -> Array:
    """When each joint's torque arrives after the SYNC [s], (n,): the latest of some cycles on the simulated bus.

    Raises:
        ScenarioError: the loop cannot run.
    """
    from lwa4d_sim.bus.build import canopen_run  # half a second of imports

    blocks = build_blocks([scenario.changed({"loop.faults": []}, variant)], variant, 1)
    with blocks.about("loop"):
        simulation, ticks = canopen_run(blocks)
        for _ in zip(range(_CYCLES), ticks, strict=False):
            pass
    joints, period = simulation.master.plan.joints, blocks.timing.period
    late = np.zeros(len(joints))
    log = FrameLog.of(simulation.wire.frames)
    for j, joint in enumerate(joints):
        rows = (log.id == _RPDO1 + joint.node) & (log.queued >= 0) & (log.received >= 0)
        since = log.received[rows] - log.queued[rows] // period * period
        late[j] = since.max() / NS_PER_S if since.size else period / NS_PER_S
    return late


def assist_of(settings: Settings, n: int, phase: Ns) -> Assist | None:
    """Observers and predictor, with the instants that they believe in; None without any.

    Args:
        settings: of a loop with a bus.
        n: number of joints.
        phase: from a sample to the computation [ns].

    Raises:
        ScenarioError: nobody can know when commands act.
    """
    loop: Any = settings.loop
    compensation, velocity = settings.compensation, loop.velocity
    observed = isinstance(velocity, ObserverVelocity)
    if compensation is None and not observed:
        return None
    schedule, horizon = schedule_of([settings]), horizons([settings])
    if schedule.acts is None:
        raise ScenarioError(
            "has no linear model where each command acts when it arrives over the bus; use loop.actuation next_sync"
        )
    disturbance = None if compensation is None else compensation.disturbance_observer
    return Assist(
        acts=np.broadcast_to(schedule.acts[0] / NS_PER_S, (n,)),
        gain=kalman_gain(loop.period, velocity.acceleration, velocity.position) if observed else None,
        due=float(schedule.due(phase).min()) / NS_PER_S,
        horizon=None if horizon is None else float(horizon.min()) / NS_PER_S,
        bandwidth=None if disturbance is None else disturbance.bandwidth,
    )
