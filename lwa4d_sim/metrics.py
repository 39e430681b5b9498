"""Numbers from one run: how well it tracked, whether it shook, and what it asked of the drives."""

import math
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from lwa4d_sim.interfaces import NS_PER_S, Array

if TYPE_CHECKING:
    from lwa4d_sim.record import RunLog

# What counts as shaking, all assumed; docs/validation.md shows where they lie against the shipped scenarios.
SMOOTH_WINDOW = 0.4  # [s] motion that a cubic over this window follows is motion, the rest is vibration
VIBRATION_FLOOR = 0.02  # [rad/s] rms below which nobody would see or hear it
VIBRATION_SHARE = 0.1  # of the joint's rms speed: what a cubic misses of a fast but smooth motion stays below
VIBRATION_LIMIT = 0.4  # [rad/s] rms that is unstable in any case: the rated speed of the slow joints
RUNAWAY = 3.0  # [rad/s] more than twice the rated speed of the fastest joint
DECAY = 0.9  # a vibration that keeps more than this from one window to the next does not decay
_COARSE = 5_000_000  # [ns] 100 Hz is beyond any arm's motion
SETTLED = 0.02  # of the segment's distance: the usual 2 % band

#: name, unit and meaning of every metric, for reports and for the keys of `expect`
METRICS: dict[str, tuple[str, str]] = {
    "stable": ("", "no divergence and no vibration that fails to decay"),
    "stopped": ("", "the master on a CANopen bus stopped the arm"),
    "unstable_since": ("s", "onset of the instability, or none"),
    "diverged_at": ("s", "instant at which the motion left all bounds, or none"),
    "final_error": ("m", "distance of the tool from its reference at the end of each segment"),
    "max_error": ("m", "largest distance of the tool from its reference"),
    "rms_error": ("m", "root mean square of that distance"),
    "settling_time": ("s", "time after which the tool stays within 2 % of each segment's distance, or none"),
    "max_joint_error": ("rad", "largest joint error at the ticks, per joint"),
    "rms_joint_error": ("rad", "root mean square joint error at the ticks, per joint"),
    "velocity_error_rms": ("rad/s", "estimated minus true joint speed at the ticks, per joint"),
    "peak_torque": ("N m", "largest applied torque, per joint"),
    "torque_ripple": ("N m", "peak-to-peak applied torque in the last second, per joint"),
    "peak_speed": ("rad/s", "largest joint speed, per joint"),
    "vibration": ("rad/s", "rms joint speed faster than smooth motion at the end of each segment, worst joint"),
    "saturation_fraction": ("", "share of joint-steps at the torque limit"),
    "data_age_max": ("s", "largest age of the data the controller used"),
    "deviation": ("m", "largest distance of the tool from the variant `ideal`, per segment (when there is one)"),
}

FLAGS = ("stable", "stopped")  # those that are true or false


def metrics(log: "RunLog") -> dict[str, Any]:
    """All metrics of one run; lists have an entry per segment or joint. Never NaN: what does not exist is None.

    A run that diverged is measured up to that instant.
    """
    vibration, since = vibrations(log)
    x, x_ref = log.x, log.x_ref
    goals = [_left_limit(x_ref, end) if end < len(x) else None for _, end in _segments(log)]
    x_ref -= x  # in place: the paths are a tenth of a long record each
    error = np.sqrt(np.einsum("ij,ij->i", x_ref, x_ref))
    del x_ref
    final = [
        None if goal is None else float(np.linalg.norm(x[end] - goal))
        for goal, (_, end) in zip(goals, _segments(log), strict=True)
    ]
    ticks = log.ticks
    peak = _peaks(log.tau)
    joint_error = ticks.q_ref - ticks.q_true
    known = ~np.isnan(ticks.dq).any(axis=1)
    diverged = log.diverged_at
    values: dict[str, Any] = {
        "stable": diverged is None and since is None,
        "stopped": log.stopped is not None,
        "unstable_since": since if since is not None else diverged,
        "diverged_at": diverged,
        "final_error": final,
        "max_error": max([float(error.max()), *(e for e in final if e is not None)]),
        "rms_error": _rms(error),
        "settling_time": _settling(log, x, goals),
        "max_joint_error": _per_joint(np.abs(joint_error), np.max),
        "rms_joint_error": _per_joint(joint_error**2, np.mean, np.sqrt),
        "velocity_error_rms": _per_joint((ticks.dq - ticks.dq_true)[known] ** 2, np.mean, np.sqrt),
        "peak_torque": peak,
        "torque_ripple": _per_joint(_last_second(log), np.ptp),
        "peak_speed": _peaks(log.dq),
        "vibration": vibration,
        "saturation_fraction": _saturation(log, peak),
        "data_age_max": _largest(ticks.age),
    }
    return {key: _finite(value) for key, value in values.items()}


