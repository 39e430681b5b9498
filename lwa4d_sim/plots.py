"""The figures of a run, in the layout of the thesis (chapter 5): all variants of a scenario in the same panels."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lwa4d_sim.drawing import (
    BLACK,
    GREY,
    LOOK,
    REFERENCE,
    SMALL,
    Curve,
    Ink,
    Picture,
    canvas,
    draw,
    envelope,
    inks,
    legend,
    longest,
    rows,
    save,
)
from lwa4d_sim.errors import RecordError
from lwa4d_sim.interfaces import NS_PER_S, Array
from lwa4d_sim.record import RunLog
from lwa4d_sim.verdict import segment_word

ZOOM = 0.3  # [s] a few swings of a loop with a period of 10 ms
JUMP_SPEED = 10.0  # [m/s] a reference faster than this jumps and is drawn with a gap (assumed: far above any arm)
MAX_GOALS = 12  # more waypoints than this are not drawn one by one
_ORDER = ("tool", "torques", "joint_error", "velocity", "path", "age")

_Logs = Mapping[str, RunLog]
_Inks = Mapping[str, Ink]
_Made = Iterator[tuple[str, str, str, Figure]]  # file stem, title, caption


def draw_all(logs: _Logs, folder: Path) -> list[Picture]:
    """Draw every figure of one scenario into ``folder``.

    Args:
        logs: record of each variant, at least one, all of the same motion.
        folder: an existing folder; files of the same names are replaced.

    Raises:
        RecordError: a file cannot be written.
    """
    with matplotlib.style.context(LOOK):
        ink = inks(logs)
        return [
            save(figure, Picture(folder / f"{stem}.png", title, caption))
            for make in (_tool, _torques, _joint_error, _velocity, _path, _age)
            for stem, title, caption, figure in make(logs, ink)
        ]


def pictures(folder: Path) -> list[Picture]:
    """The figures that lie in ``folder``, in the order of `draw_all`; any others come last.

    Raises:
        RecordError: a file is not a PNG.
    """
    from PIL import Image  # matplotlib needs it too

    found = []
    for path in folder.glob("*.png"):
        try:
            with Image.open(path, formats=["PNG"]) as image:
                about = image.info
        except OSError as error:
            raise RecordError(f"{path}: not a readable PNG ({error})") from error
        found.append(Picture(path, str(about.get("Title", path.stem)), str(about.get("Description", ""))))
    return sorted(found, key=lambda picture: (_rank(picture.path.stem), picture.path.name))


def _rank(stem: str) -> int:
    ranks = [k for k, name in enumerate(_ORDER) if stem == name or stem.startswith(f"{name}_")]
    return ranks[0] if ranks else len(_ORDER)


def _joints(symbol: str, logs: Iterable[RunLog], unit: str) -> list[str]:
    return [f"{symbol}{j + 1} [{unit}]" for j in range(max(log.q.shape[1] for log in logs))]


def _entries(symbol: str, ink: Iterable[Ink]) -> list[tuple[str, Ink]]:
    return [(f"{symbol}{i.tag}", i) for i in ink]


def _tool(logs: _Logs, ink: _Inks) -> _Made:
    title = "End-effector position"
    figure, axes = rows(logs, ink, title, ["x [m]", "y [m]", "z [m]"])
    log = longest(logs.values())
    reference = Curve(REFERENCE, log.t, log.x_ref)
    draw(axes, [reference, *(Curve(ink[name], log.t, log.x) for name, log in logs.items())], "m")
    legend(figure, _entries("X", [REFERENCE, *ink.values()]))
    caption = (
        "Where the tool is, in base axes. The dashed line is where it should be; a good run ends every segment on it. "
        "Dotted lines part the segments of the motion."
    )
    if len(logs) > 1:
        caption += " Where one variant leaves the others, look at the torques and the joint speeds at the same instant."
    yield "tool", title, caption, figure


def _torques(logs: _Logs, ink: _Inks) -> _Made:
    title = "Applied torque"
    figure, axes = rows(logs, ink, title, _joints("τ", logs.values(), "N m"))
    draw(axes, [Curve(ink[name], log.t, log.tau) for name, log in logs.items()], "N m")
    # a list, not a generator: every panel has to be marked
    reached = any([_limit_marks(ax, logs, ink, j) for j, (ax,) in enumerate(axes)])  # noqa: C419
    legend(figure, _entries("τ", ink.values()))
    limits = (
        "Bars along the upper or lower edge mark when a motor is at its limit (dash-dotted where in view): there it no "
        "longer does what the controller asks."
        if reached
        else "No motor ever reaches its limit."
    )
    caption = (
        "What the motors give the joints, after saturation. Smooth lines are healthy; a solid block of colour is a "
        f"torque that swings faster than the picture resolves, which wears gears and is heard as rattling. {limits}"
    )
    yield "torques", title, caption, figure


def _limit_marks(ax: Axes, logs: _Logs, ink: _Inks, j: int) -> bool:
    """Mark where joint ``j`` is at its torque limit; whether it ever is."""
    reached = False
    for name, log in logs.items():
        if j >= len(log.tau_max):
            continue
        limit, low_high = log.tau_max[j], ax.get_ylim()
        for sign, edge in ((1, 0.94), (-1, 0.0)):
            on = sign * log.tau[:, j] >= limit
            if not on.any():
                continue
            reached = True
            edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]])))
            starts, ends = log.t[edges[::2]], log.t[edges[1::2] - 1]
            widths = np.maximum(ends - starts, ax.get_xlim()[1] / 900)  # at least a pixel, or it would vanish
            spans = np.stack([starts, widths], axis=1).tolist()
            place: Any = ax.get_xaxis_transform()
            ax.broken_barh([ax.get_xlim()], (edge, 0.06), transform=place, color="white", lw=0, zorder=3.9)
            ax.broken_barh(spans, (edge + 0.01, 0.04), transform=place, color=ink[name].colour, lw=0, zorder=4)
            if low_high[0] < sign * limit < low_high[1]:
                ax.axhline(sign * limit, color=BLACK, lw=0.9, ls="-.", zorder=1.5)
    return reached


def _joint_error(logs: _Logs, ink: _Inks) -> _Made:
    curves = [Curve(ink[name], log.ticks.t, log.ticks.q_ref - log.ticks.q_true) for name, log in logs.items()]
    if not any(len(curve.t) for curve in curves):
        return
    title = "Joint error"
    figure, axes = rows(logs, ink, title, _joints("e", logs.values(), "rad"))
    draw(axes, curves, "rad")
    legend(figure, _entries("e", ink.values()))
    caption = (
        "Desired minus true joint position at the control ticks. A reference that steps to a new waypoint shows as a "
        "jump that should die out before the next one; what is left at the end of a segment is the steady error."
    )
    yield "joint_error", title, caption, figure


def _velocity(logs: _Logs, ink: _Inks) -> _Made:
    sampled = {name: log for name, log in logs.items() if log.period > log.timestep and len(log.ticks.t)}
    for name, log in sampled.items():
        title = "Joint speed: estimate and truth" + (f" ({name})" if len(sampled) > 1 else "")
        figure, axes = rows({name: log}, {name: ink[name]}, title, _joints("dq", [log], "rad/s"), columns=2)
        truth = replace(ink[name], colour=BLACK, width=1.4, layer=2)
        guess = replace(ink[name], width=1.0, layer=3)
        ticks = log.ticks
        draw(axes, [Curve(truth, log.t, log.dq), Curve(guess, ticks.t, ticks.dq)], "rad/s")
        start = _violent(log)
        near = slice(log.step_at(start), log.step_at(start + ZOOM) + 1)
        at = (ticks.t >= start) & (ticks.t <= start + ZOOM)
        for j, (whole, zoom) in enumerate(axes):
            whole.axvspan(start, start + ZOOM, color=GREY, alpha=0.25, lw=0, zorder=0)
            zoom.plot(log.t[near], log.dq[near, j], **truth.line)
            zoom.step(ticks.t[at], ticks.dq[at, j], where="post", marker=".", ms=5, **guess.line)
            zoom.set_xlim(start, start + ZOOM)
        axes[0][1].set_title(f"the most violent {ZOOM} s", fontsize=SMALL, color=GREY, pad=3)
        legend(figure, [("dq, true", truth), (f"dq{ink[name].tag}, estimate", guess)])
        caption = (
            "The joint speed that the controller believed at its ticks, in colour, against the true one. On the right "
            f"the grey stripe of the left, the {ZOOM} s in which the arm moved most violently: each dot is a tick, "
            "held until the next. The farther the steps trail behind the smooth line, the later the damping acts, and "
            "damping that comes too late drives a vibration on instead of ending it."
        )
        yield "velocity" if len(sampled) == 1 else f"velocity_{name}", title, caption, figure


def _violent(log: RunLog) -> float:
    """Start [s] of the stretch of `ZOOM` in which the speed of some joint varies most."""
    n = round(ZOOM * NS_PER_S / log.timestep)
    if len(log.dq) <= n:
        return 0.0
    dq = log.dq - log.dq.mean(axis=0)  # keeps the sums accurate
    sums = np.cumsum(np.stack([dq, dq**2]), axis=1)
    mean, square = (sums[:, n:] - sums[:, :-n]) / n
    return float(log.t[int((square - mean**2).max(axis=1).argmax()) + 1])


def _path(logs: _Logs, ink: _Inks) -> _Made:
    title = "Path of the tool"
    log = longest(logs.values())
    figure = canvas(title, log.name, 6.2)
    ax: Any = figure.add_axes((0.0, 0.04, 1.0, 0.88), projection="3d", computed_zorder=False)
    reference = log.x_ref
    steps = np.linalg.norm(np.diff(reference, axis=0), axis=1)
    jumps = steps > JUMP_SPEED * log.timestep / NS_PER_S
    moves = bool((steps[~jumps] > 0).any())
    ax.plot(*_thin(np.insert(reference, np.flatnonzero(jumps) + 1, np.nan, axis=0)).T, **REFERENCE.line)
    for name, run in logs.items():
        ax.plot(*_thin(run.x).T, marker="." if len(run.q) == 1 else "", **ink[name].line)
    ax.scatter(*log.x[0], marker="s", s=30, color=GREY, zorder=7)
    ax.text(*log.x[0], "   start", color=GREY, zorder=8)
    # a reference that jumps at a knot has the goal in the sample before
    goals = [reference[k - 1] for k in map(log.step_at, log.knots) if 0 < k <= len(reference)]
    named = 0 < len(goals) <= MAX_GOALS
    for k, goal in enumerate(goals if named else [], start=1):
        ax.scatter(*goal, marker="o", s=42, facecolor="white", edgecolor=BLACK, zorder=7)
        ax.text(*goal, f"   {k}", weight="bold", zorder=8)
    _to_scale(ax, np.concatenate([reference, *(run.x for run in logs.values())]))
    legend(figure, _entries("X", [*([REFERENCE] if moves else []), *ink.values()]))
    desired = (
        "The dashed line is the desired path."
        if moves
        else "The reference jumps from goal to goal, so there is no desired path: the arm finds its own."
    )
    marks = f" The circles are the goals ({segment_word(log.scenario)} 1, 2, ...)." if named else ""
    caption = (
        f"The way of the tool through space, to scale, from the square on.{marks} {desired} Fuzz or loops in a line "
        "are vibration that reaches the tool."
    )
    yield "path", title, caption, figure


def _thin(points: Array) -> Array:
    """Those of ``points`` (T, 3) that draw like all of them."""
    thin: Array = points[np.unique(np.concatenate([envelope(column) for column in points.T]))]
    return thin


def _to_scale(ax: Any, points: Array) -> None:
    """Show all ``points`` (T, 3) with the same scale on the three axes."""
    low, high = points.min(axis=0), points.max(axis=0)
    half = 0.525 * np.maximum(high - low, max(0.1 * float((high - low).max()), 1e-3))
    for axis, centre, reach in zip("xyz", (low + high) / 2, half, strict=True):
        ax.set(**{f"{axis}lim": (centre - reach, centre + reach), f"{axis}label": f"{axis} [m]"})
    ax.set_box_aspect(half, zoom=0.98)
    ax.locator_params(nbins=5)
    for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
        axis.labelpad = 10


def _age(logs: _Logs, ink: _Inks) -> _Made:
    ages = {name: log.ticks.age[np.isfinite(log.ticks.age)] for name, log in logs.items()}
    if not any(len(np.unique(age)) > 1 for age in ages.values()):
        return
    title = "Age of the measured data"
    figure, axes = rows(logs, ink, title, ["age [ms]"])
    draw(axes, [Curve(ink[name], log.ticks.t, 1e3 * log.ticks.age[:, None]) for name, log in logs.items()], "ms")
    legend(figure, _entries("age", ink.values()))
    caption = (
        "How old the oldest measurement was that the controller used at each tick. Every millisecond here is a "
        "millisecond in which the arm moved unseen; peaks are late or lost messages."
    )
    yield "age", title, caption, figure
