"""The figures of a sweep: maps over two axes, the share of stable runs, spreads of metrics, parallel coordinates."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure

from lwa4d_sim.drawing import BLACK, GREY, LOOK, PALETTE, SMALL, Picture, canvas, plain, save
from lwa4d_sim.interfaces import Array
from lwa4d_sim.metrics import METRICS
from lwa4d_sim.sweep.statistics import wilson

GOOD, BAD = PALETTE[0], PALETTE[1]
MAPPED = ("rms_error", "max_error", "vibration")  # metrics that get a map
SPREAD = ("max_error", "rms_error", "final_error", "vibration", "peak_torque", "data_age_max")  # that get a histogram
MOST_LINES = 2_000  # of parallel coordinates; more would be a solid block
BINS = 8  # of an axis with many values, in the plot of shares
_REQUIRED = 4  # different values that an axis of a map has at least
# Units of the keys that a sweep moves; what stands below one, such as the parameters of a latency law, has its unit.
_UNITS = {
    "s": ("loop.period", "loop.latency", "loop.jitter", "loop.phase", "segment_time", "time_constant", "horizon"),
    "rad": ("position_resolution",),
    "rad/s": ("disturbance_observer.bandwidth",),
    "N m": ("torque_resolution", "friction.coulomb"),
    "N m s/rad": ("friction.viscous",),
    "kg": ("payload.mass",),
}

Curve = Sequence[tuple[float, float]]


class Runs(NamedTuple):
    """A sweep's table as the figures need it.

    Attributes:
        name: of the sweep.
        axes: values of each axis by name, numbers (R,) [SI] or lists of text.
        stable: which runs are stable, (R,).
        metrics: by column (R,), NaN where there is none.
        log: axes to be drawn on a logarithmic scale.
    """

    name: str
    axes: Mapping[str, Any]
    stable: Any
    metrics: Mapping[str, Array]
    log: frozenset[str] = frozenset()

    def worst(self, metric: str) -> Array | None:
        """A metric, of several columns the largest; None where no run has it."""
        columns = [
            v for k, v in self.metrics.items() if k == metric or (k not in METRICS and k[: k.rfind("_")] == metric)
        ]
        if not columns or all(np.isnan(column).all() for column in columns):
            return None
        # fmax knows no NaN where there is a number
        out: Array = np.fmax.reduce(columns)
        return out


def draw_sweep(runs: Runs, folder: Path, boundary: Curve | None = None) -> list[Picture]:
    """Draw the figures that fit the sweep into ``folder``.

    Args:
        runs: the table.
        folder: an existing folder.
        boundary: a curve (x, y) to be drawn over the maps, such as where theory sees the limit of stability.

    Raises:
        RecordError: a file cannot be written.
    """
    with matplotlib.style.context(LOOK):
        made = [*_maps(runs, boundary), *_shares(runs), *_spreads(runs), *_parallel(runs)]
        return [save(figure, Picture(folder / f"{stem}.png", title, text)) for stem, title, text, figure in made]


_Made = Iterator[tuple[str, str, str, Figure]]


def _numeric(runs: Runs) -> dict[str, Array]:
    return {name: values for name, values in runs.axes.items() if isinstance(values, np.ndarray)}


def _maps(runs: Runs, boundary: Curve | None) -> _Made:
    axes = _numeric(runs)
    if len(runs.axes) != 2 or len(axes) != 2:
        return
    (x_name, x), (y_name, y) = axes.items()
    if min(len(np.unique(x)), len(np.unique(y))) < _REQUIRED or len(np.unique(x)) * len(np.unique(y)) > 4 * len(x):
        return  # no grid, or one too coarse for a map
    read = "Each cell is one point of the sweep; where a point was run with several seeds, the worst counts. "
    line = " The black line is where theory sees the limit." if boundary else ""
    text = (
        f"{read}Blue is stable, orange is not. A ragged edge means that the limit hangs on details: read it as a band."
        f"{line}"
    )

    def drawn(label: str, z: Array) -> Figure:
        return draw_heat_map(runs.name, (x_name, x), (y_name, y), (label, z), boundary=boundary, log=runs.log)

    yield "map_stable", "Stable or not", text, drawn("stable", np.where(runs.stable, 1.0, 0.0))
    for metric in MAPPED:
        values = runs.worst(metric)
        if values is None or not np.isfinite(values[runs.stable]).any():
            continue
        unit, meaning = METRICS[metric]
        text = (
            f"{read}Colour is {meaning} [{unit}], dark is bad; runs that are not stable are left white. Look for a "
            "bright valley, and how wide it is: a good choice lies where its neighbours are good as well."
            f"{line}"
        )
        shown = np.where(runs.stable, values, np.nan)
        yield f"map_{metric}", f"Map of {metric}", text, drawn(f"{metric} [{unit}]", shown)


def draw_heat_map(
    name: str,
    x: tuple[str, Array],
    y: tuple[str, Array],
    z: tuple[str, Array],
    *,
    boundary: Curve | None = None,
    log: frozenset[str] = frozenset(),
) -> Figure:
    """A map of a number over two axes; white where there is none.

    Args:
        name: of the sweep.
        x: label and values (R,) of the horizontal axis.
        y: of the vertical one.
        z: label and values (R,); of several at one place the worst counts. `stable` (1 or 0) gets two colours.
        boundary: points (x, y) of a curve to be drawn over the map.
        log: labels of the axes that have a logarithmic scale.
    """
    columns, at_x = np.unique(x[1], return_inverse=True)
    rows, at_y = np.unique(y[1], return_inverse=True)
    flag = z[0] == "stable"
    cells = np.full((len(rows), len(columns)), np.nan)
    for i, j, value in zip(at_y, at_x, z[1], strict=True):
        old = cells[i, j]
        cells[i, j] = value if np.isnan(old) else min(old, value) if flag else max(old, value)
    figure = canvas(f"{z[0]} over {plain(x[0])} and {plain(y[0])}", name, 5.4)
    ax = figure.add_axes((0.12, 0.115, 0.86 if flag else 0.88, 0.79))
    known = cells[np.isfinite(cells)]
    norm: Normalize = Normalize(0, 1)
    colours: Any = ListedColormap([BAD, GOOD])
    if not flag:
        positive = known[known > 0]
        wide = positive.size == known.size and known.max() > 3 * known.min()
        norm = (
            LogNorm(known.min(), known.max()) if wide else Normalize(known.min(), max(known.max(), known.min() + 1e-12))
        )
        colours = "viridis_r"
    x_log, y_log = x[0] in log, y[0] in log
    mesh = ax.pcolormesh(_edges(columns, x_log), _edges(rows, y_log), cells, cmap=colours, norm=norm)
    ax.set(xlabel=labelled(*x), ylabel=labelled(*y))
    ax.set(xscale="log" if x_log else "linear", yscale="log" if y_log else "linear")
    ax.grid(visible=False)
    if flag:
        ax.text(1, 1.01, "stable", color=GOOD, ha="right", va="bottom", transform=ax.transAxes, weight="bold")
        ax.text(0.87, 1.01, "unstable", color=BAD, ha="right", va="bottom", transform=ax.transAxes, weight="bold")
    else:
        figure.colorbar(mesh, ax=ax, pad=0.02)
    if boundary:
        limits = ax.get_xlim(), ax.get_ylim()
        ax.plot(*np.asarray(boundary, float).T, color=BLACK, lw=2.0)
        ax.set(xlim=limits[0], ylim=limits[1])
    return figure


def labelled(name: str, values: Any) -> str:
    """An axis's name, with the unit where its values are numbers that have one."""
    unit = next((unit for unit, keys in _UNITS.items() if any(f".{key}." in f".{name}." for key in keys)), "")
    return f"{plain(name)} [{unit}]" if unit and isinstance(values, np.ndarray) else plain(name)


