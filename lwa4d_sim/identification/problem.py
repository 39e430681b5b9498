"""What is asked of an arm: its unknowns, which of them are fixed, and which parameters are estimated."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.identification.equations import Equations, equations
from lwa4d_sim.identification.friction import Friction, friction_of
from lwa4d_sim.identification.options import Identify
from lwa4d_sim.identification.parameters import KINDS, Unknowns, unknowns_of
from lwa4d_sim.identification.sets import ParameterSet, base_set, thesis_set, usual_columns
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import torque_limits
from lwa4d_sim.recordings.recording import Recording

POSITIVE = ("m", "Ixx", "Iyy", "Izz")
# How far a joint's parameter usually is from its nominal value, as a share of the peak torque: assumed from the wrist's
# friction and rotors, which are 0.01 to 0.25 of it (`lwa4d_sim.arm.WRIST`).
USUAL = {"viscous": 0.25, "coulomb": 0.1, "offset": 0.02, "armature": 0.01}
USUAL_GAIN = 0.1  # assumed
UNLIMITED = 100.0  # [N m] assumed where the model states no peak torque


@dataclass(frozen=True)
class Problem:
    """What is asked of an arm.

    Attributes:
        options: of the scenario.
        model: the nominal arm, compiled.
        unknowns: of the arm.
        nominal: their values (P,).
        fixed: values of those that are not estimated, by name.
        parameters: that are estimated.
        usual: rms of their columns (r,) when they are well excited.
        friction: law of Coulomb friction.
    """

    options: Identify
    model: Any
    unknowns: Unknowns
    nominal: Array
    fixed: Mapping[str, float]
    parameters: ParameterSet
    usual: Array
    friction: Friction

    @staticmethod
    def of(options: Identify, model: Any) -> "Problem":
        """The problem that ``options`` set for a nominal arm.

        Raises:
            IdentificationError: an unknown is named that the arm does not have, or the parameters are another arm's.
        """
        gain = ("gain",) if "gain" in options.joints else ()
        kinds = tuple(kind for kind in KINDS if kind != "gain" or gain)
        unknowns = unknowns_of(model, kinds)
        nominal = unknowns.values(model)
        for name in options.known:
            if name not in unknowns.names:
                raise IdentificationError(
                    f"no unknown of that name; there are {', '.join(unknowns.names)}", f"identify.known.{name}"
                )
        if np.any(model.jnt_stiffness):
            raise IdentificationError("the arm has springs in its joints, which identification does not know", "arm")
        for name, value in options.known.items():
            owner, _, what = name.rpartition(".")
            if (what in POSITIVE and value <= 0) or (what in ("viscous", "coulomb", "armature") and value < 0):
                raise IdentificationError(f"{value:g} is no {what} of {owner}; it cannot be", f"identify.known.{name}")
            if options.parameters == "thesis" and unknowns.names.index(name) < 10 * unknowns.n:
                raise IdentificationError("p1 to p5 are made of it; use parameters: base", f"identify.known.{name}")
        taken = {
            unknowns.names[k]: float(nominal[k])
            for kind in kinds
            if kind not in options.joints
            for k in unknowns.columns(kind)
        }
        fixed = {**taken, **options.known}
        names = tuple(fixed)
        if options.parameters == "thesis":
            parameters = thesis_set(unknowns, names, nominal)
        else:
            parameters = base_set(unknowns, names)
        usual = usual_columns(parameters, unknowns)
        return Problem(options, model, unknowns, nominal, fixed, parameters, usual, friction_of(model))

    @property
    def usual_joints(self) -> Array:
        """How far the joints' unknowns (P - 10 n,) usually are from their nominal values, each in its own unit."""
        peak = torque_limits(self.model)
        peak = np.where(np.isfinite(peak), peak, UNLIMITED)
        n = self.unknowns.n
        return np.concatenate(
            [peak * USUAL[kind] if kind in USUAL else np.full(n, USUAL_GAIN) for kind in self.unknowns.kinds]
        )

    def equations(self, recording: Recording, coulomb: Array) -> Equations:
        """Of a recording, given about the size of Coulomb friction (n,) [N m]."""
        splits = self.parameters.splits
        return equations(recording, self.unknowns, self.options.bandwidth, self.friction, coulomb, gravity=splits)

    def columns(self, made: Equations) -> Array:
        """The parameters' regressor (W, n, r)."""
        return self.parameters.columns(made.Y, made.gravity)

    def torque(self, made: Equations) -> Array:
        """What is left of the torque (W, n) when the fixed unknowns have had their part."""
        values = np.array([self.fixed.get(name, 0.0) for name in self.unknowns.names])
        return np.asarray(made.b - made.Y @ values)

    def coulomb(self, unknowns: Array) -> Array:
        """Size of Coulomb friction (n,) [N m] among values of the unknowns (P,)."""
        return np.maximum(unknowns[self.unknowns.columns("coulomb")], 0.0)

    def all_unknowns(self, x: Array) -> Array:
        """Some values of the unknowns (P,) with parameters ``x`` (r,)."""
        values = self.parameters.unknowns(x)
        for name, value in self.fixed.items():
            values[self.unknowns.names.index(name)] = value
        return values

    def value(self, unknowns: Array) -> Array:
        """The parameters (r,) of values of the unknowns (P,)."""
        return np.asarray(self.parameters.combine @ self._free(unknowns))

    def _free(self, unknowns: Array) -> Array:
        fixed = [name in self.fixed for name in self.unknowns.names]
        return np.where(fixed, 0.0, unknowns)
