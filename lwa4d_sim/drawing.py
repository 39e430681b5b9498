"""What all figures share: look, colours, axis limits, marks of an onset, and an envelope that loses no peak."""

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from lwa4d_sim.errors import RecordError
from lwa4d_sim.interfaces import NS_PER_S, Array, IntArray
from lwa4d_sim.record import RunLog

WIDTH = 8.0  # [in]; at 120 dpi 960 pixels, which a phone can show without losing the labels
ROOM = 3.0  # an axis grows past the calm motion by at most this many times its range, so one wild run squashes nobody
BUCKETS = 900  # about the pixels of an axis
MAX_NAMED = 8  # more segments than this are not named one by one

# Okabe and Ito (2008), "Color Universal Design", less yellow and black: distinct for every kind of colour vision
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
GREY = "#555555"
BLACK = "#000000"

# Starting from "default" keeps a user's own matplotlib settings out of the report.
LOOK: list[Any] = [
    "default",
    {
        "figure.dpi": 120,
        "savefig.dpi": 120,
        "font.size": 10.5,
        "axes.grid": True,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.axisbelow": True,
        "grid.color": "#dddddd",
        "grid.linewidth": 0.6,
        "legend.frameon": False,
    },
]


class Picture(NamedTuple):
    """A figure on disk: ``path`` of the PNG, ``title``, and ``caption``, the paragraph that says how to read it."""

    path: Path
    title: str
    caption: str


@dataclass(frozen=True, slots=True)
class Ink:
    """How one variant is drawn.

    Attributes:
        name: of the variant.
        tag: ends its legend entries.
        colour, width, layer, dash: of its lines.
        since: onset of its instability [s], or None.
        diverged_at: end of a diverged run [s], or None.
    """

    name: str
    tag: str
    colour: str
    width: float
    layer: float
    dash: Any = "-"
    since: float | None = None
    diverged_at: float | None = None

    @property
    def line(self) -> dict[str, Any]:
        """Keyword arguments of a line."""
        return {"color": self.colour, "lw": self.width, "zorder": self.layer, "ls": self.dash}


REFERENCE = Ink("reference", "_REF", BLACK, 1.1, 1.8, (0, (4, 2)))


class Curve(NamedTuple):
    """Signals over time: ``t`` (T,) [s] and ``y`` (T, rows)."""

    ink: Ink
    t: Array
    y: Array


def inks(logs: Mapping[str, RunLog]) -> dict[str, Ink]:
    """A colour for each variant; runs that shake lie below and wide, so that calm ones stay visible."""
    out: dict[str, Ink] = {}
    for k, (name, log) in enumerate(logs.items()):
        since = log.metrics()["unstable_since"]
        # below and wide, above and thin: where two runs agree both can be seen
        rank = (0 if since is not None else 1) + (1 - k / len(logs))
        tag = {"ideal": " (ideal)", "can": "_CAN"}.get(name, f"_{plain(name)}")
        colour = PALETTE[k % len(PALETTE)]
        out[name] = Ink(plain(name), tag, colour, 2.0 - 0.5 * rank, 2 + rank, "-", since, log.diverged_at)
    return out


def plain(text: str) -> str:
    """``text`` for a label: the dollar signs that would start a formula made harmless, and not too long."""
    return (text if len(text) <= 40 else text[:37] + "...").replace("$", r"\$").replace("\n", " ")