def deviation(log: "RunLog", other: "RunLog") -> list[float | None]:
    """Largest distance [m] between the tool paths of two runs of one motion, per segment; None beyond either's end."""
    n = min(len(log.q), len(other.q))
    distance = np.linalg.norm(log.x[:n] - other.x[:n], axis=1)
    out: list[float | None] = []
    for start, end in _segments(log):
        out.append(float(distance[start : end + 1].max()) if end < n else None)
    return out


def _finite(value: Any) -> Any:
    """The value, with None for numbers that do not exist."""
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _largest(values: Array) -> float | None:
    """Largest of the values that are not NaN."""
    known = values[~np.isnan(values)]
    return float(known.max()) if known.size else None


def _segments(log: "RunLog") -> list[tuple[int, int]]:
    ends = [log.step_at(end) for end in log.knots]
    return list(zip([0, *ends[:-1]], ends, strict=True))


def _left_limit(x_ref: Array, end: int) -> Array:
    """The reference just before sample ``end``: a step reference jumps at the knot itself, a moving one goes on."""
    last: Array = x_ref[max(0, end - 1)].copy()
    if end > 1:
        last += last - x_ref[end - 2]
    return last


def _settling(log: "RunLog", x: Array, goals: list[Array | None]) -> list[float | None]:
    """Per segment, the time from its start after which the tool stays in the band around the segment's end point."""
    out: list[float | None] = []
    for goal, (start, end) in zip(goals, _segments(log), strict=True):
        if goal is None:
            out.append(None)
            continue
        distance = np.linalg.norm(x[start : end + 1] - goal, axis=1)
        band = SETTLED * float(distance[0])
        outside = np.flatnonzero(distance > band)
        if outside.size == 0:
            out.append(0.0)
        elif outside[-1] == end - start:
            out.append(None)
        else:
            k = int(outside[-1])
            share = (distance[k] - band) / (distance[k] - distance[k + 1])
            out.append(float((k + share) * log.timestep / NS_PER_S))
    return out


