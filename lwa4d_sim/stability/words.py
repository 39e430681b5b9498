"""What the margins mean, in words."""

from collections.abc import Sequence

import numpy as np

from lwa4d_sim.interfaces import Array
from lwa4d_sim.stability.analysis import PointStability
from lwa4d_sim.stability.findings import STILL, Findings

_NAMED = 0.5  # a joint that moves at least this share of the largest is named (assumed)


def unstable(point: PointStability) -> bool:
    """Whether a disturbance grows there."""
    return point.spectral_radius > 1.0 + STILL


def radius(value: float) -> str:
    """A spectral radius with as many digits as tell it from 1."""
    short = f"{value:.4f}"
    return short if float(short) != 1.0 else f"{value:.7f}"


def headline(found: Findings) -> str:
    """The verdict in one or two sentences."""
    bad = [k for k, point in enumerate(found.points) if unstable(point)]
    if not bad:
        return _stable(found)
    worst = max(bad, key=lambda k: found.points[k].spectral_radius)
    names = _joined([found.names[k] for k in bad])
    if len(bad) == len(found.points) > 1:
        head = "The loop is unstable everywhere looked at, worst"
    elif len(bad) > 1:
        head = f"The loop is unstable at {names}, worst"
    else:
        return _upper(f"at {names} the loop is unstable: {_worst(found, worst)}")
    return f"{head} at {found.names[worst]}: {_worst(found, worst)}"


def _worst(found: Findings, k: int) -> str:
    point = found.points[k]
    if point.gain_margin == 0:
        return f"{_grows(point)}, and no factor on the gains helps."
    if point.gain_margin > 1:
        return f"{_grows(point)}. These gains are too weak: it takes {factor(point.gain_margin)} times as much."
    shakes = f"{moves(point.mode.share)} at {point.mode.frequency:.1f} Hz"
    return f"{_grows(point)}. The limit there is {factor(point.gain_margin)} times these gains, where {shakes}."


def _grows(point: PointStability) -> str:
    if not np.isfinite(point.spectral_radius):
        return "a disturbance grows at once beyond all bounds"
    return f"a disturbance grows by {100 * (point.spectral_radius - 1):.2g} % from tick to tick"


def _stable(found: Findings) -> str:
    n = len(found.points)
    where = f"at {found.names[0]}" if n == 1 else f"at {'both' if n == 2 else f'all {n}'} {_kind(found)}"
    head = f"The loop is stable {where}."
    k = min(range(n), key=lambda k: (found.points[k].gain_margin, found.points[k].delay_margin))
    point = found.points[k]
    tightest = "There" if n == 1 else f"Tightest is {found.names[k]}: there"
    can = []
    if np.isfinite(point.gain_margin):
        shakes = f"{moves(point.mode.share)} at {point.mode.frequency:.1f} Hz"
        can.append(f"all gains may be {factor(point.gain_margin)} times as large before {shakes}")
    if np.isfinite(point.delay_margin):
        can.append(f"commands may come {milliseconds(point.delay_margin)} ms later")
    if not can:
        return f"{head} No limit of the gains or of the delay was found."
    return f"{head} {tightest} {', or '.join(can)}."


def details(found: Findings) -> list[str]:
    """Sentences on the delay's margins, the motion, and the workspace."""
    out = []
    jitter = np.array([point.jitter_margin for point in found.points])
    if np.isfinite(jitter).all() and jitter.min() > 0:
        k = int(jitter.argmin())
        out.append(
            f"However the delay varies, the loop stays stable as long as no command comes more than "
            f"{milliseconds(float(jitter[k]))} ms late ({found.names[k]})."
        )
    if found.charts is None:
        return out
    course = found.charts.course
    t, margin = course.t[course.worst], course.gain_margin[course.worst]
    if np.isfinite(margin) and margin > 1 and course.spectral_radius[course.worst] > 1 + STILL:
        out.append(
            f"Along the motion these gains are too weak at {t:.2f} s: it takes {factor(float(margin))} times as much."
        )
    elif np.isfinite(margin):
        out.append(
            f"Along the motion the gains are nearest to their limit at {t:.2f} s: there it is {factor(float(margin))} "
            "times these gains."
        )
    if course.floquet is not None:
        grows = "grows" if course.floquet > 1 else "shrinks"
        out.append(
            f"Over a whole cycle of the motion a disturbance {grows} by {100 * abs(course.floquet - 1):.2g} % "
            "a control period on average."
        )
    if found.charts.map is not None:
        margins = found.charts.map.gain_margin
        part = f"{100 * found.charts.map_stable.mean():.0f} %"
        text = f"In the slice of the workspace on the map these gains are stable in {part} of the poses"
        least = float(margins.min())
        limit = f"the smallest limit is {factor(least)} times these gains"
        if np.isinf(least):
            limit = "no gains are too large"
        elif least == 0:
            limit = "in some no factor on the gains helps"
        out.append(f"{text}; {limit}.")
    return out


def moves(share: Array) -> str:
    """Who shakes: the joint that moves most, and others that move much."""
    order = np.argsort(-share)
    names = [str(j + 1) for j in order if share[j] >= _NAMED]
    return f"joint {names[0]} shakes" if len(names) == 1 else f"joints {_and(names)} shake"


def factor(value: float) -> str:
    """A factor on the gains."""
    return "any" if np.isinf(value) else "none" if value == 0 else f"{value:#.3g}" if value < 100 else f"{value:.0f}"


def milliseconds(value: float) -> str:
    """A time [s] in ms; empty for what is not known."""
    return "any" if np.isinf(value) else "" if np.isnan(value) else f"{1e3 * value:.1f}"


def _kind(found: Findings) -> str:
    word = found.names[0].split(" ")[0]
    return "instants looked at" if word == "t" else f"{word}s"


def _joined(names: Sequence[str]) -> str:
    """`waypoints 3 and 4`."""
    words = [name.rsplit(" ", 1) for name in names]
    if len(names) == 1 or "=" in names[0]:
        return _and(names)
    return f"{words[0][0]}s {_and([word[1] for word in words])}"


def _and(parts: Sequence[str]) -> str:
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def _upper(text: str) -> str:
    return text[:1].upper() + text[1:]
