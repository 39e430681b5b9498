"""The picture of a slice of the workspace: the critical gain in each pose, and which joint limits it."""

from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from lwa4d_sim.drawing import BLACK, GREY, LOOK, PALETTE, SMALL, Picture, save
from lwa4d_sim.interfaces import Array
from lwa4d_sim.stability import guides as guides
from lwa4d_sim.stability.findings import Charts, Findings
from lwa4d_sim.stability.maps import Slice
from lwa4d_sim.stability.plots import canvas

NOWHERE = "#d0d0d0"  # no limit, or none worth a colour
_COLOURS: tuple[str, ...] = (
    *PALETTE,
    "#F0E442",
    "#8c6d31",
    "#999999",
    "#000000",
)  # a joint each; Okabe and Ito's yellow as the seventh
_WIDEST = 4.0  # factor on the gains at which the colours end, alike on all maps (assumed: more is plenty)
_TICKS = (0.25, 0.5, 0.7, 1.0, 1.4, 2.0, 4.0)


class Plane(NamedTuple):
    """Where a map is drawn: coordinates of its nodes and of the operating points, and names of the axes."""

    x: Array
    y: Array
    at: Array
    labels: tuple[str, str]
    in_space: bool


def draw_map(found: Findings, charts: Charts, one: Slice, folder: Path) -> Picture:
    """Draw the map into ``folder``.

    Raises:
        RecordError: the file cannot be written.
    """
    a, b = (j + 1 for j in one.joints)
    title = "Critical gain over the workspace"
    plane = plane_of(found, one)
    with matplotlib.style.context(LOOK):
        figure = canvas(found, title, 5.4)
        left, right = figure.subplots(1, 2, sharex=True, sharey=True)
        _margins(figure, (left, right), plane, charts, one)
        shown = _limiting(right, plane, one)
        for ax in (left, right):
            _points(ax, plane, found, charts)
            ax.set_xlabel(plane.labels[0])
            if plane.in_space:
                ax.set_aspect("equal")
        left.set_ylabel(plane.labels[1])
        left.set_title("critical factor on all gains", fontsize=SMALL)
        right.set_title("joint that moves most at the limit", fontsize=SMALL)
        _legend(figure, shown, charts)
        place = "where the tool is, in the vertical plane of the arm" if plane.in_space else "over the two joint angles"
        text = guides.MAP.format(a=a, b=b, place=place)
        return save(figure, Picture(folder / "workspace.png", title, text))


def plane_of(found: Findings, one: Slice) -> Plane:
    """The vertical plane that the tool moves in; where it moves in none, the two joint angles [deg]."""
    points = np.stack([point.x for point in found.points])
    flat = one.x.reshape(-1, 3)
    _, sizes, axes = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    normal = axes[2]
    if sizes[2] < 1e-6 * sizes[0] and sizes[1] > 1e-3 * sizes[0] and abs(normal[2]) < 1e-6:
        along = np.array([-normal[1], normal[0], 0.0])
        along *= 1.0 if found.study.blocks.arm.kinematics.point(found.study.waypoints().q[:1])[0] @ along >= 0 else -1.0
        aside = float(flat.mean(axis=0) @ normal)  # of the plane from the base's axis
        distance = np.sqrt(np.maximum(0.0, points[:, 0] ** 2 + points[:, 1] ** 2 - aside**2))
        at = np.stack([distance, points[:, 2]], axis=1)
        return Plane(
            one.x @ along, one.x[..., 2], at, ("horizontal distance of the tool [m]", "height of the tool [m]"), True
        )
    a, b = one.joints
    x, y = np.meshgrid(np.degrees(one.first), np.degrees(one.second), indexing="ij")
    at = np.degrees(np.stack([point.q[[a, b]] for point in found.points]))
    return Plane(x, y, at, (f"joint {a + 1} [°]", f"joint {b + 1} [°]"), False)


