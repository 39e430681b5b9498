"""The typed scenario: one variant of one file, every block's parameters checked and complete.

The parameter classes are the schema; `scenario` fills them from YAML and `runner` builds the blocks.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Le, Lt

from lwa4d_sim.bus.fault_options import Fault
from lwa4d_sim.bus.options import Noise, Profile, Traffic
from lwa4d_sim.channels import Transport
from lwa4d_sim.compensation import Compensation
from lwa4d_sim.controllers import ControllerParameters
from lwa4d_sim.delays import Latency, Loss
from lwa4d_sim.drives import LateData
from lwa4d_sim.edits import ArmEdits
from lwa4d_sim.estimators import FilteredDerivative
from lwa4d_sim.estimators import VelocityParameters as PlainVelocity
from lwa4d_sim.identification.options import Identify
from lwa4d_sim.interfaces import STRICT, NonNegative, Positive
from lwa4d_sim.observers import ObserverVelocity
from lwa4d_sim.plant import Disturbance
from lwa4d_sim.trajectories import FourierMotion, SampledMotion, WaypointMotion

_Share = Annotated[float, Ge(0), Lt(1)]

TrajectoryParameters = WaypointMotion | FourierMotion | SampledMotion
VelocityParameters = PlainVelocity | ObserverVelocity


@dataclass(frozen=True, kw_only=True)
class Initial:
    """Start of the run, at rest.

    Attributes:
        q: joint positions [rad]; default the model's `home`.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    q: tuple[float, ...] | None = None


@dataclass(frozen=True, kw_only=True)
class PlantSettings(ArmEdits):
    """The arm that is simulated, whatever the controller believes.

    Attributes:
        timestep: plant step [s].
        integrator: RK4 is exact to 1e-8 rad at 1-2 ms for a torque held over the step; the others are MuJoCo's.
        disturbances: outside forces.
        seed: of every random stream of the run.
    """

    timestep: Positive = 0.001
    integrator: Literal["RK4", "Euler", "implicit", "implicitfast"] = "RK4"
    disturbances: tuple[Disturbance, ...] = ()
    seed: Annotated[int, Ge(0), Lt(2**63)] = 0


@dataclass(frozen=True, kw_only=True)
class Latencies:
    """Transport time of each direction [s]: a number, one number a joint, or a law."""

    __pydantic_config__: ClassVar[Any] = STRICT
    measurement: Latency = 0.0
    command: Latency = 0.0


@dataclass(frozen=True, kw_only=True)
class Jitters:
    """Width of the extra, evenly drawn transport time of each direction [s]."""

    __pydantic_config__: ClassVar[Any] = STRICT
    measurement: NonNegative = 0.0
    command: NonNegative = 0.0


@dataclass(frozen=True, kw_only=True)
class Losses:
    """Loss of each direction: a probability, or a Loss with bursts."""

    __pydantic_config__: ClassVar[Any] = STRICT
    measurement: _Share | Loss = 0.0
    command: _Share | Loss = 0.0


@dataclass(frozen=True, kw_only=True)
class IdealLoop:
    """No bus: the controller acts at every plant step on the true state; second-order accurate in the plant step."""

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["ideal"] = "ideal"


