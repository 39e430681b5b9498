"""A frame on its way: while it waits and travels, and what is recorded of it."""

from typing import TYPE_CHECKING, Literal, NamedTuple

import can

from lwa4d_sim.interfaces import Ns

if TYPE_CHECKING:
    from lwa4d_sim.bus.port import WirePort


class WireFrame(NamedTuple):
    """One transmission on the wire, or one frame given up.

    Attributes:
        can_id, extended, remote, dlc, data: the frame.
        bits: its length in bits, interframe space included.
        node: name of the port that sent it.
        queued: when it was handed to the port [ns].
        started: when its first bit went on the wire [ns].
        received: when the others had it [ns], or None when they did not get it.
        free: when the wire was free again [ns].
        attempt: 1 for the first transmission, more for repetitions.
        outcome: ``sent``, ``error`` (it must be repeated) or ``discarded`` (its port gave it up).
    """

    can_id: int
    extended: bool
    remote: bool
    dlc: int
    data: bytes
    bits: int
    node: str
    queued: Ns
    started: Ns
    received: Ns | None
    free: Ns
    attempt: int
    outcome: Literal["sent", "error", "discarded"]


class Pending:
    """A frame from its `send` to the end of its transmission.

    Attributes:
        msg, port: the frame, a copy of what was handed over, and its sender.
        key: what arbitration goes by; the lowest wins.
        lane: which of the port's queues it stands in.
        seq: order of sending on the whole wire.
        bits: its length, interframe space included.
        queued, started: when it was sent, and when its newest transmission began [ns].
        attempt: number of transmissions begun.
    """

    __slots__ = ("attempt", "bits", "key", "lane", "msg", "port", "queued", "seq", "started")

    def __init__(
        self, msg: can.Message, port: "WirePort", key: int, lane: int, seq: int, bits: int, queued: Ns
    ) -> None:
        self.msg, self.port, self.key, self.lane, self.seq, self.bits = msg, port, key, lane, seq, bits
        self.queued = self.started = queued
        self.attempt = 0

    def record(
        self, started: Ns, received: Ns | None, free: Ns, outcome: Literal["sent", "error", "discarded"]
    ) -> WireFrame:
        """What the wire keeps of it."""
        msg = self.msg
        return WireFrame(
            msg.arbitration_id,
            msg.is_extended_id,
            msg.is_remote_frame,
            msg.dlc,
            bytes(msg.data),
            self.bits,
            self.port.name,
            self.queued,
            started,
            received,
            free,
            self.attempt,
            outcome,
        )
