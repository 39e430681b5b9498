"""Picture of a bus: one cycle as a time line, and every identifier's response times beside their worst case."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from lwa4d_sim.bus_timing import BusTiming, analyse
from lwa4d_sim.drawing import GREY, LOOK, PALETTE, SMALL, WIDTH, Picture, save
from lwa4d_sim.interfaces import NS_PER_S
from lwa4d_sim.record import RunLog
from lwa4d_sim.settings import CanopenLoop

BINS = 150  # of each identifier's histogram
LEAST_CYCLES = 3  # a shorter run has no cycle that is like the next

_KINDS = ("SYNC and NMT", "measurements (TPDO)", "set-points (RPDO)", "the rest")
_COLOURS = (PALETTE[1], PALETTE[0], PALETTE[2], GREY)

CAPTION = (
    "Above: one cycle on the wire, a bar for each frame from its first to its last bit, one line a station. "
    "Below: for each identifier, the most urgent on top, a histogram of how long its frames took from queued to "
    "received, and in grey the worst that can happen by analysis. The analysis knows no bit errors: only on a wire "
    "that has some may a frame go beyond the grey. An identifier without grey has no bound: the bus is overloaded for "
    "it."
)


def draw_timing(timing: BusTiming, title: str, period: float, path: Path) -> Picture:
    """Draw one cycle and the response times.

    Args:
        timing: of the run.
        title: of the picture.
        period: SYNC period [s].
        path: of the PNG.
    """
    with matplotlib.style.context(LOOK):
        height = 2.6 + 0.17 * len(timing.responses) + 0.25 * len(timing.log.names)
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(title)
        line, below = figure.subplots(
            2, 1, height_ratios=[max(2, len(timing.log.names)) + 3, 0.6 * len(timing.responses) + 2]
        )
        _time_line(line, timing, period)
        _responses(below, timing)
        figure.legend(*line.get_legend_handles_labels(), ncols=4, fontsize=SMALL, loc="outside lower center")
        return save(figure, Picture(path, title, CAPTION))


def draw_buses(logs: Mapping[str, RunLog], folder: Path) -> list[Picture]:
    """Draw the bus of each run that was on one, as ``bus_VARIANT.png``."""
    drawn = []
    for name, log in logs.items():
        bit_rate = log.scenario.get("loop", {}).get("bit_rate", CanopenLoop().bit_rate)
        cycles = (len(log.q) - 1) * log.timestep // log.period
        if log.frames is None or bit_rate is None or cycles < LEAST_CYCLES:
            continue
        found = analyse(log.frames, bit_rate, log.period, cycles)
        title = f"The bus of {name}: one cycle at {bit_rate // 1000} kbit/s"
        drawn.append(draw_timing(found, title, log.period / NS_PER_S, folder / f"bus_{name}.png"))
    return drawn


def _kind(can_id: int) -> int:
    if can_id in (0x000, 0x080):
        return 0
    if 0x180 <= can_id < 0x580:
        return 1 if can_id & 0x080 else 2
    return 3


def _time_line(ax: Axes, timing: BusTiming, period: float) -> None:
    log = timing.log
    rows = timing.cycle
    first = (log.started[rows] - timing.start) / NS_PER_S * 1e3
    last = (timing.end - timing.start) / NS_PER_S * 1e3
    kinds = np.array([_kind(int(i)) for i in log.id[rows]])
    lanes = [log.names[n] for n in log.node[rows]]
    names = sorted(set(lanes), key=lambda lane: (lane != "master", len(lane), lane))  # node 9 before node 10
    place = {name: k for k, name in enumerate(names)}
    y = np.array([place[lane] for lane in lanes])
    for kind, (label, colour) in enumerate(zip(_KINDS, _COLOURS, strict=True)):
        pick = kinds == kind
        if pick.any():
            ax.barh(
                y[pick],
                (last - first)[pick],
                left=first[pick],
                height=0.8,
                color=colour,
                label=label,
                edgecolor="white",
                linewidth=0.6,
            )
    ax.set_yticks(range(len(names)), names, fontsize=SMALL)
    ax.invert_yaxis()
    ax.set_xlim(0, period * 1e3)
    ax.set_xlabel("time in the cycle [ms]")
    ax.set_title(f"bus load {100 * timing.load:.0f} %", fontsize=SMALL, loc="right")


def _responses(ax: Axes, timing: BusTiming) -> None:
    finite = [1e3 * response.bound for response in timing.responses if np.isfinite(response.bound)]
    right = 1.02 * max([*finite, *(1e3 * float(response.seen.max()) for response in timing.responses)], default=1.0)
    edges = np.linspace(0.0, right, BINS + 1)
    for k, response in enumerate(timing.responses):
        if np.isfinite(response.bound):
            ax.barh(k, response.bound * 1e3, height=0.8, color="#e4e4e4")
        counts, _ = np.histogram(response.seen * 1e3, edges)
        some = counts > 0
        # the axis points down; even a single frame is seen
        height = -(0.15 + 0.65 * counts[some] / counts.max())
        colour = _COLOURS[_kind(response.id)]
        ax.bar(edges[:-1][some], height, right / BINS, bottom=k + 0.4, align="edge", color=colour)
    ax.set_yticks(range(len(timing.responses)), [f"{r.name}" for r in timing.responses], fontsize=SMALL - 3)
    ax.set_ylim(len(timing.responses) - 0.4, -0.6)
    ax.set_xlim(0, right)
    ax.grid(axis="y", visible=False)
    ax.set_xlabel("from queued to received [ms]; grey: worst case by analysis")
