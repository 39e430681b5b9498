"""What a scenario's key ``identify`` holds."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Gt, Le, Lt

from lwa4d_sim.controllers import ControllerParameters
from lwa4d_sim.controllers.belief import Belief
from lwa4d_sim.interfaces import STRICT, NonNegative
from lwa4d_sim.recordings.reading import Reading, Units
from lwa4d_sim.trajectories import FourierMotion, SampledMotion, WaypointMotion

Kind = Literal["viscous", "coulomb", "offset", "armature", "gain"]
Method = Literal["weighted", "ordinary", "total"]


@dataclass(frozen=True, kw_only=True)
class MeasurementNoise:
    """White noise added to what a simulated run measured.

    Attributes:
        position: standard deviation of each position sample [rad], one number or one per joint.
        torque: of each torque as recorded [N m], likewise.
        seed: of both.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    position: NonNegative | tuple[NonNegative, ...] = 0.0
    torque: NonNegative | tuple[NonNegative, ...] = 0.0
    seed: Annotated[int, Ge(0), Lt(2**63)] = 0


@dataclass(frozen=True, kw_only=True)
class Identify:
    """What `lwa4d-sim identify` makes of a run; other commands leave it alone.

    Attributes:
        parameters: base = all combinations that torque depends on; thesis = p1 to p5 of the planar arm.
        joints: what is unknown of every joint beside the links' inertia; the rest is as the nominal arm has it.
        known: values of unknowns that are known, by name, such as link7.m.
        bandwidth: of the filter that both sides of the equations go through [Hz].
        method: weighted by each joint's residual; ordinary (thesis, eq. 4.29); total for noisy regressors.
        noise: of the measurements.
        nominal: the arm as it is known before; what the data do not tell is taken from it. Default: what the
            controller believes. Its gravity is the plant's.
        validation: a second motion, which the estimate has not seen.
        control: a controller that is tried on the second motion, with the nominal and with the identified model.
        table: what the numbers of a measured table mean.
        can: how a measured CAN log is to be read.
        refine: also fit delay and shape of friction to the motion itself, by mujoco.sysid.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    parameters: Literal["base", "thesis"] = "base"
    joints: tuple[Kind, ...] = ("viscous", "coulomb", "offset", "armature")
    known: Mapping[str, float] = field(default_factory=dict)
    bandwidth: Annotated[float, Gt(0), Le(1000)] = 5.0
    method: Method = "weighted"
    noise: MeasurementNoise = MeasurementNoise()
    nominal: Belief | None = None
    validation: WaypointMotion | FourierMotion | SampledMotion | None = None
    control: ControllerParameters | None = None
    table: Units = Units()
    can: Reading = Reading()
    refine: bool = False
