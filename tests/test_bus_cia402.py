"""The power state machine against CiA 402's table, written down here a second time as conditions on bits."""

import itertools
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lwa4d_sim.bus.cia402 import ENERGISED, TRANSITIONS, Command, Machine, State, decode, state_of

S = State
WORDS = range(0x10000)

# CiA 402-2, table of device control commands, bit by bit: bit 7, 3, 2, 1, 0; x = any.
PATTERNS = {
    Command.SHUTDOWN: "0x110",
    Command.SWITCH_ON: "00111",
    Command.ENABLE_OPERATION: "01111",
    Command.DISABLE_VOLTAGE: "0xx0x",
    Command.QUICK_STOP: "0x01x",
}

# The arrows that a controlword can cause, as the standard lists them: from, bits, to, number.
ARROWS = [
    (S.SWITCH_ON_DISABLED, "0x110", S.READY, 2),
    (S.READY, "0x111", S.SWITCHED_ON, 3),
    (S.SWITCHED_ON, "01111", S.OPERATION_ENABLED, 4),
    (S.OPERATION_ENABLED, "00111", S.SWITCHED_ON, 5),
    (S.SWITCHED_ON, "0x110", S.READY, 6),
    (S.READY, "0xx0x", S.SWITCH_ON_DISABLED, 7),
    (S.READY, "0x01x", S.SWITCH_ON_DISABLED, 7),
    (S.OPERATION_ENABLED, "0x110", S.READY, 8),
    (S.OPERATION_ENABLED, "0xx0x", S.SWITCH_ON_DISABLED, 9),
    (S.SWITCHED_ON, "0xx0x", S.SWITCH_ON_DISABLED, 10),
    (S.SWITCHED_ON, "0x01x", S.SWITCH_ON_DISABLED, 10),
    (S.OPERATION_ENABLED, "0x01x", S.QUICK_STOP, 11),
    (S.QUICK_STOP, "0xx0x", S.SWITCH_ON_DISABLED, 12),
    (S.FAULT, "1xxxx", S.SWITCH_ON_DISABLED, 15),
    (S.QUICK_STOP, "01111", S.OPERATION_ENABLED, 16),
]

# The shortest way to each state: what to do to a new machine.
WAYS: dict[State, list[Callable[[Machine], object]]] = {
    S.NOT_READY: [],
    S.SWITCH_ON_DISABLED: [Machine.finish],
    S.READY: [Machine.finish, lambda m: m.command(0x06)],
    S.SWITCHED_ON: [Machine.finish, lambda m: m.command(0x06), lambda m: m.command(0x07)],
    S.OPERATION_ENABLED: [
        Machine.finish,
        lambda m: m.command(0x06),
        lambda m: m.command(0x07),
        lambda m: m.command(0x0F),
    ],
}
WAYS[S.QUICK_STOP] = [*WAYS[S.OPERATION_ENABLED], lambda m: m.command(0x02)]
WAYS[S.FAULT_REACTION] = [Machine.finish, Machine.fault]
WAYS[S.FAULT] = [Machine.finish, Machine.fault, Machine.finish]


def machine(state: State, *, stays: bool = True) -> Machine:
    made = Machine()
    made.stays = stays
    for step in WAYS[state]:
        step(made)
    assert made.state is state
    return made


def fits(word: int, pattern: str) -> bool:
    bits = (word >> 7 & 1, word >> 3 & 1, word >> 2 & 1, word >> 1 & 1, word & 1)
    return all(p in ("x", str(bit)) for p, bit in zip(pattern, bits, strict=True))


def test_every_controlword_is_one_command_or_none() -> None:
    for word in WORDS:
        matching = [command for command, pattern in PATTERNS.items() if fits(word, pattern)]
        assert len(matching) == (0 if word & 0x80 else 1)
        assert decode(word) == (matching[0] if matching else None)


@pytest.mark.parametrize("state", State)
def test_from_every_state_every_controlword_leads_where_the_table_says(state: State) -> None:
    reached = set()
    for word in WORDS:
        made = machine(state)
        expected = [(target, number) for source, bits, target, number in ARROWS if source is state and fits(word, bits)]
        arrow = made.command(word)
        if expected:
            (target, number), *more = expected
            assert not more
            assert arrow is not None
            assert (arrow.number, arrow.target) == (number, target)
            if number in (5, 8):  # they wait for standstill
                assert made.state is state
                made.finish()
            assert made.state is target
        else:
            assert arrow is None
            assert made.state is state
        reached.add(made.state)
    assert reached - {state} == {target for source, _, target, _ in ARROWS if source is state}


