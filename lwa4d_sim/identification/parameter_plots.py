"""Pictures of the parameters of an identification: how well known, how entangled, how biased."""

from collections.abc import Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from lwa4d_sim.drawing import BLACK, GREY, LOOK, PALETTE, SMALL, Picture, canvas, plain, save
from lwa4d_sim.identification.findings import Findings
from lwa4d_sim.identification.grades import LOST, WEAK, WELL, Grades, grades
from lwa4d_sim.identification.words import squared
from lwa4d_sim.interfaces import Array

COLOURS = {WELL: PALETTE[0], WEAK: PALETTE[5], LOST: "#cccccc"}
WRONG = PALETTE[1]  # where an interval misses the truth
PAIRS = 6  # ellipses (assumed: what one look takes in)
BIASED = 12  # parameters with bars (assumed, likewise)
ROWS = 36  # parameters in one column of names (assumed: a page's height)
RADIUS = 2.4477468306808166  # of the 95 % ellipse in standard deviations: sqrt of chi2's quantile with 2 d.o.f.
_HEAD = 0.42  # [in] of a figure for its title
_ROW = 0.2  # [in] for a name

KNOWN = (
    "A bar for each parameter: half the width of its 95 % interval, in per cent of the size that such a parameter has "
    "(the nominal value, or for a small one what it may come to in a link of that mass or a joint of that torque). "
    "Mind the logarithmic axis: each line to the left is a parameter known ten or a hundred times better. Dark bars "
    "end below 100 %, so the data tell these well; light ones do not; grey ones the data do not tell at all. "
)
TRUTH = (
    "Black diamond: how far the estimate is from the truth. It lies on its bar where the interval holds the truth, as "
    "19 of 20 should; orange ones lie beyond. "
)
NOMINAL = (
    "Hollow circle: how far the nominal value is from the estimate; where it lies beyond the bar the data contradict "
    "the nominal model."
)
ELLIPSES = (
    "The pairs of parameters whose errors are most correlated, counted from the estimate. The ellipse holds the truth "
    "of both with 95 % probability; the dashed box is made of their single intervals. A long thin ellipse says that "
    "the data tell a combination of the two far better than each of them: where that matters, let the excitation tell "
    "them apart, or give one as known."
)
BIAS = (
    "How far each estimate moves when one thing that the recording does to the signals is not allowed for, in per cent "
    "of the parameter's size; the parameters that move most. The grey band is the 95 % interval. A bar that leaves it "
    "is an error that no statistics show. For the noise of the positions the bar is what that noise added once more "
    "does; about as much it has done already, and that is in the estimate."
)


def sheet(found: Findings, title: str, height: float, head: float = 0.3) -> Figure:
    """An empty figure with room for its title, ``head`` inches."""
    figure = canvas(title, f"{found.scenario.name}, {found.variant}", height)
    figure.set_layout_engine("constrained", rect=(0.0, 0.0, 1.0, 1.0 - head / height))
    return figure


def draw_parameters(found: Findings, folder: Path) -> list[Picture]:
    """Draw everything about the parameters into ``folder``.

    Raises:
        RecordError: a file cannot be written.
    """
    grade = grades(found)
    with matplotlib.style.context(LOOK):
        made = [_known(found, grade), _bias(found, grade), _ellipses(found, grade)]
        return [
            save(figure, Picture(folder / f"{stem}.png", title, text))
            for stem, title, text, figure in (one for one in made if one is not None)
        ]


