"""PDO mapping: which objects share the eight bytes of a frame, packed and unpacked.

Layout after CiA 301, 7.2.2: the first mapped object takes the lowest bits of the first byte; integers little endian.
"""

import struct
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Any, Literal

from canopen.objectdictionary import datatypes

Key = tuple[int, int]  # index and sub-index of an object
# Index, sub-index, length [bit], and the data type (of canopen.objectdictionary.datatypes) or just: is it signed?
Item = tuple[int, int, int, bool | int]

MAX_BITS = 64  # the data field of a classic CAN frame
DUMMIES = range(1, 8)  # indices 0001 to 0007 are data types: mapped to leave a gap (CiA 301, 7.4.6)

_Family = Literal["signed", "unsigned", "float"]
_CODES: dict[tuple[_Family, int], str] = {
    ("signed", 8): "b",
    ("signed", 16): "h",
    ("signed", 32): "i",
    ("signed", 64): "q",
    ("unsigned", 8): "B",
    ("unsigned", 16): "H",
    ("unsigned", 32): "I",
    ("unsigned", 64): "Q",
    ("float", 32): "f",
    ("float", 64): "d",
}


class Mapping:
    """The objects of one PDO.

    Args:
        items: mapped objects in order, each (index, sub-index, bits, data type or signed). Dummy objects 0001 to 0007
            leave gaps.

    Attributes:
        keys: (index, sub-index) of the mapped objects, gaps left out.
        bits: used length [bit].
        size: length of the frame's data [byte].

    Raises:
        ValueError: when the objects do not fit in a frame or a type cannot be mapped.
    """

    __slots__ = ("_fields", "_get", "_struct", "bits", "keys", "size")

    def __init__(self, items: Sequence[Item]) -> None:
        self._fields = tuple((None if item[0] in DUMMIES else item[:2], item[2], _family(item)) for item in items)
        self.keys = tuple(key for key, _, _ in self._fields if key is not None)
        self.bits = sum(bits for _, bits, _ in self._fields)
        self.size = (self.bits + 7) // 8
        if self.bits > MAX_BITS:
            raise ValueError(f"a PDO holds {MAX_BITS} bits, not {self.bits}")
        codes = [_CODES.get((family, bits)) if key is not None else None for key, bits, family in self._fields]
        self._struct = struct.Struct("<" + "".join(filter(None, codes))) if None not in codes else None
        self._get: Callable[[Any], Any] | None = itemgetter(*self.keys) if len(self.keys) > 1 else None

    def values(self, data: bytes | bytearray) -> Sequence[Any]:
        """Values of `keys`, in order, in at least `size` bytes of data; bytes beyond the mapped ones do not count."""
        if self._struct is not None:
            return self._struct.unpack_from(data)
        return self._loose_values(data)

    def unpack(self, data: bytes | bytearray) -> list[tuple[Key, Any]]:
        """Mapped objects and their values in at least `size` bytes of data."""
        return list(zip(self.keys, self.values(data), strict=True))

    def pack(self, values: Callable[[Key], Any]) -> bytes:
        """The data field; each value is asked for by its key.

        Raises:
            OverflowError: a value does not fit in its bits.
        """
        return self._packed([values(key) for key in self.keys])

    def pack_from(self, values: dict[Key, Any]) -> bytes:
        """As `pack`, from a table: the fast road of every cycle."""
        return self._packed(self._get(values) if self._get is not None else [values[key] for key in self.keys])

    def _packed(self, values: Sequence[Any]) -> bytes:
        if self._struct is None:
            return self._loose_packed(values)
        try:
            return self._struct.pack(*values)
        except struct.error as error:
            raise OverflowError(f"{tuple(values)} does not fit in {self.keys}: {error}") from error

    def _loose_values(self, data: bytes | bytearray) -> list[Any]:
        if len(data) < self.size:
            raise struct.error(f"{self.size} bytes are mapped, not {len(data)}")
        word = int.from_bytes(data[: self.size], "little")
        values: list[Any] = []
        for key, bits, family in self._fields:
            raw = word & ((1 << bits) - 1)
            word >>= bits
            if key is None:
                continue
            if family == "float":
                values.append(struct.unpack("<" + _CODES[family, bits], raw.to_bytes(bits // 8, "little"))[0])
            else:
                negative = family == "signed" and raw >> (bits - 1)
                values.append(raw - (1 << bits) if negative else raw)
        return values

    def _loose_packed(self, values: Sequence[Any]) -> bytes:
        word, shift, left = 0, 0, iter(values)
        for key, bits, family in self._fields:
            value = 0 if key is None else next(left)
            if family == "float":
                value = int.from_bytes(struct.pack("<" + _CODES[family, bits], value), "little")
            low = -(1 << (bits - 1)) if family == "signed" else 0
            if not low <= value < low + (1 << bits):
                raise OverflowError(f"{value} does not fit in the {bits} bits of {key}")
            word |= (value & ((1 << bits) - 1)) << shift
            shift += bits
        return word.to_bytes(self.size, "little")


def _family(item: Item) -> _Family:
    index, sub, bits, kind = item
    family: _Family | None = None
    if isinstance(kind, bool):  # before the comparison with data types: True == BOOLEAN
        family = "signed" if kind else "unsigned"
    elif kind in datatypes.SIGNED_TYPES:
        family = "signed"
    elif kind in datatypes.UNSIGNED_TYPES or kind == datatypes.BOOLEAN:
        family = "unsigned"
    elif (kind, bits) in ((datatypes.REAL32, 32), (datatypes.REAL64, 64)):
        family = "float"
    if family is None or not 1 <= bits <= MAX_BITS:
        raise ValueError(f"object {index:04X}:{sub:02X} of data type {kind} cannot be mapped with {bits} bits")
    return family