def test_what_the_drive_does_by_itself_is_in_the_table_too() -> None:
    alone = {
        (S.NOT_READY, 1): S.SWITCH_ON_DISABLED,
        (S.QUICK_STOP, 12): S.SWITCH_ON_DISABLED,
        (S.FAULT_REACTION, 14): S.FAULT,
    }
    for (state, number), target in alone.items():
        made = machine(state, stays=False)
        arrow = made.finish()
        assert arrow is not None
        assert (arrow.number, made.state) == (number, target)
    for state in set(State) - {state for state, _ in alone}:
        made = machine(state)
        assert made.finish() is None
        assert made.state is state


def test_the_numbers_are_those_of_the_standard() -> None:
    assert {arrow.number for arrow in TRANSITIONS} == set(range(1, 17)) - {13}


@pytest.mark.parametrize("state", State)
def test_a_fault_comes_from_everywhere_but_from_a_fault(state: State) -> None:
    made = machine(state)
    taken = state not in (S.FAULT, S.FAULT_REACTION)
    assert made.fault() is taken
    assert made.state is (S.FAULT_REACTION if taken else state)
    made.finish()
    assert made.state is S.FAULT


@given(words=st.lists(st.integers(0, 0xFFFF), max_size=20))
def test_a_fault_is_reset_by_a_rising_edge_of_bit_7_and_by_nothing_else(words: list[int]) -> None:
    made = machine(S.FAULT)
    before = 0
    for word in words:
        made.command(word)
        if word & 0x80 and not before & 0x80:
            assert made.state is S.SWITCH_ON_DISABLED
            return
        assert made.state is S.FAULT
        before = word


def test_a_bit_held_since_before_the_fault_does_not_reset_it() -> None:
    made = machine(S.READY)
    made.command(0x80)
    made.fault()
    made.finish()
    assert made.command(0x80) is None
    assert made.command(0x8F) is None
    assert made.state is S.FAULT
    assert made.command(0x0F) is None
    arrow = made.command(0x8F)
    assert arrow is not None
    assert (arrow.number, arrow.target) == (15, S.SWITCH_ON_DISABLED)


def test_a_cause_that_persists_keeps_the_fault_and_needs_a_new_edge() -> None:
    made = machine(S.FAULT)
    assert made.command(0x80, resettable=False) is None
    assert made.command(0x80) is None
    made.command(0x00)
    assert made.command(0x80) is not None


@given(words=st.lists(st.integers(0, 0xFFFF) | st.sampled_from([0x02, 0x06, 0x07, 0x0F, 0x1F, 0x80]), max_size=60))
def test_a_controlword_takes_at_most_one_arrow(words: list[int]) -> None:
    """The walk is one edge of the table at a time; what waits for standstill is not counted twice."""
    arrows = {(arrow.source, arrow.target) for arrow in TRANSITIONS}
    made = machine(S.SWITCH_ON_DISABLED)
    for word in words:
        before = made.state
        arrow = made.command(word)
        if made.state is not before:
            assert (before, made.state) in arrows
            assert arrow is not None
            assert arrow.target is made.state
        if made.ending is not None:
            made.finish()


def test_a_word_received_again_counts_again_but_does_not_end_a_quick_stop() -> None:
    made = machine(S.SWITCH_ON_DISABLED)
    made.command(0x06)
    assert [made.command(0x0F) and made.state, made.command(0x0F) and made.state] == [
        S.SWITCHED_ON,
        S.OPERATION_ENABLED,
    ]
    made.stays = True
    made.request(Command.QUICK_STOP)  # the drive's own: the master still sends 0x0F
    assert made.command(0x0F) is None
    assert made.command(0x1F) is None  # nor by a bit that is no command
    assert made.state is S.QUICK_STOP
    made.command(0x02)
    arrow = made.command(0x0F)
    assert arrow is not None
    assert (arrow.number, arrow.target) == (16, S.OPERATION_ENABLED)


def test_without_stay_a_quick_stop_cannot_be_called_off() -> None:
    made = machine(S.QUICK_STOP, stays=False)
    assert made.command(0x0F) is None
    made.finish()
    assert made.state is S.SWITCH_ON_DISABLED


def test_a_ramp_down_can_be_called_off_or_changed_into_another() -> None:
    made = machine(S.OPERATION_ENABLED)
    made.command(0x07)
    assert made.ending is not None
    assert made.command(0x07) is None  # already begun
    made.command(0x0F)
    assert made.state is S.OPERATION_ENABLED
    assert not made.ending
    made.command(0x07)
    made.command(0x06)
    made.finish()
    assert made.state is S.READY


def test_statuswords_tell_the_states_apart() -> None:
    for state, noise in itertools.product(State, (0x0000, 0xFF90, 0x1010, 0x0200)):
        loose = ~state.value[0] & 0xFF90
        assert state_of(state.bits | (noise & loose)) is state
    for one, other in itertools.combinations(State, 2):
        assert state_of(one.bits) is not other
    assert state_of(0x4F) is None


def test_only_the_states_that_may_have_current_are_energised() -> None:
    assert {state for state in State if state.bits & 0x04 and state.bits & 0x4F != 0x40} == ENERGISED
