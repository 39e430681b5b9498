"""What a scenario may let go wrong on a CANopen bus, and when: the parameters of scripted faults."""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Le

from lwa4d_sim.bus.options import FramePeriod
from lwa4d_sim.interfaces import STRICT, NonNegative, Positive

NodeId = Annotated[int, Ge(1), Le(127)]
Count = Annotated[int, Ge(1)]
Pdo = Literal["rpdo1", "rpdo2", "tpdo1", "tpdo2"]


@dataclass(frozen=True, kw_only=True)
class _Fault:
    """Something goes wrong.

    Attributes:
        at: from when on [s]; 0 is the first SYNC of the run.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    at: NonNegative


@dataclass(frozen=True, kw_only=True)
class _Lasting(_Fault):
    """It lasts.

    Attributes:
        duration: [s]; default for good.
    """

    duration: Positive | None = None


@dataclass(frozen=True, kw_only=True)
class _Frames(_Fault):
    """It happens to some frames.

    Attributes:
        count: how many.
    """

    count: Count = 1


@dataclass(frozen=True, kw_only=True)
class _Pdos(_Frames):
    """It happens to PDOs.

    Attributes:
        node: of which drive.
        pdo: rpdo = from the master to the drive, tpdo = from the drive to the master.
    """

    node: NodeId
    pdo: Pdo


# What happens to frames


@dataclass(frozen=True, kw_only=True)
class LostSync(_Frames):
    """The master's next SYNCs do not reach the wire."""

    kind: Literal["lost_sync"]


@dataclass(frozen=True, kw_only=True)
class LateSync(_Frames):
    """The master's next SYNCs come late by ``delay`` [s]."""

    kind: Literal["late_sync"]
    delay: Positive


@dataclass(frozen=True, kw_only=True)
class LongSync(_Frames):
    """The master's next SYNCs carry ``size`` data bytes, which do not belong there."""

    kind: Literal["long_sync"]
    size: Annotated[int, Ge(1), Le(8)] = 8


@dataclass(frozen=True, kw_only=True)
class LostPdo(_Pdos):
    """The next PDOs do not reach the wire."""

    kind: Literal["lost_pdo"]


@dataclass(frozen=True, kw_only=True)
class LatePdo(_Pdos):
    """The next PDOs come late by ``delay`` [s]; those behind them wait, so that their order stays."""

    kind: Literal["late_pdo"]
    delay: Positive


@dataclass(frozen=True, kw_only=True)
class WrongPdo(_Pdos):
    """The next PDOs have ``size`` bytes: cut short, or filled up with zeros; default one too few or too many."""

    kind: Literal["short_pdo", "long_pdo"]
    size: Annotated[int, Ge(0), Le(8)] | None = None


@dataclass(frozen=True, kw_only=True)
class DuplicatedPdo(_Pdos):
    """The next PDOs come twice, the copy after ``delay`` [s], which may be after newer ones."""

    kind: Literal["duplicated_pdo"]
    delay: NonNegative = 0.0


# What happens to a drive or the master


@dataclass(frozen=True, kw_only=True)
class NodeReset(_Fault):
    """A drive restarts, as after a dip of its supply."""

    kind: Literal["node_reset"]
    node: NodeId


@dataclass(frozen=True, kw_only=True)
class NodeSilence(_Lasting):
    """A drive loses its supply (off), or the bus (unplugged); at 0 before the start-up already."""

    kind: Literal["node_silence"]
    node: NodeId
    how: Literal["off", "unplugged"] = "off"


@dataclass(frozen=True, kw_only=True)
class HeartbeatLoss(_Lasting):
    """Heartbeats stay away, all else goes on; without ``node`` those of the master."""

    kind: Literal["heartbeat_loss"]
    node: NodeId | None = None


