"""Longest time a CAN message can take from its release to its end on the wire, before anything has run.

The analysis is that of Davis, Burns, Bril and Lukkien, "Controller Area Network (CAN) schedulability analysis: refuted,
revisited and revised", Real-Time Systems 35 (2007), sections 3 and 5, in whole nanoseconds. It holds where every node
offers its most urgent frame to the arbitration (`transmit="priority"`), and frames of one identifier keep their order.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import NamedTuple

import can

from lwa4d_sim.bus.frames import INTERFRAME_BITS, arbitration_key, worst_bits
from lwa4d_sim.interfaces import NS_PER_S, Ns

# Longest error frame with its pauses: flags 12, delimiter 8, intermission 3, suspension 8 (Davis 2007, section 5).
ERROR_BITS = 31


@dataclass(frozen=True, kw_only=True, slots=True)
class Stream:
    """A message sent again and again.

    Attributes:
        can_id: identifier.
        period: shortest time between two releases [ns].
        dlc: data bytes.
        jitter: longest time from a release to the queuing in the controller [ns].
        deadline: allowed response [ns]; None: the period.
        extended: 29-bit identifier.
        remote: remote frame.
        bits: longest length of its frames with interframe space, where that is known better than `worst_bits`.
        name: what to call it.
    """

    can_id: int
    period: Ns
    dlc: int = 8
    jitter: Ns = Ns(0)
    deadline: Ns | None = None
    extended: bool = False
    remote: bool = False
    bits: int | None = None
    name: str = ""

    def __post_init__(self) -> None:
        """Refuse what no frame can have."""
        if not 0 <= self.can_id < (1 << 29 if self.extended else 1 << 11):
            raise ValueError(f"no such identifier: {self.can_id:#x}")
        if self.period <= 0 or self.jitter < 0:
            raise ValueError(f"period must be positive and jitter not negative: {self}")
        worst_bits(self.dlc)  # refuses what is no length

    @property
    def longest(self) -> int:
        """Bits of its longest frame, interframe space included."""
        return self.bits or worst_bits(self.dlc, extended=self.extended, remote=self.remote)

    @property
    def key(self) -> int:
        """Its place in the arbitration; the lowest wins."""
        return arbitration_key(
            can.Message(
                arbitration_id=self.can_id, is_extended_id=self.extended, is_remote_frame=self.remote, dlc=self.dlc
            )
        )


@dataclass(frozen=True, slots=True)
class Response:
    """What the analysis says of one message.

    Attributes:
        stream: the message.
        worst: longest response [ns], jitter and the three bits of interframe space included; inf if it has no bound.
        reception: the same up to the instant at which the receivers have the frame, three bits earlier.
        instances: releases in the longest busy period, each of which was looked at; 0 if there is no bound.
        busy: length of that period [ns], or inf.
    """

    stream: Stream
    worst: float
    reception: float
    instances: int
    busy: float

    @property
    def in_time(self) -> bool:
        """Whether it always meets its deadline."""
        deadline = self.stream.deadline
        return self.worst <= (self.stream.period if deadline is None else deadline)


class _Sharer(NamedTuple):
    """A message in the sums of the analysis, all [ns]."""

    cost: int
    period: int
    jitter: int


def utilisation(streams: Sequence[Stream], bit_rate: int) -> float:
    """Share of the time the bus is taken when every frame is as long as can be."""
    return float(sum(Fraction(_span(one.longest, bit_rate), one.period) for one in streams))


def response_times(streams: Sequence[Stream], bit_rate: int, *, error_interval: Ns | None = None) -> list[Response]:
    """Worst response of every message, in the order given.

    Args:
        streams: all messages on the bus; no two may have one identifier.
        bit_rate: bits a second.
        error_interval: shortest time between two bit errors [ns]; None: there are none.
    """
    if bit_rate <= 0:
        raise ValueError(f"a bit rate is positive, not {bit_rate}")
    if len({one.key for one in streams}) < len(streams):
        raise ValueError("two messages have the same identifier: arbitration does not part them")
    return [_response(one, streams, bit_rate, error_interval) for one in streams]


def _response(one: Stream, streams: Sequence[Stream], bit_rate: int, interval: Ns | None) -> Response:
    own = one.key
    bit, cost = _span(1, bit_rate), _span(one.longest, bit_rate)
    hep = [other for other in streams if other.key <= own]
    sharers = [_Sharer(_span(other.longest, bit_rate), other.period, other.jitter) for other in hep]
    higher = [sharer for sharer, other in zip(sharers, hep, strict=True) if other is not one]
    blocking = max((_span(other.longest, bit_rate) for other in streams if other.key > own), default=0)
    if interval is not None:
        # An error costs an error frame, and once more the longest frame it may have spoiled.
        repair = _span(ERROR_BITS + max(other.longest for other in hep), bit_rate)
        sharers.append(_Sharer(repair, interval, 0))
        # What counts is an error before the frame's end, not before its beginning: a jitter of the frame's length.
        higher.append(_Sharer(repair, interval, max(0, cost - bit)))
    load = sum((Fraction(sharer.cost, sharer.period) for sharer in sharers), Fraction())
    if load > 1 or (load == 1 and (blocking or any(sharer.jitter for sharer in sharers))):
        return Response(one, math.inf, math.inf, 0, math.inf)
    busy = _rest(cost, blocking, sharers, 0)
    instances = -(-(busy + one.jitter) // one.period)
    worst = wait = 0
    for q in range(instances):
        wait = _rest(max(wait, blocking + q * cost), blocking + q * cost, higher, bit)
        worst = max(worst, one.jitter + wait - q * one.period + cost)
    return Response(one, worst, worst - _span(INTERFRAME_BITS, bit_rate), instances, busy)


def _rest(start: int, base: int, sharers: Sequence[_Sharer], late: int) -> int:
    """Smallest t, not below ``start``, with t = base + what the sharers ask for in t and ``late``."""
    t = start
    while True:
        asked = base + sum(-(-(t + jitter + late) // period) * cost for cost, period, jitter in sharers)
        if asked <= t:
            return t
        t = asked


def _span(bits: int, bit_rate: int) -> int:
    """Duration of some bits [ns], rounded up."""
    return -(-bits * NS_PER_S // bit_rate)
