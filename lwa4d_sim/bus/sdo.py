"""The SDO server of a node: expedited, segmented and block transfer in both directions (CiA 301, 7.2.4).

One transfer at a time. A new request ends a transfer that is open; a request that does not fit is answered with one
abort and closes the transfer. The length of a download is bounded by the object it goes to.
"""

import struct
from binascii import crc_hqx
from collections.abc import Callable
from enum import Enum
from typing import Protocol

from lwa4d_sim.bus.entry import (
    BAD_BLOCK_SIZE,
    BAD_COMMAND,
    BAD_CRC,
    BAD_SEQUENCE,
    NO_MEMORY,
    TIME_OUT,
    TOGGLE,
    TOO_LONG,
    WRONG_LENGTH,
    Abort,
)
from lwa4d_sim.interfaces import Ns

TIME_LIMIT = Ns(1_000_000_000)  # [ns] within which the client must go on with a transfer (assumed; CiA 301 has none)
BUFFER = 1 << 16  # longest transfer [byte] (assumed)
BLOCK = 127  # segments of a block, the most that CiA 301 allows
LENGTH = 8  # of every SDO frame [byte]
SEGMENT = 7  # data of a segment [byte]

_HEADER = struct.Struct("<BHBI")
_EMPTY = bytes(LENGTH)


class Objects(Protocol):
    """What the server gives access to. Each method may raise `Abort`."""

    def read(self, index: int, sub: int) -> bytes:
        """Value of an object."""
        ...

    def write(self, index: int, sub: int, data: bytes) -> None:
        """Set the value of an object."""
        ...

    def capacity(self, index: int, sub: int) -> int:
        """Longest value [byte] that an object takes; refuses if it cannot be written at all."""
        ...


class _Open(Enum):
    NOTHING = 0
    UPLOAD = 1  # segments asked for one by one
    DOWNLOAD = 2
    BLOCK_UPLOAD = 3  # initiated, not started
    BLOCK_SENT = 4  # a block is out, its acknowledgement is awaited
    BLOCK_UPLOADED = 5  # all acknowledged, the client's last word is awaited
    BLOCK_DOWNLOAD = 6  # segments of a block come in
    BLOCK_COMPLETE = 7  # the last segment came, the client's last word is awaited


