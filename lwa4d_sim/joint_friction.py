"""Friction that a controller believes in, as a function of speed alone."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lwa4d_sim.interfaces import Array

# [rad/s] below which Coulomb friction is taken to grow with speed, so that a reference at rest asks for none: about the
# speed at which MuJoCo's own creeps (assumed; `lwa4d_sim.identification.friction` derives it for each joint)
CREEP = 0.01


class JointFriction:
    """Viscous and Coulomb friction of some models' joints: viscous dq + coulomb min(1, |dq| / CREEP) sign(dq).

    Args:
        models: compiled models, one for all arms or one for each.
    """

    def __init__(self, models: Sequence[Any]) -> None:
        self._viscous = np.array([model.dof_damping for model in models])
        self._coulomb = np.array([model.dof_frictionloss for model in models])

    def __call__(self, dq: Array) -> Array:
        """Torque (N, n) [N m] at joint speed ``dq`` (N, n) [rad/s], with the sign of the speed."""
        return np.asarray(self._viscous * dq + self._coulomb * np.clip(dq / CREEP, -1.0, 1.0))
