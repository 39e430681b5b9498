"""The folder that the command `identify` writes: numbers, parameters, model, torques, pictures and a page."""

import csv
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from lwa4d_sim.assembly import versions
from lwa4d_sim.folders import claim, written_whole
from lwa4d_sim.identification.findings import Findings
from lwa4d_sim.identification.grades import LOST, grades
from lwa4d_sim.identification.model_file import write_unknowns
from lwa4d_sim.identification.report import command, write_identification_page
from lwa4d_sim.identification.words import details, headline, interval, meaning, sound
from lwa4d_sim.recordings.recording import Recording
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.yaml_text import dump

_NAMES = ("torque.csv", "identified.xml", "parameters.yaml", "identification.json", "report.html")
_OURS = (".csv", ".html", ".json", ".png", ".xml", ".yaml")  # what such a folder may hold, and the next one replaces


def claim_for(scenario: Scenario, out: Path, inputs: Sequence[Path] = ()) -> Path:
    """The folder for a scenario's results in ``out``, see `folders.claim`.

    Args:
        scenario: the scenario.
        out: where results go.
        inputs: files that must not lie in that folder, for it is replaced.
    """
    return claim(out / f"{scenario.name}-identify", _OURS, inputs, _NAMES)


def write_findings(folder: Path, found: Findings, model: Path, *, plots: bool = True, data: Sequence[str] = ()) -> None:
    """Write everything, whole or not at all.

    Args:
        folder: to be made or replaced.
        found: the answer.
        model: MJCF of the identified arm; it is written anew, for its meshes are named by their way from the file.
        plots: whether to draw, and to write the page.
        data: words of the command line that name measured data.

    Raises:
        RecordError: something cannot be written.
    """
    with written_whole(folder) as partial:
        text = json.dumps(record(found, data), indent=1, allow_nan=False)
        (partial / "identification.json").write_text(text + "\n", encoding="utf-8")
        (partial / "parameters.yaml").write_text(parameters_text(found), encoding="utf-8")
        about = f"identified from {found.scenario.name}, variant {found.variant}; see parameters.yaml beside this file"
        # written anew from the first, so that paths of meshes begin at the new place
        write_unknowns(found.problem.unknowns, found.identified, model, partial / "identified.xml", about)
        _write_torque(partial / "torque.csv", found)
        if plots:
            from lwa4d_sim.identification.parameter_plots import draw_parameters
            from lwa4d_sim.identification.plots import draw_motions

            motions, parameters = draw_motions(found, partial), draw_parameters(found, partial)
            figures = [motions[0], *parameters, *motions[1:]]
            write_identification_page(partial / "report.html", found, figures, data)


def as_object(found: Findings) -> dict[str, Any]:
    """What a program wants to know; what does not exist is None."""
    parameters = _parameters(found)
    return {
        "name": found.scenario.name,
        "variant": found.variant,
        "verdict": headline(found),
        "sound": sound(found),
        "parameters": parameters,
        "validation": {
            "nrmse": _plain(found.validation.nrmse["estimate"]),
            "model": _plain(found.validation.nrmse["identified"]),
            "nominal": _plain(found.validation.nrmse["nominal"]),
        },
        "bias": {cause: _named(found, shift) for cause, shift in found.bias.items()},
        "coverage": None if found.coverage is None else _named(found, found.coverage),
        "repeats": found.repeats,
        "tried": _plain(found.tried),
        "refined": None if found.refined is None else _plain(asdict(found.refined)),
        "lost": [name for name, row in parameters.items() if row["estimate"] is None],
        "remarks": list(found.remarks),
    }


def record(found: Findings, data: Sequence[str] = ()) -> dict[str, Any]:
    """For `identification.json`: the object, and all that its numbers depend on."""
    u, scenario, fit = found.problem.unknowns, found.scenario, found.fit
    columns = zip(u.names, u.units, found.identified, found.problem.nominal, strict=True)
    return {
        **as_object(found),
        "details": details(found),
        "covariance": _plain(np.where(np.isfinite(fit.std_error[:, None] * fit.std_error), fit.covariance, np.nan)),
        "model": {n: {"value": float(a), "nominal": float(b), "unit": unit} for n, unit, a, b in columns},
        "condition": _plain(fit.estimate.condition),
        "bandwidth": found.problem.options.bandwidth,
        "method": found.problem.options.method,
        "known": {name: float(value) for name, value in found.problem.fixed.items()},
        "position_noise": _plain(fit.equations.noise),
        "torque_noise": _plain(fit.torque_noise),
        "data": {
            "source": found.recording.source,
            "validation": found.validation.source,
            "joints": list(found.recording.joints),
            "samples": len(found.recording.t),
            "sha256": data_hash(found.recording),
        },
        "command": command(found, data),
        "source": scenario.source,
        "scenario": scenario.text,
        "overrides": dict(scenario.overrides),
        "settings": scenario.resolved(found.variant),
        "versions": versions(),
    }


def parameters_text(found: Findings) -> str:
    """For `parameters.yaml`: what was estimated, and the unknowns of the written model."""
    u = found.problem.unknowns
    columns = zip(u.names, u.units, found.identified, strict=True)
    document = {
        "name": found.scenario.name,
        "variant": found.variant,
        "parameters": _parameters(found),
        "model": {name: {"value": float(value), "unit": unit} for name, unit, value in columns},
    }
    keys = "parameters: as estimated, null where the data do not tell; model: the unknowns of identified.xml."
    return "".join(f"# {text}\n" for text in (*headline(found), keys)) + dump(document)


def data_hash(recording: Recording) -> str:
    """SHA-256 of the samples, as hexadecimal digits."""
    digest = hashlib.sha256()
    for values in (recording.t, recording.q, recording.since, recording.tau):
        digest.update(np.ascontiguousarray(values, "<f8").tobytes())
    return digest.hexdigest()


def _parameters(found: Findings) -> dict[str, dict[str, Any]]:
    p, x, s = found.problem.parameters, found.fit.estimate.x, found.fit.std_error
    model, nominal = found.problem.value(found.identified), found.problem.value(found.problem.nominal)
    told = grades(found).told
    made = {}
    for k, name in enumerate(p.names):
        ends = interval(found, k)
        made[name] = {
            "estimate": None if told[k] == LOST else _plain(x[k]),
            "std_error": None if told[k] == LOST else _plain(s[k]),
            "interval": None if ends is None else list(ends),
            "truth": None if found.truth is None else _plain(found.truth[k]),
            "unit": p.units[k],
            "words": p.words[k],
            "meaning": meaning(name),
            "told": told[k],
            "model": _plain(model[k]),
            "nominal": _plain(nominal[k]),
        }
    return made


def _named(found: Findings, values: Any) -> dict[str, Any]:
    return dict(zip(found.problem.parameters.names, _plain(values), strict=True))


def _plain(value: Any) -> Any:
    """Numbers, lists and mappings that JSON can hold; what is not finite is None."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _write_torque(path: Path, found: Findings) -> None:
    """Torques on the second motion, filtered, a column for each joint and model."""
    v = found.validation
    columns = {"measured": v.torque, **v.predictions}
    with path.open("w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["time [s]", *(f"{joint} {name} [N m]" for name in columns for joint in found.recording.joints)])
        table.writerows([f"{value:.9g}" for value in row] for row in np.column_stack([v.t, *columns.values()]).tolist())
