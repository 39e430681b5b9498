"""The page of an identification: verdict, parameters, pictures, biases, and the command to repeat it."""

import json
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lwa4d_sim.assembly import versions
from lwa4d_sim.identification.findings import Findings
from lwa4d_sim.identification.grades import LOST, WELL, grades
from lwa4d_sim.identification.words import details, headline, interval, meaning, sound, squared
from lwa4d_sim.page import NONE, write_page
from lwa4d_sim.settings import CanopenLoop, IdealLoop

if TYPE_CHECKING:
    from lwa4d_sim.drawing import Picture

_ROUNDING = 1e-12  # of a parameter's size; less is rounding of sums and shown as 0 (derived: 1e4 roundings)


def write_identification_page(
    path: Path, found: Findings, figures: "Sequence[Picture]", data: Sequence[str] = ()
) -> None:
    """Write the page, whole or not at all.

    Args:
        path: of the page.
        found: the answer.
        figures: in the order of the page.
        data: see `command`.

    Raises:
        RecordError: a figure cannot be read or the page cannot be written.
    """
    scenario = found.scenario
    write_page(
        path,
        "identify.html.j2",
        title=f"{scenario.name}, {found.variant}",
        headline=" ".join(headline(found)),
        details=details(found),
        sound=sound(found),
        about=_about(found),
        remarks=[f"{text[:1].upper()}{text[1:].rstrip('.')}." for text in found.remarks],
        rows=_rows(found),
        truth=found.truth is not None,
        coverage=found.coverage is not None,
        biases=_biases(found),
        predictions=_predictions(found),
        refined=_refined(found.refined),
        figures=figures,
        command=command(found, data),
        versions=versions(),
        source=scenario.source,
        scenario=scenario.text,
    )


def command(found: Findings, data: Sequence[str] = ()) -> str:
    """The command line that gives these numbers again; ``data`` are the words of it that name measured data."""
    scenario = found.scenario
    words = ["lwa4d-sim", "identify", scenario.source, "--variant", found.variant]
    for key, value in scenario.overrides.items():
        words += ["--set", f"{key}={json.dumps(value)}"]
    if found.repeats:
        words += ["--repeats", str(found.repeats)]
    return shlex.join([*words, *data])


def _about(found: Findings) -> str:
    """What was measured, and how it was fitted."""
    recording, options = found.recording, found.problem.options
    loop = found.scenario.variants[found.variant].loop
    if found.truth is None:
        origin = f"Measured data, {recording.source}"
    elif isinstance(loop, IdealLoop):
        origin = "A simulated run in continuous time, without a bus"
    else:
        origin = f"A simulated run under a {'CANopen bus' if isinstance(loop, CanopenLoop) else 'bus'}"
    return (
        f"{origin}: {len(recording.t)} samples of {recording.n} joints, {1e3 * recording.period:.4g} ms apart. Torque "
        f"and motion went through the same zero-phase filter of {options.bandwidth:g} Hz; {found.fit.equations.rows} "
        f"equations were fitted by {options.method} least squares, their condition number (scaled) is "
        f"{found.fit.estimate.condition:.3g}."
    )


def digits(value: float | None, error: float | None = None) -> str:
    """A number with as many digits as its error leaves it, or six; a dash for what does not exist."""
    if value is None or not np.isfinite(value):
        return NONE
    if error is None or not np.isfinite(error) or error <= 0 or value == 0:
        return f"{value:.6g}"
    places = int(np.clip(np.floor(np.log10(abs(value))) - np.floor(np.log10(error)) + 2, 2, 10))
    return f"{value:.{places}g}"


def _rows(found: Findings) -> list[Mapping[str, Any]]:
    p, x, s, grade = found.problem.parameters, found.fit.estimate.x, found.fit.std_error, grades(found)
    tiny = _ROUNDING * grade.size
    model, nominal, truth = (
        np.zeros(len(x)) if values is None else np.where(np.abs(values) < tiny, 0.0, values)
        for values in (found.problem.value(found.identified), found.problem.value(found.problem.nominal), found.truth)
    )
    rows: list[Mapping[str, Any]] = []
    for k, name in enumerate(p.names):
        ends = interval(found, k)
        rows.append(
            {
                "name": name,
                "meaning": meaning(name),
                "words": "" if p.words[k] == name else squared(p.words[k]),
                "unit": squared(p.units[k]),
                "told": grade.told[k],
                "well": grade.told[k] == WELL,
                "lost": grade.told[k] == LOST,
                "estimate": digits(x[k], s[k]),
                "std_error": digits(s[k], 10.0 * s[k]),
                "interval": NONE if ends is None else f"{digits(ends[0], s[k])} to {digits(ends[1], s[k])}",
                "truth": digits(truth[k], s[k]),
                "outside": bool(abs(grade.error[k]) > grade.half[k]),
                "model": digits(model[k], s[k]),
                "nominal": f"{nominal[k]:.4g}",
                "coverage": "" if found.coverage is None else f"{100 * found.coverage[k]:.1f} %",
            }
        )
    return rows


def _biases(found: Findings) -> Mapping[str, Any]:
    """Shifts as a table, a column for each cause."""
    grade, names = grades(found), found.problem.parameters.names
    cells = [
        [
            {"text": digits(float(f"{shift[k]:.2g}")), "beyond": bool(abs(shift[k]) > grade.half[k])}
            for shift in found.bias.values()
        ]
        for k in range(len(names))
    ]
    return {"causes": list(found.bias), "rows": list(zip(names, cells, strict=True))}


def _predictions(found: Findings) -> list[Mapping[str, Any]]:
    nrmse = found.validation.nrmse
    return [
        {"joint": joint, "errors": [f"{100 * nrmse[name][j]:.3g}" for name in ("estimate", "identified", "nominal")]}
        for j, joint in enumerate(found.recording.joints)
    ]


def _refined(refined: Any) -> list[Mapping[str, Any]]:
    """What the motion itself says, a row for each parameter; nothing where it was not asked."""
    if refined is None:
        return []
    columns = zip(refined.names, refined.units, refined.start, refined.estimate, refined.std_error, strict=True)
    return [
        {
            "name": name,
            "unit": squared(unit),
            "start": digits(a),
            "estimate": digits(b, s),
            "std_error": digits(s, 10 * s),
        }
        for name, unit, a, b, s in columns
    ]
