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
from lwa4d_sim.verdict import segment_word

WIDTH = 8.0  # [in]; 960 pixels, enough for a desktop
TEXT, SMALL = 12.0, 9.5  # [pt]; against this width still readable where a phone shrinks the figure to its screen
# That one wild run may not squash the others, an axis grows past the calm motion by at most so many times its range, or
# this share of the wild range if that is more: a vibration is worth seeing whole, a diverged run's way to infinity not.
ROOM_SHAKING, ROOM_DIVERGED = (10.0, 0.2), (2.0, 0.001)
BUCKETS = 900  # about the pixels of an axis
_LINE = 13.0  # [pt] from one small line of text to the next
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
        "font.size": TEXT,
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

    @property
    def onsets(self) -> dict[float, str]:
        """What went wrong when [s]."""
        told = {} if self.since is None else {self.since: f"{self.name}: shakes from {self.since:.2f} s"}
        if self.diverged_at is not None:
            told[self.diverged_at] = f"{self.name}: diverged at {self.diverged_at:.2f} s, run ends"
        return told


REFERENCE = Ink("reference", "_REF", BLACK, 1.1, 1.8, (0, (4, 2)))


class Curve(NamedTuple):
    """Signals over time: ``t`` (T,) [s] and ``y`` (T, rows)."""

    ink: Ink
    t: Array
    y: Array


def inks(logs: Mapping[str, RunLog]) -> dict[str, Ink]:
    """A colour for each variant; runs that shake lie lowest, so that calm ones stay visible."""
    out: dict[str, Ink] = {}
    since_when = {name: log.metrics()["unstable_since"] for name, log in logs.items()}
    top_down = sorted(logs, key=lambda name: since_when[name] is not None)
    for k, (name, log) in enumerate(logs.items()):
        # below and wide, above and thin: where two runs agree both can be seen
        depth = top_down.index(name) / max(1, len(logs) - 1)
        tag = {"ideal": " (ideal)", "can": "_CAN"}.get(name, f"_{plain(name)}")
        colour = PALETTE[k % len(PALETTE)]
        out[name] = Ink(plain(name), tag, colour, 1.0 + 1.3 * depth, 3 - depth, "-", since_when[name], log.diverged_at)
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
    ends = [0, len(y) - 1]
    return np.unique(np.concatenate([ends, lowest, highest, edges, edges + 1, np.arange(whole, len(y))]))


def longest(logs: Iterable[RunLog]) -> RunLog:
    """The log that lasts longest: a diverged run ends early."""
    return max(logs, key=lambda log: len(log.q) * log.timestep)


def canvas(title: str, name: str, height: float) -> Figure:
    """An empty figure, ``height`` inches high, with its title and the scenario's name."""
    figure = Figure(figsize=(WIDTH, height))
    FigureCanvasAgg(figure)
    top = 1 - 0.09 / height
    figure.text(0.015, top, title, va="top", weight="bold")
    figure.text(0.985, top, plain(name), va="top", ha="right", color=GREY)
    return figure


def rows(
    logs: Mapping[str, RunLog], ink: Mapping[str, Ink], title: str, labels: Sequence[str], columns: int = 1
) -> tuple[Figure, list[list[Axes]]]:
    """A figure of stacked panels over time, segments and onsets marked; axes by row, then column."""
    first = next(iter(logs.values()))
    onsets = [(t, text, i.colour) for i in ink.values() for t, text in i.onsets.items()]
    head = 0.82 + _LINE / 72 * len(onsets)
    height = head + 0.55 + 1.4 * len(labels)
    figure = canvas(title, first.name, height)
    grid = figure.add_gridspec(
        len(labels),
        columns,
        width_ratios=[1.7, 1][:columns],
        left=0.135,
        right=0.97,
        bottom=0.55 / height,
        top=1 - head / height,
        hspace=0.14,
        wspace=0.2,
    )
    axes = [[figure.add_subplot(grid[row, column]) for column in range(columns)] for row in range(len(labels))]
    end = max(longest(logs.values()).t[-1], first.knots.max(initial=0), first.timestep / NS_PER_S)
    for row, label in zip(axes, labels, strict=True):
        row[0].set(ylabel=label, xlim=(0, end))
        for knot in first.knots[first.knots < end][: 4 * MAX_NAMED]:
            row[0].axvline(knot, color=GREY, lw=0.8, ls=":", zorder=1)
        for t, _, colour in onsets:
            row[0].axvline(t, color=colour, lw=1.2, ls="--", zorder=5)
        for ax in row:
            ax.tick_params(labelbottom=row is axes[-1])
    for ax in axes[-1]:
        ax.set_xlabel("time [s]")
    _name_segments(axes[0][0], first)
    for k, (t, text, colour) in enumerate(onsets):
        _name_onset(axes[0][0], t, text, colour, k)
    figure.align_ylabels([row[0] for row in axes])
    return figure, axes


