"""What may be written to the PDO parameters 1400-1BFF, and what they then mean (CiA 301, 7.5.2.35 to 7.5.2.38)."""

from dataclasses import dataclass
from typing import Any

from canopen.objectdictionary import datatypes

from lwa4d_sim.bus.dictionary import Dictionary
from lwa4d_sim.bus.entry import (
    INCOMPATIBLE,
    INVALID,
    NO_OBJECT,
    NOT_MAPPABLE,
    PDO_TOO_LONG,
    UNSUPPORTED,
    Abort,
)
from lwa4d_sim.bus.mapping import DUMMIES, MAX_BITS, Item, Mapping

RECEIVE, TRANSMIT = range(0x1400, 0x1600), range(0x1800, 0x1A00)
MAPPING_OFFSET = 0x200  # from a communication record to its mapping record

NOT_VALID, NO_REMOTE, EXTENDED = 1 << 31, 1 << 30, 1 << 29  # bits of a COB-ID entry
COB_ID, KIND, INHIBIT, EVENT_TIMER, SYNC_START = 1, 2, 3, 5, 6  # sub-indices of a communication record
LAST_CYCLIC, EVENT = 240, 254  # transmission types: 1 to 240 every n-th SYNC, 254 and 255 on events
ON_REQUEST_SAMPLED, ON_REQUEST = 252, 253

# Identifiers that no PDO may have (CiA 301, table 39).
RESTRICTED = (
    range(0x080),
    range(0x101, 0x181),
    range(0x581, 0x600),
    range(0x601, 0x680),
    range(0x6E0, 0x800),
)
INHIBIT_UNIT, TIMER_UNIT = 100_000, 1_000_000  # [ns]


@dataclass(frozen=True, slots=True)
class Parameters:
    """One PDO as its objects describe it.

    Attributes:
        record: index of its communication record.
        cob_id: 11-bit identifier.
        valid: whether it exists.
        remote: whether it may be asked for by remote frame.
        kind: transmission type.
        inhibit: shortest time between two transmissions [ns].
        timer: longest time between two, or longest wait for one [ns]; 0 = none.
        start: SYNC counter at which it starts; 0 = any.
        mapping: its contents.
    """

    record: int
    cob_id: int
    valid: bool
    remote: bool
    kind: int
    inhibit: int
    timer: int
    start: int
    mapping: Mapping


def is_pdo(index: int) -> bool:
    """Whether an object describes a PDO."""
    return 0x1400 <= index < 0x1C00


def record_of(index: int) -> int:
    """Communication record of the PDO that an object describes."""
    return index if index in RECEIVE or index in TRANSMIT else index - MAPPING_OFFSET


def records(dictionary: Dictionary) -> list[int]:
    """Communication records of all PDOs that a dictionary has."""
    return [record for record in (*RECEIVE, *TRANSMIT) if (record, COB_ID) in dictionary]


def pdo_ids(dictionary: Dictionary, but: int = 0) -> set[int]:
    """Identifiers of the PDOs that exist, the one with record ``but`` left out."""
    cob_ids = [dictionary[record, COB_ID] for record in records(dictionary) if record != but]
    return {cob_id & 0x7FF for cob_id in cob_ids if not cob_id & NOT_VALID}


def parameters(dictionary: Dictionary, record: int) -> Parameters:
    """The PDO that a communication record and its mapping record describe now."""
    values = dictionary.values
    cob_id = values[record, COB_ID]
    table = record + MAPPING_OFFSET
    entries = [values[table, k] for k in range(1, values[table, 0] + 1)]
    return Parameters(
        record=record,
        cob_id=cob_id & 0x7FF,
        valid=not cob_id & NOT_VALID,
        remote=not cob_id & NO_REMOTE,
        kind=values[record, KIND],
        inhibit=values.get((record, INHIBIT), 0) * INHIBIT_UNIT,
        timer=values.get((record, EVENT_TIMER), 0) * TIMER_UNIT,
        start=values.get((record, SYNC_START), 0),
        mapping=Mapping([_item(dictionary, entry, record in RECEIVE) for entry in entries]),
    )


def check(dictionary: Dictionary, index: int, sub: int, value: Any, taken: set[int]) -> None:
    """Whether a value may be written.

    Args:
        dictionary: the objects as they are now.
        index: what is to be written.
        sub: sub-index of it.
        value: with what.
        taken: identifiers that other services of the node use.

    Raises:
        Abort: it may not, and why.
    """
    record = record_of(index)
    valid = not dictionary[record, COB_ID] & NOT_VALID
    if index != record:
        _check_mapping(dictionary, record, sub, value, valid)
    elif sub == COB_ID:
        _check_cob_id(value, dictionary[record, COB_ID], taken)
    elif sub == KIND:
        reserved = LAST_CYCLIC < value < (ON_REQUEST_SAMPLED if record in TRANSMIT else EVENT)
        if reserved:
            raise Abort(INVALID)
    elif sub in (INHIBIT, SYNC_START) and valid:
        raise Abort(UNSUPPORTED)


def _check_cob_id(new: int, old: int, taken: set[int]) -> None:
    identifier = new & 0x1FFFFFFF
    if new & EXTENDED or identifier > 0x7FF:
        raise Abort(INVALID)  # the drive has 11-bit identifiers only
    if new & NOT_VALID:
        return
    if not old & NOT_VALID and identifier != old & 0x7FF:
        raise Abort(INVALID)  # a PDO that exists keeps its identifier
    if any(identifier in block for block in RESTRICTED):
        raise Abort(INVALID)
    if identifier in taken:
        raise Abort(INCOMPATIBLE)


def _check_mapping(dictionary: Dictionary, record: int, sub: int, value: int, valid: bool) -> None:
    table = record + MAPPING_OFFSET
    receive = record in RECEIVE
    if valid or (sub != 0 and dictionary[table, 0] != 0):
        raise Abort(UNSUPPORTED)
    if sub == 0:
        items = [_item(dictionary, dictionary[table, k], receive) for k in range(1, value + 1)]
        if sum(item[2] for item in items) > MAX_BITS:
            raise Abort(PDO_TOO_LONG)
    elif value:  # 0 empties the place
        _item(dictionary, value, receive)


def _item(dictionary: Dictionary, entry: int, receive: bool) -> Item:
    """What a mapping entry (index, sub-index, bits) names.

    Raises:
        Abort: no such object, or it cannot be mapped like this.
    """
    index, sub, bits = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
    if receive and index in DUMMIES[1:] and sub == 0:
        if bits != {
            datatypes.INTEGER8: 8,
            datatypes.UNSIGNED8: 8,
            datatypes.INTEGER16: 16,
            datatypes.UNSIGNED16: 16,
        }.get(index, 32):
            raise Abort(NOT_MAPPABLE)
        return index, sub, bits, index
    try:
        found = dictionary.entry(index, sub)
    except Abort:
        raise Abort(NO_OBJECT) from None
    forbidden = found.access in ("ro", "const") if receive else found.access == "wo"
    if not found.mappable or forbidden or bits != found.bits:
        raise Abort(NOT_MAPPABLE)
    return index, sub, bits, found.type
