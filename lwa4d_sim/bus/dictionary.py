"""The object dictionary of a drive: its objects, their values, the checks of a write, non-volatile memory."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal, cast

from canopen.objectdictionary import ObjectDictionary, datatypes

from lwa4d_sim.bus import sheet
from lwa4d_sim.bus.entry import NO_OBJECT, NO_SUB_INDEX, RANGES, READ_ONLY, STRUCTS, WRITE_ONLY, Abort, Access, Entry
from lwa4d_sim.bus.mapping import Key
from lwa4d_sim.bus.objects import EXTENSION, EXTENSION_PDOS, FIRMWARE, FIRMWARE_PDOS, pdo_rows
from lwa4d_sim.bus.options import FIRST_NODE

__all__ = ["Abort", "Dictionary", "Entry", "Group", "Joint", "drive_dictionary"]

Group = Literal["all", "communication", "manufacturer", "application"]

GROUPS: dict[Group, range] = {  # CiA 301, 7.4.1
    "all": range(0x10000),
    "communication": range(0x1000, 0x2000),
    "manufacturer": range(0x2000, 0x6000),
    "application": range(0x6000, 0xA000),
}

MDEG_PER_RAD = 180_000 / math.pi
FLOAT_MAX = 3.4028234663852886e38  # largest finite REAL32

# Data types of the tables.
_TYPES = {
    "u8": datatypes.UNSIGNED8,
    "u16": datatypes.UNSIGNED16,
    "u32": datatypes.UNSIGNED32,
    "i8": datatypes.INTEGER8,
    "i16": datatypes.INTEGER16,
    "i32": datatypes.INTEGER32,
    "f32": datatypes.REAL32,
    "str": datatypes.VISIBLE_STRING,
    "oct": datatypes.OCTET_STRING,
    "dom": datatypes.DOMAIN,
}


class Dictionary:
    """Objects and their values.

    The device reads and writes with ``dictionary[index, sub]``; the bus with `read` and `write`, which check.

    Args:
        entries: the objects, sub-index 0 of arrays and records included.
        names: of the objects that have sub-indices.

    Attributes:
        values: the values by (index, sub-index); to be read, not written.
    """

    def __init__(self, entries: Iterable[Entry], names: Mapping[int, str]) -> None:
        self._entries = {(entry.index, entry.sub): entry for entry in entries}
        self._indices = {index for index, _ in self._entries}
        self._names = dict(names)
        self._defaults = {key: entry.default for key, entry in self._entries.items()}
        self._stored: dict[Key, Any] = {}
        self._ranges = {key: RANGES.get(entry.type) for key, entry in self._entries.items()}
        self.values: dict[Key, Any] = dict(self._defaults)

    def __getitem__(self, key: Key) -> Any:
        return self.values[key]

    def __setitem__(self, key: Key, value: Any) -> None:
        limits = self._ranges[key]
        if limits is not None:
            low, high = limits
            value = low if value < low else high if value > high else value if type(value) is int else round(value)
        elif type(value) is float and not -FLOAT_MAX <= value <= FLOAT_MAX and math.isfinite(value):
            value = math.copysign(FLOAT_MAX, value)
        self.values[key] = value

    def __contains__(self, key: object) -> bool:
        return key in self.values

    def entry(self, index: int, sub: int) -> Entry:
        """Definition of an object.

        Raises:
            Abort: there is no such object (06020000) or sub-index (06090011).
        """
        entry = self._entries.get((index, sub))
        if entry is None:
            raise Abort(NO_SUB_INDEX if index in self._indices else NO_OBJECT)
        return entry

    def redefine(self, key: Key, default: Any) -> None:
        """Set what a parameter is after power-on, and now."""
        self[key] = default
        self._defaults[key] = self.values[key]
        self._entries[key] = replace(self._entries[key], default=self.values[key])

    def read(self, index: int, sub: int) -> bytes:
        """A value as the bus sees it.

        Raises:
            Abort: there is no such object, or it is write-only.
        """
        entry = self.entry(index, sub)
        if entry.access == "wo":
            raise Abort(WRITE_ONLY)
        return entry.encode(self.values[index, sub])

    def writable(self, index: int, sub: int) -> Entry:
        """Definition of an object that the bus may write.

        Raises:
            Abort: there is no such object, or it is read-only.
        """
        entry = self.entry(index, sub)
        if entry.access in ("ro", "const"):
            raise Abort(READ_ONLY)
        return entry

    def decode(self, index: int, sub: int, data: bytes) -> Any:
        """The value that a write from the bus would set.

        Raises:
            Abort: no such object, read-only, wrong length or out of range.
        """
        return self.writable(index, sub).decode(data)

    def write(self, index: int, sub: int, data: bytes) -> None:
        """Write from the bus: access, length and range are checked.

        Raises:
            Abort: see `decode`.
        """
        self.values[index, sub] = self.decode(index, sub, data)

    def store(self, group: Group = "all") -> None:
        """Put the parameters of a group into non-volatile memory (1010)."""
        for key, entry in self._entries.items():
            if key[0] in GROUPS[group] and entry.access in ("rw", "wo") and not entry.volatile:
                self._stored[key] = self.values[key]

    def restore(self, group: Group = "all") -> None:
        """Forget what was stored of a group (1011): defaults hold from the next reset on."""
        for key in [key for key in self._stored if key[0] in GROUPS[group]]:
            del self._stored[key]

    def reset(self, group: Group = "all") -> None:
        """Values after power-on: the stored ones, else the defaults."""
        for key, default in self._defaults.items():
            if key[0] in GROUPS[group]:
                self.values[key] = self._stored.get(key, default)

    def eds(self, node_id: int) -> ObjectDictionary:
        """The objects as the canopen library knows them."""
        return sheet.object_dictionary(self._entries.values(), self._names, node_id)

    def export_eds(self, path: str | Path, node_id: int) -> None:
        """Write the objects as an electronic data sheet."""
        sheet.export(self.eds(node_id), path)


@dataclass(frozen=True, slots=True, kw_only=True)
class Joint:
    """What a drive knows about its joint.

    Attributes:
        name: of the module.
        low, high: position limits [rad], None for a joint without.
        speed: largest speed [rad/s].
        acceleration: largest acceleration [rad/s^2].
        torque: peak torque [N m].
        torque_constant: joint torque a current gives [N m/A].
        node: id of its drive.
    """

    name: str
    low: float | None
    high: float | None
    speed: float
    acceleration: float
    torque: float
    torque_constant: float = 10.0  # gear 100 x 0.1 N m/A of the ERB 115 (AndreaGiusti/OTFCtrlModRob); upper bound
    node: int = FIRST_NODE


def drive_dictionary(profile: Literal["lwa4d", "cia402"], node_id: int, joint: Joint) -> Dictionary:
    """The objects of one drive: ``lwa4d`` as the firmware has them, ``cia402`` with extensions."""
    mdeg = {"speed": joint.speed, "acceleration": joint.acceleration}
    constants: dict[str, Any] = {name: round(value * MDEG_PER_RAD) for name, value in mdeg.items()}
    constants |= {
        "name": joint.name.encode("ascii", "replace").decode(),
        "image": bytes(k % 256 for k in range(1024)),  # some content to upload
        "low": -(1 << 31) if joint.low is None else round(joint.low * MDEG_PER_RAD),
        "high": (1 << 31) - 1 if joint.high is None else round(joint.high * MDEG_PER_RAD),
        "torque": round(joint.torque * 1000),
        "current": math.ceil(joint.torque / joint.torque_constant * 1000),
    }
    tables = [FIRMWARE, pdo_rows(FIRMWARE_PDOS, extended=False)]
    if profile == "cia402":
        tables = [FIRMWARE, EXTENSION, pdo_rows(EXTENSION_PDOS, extended=True)]
    rows: dict[Key, tuple[str, ...]] = {}
    names: dict[int, str] = {}
    for table in tables:
        rows |= _rows(table)[0]
        names |= _rows(table)[1]
    for index in names:
        if (index, 0) not in rows:
            last = max(sub for i, sub in rows if i == index)
            rows[index, 0] = ("u8", "const", str(last), "-", "-", "-", "highest sub-index", rows[index, last][-1])
    return Dictionary([_entry(key, row, node_id, constants) for key, row in sorted(rows.items())], names)


@cache
def _rows(table: str) -> tuple[dict[Key, tuple[str, ...]], dict[int, str]]:
    rows: dict[Key, tuple[str, ...]] = {}
    names: dict[int, str] = {}
    source = ""
    for line in table.strip().splitlines():
        if line.startswith("#"):
            source = line[2:]
            continue
        place, kind, rest = line.split(maxsplit=2)
        index, _, sub = place.partition(":")
        if kind == "=":
            names[int(index, 16)] = rest
        else:
            rows[int(index, 16), int(sub or "0", 16)] = (kind, *rest.split(maxsplit=5), source)
    return rows, names


def _entry(key: Key, row: tuple[str, ...], node_id: int, constants: Mapping[str, Any]) -> Entry:
    kind, access, text, limits, flags, unit, name, source = row
    low, high = map(int, limits.split("..")) if limits != "-" else (None, None)
    data_type = _TYPES[kind]
    default: Any = text
    if text.startswith("@"):
        default = constants[text[1:]]
    elif text.startswith("$"):
        default = int(text[1:], 0) + node_id
    elif kind == "f32":
        default = float(text)
    elif data_type in STRUCTS:
        default = int(text, 0)
    elif text == "-":
        default = "" if kind == "str" else b""
    if data_type in RANGES:  # constants of an unusual joint may not fit
        first, last = RANGES[data_type]
        default = min(max(default, first if low is None else low), last if high is None else high)
    elif data_type not in STRUCTS and high is None:
        high = max(64, len(default))
    return Entry(
        index=key[0],
        sub=key[1],
        name=name,
        type=data_type,
        access=cast(Access, access),
        default=default,
        low=low,
        high=high,
        mappable="m" in flags,
        unit="" if unit == "-" else unit,
        source=source,
        relative=text.startswith("$"),
        volatile="v" in flags,
    )
