"""What the PDOs of a logged CANopen bus carried, object by object.

The PDOs are those of the data sheets, changed by what the log itself shows: SDO downloads that were confirmed, and
boot-ups, after which the defaults hold again (CiA 301, 7.2.2 and 7.2.4).
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from lwa4d_sim.bus.mapping import DUMMIES, MAX_BITS, Item, Key
from lwa4d_sim.bus.mapping import Mapping as Packing
from lwa4d_sim.bus.master import MASTER_NODE
from lwa4d_sim.bus.pdo_rules import (
    COB_ID,
    EXTENDED,
    KIND,
    LAST_CYCLIC,
    MAPPING_OFFSET,
    NOT_VALID,
    ON_REQUEST_SAMPLED,
    RECEIVE,
    TRANSMIT,
    is_pdo,
)
from lwa4d_sim.errors import IdentificationError

Frame = tuple[float, int, bytes]  # time stamp [s], 11-bit identifier, data
# Identifiers of CiA 301's predefined connection set, less the node id.
REQUEST, ANSWER, ERROR_CONTROL = 0x600, 0x580, 0x700
DOWNLOADED, BOOT_UP = 0x60, b"\0"  # SDO: response to a download (CiA 301, 7.2.4.3.3); first heartbeat after a start


@dataclass(frozen=True, slots=True)
class Pdo:
    """One PDO that exists.

    Attributes:
        name: RPDO or TPDO and its number.
        cob_id: identifier.
        transmitted: by the node; else received.
        synchronous: what it carries was sampled at, or acts at, a SYNC.
        packing: its contents.
    """

    name: str
    cob_id: int
    transmitted: bool
    synchronous: bool
    packing: Packing


class NodePdos:
    """The PDO parameters of one node as a log goes by.

    Args:
        node: its id.
        sheet: its objects, as the canopen library knows them.

    Attributes:
        changed: the log has written some.
    """

    def __init__(self, node: int, sheet: Any) -> None:
        self.node, self._types = node, dict[Key, int]()
        self._defaults: dict[Key, int] = {}
        for index in sheet:
            found = sheet[index]
            subs = found.subindices if hasattr(found, "subindices") else {0: found}
            for sub, variable in subs.items():
                self._types[index, sub] = variable.data_type
                value = getattr(variable, "value", None)  # a configuration (DCF) has values beside the defaults
                value = variable.default if value is None else value
                if is_pdo(index) and isinstance(value, int):
                    self._defaults[index, sub] = value
        self._records = [record for record in (*RECEIVE, *TRANSMIT) if (record, COB_ID) in self._defaults]
        self._values = dict(self._defaults)
        self._asked: tuple[bytes, Key, int] | None = None
        self.changed = False

    def __contains__(self, key: object) -> bool:
        return key in self._types

    def hear(self, cob_id: int, data: bytes) -> bool:
        """Take in a frame of the node's SDO or error control; says whether its PDOs have changed."""
        if cob_id == REQUEST + self.node:
            self._asked = _expedited(data)
        elif cob_id == ANSWER + self.node:
            asked, self._asked = self._asked, None
            if asked is not None and data[:4] == bytes([DOWNLOADED]) + asked[0] and is_pdo(asked[1][0]):
                self._values[asked[1]] = asked[2]
                self.changed = True
                return True
        elif data == BOOT_UP and self._values != self._defaults:
            self._values = dict(self._defaults)
            self.changed = False
            return True
        return False

    def pdos(self) -> list[Pdo]:
        """Those that exist now and carry anything.

        Raises:
            IdentificationError: a mapping that no frame can have.
        """
        made = []
        for record in self._records:
            cob_id, table = self._values[record, COB_ID], record + MAPPING_OFFSET
            count = self._values.get((table, 0), 0)
            if cob_id & (NOT_VALID | EXTENDED) or not count:
                continue
            transmitted, kind = record in TRANSMIT, self._values.get((record, KIND), LAST_CYCLIC)
            name = f"{'T' if transmitted else 'R'}PDO{record % 0x200 + 1}"
            places = range(1, min(count, MAX_BITS + 1) + 1)  # more are too many anyway, were they a billion
            try:
                packing = Packing([self._item(self._values.get((table, k), 0)) for k in places])
            except ValueError as error:
                raise IdentificationError(f"node {self.node}: {name} cannot be as it is mapped: {error}") from error
            synchronous = kind <= LAST_CYCLIC or (transmitted and kind == ON_REQUEST_SAMPLED)
            made.append(Pdo(name, cob_id & 0x7FF, transmitted, synchronous, packing))
        return made

    def _item(self, entry: int) -> Item:
        index, sub, bits = entry >> 16, entry >> 8 & 0xFF, entry & 0xFF
        # what the sheet does not know cannot be wanted, and only fills its place
        return index, sub, bits, index if index in DUMMIES else self._types.get((index, sub), False)