def vibrations(log: "RunLog") -> tuple[list[float | None], float | None]:
    """Vibration at the end of each segment [rad/s], worst joint, and the onset of instability [s] or None.

    Vibration is what a cubic fitted over `SMOOTH_WINDOW` (Savitzky and Golay 1964) leaves of the joint speed; a segment
    of less than a second has none that could be told from motion. A segment is unstable when, in its last second (or
    quarter), the vibration is above the floor, a good share of the speed, and has not decayed against the stretch
    before, or is above the limit anyway. The onset is the start of the stretch in which the running rms stays above the
    floor; where a run diverges too soon for that, of the stretch in which some joint is too fast for any drive.
    """
    # half a control period resolves every frequency a sampled loop can have; the ideal loop has none of its own
    finest = log.period // 2 if log.period > log.timestep else _COARSE
    stride = max(1, min(finest, _COARSE) // log.timestep)
    h = stride * log.timestep / NS_PER_S
    half = max(2, round(0.5 * SMOOTH_WINDOW / h))
    coarse = log.dq[::stride]
    signal = vibrating(coarse, half)
    power = (signal**2).max(axis=1)
    values: list[float | None] = []
    since: float | None = None
    for start, end in _segments(log):
        if end >= len(log.dq):
            values.append(None)
            if since is None and log.diverged_at is not None and start < len(log.dq):
                # as in a whole segment, so that it does not matter whether a shaking run just stays within bounds
                a, b = start // stride, len(power) - half
                k = _onset(power[a:b], b - a, h) if b > half else None
                since = (a + k) * h if k is not None else _runaway(log, start)
            continue
        # the fit looks half a window ahead and must not see the next segment's jump
        a, b = start // stride, end // stride - half
        if b - a < 4 * half:
            values.append(None)
            continue
        window = max(2, min(round(1.0 / h), (b - a) // 4))
        # per joint, so that a mode moving from one joint to another is not mistaken for decay
        before = np.sqrt(np.mean(signal[b - 2 * window : b - window] ** 2, axis=0))
        now = np.sqrt(np.mean(signal[b - window : b] ** 2, axis=0))
        values.append(float(now.max()))
        speed = np.sqrt(np.mean(coarse[b - window : b] ** 2, axis=0))
        lasting = (now > VIBRATION_FLOOR) & (now > VIBRATION_SHARE * speed) & (now > DECAY * before)
        shaking = lasting | (now > VIBRATION_LIMIT)
        if shaking.any() and since is None:
            since = (a + (_onset(power[a:b], window, h) or 0)) * h
    return values, since


def _runaway(log: "RunLog", start: int) -> float:
    """Instant [s] from which, to its end, a diverged run has a joint faster than `RUNAWAY`."""
    slow = np.flatnonzero(np.abs(log.dq[start:]).max(axis=1) < RUNAWAY)
    return (start + (int(slow[-1]) + 1 if slow.size else 0)) * log.timestep / NS_PER_S


def _onset(power: Array, window: int, h: float) -> int | None:
    """First index after which the running mean of ``power`` stays above the floor to the end; None if it does not."""
    width = max(1, min(round(0.2 / h), window))
    if len(power) < width:
        return None
    running = np.convolve(power, np.full(width, 1.0 / width), mode="valid")
    below = np.flatnonzero(running < VIBRATION_FLOOR**2)
    first = int(below[-1]) + 1 if below.size else 0
    return first if first < len(running) else None


def vibrating(signal: Array, half: int) -> Array:
    """``signal`` (T, n) minus its cubic fit over 2 half + 1 samples; beyond the ends the end values go on."""
    if len(signal) <= 2 * half:
        return np.asarray(signal - signal.mean(axis=0))
    padded = np.concatenate([np.repeat(signal[:1], half, 0), signal, np.repeat(signal[-1:], half, 0)])
    kernel = _smoothing_kernel(half)
    smooth = np.stack([np.convolve(column, kernel, mode="valid") for column in padded.T], axis=1)
    return np.asarray(signal - smooth)


@lru_cache(maxsize=8)
def _smoothing_kernel(half: int) -> Array:
    """Weights of the value at the centre of a cubic least-squares fit over 2 half + 1 samples."""
    u = np.arange(-half, half + 1) / half
    kernel: Array = np.linalg.pinv(np.vander(u, 4, increasing=True))[0]
    return kernel


def _rms(values: Array) -> float:
    return math.sqrt(float(np.mean(values**2)))


def _saturation(log: "RunLog", peak: list[float]) -> float:
    """Share of joint-steps at the torque limit; most runs never reach it, and need no second look at every step."""
    if (np.asarray(peak) < log.tau_max).all():
        return 0.0
    return float(np.mean((log.tau >= log.tau_max) | (log.tau <= -log.tau_max)))


def _last_second(log: "RunLog") -> Array:
    """Applied torque in the last second; the ideal loop's, which belongs to the steps' middles, moved to their ends."""
    end = max(1, len(log.tau) - 1)  # the last row only repeats the one before
    start = max(0, end - round(NS_PER_S / log.timestep))
    tail: Array = log.tau[start:end]
    if log.period == log.timestep and start > 0:
        last = 1.5 * log.tau[end - 1] - 0.5 * log.tau[end - 2]
        tail = np.vstack([0.5 * (tail + log.tau[start - 1 : end - 1]), last])
    return tail


def _peaks(values: Array) -> list[float]:
    """Largest magnitude of each column, without a copy of the whole record."""
    peaks: list[float] = np.abs(np.maximum(values.max(axis=0), -values.min(axis=0))).tolist()  # abs: no -0.0
    return peaks


def _per_joint(values: Array, reduce: Any, then: Any = None) -> list[float] | None:
    if not len(values):
        return None
    out = reduce(values, axis=0)
    result: list[float] = (out if then is None else then(out)).tolist()
    return result