def envelope(y: Array, buckets: int = BUCKETS) -> IntArray:
    """Indices, in order, of samples of ``y`` (T,) that draw like all of them.

    The ends, the edges of gaps (NaN), and the smallest and largest sample of each of at most ``buckets`` equal
    stretches; every index when that would save little.
    """
    if len(y) <= 3 * buckets:
        return np.arange(len(y))
    size = -(-len(y) // buckets)
    whole = len(y) // size * size
    stretches = y[:whole].reshape(-1, size)
    starts = np.arange(0, whole, size)
    gap = np.isnan(stretches)
    lowest = starts + np.where(gap, np.inf, stretches).argmin(axis=1)
    highest = starts + np.where(gap, -np.inf, stretches).argmax(axis=1)
    edges = np.flatnonzero(np.diff(np.isnan(y)))
    return np.unique(np.concatenate([[0], lowest, highest, edges, edges + 1, np.arange(whole, len(y))]))


def longest(logs: Iterable[RunLog]) -> RunLog:
    """The log that lasts longest: a diverged run ends early."""
    return max(logs, key=lambda log: len(log.q) * log.timestep)


def segment_word(log: RunLog) -> str:
    """What a stretch between two knots leads to, in the words of the scenario."""
    kind = log.scenario.get("trajectory", {}).get("kind", "waypoints")
    return "waypoint" if kind == "waypoints" else "segment"


def canvas(title: str, log: RunLog, height: float) -> Figure:
    """An empty figure, ``height`` inches high, with its title and the scenario's name."""
    figure = Figure(figsize=(WIDTH, height))
    FigureCanvasAgg(figure)
    top = 1 - 0.09 / height
    figure.text(0.015, top, title, va="top", weight="bold")
    figure.text(0.985, top, plain(log.name), va="top", ha="right", color=GREY)
    return figure


def rows(
    logs: Mapping[str, RunLog], title: str, labels: Sequence[str], columns: int = 1
) -> tuple[Figure, list[list[Axes]]]:
    """A figure of stacked panels over time, the segments marked in the first column; axes by row, then column."""
    first = next(iter(logs.values()))
    height = 1.2 + 1.4 * len(labels)
    figure = canvas(title, first, height)
    grid = figure.add_gridspec(
        len(labels),
        columns,
        width_ratios=[1.7, 1][:columns],
        left=0.1,
        right=0.985,
        bottom=0.5 / height,
        top=1 - 0.78 / height,
        hspace=0.14,
        wspace=0.17,
    )
    axes = [[figure.add_subplot(grid[row, column]) for column in range(columns)] for row in range(len(labels))]
    end = max(longest(logs.values()).t[-1], first.knots.max(initial=0), first.timestep / NS_PER_S)
    for row, label in zip(axes, labels, strict=True):
        row[0].set(ylabel=label, xlim=(0, end))
        for knot in first.knots[first.knots < end][: 4 * MAX_NAMED]:
            row[0].axvline(knot, color=GREY, lw=0.8, ls=":", zorder=1)
        for ax in row:
            ax.tick_params(labelbottom=row is axes[-1])
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    _name_segments(axes[0][0], first)
    figure.align_ylabels([row[0] for row in axes])
    return figure, axes


def _name_segments(ax: Axes, log: RunLog) -> None:
    if not 1 < len(log.knots) <= MAX_NAMED:
        return
    for k, (start, end) in enumerate(zip([0.0, *log.knots[:-1]], log.knots, strict=True), start=1):
        where: Any = {"transform": ax.get_xaxis_transform(), "ha": "center", "va": "bottom"}
        ax.text((start + end) / 2, 1.01, f"{segment_word(log)} {k}", color=GREY, fontsize=8.5, **where)


def draw(axes: Sequence[Sequence[Axes]], curves: Sequence[Curve], unit: str) -> None:
    """Draw every curve into the first panel of each row, set the limits and mark onsets."""
    for j, (ax, *_) in enumerate(axes):
        for ink, t, y in curves:
            keep = envelope(y[:, j])
            ax.plot(t[keep], y[keep, j], marker="." if len(t) == 1 else "", **ink.line)
        _limit(ax, [(ink.since, t, y[:, j]) for ink, t, y in curves], unit)
    marked = {ink.name: ink for ink, _, _ in curves if ink.since is not None}
    for k, ink in enumerate(marked.values()):
        _mark(axes, ink, k)


def _limit(ax: Axes, signals: Sequence[tuple[float | None, Array, Array]], unit: str) -> None:
    """Fit the axis to the calm motion and say in it how far the rest goes."""
    finite = [(since, t[np.isfinite(y)], y[np.isfinite(y)]) for since, t, y in signals]
    everything = np.concatenate([y for _, _, y in finite])
    if not everything.size:
        return
    calm = np.concatenate([y if since is None else y[t < since] for since, t, y in finite])
    calm = calm if calm.size else everything
    room = ROOM * np.ptp(calm)
    least, most = everything.min(), everything.max()
    bottom, top = max(least, calm.min() - room), min(most, calm.max() + room)
    margin = max(0.07 * (top - bottom), 1e-6)  # the floor keeps a constant signal from an axis of no height
    ax.set_ylim(bottom - margin, top + margin)
    if most > top:
        boxed(ax, 0.006, 0.95, f"▲ up to {most:.3g} {unit}", va="top", transform=ax.transAxes)
    if least < bottom:
        boxed(ax, 0.006, 0.05, f"▼ down to {least:.3g} {unit}", va="bottom", transform=ax.transAxes)


def _mark(axes: Sequence[Sequence[Axes]], ink: Ink, k: int) -> None:
    """A line at the onset of instability and at the end of a diverged run, told in the top panel."""
    told = {} if ink.since is None else {ink.since: f"{ink.name}: shakes from {ink.since:.2f} s"}
    if ink.diverged_at is not None:
        told[ink.diverged_at] = f"{ink.name}: diverged at {ink.diverged_at:.2f} s, run ends"
    top = axes[0][0]
    for j, (t, text) in enumerate(told.items()):
        for ax, *_ in axes:
            ax.axvline(t, color=ink.colour, lw=1.2, ls="--", zorder=5)
        side = "left" if t < 0.5 * top.get_xlim()[1] else "right"
        where = {"transform": top.get_xaxis_transform(), "ha": side, "va": "top"}
        boxed(top, t, 0.95 - 0.17 * (k + j), f" {text} ", color=ink.colour, **where)


def boxed(ax: Axes, x: float, y: float, text: str, **style: Any) -> None:
    """Small text that stays readable on top of lines."""
    box = {"facecolor": "white", "alpha": 0.8, "pad": 0.8, "linewidth": 0}
    ax.text(x, y, text, bbox=box, **{"fontsize": 8.5, "color": GREY, "zorder": 6, **style})


def legend(figure: Figure, entries: Iterable[tuple[str, Ink]]) -> None:
    """One legend for the whole figure, between its title and the panels."""
    handles = [Line2D([], [], label=label, **ink.line) for label, ink in entries]
    figure.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(0.01, 1 - 0.3 / figure.get_figheight()),
        ncols=min(6, len(handles)),
        borderaxespad=0,
        borderpad=0.2,
        columnspacing=1.4,
        handlelength=1.8,
    )


def save(figure: Figure, picture: Picture) -> Picture:
    """Write the PNG; title and caption travel in it, so that a picture on its own can still be read.

    Raises:
        RecordError: the file cannot be written.
    """
    try:
        with warnings.catch_warnings():
            # a name in a script that the font lacks shows as boxes, which is no reason to disturb
            warnings.filterwarnings("ignore", message="Glyph .* missing")
            metadata = {"Title": picture.title, "Description": picture.caption}
            figure.savefig(picture.path, format="png", metadata=metadata)
    except OSError as error:
        raise RecordError(f"{picture.path}: cannot write the figure ({error})") from error
    return picture
