"""The drives as a master knows them: what goes into their PDOs, what came last, and whether they are well."""

from collections.abc import Mapping as Map
from dataclasses import dataclass, field
from typing import Any

from lwa4d_sim.bus.dictionary import MDEG_PER_RAD, Joint
from lwa4d_sim.bus.mapping import Mapping
from lwa4d_sim.bus.options import Profile
from lwa4d_sim.interfaces import Ns

CONTROL, STATUS, POSITION, SPEED = (0x6040, 0), (0x6041, 0), (0x6064, 0), (0x606C, 0)
TARGET_TORQUE, TARGET_POSITION, TARGET_SPEED = (0x6071, 0), (0x607A, 0), (0x60FF, 0)
OFFSET, SET_POINT = (0x60B2, 0), (0x60C1, 1)

NEVER = Ns(-(2**62))  # the stamp of what has not come yet; virtual time may begin below zero

Key = tuple[int, int]
Item = tuple[int, int, int, bool]  # index, sub, bits, signed


@dataclass(frozen=True, slots=True)
class Layout:
    """How a profile is used for torque control.

    Attributes:
        mode: of operation (6060).
        bit: of the supported modes (6502) that the mode needs.
        control: controlword of a moving drive.
        receive, transmit: contents of RPDO 1 and 2 and of TPDO 1 and 2.
        torque: the object that takes the torque.
    """

    mode: int
    bit: int
    control: int
    receive: tuple[tuple[Item, ...], ...]
    transmit: tuple[tuple[Item, ...], ...]
    torque: Key


LAYOUTS: Map[Profile, Layout] = {
    # cyclic synchronous torque
    "cia402": Layout(
        mode=10,
        bit=9,
        control=0x0F,
        receive=(
            ((0x6040, 0, 16, False), (0x6071, 0, 16, True), (0x607A, 0, 32, True)),
            ((0x60FF, 0, 32, True), (0x60B2, 0, 16, True)),
        ),
        transmit=(
            ((0x6041, 0, 16, False), (0x6077, 0, 16, True), (0x6064, 0, 32, True)),
            ((0x606C, 0, 32, True), (0x60F4, 0, 32, True)),
        ),
        torque=TARGET_TORQUE,
    ),
    # The firmware has no torque mode: interpolated position with the loops opened, torque as current offset
    # (COT_CurrentMode of SCHUNK's tools; factory RPDO 1).
    "lwa4d": Layout(
        mode=7,
        bit=6,
        control=0x1F,
        receive=(
            ((0x6040, 0, 16, False), (0x60B2, 0, 16, True), (0x60C1, 1, 32, True)),
            ((0x607A, 0, 32, True), (0x6081, 0, 32, False)),
        ),
        transmit=(
            ((0x6041, 0, 16, False), (0x6077, 0, 16, True), (0x6064, 0, 32, True)),
            ((0x606B, 0, 32, True), (0x606C, 0, 32, True)),
        ),
        torque=OFFSET,
    ),
}


def torque_counts_per_newton_metre(profile: Profile, joint: Joint) -> float:
    """Counts of the torque object in one newton metre: per mille of the rated torque, or milliamperes."""
    return 1000.0 / joint.torque if profile == "cia402" else 1000.0 / joint.torque_constant


@dataclass(slots=True)
class Station:
    """One drive.

    Attributes:
        node: its id.
        joint: its constants.
        values: objects as last sent or received.
        stamp: SYNC [ns] of the last TPDO 1.
        since: when that TPDO arrived [ns].
        fresh: TPDOs of this cycle that have arrived, as bits.
        owed: TPDOs that did not come in the cycle before, as bits; what comes now may be these.
        complete: all TPDOs of this cycle have arrived.
        frames, before: contents of the TPDOs of this cycle and of the one before, by those bits.
        missed: cycles in a row without TPDO 1.
        defied: cycles in a row in which it has not followed a quick stop.
        alive: last sign of life on the error control channel [ns].
        nmt: state it last told there, or None.
        emergency: last error code reported and not taken back, 0 = none.
        boots: boot-up messages seen.
        answers: SDO answers seen.
    """

    node: int
    joint: Joint
    values: dict[Key, Any] = field(default_factory=dict)
    stamp: Ns = NEVER
    since: Ns = NEVER
    fresh: int = 0
    owed: int = 0
    complete: bool = False
    frames: dict[int, bytes] = field(default_factory=dict)
    before: dict[int, bytes] = field(default_factory=dict)
    missed: int = 0
    defied: int = 0
    alive: Ns = NEVER
    nmt: int | None = None
    emergency: int = 0
    boots: int = 0
    answers: int = 0

    @property
    def status(self) -> int:
        """Statusword, 0 before the first."""
        return int(self.values.get(STATUS, 0))

    @property
    def q(self) -> float:
        """Last position [rad]."""
        return float(self.values.get(POSITION, 0)) / MDEG_PER_RAD

    @property
    def dq(self) -> float:
        """Last speed [rad/s]."""
        return float(self.values.get(SPEED, 0)) / MDEG_PER_RAD


def mappings(items: tuple[tuple[Item, ...], ...]) -> list[Mapping]:
    """Packers of some PDOs."""
    return [Mapping(one) for one in items]


def opening(profile: Profile) -> list[tuple[Key, str, float]]:
    """Objects that make a drive obey the torque alone: (index and sub-index, `struct` format, value).

    The firmware of `lwa4d` takes a torque only beside its position and speed loops, so both get a gain of zero, as
    SCHUNK's COT_CurrentMode does with the speed loop.
    """
    if profile == "cia402":
        return []
    return [((0x2030, 0), "<f", 0.0), ((0x2020, 0), "<f", 0.0)]
