"""How measured data are to be read: units of a table, profile and counts of a CAN log."""

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from lwa4d_sim.bus.options import Profile
from lwa4d_sim.interfaces import STRICT, Positive

Actuation = Literal["next_sync", "immediate"]


@dataclass(frozen=True, kw_only=True)
class Units:
    """What the numbers of a table mean.

    Attributes:
        angle: unit of the positions.
        torque: unit of the torques: N m, permil of the rated torque, or mA of a current.
        rated: rated torque of each joint [N m], for permil; default the arm's peak torques.
        constant: torque of a current at each joint [N m/A], for mA.
        delay: from a row's time to when its torque begins to act [s]. A torque that was measured and not asked for
            stands for what was around that time: minus half a period.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    angle: Literal["rad", "deg", "mdeg"] = "rad"
    torque: Literal["N m", "permil", "mA"] = "N m"
    rated: tuple[Positive, ...] | None = None
    constant: tuple[Positive, ...] | None = None
    delay: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How a CAN log is to be read.

    Attributes:
        profile: how the drives take their torque (docs/canopen.md, two profiles); default the scenario's loop's, else
            lwa4d.
        torque: the one commanded, or the one that the drives report (6077).
        actuation: when a command acts; default as the transmission type of its PDO says, in the log's set-up or, where
            the log begins later, in the data sheet.
        position_counts: counts of 6064 in a radian, joint by joint; default millidegrees.
        torque_counts: counts of the torque object in a newton metre; default the profile's.
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    profile: Profile | None = None
    torque: Literal["command", "actual"] = "command"
    actuation: Actuation | None = None
    position_counts: tuple[Positive, ...] | None = None
    torque_counts: tuple[Positive, ...] | None = None
