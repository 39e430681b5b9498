"""What bit errors do to a frame and to the nodes: error frames, error counters, error passive, bus-off.

The rules are those of Bosch, CAN specification 2.0 (1991), chapters 6 (error handling) and 7 (fault confinement).
"""

from typing import NamedTuple

import can

from lwa4d_sim.bus.frames import ACK_SLOT, INTERFRAME_BITS, TAIL, levels

FLAG_BITS = 6  # error flag (CAN 2.0, 3.1.3)
DELIMITER_BITS = 8  # error delimiter (CAN 2.0, 3.1.3)
SUSPEND_BITS = 8  # pause of an error passive transmitter before its next frame (CAN 2.0, 3.1.5)
PASSIVE, BUS_OFF = 128, 256  # counts from which a node is error passive, bus-off (CAN 2.0, 7)
RECOVERY_SEQUENCES = 128  # sequences of recessive bits that end bus-off (CAN 2.0, 7, rule 12)
SEQUENCE_BITS = 11
TRANSMIT_STEP, PRIMARY_STEP = 8, 8  # rules 3 and 2
RECEIVE_RETURN = 127  # what a receive counter above it falls to after a good frame (rule 8: 119 to 127)

# Error classes as SocketCAN reports them (linux/can/error.h), so that foreign software knows them.
ERROR_CONTROLLER, ERROR_BUS_OFF, ERROR_RESTARTED, ERROR_COUNTERS = 0x004, 0x040, 0x100, 0x200
CONTROLLER_RX_PASSIVE, CONTROLLER_TX_PASSIVE, CONTROLLER_ACTIVE = 0x10, 0x20, 0x40


class Counters:
    """Transmit and receive error counter of one node.

    Attributes:
        tec, rec: the counters.
        off: True in bus-off.
    """

    __slots__ = ("off", "rec", "tec")

    def __init__(self) -> None:
        self.tec = self.rec = 0
        self.off = False

    @property
    def passive(self) -> bool:
        """Error passive: its error flags are recessive and disturb nobody."""
        return self.tec >= PASSIVE or self.rec >= PASSIVE

    @property
    def state(self) -> can.BusState:
        """ACTIVE is error active, PASSIVE error passive, ERROR bus-off."""
        if self.off:
            return can.BusState.ERROR
        return can.BusState.PASSIVE if self.passive else can.BusState.ACTIVE

    def sent(self) -> None:
        """A frame was sent and acknowledged (rule 7)."""
        self.tec = max(0, self.tec - 1)

    def received(self) -> None:
        """A frame was received well (rule 8)."""
        self.rec = RECEIVE_RETURN if self.rec > RECEIVE_RETURN else max(0, self.rec - 1)

    def failed_to_send(self, *, unanswered: bool = False) -> None:
        """It met an error as transmitter (rule 3); alone on the bus, it does not go on counting once passive."""
        if not (unanswered and self.passive):
            self.tec += TRANSMIT_STEP
            self.off = self.tec >= BUS_OFF

    def failed_to_receive(self, *, first: bool = False) -> None:
        """It met an error as receiver (rule 1), before the others did when ``first`` (rule 2)."""
        # Nothing in the rules ends the counting; controllers have a register of eight or nine bits.
        self.rec = min(self.rec + 1 + (PRIMARY_STEP if first else 0), BUS_OFF - 1)

    def restart(self) -> None:
        """Error active again after bus-off (rule 12)."""
        self.tec = self.rec = 0
        self.off = False

    def report(self, kind: int, channel: str, timestamp: float) -> can.Message:
        """Error frame, as SocketCAN forms it, that tells a node's software of a change of its state."""
        detail = 0
        if kind == ERROR_CONTROLLER:
            passive = CONTROLLER_TX_PASSIVE if self.tec >= PASSIVE else CONTROLLER_RX_PASSIVE
            detail = passive if self.passive else CONTROLLER_ACTIVE
        data = [0, detail, 0, 0, 0, 0, min(self.tec, 255), min(self.rec, 255)]
        return can.Message(
            timestamp=timestamp,
            arbitration_id=kind | ERROR_COUNTERS,
            is_extended_id=False,
            is_error_frame=True,
            channel=channel,
            data=data,
        )


class Outcome(NamedTuple):
    """How a transmission ends.

    Attributes:
        failed: the transmitter must send it again.
        bits: from the start of frame to the end of the frame or of the error frame, without intermission.
        accepted: whether receivers that have not read a bit wrong themselves take the frame.
    """

    failed: bool
    bits: int
    accepted: bool


def unanswered(bits: int) -> Outcome:
    """Nobody acknowledges a frame of that length: the transmitter's flag follows the acknowledge slot."""
    return Outcome(True, bits - INTERFRAME_BITS - ACK_SLOT + 1 + FLAG_BITS + DELIMITER_BITS, False)


def broken(msg: can.Message, bit: int, *, flag: int = 0, local: bool = False) -> Outcome:
    """What becomes of a frame when somebody finds an error at a bit and sends an error flag behind it.

    A flag breaks the stuffing rule or a fixed field, so the others soon send theirs; six to twelve bits come of it. A
    receiver has accepted a frame before the last bit, the transmitter only after it: so a frame may arrive twice
    (CAN 2.0, 4, message validation). A bit read wrong during arbitration counts as any other.

    Args:
        msg: the frame.
        bit: which, counted from the start of frame, stuff bits included; beyond the end it is the last.
        flag: level of the first flag: 0 from an error active node, 1 from an error passive transmitter.
        local: only one node finds an error there, the others read what was sent.
    """
    sent = levels(msg)
    last, tail = len(sent) - 1, len(sent) - len(TAIL)
    bit = min(bit, last)
    if bit >= tail:
        lag = int(local)  # a fixed field is broken at once
    else:
        seen = sent[: bit + 1]
        seen[bit] ^= not local
        run = 1
        while run < FLAG_BITS and run <= bit and seen[bit - run] == seen[bit]:
            run += 1
        # Flag bits that pass before receivers, who wait for six equal ones, begin their flags.
        lag = 0 if run == FLAG_BITS else FLAG_BITS - (run if seen[bit] == flag else 0)
        if local:  # and before the other transmitter does
            lag = max(lag, next(k for k in range(1, len(sent)) if sent[bit + k] != flag))
        if not flag:
            lag = min(lag, tail - bit)  # a dominant CRC delimiter nobody overlooks
    return Outcome(True, bit + 1 + lag + FLAG_BITS + DELIMITER_BITS, bit + local >= last)