@dataclass(frozen=True, kw_only=True)
class SampledLoop:
    """The controller at the end of a bus.

    Attributes:
        period: control period [s], a whole number of plant steps (thesis: 0.01).
        actuation: immediate = a command acts when it arrives (thesis); next_sync = at the next SYNC after that.
        velocity: how the controller gets the joint speed.
        latency: transport time [s]. One value is the command's; a mapping gives `measurement` and `command`.
        jitter: extra transport time drawn evenly from 0 up to this [s]; one value is the command's.
        loss: lost samples; one value holds for both directions.
        per_joint: latency laws, jitter and loss are drawn joint by joint instead of once a sample.
        phase: from the sample to the controller's computation [s]; default the longest usual measurement latency.
        position_resolution: encoder step [rad], one number or one per joint; 0 for none.
        torque_resolution: torque step [N m], likewise.
        late_data: what the drive does when commands stay away.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["sampled"] = "sampled"
    period: Positive = 0.01
    actuation: Literal["immediate", "next_sync"] = "immediate"
    velocity: VelocityParameters = field(default_factory=FilteredDerivative)
    latency: Latency | Latencies = 0.0
    jitter: NonNegative | Jitters = 0.0
    loss: _Share | Loss | Losses = 0.0
    per_joint: bool = False
    phase: NonNegative | None = None
    position_resolution: NonNegative | tuple[NonNegative, ...] = 0.0
    torque_resolution: NonNegative | tuple[NonNegative, ...] = 0.0
    late_data: LateData = field(default_factory=LateData)

    @property
    def transports(self) -> tuple[Transport, Transport]:
        """(measurement, command) transport."""
        latency = self.latency if isinstance(self.latency, Latencies) else Latencies(command=self.latency)
        jitter = self.jitter if isinstance(self.jitter, Jitters) else Jitters(command=self.jitter)
        loss = self.loss if isinstance(self.loss, Losses) else Losses(measurement=self.loss, command=self.loss)
        return (
            Transport(
                latency=latency.measurement,
                jitter=jitter.measurement,
                loss=_loss(loss.measurement),
                per_joint=self.per_joint,
            ),
            Transport(
                latency=latency.command, jitter=jitter.command, loss=_loss(loss.command), per_joint=self.per_joint
            ),
        )


def _loss(loss: float | Loss) -> Loss:
    return loss if isinstance(loss, Loss) else Loss(probability=loss)


@dataclass(frozen=True, kw_only=True)
class CanopenLoop:
    """The controller as CANopen master, a CiA 402 drive at each joint, and a timed CAN bus between them.

    Attributes:
        period: SYNC period [s], a whole number of plant steps (thesis: 0.01).
        actuation: next_sync = a command acts at the SYNC after it, as with synchronous PDOs; immediate = when it
            arrives.
        velocity: how the controller gets the joint speed; `continuous` and `true` mean the drive's own speed signal.
        bit_rate: [bit/s] (thesis: 500000); null for a bus on which frames take no time.
        profile: lwa4d = as the real firmware, torque as current offset; cia402 = with the torque mode it lacks.
        deadline: from the SYNC to when the controller no longer waits for measurements [s]; default half a period.
        heartbeat: heartbeat time of drives and master [s]; 0 for none.
        following_error: distance of a joint from its desired motion at which the arm is stopped [rad]; default none.
        noise: bit errors.
        traffic: frames of other stations.
        nodes: node id of each joint; default the real arm's (joint 1 is 3, joint 7 is 9), for another arm 3 and up.
        faults: what goes wrong, and when.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["canopen"] = "canopen"
    period: Positive = 0.01
    actuation: Literal["immediate", "next_sync"] = "next_sync"
    velocity: VelocityParameters = field(default_factory=FilteredDerivative)
    bit_rate: Annotated[int, Ge(10_000), Le(1_000_000)] | None = 500_000
    profile: Profile = "lwa4d"
    deadline: Positive | None = None
    heartbeat: Annotated[float, Ge(0), Le(10)] = 0.1
    following_error: Positive | None = None
    noise: Noise = Noise()
    traffic: tuple[Traffic, ...] = ()
    nodes: tuple[Annotated[int, Ge(1), Le(126)], ...] | None = None
    faults: tuple[Fault, ...] = ()


LoopSettings = SampledLoop | IdealLoop | CanopenLoop


@dataclass(frozen=True, kw_only=True)
class Settings:
    """One variant of a scenario.

    Attributes:
        name: of the scenario; names its folder of results.
        arm: shipped model or path of an MJCF file.
        initial: start of the run.
        plant: the arm as it is.
        trajectory: the motion asked for.
        controller: control law, gains and belief.
        compensation: what wins back gain lost to the bus.
        loop: what lies between controller and arm.
        identify: what the command `identify` makes of a run.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    name: str
    arm: str
    initial: Initial = Initial()
    plant: PlantSettings = PlantSettings()
    trajectory: TrajectoryParameters
    controller: ControllerParameters
    compensation: Compensation | None = None
    loop: LoopSettings = field(default_factory=SampledLoop)
    identify: Identify | None = None


#: Blocks that a scenario chooses by `kind`: the classes, and the kind that may be left out.
CHOICES: Mapping[str, str] = {"trajectory": "waypoints", "loop": "sampled"}
