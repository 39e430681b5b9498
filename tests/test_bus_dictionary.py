"""The objects of both profiles, what a write may do to them, non-volatile memory, and the EDS read back."""

import math
import struct
from pathlib import Path
from typing import Any

import canopen
import pytest
from canopen.objectdictionary import ODVariable, datatypes
from hypothesis import given, settings
from hypothesis import strategies as st

from lwa4d_sim.bus.dictionary import GROUPS, Abort, Dictionary, Entry, Group, Joint, drive_dictionary
from lwa4d_sim.bus.mapping import Key
from lwa4d_sim.bus.options import Profile

JOINT = Joint(name="PRL 120", low=-2.14, high=2.14, speed=0.43633, acceleration=2.79, torque=372.0)
PROFILES: tuple[Profile, ...] = ("lwa4d", "cia402")

# The lists of objects in SCHUNK's Schunk_0_63.dcf.
FIRMWARE = """
1000 1001 1018 1002 1003 1005 1008 1009 100A 100C 100D 1014 1016 1017 1200 1400 1401 1600 1601 1800 1801 1802 1803 1A00
1A01 1A02 1A03 6040 6041 6042 6043 6044 6046 6048 6049 604C 6060 6061 6062 6064 6065 606B 606C 6073 6075 6077 607A 607C
607D 6081 6083 6086 6098 60B2 60C0 60C1 60C2 60C3 60C4 60F4 60FD 60FE 6502 2000 2001 2002 2003 2004 2007 2008 2009 200A
200B 200C 200D 200E 2010 2011 2012 2013 2020 2021 2022 2023 2024 2030 2031 2032 2033 2034 2041 2050
"""
# What the firmware lacks (schunk_lwa4d, config/Schunk_0_63.dcf) and the other profile was asked to have.
EXTENSIONS = """
1006 1010 1011 1015 1019 1029 603F 605A 605B 605C 605D 605E 6007 6066 6067 6068 606A 606D 606E 606F 6070 6071 6072 6074
6076 6078 6079 607E 607F 6080 6082 6084 6085 6087 6099 609A 60B0 60B1 60C5 60C6 60F2 60FF 6402
"""


def indices(text: str) -> set[int]:
    return {int(word, 16) for word in text.split()}


def entries(dictionary: Dictionary) -> list[Entry]:
    return [dictionary.entry(*key) for key in dictionary.values]


def made(profile: Profile) -> Dictionary:
    return drive_dictionary(profile, 5, JOINT)


def test_the_firmware_profile_has_the_objects_of_the_firmware_and_no_other() -> None:
    assert {entry.index for entry in entries(made("lwa4d"))} == indices(FIRMWARE)


def test_the_other_profile_has_more_and_says_of_each_that_it_is_an_extension() -> None:
    firmware, extended = made("lwa4d"), made("cia402")
    assert indices(FIRMWARE) | indices(EXTENSIONS) <= {entry.index for entry in entries(extended)}
    for entry in entries(extended):
        key = (entry.index, entry.sub)
        if key not in firmware or entry != firmware.entry(*key):
            assert entry.source.startswith("extension"), key
    assert not any(entry.source.startswith("extension") for entry in entries(firmware))
    assert all(entry.source and entry.name for entry in entries(extended))


@pytest.mark.parametrize(("profile", "modes"), [("lwa4d", {1, 2, 7}), ("cia402", {1, 2, 3, 4, 6, 7, 8, 9, 10})])
def test_the_supported_modes_are_told(profile: Profile, modes: set[int]) -> None:
    assert made(profile)[0x6502, 0] == sum(1 << (mode - 1) for mode in modes)


