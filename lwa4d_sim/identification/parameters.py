"""The unknowns of an arm: names, units, and their values in a compiled model."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lwa4d_sim.chain import Chain
from lwa4d_sim.identification.inertia import NAMES, UNITS, standard_parameters
from lwa4d_sim.identification.options import Kind
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import chain_of
from lwa4d_sim.mjcf_checks import name_of

#: What a joint adds to the links' inertia, with its unit. ``gain``: torque in the joint over torque as recorded, minus
#: one; ``offset``: torque in the joint where none is recorded, with the sign of friction.
KINDS: dict[Kind, str] = {
    "viscous": "N m s/rad",
    "coulomb": "N m",
    "offset": "N m",
    "armature": "kg m^2",
    "gain": "1",
}


@dataclass(frozen=True)
class Unknowns:
    """The P unknowns of an arm: ten a link, then one a joint for each kind.

    Attributes:
        chain: geometry.
        gravity: (3,) [m/s^2].
        kinds: what is unknown of every joint, in the order of the columns.
        names: of the unknowns, such as link2.hz and joint2.viscous.
        units: likewise.
    """

    chain: Chain
    gravity: Array
    kinds: tuple[Kind, ...]
    names: tuple[str, ...]
    units: tuple[str, ...]

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.chain.names)

    def columns(self, kind: Kind) -> NDArray[np.intp]:
        """Where the unknowns of a kind stand (n,)."""
        return np.arange(self.n) + 10 * self.n + self.kinds.index(kind) * self.n

    def values(self, model: Any) -> Array:
        """The unknowns (P,) as a compiled model has them; offset and gain are 0."""
        joints = {"viscous": model.dof_damping, "coulomb": model.dof_frictionloss, "armature": model.dof_armature}
        rest = [np.asarray(joints.get(kind, np.zeros(self.n))) for kind in self.kinds]
        return np.concatenate([standard_parameters(model).ravel(), *rest])


def unknowns_of(model: Any, kinds: Sequence[Kind]) -> Unknowns:
    """The unknowns of a compiled arm, with the ``kinds`` of every joint."""
    chain = chain_of(model)
    links = [name_of(model, "BODY", body) for body in model.jnt_bodyid]
    ordered = tuple(kind for kind in KINDS if kind in kinds)
    names = [f"{link}.{name}" for link in links for name in NAMES]
    names += [f"{joint}.{kind}" for kind in ordered for joint in chain.names]
    units = [*UNITS] * len(links) + [KINDS[kind] for kind in ordered for _ in chain.names]
    return Unknowns(chain, np.array(model.opt.gravity), ordered, tuple(names), tuple(units))
