"""The page of a stability analysis: verdict, margins, pictures with their guides, and the command to repeat it."""

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lwa4d_sim.assembly import versions
from lwa4d_sim.drawing import Picture
from lwa4d_sim.page import write_page
from lwa4d_sim.settings import CanopenLoop, IdealLoop
from lwa4d_sim.stability.findings import Findings
from lwa4d_sim.stability.maps import default_joints
from lwa4d_sim.stability.words import details, factor, headline, milliseconds, radius, unstable

_SIZE = 50  # of a map that no option made larger or smaller


def write_stability_page(path: Path, found: Findings, figures: Sequence[Picture]) -> None:
    """Write the page, whole or not at all.

    Raises:
        RecordError: a figure cannot be read or the page cannot be written.
    """
    scenario = found.scenario
    write_page(
        path,
        "stability.html.j2",
        title=f"{scenario.name}, {found.variant}",
        headline=headline(found),
        details=details(found),
        unstable=any(map(unstable, found.points)),
        about=_about(found),
        remarks=[f"{text[:1].upper()}{text[1:]}." for text in found.remarks],
        rows=_rows(found),
        figures=figures,
        command=command(found),
        versions=versions(),
        source=scenario.source,
        scenario=scenario.text,
    )


def command(found: Findings) -> str:
    """The command line that gives these numbers again."""
    scenario = found.scenario
    words = ["lwa4d-sim", "stability", scenario.source, "--variant", found.variant]
    for key, value in scenario.overrides.items():
        words += ["--set", f"{key}={json.dumps(value)}"]
    for pose in found.poses:
        words.append(f"--pose={pose}")
    if found.charts is not None and found.charts.map is not None:
        one = found.charts.map
        if one.joints != default_joints(found.study):
            words += ["--joints", ",".join(str(j + 1) for j in one.joints)]
        if len(one.first) != _SIZE:
            words += ["--size", str(len(one.first))]
    return shlex.join(words)


def _about(found: Findings) -> str:
    """What loop was looked at."""
    study = found.study
    loop = study.loop_settings
    if isinstance(loop, IdealLoop):
        return "The controller in continuous time, without a bus."
    bus = "CANopen bus" if isinstance(loop, CanopenLoop) else "bus"
    acts = "at the next SYNC" if loop.actuation == "next_sync" else "as soon as they arrive"
    return f"The controller under a {bus} with a period of {1e3 * study.period:.4g} ms, torques acting {acts}."


def _rows(found: Findings) -> list[Mapping[str, Any]]:
    return [
        {
            "name": name,
            "unstable": unstable(point),
            "radius": radius(point.spectral_radius),
            "gain": factor(point.gain_margin),
            "delay": milliseconds(point.delay_margin),
            "jitter": milliseconds(point.jitter_margin),
            "frequency": f"{point.mode.frequency:.1f}",
            "joint": int(point.mode.share.argmax()) + 1,
            "q": _vector(point.q),
            "x": _vector(point.x),
        }
        for name, point in zip(found.names, found.points, strict=True)
    ]


def _vector(values: Any) -> str:
    return ", ".join(f"{value:.4f}" for value in values)
