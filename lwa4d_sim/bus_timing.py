"""What one cycle on the bus looks like: time line, load, and response times beside their worst case."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lwa4d_sim.bus.response import Stream, response_times
from lwa4d_sim.frame_log import OUTCOMES, FrameLog
from lwa4d_sim.interfaces import NS_PER_S, Array, IntArray, Ns


@dataclass(frozen=True, slots=True, eq=False)
class Responses:
    """Response times of one identifier, from queued to received.

    Attributes:
        id: CAN identifier.
        name: what the predefined connection set calls it.
        seen: observed times [s] (frames,).
        bound: worst case [s] on a bus without errors (Davis, Burns, Bril and Lukkien 2007); inf when there is none.
    """

    id: int
    name: str
    seen: Array
    bound: float


@dataclass(frozen=True, slots=True, eq=False)
class BusTiming:
    """Timing of a run.

    Attributes:
        cycle: rows of the frames of one cycle in the log.
        end: of each of these frames [ns]; of one that failed, when the wire is free again.
        start: beginning of that cycle [ns].
        load: share of the time at which the wire was busy.
        responses: one for each identifier, most urgent first.
    """

    log: FrameLog
    cycle: IntArray
    end: IntArray
    start: Ns
    load: float
    responses: list[Responses]


def name_of(can_id: int) -> str:
    """What an 11-bit identifier means in CANopen's predefined connection set (CiA 301, 7.3.5)."""
    kinds = {0x000: "NMT", 0x080: "SYNC"}
    if can_id in kinds:
        return kinds[can_id]
    bases = {0x080: "EMCY", 0x180: "TPDO1", 0x200: "RPDO1", 0x280: "TPDO2", 0x300: "RPDO2", 0x380: "TPDO3"}
    bases |= {0x400: "RPDO3", 0x480: "TPDO4", 0x500: "RPDO4", 0x580: "SDO answer", 0x600: "SDO request"}
    bases |= {0x700: "heartbeat"}
    base = can_id & 0x780
    return f"{bases[base]} {can_id & 0x7F}" if base in bases else "other"


def analyse(log: FrameLog, bit_rate: int, period: Ns, cycles: int) -> BusTiming:
    """Timing of the cycles from 0 on.

    Args:
        log: frames of the run.
        bit_rate: [bit/s].
        period: SYNC period [ns].
        cycles: number of cycles run.
    """
    end = cycles * period
    inside = (log.queued >= 0) & (log.started < end)
    free = _free(log, bit_rate)
    load = float((free - log.started)[inside].sum()) / end
    received = inside & (log.received >= 0) & (log.outcome == 0)
    streams, seen = [], []
    for can_id in np.unique(log.id[received & ~log.extended]).tolist():
        rows = np.flatnonzero(received & (log.id == can_id) & ~log.extended)
        queued = log.queued[rows]
        seen.append((can_id, (log.received[rows] - queued) / NS_PER_S))
        # between two frames of one identifier lies at least a period less what its release wanders
        gaps = np.diff(queued)
        regular = int(np.median(gaps)) if gaps.size else end
        regular = max(period, round(regular / period) * period)
        wander = queued - regular * np.round((queued - queued[0]) / regular).astype(np.int64)
        jitter = int(wander.max() - wander.min())
        streams.append(Stream(can_id=can_id, period=Ns(regular), dlc=int(log.size[rows].max()), jitter=Ns(jitter)))
    bounds = {found.stream.can_id: found.reception - found.stream.jitter for found in response_times(streams, bit_rate)}
    k = max(0, cycles - 2)
    cycle = np.flatnonzero((log.started >= k * period) & (log.started < (k + 1) * period))
    responses = [Responses(can_id, name_of(can_id), times, bounds[can_id] / NS_PER_S) for can_id, times in seen]
    ends = np.where(log.outcome == 0, log.received, free)[cycle]
    return BusTiming(log, cycle, ends, Ns(k * period), load, responses)


def _free(log: FrameLog, bit_rate: int) -> IntArray:
    """When the wire is free after each transmission [ns].

    A spoilt frame is not sent to its end: behind its error frame comes a repetition.
    """
    free = log.started.copy()  # what was given up was not on the wire
    rows = np.flatnonzero(log.outcome != OUTCOMES.index("discarded"))
    whole = log.started[rows] + log.bits[rows] * NS_PER_S // bit_rate
    free[rows] = np.minimum(whole, np.append(log.started[rows][1:], whole[-1:]))
    return free


def as_object(timing: BusTiming) -> dict[str, Any]:
    """For JSON: the frames of the cycle [s from its start], the load, and by identifier the longest response [s]."""
    log = timing.log
    frames = [
        {
            "id": int(log.id[k]),
            "bits": int(log.bits[k]),
            "start": (int(log.started[k]) - timing.start) / NS_PER_S,
            "end": (int(end) - timing.start) / NS_PER_S,
            "outcome": OUTCOMES[log.outcome[k]],
        }
        for k, end in zip(timing.cycle, timing.end, strict=True)
    ]
    response = {
        str(r.id): {"max": float(r.seen.max()), "bound": r.bound if np.isfinite(r.bound) else None}
        for r in timing.responses
    }
    return {"frames": frames, "load": timing.load, "response": response}


def as_text(timing: BusTiming) -> str:
    """For a terminal."""
    log = timing.log
    lines = [f"{'frame':16} {'bits':>5} {'start [ms]':>11} {'end [ms]':>9}"]
    for k, until in zip(timing.cycle, timing.end, strict=True):
        start, end = ((int(t) - timing.start) / 1e6 for t in (log.started[k], until))
        name = f"{int(log.id[k]):03X} {name_of(int(log.id[k]))}"
        failed = f"  {OUTCOMES[log.outcome[k]]}" if log.outcome[k] else ""
        lines.append(f"{name:16} {int(log.bits[k]):5} {start:11.3f} {end:9.3f}{failed}")
    lines += ["", f"{'identifier':16} {'frames':>7} {'longest [ms]':>13} {'worst case [ms]':>16}"]
    for r in timing.responses:
        bound = f"{r.bound * 1e3:.3f}" if np.isfinite(r.bound) else "none"
        lines.append(f"{r.name:16} {len(r.seen):7} {r.seen.max() * 1e3:13.3f} {bound:>16}")
    return "\n".join([*lines, "", f"bus load {100 * timing.load:.1f} %"])
