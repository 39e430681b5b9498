"""One object of a dictionary: its definition, how its value looks on the bus, and why a request is refused."""

import struct
from dataclasses import dataclass
from typing import Any, Literal

from canopen.objectdictionary import datatypes

Access = Literal["ro", "rw", "wo", "const"]

STRUCTS = {
    datatypes.UNSIGNED8: struct.Struct("<B"),
    datatypes.UNSIGNED16: struct.Struct("<H"),
    datatypes.UNSIGNED32: struct.Struct("<I"),
    datatypes.INTEGER8: struct.Struct("<b"),
    datatypes.INTEGER16: struct.Struct("<h"),
    datatypes.INTEGER32: struct.Struct("<i"),
    datatypes.REAL32: struct.Struct("<f"),
}
RANGES = {
    kind: (-(1 << (8 * form.size - 1)), (1 << (8 * form.size - 1)) - 1)
    if kind in datatypes.SIGNED_TYPES
    else (0, (1 << (8 * form.size)) - 1)
    for kind, form in STRUCTS.items()
    if kind != datatypes.REAL32
}

# Abort codes of CiA 301, table 22.
TOGGLE, TIME_OUT, BAD_COMMAND = 0x05030000, 0x05040000, 0x05040001
BAD_BLOCK_SIZE, BAD_SEQUENCE, BAD_CRC, NO_MEMORY = 0x05040002, 0x05040003, 0x05040004, 0x05040005
UNSUPPORTED, WRITE_ONLY, READ_ONLY = 0x06010000, 0x06010001, 0x06010002
NO_OBJECT, NO_SUB_INDEX = 0x06020000, 0x06090011
NOT_MAPPABLE, PDO_TOO_LONG, INCOMPATIBLE = 0x06040041, 0x06040042, 0x06040043
WRONG_LENGTH, TOO_LONG, TOO_SHORT = 0x06070010, 0x06070012, 0x06070013
INVALID, TOO_HIGH, TOO_LOW = 0x06090030, 0x06090031, 0x06090032
GENERAL, CANNOT_STORE, WRONG_STATE = 0x08000000, 0x08000020, 0x08000022


class Abort(Exception):
    """A request of an SDO client is refused.

    Attributes:
        code: abort code of CiA 301, table 22.
    """

    def __init__(self, code: int) -> None:
        super().__init__(f"SDO abort {code:08X}")
        self.code = code


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One object, or one sub-index of one.

    Attributes:
        index, sub: its place.
        name: its name.
        type: data type (canopen.objectdictionary.datatypes).
        access: by SDO.
        default: value after power-on, unless another was stored.
        low, high: limits of a number (None = those of the type); ``high`` of text and bytes is the longest length.
        mappable: may be part of a PDO.
        unit: of the counts.
        source: where the definition comes from.
        relative: the default contains the node id.
        volatile: a command or state, not a parameter: never stored.
    """

    index: int
    sub: int
    name: str
    type: int
    access: Access
    default: Any
    low: int | None = None
    high: int | None = None
    mappable: bool = False
    unit: str = ""
    source: str = ""
    relative: bool = False
    volatile: bool = False

    @property
    def bits(self) -> int:
        """Length of a number [bit]; 0 for text and bytes."""
        return STRUCTS[self.type].size * 8 if self.type in STRUCTS else 0

    @property
    def capacity(self) -> int:
        """Longest value [byte]."""
        return self.bits // 8 or self.high or 0

    @property
    def limited(self) -> bool:
        """Whether some values of its type are refused."""
        return self.low is not None or self.high is not None or self.type == datatypes.REAL32

    def within(self, value: float) -> bool:
        """Whether a number keeps the limits; NaN does not."""
        return value == value and (
            (self.low is None or value >= self.low) and (self.high is None or value <= self.high)
        )

    def encode(self, value: Any) -> bytes:
        """A value as it goes over the bus."""
        if self.type in STRUCTS:
            return STRUCTS[self.type].pack(value)
        return value.encode("ascii", "replace") if isinstance(value, str) else bytes(value)

    def decode(self, data: bytes) -> Any:
        """The value that came over the bus.

        Raises:
            Abort: wrong length or out of range.
        """
        if len(data) > self.capacity:
            raise Abort(TOO_LONG)
        form = STRUCTS.get(self.type)
        if form is None:
            if self.type != datatypes.VISIBLE_STRING:
                return bytes(data)
            if not data.isascii():
                raise Abort(INVALID)
            return data.decode("ascii")
        if len(data) < form.size:
            raise Abort(TOO_SHORT)
        value = form.unpack(data)[0]
        if not self.within(value):
            too_high = self.high is not None and value > self.high
            raise Abort(INVALID if value != value else TOO_HIGH if too_high else TOO_LOW)
        return value
