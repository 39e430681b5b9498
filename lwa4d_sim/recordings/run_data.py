"""A recording from the record of a simulated run: what the arm did, or what was known on the controller's side."""

from typing import Any, Literal

import numpy as np

from lwa4d_sim.delays import ExponentialLatency, Latency, NormalLatency, TraceLatency, UniformLatency
from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.interfaces import NS_PER_S, Array, IntArray, to_ns
from lwa4d_sim.lateness import schedule_of
from lwa4d_sim.mjcf import joint_facts, load_model
from lwa4d_sim.record import RunLog
from lwa4d_sim.recordings.reading import Reading
from lwa4d_sim.recordings.recording import Recording
from lwa4d_sim.schema import Misfit, fit
from lwa4d_sim.settings import CanopenLoop, IdealLoop, SampledLoop, Settings

Signals = Literal["plant", "bus"]


def from_run(log: RunLog, signals: Signals, facts: Any = None) -> Recording:
    """What a run leaves to an identification.

    Args:
        log: its record.
        signals: plant = true positions and the torques that acted, at every plant step; bus = the encoders' samples
            that reached the controller, and the torques it asked for from when they should have acted. Over a CANopen
            bus these come from the frames, read as a log of a real bus is.
        facts: name, position limits and peak torque of each joint (`lwa4d_sim.mjcf.joint_facts`); default those of the
            model that the record names.

    Raises:
        IdentificationError: the record has no bus, does not tell when a sample was taken, or is of another version.
        ModelError: the model that the record names cannot be loaded.
    """
    source = f"run {log.name}, {log.variant}"
    try:
        settings = fit(log.scenario, Settings)
    except Misfit as error:
        raise IdentificationError(f"{source}: the record's settings do not fit this version: {error}") from error
    joints = joint_facts(load_model(settings.arm)) if facts is None else facts
    if len(joints) != log.q.shape[1]:
        raise IdentificationError(f"{source}: has {log.q.shape[1]} joints, the arm {len(joints)}")
    loop = settings.loop
    if signals == "plant":
        return _plant(log, settings, joints, source)
    if isinstance(loop, CanopenLoop):
        return _frames(log, settings, loop, joints, source)
    if isinstance(loop, IdealLoop):
        raise IdentificationError(f"{source}: an ideal loop has no bus; valid signals: plant")
    return _sampled(log, settings, loop, joints, source)


def _plant(log: RunLog, settings: Settings, facts: Any, source: str) -> Recording:
    t = np.repeat(log.t[:, None], log.q.shape[1], axis=1)
    none = np.zeros(log.q.shape[1])
    return Recording(
        joints=tuple(name for name, *_ in facts),
        t=t,
        q=log.q,
        since=t,
        tau=np.where(_braked(log)[:, None], np.nan, log.tau),
        position_step=none,
        torque_step=none,
        end=float(log.t[-1]),
        source=source,
        remarks=_forces(settings),
    )


def _frames(log: RunLog, settings: Settings, loop: CanopenLoop, facts: Any, source: str) -> Recording:
    from lwa4d_sim.bus.dictionary import drive_dictionary
    from lwa4d_sim.bus.frame_files import messages
    from lwa4d_sim.bus.joints import joints_for
    from lwa4d_sim.recordings.can_log import decode, plain

    if log.frames is None:
        raise IdentificationError(f"{source}: the record has no frames")
    joints = joints_for(settings.arm, facts, loop.nodes)
    sheets = {one.node: drive_dictionary(loop.profile, one.node, one).eds(one.node) for one in joints}
    frames = [plain(msg) for msg in messages(log.frames) if not (msg.is_extended_id or msg.is_remote_frame)]
    return decode(frames, sheets, joints, source, Reading(profile=loop.profile), _forces(settings))


