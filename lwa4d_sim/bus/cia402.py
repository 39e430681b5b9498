"""The power state machine of CiA 402, as tables and the few rules that walk them.

Numbers of transitions, states and masks follow CiA 402-2 (statusword 6041, controlword 6040). Nothing here knows
motors or time: a transition that must wait for standstill is begun by one call and ended by `Machine.finish`.
"""

from enum import Enum
from typing import NamedTuple


class State(Enum):
    """A power state: (mask, value) of the statusword that says so."""

    NOT_READY = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP = (0x6F, 0x07)
    FAULT_REACTION = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)

    @property
    def bits(self) -> int:
        """Statusword bits 0-3, 5 and 6 of this state."""
        return self.value[1]


class Command(Enum):
    """What a controlword asks of the power state: (mask, value) of its bits 0-3 and 7."""

    SHUTDOWN = (0x87, 0x06)
    SWITCH_ON = (0x8F, 0x07)  # in operation the same bits mean: disable operation
    ENABLE_OPERATION = (0x8F, 0x0F)
    DISABLE_VOLTAGE = (0x82, 0x00)
    QUICK_STOP = (0x86, 0x02)
    FAULT_RESET = (0x80, 0x80)  # its rising edge


class Transition(NamedTuple):
    """One arrow of the state machine; ``command`` None: the drive takes it by itself."""

    number: int
    source: State
    command: Command | None
    target: State


_S, _C = State, Command