@pytest.mark.parametrize(
    ("key", "kind", "access", "default", "mappable"),
    [
        ((0x6040, 0), datatypes.UNSIGNED16, "rw", 0, True),
        ((0x6048, 2), datatypes.UNSIGNED16, "rw", 1, True),
        ((0x604C, 2), datatypes.INTEGER32, "rw", 6000, False),
        ((0x6081, 0), datatypes.UNSIGNED32, "rw", 10000, True),
        ((0x6098, 0), datatypes.INTEGER8, "const", 0, False),
        ((0x60B2, 0), datatypes.INTEGER16, "rw", 0, True),
        ((0x60C2, 1), datatypes.UNSIGNED8, "rw", 8, False),
        ((0x60C2, 2), datatypes.INTEGER8, "rw", -3, False),
        ((0x60C4, 5), datatypes.UNSIGNED8, "wo", 1, False),
        ((0x200D, 1), datatypes.REAL32, "ro", 25.0, True),
        ((0x200E, 0), datatypes.UNSIGNED8, "rw", 6, False),
        ((0x2050, 0), datatypes.UNSIGNED8, "ro", 0, True),
        ((0x1800, 0), datatypes.UNSIGNED8, "const", 5, False),
        ((0x1401, 1), datatypes.UNSIGNED32, "rw", 0x305, False),
        ((0x1600, 0), datatypes.UNSIGNED8, "rw", 3, False),
        ((0x1600, 2), datatypes.UNSIGNED32, "rw", 0x60B20010, False),
        ((0x607D, 1), datatypes.INTEGER32, "rw", -122613, False),  # -2.14 rad
        ((0x6075, 0), datatypes.UNSIGNED32, "rw", 37200, False),  # 372 N m at 10 N m/A
    ],
)
def test_samples_of_the_firmware_tables(key: Key, kind: int, access: str, default: Any, mappable: bool) -> None:
    entry = made("lwa4d").entry(*key)
    assert (entry.type, entry.access, entry.default, entry.mappable) == (kind, access, default, mappable)


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("node_id", [1, 5, 127])
def test_the_eds_says_the_same_when_the_library_reads_it(profile: Profile, node_id: int, tmp_path: Path) -> None:
    dictionary = made(profile)
    path = tmp_path / "drive.eds"
    dictionary.export_eds(path, 5)
    read = canopen.import_od(str(path), node_id)
    loaded = {
        (variable.index, variable.subindex): variable
        for item in read.values()
        for variable in ([item] if isinstance(item, ODVariable) else item.values())
        if item.index >= 0x1000
    }
    assert loaded.keys() == dictionary.values.keys()
    for key, variable in loaded.items():
        entry = dictionary.entry(*key)
        default = entry.default + (node_id - 5 if entry.relative else 0) if entry.bits else entry.default or None
        assert variable.default == default, key
        assert (variable.data_type, variable.access_type) == (entry.type, entry.access), key
        assert (variable.pdo_mappable, variable.unit) == (entry.mappable, entry.unit), key
        if entry.bits:
            assert (variable.min, variable.max) == (entry.low, entry.high), key
    assert read.device_information.nr_of_TXPDO == 4
    again = tmp_path / "again.eds"
    dictionary.export_eds(again, 5)
    assert again.read_bytes().replace(b"again", b"drive") == path.read_bytes()


WRITABLE = [
    entry for entry in entries(made("cia402")) if entry.access == "rw" and entry.type in datatypes.INTEGER_TYPES
]


@settings(deadline=None)
@given(st.sampled_from(WRITABLE), st.integers(-(1 << 33), 1 << 33))
def test_a_number_is_taken_if_and_only_if_it_is_in_range(entry: Entry, value: int) -> None:
    dictionary = made("cia402")
    key, size = (entry.index, entry.sub), entry.bits // 8
    signed = entry.type in datatypes.SIGNED_TYPES
    value = int.from_bytes((value % (1 << entry.bits)).to_bytes(size, "little"), "little", signed=signed)
    data = value.to_bytes(size, "little", signed=signed)
    low = entry.low if entry.low is not None else value
    high = entry.high if entry.high is not None else value
    if low <= value <= high:
        dictionary.write(*key, data)
        assert dictionary[key] == value
        assert dictionary.read(*key) == data
    else:
        with pytest.raises(Abort) as refused:
            dictionary.write(*key, data)
        assert refused.value.code == (0x06090031 if value > high else 0x06090032)
        assert dictionary[key] == entry.default


