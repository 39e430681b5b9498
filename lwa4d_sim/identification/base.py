"""Base parameters: the combinations of unknowns that torque depends on, and what no torque tells apart."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lwa4d_sim.identification.parameters import Unknowns
from lwa4d_sim.identification.regressor import Regressor
from lwa4d_sim.interfaces import Array

STATES = 400  # assumed: random states, many more than are needed for full rank
TOLERANCE = 1e-9  # of a column's length: what is left of one that depends on those before it is rounding


@dataclass(frozen=True)
class Base:
    """Linear combinations ``combine @ x`` of the unknowns x.

    Attributes:
        columns: the unknowns that lead the combinations (r,); their columns of the regressor are independent.
        combine: (r, P), 1 at each leading unknown.
        names: of the leading unknowns.
        units: likewise.
        words: each combination, such as "link2.Iyy + 0.1076 link4.m".
        unseen: unknowns that no torque depends on.
    """

    columns: NDArray[np.intp]
    combine: Array
    names: tuple[str, ...]
    units: tuple[str, ...]
    words: tuple[str, ...]
    unseen: tuple[str, ...]


def base_of(unknowns: Unknowns, known: tuple[str, ...] = ()) -> Base:
    """The base parameters of an arm whose joints go anywhere (Gautier 1991, by QR of a regressor at random states).

    Of dependent unknowns the first leads: links count from the base, masses come after moments and inertias of their
    link, and a joint's own come last, so that a rotor inertia is added to a link's where the two cannot be told apart.

    Args:
        unknowns: of the arm.
        known: names of unknowns whose values are known; they take no part.
    """
    P, n = len(unknowns.names), unknowns.n
    Y = random_regressor(unknowns).reshape(-1, P)
    order = np.concatenate([np.roll(np.arange(10 * i, 10 * i + 10), -1) for i in range(n)] + [np.arange(10 * n, P)])
    free = np.array([k for k in order if unknowns.names[k] not in known], dtype=int)
    length = np.linalg.norm(Y, axis=0)
    seen = free[length[free] > TOLERANCE * length.max()]
    R = np.asarray(np.linalg.qr(Y[:, seen] / length[seen], mode="r"))
    lead = np.abs(np.diag(R)) > TOLERANCE * np.sqrt(len(seen))
    # R = [R1 R2] up to order: dependent columns are R1 (R1^-1 R2)
    mix = np.linalg.lstsq(R[:, lead], R, rcond=None)[0]
    mix = mix * length[seen] / length[seen[lead], None]
    mix[np.abs(mix) < 1e-8] = 0.0
    combine = np.zeros((int(lead.sum()), P))
    combine[:, seen] = mix
    columns: NDArray[np.intp] = seen[lead]
    natural = np.argsort(columns)
    columns, combine = columns[natural], combine[natural]
    combine[:, columns] = np.eye(len(columns))
    return Base(
        columns=columns,
        combine=combine,
        names=tuple(unknowns.names[k] for k in columns),
        units=tuple(unknowns.units[k] for k in columns),
        words=tuple(in_words(row, unknowns.names, k) for row, k in zip(combine, columns, strict=True)),
        unseen=tuple(unknowns.names[k] for k in free if length[k] <= TOLERANCE * length.max()),
    )


def random_regressor(unknowns: Unknowns, seed: int = 0) -> Array:
    """Torque regressor (STATES, n, P) at random states; a recorded torque is drawn like the states."""
    rng = np.random.default_rng(seed)
    n = unknowns.n
    q, dq, ddq = rng.uniform(-np.pi, np.pi, (3, STATES, n))
    Y = np.zeros((STATES, n, len(unknowns.names)))
    Y[..., : 10 * n] = Regressor(unknowns.chain, unknowns.gravity).torque(q, dq, ddq)
    own = {"viscous": dq, "coulomb": np.sign(dq), "offset": np.ones_like(q), "armature": ddq}
    for kind in unknowns.kinds:
        value = own.get(kind)
        Y[:, np.arange(n), unknowns.columns(kind)] = rng.normal(size=q.shape) if value is None else value
    return Y


def in_words(row: Array, names: tuple[str, ...], lead: int) -> str:
    """A combination as people write it, its leading unknown first."""
    text = names[lead]
    for k in np.flatnonzero(row):
        if k != lead:
            size = "" if abs(abs(row[k]) - 1.0) < 1e-8 else f"{abs(row[k]):.4g} "
            text += f" {'-' if row[k] < 0 else '+'} {size}{names[k]}"
    return text
