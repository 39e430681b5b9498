"""Coulomb friction as MuJoCo has it: which way it pulls, and when a joint slides at all.

Friction loss is a soft constraint on a joint's speed (MuJoCo documentation, "Computation", constraint model): it takes
the torque that brings ddq to -rate dq, softened by R, up to ``coulomb``. Solved for the torque that acts,

    tau = coulomb clip((rate dq + ddq) / (R coulomb), -1, 1),

so a joint slides where the argument is beyond +-1 and creeps between (derived; with MuJoCo's defaults and the LWA4D's
numbers below about 0.01 rad/s).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lwa4d_sim.interfaces import Array


@dataclass(frozen=True)
class Friction:
    """The law of n joints.

    Attributes:
        rate: at which the constraint takes speed away (n,) [1/s].
        softness: R (n,) [rad/s^2 per N m].
    """

    rate: Array
    softness: Array

    def effort(self, dq: Array, ddq: Array, coulomb: Array) -> Array:
        """Torque that would hold the joint, in shares of the friction ``coulomb`` (n,) [N m], at states (T, n)."""
        return np.asarray((self.rate * dq + ddq) / np.maximum(self.softness * coulomb, 1e-9))

    def direction(self, dq: Array, ddq: Array, coulomb: Array) -> Array:
        """Share of the friction that acts, with the sign of the motion; arguments as for `effort`."""
        return np.clip(self.effort(dq, ddq, coulomb), -1.0, 1.0)


def friction_of(model: Any) -> Friction:
    """The law of a compiled model's joints."""
    time, damping = np.asarray(model.dof_solref).T
    least, most = np.asarray(model.dof_solimp)[:, :2].T
    rate = np.where(damping > 0, 2.0 / (most * np.maximum(time, 1e-9)), -damping)  # negative: the direct format
    return Friction(rate, (1.0 - least) / least * np.asarray(model.dof_invweight0))