def _expedited(data: bytes) -> tuple[bytes, Key, int] | None:
    """Object and value of an expedited download: its multiplexer as sent, index and sub-index, value; else None."""
    if len(data) != 8 or data[0] >> 5 != 1 or not data[0] & 2:
        return None
    size = 4 - (data[0] >> 2 & 3) if data[0] & 1 else 4
    return data[1:4], (int.from_bytes(data[1:3], "little"), data[3]), int.from_bytes(data[4 : 4 + size], "little")


@dataclass(slots=True)
class Trace:
    """One object of one node, each time a PDO carried it.

    Attributes:
        pdo: name of the last PDO that could carry it, or None.
        cob_id: its identifier.
        beats: number of beats before each.
        stamps: of the frames [s].
        values: raw.
        synchronous: see `Pdo`.
    """

    pdo: str | None = None
    cob_id: int = 0
    beats: list[int] = field(default_factory=list)
    stamps: list[float] = field(default_factory=list)
    values: list[int] = field(default_factory=list)
    synchronous: list[bool] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Traffic:
    """A log, sorted.

    Attributes:
        beats: stamps of the frames that count the cycles [s].
        traces: by node and object.
        strangers: nodes that speak and have no data sheet, the master left out.
        short: PDOs that were shorter than mapped and so left out.
    """

    beats: list[float]
    traces: Mapping[tuple[int, Key], Trace]
    strangers: tuple[int, ...]
    short: int


def follow(
    frames: Iterable[Frame], nodes: Sequence[NodePdos], wanted: Sequence[tuple[Key, bool]], beat: int
) -> Traffic:
    """Go through a log once, in the order of the frames, which time stamps may be too coarse to tell.

    Args:
        frames: of the log.
        nodes: with their PDOs as before the log.
        wanted: objects, and whether the node transmits them.
        beat: identifier of the frames that count the cycles.

    Raises:
        IdentificationError: time runs backwards, one frame is by the sheets of two nodes, or a PDO cannot be as mapped.
    """
    traces = {(node.node, key): Trace() for node in nodes for key, _ in wanted}
    owners = {base + node.node: node for node in nodes for base in (REQUEST, ANSWER, ERROR_CONTROL)}
    table: _Table | None = None
    beats: list[float] = []
    heard: set[int] = set()
    before, short = float("-inf"), 0
    for k, (stamp, cob_id, data) in enumerate(frames):
        if not before <= stamp < float("inf"):
            raise IdentificationError(
                f"frame {k + 1}: time stamp {stamp:.6f} s comes after {before:.6f} s; they must not run backwards"
            )
        before = stamp
        if cob_id in owners:
            if owners[cob_id].hear(cob_id, data):
                table = None
            continue
        if cob_id & 0x780 in (ANSWER, ERROR_CONTROL):
            heard.add(cob_id & 0x7F)
        if cob_id == beat:
            beats.append(stamp)
        if table is None:
            table = _table(nodes, wanted, traces)
        found = table.get(cob_id, ())
        if len(found) > 1 and found[0][0].transmitted:
            raise IdentificationError(f"frame {k + 1}: by the data sheets more than one node sends {cob_id:03X}")
        for pdo, takers in found:
            if len(data) < pdo.packing.size:
                short += 1
                continue
            values = pdo.packing.values(data)
            for place, trace in takers:
                trace.beats.append(len(beats))
                trace.stamps.append(stamp)
                trace.values.append(values[place])
                trace.synchronous.append(pdo.synchronous)
    if table is None:
        _table(nodes, wanted, traces)
    return Traffic(beats, traces, tuple(sorted(heard - {0, MASTER_NODE})), short)


_Table = dict[int, list[tuple[Pdo, list[tuple[int, Trace]]]]]


def _table(
    nodes: Sequence[NodePdos], wanted: Sequence[tuple[Key, bool]], traces: Mapping[tuple[int, Key], Trace]
) -> _Table:
    """For each identifier the PDOs that have it, and where in them which trace finds its values."""
    table: _Table = {}
    for node in nodes:
        for pdo in node.pdos():
            takers = []
            for key, transmitted in wanted:
                if transmitted == pdo.transmitted and key in pdo.packing.keys:
                    trace = traces[node.node, key]
                    trace.pdo, trace.cob_id = pdo.name, pdo.cob_id
                    takers.append((pdo.packing.keys.index(key), trace))
            if takers:
                table.setdefault(pdo.cob_id, []).append((pdo, takers))
    return table
