"""Which transmissions are disturbed, by chance, by script or by two nodes with one identifier, and who suffers."""

import math
import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated

import can
from annotated_types import Ge, Le

from lwa4d_sim.bus.confinement import Outcome, broken, unanswered
from lwa4d_sim.bus.frames import ACK_SLOT, INTERFRAME_BITS, levels
from lwa4d_sim.bus.port import WirePort
from lwa4d_sim.bus.transmission import Pending

NEVER = 1 << 62  # later than anything, in bits and in nanoseconds
Match = Callable[[can.Message, str], bool]


@dataclass(frozen=True, kw_only=True, slots=True)
class BitErrors:
    """Bits that are read wrong at random, each independent of the others.

    Attributes:
        probability: that a bit of a frame is disturbed.
        local: share of the disturbances that a single receiver sees; every node sees the others.
    """

    probability: Annotated[float, Ge(0), Le(1)]
    local: Annotated[float, Ge(0), Le(1)] = 0.0

    def __post_init__(self) -> None:
        """Refuse what is no probability."""
        if not (0 <= self.probability <= 1 and 0 <= self.local <= 1):
            raise ValueError(f"probabilities lie between 0 and 1: {self}")

    def gap(self, rng: random.Random) -> int:
        """Good bits before the next disturbed one: geometrically distributed."""
        if self.probability in (0, 1):
            return 0 if self.probability else NEVER
        return int(min(math.log(1.0 - rng.random()) / math.log1p(-self.probability), float(NEVER)))


@dataclass(slots=True)
class Disturbance:
    """A disturbance of the next transmissions of chosen frames.

    Attributes:
        match: called with a frame and the name of its sender; True chooses it.
        times: how many transmissions, repetitions included, it will still disturb.
        bit: which bit is read wrong, counted from the start of frame with the stuff bits; beyond the end the last.
        at: name of the one receiver that reads it wrong, and finds out by the CRC; None: every node does.
    """

    match: Match
    times: int = 1
    bit: int = 20
    at: str | None = None


@dataclass(slots=True)
class Verdict:
    """How a transmission ends, and for whom.

    Attributes:
        outcome: of the frame on the wire.
        senders: the frames of those who send to that end; more than one only if they send alike.
        losers: frames of error passive nodes that gave way to one with the same identifier.
        misread: the one receiver that reads a bit wrong, or None.
        answered: False when a passive sender hears no answer at all.
        first: whether that one receiver sends its error flag before the others do.
    """

    outcome: Outcome
    senders: list[Pending]
    losers: list[Pending]
    misread: WirePort | None = None
    answered: bool = True
    first: bool = False

    def receivers(self, nodes: Iterable[WirePort]) -> list[WirePort]:
        """The nodes that have the frame afterwards."""
        if not self.outcome.accepted:
            return []
        busy = [frame.port for frame in (*self.senders, *self.losers)]
        return [port for port in nodes if port is not self.misread and port not in busy]

    def count(self, nodes: Iterable[WirePort]) -> None:
        """Move the error counters of all nodes."""
        for frame in self.senders:
            if self.outcome.failed:
                frame.port.counters.failed_to_send(unanswered=not self.answered)
            else:
                frame.port.counters.sent()
        for frame in self.losers:
            frame.port.counters.failed_to_send()
        content = self.receivers(nodes)
        busy = [frame.port for frame in (*self.senders, *self.losers)]
        for port in nodes:
            if port in content:
                port.counters.received()
            elif port not in busy:
                port.counters.failed_to_receive(first=self.first and port is self.misread)