def _name_segments(ax: Axes, log: RunLog) -> None:
    if not 1 < len(log.knots) <= MAX_NAMED:
        return
    for k, (start, end) in enumerate(zip([0.0, *log.knots[:-1]], log.knots, strict=True), start=1):
        where: Any = {"transform": ax.get_xaxis_transform(), "ha": "center", "va": "bottom"}
        ax.text((start + end) / 2, 1.01, f"{segment_word(log.scenario)} {k}", color=GREY, fontsize=SMALL, **where)


def _name_onset(ax: Axes, t: float, text: str, colour: str, k: int) -> None:
    """Text above the panel, in line ``k`` over the names of the segments, beside the onset's line drawn on up to it."""
    height = _LINE * (k + 1)
    stem: Any = {"arrowstyle": "-", "color": colour, "lw": 1.2, "ls": "--", "shrinkA": 0, "shrinkB": 0}
    place: Any = {"xycoords": ax.get_xaxis_transform(), "textcoords": "offset points"}
    ax.annotate("", (t, 1), (0, height + 9), arrowprops=stem, **place)
    right = t > 0.5 * ax.get_xlim()[1]
    side: Any = {"ha": "right" if right else "left", "va": "bottom", "fontsize": SMALL, "color": colour}
    ax.annotate(text, (t, 1), (-4 if right else 4, height), **side, **place)


def draw(axes: Sequence[Sequence[Axes]], curves: Sequence[Curve], unit: str) -> None:
    """Draw every curve, as far as it has so many columns, into the first panel of each row, and set the limits."""
    for j, (ax, *_) in enumerate(axes):
        signals = [(ink, t, y[:, j]) for ink, t, y in curves if j < y.shape[1]]
        for ink, t, y in signals:
            keep = envelope(y)
            ax.plot(t[keep], y[keep], marker="." if len(t) == 1 else "", **ink.line)
        _limit(ax, signals, unit)


def _limit(ax: Axes, signals: Sequence[tuple[Ink, Array, Array]], unit: str) -> None:
    """Fit the axis to the calm motion and some of the rest, and say in it how far that goes."""
    finite = [(ink, t[np.isfinite(y)], y[np.isfinite(y)]) for ink, t, y in signals if np.isfinite(y).any()]
    if not finite:
        return
    calm = np.concatenate([_calm(*signal) for signal in finite])
    calm = calm if calm.size else np.concatenate([y for _, _, y in finite])
    bottom, top, least, most = calm.min(), calm.max(), calm.min(), calm.max()
    for ink, _, y in finite:
        times, share = ROOM_SHAKING if ink.diverged_at is None else ROOM_DIVERGED
        room = max(times * np.ptp(calm), share * np.ptp(y))
        bottom, top = min(bottom, max(y.min(), calm.min() - room)), max(top, min(y.max(), calm.max() + room))
        least, most = min(least, y.min()), max(most, y.max())
    margin = max(0.07 * (top - bottom), 1e-6)  # the floor keeps a constant signal from an axis of no height
    ax.set_ylim(bottom - margin, top + margin)
    if most > top:
        _boxed(ax, 0.92, "top", f"▲ up to {most:.3g} {unit}")
    if least < bottom:
        _boxed(ax, 0.08, "bottom", f"▼ down to {least:.3g} {unit}")


def _calm(ink: Ink, t: Array, y: Array) -> Array:
    """What of a signal shows its ordinary range."""
    if ink.diverged_at is not None:  # it may have grown for long before it was found to be unstable
        return np.quantile(y, [0.25, 0.75])
    return y if ink.since is None else y[t < ink.since]


def _boxed(ax: Axes, height: float, side: str, text: str) -> None:
    """Small text at the left edge of a panel that stays readable on top of lines."""
    box = {"facecolor": "white", "alpha": 0.8, "pad": 0.8, "linewidth": 0}
    place: Any = {"transform": ax.transAxes, "va": side}
    ax.text(0.006, height, text, bbox=box, fontsize=SMALL, color=GREY, zorder=6, **place)


def legend(figure: Figure, entries: Iterable[tuple[str, Ink]]) -> None:
    """One legend for the whole figure, between its title and the panels."""
    handles = [Line2D([], [], label=label, **ink.line) for label, ink in entries]
    figure.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(0.01, 1 - 0.33 / figure.get_figheight()),
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