def _sampled(log: RunLog, settings: Settings, loop: SampledLoop, facts: Any, source: str) -> Recording:
    n, ticks = log.q.shape[1], log.ticks
    schedule = schedule_of([settings])
    assert schedule.acts is not None  # but for a bus of frames the settings tell
    begin = np.rint((ticks.t - ticks.t[0]) * NS_PER_S).astype(np.int64)  # of each period [ns]
    try:
        sampled, arrived = _samples(log, loop, begin)
    except IdentificationError as error:
        raise IdentificationError(f"{source}: {error}") from error
    step = np.broadcast_to(np.asarray(loop.position_resolution, float), (n,))
    reading = _rounded(log.q[np.clip(sampled // log.timestep, 0, len(log.q) - 1), np.arange(n)], step)
    end = float(log.t[-1])
    since = np.minimum((begin[:, None] + np.broadcast_to(schedule.acts[0], (n,))) / NS_PER_S, end)
    grain = np.broadcast_to(np.asarray(loop.torque_resolution, float), (n,))
    tau = np.clip(_rounded(ticks.tau, grain), -log.tau_max, log.tau_max)
    remarks = list(_forces(settings))
    _, down = loop.transports
    if not isinstance(down.latency, (int, float, tuple)) or down.jitter or down.loss.probability:
        remarks.append(
            "commands were lost or came at random instants; the torques are those asked for, at the mean instant, and "
            "not all of them acted so"
        )
    lost = int((~arrived).any(axis=1).sum())
    if lost:
        remarks.append(f"{lost} of {len(arrived)} samples did not reach the controller, or it is not known when")
    return Recording(
        joints=tuple(name for name, *_ in facts),
        t=sampled / NS_PER_S,
        q=np.where(arrived, reading, np.nan),
        since=since,
        tau=np.where(_braked_between(log, since, end), np.nan, tau),
        position_step=step,
        torque_step=np.zeros(n),  # as rounded here the drive applies it
        end=end,
        source=source,
        remarks=tuple(remarks),
    )


def _samples(log: RunLog, loop: SampledLoop, begin: IntArray) -> tuple[IntArray, Any]:
    """Instants [ns] of the samples that the controller was to use, tick by tick, and whether each ever came, (K, n).

    The record has the age of the oldest datum of a tick only. Latencies that differ from joint to joint are known from
    the settings. Where each joint has its own luck, a tick in which one datum is old tells nothing of the others.

    Raises:
        IdentificationError: latencies that differ from joint to joint, and at random.
    """
    ticks, period, (up, _) = log.ticks, log.period, loop.transports
    n, phase, heard = log.q.shape[1], round(float(ticks.t[0]) * NS_PER_S), np.isfinite(ticks.age)
    if isinstance(up.latency, tuple):
        if up.jitter or up.loss.probability:
            raise IdentificationError(
                "the record does not tell which joint's sample was late; give one latency for all joints, or no jitter "
                "and loss of measurements"
            )
        latency = np.array([to_ns(one) for one in up.latency])
        sampled = begin[:, None] + (phase - latency) // period * period
        return sampled, heard[:, None] & (sampled >= 0)
    age = np.rint(np.where(heard, ticks.age, np.nan) * NS_PER_S)
    usual = phase - (phase - to_ns(_shortest(up.latency))) // period * period
    late = np.rint((age - usual) / period)
    seen = heard & ((late == 0) if up.per_joint else True)
    arrived = np.zeros(len(age), bool)
    arrived[(np.arange(len(age))[seen] - late[seen]).astype(int)] = True
    sampled = (begin + phase - usual)[:, None].repeat(n, axis=1)
    return sampled, arrived[:, None].repeat(n, axis=1)


def _shortest(latency: Latency) -> float:
    """The shortest transport time [s] that a law gives."""
    match latency:
        case UniformLatency(low=least) | ExponentialLatency(minimum=least):
            return least
        case TraceLatency(values=values):
            return min(values)
        case NormalLatency():
            return 0.0
        case _:
            assert isinstance(latency, (int, float))
            return float(latency)


def _rounded(x: Array, step: Array) -> Array:
    return np.where(step > 0, np.rint(x / np.where(step > 0, step, 1.0)) * step, x)


def _braked(log: RunLog) -> Any:
    """Whether the brakes held the arm in the plant step from each sample on, (T,)."""
    braked = np.zeros(len(log.q), bool)
    for t, text in log.events:
        if text in ("brakes closed", "brakes released"):
            braked[log.step_at(t) :] = text == "brakes closed"
    return braked


def _braked_between(log: RunLog, since: Array, end: float) -> Any:
    """Whether the brakes held the arm at any time from each instant (K, n) to the next of its joint."""
    before = np.concatenate([[0], np.cumsum(_braked(log))])
    edges = np.concatenate([since, np.full((1, since.shape[1]), end)]) * (NS_PER_S / log.timestep)
    first, last = np.floor(edges[:-1] + 1e-6).astype(int), np.ceil(edges[1:] - 1e-6).astype(int)
    return before[np.clip(last, 0, len(log.q))] > before[np.clip(first, 0, len(log.q))]


def _forces(settings: Settings) -> tuple[str, ...]:
    if not settings.plant.disturbances:
        return ()
    return ("outside forces acted on the arm, which the torques do not contain",)