def _known(found: Findings, grade: Grades) -> tuple[str, str, str, Figure]:
    title = "How well each parameter is known"
    names, r = found.problem.parameters.names, len(grade.told)
    columns = -(-r // ROWS)
    rows = -(-r // columns)
    figure = sheet(found, title, _HEAD + 1.0 + _ROW * max(rows, 4))
    away = np.abs(found.fit.estimate.x - found.problem.value(found.problem.nominal)) / grade.size
    shares = [grade.half / grade.size, np.abs(grade.error) / grade.size, away]
    known = 100.0 * np.concatenate(shares)
    known = known[np.isfinite(known) & (known > 0)]
    # a parameter exact to rounding must not push the others into a corner
    low = max(known.min(initial=1.0), 1e-6 * float(np.median(known)) if known.size else 0.1) / 2.0
    limits = (low, max(known.max(initial=100.0), 100.0) * 2.0)
    for c, ax in enumerate(np.atleast_1d(figure.subplots(1, columns, sharex=True))):
        part = range(c * rows, min((c + 1) * rows, r))
        _bars(ax, grade, shares, part, limits)
        ax.set_yticks(range(len(part)), [plain(names[k]) for k in part], fontsize=SMALL)
        ax.set(ylim=(rows - 0.4, -0.6), xlim=limits, xlabel="[%] of the parameter's size")
    handles: list[Any] = [
        Patch(color=COLOURS[told], label=label)
        for told, label in ((WELL, "95 % interval"), (WEAK, "95 % interval, weakly told"), (LOST, "not told"))
        if told in grade.told
    ]
    handles.append(_dot("o", GREY, "none", "nominal value"))
    if found.truth is not None:
        handles.append(_dot("D", BLACK, BLACK, "truth"))
    if (np.abs(grade.error) > grade.half).any():
        handles.append(_dot("D", WRONG, WRONG, "truth outside the interval"))
    figure.legend(handles=handles, loc="outside lower left", ncols=3, fontsize=SMALL)
    return "parameters", title, KNOWN + (TRUTH if found.truth is not None else "") + NOMINAL, figure


def _bars(ax: Axes, grade: Grades, shares: Sequence[Array], part: range, limits: tuple[float, float]) -> None:
    half, off, away = (100.0 * np.clip(share[list(part)], limits[0] / 100.0, None) for share in shares)
    told = [grade.told[k] for k in part]
    y = np.arange(len(part))
    lost = np.array([one == LOST for one in told])
    ax.barh(y, np.where(lost, limits[1], half), color=[COLOURS[one] for one in told], height=0.62, zorder=2)
    ax.plot(away, y, "o", color=GREY, mfc="white", ms=4.5, zorder=3)
    good = off <= half
    for rows, colour in ((good, BLACK), (~good & np.isfinite(off), WRONG)):
        ax.plot(off[rows], y[rows], "D", color=colour, ms=3.8, zorder=4)
    ax.axvline(100.0, color=BLACK, lw=1.0, ls="--", zorder=3)
    ax.set_xscale("log")
    ax.xaxis.set_major_locator(LogLocator(numticks=6))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(FuncFormatter(_power))
    ax.grid(visible=False, axis="y")


def _power(value: float, _: Any) -> str:
    """A power of ten with few characters."""
    return f"{value:g}" if 1e-3 <= value <= 1e4 else f"$10^{{{round(np.log10(value))}}}$"


def _dot(mark: str, colour: str, face: str, label: str) -> Line2D:
    return Line2D([], [], ls="", marker=mark, color=colour, mfc=face, ms=4.5, label=label)


def _ellipses(found: Findings, grade: Grades) -> tuple[str, str, str, Figure] | None:
    told = np.flatnonzero(np.isfinite(grade.half) & (grade.half > 0))
    if len(told) < 2:
        return None
    title = "Parameters whose errors go together"
    s = found.fit.std_error[told]
    correlation = found.fit.covariance[np.ix_(told, told)] / np.outer(s, s)
    upper = np.triu_indices(len(told), 1)
    order = np.argsort(-np.abs(correlation[upper]))[:PAIRS]
    pairs = [(int(told[upper[0][k]]), int(told[upper[1][k]]), float(correlation[upper][k])) for k in order]
    columns = min(3, len(pairs))
    rows = -(-len(pairs) // columns)
    figure = sheet(found, title, _HEAD + 0.3 + 2.6 * rows)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax in axes[len(pairs) :]:
        ax.set_axis_off()
    for ax, (i, j, r) in zip(axes, pairs, strict=False):
        _ellipse(ax, found, grade, i, j, r)
    handles: list[Any] = [
        _dot("o", PALETTE[0], PALETTE[0], "estimate"),
        Line2D([], [], color=PALETTE[0], label="95 % of both"),
        Line2D([], [], color=GREY, ls="--", lw=1.0, label="95 % of each"),
    ]
    if found.truth is not None:
        handles.append(_dot("D", BLACK, BLACK, "truth"))
    figure.legend(handles=handles, loc="outside lower left", ncols=4, fontsize=SMALL)
    return "ellipses", title, ELLIPSES, figure


def _ellipse(ax: Axes, found: Findings, grade: Grades, i: int, j: int, r: float) -> None:
    """Everything about the estimate, whose digits would not fit on an axis where the interval is small."""
    parameters = found.problem.parameters
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    round_ = np.stack([np.cos(angle), r * np.cos(angle) + np.sqrt(max(0.0, 1.0 - r**2)) * np.sin(angle)])
    corner = np.array([[-1, 1, 1, -1, -1], [-1, -1, 1, 1, -1]])
    truth = -grade.error[[i, j]]
    for k, row, label in ((i, 0, ax.set_xlabel), (j, 1, ax.set_ylabel)):
        reach = np.nanmax([RADIUS * found.fit.std_error[k], abs(truth[row])])
        power = 3 * int(np.floor(np.log10(reach) / 3.0))
        round_[row] *= RADIUS * found.fit.std_error[k] / 10.0**power
        truth[row] /= 10.0**power
        unit = ("" if power == 0 else f"$10^{{{power}}}$ ") + squared(parameters.units[k])
        corner = corner.astype(float)
        corner[row] *= grade.half[k] / 10.0**power
        label(f"{plain(parameters.names[k])} [{unit}]", fontsize=SMALL)
    ax.plot(*round_, color=PALETTE[0], lw=1.6)
    ax.plot(*corner, color=GREY, ls="--", lw=1.0)
    ax.plot(0.0, 0.0, "o", color=PALETTE[0], ms=4.5)
    ax.plot(*truth, "D", color=BLACK, ms=4.0, zorder=4)  # nothing where it is not known
    ax.set_title(f"correlation {r:.4f}" if abs(r) > 0.99 else f"correlation {r:.2f}", fontsize=SMALL, color=GREY)
    ax.tick_params(labelsize=SMALL)
    ax.margins(0.12)


def _bias(found: Findings, grade: Grades) -> tuple[str, str, str, Figure] | None:
    told = np.flatnonzero(np.isfinite(grade.half))
    if not found.bias or not len(told):
        return None
    title = "What the recording does to the estimate"
    shifts = {source: 100.0 * shift / grade.size for source, shift in found.bias.items()}
    most = np.max([np.abs(shift[told]) / np.abs(shift[told]).max(initial=1e-300) for shift in shifts.values()], axis=0)
    weak = np.array([grade.told[k] != WELL for k in told])
    rows = told[np.lexsort((-most, weak))[:BIASED]]
    names = [plain(found.problem.parameters.names[k]) for k in rows]
    y = np.arange(len(rows))
    figure = sheet(found, title, _HEAD + 1.2 + 0.26 * max(len(rows), 4))
    for ax, (source, shift) in zip(
        figure.subplots(1, len(shifts), squeeze=False, sharey=True)[0], shifts.items(), strict=True
    ):
        half = 100.0 * grade.half[rows] / grade.size[rows]
        reach = 1.25 * max(float(np.abs(shift[rows]).max()), 1e-9)
        ax.barh(y, 2 * half, left=-half, color="#dddddd", height=0.8, zorder=1)
        beyond = np.abs(shift[rows]) > half
        ax.barh(y, shift[rows], color=np.where(beyond, WRONG, PALETTE[0]), height=0.45, zorder=3)
        ax.axvline(0.0, color=BLACK, lw=0.8, zorder=4)
        ax.set(xlim=(-reach, reach), ylim=(len(rows) - 0.4, -0.6), xlabel="[%] of its size")
        ax.set_title("\n".join(wrap(source, 26)), fontsize=SMALL, color=GREY)
        ax.set_yticks(y, names, fontsize=SMALL)
        ax.tick_params(labelsize=SMALL)
        ax.grid(visible=False, axis="y")
    handles = [
        Patch(color="#dddddd", label="95 % interval"),
        Patch(color=PALETTE[0], label="shift within it"),
        Patch(color=WRONG, label="shift beyond it"),
    ]
    figure.legend(handles=handles, loc="outside lower left", ncols=3, fontsize=SMALL)
    return "bias", title, BIAS, figure