@dataclass(frozen=True, kw_only=True)
class DriveError(_Fault):
    """A drive finds an error of its own, with its ``code``: it goes to its fault state and reports (EMCY)."""

    kind: Literal["emergency"]
    node: NodeId
    code: Annotated[int, Ge(0x1000), Le(0xFFFF)] = 0x4310  # drive over-temperature (CiA 402)


@dataclass(frozen=True, kw_only=True)
class ControllerErrors(_Fault):
    """Frames of a drive, or of the master, are spoilt until its CAN controller is error passive, or leaves the bus."""

    kind: Literal["error_passive", "bus_off"]
    node: NodeId | None = None


@dataclass(frozen=True, kw_only=True)
class StuckEncoder(_Lasting):
    """A drive's encoder stays at one value."""

    kind: Literal["stuck_encoder"]
    node: NodeId


@dataclass(frozen=True, kw_only=True)
class BrakeFailure(_Fault):
    """A drive's brake holds nothing."""

    kind: Literal["brake_failure"]
    node: NodeId


@dataclass(frozen=True, kw_only=True)
class WrongDevice:
    """From the start a drive is of another type: its supported modes (6502) are ``modes``."""

    __pydantic_config__: ClassVar[Any] = STRICT
    kind: Literal["wrong_device"]
    node: NodeId
    modes: Annotated[int, Ge(0), Le(0x3FF)] = 1


@dataclass(frozen=True, kw_only=True)
class MasterCrash(_Lasting):
    """The controller's process stands still: it neither hears, computes nor sends."""

    kind: Literal["master_crash"]


# What strangers do


@dataclass(frozen=True, kw_only=True)
class BabblingNode(_Lasting):
    """A broken station sends frames without a pause, with an ``id`` more urgent than most."""

    kind: Literal["babbling_node"]
    id: Annotated[int, Ge(0), Le(0x7FF)] = 1
    size: Annotated[int, Ge(0), Le(8)] = 8


@dataclass(frozen=True, kw_only=True)
class DuplicateNode(_Fault):
    """A second drive with a node id in use is switched on; at 0 before the start-up already."""

    kind: Literal["duplicate_node"]
    node: NodeId


@dataclass(frozen=True, kw_only=True)
class ForeignNmt(_Fault):
    """Another station sends a command of network management, without ``node`` to all."""

    kind: Literal["foreign_nmt"]
    command: Literal["start", "stop", "pre_operational", "reset_node", "reset_communication"]
    node: NodeId | None = None


@dataclass(frozen=True, kw_only=True)
class ForeignSync(_Frames):
    """A second SYNC producer with a ``period`` [s] of its own."""

    kind: Literal["foreign_sync"]
    period: FramePeriod = 0.01


@dataclass(frozen=True, kw_only=True)
class ForeignFrames(_Frames):
    """Another station sends any frames: ``id``, ``data``, 29-bit (extended) or remote, every ``period`` [s]."""

    kind: Literal["foreign_frames"]
    id: Annotated[int, Ge(0), Le(0x1FFFFFFF)]
    data: tuple[Annotated[int, Ge(0), Le(255)], ...] = ()
    extended: bool = False
    remote: bool = False
    period: FramePeriod = 0.001


@dataclass(frozen=True, kw_only=True)
class SdoFlood(_Frames):
    """Another station keeps a drive's SDO server busy: reads, or one segmented transfer that never ends."""

    kind: Literal["sdo_flood"]
    node: NodeId
    request: Literal["read", "endless"] = "read"
    count: Count = 1000
    period: FramePeriod = 0.001


FrameFault = LostSync | LateSync | LongSync | LostPdo | LatePdo | WrongPdo | DuplicatedPdo
DriveFault = NodeReset | NodeSilence | HeartbeatLoss | DriveError | ControllerErrors | StuckEncoder | BrakeFailure
StrangerFault = BabblingNode | DuplicateNode | ForeignNmt | ForeignSync | ForeignFrames | SdoFlood
Fault = FrameFault | DriveFault | WrongDevice | StrangerFault | MasterCrash
