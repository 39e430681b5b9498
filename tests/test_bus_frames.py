"""Lengths of CAN frames against hand-made vectors and against a second implementation that works on strings of bits."""

import itertools
import random
import re

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lwa4d_sim.bus.frames import (
    ACK_SLOT,
    INTERFRAME_BITS,
    TAIL,
    arbitration_key,
    best_bits,
    frame_bits,
    levels,
    worst_bits,
)

# Equal to can-utils' canframelen with CFL_EXACT.
VECTORS = {
    "080#": 51,
    "000#0103": 68,
    "703#05": 58,
    "203#0000000000000000": 125,
    "203#ffffffffffffffff": 124,
    "203#1f00102700000000": 124,
    "183#3712102700000000": 121,
    "7ff#ffffffffffffffff": 126,
    "000#0000000000000000": 127,
    "123#0102030405060708": 119,
    "555#5555555555555555": 112,
    "000#3c3c3c3c0f87f000": 130,
}
GENERATOR = 0b1100010110011001  # x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1


def frame(can_id: int, data: bytes = b"", *, extended: bool = False, remote: bool = False, dlc: int = 0) -> can.Message:
    return can.Message(
        arbitration_id=can_id,
        is_extended_id=extended,
        is_remote_frame=remote,
        data=None if remote else data,
        dlc=dlc if remote else len(data),
        check=True,
    )


def parse(text: str) -> can.Message:
    can_id, data = text.split("#")
    return frame(int(can_id, 16), bytes.fromhex(data))


def covered(msg: can.Message) -> str:
    """The bits from start of frame to the last data bit, as text."""
    rtr = "1" if msg.is_remote_frame else "0"
    if msg.is_extended_id:
        bits = f"{msg.arbitration_id:029b}"
        head = "0" + bits[:11] + "11" + bits[11:] + rtr + "00"
    else:
        head = f"0{msg.arbitration_id:011b}{rtr}00"
    return head + f"{msg.dlc:04b}" + "".join(f"{byte:08b}" for byte in msg.data)


def crc(bits: str) -> str:
    """Remainder of a long division by the generator polynomial."""
    rest = int(bits, 2) << 15
    for top in range(rest.bit_length() - 1, 14, -1):
        if rest >> top & 1:
            rest ^= GENERATOR << (top - 15)
    return f"{rest:015b}"


def stuffed(bits: str) -> str:
    """Put the opposite bit after every five equal ones, the stuffed ones counted."""
    done = ""
    while match := re.search(r"00000|11111", bits):
        cut = match.end()
        done += bits[:cut]
        bits = ("1" if bits[cut - 1] == "0" else "0") + bits[cut:]
    return done + bits


def on_the_wire(msg: can.Message) -> str:
    head = covered(msg)
    return stuffed(head + crc(head)) + "1" * 10


def random_frame(rng: random.Random) -> can.Message:
    extended, remote, dlc = rng.random() < 0.5, rng.random() < 0.2, rng.randint(0, 8)
    # Runs make stuffing: draw half of the bytes from those with long ones.
    alphabet = rng.choice([bytes(range(256)), b"\x00\xff\xf0\x0f\x1f\xf8\x07\xe0\x83\x7c"])
    can_id = rng.choice([0, (1 << (29 if extended else 11)) - 1, rng.getrandbits(29 if extended else 11)])
    return frame(can_id, bytes(rng.choices(alphabet, k=dlc)), extended=extended, remote=remote, dlc=dlc)


@st.composite
def frames(draw: st.DrawFn) -> can.Message:
    extended, remote = draw(st.booleans()), draw(st.booleans())
    return frame(
        draw(st.integers(0, (1 << (29 if extended else 11)) - 1)),
        draw(st.binary(max_size=8)),
        extended=extended,
        remote=remote,
        dlc=draw(st.integers(0, 8)),
    )


@pytest.mark.parametrize(("text", "bits"), VECTORS.items())
def test_known_frames_have_their_known_length(text: str, bits: int) -> None:
    assert frame_bits(parse(text)) == bits


@pytest.mark.parametrize(("text", "value"), [("080#", 0x1C05), ("000#0103", 0x6AA5), ("7ff#ffffffffffffffff", 0x4C89)])
def test_known_frames_have_their_known_crc(text: str, value: int) -> None:
    """Of the reference in this file, so that it leans on something itself."""
    assert int(crc(covered(parse(text))), 2) == value