class Disturbances:
    """Judge of the transmissions.

    Args:
        errors: law of the bit errors, or None.
        seed: of the random numbers.
    """

    def __init__(self, errors: BitErrors | None, seed: int) -> None:
        self._rng = random.Random(seed)
        self.script: list[Disturbance] = []
        self.set_law(errors)

    def set_law(self, errors: BitErrors | None) -> None:
        """Bit errors from now on."""
        self.law = errors or BitErrors(probability=0)
        self._gap = self.law.gap(self._rng)

    def passes(self, bits: int) -> bool:
        """Whether chance spares the next bits; only then do they count as gone by."""
        if self._gap < bits:
            return False
        self._gap -= bits
        return True

    def judge(self, contenders: Sequence[Pending], nodes: Sequence[WirePort]) -> Verdict:
        """Say how a transmission will end that these frames, equal in arbitration, begin together."""
        verdict = _collide(contenders)
        frame = verdict.senders[0]
        taken = {id(other.port) for other in contenders}
        others = [port for port in nodes if id(port) not in taken]
        chance = self._by_chance(frame.bits - INTERFRAME_BITS, others)
        if verdict.outcome.failed:
            return verdict
        if not others:
            verdict.outcome, verdict.answered = unanswered(frame.bits), False
            return verdict
        found = self._by_script(frame) or chance
        if found is None:
            return verdict
        bit, at = found
        verdict.misread = next((port for port in others if port.name == at), None)
        if verdict.misread is not None:
            _misread(verdict, frame, bit, alone=len(others) == 1)
        elif at in (None, frame.port.name):
            passive = all(sender.port.counters.passive for sender in verdict.senders)
            verdict.outcome = broken(frame.msg, bit, flag=int(passive))
        return verdict

    def _by_chance(self, bits: int, others: Sequence[WirePort]) -> tuple[int, str | None] | None:
        if self.passes(bits):
            return None
        bit, self._gap = self._gap, self.law.gap(self._rng)
        local = others and self._rng.random() < self.law.local
        return bit, self._rng.choice(others).name if local else None

    def _by_script(self, frame: Pending) -> tuple[int, str | None] | None:
        for item in self.script:
            if item.match(frame.msg, frame.port.name):
                item.times -= 1
                if item.times <= 0:
                    self.script.remove(item)
                return item.bit, item.at
        return None


def _misread(verdict: Verdict, frame: Pending, bit: int, *, alone: bool) -> None:
    """One receiver reads a bit wrong: the CRC tells it, or a fixed field, and it does not acknowledge."""
    passive = verdict.misread is not None and verdict.misread.counters.passive
    bits = frame.bits - INTERFRAME_BITS
    if bit < bits - ACK_SLOT and alone:
        verdict.outcome, verdict.answered = unanswered(frame.bits), not passive
    elif bit >= bits - 1:
        verdict.misread = None  # a receiver has accepted the frame before its last bit
    elif not passive:  # a passive node's flag disturbs nobody: it alone goes without the frame
        # Whatever is wrong before it, the CRC error flag stands behind the acknowledge delimiter.
        verdict.outcome = broken(frame.msg, max(bit, bits - ACK_SLOT + 1), local=True)
        verdict.first = True


def _collide(contenders: Sequence[Pending]) -> Verdict:
    """What happens until at most equal frames are left.

    Arbitration does not part frames with one identifier. At the first bit in which they differ, the one that sends it
    recessive reads a dominant bit: a bit error. Its flag ends all of them, unless it is error passive.
    """
    rest = list(contenders)
    losers: list[Pending] = []
    while True:
        sent = [levels(frame.msg) for frame in rest] if len(rest) > 1 else []
        bit = next((k for k, column in enumerate(zip(*sent, strict=False)) if len(set(column)) > 1), None)
        if bit is None:
            return Verdict(Outcome(False, rest[0].bits - INTERFRAME_BITS, True), rest, losers)
        recessive = [frame for frame, one in zip(rest, sent, strict=True) if one[bit]]
        dominant = [frame for frame, one in zip(rest, sent, strict=True) if not one[bit]]
        if not all(frame.port.counters.passive for frame in recessive):
            return Verdict(broken(dominant[0].msg, bit, local=True), rest, losers)
        losers += recessive
        rest = dominant