def _edges(centres: Array, log: bool) -> Array:
    """Borders of cells around sorted centres, at their middles (of the logarithms, on such a scale)."""
    if log:
        edges: Array = np.exp(_edges(np.log(centres), False))
        return edges
    middles = 0.5 * (centres[1:] + centres[:-1])
    return np.concatenate([[2 * centres[0] - middles[0]], middles, [2 * centres[-1] - middles[-1]]])


def _shares(runs: Runs) -> _Made:
    if runs.stable.all():
        return
    names = list(runs.axes)[:6]
    figure = canvas("Share of stable runs", runs.name, 0.95 + 2.1 * -(-len(names) // 2))
    for ax, name in zip(_panels(figure, len(names)), names, strict=False):
        labels, group = _binned(runs.axes[name])
        passed = np.array([runs.stable[group == k].sum() for k in range(len(labels))])
        count = np.array([(group == k).sum() for k in range(len(labels))])
        share = passed / np.maximum(count, 1)
        ends = np.array([wilson(int(p), int(c)) for p, c in zip(passed, count, strict=True)]).T
        at = np.arange(len(labels))
        bars = np.maximum(0.0, [share - ends[0], ends[1] - share])  # rounding leaves -1e-17
        ax.errorbar(at, share, bars, fmt="o", color=GOOD, ecolor=GREY, capsize=2, ms=4)
        ax.set(ylim=(-0.05, 1.05), xlabel=labelled(name, runs.axes[name]), xlim=(-0.5, len(labels) - 0.5))
        thin = max(1, -(-len(labels) // BINS))
        ax.set_xticks(
            at[::thin], labels[::thin], fontsize=SMALL, rotation=20 if sum(map(len, labels[::thin])) > 42 else 0
        )
    text = (
        "One panel an axis; each dot is the share of the runs there that are stable, over all values of the others, "
        "and its bar the 95 % confidence interval (Wilson 1927) of that share. An axis whose dots lie level does not "
        "matter; one whose dots fall decides. A wide bar asks for more runs."
    )
    yield "share_stable", "Share of stable runs", text, figure


def _binned(values: Any) -> tuple[list[str], Any]:
    """Names of an axis's values, or of stretches with as many runs each, and which of them each run belongs to."""
    if not isinstance(values, np.ndarray):
        labels = list(dict.fromkeys(values))
        return [plain(label) for label in labels], np.array([labels.index(value) for value in values])
    distinct = np.unique(values)
    if len(distinct) <= 4 * BINS:
        return [f"{value:.3g}" for value in distinct], np.searchsorted(distinct, values)
    borders = np.quantile(values, np.linspace(0, 1, BINS + 1))
    group = np.clip(np.searchsorted(borders, values, "right") - 1, 0, BINS - 1)
    return [f"{value:.3g}" for value in 0.5 * (borders[1:] + borders[:-1])], group


def _spreads(runs: Runs) -> _Made:
    shown = [(metric, values) for metric in SPREAD if (values := runs.worst(metric)) is not None]
    shown = [(m, v[runs.stable & np.isfinite(v)]) for m, v in shown]
    shown = [(metric, values) for metric, values in shown if values.size > 1 and np.ptp(values) > 1e-9 * values.max()]
    if not shown:
        return
    figure = canvas("Spread of the metrics over the stable runs", runs.name, 0.95 + 2.1 * -(-len(shown) // 2))
    for ax, (metric, values) in zip(_panels(figure, len(shown)), shown, strict=True):
        ax.hist(values, bins=min(40, max(8, int(np.sqrt(values.size)))), color=GOOD)
        for share, dash in ((50, "-"), (95, "--"), (99, ":")):
            ax.axvline(float(np.percentile(values, share)), color=BAD, lw=1.2, ls=dash)
        ax.set(xlabel=f"{metric} [{METRICS[metric][0]}]", ylabel="runs")
    text = (
        "How often each value occurs among the stable runs; of a metric with several numbers the largest of each run. "
        "Vertical lines: half of the runs stay below the solid one, 95 % below the dashed, 99 % below the dotted. A "
        "long tail to the right means that a few points are much worse than the rest: look at the worst run."
    )
    yield "spread", "Spread of the metrics", text, figure


def _panels(figure: Figure, count: int) -> list[Axes]:
    """So many panels in two columns."""
    rows, height = -(-count // 2), figure.get_figheight()
    grid = figure.add_gridspec(
        rows, 2, left=0.09, right=0.98, bottom=0.8 / height, top=1 - 0.45 / height, hspace=0.75, wspace=0.24
    )
    return [figure.add_subplot(grid[k // 2, k % 2]) for k in range(count)]


def _parallel(runs: Runs) -> _Made:
    axes = _numeric(runs)
    error = runs.worst("max_error")
    if len(runs.axes) < 3 or len(axes) < 2 or error is None:
        return
    columns = {**axes, "max_error [m]": np.where(runs.stable, error, np.nan)}
    figure = canvas("All runs, axis by axis", runs.name, 4.8)
    ax = figure.add_axes((0.08, 0.19, 0.84, 0.66))
    scaled = []
    for k, (name, values) in enumerate(columns.items()):
        low, high = np.nanmin(values, initial=np.inf), np.nanmax(values, initial=-np.inf)
        if not np.isfinite(low):
            return
        if name in runs.log:
            shown, ends = np.log(values), np.log([low, high])
        else:
            shown, ends = values, np.array([low, high])
        scaled.append((shown - ends[0]) / np.ptp(ends) if high > low else np.full(len(values), 0.5))
        ax.text(k, 1.03, f"{high:.3g}", ha="center", va="bottom", fontsize=SMALL, color=GREY)
        down = "\n" * (1 + k % 2)  # on two lines by turns, for names are long
        ax.text(k, -0.03, f"{low:.3g}{down}{labelled(name, values)}", ha="center", va="top", fontsize=SMALL)
        ax.axvline(k, color=GREY, lw=0.8)
    lines = np.stack(scaled, axis=1)
    lines[~runs.stable, -1] = 1.0
    pick = np.linspace(0, len(lines) - 1, min(len(lines), MOST_LINES)).astype(int)
    faint = min(1.0, max(0.05, 60 / len(pick)))
    for stable, colour in ((True, GOOD), (False, BAD)):
        chosen = lines[pick[runs.stable[pick] == stable]]
        if len(chosen):
            ax.plot(np.arange(lines.shape[1]), chosen.T, color=colour, lw=0.7, alpha=faint)
    ax.set(ylim=(0, 1), xlim=(-0.3, lines.shape[1] - 0.7))
    ax.axis("off")
    text = (
        "Every line is one run: it crosses each vertical axis at the run's value there, smallest below, largest above. "
        "The last axis is the outcome; orange runs are not stable and end at its top. Where the orange lines crowd on "
        "an axis, that range is the cause; where they spread evenly, that axis has no part in it."
    )
    yield "parallel", "All runs, axis by axis", text, figure
