"""What a scenario may say about a CANopen bus: rate, profile, noise and other traffic."""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from annotated_types import Ge, Le, Lt

from lwa4d_sim.interfaces import STRICT, NonNegative

Profile = Literal["lwa4d", "cia402"]

# Not even a bus of 1 Mbit/s carries frames more often than its shortest of 47 bits (CAN 2.0) [s].
FramePeriod = Annotated[float, Ge(47e-6)]

FIRST_NODE = 3  # node id of joint 1; joint 7 has 9 (schunk_lwa4d, config/arm_driver.yaml)


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Bit errors on the wire: each spoils a frame, which is repeated after an error frame.

    Attributes:
        per_bit: probability that a bit is spoilt (assumed independent).
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    per_bit: Annotated[float, Ge(0), Lt(1)] = 0.0


@dataclass(frozen=True, kw_only=True)
class Traffic:
    """Frames of another station, sent regularly.

    Attributes:
        id: 11-bit identifier; the lower, the sooner it wins.
        size: data bytes.
        period: [s].
        offset: of the first frame from the start [s].
    """

    __pydantic_config__: ClassVar[Any] = STRICT
    id: Annotated[int, Ge(1), Le(0x7FF)]
    size: Annotated[int, Ge(0), Le(8)] = 8
    period: FramePeriod
    offset: NonNegative = 0.0
