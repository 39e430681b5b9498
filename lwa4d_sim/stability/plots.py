"""The pictures of a stability analysis: critical gains, the motion, eigenvalues, and who shakes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from lwa4d_sim.drawing import BLACK, GREY, LOOK, PALETTE, SMALL, WIDTH, Picture, plain, save
from lwa4d_sim.interfaces import Array
from lwa4d_sim.stability import guides as guides
from lwa4d_sim.stability.analysis import Curve
from lwa4d_sim.stability.findings import Charts, Findings
from lwa4d_sim.stability.words import unstable

SAFE = "#e3eef7"  # where the loop is stable at every point
TICKS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100)
LOWEST, HIGHEST = 0.05, 20.0  # factors on the gains beyond which nobody looks (assumed)
_MARKS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "h", "*")
_BARS = 8  # operating points whose mode is drawn; with more, those with the smallest margins (assumed)
_ROOM = 0.15  # of a curve's range between it and the frame (assumed)
_SWINGS = 0.05  # of half the sampling rate, from which on an eigenvalue is said to swing (assumed)


class Marked(NamedTuple):
    """How an operating point is drawn: `name`, `colour` and `mark`."""

    name: str
    colour: Any
    mark: str


def draw_findings(found: Findings, charts: Charts, folder: Path) -> list[Picture]:
    """Draw everything but the map into ``folder``.

    Raises:
        RecordError: a file cannot be written.
    """
    with matplotlib.style.context(LOOK):
        made = [_modes(found), _motion(found, charts)]
        if charts.poles is not None:
            made.insert(0, _poles(found, charts, charts.poles))
        if charts.period is not None:
            made.insert(0, _over_period(found, charts, charts.period))
        if charts.latency is not None:
            made.insert(0, _over_latency(found, charts, charts.latency))
        return [save(figure, Picture(folder / f"{stem}.png", title, text)) for stem, title, text, figure in made]


def marked(found: Findings, charts: Charts) -> list[Marked]:
    """Colour and mark of each operating point that has curves."""
    names = [found.names[k] for k in charts.rows]
    if len(names) <= len(PALETTE):
        colours: Sequence[Any] = PALETTE
    else:
        colours = list(matplotlib.colormaps["viridis"](np.linspace(0.0, 0.9, len(names))))
    return [Marked(*one) for one in zip(names, colours, _MARKS, strict=False)]


def canvas(found: Findings, title: str, height: float) -> Figure:
    """An empty figure with its title, and the scenario's name and variant."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, x=0.015, ha="left", weight="bold", fontsize="medium")
    name = plain(f"{found.scenario.name}, {found.variant}")
    figure.text(0.985, 1 - 0.09 / height, name, va="top", ha="right", color=GREY, fontsize=SMALL)
    return figure


def _over_latency(found: Findings, charts: Charts, curve: Curve) -> tuple[str, str, str, Figure]:
    title = "Critical gain over extra latency"
    figure = canvas(found, title, 4.8)
    ax = figure.subplots()
    _critical(ax, 1e3 * curve.x, curve.critical, marked(found, charts), jumps=_jumps(found))
    for k, one in zip(charts.rows, marked(found, charts), strict=True):
        point = found.points[k]
        for margin, size, face in ((point.jitter_margin, 10, "white"), (point.delay_margin, 7, one.colour)):
            if 0 < margin <= curve.x[-1]:
                ax.plot(1e3 * margin, 1.0, one.mark, ms=size, color=one.colour, mfc=face, zorder=6)
    ax.set(
        xlabel="extra latency of the commands [ms]", ylabel="critical factor on all gains", xlim=(0, 1e3 * curve.x[-1])
    )
    extra = [
        Line2D([], [], ls="", marker="o", color=GREY, label="delay margin"),
        Line2D([], [], ls="", marker="o", color=GREY, mfc="white", label="jitter margin"),
    ]
    _legend(figure, marked(found, charts), extra, line=True)
    return "latency", title, guides.LATENCY, figure


def _jumps(found: Findings) -> bool:
    """Whether a latency is felt in whole periods."""
    return getattr(found.study.loop_settings, "actuation", None) == "next_sync"


def _over_period(found: Findings, charts: Charts, curve: Curve) -> tuple[str, str, str, Figure]:
    title = "Critical gain over the control period"
    figure = canvas(found, title, 4.6)
    ax = figure.subplots()
    _critical(ax, 1e3 * curve.x, curve.critical, marked(found, charts))
    ax.axvline(1e3 * found.study.period, color=GREY, ls=":", lw=1.4, zorder=2)
    ax.set(
        xlabel="control period [ms]", ylabel="critical factor on all gains", xlim=(1e3 * curve.x[0], 1e3 * curve.x[-1])
    )
    _legend(figure, marked(found, charts), [Line2D([], [], color=GREY, ls=":", lw=1.4, label="period now")], line=True)
    return "period", title, guides.PERIOD, figure