@settings(deadline=None)
@given(st.sampled_from(entries(made("cia402"))), st.binary(max_size=80))
def test_any_bytes_are_taken_or_refused_and_nothing_else(entry: Entry, data: bytes) -> None:
    dictionary = made("cia402")
    before = dict(dictionary.values)
    key = (entry.index, entry.sub)
    code = 0
    try:
        dictionary.write(*key, data)
    except Abort as refused:
        code = refused.code
    assert code in {0, 0x06010002, 0x06070012, 0x06070013, 0x06090030, 0x06090031, 0x06090032}
    assert (code == 0x06010002) == (entry.access in ("ro", "const"))
    if entry.bits and code != 0x06010002:
        assert (len(data) == entry.bits // 8) == (code not in (0x06070012, 0x06070013))
    assert {k for k in before if dictionary[k] != before[k]} <= ({key} if code == 0 else set())
    assert code or entry.encode(dictionary[key]) == data


@pytest.mark.parametrize(
    ("key", "code"), [((0x1234, 0), 0x06020000), ((0x1000, 1), 0x06090011), ((0x2008, 0), 0x06010001)]
)
def test_what_cannot_be_read_is_refused(key: Key, code: int) -> None:
    with pytest.raises(Abort) as refused:
        made("lwa4d").read(*key)
    assert refused.value.code == code


@settings(deadline=None)
@given(
    st.sampled_from([(0x6077, 0), (0x6064, 0), (0x6041, 0), (0x6061, 0), (0x1001, 0), (0x6065, 0)]),
    st.one_of(st.integers(), st.floats(-1e12, 1e12)),
)
def test_the_device_cannot_write_what_the_bus_cannot_carry(key: Key, value: float) -> None:
    dictionary = made("lwa4d")
    dictionary[key] = value
    bits = dictionary.entry(*key).bits
    signed = dictionary.entry(*key).type in datatypes.SIGNED_TYPES
    low = -(1 << (bits - 1)) if signed else 0
    assert dictionary[key] == min(max(round(value), low), low + (1 << bits) - 1)
    assert int.from_bytes(dictionary.read(*key), "little", signed=signed) == dictionary[key]


@settings(deadline=None)
@given(st.floats())
def test_any_float_of_the_device_can_be_read(value: float) -> None:
    dictionary = made("lwa4d")
    dictionary[0x200D, 1] = value
    (read,) = struct.unpack("<f", dictionary.read(0x200D, 1))
    assert math.isfinite(read) == math.isfinite(value)


# Non-volatile memory against a plain model of it.

PARAMETERS = {
    (0x1017, 0): "communication",
    (0x100C, 0): "communication",
    (0x200E, 0): "manufacturer",
    (0x6081, 0): "application",
    (0x605A, 0): "application",
}
STEPS = st.lists(
    st.one_of(
        st.tuples(st.just("set"), st.sampled_from(list(PARAMETERS)), st.integers(0, 8)),
        st.tuples(st.sampled_from(["store", "restore", "reset"]), st.sampled_from(list(GROUPS)), st.just(0)),
    ),
    max_size=30,
)


@settings(deadline=None)
@given(STEPS)
def test_stored_values_come_back_and_restored_ones_do_not(steps: list[tuple[str, Any, int]]) -> None:
    dictionary = made("cia402")
    default = {key: dictionary[key] for key in PARAMETERS}
    value, stored = dict(default), dict(default)
    for what, where, number in steps:
        if what == "set":
            dictionary[where] = value[where] = number
            continue
        group: Group = where
        concerned = [key for key, name in PARAMETERS.items() if group in ("all", name)]
        source, target = {"store": (value, stored), "restore": (default, stored), "reset": (stored, value)}[what]
        target.update({key: source[key] for key in concerned})
        getattr(dictionary, what)(group)
    assert {key: dictionary[key] for key in PARAMETERS} == value


@pytest.mark.parametrize(
    "key", [(0x6040, 0), (0x6060, 0), (0x607A, 0), (0x6071, 0), (0x60FF, 0), (0x60C1, 1), (0x60FE, 1)]
)
def test_a_command_is_never_stored(key: Key) -> None:
    dictionary = made("cia402")
    dictionary[key] = 3
    dictionary.store()
    dictionary.reset()
    assert dictionary[key] == 0


def test_a_default_that_the_device_sets_outlives_a_reset() -> None:
    dictionary = made("lwa4d")
    dictionary.redefine((0x2020, 0), 12.5)
    dictionary[0x2020, 0] = 3.0
    dictionary.reset()
    assert dictionary[0x2020, 0] == 12.5
    told = dictionary.eds(5).get_variable(0x2020)
    assert told is not None
    assert told.default == 12.5


@pytest.mark.parametrize("profile", PROFILES)
def test_an_odd_joint_still_gives_values_in_range(profile: Profile) -> None:
    odd = Joint(name="Gelenk-ß", low=None, high=1e9, speed=1e9, acceleration=1e-9, torque=1e-9)
    dictionary = drive_dictionary(profile, 1, odd)
    for entry in entries(dictionary):
        assert not entry.bits or entry.within(dictionary[entry.index, entry.sub])
        if entry.access != "wo":
            dictionary.read(entry.index, entry.sub)
    assert dictionary[0x607D, 1] == -(1 << 31)
