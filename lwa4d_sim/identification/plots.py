"""Pictures of the motions and torques of an identification: the thesis's figure, validation, limits, remainder."""

from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullFormatter

from lwa4d_sim.arm import ARMS
from lwa4d_sim.assembly import build_blocks
from lwa4d_sim.drawing import BLACK, GREY, LOOK, PALETTE, SMALL, Picture, envelope, plain, save
from lwa4d_sim.identification.findings import Findings
from lwa4d_sim.identification.grades import WELL, grades
from lwa4d_sim.identification.parameter_plots import sheet
from lwa4d_sim.identification.words import joint_error, percent, squared
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import joint_facts

CLOSE = 1e-3  # assumed: spread of the curves below which they are drawn in parts per million
CURVES = 8  # parameters whose course is drawn (assumed: colours that an eye can tell apart)
TOGETHER = 4  # joints on one picture of torques (assumed: a page's height)
COLOURS = (*PALETTE, GREY, BLACK)
MODELS = {"estimate": PALETTE[0], "identified": PALETTE[1], "nominal": PALETTE[2]}

ASKED = "In the layout of the thesis's Figure 5.2. A: the motion that was asked for. "
ESTIMATION = (
    "B: the joint angles that were measured. C: the estimates as they would have been at each instant (recursive least "
    "squares, thesis, eq. 4.29, begun without any belief), each over its {over}: all should settle at the dashed line. "
    "What is wild at first runs out of the panel. {some}What to look for: curves that still drift at the end want a "
    "longer or livelier motion."
)
TORQUE = (
    "A motion that the estimate has not seen. Wide: measured torque, seen through the same filter as the equations "
    "({bandwidth:g} Hz, zero phase). Thin: what the estimate and the nominal model predict from the measured angles; a "
    "nominal model that is far off runs out of the panel. Below each joint: what the estimate gets wrong, on its own "
    "scale. The rms error is given in per cent of the torque's standard deviation, for the written model (identified) "
    "as well. What to look for: a remainder that follows the motion is a model that lacks something; one that looks "
    "like noise is noise."
)
USED = (
    "How much of its room each joint used: the range of angles, and the largest speed and torque to either side, with "
    "numbers. Black: limits of the model, and of SCHUNK's modules for speed; a joint without a limit has none drawn. "
    "What to look for: a joint that hardly moves tells little about its own parameters."
)
REMAINDER = (
    "Spectrum of what the fit leaves over, joint by joint (grey dots), and what the estimated noise of positions and "
    "torques would leave (line). What to look for: dots that follow the line. Where they rise above it, mostly at low "
    "frequencies, something is in the data that is neither the model nor noise, and the intervals are too narrow."
)
TRIED = (
    "The controller that the scenario names under identify.control, run on the second motion with the nominal model "
    "and with the identified one: rms error of each joint, and of the tool. A run that starts away from its motion has "
    "that jump in its numbers."
)


def draw_motions(found: Findings, folder: Path) -> list[Picture]:
    """Draw everything but the parameters into ``folder``.

    Raises:
        RecordError: a file cannot be written.
    """
    n = found.recording.n
    parts = [range(start, min(start + TOGETHER, n)) for start in range(0, n, TOGETHER)]
    with matplotlib.style.context(LOOK):
        torque = [_torque(found, joints, k) for k, joints in enumerate(parts, start=1)]
        made = [_estimation(found), *torque, _tried(found), _used(found), _remainder(found)]
        return [
            save(figure, Picture(folder / f"{stem}.png", title, text))
            for stem, title, text, figure in (one for one in made if one is not None)
        ]


def reference(found: Findings) -> tuple[Array, Array] | None:
    """Instants (T,) [s] and the joint angles (T, n) that the scenario asks for; None where the data are no run's."""
    if found.truth is None:
        return None
    trajectory = build_blocks([found.scenario], found.variant, 1).infos[0].trajectory
    t = np.linspace(0.0, trajectory.duration, 801)
    return t, trajectory.joint(t).q