def _critical(ax: Axes, x: Array, critical: Array, marks: Sequence[Marked], *, jumps: bool = False) -> None:
    """Curves (K, P) on a logarithmic axis, the area below all of them, and the line of the gains as they are."""
    shown = np.where(np.isinf(critical), np.nan, np.maximum(critical, LOWEST))
    finite = shown[np.isfinite(shown)]
    low, high = min(finite.min(initial=1.0), 0.5) / 1.1, max(finite.max(initial=1.0), 2.0) * 1.15
    low, high = max(low, LOWEST), min(high, HIGHEST)
    style: Any = {"drawstyle": "steps-mid"} if jumps else {}
    step: Any = {"step": "mid"} if jumps else {}
    ax.fill_between(x, low, np.minimum(critical.min(axis=1), high), color=SAFE, lw=0, zorder=0, **step)
    for column, one in zip(shown.T, marks, strict=True):
        ax.plot(x, column, color=one.colour, marker=one.mark, markevery=(3, 8), ms=4.5, lw=1.6, zorder=3, **style)
    ax.axhline(1.0, color=BLACK, ls="--", lw=1.2, zorder=2.5)
    ax.set_ylim(low, high)
    log_axis(ax)


def log_axis(ax: Axes) -> None:
    """A logarithmic axis of factors with plain numbers on it."""
    ax.set_yscale("log")
    low, high = ax.get_ylim()
    ticks = TICKS if high / low > 6 else (0.25, 0.35, 0.5, 0.7, 1, 1.4, 2, 2.8, 4)
    ax.yaxis.set_major_locator(FixedLocator(ticks))
    ax.yaxis.set_minor_locator(NullLocator())
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _legend(figure: Figure, marks: Sequence[Marked], extra: Sequence[Any], *, line: bool) -> None:
    handles: list[Any] = [
        Line2D([], [], color=one.colour, marker=one.mark, ms=5, lw=1.6, ls="-" if line else "", label=one.name)
        for one in marks
    ]
    if line:
        handles += [
            Line2D([], [], color=BLACK, ls="--", lw=1.2, label="gains as they are"),
            Patch(color=SAFE, label="stable at every point"),
        ]
    handles += extra
    figure.legend(
        handles=handles,
        loc="outside lower left",
        ncols=6 if len(marks) <= 4 and not line else 4,
        fontsize=SMALL,
        handlelength=1.8,
    )


def _poles(found: Findings, charts: Charts, poles: Any) -> tuple[str, str, str, Figure]:
    title = "Eigenvalues of the loop"
    figure = canvas(found, title, 4.6)
    whole, near = figure.subplots(1, 2)
    circle = np.exp(1j * np.linspace(0.0, 2.0 * np.pi, 721))
    lead = [_swinging(values) for values in poles]
    for ax in (whole, near):
        ax.fill(circle.real, circle.imag, color=SAFE, lw=0, zorder=0)
        ax.plot(circle.real, circle.imag, color=BLACK, lw=1.0, zorder=1)
        for values, one in zip(poles, marked(found, charts), strict=True):
            ax.plot(values.real, values.imag, ls="", marker=one.mark, color=one.colour, mfc="none", ms=6, zorder=3)
        ax.set_aspect("equal")
        ax.set(xlabel="real part")
    whole.set_ylabel("imaginary part")
    reach = max(1.15, min(3.0, 1.05 * float(np.abs(poles[np.isfinite(poles)]).max(initial=1.0))))
    whole.set(xlim=(-reach, reach), ylim=(-reach, reach))
    x, y = np.array([z.real for z in lead]), np.abs([z.imag for z in lead])
    half = max(0.12, 0.6 * float(np.ptp(x)), 0.6 * float(np.ptp(y)))
    centre = (float(x.min() + x.max()) / 2, float(y.min() + y.max()) / 2)
    near.set(xlim=(centre[0] - half, centre[0] + half), ylim=(centre[1] - half, centre[1] + half))
    near.set_title("those that swing", fontsize=SMALL, color=GREY)
    whole.plot(
        centre[0] + half * np.array([-1, 1, 1, -1, -1]),
        centre[1] + half * np.array([-1, -1, 1, 1, -1]),
        color=GREY,
        lw=0.8,
    )
    for ax in (whole, near):
        _frequencies(ax, found.study.period)
    _legend(figure, marked(found, charts), [Patch(color=SAFE, label="inside the unit circle: stable")], line=False)
    return "eigenvalues", title, guides.POLES, figure


def _swinging(values: Any) -> complex:
    """The largest eigenvalue of those that swing, or of all where none does."""
    some = values[np.abs(np.angle(values)) > _SWINGS * np.pi]
    some = some if some.size else values
    return complex(some[np.argmax(np.abs(some))])


