"""How many bits a classic CAN frame takes on the wire, exactly and at best and worst.

Fields, stuffing and CRC are those of Bosch, CAN specification 2.0 (1991), parts A and B; the bounds are those of Davis,
Burns, Bril and Lukkien, Real-Time Systems 35 (2007). `frame_bits` works a byte at a time from tables, `levels` bit by
bit; the first is for every frame, the second for the rare one that meets an error.
"""

from functools import lru_cache

import can

INTERFRAME_BITS = 3  # intermission, after which the bus is free (CAN 2.0, 3.2)
STUFF_RUN = 5  # equal bits after which one opposite bit is put in (CAN 2.0, 5)
# After the CRC, never stuffed: CRC delimiter, ACK slot, ACK delimiter, seven bits end of frame (CAN 2.0, 3.1).
TAIL = (1, 1, 1, 1, 1, 1, 1, 1, 1, 1)
ACK_SLOT = 9  # bits from the acknowledge slot, it included, to the end of the frame

_POLYNOMIAL = 0x4599  # x^15 + x^14 + x^10 + x^8 + x^7 + x^4 + x^3 + 1 (CAN 2.0, 3.1.1)
_CRC_BITS = 15
_CRC_MASK = 0x7FFF
_BASE, _EXTENDED = 34, 54  # stuffed bits of a frame without data: 19 or 39 of header, 15 of CRC
_FIXED = len(TAIL) + INTERFRAME_BITS


def best_bits(dlc: int, *, extended: bool = False, remote: bool = False) -> int:
    """Bits of a frame that needs no stuffing, interframe space included: 47 + 8 n, or 67 + 8 n with 29-bit ids."""
    return _stuffable(dlc, extended, remote) + _FIXED


def worst_bits(dlc: int, *, extended: bool = False, remote: bool = False) -> int:
    """Bits of the longest frame thinkable, interframe space included: 55 + 10 n, or 80 + 10 n with 29-bit ids."""
    stuffable = _stuffable(dlc, extended, remote)
    return stuffable + (stuffable - 1) // (STUFF_RUN - 1) + _FIXED


def frame_bits(msg: can.Message) -> int:
    """Bits that this frame occupies on the wire: stuff bits and the three of the interframe space included.

    Raises:
        ValueError: not a well-formed classic data or remote frame.
    """
    dlc, data = msg.dlc, msg.data
    if msg.is_fd or msg.is_error_frame or len(data) != (0 if msg.is_remote_frame else dlc):
        raise ValueError(f"neither a classic data frame nor a remote frame: {msg}")
    crc, stuffing, bits = _header(msg.arbitration_id, msg.is_extended_id, msg.is_remote_frame, dlc)
    # `stuffing` carries the state of the last step in bits 8-10; the steps' stuff bits add up from bit 16 in `total`.
    total = 0
    for byte in data:
        crc = (crc << 8 & _CRC_MASK) ^ _CRC_OF_BYTE[crc >> 7 ^ byte]
        stuffing = _STUFF_BYTE[stuffing & 0x700 | byte]
        total += stuffing
    stuffing = _STUFF_BYTE[stuffing & 0x700 | crc >> 7]
    return bits + (total + stuffing + _STUFF_SEVEN[(stuffing & 0x700) >> 1 | crc & 0x7F] >> 16)


def levels(msg: can.Message) -> list[int]:
    """Every bit the transmitter drives, from start to end of frame: 0 dominant, 1 recessive; stuff bits included."""
    frame_bits(msg)  # refuses what is no frame
    value, width = _header_bits(msg.arbitration_id, msg.is_extended_id, msg.is_remote_frame, msg.dlc)
    for byte in msg.data:
        value, width = value << 8 | byte, width + 8
    value, width = value << _CRC_BITS | _crc(value, width), width + _CRC_BITS
    out: list[int] = []
    state = _START
    for shift in range(width - 1, -1, -1):
        bit = value >> shift & 1
        out.append(bit)
        state, stuffed = _step(state, bit)
        if stuffed:
            out.append(1 - bit)
    return [*out, *TAIL]


