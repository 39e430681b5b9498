"""What a calibration found, in words and plain data."""

from typing import Any

import numpy as np

from lwa4d_sim.calibration.identifiable import explain, moves
from lwa4d_sim.calibration.study import Study

_WRONG_NOISE = 0.001  # chance that residuals of a right model with the stated noise are remarked upon (assumed)


def table(study: Study) -> list[dict[str, Any]]:
    """One row for each fitted coordinate: name, unit, estimate, std_error, low, high and, if known, truth."""
    fit, model = study.fit, study.model
    return [
        {
            "name": model.names[j],
            "unit": model.units[j],
            "estimate": float(fit.xi[j]),
            "std_error": float(fit.std_error[k]),
            "low": float(fit.xi[j] - fit.half[k]),
            "high": float(fit.xi[j] + fit.half[k]),
            "truth": None if study.truth is None else float(study.truth[j]),
        }
        for k, j in enumerate(fit.kept)
    ]


def errors(study: Study) -> dict[str, float | None]:
    """Root mean square distance of the tool [m], and angle [rad] where measured, before, after and on unseen poses."""
    nominal = np.zeros_like(study.fit.xi)
    cases = {
        "before": (study.data, nominal),
        "after": (study.data, study.fit.xi),
        "held_out_before": (study.unseen, nominal),
        "held_out": (study.unseen, study.fit.xi),
    }
    out: dict[str, float | None] = {}
    for name, (data, xi) in cases.items():
        if len(data.q) == 0:
            out[name] = None
            continue
        out[name], angle = study.rms(data, xi)
        if data.R is not None:
            out[f"{name}_angle"] = angle
    return out


def zeros(study: Study) -> list[str]:
    """One sentence for each joint: where its zero is, or why that is not known."""
    fit, model = study.fit, study.model
    fitted = {int(j): k for k, j in enumerate(fit.kept)}
    shared = moves(model, study.split)
    told = []
    for joint, slides, j in zip(model.nominal.names, model.nominal.slide, model.offsets, strict=True):
        if int(j) not in fitted:
            told.append(f"{joint}: these measurements do not show its zero; it is left as it is")
            continue
        k = fitted[int(j)]
        factor, unit = (1e3, "mm") if slides else (180.0 / np.pi, "deg")
        value, half = factor * fit.xi[j], factor * fit.half[k]
        sure = "" if abs(value) > half else ", which may be nothing"
        same = [model.names[lost] for lost in study.split.lost[shared[k] != 0.0]]
        also = f"; or {', '.join(same)}, which nobody can tell from it" if same else ""
        told.append(f"{joint}: add {value:+.4f} +/- {half:.4f} {unit} to its readings{sure}{also}")
    return told


def remarks(study: Study) -> list[str]:
    """What the reader should know before trusting the numbers."""
    from scipy.special import chdtri

    fit, data = study.fit, study.data
    told = [
        f"{data.source}: {data.labels[k]} does not fit the others; measure it again, or leave it out"
        for k in fit.outliers
    ]
    freedom = len(data.q) * len(study.instrument.weights) - len(fit.kept)
    if fit.ratio**2 * freedom > chdtri(freedom, _WRONG_NOISE):
        told.append(
            f"residuals are {fit.ratio:.2f} times the stated noise: outliers, a noisier instrument, or errors that are "
            "not in the geometry, such as elastic gears; the intervals take the residuals as noise"
        )
    unseen = errors(study)
    before, after = unseen["held_out_before"], unseen["held_out"]
    if before is not None and after is not None and after > before:
        told.append("unseen poses fit worse than before: these corrections do not serve; keep the arm as it is")
    return told


def record(study: Study, arm: str) -> dict[str, Any]:
    """Everything as plain data."""
    return {
        "arm": arm,
        "source": study.data.source,
        "poses": {"fit": len(study.data.q), "held_out": len(study.unseen.q)},
        "instrument": {"position": study.instrument.position, "angle": study.instrument.angle},
        "identifiable": len(study.split.kept),
        "parameters": {row.pop("name"): row for row in table(study)},
        "rms": errors(study),
        "noise_ratio": study.fit.ratio,
        "zeros": zeros(study),
        "left_out": explain(study.model, study.split),
        "remarks": remarks(study),
    }
