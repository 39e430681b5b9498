"""PDO mapping: round trips, the canopen library's packing as another road, and bytes known from elsewhere."""

import struct
from typing import Any

import canopen
import pytest
from canopen.objectdictionary import ODVariable, datatypes
from hypothesis import given, settings
from hypothesis import strategies as st

from lwa4d_sim.bus.mapping import Item, Key, Mapping

NATURAL = {
    datatypes.INTEGER8: 8,
    datatypes.INTEGER16: 16,
    datatypes.INTEGER32: 32,
    datatypes.INTEGER64: 64,
    datatypes.UNSIGNED8: 8,
    datatypes.UNSIGNED16: 16,
    datatypes.UNSIGNED32: 32,
    datatypes.UNSIGNED64: 64,
}
SIGNED = (datatypes.INTEGER8, datatypes.INTEGER16, datatypes.INTEGER32, datatypes.INTEGER64)


def integers(bits: int, signed: bool) -> st.SearchStrategy[int]:
    low = -(1 << (bits - 1)) if signed else 0
    return st.one_of(st.integers(low, low + (1 << bits) - 1), st.sampled_from((low, low + (1 << bits) - 1)))


@st.composite
def maps(draw: st.DrawFn) -> tuple[list[Item], dict[Key, int]]:
    """Any integers of any length that fit in a frame, and values for them."""
    items: list[Item] = []
    values: dict[Key, int] = {}
    left = 64
    while left and draw(st.booleans()):
        bits, signed = draw(st.integers(1, left)), draw(st.booleans())
        key = (0x6000 + len(items), draw(st.integers(0, 255)))
        items.append((*key, bits, signed))
        values[key] = draw(integers(bits, signed))
        left -= bits
    return items, values


