"""What a CANopen node expects of the device behind its objects."""

from typing import Literal, Protocol

from lwa4d_sim.interfaces import Ns

Loss = Literal["heartbeat", "guarding", "nmt_stop", "bus_off", "sync", "rpdo"]


class Device(Protocol):
    """What sits behind the dictionary."""

    def advance(self, now: Ns) -> None:
        """Bring the physics up to now; called before anything is handed to or read from the device."""
        ...

    def refresh(self) -> None:
        """Update actual values in the dictionary, before a TPDO is sampled or an SDO read is answered."""
        ...

    def written(self, index: int, sub: int) -> None:
        """An object was written by SDO or RPDO; its value is in the dictionary.

        Raises:
            Abort: the value is refused; the old one is put back.
        """
        ...

    def sync(self, now: Ns) -> None:
        """SYNC: after latched RPDOs were written, before TPDOs are sampled."""
        ...

    def lost(self, reason: Loss, now: Ns) -> None:
        """The connection to the master is lost (6007)."""
        ...

    def reset(self, now: Ns) -> None:
        """NMT reset node: as after power-on. The dictionary has been reset already."""
        ...

    def poll(self, now: Ns) -> Ns | None:
        """Let own timers act; the next one, or None."""
        ...


class Nothing:
    """A device that does nothing."""

    def advance(self, now: Ns) -> None: ...

    def refresh(self) -> None: ...

    def written(self, index: int, sub: int) -> None: ...

    def sync(self, now: Ns) -> None: ...

    def lost(self, reason: Loss, now: Ns) -> None: ...

    def reset(self, now: Ns) -> None: ...

    def poll(self, now: Ns) -> Ns | None:
        return None
