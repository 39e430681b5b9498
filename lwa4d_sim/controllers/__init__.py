"""Control laws. A new one is a module here and a line below; a user's own needs neither (see docs/controllers.md)."""

from lwa4d_sim.controllers.computed_torque import ComputedTorque
from lwa4d_sim.controllers.custom import CustomController
from lwa4d_sim.controllers.pd_gravity import PdGravity

ControllerParameters = PdGravity | ComputedTorque | CustomController

__all__ = ["ComputedTorque", "ControllerParameters", "CustomController", "PdGravity"]