# CiA 402-2, figure and table of the power state machine. Transition 0 is power-on, 13 starts in every state.
TRANSITIONS = (
    Transition(1, _S.NOT_READY, None, _S.SWITCH_ON_DISABLED),
    Transition(2, _S.SWITCH_ON_DISABLED, _C.SHUTDOWN, _S.READY),
    Transition(3, _S.READY, _C.SWITCH_ON, _S.SWITCHED_ON),
    Transition(3, _S.READY, _C.ENABLE_OPERATION, _S.SWITCHED_ON),  # transition 4 follows when the word comes again
    Transition(4, _S.SWITCHED_ON, _C.ENABLE_OPERATION, _S.OPERATION_ENABLED),
    Transition(5, _S.OPERATION_ENABLED, _C.SWITCH_ON, _S.SWITCHED_ON),
    Transition(6, _S.SWITCHED_ON, _C.SHUTDOWN, _S.READY),
    Transition(7, _S.READY, _C.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    Transition(7, _S.READY, _C.QUICK_STOP, _S.SWITCH_ON_DISABLED),
    Transition(8, _S.OPERATION_ENABLED, _C.SHUTDOWN, _S.READY),
    Transition(9, _S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    Transition(10, _S.SWITCHED_ON, _C.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    Transition(10, _S.SWITCHED_ON, _C.QUICK_STOP, _S.SWITCH_ON_DISABLED),
    Transition(11, _S.OPERATION_ENABLED, _C.QUICK_STOP, _S.QUICK_STOP),
    Transition(12, _S.QUICK_STOP, None, _S.SWITCH_ON_DISABLED),
    Transition(12, _S.QUICK_STOP, _C.DISABLE_VOLTAGE, _S.SWITCH_ON_DISABLED),
    Transition(14, _S.FAULT_REACTION, None, _S.FAULT),
    Transition(15, _S.FAULT, _C.FAULT_RESET, _S.SWITCH_ON_DISABLED),
    Transition(16, _S.QUICK_STOP, _C.ENABLE_OPERATION, _S.OPERATION_ENABLED),
)
_BY_COMMAND = {(arrow.source, arrow.command): arrow for arrow in TRANSITIONS if arrow.command}
_AUTOMATIC = {arrow.source: arrow for arrow in TRANSITIONS if arrow.command is None}

# Those that leave operation on a ramp and so end at standstill: disable operation (605C) and shutdown (605B).
_RAMPED = frozenset({5, 8})

# States in which the motor may have current.
ENERGISED = frozenset({State.OPERATION_ENABLED, State.QUICK_STOP, State.FAULT_REACTION})

# Statusword bits beside the state (CiA 402-2); 8, 14 and 15 are the maker's: see libPowerballArm, ipa_canopen_core.
VOLTAGE, WARNING, MOVING, REMOTE = 1 << 4, 1 << 7, 1 << 8, 1 << 9
REACHED, LIMITED, SPECIFIC, DEVIATION = 1 << 10, 1 << 11, 1 << 12, 1 << 13
BLOCKED, REFERENCED = 1 << 14, 1 << 15
HALT = 1 << 8  # controlword

_COMMAND_BITS = 0x8F
_DECODED = tuple(
    next((c for c in Command if c is not Command.FAULT_RESET and word & c.value[0] == c.value[1]), None)
    for word in range(_COMMAND_BITS + 1)
)


def decode(word: int) -> Command | None:
    """The command in a controlword, but for the fault reset, which is an edge; None: bit 7 is set, no command."""
    return _DECODED[word & _COMMAND_BITS]


def state_of(statusword: int) -> State | None:
    """The state that a statusword tells; None for patterns that CiA 402 does not know."""
    return next((state for state in State if statusword & state.value[0] == state.value[1]), None)


class Machine:
    """The state machine of one drive.

    Attributes:
        state: where it stands.
        ending: the transition that `finish` will take once the axis stands still, or None.
        stays: a quick stop ends in QUICK_STOP (605A = 5 to 8) and not in SWITCH_ON_DISABLED.
    """

    def __init__(self) -> None:
        self.state = State.NOT_READY
        self.ending: Transition | None = _AUTOMATIC[State.NOT_READY]
        self.stays = False
        self._last = 0

    def command(self, word: int, *, resettable: bool = True) -> Transition | None:
        """Take a received controlword: at most one transition.

        A word received again is the same wish still standing. It counts, so that a drive that was not ready for it
        follows later; but fault reset needs its rising edge, and no wish from before a quick stop ends one.

        Args:
            word: controlword 6040.
            resettable: False while the cause of a fault persists.

        Returns:
            The transition taken, or begun: see `ending`.
        """
        rising, changed = word & ~self._last & 0x80, (word ^ self._last) & _COMMAND_BITS
        self._last = word
        if self.state is State.FAULT:
            return self._take(_BY_COMMAND[State.FAULT, Command.FAULT_RESET]) if rising and resettable else None
        wish = decode(word)
        if wish is None or (self.state is State.QUICK_STOP and not changed):
            return None
        return self.request(wish)

    def request(self, wish: Command) -> Transition | None:
        """Take a command whoever gives it (a controlword, or the drive when it has lost its master)."""
        arrow = _BY_COMMAND.get((self.state, wish))
        if arrow is None or (arrow.number == 16 and not self.stays):
            if wish is Command.ENABLE_OPERATION and self.state is State.OPERATION_ENABLED:
                self.ending = None  # the ramp down is called off
            return None
        if arrow.number in _RAMPED:
            if self.ending == arrow:
                return None
            self.ending = arrow
            return arrow
        return self._take(arrow)

    def fault(self) -> bool:
        """Transition 13; whether it was taken (it is not in FAULT_REACTION and FAULT)."""
        if self.state in (State.FAULT_REACTION, State.FAULT):
            return False
        self._take(Transition(13, self.state, None, State.FAULT_REACTION))
        return True

    def finish(self) -> Transition | None:
        """What was begun is done (start-up, ramp, fault reaction): take the transition that waited for it."""
        return self._take(self.ending) if self.ending else None

    def _take(self, arrow: Transition) -> Transition:
        self.state = arrow.target
        self.ending = _AUTOMATIC.get(arrow.target)
        if arrow.target is State.QUICK_STOP and self.stays:
            self.ending = None
        return arrow
