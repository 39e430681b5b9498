"""The objects of a node as an SDO reaches them, with the rules that a type and two limits cannot express (CiA 301)."""

from collections.abc import Callable
from typing import Any

from lwa4d_sim.bus import pdo_rules
from lwa4d_sim.bus.device import Device
from lwa4d_sim.bus.dictionary import Dictionary, Group
from lwa4d_sim.bus.entry import CANNOT_STORE, INCOMPATIBLE, INVALID, WRONG_STATE, Abort
from lwa4d_sim.bus.error_control import check_consumer
from lwa4d_sim.bus.pdo_rules import EXTENDED, NOT_VALID, RESTRICTED, is_pdo, pdo_ids, record_of
from lwa4d_sim.bus.sync import PRODUCE
from lwa4d_sim.interfaces import Ns

SAVE, LOAD = (int.from_bytes(text, "little") for text in (b"save", b"load"))
STORE, RESTORE = 0x1010, 0x1011
GROUP_OF_SUB: dict[int, Group] = {1: "all", 2: "communication", 3: "application", 4: "manufacturer"}
APPLICATION = 0x2000  # from here on the objects are the device's


class Access:
    """Reading and writing with all that follows from it.

    Args:
        dictionary: the objects.
        node_id: of the node.
        device: what the objects from 2000 on belong to.
        changed: told of a communication object that was written.

    Attributes:
        now: instant of the request [ns]; set it before.
    """

    def __init__(self, dictionary: Dictionary, node_id: int, device: Device, changed: Callable[[int], None]) -> None:
        self._dictionary, self._node_id, self._device, self._changed = dictionary, node_id, device, changed
        self.now = Ns(0)

    def read(self, index: int, sub: int) -> bytes:
        """Value of an object; raises `Abort`."""
        if index >= APPLICATION:
            self._device.advance(self.now)
            self._device.refresh()
        return self._dictionary.read(index, sub)

    def capacity(self, index: int, sub: int) -> int:
        """Longest value [byte] that an object takes; raises `Abort`."""
        return self._dictionary.writable(index, sub).capacity

    def write(self, index: int, sub: int, data: bytes) -> None:
        """Write an object; raises `Abort`."""
        dictionary, values = self._dictionary, self._dictionary.values
        value = dictionary.decode(index, sub, data)
        if index >= APPLICATION:
            self._device.advance(self.now)
            old, values[index, sub] = values[index, sub], value
            try:
                self._device.written(index, sub)
            except Abort:
                values[index, sub] = old
                raise
            return
        check(dictionary, self._node_id, index, sub, value)
        if index == STORE:
            dictionary.store(GROUP_OF_SUB[sub])
        elif index == RESTORE:
            dictionary.restore(GROUP_OF_SUB[sub])
        else:
            values[index, sub] = value
            self._changed(index)


def check(dictionary: Dictionary, node_id: int, index: int, sub: int, value: Any) -> None:
    """Whether a communication object may be given a value.

    Args:
        dictionary: the objects as they are now.
        node_id: of the node.
        index: what is to be written.
        sub: sub-index of it.
        value: with what; its type and limits are right.

    Raises:
        Abort: it may not, and why.
    """
    values = dictionary.values
    sync, emergency = values[0x1005, 0] & 0x7FF, values[0x1014, 0]
    fixed = {0x000, 0x580 + node_id, 0x600 + node_id, 0x700 + node_id}
    if is_pdo(index):
        taken = fixed | {sync, emergency & 0x7FF} | pdo_ids(dictionary, but=record_of(index))
        pdo_rules.check(dictionary, index, sub, value, taken)
    elif index == 0x1003 and value:
        raise Abort(INVALID)
    elif index == 0x1005:
        _check_id(value, fixed | {emergency & 0x7FF} | pdo_ids(dictionary))
        if value & PRODUCE and (0x1006, 0) not in dictionary:
            raise Abort(INVALID)
        if values[0x1005, 0] & value & PRODUCE and sync != value & 0x7FF:
            raise Abort(INVALID)
    elif index == 0x1014:
        _check_id(value, fixed | {sync} | pdo_ids(dictionary))
        if not (emergency | value) & NOT_VALID and value != emergency:
            raise Abort(INVALID)
    elif index == 0x1016:
        check_consumer(values, sub, value)
    elif index == 0x1019:
        if values[0x1006, 0]:
            raise Abort(WRONG_STATE)  # not while the period of the SYNC is set
        if value == 1:
            raise Abort(INVALID)
    elif index in (STORE, RESTORE) and value != (SAVE if index == STORE else LOAD):
        raise Abort(CANNOT_STORE)


def _check_id(value: int, taken: set[int]) -> None:
    identifier = value & 0x1FFFFFFF
    if value & EXTENDED or any(identifier in block for block in RESTRICTED) or identifier > 0x7FF:
        raise Abort(INVALID)
    if identifier in taken and not value & NOT_VALID:
        raise Abort(INCOMPATIBLE)
