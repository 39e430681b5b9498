"""What a drive reports: emergency codes and the error register that goes with each."""

from collections.abc import Callable

from lwa4d_sim.bus.device import Loss

# Codes of CiA 301 and 402; all but 8100 and 8140 are in the list of SCHUNK's modules (libPowerballArm, schunkErrors.h).
OVERHEATED = 0x4210
PARAMETER = 0x6320
COMMUTATION = 0x7122
ENCODER = 0x7305
SYNC_LOST = 0x8100  # generic communication error: neither CiA 301 nor the list has one for a missing SYNC
OVERSPEED = 0x8400
FOLLOWING = 0x8611
UNDER_VOLTAGE = frozenset({0x3221, 0x3222})

# What 603F says after a loss that is a fault by 6007 = 1. The node reports it, but for an NMT command, which is none.
LOSS_CODES: dict[Loss, int] = {
    "heartbeat": 0x8130,
    "guarding": 0x8130,
    "nmt_stop": 0x8100,
    "bus_off": 0x8140,
    "sync": SYNC_LOST,
    "rpdo": 0x8250,
}

# Error register 1001 (CiA 301): bit 0 is set with any error.
GENERIC, CURRENT, VOLTAGE, TEMPERATURE, COMMUNICATION, PROFILE = 0x01, 0x02, 0x04, 0x08, 0x10, 0x20
_REGISTER = {0x2: CURRENT, 0x3: VOLTAGE, 0x4: TEMPERATURE}


def register(code: int) -> int:
    """Error register of an emergency code."""
    if code >> 8 in (0x81, 0x82):
        return GENERIC | COMMUNICATION
    if code >> 12 == 0x8:
        return GENERIC | PROFILE
    return GENERIC | _REGISTER.get(code >> 12, 0)


class Faults:
    """The faults that are present.

    Args:
        emergency: reports one: code and error register.
        recovered: says that one is gone.

    Attributes:
        active: their codes.
    """

    def __init__(self, emergency: Callable[[int, int], None], recovered: Callable[[int], None]) -> None:
        self.emergency, self.recovered = emergency, recovered
        self.active: set[int] = set()

    def come(self, code: int, *, report: bool) -> None:
        """A fault; it is reported if no one else does."""
        self.active.add(code)
        if report:
            self.emergency(code, register(code))

    def reset(self) -> None:
        """All are taken back."""
        for code in sorted(self.active):
            self.recovered(code)
        self.active.clear()