@settings(deadline=None)
@given(maps())
def test_what_is_packed_comes_out_again(drawn: tuple[list[Item], dict[Key, int]]) -> None:
    items, values = drawn
    mapping = Mapping(items)
    data = mapping.pack(values.__getitem__)
    assert len(data) == mapping.size == -(-sum(item[2] for item in items) // 8)
    assert dict(mapping.unpack(data)) == values
    assert mapping.pack_from(values) == data
    assert list(mapping.values(data + b"\xff\xff")) == list(values.values())  # bytes beyond do not count


@settings(deadline=None)
@given(maps())
def test_bits_lie_where_the_standard_puts_them(drawn: tuple[list[Item], dict[Key, int]]) -> None:
    """Built bit by bit from a string, lowest bit first."""
    items, values = drawn
    text = "".join(f"{values[item[0], item[1]] % (1 << item[2]):0{item[2]}b}"[::-1] for item in items)
    text = text.ljust(-(-len(text) // 8) * 8, "0")
    expected = bytes(int(text[k : k + 8][::-1], 2) for k in range(0, len(text), 8))
    assert Mapping(items).pack(values.__getitem__) == expected


@st.composite
def library_maps(draw: st.DrawFn) -> list[tuple[int, int, int]]:
    """(data type, bits, value): whole bytes of every type, or unsigned parts of a byte that stay inside it.

    More the canopen library does not pack right.
    """
    fields: list[tuple[int, int, int]] = []
    used = 0
    while draw(st.booleans()):
        kind = draw(st.sampled_from(list(NATURAL)))
        if used % 8 == 0 and used + NATURAL[kind] <= 64 and draw(st.booleans()):
            bits = NATURAL[kind]
            fields.append((kind, bits, draw(integers(bits, kind in SIGNED))))
        elif used < 64:
            bits = draw(st.integers(1, 8 - used % 8))
            fields.append((datatypes.UNSIGNED8, bits, draw(integers(bits, False))))
        else:
            break
        used += bits
    return fields


@settings(deadline=None)
@given(library_maps())
def test_the_canopen_library_packs_the_same(fields: list[tuple[int, int, int]]) -> None:
    od = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]
    record = canopen.objectdictionary.ODRecord("TPDO", 0x1800)
    table = canopen.objectdictionary.ODArray("TPDO map", 0x1A00)
    for parent in (record, table):
        member = ODVariable("sub", parent.index, 1)
        member.data_type = datatypes.UNSIGNED32
        parent.add_member(member)
        od.add_object(parent)
    for k, (kind, _, _) in enumerate(fields):
        variable = ODVariable(f"object {k}", 0x2000 + k)
        variable.data_type = kind
        od.add_object(variable)
    theirs = canopen.LocalNode(1, od).tpdo[1]
    for k, (_, bits, _) in enumerate(fields):
        theirs.add_variable(0x2000 + k, 0, bits)
    for variable, (_, _, value) in zip(theirs.map, fields, strict=True):
        variable.raw = value
    ours = Mapping([(0x2000 + k, 0, bits, kind) for k, (kind, bits, _) in enumerate(fields)])
    values = {(0x2000 + k, 0): value for k, (_, _, value) in enumerate(fields)}
    assert ours.pack(values.__getitem__) == bytes(theirs.data)


def test_a_frame_seen_on_a_bus() -> None:
    """183#3712102700000000 (SCHUNK drive): statusword, current, position."""
    mapping = Mapping([(0x6041, 0, 16, False), (0x6077, 0, 16, True), (0x6064, 0, 32, True)])
    assert mapping.unpack(bytes.fromhex("3712102700000000")) == [
        ((0x6041, 0), 0x1237),
        ((0x6077, 0), 10000),
        ((0x6064, 0), 0),
    ]


def test_gaps_are_skipped_and_sent_as_zero() -> None:
    mapping = Mapping([(0x0005, 0, 8, 5), (0x6060, 0, 8, True), (0x0006, 0, 16, 6), (0x6040, 0, 16, False)])
    assert mapping.keys == ((0x6060, 0), (0x6040, 0))
    assert mapping.unpack(bytes.fromhex("ff80ffff0f00")) == [((0x6060, 0), -128), ((0x6040, 0), 15)]
    assert mapping.pack({(0x6060, 0): -1, (0x6040, 0): 6}.__getitem__).hex() == "00ff00000600"


@settings(deadline=None)
@given(st.floats(width=32), st.integers(0, 7))
def test_floats_pass_at_any_bit(value: float, shift: int) -> None:
    items: list[Item] = [(0x2000, 0, shift, False)] * bool(shift) + [(0x200D, 1, 32, datatypes.REAL32)]
    data = Mapping(items).pack(lambda key: value if key == (0x200D, 1) else 0)
    again = dict(Mapping(items).unpack(data))[0x200D, 1]
    assert struct.pack("<f", again) == struct.pack("<f", value)


@pytest.mark.parametrize(
    "items",
    [
        [(0x6064, 0, 32, True), (0x6062, 0, 32, True), (0x6060, 0, 1, True)],
        [(0x200D, 1, 16, datatypes.REAL32)],
        [(0x1008, 0, 64, datatypes.VISIBLE_STRING)],
        [(0x6060, 0, 0, True)],
        [(0x6060, 0, 65, False)],
    ],
)
def test_what_does_not_fit_or_is_no_number_is_refused(items: list[Item]) -> None:
    with pytest.raises(ValueError, match="bits"):
        Mapping(items)


@settings(deadline=None)
@given(st.sampled_from([(16, True), (16, False), (13, True), (13, False)]), st.integers(0, 1 << 20), st.booleans())
def test_a_value_that_does_not_fit_is_never_cut(field: tuple[int, bool], excess: int, below: bool) -> None:
    bits, signed = field
    low = -(1 << (bits - 1)) if signed else 0
    value = low - 1 - excess if below else low + (1 << bits) + excess
    with pytest.raises(OverflowError):
        Mapping([(0x6042, 0, bits, signed)]).pack(lambda key: value)


@pytest.mark.parametrize("kind", [(16, True), (13, True)])
def test_too_few_bytes_are_an_error(kind: tuple[int, bool]) -> None:
    mapping: Any = Mapping([(0x6040, 0, *kind)])
    with pytest.raises(struct.error):
        mapping.unpack(b"\x01")
