"""The object dictionary as an electronic data sheet (EDS), by way of the canopen library."""

import re
from collections.abc import Iterable, Mapping
from io import StringIO
from pathlib import Path
from typing import Any, cast

from canopen.objectdictionary import ObjectDictionary, ODArray, ODRecord, ODVariable, eds

from lwa4d_sim.bus.entry import Entry
from lwa4d_sim.bus.mapping import DUMMIES
from lwa4d_sim.errors import BusError

BIT_RATE = 500_000  # [bit/s] of the arm (schunk_robots, schunk_lwa4d/config/can0.yaml)
BIT_RATES = {50_000, 125_000, 250_000, 500_000, 1_000_000}  # EDS 0.63
LAST_SUB_INDEX = 254  # CiA 301, 7.4.3
_COMPACT = re.compile(r"^\[(\w+)\][^\[]*?^CompactSubObj\s*=\s*(\S+)", re.MULTILINE | re.IGNORECASE)
RECORDS = (0x1018, *range(0x1200, 0x1C00))  # identity, SDO and PDO parameters are records even if all members are alike


def object_dictionary(entries: Iterable[Entry], names: Mapping[int, str], node_id: int) -> ObjectDictionary:
    """Objects as the canopen library knows them.

    Args:
        entries: the objects.
        names: of the objects that have sub-indices.
        node_id: for the defaults that contain it.
    """
    od = ObjectDictionary()  # type: ignore[no-untyped-call]  # canopen is typed in part
    od.node_id, od.bitrate = node_id, BIT_RATE
    members: dict[int, list[Entry]] = {}
    for entry in sorted(entries, key=lambda entry: (entry.index, entry.sub)):
        members.setdefault(entry.index, []).append(entry)
    for kind in DUMMIES[1:]:  # EDS 0.63 leaves out the first, BOOLEAN
        dummy = ODVariable(f"Dummy{kind:04d}", kind)
        dummy.data_type, dummy.access_type = kind, "const"
        od.add_object(dummy)
    for index, group in members.items():
        if index not in names:
            od.add_object(_variable(group[0], node_id))
            continue
        record = index in RECORDS or len({entry.type for entry in group[1:]}) > 1
        parent = ODRecord(names[index], index) if record else ODArray(names[index], index)
        for entry in group:
            parent.add_member(_variable(entry, node_id))
        od.add_object(parent)
    info: Any = od.device_information
    info.vendor_name, info.product_name = "lwa4d_sim", "simulated rotary drive"
    info.allowed_baudrates = set(BIT_RATES)
    info.simple_boot_up_slave, info.granularity, info.LSS_supported = True, 8, False
    info.nr_of_RXPDO = sum(0x1400 <= index < 0x1600 for index in members)
    info.nr_of_TXPDO = sum(0x1800 <= index < 0x1A00 for index in members)
    return od


def export(od: ObjectDictionary, path: str | Path) -> None:
    """Write an object dictionary as EDS; the same text every time."""
    about = {"FileName": Path(path).name, "CreatedBy": "lwa4d_sim"}
    for what in ("Creation", "Modification"):
        about |= {f"{what}Date": "01-01-2026", f"{what}Time": "12:00AM"}
    with open(path, "w", encoding="ascii", newline="\n") as file:
        eds.export_eds(od, file, about)  # type: ignore[no-untyped-call]


def load(path: Path, node_id: int | None = None) -> ObjectDictionary:
    """Read a data sheet (EDS) or a configuration (DCF).

    Raises:
        BusError: the file is not there, or is none.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise BusError(f"{path}: cannot read the data sheet: {error.strerror or error}") from error
    for index, count in _COMPACT.findall(text):
        if not count.isdecimal() or int(count) > LAST_SUB_INDEX:  # the library would make them all, were it billions
            raise BusError(f"{path}: no data sheet: [{index}] has CompactSubObj={count}, not 0 to {LAST_SUB_INDEX}")
    try:
        od = eds.import_eds(StringIO(text), node_id)  # type: ignore[no-untyped-call]
    except Exception as error:  # the library lets through whatever its parser meets
        reason = " ".join(str(error).split()) or type(error).__name__
        raise BusError(f"{path}: no data sheet: {reason}") from error
    if not len(od):
        raise BusError(f"{path}: no data sheet: it lists no object")
    return cast(ObjectDictionary, od)


def _variable(entry: Entry, node_id: int) -> ODVariable:
    variable: Any = ODVariable(entry.name, entry.index, entry.sub)
    variable.data_type, variable.access_type, variable.unit = entry.type, entry.access, entry.unit
    variable.pdo_mappable, variable.description = entry.mappable, entry.source
    if entry.bits:
        variable.min, variable.max = entry.low, entry.high
    variable.default, variable.relative = entry.default, entry.relative
    if entry.relative:
        base = entry.default & ~0x7F
        variable.default, raw = base + node_id, f"$NODEID+0x{base:X}"
    else:
        # the exporter alone would write negative numbers as 0x-3, which no reader takes
        raw = entry.default.hex() if isinstance(entry.default, bytes) else str(entry.default)
    if raw:
        variable.default_raw = raw
    else:
        variable.default = None
    return cast(ODVariable, variable)