def _estimation(found: Findings) -> tuple[str, str, str, Figure]:
    title = "Estimation of the parameters"
    recording, joints = found.recording, found.recording.joints
    asked = reference(found)
    figure = sheet(found, title, 7.2, head=0.62)
    grid = figure.add_gridspec(2, 2, height_ratios=[1.0, 1.5])
    places = [grid[0, 0], grid[0, 1]] if asked is not None else [grid[0, :]]
    axes = [figure.add_subplot(place) for place in places]
    curves = [] if asked is None else [(axes[0], "A  reference trajectories", *asked)]
    curves.append((axes[-1], "B  joint positions", recording.t, recording.q))
    for ax, name, t, q in curves:
        for j in range(recording.n):
            at = t if t.ndim == 1 else t[:, j]
            keep = envelope(q[:, j])
            ax.plot(at[keep], q[keep, j], color=COLOURS[j % len(COLOURS)], lw=1.4, label=plain(joints[j]))
        ax.set_title(name, fontsize="medium", loc="left")
        ax.set(xlabel="time [s]", ylabel="angle [rad]", xlim=(0.0, recording.end))
    if asked is not None:
        axes[0].set_ylim(*_common(axes))
        axes[1].set_ylim(axes[0].get_ylim())
    place: Any = {"loc": "upper left", "bbox_to_anchor": (0.01, 1.0 - 0.33 / figure.get_figheight())}
    figure.legend(*axes[-1].get_legend_handles_labels(), ncols=8, fontsize=SMALL, handlelength=1.2, **place)
    rest = _course(figure.add_subplot(grid[1, :]), found)
    over = "final value" if found.truth is None else "true value"
    text = ("" if asked is None else ASKED) + ESTIMATION.format(over=over, some=rest)
    return "estimation", title, text, figure


def _common(axes: list[Axes]) -> tuple[float, float]:
    limits = np.array([ax.get_ylim() for ax in axes])
    return float(limits[:, 0].min()), float(limits[:, 1].max())