def _frequencies(ax: Axes, period: float) -> None:
    """Names of frequencies [Hz] along the unit circle."""
    nyquist = 0.5 / period
    for f in (0.1, 0.2, 0.3, 0.5, 0.75, 1.0):
        z = np.exp(1j * np.pi * f)
        text = ax.annotate(
            f"{f * nyquist:.3g} Hz",
            (z.real, z.imag),
            (7 * z.real - (28 if 0.6 < f < 1 else 0), 7 * z.imag) if f < 1 else (8, 4),
            textcoords="offset points",
            fontsize=SMALL - 2,
            color=GREY,
            annotation_clip=True,
        )
        text.set_clip_on(True)
        ax.plot(z.real, z.imag, ".", color=BLACK, ms=4, zorder=2)


def _modes(found: Findings) -> tuple[str, str, str, Figure]:
    title = "What shakes at the limit"
    order = sorted(range(len(found.points)), key=lambda k: found.points[k].gain_margin)[:_BARS]
    some = sorted(order)
    columns = min(2, len(some))
    rows = -(-len(some) // columns)
    figure = canvas(found, title, 0.9 + 1.75 * rows)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for ax, k in zip(axes.flat, some, strict=False):
        point = found.points[k]
        colours = [PALETTE[1] if share == point.mode.share.max() else PALETTE[0] for share in point.mode.share]
        ax.bar(np.arange(1, found.study.n + 1), point.mode.share, color=colours, width=0.7)
        state = " (unstable)" if unstable(point) else ""
        limit = f"limit {point.gain_margin:#.3g}" if 0 < point.gain_margin < np.inf else "no limit"
        ax.set_title(f"{found.names[k]}{state}: {point.mode.frequency:.1f} Hz, {limit}", fontsize=SMALL)
        ax.set_xticks(range(1, found.study.n + 1))
        ax.set_ylim(0, 1.05)
        ax.grid(axis="x", visible=False)
    for ax in axes.flat[len(some) :]:
        ax.set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel("joint")
    for ax in axes[:, 0]:
        ax.set_ylabel("share")
    return "modes", title, guides.MODES, figure


def _motion(found: Findings, charts: Charts) -> tuple[str, str, str, Figure]:
    course = charts.course
    title = "Along the motion"
    figure = canvas(found, title, 5.2)
    above, below = figure.subplots(2, 1, sharex=True)
    margin = np.where(np.isfinite(course.gain_margin), np.maximum(course.gain_margin, LOWEST), np.nan)
    finite = margin[np.isfinite(margin)]
    low = max(LOWEST, min(0.5, finite.min(initial=1.0) / 1.1))
    high = min(HIGHEST, max(2.0, finite.max(initial=1.0) * 1.15))
    above.plot(course.t, margin, color=PALETTE[0], lw=1.6)
    above.axhspan(1.0, high, color=SAFE, lw=0, zorder=0)
    above.set_ylim(low, high)
    log_axis(above)
    below.plot(course.t, course.spectral_radius, color=PALETTE[0], lw=1.6)
    radii = course.spectral_radius[np.isfinite(course.spectral_radius)]
    room = _ROOM * max(float(np.ptp(radii)) if radii.size else 0.0, 0.005)
    bottom, top = min(radii.min(initial=1.0), 1.0) - room, max(radii.max(initial=1.0), 1.0) + room
    below.axhspan(bottom, 1.0, color=SAFE, lw=0, zorder=0)
    below.set_ylim(bottom, top)
    worst = float(course.t[course.worst])
    for ax in (above, below):
        ax.axhline(1.0, color=BLACK, ls="--", lw=1.2)
        ax.axvline(worst, color=PALETTE[1], lw=1.2, ls="-.")
        for knot in found.study.blocks.infos[0].trajectory.knots:
            ax.axvline(float(knot), color=GREY, lw=0.8, ls=":", zorder=1)
    above.set(ylabel="gain margin [1]", xlim=(0.0, 1.01 * float(course.t[-1]) or 1.0))
    below.set(ylabel="spectral radius [1]", xlabel="time [s]")
    handles = [
        Line2D([], [], color=PALETTE[1], ls="-.", label=f"worst instant, {worst:.2f} s"),
        Line2D([], [], color=GREY, ls=":", label="end of a segment"),
        Patch(color=SAFE, label="stable"),
    ]
    figure.legend(handles=handles, loc="outside lower left", ncols=3, fontsize=SMALL)
    how = guides.STEPS if found.study.steps else guides.FROZEN
    cycle = "" if course.floquet is None else guides.CYCLE.format(factor=course.floquet)
    return "motion", title, guides.MOTION.format(how=how, cycle=cycle), figure