def _margins(figure: Figure, axes: tuple[Axes, Axes], plane: Plane, charts: Charts, one: Slice) -> None:
    span, margin = _WIDEST, np.clip(one.gain_margin, 1e-3, 1e3)
    too_weak = ~charts.map_stable & (margin > 1.0)  # red as well: there the factor is the least that is needed
    logs = np.log(np.where(too_weak, 1.0 / margin, margin))
    cells = np.exp(0.25 * (logs[1:, 1:] + logs[:-1, 1:] + logs[1:, :-1] + logs[:-1, :-1]))
    ax = axes[0]
    colours = matplotlib.colormaps["RdBu"]
    mesh = ax.pcolormesh(
        plane.x, plane.y, cells, cmap=colours, norm=LogNorm(1 / span, span), shading="flat", rasterized=True
    )
    if logs.min() < 0.0 < logs.max():
        ax.contour(plane.x, plane.y, logs, levels=[0.0], colors=[BLACK], linewidths=1.4)
    bar = figure.colorbar(mesh, ax=list(axes), location="bottom", shrink=0.55, pad=0.03, extend="both")
    bar.ax.xaxis.set_major_locator(FixedLocator(_TICKS))
    bar.ax.xaxis.set_minor_locator(NullLocator())
    bar.ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    bar.ax.tick_params(labelsize=SMALL)


def _limiting(ax: Axes, plane: Plane, one: Slice) -> list[int]:
    """The joints that limit somewhere."""
    shown = [int(j) for j in np.unique(one.limiting)]
    colours = ListedColormap([NOWHERE if j < 0 else _COLOURS[int(j) % len(_COLOURS)] for j in shown])
    index = np.searchsorted(np.array(shown), one.limiting[:-1, :-1])
    norm = BoundaryNorm(np.arange(len(shown) + 1) - 0.5, len(shown)) if len(shown) > 1 else None
    ax.pcolormesh(plane.x, plane.y, index, cmap=colours, norm=norm, shading="flat", rasterized=True)
    return shown


def _points(ax: Axes, plane: Plane, found: Findings, charts: Charts) -> None:
    at = plane.at[list(charts.rows)]
    near = 0.1 * np.array([np.ptp(plane.x), np.ptp(plane.y)])
    box: Any = {"facecolor": "white", "alpha": 0.75, "pad": 0.6, "linewidth": 0}
    for k, place in zip(charts.rows, at, strict=True):
        x, y = place
        face, edge = (BLACK, "white") if charts.alike[k] else ("white", BLACK)
        ax.plot(x, y, "o", ms=7, mfc=face, mec=edge, zorder=6)
        if found.names[k].startswith("t"):
            continue
        # beside a neighbour on the right the name goes to the left
        beside = (at[:, 0] > x) & (np.abs(at - place) < near).all(axis=1)
        shift, side = ((-6, 5), "right") if beside.any() else ((6, 5), "left")
        where: Any = {"textcoords": "offset points", "ha": side, "fontsize": SMALL, "bbox": box, "zorder": 7}
        ax.annotate(found.names[k].rsplit(" ", 1)[-1], (x, y), shift, **where)


def _legend(figure: Figure, shown: list[int], charts: Charts) -> None:
    handles: list[Any] = [
        Patch(color=NOWHERE if j < 0 else _COLOURS[j % len(_COLOURS)], label="no limit" if j < 0 else f"joint {j + 1}")
        for j in shown
    ]
    if any(charts.alike):
        handles.append(Line2D([], [], ls="", marker="o", ms=7, mfc=BLACK, mec="white", label="operating point"))
    if not all(charts.alike):
        handles.append(Line2D([], [], ls="", marker="o", ms=7, mfc="white", mec=BLACK, label="tool point, other pose"))
    figure.legend(handles=handles, loc="outside lower right", ncols=5, fontsize=SMALL, labelcolor=GREY)