def _course(ax: Axes, found: Findings) -> str:
    """Draw panel C; says which parameters are in it."""
    parameters = found.problem.parameters
    t, values = found.convergence
    goal = found.fit.estimate.x if found.truth is None else found.truth
    grade = grades(found)
    # those that make most torque, of which there is something to see
    torque = np.sqrt((found.problem.columns(found.fit.equations) ** 2).mean(axis=(0, 1))) * np.abs(goal)
    shown = [k for k in np.argsort(-torque) if np.isfinite(values[-1, k]) and torque[k] > 0]
    first = [k for k in shown if grade.told[k] == WELL] or shown
    picked = sorted(first[:CURVES])
    enough = np.arange(1, len(t) + 1) * found.recording.n >= len(parameters.names)
    share = np.where(enough[:, None], values[:, picked] / goal[picked], np.nan)
    settled = share[len(share) // 4 :]
    low, high = (float(f(settled, initial=1.0)) for f in (np.nanmin, np.nanmax))
    room = max(0.5 * (high - low), 1e-6)
    over = "final value" if found.truth is None else "true value"
    label, goes_to = f"estimate / {over}", 1.0
    if high - low + room < CLOSE:  # parts per million of what is left, for an axis cannot show 1.000001
        share, low, high, room = 1e6 * (share - 1.0), 1e6 * (low - 1.0), 1e6 * (high - 1.0), 1e6 * room
        label, goes_to = f"estimate off the {over} [ppm]", 0.0
    for k, column, colour in zip(picked, share.T, COLOURS, strict=False):
        value = f"{found.fit.estimate.x[k]:.4g} {squared(parameters.units[k])}"
        ax.plot(t, column, color=colour, lw=1.5, label=f"{plain(parameters.names[k])} = {value}")
    ax.axhline(goes_to, color=BLACK, ls="--", lw=1.2, zorder=4)
    ax.set_title("C  estimated parameters", fontsize="medium", loc="left")
    ax.set(xlabel="time [s]", ylabel=label, xlim=(0.0, found.recording.end), ylim=(low - room, high + room))
    ax.legend(fontsize=SMALL, loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=3, handlelength=1.4)
    return (
        ""
        if len(picked) == len(parameters.names)
        else (f"Drawn are the {len(picked)} well-told parameters that make most torque, of {len(parameters.names)}. ")
    )


def _torque(found: Findings, joints: range, number: int) -> tuple[str, str, str, Figure]:
    """The joints ``joints``, on the picture ``number`` of several."""
    title = "Torque on a motion that was not used"
    v, names = found.validation, found.recording.joints
    figure = sheet(found, title, 1.2 + 1.5 * len(joints))
    axes = figure.subplots(2 * len(joints), 1, sharex=True, height_ratios=[1.9, 1.0] * len(joints))
    wide: Any = {"color": "#aaaaaa", "lw": 4.0}
    thin: Any = {
        name: {"color": MODELS[name], "lw": 1.3, "ls": style} for name, style in (("nominal", ":"), ("estimate", "-"))
    }
    for j, (ax, below) in zip(joints, axes.reshape(-1, 2), strict=True):
        ax.plot(v.t, v.torque[:, j], zorder=2, **wide)
        for name, style in thin.items():
            ax.plot(v.t, v.predictions[name][:, j], **style)
        near, far = float(v.torque[:, j].min()), float(v.torque[:, j].max())
        room = max(0.5 * (far - near), 1e-9)  # a nominal model that is far off may not squash the rest
        ax.set_ylim(max(ax.get_ylim()[0], near - room), min(ax.get_ylim()[1], far + room))
        below.plot(v.t, v.torque[:, j] - v.predictions["estimate"][:, j], color=MODELS["estimate"], lw=0.9)
        ax.set_ylabel(f"{plain(names[j])}\n[N m]", fontsize=SMALL)
        below.set_ylabel("wrong\nby", fontsize=SMALL)
        errors = ", ".join(f"{name} {percent(v.nrmse[name][j])}" for name in MODELS)
        place: Any = {"transform": ax.transAxes, "ha": "right", "va": "bottom", "fontsize": SMALL, "color": GREY}
        ax.text(0.995, 1.0, f"rms error: {errors}", **place)
        for one in (ax, below):
            one.tick_params(labelsize=SMALL)
            one.yaxis.get_offset_text().set_fontsize(SMALL)
    axes[-1].set(xlabel="time [s]", xlim=(v.t[0], v.t[-1]))
    figure.align_ylabels(list(axes))
    handles = [Line2D([], [], label="measured", **wide), *(Line2D([], [], label=name, **thin[name]) for name in thin)]
    figure.legend(handles=handles, loc="outside lower left", ncols=4, fontsize=SMALL)
    text = TORQUE.format(bandwidth=found.problem.options.bandwidth)
    return f"torque_{number}" if number > 1 else "torque", title, text, figure


def _used(found: Findings) -> tuple[str, str, str, Figure]:
    title = "What the motion used of the limits"
    recording, motion = found.recording, found.fit.equations.motion
    facts = joint_facts(found.problem.model)
    arm = ARMS.get(found.scenario.variants[found.variant].arm)
    fast = np.full(recording.n, np.nan) if arm is None else arm.velocity_max
    ends = np.array([(np.nan, np.nan) if limits is None else limits for _, limits, _ in facts])
    strong = np.array([peak if np.isfinite(peak) else np.nan for _, _, peak in facts])
    panels = [
        ("angle [rad]", motion.q, ends),
        ("speed [rad/s]", motion.dq, np.stack([-fast, fast], axis=1)),
        ("torque [N m]", recording.tau, np.stack([-strong, strong], axis=1)),
    ]
    figure = sheet(found, title, _height(recording.n))
    y = np.arange(recording.n)
    for ax, (label, values, limits) in zip(figure.subplots(1, 3, sharey=True), panels, strict=True):
        low, high = np.nanmin(values, axis=0), np.nanmax(values, axis=0)
        ax.barh(y, high - low, left=low, color=PALETTE[0], height=0.5, zorder=2)
        for j, pair in enumerate(limits):
            ax.plot(pair, [j, j], "|", color=BLACK, ms=14, mew=1.6, zorder=3)
            few = max(
                0, 2 - int(np.floor(np.log10(max(-low[j], high[j], 1e-9))))
            )  # decimals: three digits of the larger
            used = f"{low[j]:.{few}f} to {high[j]:.{few}f}".replace("-", "\u2212")
            ax.text((low[j] + high[j]) / 2, j - 0.29, used, fontsize=SMALL, color=GREY, ha="center", va="bottom")
        ax.set(xlabel=label, ylim=(recording.n - 0.4, -0.7))
        ax.set_yticks(y, [plain(name) for name in recording.joints])
        ax.grid(visible=False, axis="y")
        ax.margins(x=0.08)
    return "excitation", title, USED, figure


def _height(rows: int) -> float:
    return 1.3 + 0.5 * max(rows, 2)


def _remainder(found: Findings) -> tuple[str, str, str, Figure]:
    title = "What the fit leaves over"
    fit, n = found.fit, found.recording.n
    residual, step = fit.estimate.residual, float(np.median(np.diff(fit.equations.t)))
    # as in `noise`: the mean is left out, and a spectrum's value is a variance [N^2 m^2]
    spectrum = np.abs(np.fft.rfft(residual, axis=0)[1:]) ** 2 / len(residual)
    position, torque = fit.equations.noise, fit.torque_noise
    noise = np.einsum("ijb,j->ib", fit.influence.rows_position, position**2)
    noise = noise + fit.influence.rows_torque * torque[:, None] ** 2
    f = np.arange(1, len(spectrum) + 1) / (step * len(residual))
    columns = min(n, 3)
    rows = -(-n // columns)
    figure = sheet(found, title, 1.0 + 2.2 * rows)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True).ravel()
    for ax in axes[n:]:
        ax.set_axis_off()
    for j, ax in enumerate(axes[:n]):
        ax.loglog(f, np.sqrt(spectrum[:, j]), ".", color="#999999", ms=3)
        ax.loglog(f, np.sqrt(noise[j]), color=PALETTE[1], lw=1.6)
        ax.set_title(plain(found.recording.joints[j]), fontsize=SMALL, color=GREY)
        level = np.sqrt(np.concatenate([spectrum[:, j], noise[j]]))
        if (level > 0).any():  # the few dots far below say nothing
            ax.set_ylim(np.quantile(level[level > 0], 0.05) / 2.0, level.max() * 2.0)
        ax.tick_params(labelsize=SMALL)
        ax.yaxis.set_minor_formatter(NullFormatter())
    for j in range(max(0, n - columns), n):
        axes[j].set_xlabel("frequency [Hz]")
        axes[j].tick_params(labelbottom=True)
    for ax in axes[::columns]:
        ax.set_ylabel("remainder [N m]")
    handles = [
        Line2D([], [], ls="", marker=".", color="#999999", label="left over by the fit"),
        Line2D([], [], color=PALETTE[1], lw=1.6, label="what the noise would leave"),
    ]
    figure.legend(handles=handles, loc="outside lower left", ncols=2, fontsize=SMALL)
    return "remainder", title, REMAINDER, figure


def _tried(found: Findings) -> tuple[str, str, str, Figure] | None:
    if found.tried is None:
        return None
    title = "A controller, before and after"
    figure = sheet(found, title, 3.6)
    joints, tool = figure.subplots(1, 2, width_ratios=[max(3, found.recording.n), 3])
    for k, name in enumerate(("nominal", "identified")):
        run: Any = found.tried[name]
        shake = "" if run["stable"] else ", shakes"
        y = 1e3 * np.asarray(run["rms_joint_error"])
        style: Any = {"width": 0.36, "color": MODELS[name], "zorder": 2}
        joints.bar(
            np.arange(len(y)) + 0.4 * k - 0.2, y, label=f"{name}{shake}: {1e3 * joint_error(run):.3g} mrad", **style
        )
        errors = [1e3 * run["rms_error"], 1e3 * run["max_error"]]
        tool.bar(np.arange(2) + 0.4 * k - 0.2, errors, **style)
        for x, value in enumerate(errors):
            tool.text(x + 0.4 * k - 0.2, value, f"{value:.3g}", ha="center", va="bottom", fontsize=SMALL)
    joints.set_xticks(range(found.recording.n), [plain(name) for name in found.recording.joints], fontsize=SMALL)
    tool.set_xticks(range(2), ["rms", "largest"])
    joints.set_ylabel("rms joint error [mrad]")
    tool.set_ylabel("tool error [mm]")
    for ax in (joints, tool):
        ax.grid(visible=False, axis="x")
        ax.margins(y=0.15)
    figure.legend(loc="outside lower left", ncols=2, fontsize=SMALL)
    return "control", title, TRIED, figure
