"""What scripted faults do to the frames that the master and the drives send: rules in front of the wire."""

from collections.abc import Callable
from dataclasses import dataclass

import can

from lwa4d_sim.bus.fault_options import DuplicatedPdo, FrameFault, LatePdo, LateSync, LongSync, LostPdo, LostSync, Pdo
from lwa4d_sim.bus.options import Profile
from lwa4d_sim.bus.stations import LAYOUTS
from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.interfaces import Ns, to_ns

SYNC = 0x080  # CiA 301, predefined connection set, as the next
_BASES = {"rpdo1": 0x200, "rpdo2": 0x300, "tpdo1": 0x180, "tpdo2": 0x280}

Frames = list[tuple[Ns, can.Message]]
AT_ONCE = Ns(0)


@dataclass(slots=True)
class Rule:
    """What becomes of some frames.

    Attributes:
        at: from when on [ns].
        cob_id: of the frames.
        left: how many more it changes.
        change: what is put on the wire instead of one.
    """

    at: Ns
    cob_id: int
    left: int
    change: Callable[[can.Message], Frames]


class Tamper:
    """Stands in front of a wire (`Wire.tamper`).

    Attributes:
        rules: those that are not used up.
        without_heartbeat: error control identifiers whose frames are swallowed.
    """

    def __init__(self) -> None:
        self.rules: list[Rule] = []
        self.without_heartbeat: set[int] = set()
        self._held: dict[int, Ns] = {}  # identifier: until when its frames are held back

    def __call__(self, msg: can.Message, port: str, now: Ns) -> Frames:
        """What goes on the wire instead of a frame, and how much later [ns]."""
        cob_id = msg.arbitration_id
        # Strangers' frames are not touched, even with an identifier of the arm.
        if msg.is_extended_id or msg.is_remote_frame or not (port == "master" or port.startswith("node ")):
            return [(AT_ONCE, msg)]
        if cob_id in self.without_heartbeat:
            return []
        frames: Frames = [(AT_ONCE, msg)]
        for rule in self.rules:
            if rule.cob_id == cob_id and now >= rule.at:
                frames = rule.change(msg)
                rule.left -= 1
                if rule.left == 0:
                    self.rules.remove(rule)
                break
        held = Ns(self._held.get(cob_id, now) - now)  # nothing overtakes a frame of its own identifier
        frames = [(max(delay, held), each) for delay, each in frames]
        if frames and frames[0][0] > 0:
            self._held[cob_id] = Ns(now + frames[0][0])
        return frames


def rule(fault: FrameFault, key: str, profile: Profile) -> Rule:
    """The rule of a fault.

    Args:
        fault: as the scenario has it.
        key: its place there.
        profile: of the drives, which says how long a PDO is.

    Raises:
        ScenarioError: a PDO cannot have such a length.
    """
    cob_id = SYNC if isinstance(fault, LostSync | LateSync | LongSync) else _BASES[fault.pdo] + fault.node
    return Rule(to_ns(fault.at), cob_id, fault.count, _change(fault, key, profile))


def _change(fault: FrameFault, key: str, profile: Profile) -> Callable[[can.Message], Frames]:
    if isinstance(fault, LostSync | LostPdo):
        return lambda msg: []
    if isinstance(fault, LateSync | LatePdo):
        delay = to_ns(fault.delay)
        return lambda msg: [(delay, msg)]
    if isinstance(fault, DuplicatedPdo):
        copy = to_ns(fault.delay)
        return lambda msg: [(AT_ONCE, msg), (copy, msg)]
    if isinstance(fault, LongSync):
        size = fault.size
    else:
        right, short = pdo_size(profile, fault.pdo), fault.kind == "short_pdo"
        size = fault.size if fault.size is not None else right + (-1 if short else 1)
        if not (0 <= size < right if short else right < size <= 8):
            rule = f"must be below {right}" if short else f"must be above {right} and at most 8"
            raise ScenarioError(f"{fault.pdo} of the profile '{profile}' has {right} bytes; size {rule}", key)
    return lambda msg: [(AT_ONCE, _resized(msg, size))]


def pdo_size(profile: Profile, pdo: Pdo) -> int:
    """Bytes of a PDO."""
    layout, number = LAYOUTS[profile], int(pdo[-1]) - 1
    items = (layout.receive if pdo[0] == "r" else layout.transmit)[number]
    return sum(bits for _, _, bits, _ in items) // 8


def _resized(msg: can.Message, size: int) -> can.Message:
    data = bytes(msg.data[:size]).ljust(size, b"\0")
    return can.Message(arbitration_id=msg.arbitration_id, data=data, is_extended_id=False)