class SdoServer:
    """One server.

    Args:
        objects: the dictionary.
        send: puts eight bytes on the bus.
    """

    def __init__(self, objects: Objects, send: Callable[[bytes], None]) -> None:
        self._objects, self._send = objects, send
        self._open = _Open.NOTHING
        self._index = self._sub = 0
        self._data = bytearray()
        self._position = 0  # first byte not sent, or not acknowledged
        self._size: int | None = None  # of a download, where the client told
        self._capacity = 0
        self._toggle = 0
        self._block = 0  # segments of a block
        self._sequence = 0  # last segment sent or received of this block
        self._with_crc = False
        self._deadline: Ns | None = None
        self._answers: tuple[Callable[[bytes], None], ...] = (
            self._download_segment,
            self._download,
            self._upload,
            self._upload_segment,
            self._abandon,
            self._block_upload,
            self._block_download,
            self._unknown,
        )

    def reset(self) -> None:
        """Drop an open transfer without a word."""
        self._open, self._deadline = _Open.NOTHING, None
        self._data = bytearray()

    def receive(self, data: bytes, now: Ns) -> None:
        """A frame from the client. Frames that do not have eight bytes are no SDO and are left alone."""
        if len(data) != LENGTH:
            return
        try:
            if self._open is _Open.BLOCK_DOWNLOAD and data[0] != 0x80:
                self._block_segment(data)
            else:
                self._answers[data[0] >> 5](data)
        except Abort as refusal:
            self._refuse(refusal.code)
        self._deadline = None if self._open is _Open.NOTHING else Ns(now + TIME_LIMIT)

    def poll(self, now: Ns) -> Ns | None:
        """Give up a transfer that the client does not go on with; the instant at which the open one is given up."""
        if self._deadline is not None and now >= self._deadline:
            self._refuse(TIME_OUT)
        return self._deadline

    def _refuse(self, code: int) -> None:
        self._send(_HEADER.pack(0x80, self._index, self._sub, code))
        self.reset()

    def _begin(self, data: bytes) -> None:
        """A new transfer; one that is open ends here."""
        self.reset()
        _, self._index, self._sub, _ = _HEADER.unpack(data)
        self._position = self._toggle = self._sequence = 0

    def _expect(self, *states: _Open) -> None:
        if self._open not in states:
            if self._open is _Open.NOTHING:
                self._index = self._sub = 0  # there is no transfer to name
            raise Abort(BAD_COMMAND)

    def _abandon(self, data: bytes) -> None:
        self.reset()

    def _unknown(self, data: bytes) -> None:
        self._begin(data)
        raise Abort(BAD_COMMAND)

    def _prepare(self, size: int | None) -> None:
        """Room for a download of the size that the client tells, if it does."""
        self._capacity = self._objects.capacity(self._index, self._sub)
        self._size = size
        if size is not None and size > self._capacity:
            raise Abort(TOO_LONG)
        if size is not None and size > BUFFER:
            raise Abort(NO_MEMORY)

    def _take(self, part: bytes, slack: int = 0) -> None:
        """Data of a download; ``slack`` bytes too many may turn out to be padding."""
        self._data += part
        if len(self._data) > (self._capacity if self._size is None else self._size) + slack:
            raise Abort(TOO_LONG)
        if len(self._data) > BUFFER + slack:
            raise Abort(NO_MEMORY)

    def _finish(self) -> None:
        if self._size is not None and len(self._data) != self._size:
            raise Abort(WRONG_LENGTH)
        self._objects.write(self._index, self._sub, bytes(self._data))

    # Expedited and segmented transfer.

    def _download(self, data: bytes) -> None:
        self._begin(data)
        command = data[0]
        if command & 2:
            size = 4 - (command >> 2 & 3) if command & 1 else min(4, self._objects.capacity(self._index, self._sub))
            self._objects.write(self._index, self._sub, data[4 : 4 + size])
        else:
            self._prepare(int.from_bytes(data[4:], "little") if command & 1 else None)
            self._open = _Open.DOWNLOAD
        self._send(_HEADER.pack(0x60, self._index, self._sub, 0))

    def _download_segment(self, data: bytes) -> None:
        self._expect(_Open.DOWNLOAD)
        self._check_toggle(data[0])
        self._take(data[1 : 8 - (data[0] >> 1 & 7)])
        answer = bytes((0x20 | self._toggle,)) + _EMPTY[1:]
        self._toggle ^= 0x10
        if data[0] & 1:
            self._finish()
            self.reset()
        self._send(answer)

    def _upload(self, data: bytes) -> None:
        self._begin(data)
        self._answer_upload(self._objects.read(self._index, self._sub))

    def _answer_upload(self, value: bytes) -> None:
        size = len(value)
        if 0 < size <= 4:
            self._send(_HEADER.pack(0x43 | (4 - size) << 2, self._index, self._sub, int.from_bytes(value, "little")))
        else:
            self._data, self._open = bytearray(value), _Open.UPLOAD
            self._send(_HEADER.pack(0x41, self._index, self._sub, size))

    def _upload_segment(self, data: bytes) -> None:
        self._expect(_Open.UPLOAD)
        self._check_toggle(data[0])
        part = self._data[self._position : self._position + SEGMENT]
        self._position += len(part)
        last = self._position >= len(self._data)
        self._send(bytes((self._toggle | (SEGMENT - len(part)) << 1 | last,)) + part.ljust(SEGMENT, b"\0"))
        self._toggle ^= 0x10
        if last:
            self.reset()

    def _check_toggle(self, command: int) -> None:
        if command & 0x10 != self._toggle:
            raise Abort(TOGGLE)

    # Block upload: the server sends.

    def _block_upload(self, data: bytes) -> None:
        what = data[0] & 3
        if what == 0:
            self._begin(data)
            self._set_block(data[4])
            self._with_crc = bool(data[0] & 4)
            value = self._objects.read(self._index, self._sub)
            if 0 < data[5] >= len(value):  # so short that the client wants it the plain way
                self._answer_upload(value)
                return
            self._data, self._open = bytearray(value), _Open.BLOCK_UPLOAD
            self._send(_HEADER.pack(0xC2 | self._with_crc << 2, self._index, self._sub, len(value)))
        elif what == 3:
            self._expect(_Open.BLOCK_UPLOAD)
            self._send_block()
        elif what == 2:
            self._expect(_Open.BLOCK_SENT)
            if data[1] > self._sequence:
                raise Abort(BAD_SEQUENCE)
            self._set_block(data[2])
            self._position += data[1] * SEGMENT
            if data[1] == self._sequence and self._position >= len(self._data):
                padding = -len(self._data) % SEGMENT if self._data else SEGMENT
                crc = crc_hqx(self._data, 0) if self._with_crc else 0
                self._open = _Open.BLOCK_UPLOADED
                self._send(bytes((0xC1 | padding << 2,)) + crc.to_bytes(2, "little") + _EMPTY[3:])
            else:
                self._send_block()
        else:
            self._expect(_Open.BLOCK_UPLOADED)
            self.reset()

    def _set_block(self, segments: int) -> None:
        if not 1 <= segments <= BLOCK:
            raise Abort(BAD_BLOCK_SIZE)
        self._block = segments

    def _send_block(self) -> None:
        self._open, self._sequence = _Open.BLOCK_SENT, 0
        position, end = self._position, len(self._data)
        while self._sequence < self._block and (position < end or self._sequence == 0):
            part = self._data[position : position + SEGMENT]
            position += SEGMENT
            self._sequence += 1
            self._send(bytes((self._sequence | (position >= end) << 7,)) + part.ljust(SEGMENT, b"\0"))

    # Block download: the server receives.

    def _block_download(self, data: bytes) -> None:
        if not data[0] & 1:
            self._begin(data)
            self._with_crc = bool(data[0] & 4)
            self._prepare(int.from_bytes(data[4:], "little") if data[0] & 2 else None)
            self._open = _Open.BLOCK_DOWNLOAD
            self._send(_HEADER.pack(0xA0 | self._with_crc << 2, self._index, self._sub, BLOCK))
            return
        self._expect(_Open.BLOCK_COMPLETE)
        padding = data[0] >> 2 & 7
        if padding:
            del self._data[-padding:]
        if self._with_crc and crc_hqx(self._data, 0) != int.from_bytes(data[1:3], "little"):
            raise Abort(BAD_CRC)
        self._finish()
        self.reset()
        self._send(b"\xa1" + _EMPTY[1:])

    def _block_segment(self, data: bytes) -> None:
        sequence, last = data[0] & 0x7F, bool(data[0] & 0x80)
        if sequence == 0:
            raise Abort(BAD_SEQUENCE)
        in_order = sequence == self._sequence + 1
        if in_order:  # what follows a gap is sent again by the client, after the acknowledgement
            self._sequence = sequence
            self._take(data[1:], slack=SEGMENT)
        if last or sequence == BLOCK:
            self._send(bytes((0xA2, self._sequence, BLOCK)) + _EMPTY[3:])
            self._sequence = 0
            if last and in_order:
                self._open = _Open.BLOCK_COMPLETE
