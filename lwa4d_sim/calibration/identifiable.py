"""Which error coordinates measured poses can tell apart, and what the others cannot be told from, in words.

A turning joint lets a turn about its axis and a shift along it pass from the frame before it into the one behind it, a
sliding joint three shifts and one turn. So of 6 (n + 1) coordinates, whole poses show 4 for each turning joint, 2 for
each sliding one, and 6 (Everett, Driels, Suh 1987, "Kinematic modelling for robot calibration"); positions show three
less, and fewer where the tool lies on a joint's axis.
"""

from typing import NamedTuple

import numpy as np

from lwa4d_sim.calibration.error_model import ErrorModel
from lwa4d_sim.interfaces import Array, IntArray

# [-] Least of what a coordinate does that others cannot do, of what the one that does most does. What is left out for
# less moves the tool by 5 um for an error of 1 mm, less than a tracker notices (derived; 10 um noise assumed).
APART = 5e-3
ROUNDING = 1e-6  # [-] the same, where numbers are equal but for rounding, in files with six digits
_STRONG = 1e-2  # [-] what does so much that is new goes first, so that none is the small difference of two others
_PROBES = 200  # poses that show the structure; any number well above the coordinates serves
_SEED = 0
_TERMS = 3  # so many coordinates are named in an explanation


class Split(NamedTuple):
    """Coordinates ``kept``, in the order of the model, and ``lost``; column lost[j] = sum of kept columns * C[:, j]."""

    kept: IntArray
    lost: IntArray
    C: Array


def preference(model: ErrorModel) -> IntArray:
    """All coordinates, those first that stand for what is indistinguishable.

    Zeros of the joints first, which are off by most and can be corrected in the drive, then where the tool's point is,
    where the axes are, their tilts, how the tool is turned, and last shifts along the axes (assumed order).
    """
    p = len(model.names)
    joints = np.arange(p - 6).reshape(-1, 6)
    point, turn = np.arange(p - 6, p - 3), np.arange(p - 3, p)
    across, tilts = joints[:, :2].ravel(), joints[:, 3:5].ravel()
    order = np.concatenate([model.offsets, point, across, tilts, turn, joints.ravel()])
    return np.array(list(dict.fromkeys(order.tolist())))  # each where it comes first


def split(J: Array, candidates: IntArray, scale: Array, least: float = ROUNDING) -> Split:
    """Take the candidates one by one and keep each that does something the ones kept before cannot do.

    A Gram-Schmidt elimination, first for those that do much that is new, then for the rest: so an arm whose axes are
    parallel but for a thousandth keeps what a parallel one keeps.

    Args:
        J: stacked derivatives (rows, p), rows in comparable units.
        candidates: coordinates in order of preference.
        scale: units of the coordinates (p,).
        least: part of the largest column that must be new.
    """
    columns = J[:, candidates] * scale[candidates]
    unit = columns / (np.linalg.norm(columns, axis=0).max() or 1.0)
    basis: Array = np.zeros((len(J), 0))
    chosen: list[int] = []
    for part in (_STRONG, least):
        for k in range(len(candidates)):
            rest = unit[:, k] - basis @ (basis.T @ unit[:, k])
            rest = rest - basis @ (basis.T @ rest)  # once more, against rounding
            size = float(np.linalg.norm(rest))
            if k not in chosen and len(chosen) < len(J) and size > part:
                basis = np.column_stack([basis, rest / size])
                chosen.append(k)
    kept = sorted(chosen, key=lambda j: int(candidates[j]))
    lost = sorted(set(range(len(candidates))) - set(kept), key=lambda j: int(candidates[j]))
    C = np.linalg.lstsq(columns[:, kept], columns[:, lost], rcond=None)[0]
    C = C * scale[candidates[kept]][:, None] / scale[candidates[lost]]
    return Split(candidates[kept], candidates[lost], C)


def rows(model: ErrorModel, J: Array, whole: bool) -> Array:
    """Derivatives (K, 6, p) as stacked rows (K d, p): positions over the arm's length, and turns if ``whole``."""
    weights = np.repeat([1.0 / model.length, 1.0], 3)
    d = 6 if whole else 3
    return np.asarray((J * weights[:, None])[:, :d].reshape(-1, J.shape[-1]))


def structure(model: ErrorModel, whole: bool, candidates: IntArray | None = None) -> Split:
    """What any poses within the joint limits could tell apart.

    Args:
        model: the arm.
        whole: poses are measured, not only positions.
        candidates: coordinates that may be off, in order of preference; default all.
    """
    q = random_poses(model, _PROBES, np.random.default_rng(_SEED))
    J = model.predict(q, np.zeros(len(model.names))).J
    return split(rows(model, J, whole), preference(model) if candidates is None else candidates, model.scale, APART)


def random_poses(model: ErrorModel, count: int, rng: np.random.Generator) -> Array:
    """Readings (count, n) drawn evenly within the joint limits; a turn, or 2 m, where there are none."""
    chain = model.nominal
    span = np.where(chain.slide, 1.0, np.pi)
    low, high = (
        np.where(np.isfinite(limit), limit, side * span) for limit, side in ((chain.lower, -1), (chain.upper, 1))
    )
    return np.asarray(rng.uniform(low, high, (count, model.n)))


def moves(model: ErrorModel, found: Split) -> Array:
    """``found.C`` for coordinates that move the tool by one length each (kept, lost), what is too little left out."""
    C = found.C * model.scale[found.lost] / model.scale[found.kept][:, None]
    return np.asarray(np.where(np.abs(C) > APART * np.abs(C).max(axis=0, initial=ROUNDING), C, 0.0))


def explain(model: ErrorModel, found: Split) -> list[str]:
    """One sentence for each lost coordinate: what it cannot be told from."""
    return [f"{model.names[j]} {words}" for j, words in zip(found.lost, like(model, found), strict=True)]


def like(model: ErrorModel, found: Split) -> list[str]:
    """What each lost coordinate does, as far as the kept ones can say it."""
    told = []
    for column, factors in zip(moves(model, found).T, found.C.T, strict=True):
        order = [i for i in np.argsort(-np.abs(column)) if column[i]]
        terms = [_term(float(factors[i]), model.names[found.kept[i]]) for i in order[:_TERMS]]
        more = f" and {len(order) - _TERMS} more" if len(order) > _TERMS else ""
        words = " ".join(terms)
        first = "" if words.startswith("+") else "-"
        told.append(f"acts as {first}{words[2:]}{more}" if terms else "does not move what is measured")
    return told


def _term(factor: float, name: str) -> str:
    size = f"{abs(factor):.4g}"
    return f"{'-' if factor < 0 else '+'} {'' if size == '1' else size + ' '}{name}"