def test_ten_thousand_frames_are_as_long_as_bit_by_bit() -> None:
    rng = random.Random(2007)
    seen = set()
    for _ in range(10_000):
        msg = random_frame(rng)
        assert frame_bits(msg) == len(on_the_wire(msg)) + INTERFRAME_BITS, msg
        seen.add((msg.is_extended_id, msg.is_remote_frame, msg.dlc))
    assert len(seen) == 2 * 2 * 9


@given(frames())
def test_levels_are_the_bits_on_the_wire(msg: can.Message) -> None:
    assert "".join(map(str, levels(msg))) == on_the_wire(msg)
    assert len(levels(msg)) + INTERFRAME_BITS == frame_bits(msg)
    assert len(TAIL) - ACK_SLOT == 1  # the delimiter alone stands between CRC and acknowledge slot


@given(frames())
def test_no_frame_is_shorter_than_best_or_longer_than_worst(msg: can.Message) -> None:
    kind = {"extended": msg.is_extended_id, "remote": msg.is_remote_frame}
    assert best_bits(msg.dlc, **kind) <= frame_bits(msg) <= worst_bits(msg.dlc, **kind)


@pytest.mark.parametrize("dlc", range(9))
def test_best_and_worst_are_the_closed_forms(dlc: int) -> None:
    assert best_bits(dlc) == 47 + 8 * dlc
    assert worst_bits(dlc) == 55 + 10 * dlc
    assert best_bits(dlc, extended=True) == 67 + 8 * dlc
    assert worst_bits(dlc, extended=True) == 80 + 10 * dlc
    assert best_bits(dlc, remote=True) == 47
    assert worst_bits(dlc, extended=True, remote=True) == 80


def test_the_best_case_is_met_by_frames_of_eight_bytes() -> None:
    """Not by those of none: their control field alone has seven dominant bits in a row."""
    found = (frame_bits(frame(can_id, b"\xaa" * 8)) for can_id in range(0x800))
    assert min(found) == best_bits(8)
    assert min(frame_bits(frame(can_id)) for can_id in range(0x800)) == best_bits(0) + 1


@pytest.mark.parametrize(
    "msg",
    [
        can.Message(arbitration_id=0x800, is_extended_id=False),
        can.Message(arbitration_id=1 << 29),
        can.Message(arbitration_id=-1),
        can.Message(arbitration_id=1, dlc=9, data=bytes(9)),
        can.Message(arbitration_id=1, dlc=9, is_remote_frame=True),
        can.Message(arbitration_id=1, dlc=-1, is_remote_frame=True),
        can.Message(arbitration_id=1, dlc=2, data=bytes(3)),
        can.Message(arbitration_id=1, is_fd=True, data=bytes(3)),
        can.Message(arbitration_id=1, is_error_frame=True),
    ],
)
def test_what_is_no_classic_frame_is_refused(msg: can.Message) -> None:
    for length in (frame_bits, levels):
        with pytest.raises(ValueError, match=r"frame|identifier|bytes"):
            length(msg)


@pytest.mark.parametrize("dlc", [-1, 9])
def test_bounds_of_no_length_are_refused(dlc: int) -> None:
    for bound in (best_bits, worst_bits):
        with pytest.raises(ValueError, match="0 to 8 bytes"):
            bound(dlc)


@given(frames(), frames())
def test_arbitration_is_won_by_the_first_dominant_bit(one: can.Message, other: can.Message) -> None:
    def field(msg: can.Message) -> str:
        """Identifier, RTR or SRR, IDE and so on, padded: what follows a shorter field is the data length."""
        return covered(msg)[1 : 33 if msg.is_extended_id else 14]

    won = next((a < b for a, b in zip(field(one), field(other), strict=False) if a != b), None)
    if won is None:
        assert arbitration_key(one) == arbitration_key(other)
    else:
        assert (arbitration_key(one) < arbitration_key(other)) is won


def test_arbitration_order_of_frames_that_begin_alike() -> None:
    base = 0x123
    order = [
        frame(base),
        frame(base, remote=True),
        frame(base << 18, extended=True),
        frame(base << 18, extended=True, remote=True),
        frame(base << 18 | 1, extended=True),
        frame(base + 1),
    ]
    keys = [arbitration_key(msg) for msg in order]
    assert all(a < b for a, b in itertools.pairwise(keys))
