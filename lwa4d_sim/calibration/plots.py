"""The picture of a calibration: how far each pose was off, before and after."""

from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from lwa4d_sim.calibration.fit import residual
from lwa4d_sim.calibration.study import Study
from lwa4d_sim.drawing import BLACK, GREY, LOOK, PALETTE, SMALL, Picture, canvas, save
from lwa4d_sim.interfaces import Array

_CAPTION = (
    "Distance (and angle) between measured poses and those of the arm, one mark a pose; left of the dotted line poses "
    "that were fitted, right of it poses that the fit has not seen. Dashed: what the instrument's stated noise alone "
    "would give as a root mean square."
)


def draw_errors(study: Study, name: str, folder: Path) -> Picture:
    """Draw errors.png into ``folder``.

    Args:
        study: the calibration.
        name: of the arm.
        folder: where.

    Raises:
        RecordError: the file cannot be written.
    """
    title = "Errors of the tool before and after calibration"
    instrument = study.instrument
    panels = [("position error [mm]", 0, 1e3, instrument.position)]
    if instrument.angle is not None:
        panels.append(("angle error [mrad]", 1, 1e3, instrument.angle))
    with matplotlib.style.context(LOOK):
        height = 1.4 + 2.4 * len(panels)
        figure = canvas(title, name, height)
        axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
        figure.subplots_adjust(left=0.11, right=0.97, bottom=0.55 / height, top=1 - 0.85 / height, hspace=0.12)
        for ax, (label, which, factor, sigma) in zip(axes, panels, strict=True):
            for xi, colour, marker, text in (
                (np.zeros_like(study.fit.xi), PALETTE[1], "o", "nominal arm"),
                (study.fit.xi, PALETTE[0], "s", "calibrated arm"),
            ):
                sizes = factor * np.concatenate([_sizes(study, xi, data)[which] for data in (study.data, study.unseen)])
                ax.plot(np.arange(1, len(sizes) + 1), sizes, marker, ms=4, color=colour, label=text)
            ax.axhline(factor * sigma * np.sqrt(3), color=GREY, ls="--", lw=1.0, label="stated noise")
            ax.axvline(len(study.data.q) + 0.5, color=BLACK, ls=":", lw=1.0)
            ax.set(ylabel=label, yscale="log")
            ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            ax.yaxis.set_minor_formatter(NullFormatter())
        axes[0].annotate(" unseen", (len(study.data.q) + 0.5, 1.0), ha="left", **_ABOVE)
        for k in study.fit.outliers:
            axes[0].annotate(f"{study.data.labels[k]} does not fit", (k + 1, 1.0), ha="center", **_ABOVE)
        axes[-1].set_xlabel("pose")
        figure.align_ylabels(axes)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="upper left", bbox_to_anchor=(0.01, 1 - 0.33 / height), ncols=3)
        return save(figure, Picture(folder / "errors.png", title, _CAPTION))


_ABOVE: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "va": "bottom", "fontsize": SMALL, "color": GREY}


def _sizes(study: Study, xi: Array, data: Any) -> tuple[Array, Array]:
    shifts, turns = residual(study.model, xi, data)
    return np.linalg.norm(shifts, axis=1), np.linalg.norm(turns, axis=1)