def arbitration_key(msg: can.Message) -> int:
    """The bits that decide arbitration, as a number: the lowest wins, because 0 is dominant.

    An identifier of 11 bits beats one of 29 bits that begins alike, and a data frame a remote frame of the same
    identifier (CAN 2.0, 3.1.1 and 3.1.2).
    """
    can_id, remote = msg.arbitration_id, msg.is_remote_frame
    if msg.is_extended_id:  # id 28-18, SRR 1, IDE 1, id 17-0, RTR
        return can_id >> 18 << 21 | 0x180000 | (can_id & 0x3FFFF) << 1 | remote
    return can_id << 21 | remote << 20  # id 10-0, RTR, IDE 0


def _stuffable(dlc: int, extended: bool, remote: bool) -> int:
    if not 0 <= dlc <= 8:
        raise ValueError(f"a classic CAN frame carries 0 to 8 bytes, not {dlc}")
    return (_EXTENDED if extended else _BASE) + (0 if remote else 8 * dlc)


def _header_bits(can_id: int, extended: bool, remote: bool, dlc: int) -> tuple[int, int]:
    """Start of frame to data length code: value and width."""
    if not 0 <= can_id < (1 << 29 if extended else 1 << 11):
        raise ValueError(f"identifier {can_id:#x} does not fit {29 if extended else 11} bits")
    if not 0 <= dlc <= 8:
        raise ValueError(f"a classic CAN frame carries 0 to 8 bytes, not {dlc}")
    if extended:  # SOF 0, id 28-18, SRR 1, IDE 1, id 17-0, RTR, r1 0, r0 0, DLC
        return (can_id >> 18 << 20 | 0b11 << 18 | can_id & 0x3FFFF) << 7 | remote << 6 | dlc, 39
    return can_id << 7 | remote << 6 | dlc, 19  # SOF 0, id, RTR, IDE 0, r0 0, DLC


@lru_cache(maxsize=4096)
def _header(can_id: int, extended: bool, remote: bool, dlc: int) -> tuple[int, int, int]:
    """CRC and stuffing state behind the header, and the bits of the frame without the stuffing of what follows."""
    value, width = _header_bits(can_id, extended, remote, dlc)
    state, count = _START, 0
    for shift in range(width - 1, -1, -1):
        state, stuffed = _step(state, value >> shift & 1)
        count += stuffed
    return _crc(value, width), state << 8, count + best_bits(dlc, extended=extended, remote=remote)


def _crc(value: int, width: int) -> int:
    crc = 0
    for shift in range(width - 1, -1, -1):
        top = crc >> 14 ^ value >> shift & 1
        crc = crc << 1 & _CRC_MASK ^ (_POLYNOMIAL if top else 0)
    return crc


# State of the stuffing: 4 * (last bit) + (length of its run) - 1, a run of one to four; a run of five is at once ended
# by its stuff bit, which begins the next run.
_START = 4  # a recessive run of one: the start bit, dominant, begins its own


def _step(state: int, bit: int) -> tuple[int, int]:
    """State after one more bit and the stuff bits it causes (0 or 1)."""
    last, run = state >> 2, (state & 3) + 1
    run = run + 1 if bit == last else 1
    return (4 * (1 - bit), 1) if run == STUFF_RUN else (4 * bit + run - 1, 0)


def _stuff_table(width: int) -> list[int]:
    """Entry [state << width | bits]: state afterwards << 8, and stuff bits << 16."""
    table = [state << 8 for state in range(8)]
    for _ in range(width):
        table = [
            (state << 8) + (stuffed << 16) + (entry & ~0xFFFF)
            for entry in table
            for bit in (0, 1)
            for state, stuffed in (_step(entry >> 8 & 7, bit),)
        ]
    return table


_STUFF_BYTE = _stuff_table(8)
_STUFF_SEVEN = _stuff_table(7)
_CRC_OF_BYTE = [_crc(byte, 8) for byte in range(256)]
