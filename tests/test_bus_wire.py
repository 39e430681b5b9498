"""The simulated wire: timing, arbitration, errors bit by bit, fault confinement, and python-can's way of using it."""

import gc
import itertools
import logging
import random
from collections.abc import Callable
from functools import partial
from typing import Literal

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lwa4d_sim.bus.confinement import broken
from lwa4d_sim.bus.frames import frame_bits, levels
from lwa4d_sim.bus.wire import BitErrors, Wire, WireFrame, WirePort
from lwa4d_sim.interfaces import Ns

BIT = 2_000  # ns at 500 kbit/s
MS = 1_000_000
Heard = list[tuple[int, can.Message]]


def frame(can_id: int, data: bytes = b"", *, extended: bool = False) -> can.Message:
    return can.Message(arbitration_id=can_id, is_extended_id=extended, data=data)


def remote(can_id: int, dlc: int = 0) -> can.Message:
    return can.Message(arbitration_id=can_id, is_extended_id=False, is_remote_frame=True, dlc=dlc)


def ear(wire: Wire, name: str = "ear") -> tuple[WirePort, Heard]:
    """A node that only listens: what it heard and when."""
    heard: Heard = []
    return wire.port(name, lambda msg, now: heard.append((now, msg))), heard


def ids(heard: Heard) -> list[int]:
    return [msg.arbitration_id for _, msg in heard]


def at(wire: Wire, t: float, action: Callable[[], None]) -> None:
    wire.call_at(Ns(round(t)), action)


def in_turn(*actions: Callable[[], None]) -> Callable[[], None]:
    def run() -> None:
        for action in actions:
            action()

    return run


def is_from(name: str) -> Callable[[can.Message, str], bool]:
    return lambda msg, node: node == name


def outcomes(wire: Wire) -> list[str]:
    return [one.outcome for one in wire.frames]


# ---------------------------------------------------------------------------------------------------- timing and order


def test_a_frame_arrives_after_its_bits_and_the_next_begins_after_three_more() -> None:
    wire = Wire(500_000, record=True)
    a = wire.port("a")
    _, heard = ear(wire)
    first, second = frame(0x203, bytes(8)), frame(0x80)  # 125 and 51 bits
    at(wire, 1_234, in_turn(partial(a.send, first), partial(a.send, second)))
    at(wire, 1_234 + 122 * BIT, lambda: a.send(frame(0x81)))
    wire.run_until(Ns(MS))
    begin = 1_234 + 51 * BIT  # the lower identifier went first
    assert [now for now, _ in heard] == [1_234 + 48 * BIT, begin + 122 * BIT, begin + (125 + 48) * BIT]
    assert [frame_bits(msg) for msg in (first, second, frame(0x81))] == [125, 51, 51]
    assert [msg.timestamp for _, msg in heard] == [now / 1e9 for now, _ in heard]
    assert [(one.queued, one.started, one.received, one.free) for one in wire.frames] == [
        (1_234, 1_234, 1_234 + 48 * BIT, begin),
        (1_234, begin, begin + 122 * BIT, begin + 125 * BIT),
        (1_234 + 122 * BIT, begin + 125 * BIT, begin + 173 * BIT, begin + 176 * BIT),
    ]
    assert wire.busy == (51 + 125 + 51) * BIT
    assert wire.now == MS


@pytest.mark.parametrize("bit_rate", [10_000, 83_333, 125_000, 800_000, 1_000_000])
def test_any_bit_rate(bit_rate: int) -> None:
    wire = Wire(bit_rate)
    a = wire.port("a")
    _, heard = ear(wire)
    for _ in range(3):
        a.send(frame(0x80))
    wire.run_until(Ns(10**9))
    assert [now for now, _ in heard] == pytest.approx([bits * 1e9 / bit_rate for bits in (48, 99, 150)], abs=3)


def test_nobody_hears_himself_and_all_others_do() -> None:
    wire = Wire()
    ports, ears = zip(*(ear(wire, name) for name in "abc"), strict=True)
    ports[1].send(frame(1))
    wire.run_until(Ns(MS))
    assert [ids(heard) for heard in ears] == [[1], [], [1]]


def test_what_is_sent_is_a_copy() -> None:
    wire = Wire()
    a, (_, heard) = wire.port("a"), ear(wire)
    msg = frame(1, b"ab")
    a.send(msg)
    msg.data[0], msg.arbitration_id = 0, 2
    wire.run_until(Ns(MS))
    assert (heard[0][1].arbitration_id, bytes(heard[0][1].data)) == (1, b"ab")
    assert msg.timestamp == 0


@st.composite
def traffic(draw: st.DrawFn) -> list[tuple[int, int, can.Message]]:
    """(instant, node, frame) in the order of sending; equal frames of two nodes excluded."""
    items = []
    owner: dict[tuple[int, bool, bool], int] = {}
    for _ in range(draw(st.integers(1, 25))):
        node, extended = draw(st.integers(0, 3)), draw(st.booleans())
        top = draw(st.sampled_from([0, 1, 0x123, 0x7FF]))
        can_id = top << 18 | draw(st.integers(0, 2)) if extended else top
        msg = can.Message(arbitration_id=can_id, is_extended_id=extended, is_remote_frame=draw(st.booleans()))
        if not msg.is_remote_frame:
            msg.data = bytearray(draw(st.binary(max_size=8)))
            msg.dlc = len(msg.data)
        node = owner.setdefault((can_id, extended, msg.is_remote_frame), node)
        items.append((draw(st.integers(0, 10)) * 100_000, node, msg))
    return sorted(items, key=lambda item: item[0])


def play(
    items: list[tuple[int, int, can.Message]], transmit: Literal["priority", "fifo"] = "priority"
) -> list[tuple[int, WireFrame]]:
    """The recorded frames, each with its index in the traffic; of equal ones the first sent comes first."""
    wire = Wire(500_000, record=True)
    ports = [wire.port(str(k), transmit=transmit) for k in range(4)]
    for t, node, msg in items:
        at(wire, t, partial(ports[node].send, msg))
    wire.run_until(Ns(100 * MS))
    assert outcomes(wire) == ["sent"] * len(items)
    left = [
        (i, (m.arbitration_id, m.is_extended_id, m.is_remote_frame, m.dlc, bytes(m.data), str(node), t))
        for i, (t, node, m) in enumerate(items)
    ]
    found = []
    for one in wire.frames:
        key = (one.can_id, one.extended, one.remote, one.dlc, one.data, one.node, one.queued)
        item = next(item for item in left if item[1] == key)
        left.remove(item)
        found.append((item[0], one))
    return found


def field(one: WireFrame) -> str:
    """Arbitration field as text; characters compare as dominant before recessive."""
    bits = f"{one.can_id:029b}"
    rtr = str(int(one.remote))
    return bits[:11] + "11" + bits[11:] + rtr if one.extended else f"{one.can_id:011b}{rtr}0"


@given(traffic())
@settings(deadline=None)
def test_the_bus_carries_one_frame_at_a_time_the_most_urgent_first_and_never_rests_in_vain(
    items: list[tuple[int, int, can.Message]],
) -> None:
    found = [one for _, one in play(items)]
    for one, after in itertools.pairwise(found):
        assert one.free <= after.started
        assert after.started == max(one.free, min(x.queued for x in found if x.started >= after.started))
    for one in found:
        assert one.free - one.started == one.bits * BIT
        assert one.received == one.free - 3 * BIT
        waiting = [x for x in found if x.queued <= one.started <= x.started]
        assert field(one) == min(field(x) for x in waiting)


@given(traffic())
@settings(deadline=None)
def test_frames_of_one_identifier_and_frames_of_a_queue_keep_their_order(
    items: list[tuple[int, int, can.Message]],
) -> None:
    by_id: dict[str, list[int]] = {}
    for _, one in play(items):
        by_id.setdefault(field(one), []).append(one.queued)
    assert all(queued == sorted(queued) for queued in by_id.values())
    by_node: dict[str, list[int]] = {}
    for index, one in play(items, "fifo"):
        by_node.setdefault(one.node, []).append(index)
    assert all(order == sorted(order) for order in by_node.values())


def test_a_queue_holds_back_what_mailboxes_do_not() -> None:
    orders = {}
    for transmit in ("priority", "fifo"):
        wire = Wire()
        a, b, (_, heard) = wire.port("a", transmit=transmit), wire.port("b"), ear(wire)
        for msg in (frame(0x300), frame(0x100)):
            a.send(msg)
        b.send(frame(0x200))
        wire.run_until(Ns(MS))
        orders[transmit] = ids(heard)
    assert orders == {"priority": [0x100, 0x200, 0x300], "fifo": [0x200, 0x300, 0x100]}


def test_at_one_instant_arrivals_come_before_timers_and_timers_before_arbitration() -> None:
    wire = Wire()
    a, b = wire.port("a"), wire.port("b")
    seen: list[str] = []
    wire.port("ear", lambda msg, now: seen.append(f"{msg.arbitration_id:x}"))
    a.send(frame(0x80))
    free = 51 * BIT
    b.send(frame(0x700))
    at(wire, 48 * BIT, lambda: seen.append("timer"))
    at(wire, free, in_turn(partial(seen.append, "low"), partial(a.send, frame(0x600))))
    at(wire, free, in_turn(partial(seen.append, "high"), partial(b.send, frame(0x10))))
    wire.run_until(Ns(free))
    assert seen == ["80", "timer", "low", "high"]
    wire.run_until(Ns(MS))
    assert seen[4:] == ["10", "600", "700"]


def test_timers_run_once_in_order_unless_cancelled_and_late_ones_at_once() -> None:
    wire = Wire(start=Ns(5))
    seen: list[tuple[str, int]] = []

    def note(name: str) -> None:
        seen.append((name, wire.now))

    gone = wire.call_at(Ns(20), partial(note, "gone"))
    at(wire, 30, partial(note, "b"))
    at(wire, 10, in_turn(partial(note, "a"), partial(at, wire, 3, partial(note, "late"))))
    at(wire, 30, partial(note, "c"))
    gone.cancel()
    wire.run_until(Ns(29))
    assert seen == [("a", 10), ("late", 10)]
    wire.run_until(Ns(7))  # the past is past
    assert wire.now == 29
    wire.run_until(Ns(30))
    assert seen[2:] == [("b", 30), ("c", 30)]


def test_a_wire_without_bit_rate_costs_no_time_and_keeps_the_order_of_sending() -> None:
    wire = Wire(None, record=True)
    a, (b, heard) = wire.port("a"), ear(wire)
    for can_id in (0x300, 0x100, 0x200):
        (b if can_id == 0x100 else a).send(frame(can_id))
    wire.port("echo", lambda msg, now: b.send(frame(0x10)) if msg.arbitration_id == 0x300 else None)
    wire.run_until(Ns(0))
    assert [one.can_id for one in wire.frames] == [0x300, 0x100, 0x200, 0x10]
    assert {(one.queued, one.received, one.free) for one in wire.frames} == {(0, 0, 0)}
    assert ids(heard) == [0x300, 0x200]
    lone = Wire(None)
    lone.port("a").send(frame(1))
    lone.run_until(Ns(0))  # ends: nobody needs to acknowledge
    for nonsense in (lambda: Wire(None, errors=BitErrors(probability=0.1)), lambda: wire.disturb(is_from("a"))):
        with pytest.raises(ValueError, match="no bits to disturb"):
            nonsense()


def test_frames_can_be_lost_delayed_doubled_and_changed() -> None:
    wire = Wire(record=True)
    a, (_, heard) = wire.port("a"), ear(wire)

    def tamper(msg: can.Message, node: str, now: Ns) -> list[tuple[Ns, can.Message]]:
        assert (node, now) == ("a", wire.now)
        original = bytes(msg.data)
        msg.data[:] = b"xx"
        return {
            1: [],
            2: [(Ns(MS), msg)],
            3: [(Ns(0), frame(3, original)), (Ns(2 * MS), frame(3, original))],
            4: [(Ns(0), frame(4))],
        }[msg.arbitration_id]

    wire.tamper = tamper
    sent = [frame(can_id, b"ab") for can_id in (1, 2, 3, 4)]
    for msg in sent:
        a.send(msg)
    assert all(msg.data == b"ab" for msg in sent)
    wire.run_until(Ns(4 * MS))
    assert [(msg.arbitration_id, bytes(msg.data)) for _, msg in heard] == [
        (3, b"ab"),
        (4, b""),
        (2, b"xx"),
        (3, b"ab"),
    ]
    assert [one.queued for one in wire.frames] == [0, 0, MS, 2 * MS]


# ------------------------------------------------------------------------------------------------- errors, bit by bit


def signalled(
    sent: list[int], wrong: int, *, local: bool = False, passive: bool = False, rival: list[int] | None = None
) -> tuple[int, bool]:
    """Error signalling simulated one bit time after the other; end of the error frame, and whether others accept.

    Three nodes drive a wired-and bus: the transmitter 0, a receiver 1, and 2: a receiver that reads the wrong bit when
    it is a local one, else all read it wrong; or a second transmitter, of the frame ``rival``.
    """
    size = len(sent)
    tail = size - 10
    expected = [*sent[:tail], 1, 0, *[1] * 8]
    state = ["frame"] * 3
    count = [0] * 3
    last = [1] * 3
    run = [0] * 3
    accepted = True
    for i in itertools.count():
        out = []
        for node in range(3):
            drive = 1
            if state[node] == "frame" and i < size:
                drive = sent[i] if node == 0 else rival[i] if node == 2 and rival else int(i != tail + 1)
            elif state[node] == "flag":
                drive = int(passive and node == 0)
            out.append(drive)
        bus = min(out)
        for node in range(3):
            seen = bus ^ int(i == wrong and (node == 2 if local else True))
            run[node] = run[node] + 1 if seen == last[node] and i else 1
            last[node] = seen
            if state[node] == "frame":
                form = (node == 0 or i >= tail) and seen != expected[i]
                clash = node == 2 and rival is not None and seen != rival[i]
                if form or clash or (node and i < tail and run[node] == 6):
                    accepted &= node != 1 or i == size - 1
                    state[node], count[node] = "flag", 0
                    if passive and node == 0:
                        run[node] = 0
            elif state[node] == "flag":
                count[node] += 1
                if run[node] >= 6 if passive and node == 0 else count[node] == 6:
                    state[node], count[node] = "delimiter", 0
            elif state[node] == "delimiter":
                count[node] = count[node] + 1 if seen else 0
                if count[node] == 8:
                    state[node] = "done"
        if all(one == "done" for one in state):
            return i + 1, accepted
    raise AssertionError


@pytest.mark.parametrize("text", ["080#", "203#0000000000000000", "7ff#ffffffffffffffff", "123#0102030405060708"])
def test_error_frames_are_as_long_as_bit_by_bit(text: str) -> None:
    can_id, data = text.split("#")
    msg = frame(int(can_id, 16), bytes.fromhex(data))
    sent = levels(msg)
    lengths = set()
    for wrong in range(len(sent)):
        found = broken(msg, wrong)
        assert (found.bits, found.accepted) == signalled(sent, wrong), wrong
        assert found.failed
        lengths.add(found.bits - wrong - 1)
    assert min(lengths) == 6 + 8
    assert max(lengths) <= 12 + 8
    for wrong in range(len(sent) - 8, len(sent) - 1):  # where the others, who read well, first hear of it
        found = broken(msg, wrong, local=True)
        assert (found.bits, found.accepted) == signalled(sent, wrong, local=True), wrong
    for wrong in range(len(sent) - 17):
        found = broken(msg, wrong, flag=1)
        assert (found.bits, found.accepted) == signalled(sent, wrong, passive=True), wrong


@given(st.integers(0, 0x7FF), st.binary(min_size=1, max_size=3), st.binary(min_size=1, max_size=3))
@settings(deadline=None)
def test_error_frames_of_a_doubled_identifier_are_as_long_as_bit_by_bit(can_id: int, one: bytes, other: bytes) -> None:
    wire = Wire(record=True)
    for name, data in (("a", one), ("b", other)):
        wire.port(name).send(frame(can_id, data))
    ear(wire)
    wire.run_until(Ns(MS // 2))
    if one != other:
        sent, rival = levels(frame(can_id, one)), levels(frame(can_id, other))
        bit = next(k for k, (x, y) in enumerate(zip(sent, rival, strict=False)) if x != y)
        if sent[bit]:
            sent, rival = rival, sent
        assert wire.frames[0].free == (signalled(sent, -1, rival=rival)[0] + 3) * BIT
    assert (wire.frames[0].outcome == "sent") is (one == other)


def test_a_disturbed_frame_is_repeated_at_once_and_counted() -> None:
    wire = Wire(record=True)
    a, b, (c, heard) = wire.port("a"), wire.port("b"), ear(wire, "c")
    wire.disturb(is_from("a"), times=2, bit=30)
    a.send(frame(0x203, bytes(8)))
    b.send(frame(0x300))
    wire.run_until(Ns(5 * MS))
    one, two, good, other = wire.frames
    assert [x.outcome for x in wire.frames] == ["error", "error", "sent", "sent"]
    assert [x.attempt for x in wire.frames] == [1, 2, 3, 1]
    assert one.received is None
    assert one.free - one.started == (broken(frame(0x203, bytes(8)), 30).bits + 3) * BIT
    assert [x.started for x in (two, good, other)] == [one.free, two.free, good.free]
    assert len(heard) == 2
    assert (a.tec, a.rec, b.tec, b.rec, c.tec, c.rec) == (16 - 1, 0, 0, 1, 0, 2 - 1 - 1)
    assert wire.busy == other.free


def test_a_more_urgent_frame_gets_between_a_frame_and_its_repetition() -> None:
    wire = Wire(record=True)
    a, b, _ = wire.port("a"), wire.port("b"), ear(wire)
    wire.disturb(is_from("a"))
    a.send(frame(0x203, bytes(8)))
    at(wire, 10 * BIT, lambda: b.send(frame(0x80)))
    wire.run_until(Ns(5 * MS))
    assert [(one.can_id, one.outcome) for one in wire.frames] == [(0x203, "error"), (0x80, "sent"), (0x203, "sent")]


def test_an_error_in_the_very_last_bit_makes_a_frame_arrive_twice() -> None:
    wire = Wire(record=True)
    a, (b, heard) = wire.port("a"), ear(wire)
    wire.disturb(is_from("a"), bit=10_000)
    a.send(frame(0x80, b"x"))
    wire.run_until(Ns(MS))
    assert ids(heard) == [0x80, 0x80]
    assert heard[0][1].timestamp < heard[1][1].timestamp
    assert outcomes(wire) == ["error", "sent"]
    assert (a.tec, b.rec) == (7, 0)


@pytest.mark.parametrize(
    ("bit", "copies", "counts"),
    [
        # The others: error, error, twice; b, who reads wrong, counts 1 + 8 and then a good frame.
        (20, (1, 1), (7, 8, 0)),
        (-2, (1, 2), (7, 8, 0)),  # last but one: only b refuses the frame
        (-1, (1, 1), (0, 0, 0)),  # last: b has accepted it
    ],
)
def test_one_receiver_alone_reads_wrong(bit: int, copies: tuple[int, int], counts: tuple[int, int, int]) -> None:
    wire = Wire(record=True)
    a, (b, heard_b), (c, heard_c) = wire.port("a"), ear(wire, "b"), ear(wire, "c")
    msg = frame(0x80, b"x")
    wire.disturb(is_from("a"), bit=bit % len(levels(msg)), at="b")
    a.send(msg)
    wire.run_until(Ns(MS))
    if counts[0]:  # the flag stands behind the acknowledge delimiter, or behind the wrong bit if that is later
        sent = levels(msg)
        wrong = max(bit % len(sent), len(sent) - 8)
        assert wire.frames[0].free == (signalled(sent, wrong, local=True)[0] + 3) * BIT
    assert (len(heard_b), len(heard_c)) == copies
    assert (a.tec, b.rec, c.rec) == counts


def test_the_only_receiver_withholds_its_acknowledgement() -> None:
    wire = Wire(record=True)
    a, (b, heard) = wire.port("a"), ear(wire, "b")
    msg = frame(0x80, b"x")
    wire.disturb(is_from("a"), at="b")
    a.send(msg)
    wire.run_until(Ns(MS))
    # Up to the acknowledge slot, ninth from the end; flag, delimiter and intermission.
    assert wire.frames[0].free == (len(levels(msg)) - 8 + 6 + 8 + 3) * BIT
    assert (len(heard), a.tec, b.rec) == (1, 7, 0)


def test_an_error_passive_receiver_loses_a_frame_that_the_others_get() -> None:
    wire = Wire(record=True)
    a, (b, heard_b), (_, heard_c) = wire.port("a"), ear(wire, "b"), ear(wire, "c")
    b.counters.rec = 130
    wire.port("d")  # joins, so that the wire looks at the counters again
    wire.disturb(is_from("a"), at="b")
    a.send(frame(0x80))
    a.send(frame(0x81))
    wire.run_until(Ns(MS))
    assert outcomes(wire) == ["sent", "sent"]
    assert [ids(heard_c), [can_id for can_id in ids(heard_b) if can_id < 0x200]] == [[0x80, 0x81], [0x81]]
    assert (a.tec, b.rec, b.state) == (0, 127, can.BusState.ACTIVE)  # 131, then back by a good frame


def run_noisy(seed: int, *, probability: float = 3e-4, local: float = 0.0, count: int = 3000) -> tuple[Wire, Heard]:
    wire = Wire(errors=BitErrors(probability=probability, local=local), seed=seed, record=True)
    ports = [wire.port(f"n{k}") for k in range(3)]
    _, heard = ear(wire)
    rng = random.Random(seed)
    for k in range(count):
        node = rng.randrange(3)
        at(wire, k * 150 * BIT * 1.3, partial(ports[node].send, frame(node << 8 | k % 256, k.to_bytes(8, "big"))))
    wire.run_until(Ns(3 * MS + count * 150 * BIT * 2))
    return wire, heard


def test_bits_are_wrong_as_often_as_the_law_says_and_no_frame_is_lost() -> None:
    wire, heard = run_noisy(1)
    expected = sum(1 - (1 - 3e-4) ** (one.bits - 3) for one in wire.frames)
    errors = outcomes(wire).count("error")
    assert abs(errors - expected) < 3 * expected**0.5  # about Poisson
    assert expected > 90
    data = [bytes(msg.data) for _, msg in heard if not msg.is_error_frame]
    assert set(data) == {k.to_bytes(8, "big") for k in range(3000)}
    twice = [one for one in wire.frames if one.outcome == "error" and one.received is not None]
    assert len(data) == 3000 + len(twice)


def test_the_same_seed_gives_the_same_errors() -> None:
    runs = [run_noisy(seed, count=500)[0].frames for seed in (5, 5, 6)]
    assert runs[0] == runs[1]
    assert [one.outcome for one in runs[0]] != [one.outcome for one in runs[2]]


@pytest.mark.parametrize("seed", range(3))
def test_error_counters_follow_from_what_happened(seed: int) -> None:
    wire, _ = run_noisy(seed, probability=6e-4, count=1000)
    count = {name: [0, 0] for name in ("n0", "n1", "n2", "ear")}
    for one in wire.frames:
        for name, both in count.items():
            good = one.received is not None
            if name == one.node:
                both[0] = max(0, both[0] - 1) if one.outcome == "sent" else both[0] + 8
            else:
                both[1] = max(0, both[1] - 1) if good else both[1] + 1
    assert max(tec for tec, _ in count.values()) > 0
    ports = {port.name: [port.tec, port.rec] for port in wire._ports}
    assert ports == count


def test_errors_seen_by_one_receiver_lose_no_frame_either() -> None:
    wire, heard = run_noisy(4, local=1.0, count=1000)
    data = {bytes(msg.data) for _, msg in heard if not msg.is_error_frame}
    assert data == {k.to_bytes(8, "big") for k in range(1000)}
    assert outcomes(wire).count("error") > 20


def test_a_law_of_certain_error_and_of_none() -> None:
    wire = Wire(errors=BitErrors(probability=1), record=True)
    a, _ = wire.port("a"), ear(wire)
    assert wire.errors == BitErrors(probability=1)
    a.send(frame(1))
    wire.run_until(Ns(MS // 10))
    assert set(outcomes(wire)) == {"error"}
    wire.errors = None
    assert wire.errors is None
    wire.run_until(Ns(2 * MS))
    assert outcomes(wire)[-1] == "sent"
    for nonsense in ({"probability": 1.1}, {"probability": -0.1}, {"probability": 0.1, "local": 2}):
        with pytest.raises(ValueError, match="between 0 and 1"):
            BitErrors(**nonsense)


# ---------------------------------------------------------------------------------------------------- fault confinement


def test_sixteen_errors_make_a_node_passive_and_sixteen_more_bus_off() -> None:
    wire = Wire(record=True)
    told: Heard = []
    a, (b, heard) = wire.port("a", lambda msg, now: told.append((now, msg))), ear(wire)
    wire.disturb(is_from("a"), times=32)
    for k in range(3):
        a.send(frame(0x100 + k))
    wire.run_until(Ns(20 * MS))
    errors = [one for one in wire.frames if one.outcome == "error"]
    assert len(errors) == 32
    gaps = [after.started - one.free for one, after in itertools.pairwise(errors)]
    assert gaps == [0] * 15 + [8 * BIT] * 16  # suspended once passive
    assert (a.tec, a.state, b.rec, b.state) == (256, can.BusState.ERROR, 32, can.BusState.ACTIVE)
    assert outcomes(wire)[32:] == ["discarded"] * 3
    assert heard == []
    assert [(msg.is_error_frame, msg.arbitration_id, msg.data[1], msg.data[6]) for _, msg in told] == [
        (True, 0x204, 0x20, 128),
        (True, 0x240, 0, 255),
    ]
    assert [now for now, _ in told] == [errors[15].free - 3 * BIT, errors[31].free - 3 * BIT]
    with pytest.raises(can.CanOperationError, match="a is bus-off"):
        a.send(frame(1))
    b.send(frame(5))
    wire.run_until(Ns(21 * MS))
    assert len(told) == 2  # deaf as well


def test_a_pause_of_the_passive_lets_others_go_first_and_ends_with_their_frame() -> None:
    wire = Wire(record=True)
    a, b, _ = wire.port("a"), wire.port("b"), ear(wire)
    wire.disturb(is_from("a"), times=16)
    a.send(frame(0x10))
    wire.run_until(Ns(5 * MS))
    assert a.state is can.BusState.ACTIVE  # 128 - 1
    a.counters.tec = 200
    start = wire.now
    a.send(frame(0x10))
    a.send(frame(0x11))
    b.send(frame(0x700))
    wire.run_until(Ns(start + MS))
    first, second, third = wire.frames[-3:]
    assert [one.can_id for one in (first, second, third)] == [0x10, 0x700, 0x11]
    assert (second.started, third.started) == (first.free, second.free)


def test_a_frame_queued_during_the_pause_of_another_need_not_wait() -> None:
    wire = Wire(record=True)
    a, b, _ = wire.port("a"), wire.port("b"), ear(wire)
    wire.disturb(is_from("a"), times=17)
    a.send(frame(0x10))
    while len(wire.frames) < 16:
        wire.run_until(Ns(wire.now + BIT))
    free = wire.frames[-1].free
    at(wire, free + 5 * BIT, lambda: b.send(frame(0x700)))
    wire.run_until(Ns(20 * MS))
    after = wire.frames[16:]
    assert [(one.can_id, one.started) for one in after[:2]] == [(0x700, free + 5 * BIT), (0x10, after[0].free)]


def recessive_sequences(frames: list[WireFrame], start: int, end: int) -> int:
    """Runs of eleven recessive bits between two instants, counted on the bits of the recorded frames."""
    line = [1] * ((end - start) // BIT)
    for one in frames:
        if one.started >= start and one.outcome == "sent":
            msg = can.Message(arbitration_id=one.can_id, is_extended_id=one.extended, data=one.data)
            drawn = levels(msg)
            drawn[-9] = 0  # acknowledged
            first = (one.started - start) // BIT
            line[first : first + len(drawn)] = drawn[: max(0, len(line) - first)]
    found = run = 0
    for bit in line:
        run = run + 1 if bit else 0
        if run == 11:
            found, run = found + 1, 0
    return found


@pytest.mark.parametrize("automatic", [True, False])
@pytest.mark.parametrize("busy", [True, False])
def test_bus_off_ends_after_128_times_eleven_recessive_bits(automatic: bool, busy: bool) -> None:
    wire = Wire(record=True)
    told: Heard = []
    a = wire.port("a", lambda msg, now: told.append((now, msg)), recovers=automatic)
    b, _ = wire.port("b"), ear(wire)
    wire.disturb(is_from("a"), times=32)
    a.send(frame(0x10))
    while a.state is not can.BusState.ERROR:
        wire.run_until(Ns(wire.now + BIT))
    begin = int(wire.frames[31].free)
    if not automatic:
        wire.run_until(Ns(begin + 5 * MS))
        assert a.state is can.BusState.ERROR
        begin = int(wire.now)
        a.recover()
        a.recover()  # once is enough
    if busy:
        for k in range(150):
            at(wire, begin + (1 + k * 110 + k * k % 37) * BIT, lambda: b.send(frame(0x123, b"12")))
    while a.state is can.BusState.ERROR:
        wire.run_until(Ns(wire.now + BIT))
    (end, last) = told[-1]
    assert (last.arbitration_id, a.tec, a.rec) == (0x300, 0, 0)
    missing = 127 if automatic else 128  # the delimiter and intermission after the last error frame are a sequence
    if busy:
        assert recessive_sequences(wire.frames, begin, end) == missing
        assert recessive_sequences(wire.frames, begin, end - BIT) == missing - 1
    else:
        assert end == begin + missing * 11 * BIT
    a.send(frame(0x10))
    sent = wire.now
    wire.run_until(Ns(sent + 5 * MS))
    assert [one.outcome for one in wire.frames if one.node == "a"][-1] == "sent"


def test_recovery_asked_for_while_a_frame_is_on_the_wire_counts_from_its_end() -> None:
    wire = Wire(record=True)
    a, b, _ = wire.port("a"), wire.port("b"), ear(wire)
    wire.disturb(is_from("a"), times=32)
    a.send(frame(0x10))
    wire.run_until(Ns(20 * MS))
    b.send(frame(1, bytes(8)))
    wire.run_until(Ns(wire.now + 20 * BIT))
    a.recover()
    while a.state is can.BusState.ERROR:
        wire.run_until(Ns(wire.now + BIT))
    assert wire.now == wire.frames[-1].free + 127 * 11 * BIT
    b.recover()  # not bus-off: nothing
    assert b.state is can.BusState.ACTIVE


def test_alone_on_the_bus_a_node_repeats_and_becomes_passive_but_never_bus_off() -> None:
    wire = Wire(record=True)
    a = wire.port("a")
    a.send(frame(0x123))
    wire.run_until(Ns(50 * MS))
    assert len(wire.frames) > 300
    assert set(outcomes(wire)) == {"error"}
    assert (a.tec, a.state) == (128, can.BusState.PASSIVE)
    _, heard = ear(wire)
    wire.run_until(Ns(51 * MS))
    assert ids(heard) == [0x123]
    assert a.tec == 127


def test_counters_come_back_and_a_passive_receiver_by_one_good_frame() -> None:
    wire = Wire()
    a, (b, _) = wire.port("a"), ear(wire)
    a.counters.tec, b.counters.rec = 3, 200
    wire.port("c")
    assert b.state is can.BusState.PASSIVE
    for k in range(5):
        a.send(frame(k))
    wire.run_until(Ns(MS))
    assert (a.tec, b.rec, b.state) == (0, 127 - 4, can.BusState.ACTIVE)


def test_one_identifier_from_two_nodes_is_an_error_of_both_until_one_gives_way() -> None:
    wire = Wire(record=True)
    a, b, (c, heard) = wire.port("a"), wire.port("b"), ear(wire)
    a.send(frame(0x123, b"\x00"))
    b.send(frame(0x123, b"\x01"))
    wire.run_until(Ns(10 * MS))
    together = wire.frames[:32]
    assert {one.outcome for one in together} == {"error"}
    assert len({one.started for one in together}) == 16
    # Both are passive now. b, who sends the first recessive bit, gives way; a gets through; then b does.
    assert [(one.node, one.outcome) for one in wire.frames[32:]] == [("a", "sent"), ("b", "error"), ("b", "sent")]
    assert [bytes(msg.data) for _, msg in heard if not msg.is_error_frame] == [b"\x00", b"\x01"]
    assert (a.tec, b.tec, c.rec) == (128 - 1, 128 + 8 - 1, 16 - 2)


def test_equal_frames_of_two_nodes_are_one_on_the_wire() -> None:
    wire = Wire(record=True)
    (a, heard_a), (b, heard_b), (_, heard) = ear(wire, "a"), ear(wire, "b"), ear(wire, "c")
    for port in (a, b):
        port.send(frame(0x123, b"same"))
    wire.run_until(Ns(MS))
    assert [(one.node, one.outcome, one.started) for one in wire.frames] == [("a", "sent", 0), ("b", "sent", 0)]
    assert (len(heard_a), len(heard_b), len(heard)) == (0, 0, 1)
    assert wire.busy == wire.frames[0].bits * BIT


def test_two_nodes_that_keep_one_identifier_go_bus_off() -> None:
    """Fault of a doubled node id: both produce heartbeats with different states at the same instants."""
    wire = Wire()
    a, b, _ = wire.port("a"), wire.port("b"), ear(wire)

    def beat(port: WirePort, state: int) -> None:
        if port.state is not can.BusState.ERROR:
            port.send(frame(0x703, bytes([state])))

    for k in range(40):
        at(wire, k * 20 * MS, partial(beat, a, 5))
        at(wire, k * 20 * MS, partial(beat, b, 0x7F))
    wire.run_until(Ns(900 * MS))
    assert can.BusState.ERROR in (a.state, b.state)


# ------------------------------------------------------------------------------------------------------- python-can API


def test_recv_moves_simulated_time_up_to_the_frame_or_the_timeout() -> None:
    wire = Wire()
    a, b = wire.port("a"), wire.port("b")
    at(wire, MS, lambda: b.send(frame(0x80)))
    assert a.recv(0.0005) is None
    assert wire.now == MS // 2
    got = a.recv(0.01)
    assert got is not None
    assert wire.now == MS + 48 * BIT == round(got.timestamp * 1e9)
    assert a.recv(0) is None
    assert wire.now == MS + 48 * BIT
    b.send(frame(1))
    b.send(frame(2))
    assert [msg.arbitration_id for msg in (a.recv(), a.recv()) if msg] == [1, 2]
    with pytest.raises(can.CanOperationError, match="nothing is left to happen"):
        a.recv()


def test_a_request_is_answered_within_recv() -> None:
    wire = Wire()
    client = wire.port("client")
    server = wire.port("server", lambda msg, now: server.send(frame(0x583, bytes(msg.data))))
    client.send(frame(0x603, b"ping"))
    answer = client.recv(1)
    assert answer is not None
    assert (answer.arbitration_id, bytes(answer.data)) == (0x583, b"ping")


def test_filters_are_honoured_by_recv_and_by_listeners() -> None:
    wire = Wire()
    a = wire.port("a")
    masks: can.typechecking.CanFilters = [{"can_id": 0x180, "can_mask": 0x780, "extended": False}]
    b = wire.port("b", can_filters=masks)
    c, heard = ear(wire)
    c.set_filters([{"can_id": 0x200, "can_mask": 0x7FF}])
    for msg in (frame(0x183), frame(0x183, extended=True), frame(0x200), frame(0x1FF)):
        a.send(msg)
    got = list(iter(lambda: b.recv(0.01), None))
    assert [(msg.arbitration_id, msg.is_extended_id) for msg in got] == [(0x183, False), (0x1FF, False)]
    assert ids(heard) == [0x200]
    b.filters = None
    a.send(frame(0x300))
    assert b.recv(1) is not None


def test_periodic_sending_needs_no_thread() -> None:
    wire = Wire()
    a, (_, heard) = wire.port("a"), ear(wire)
    task = a.send_periodic(frame(0x80), 0.010, duration=0.045)
    assert isinstance(task, can.ModifiableCyclicTaskABC)
    other = a.send_periodic([frame(0x90, b"0"), frame(0x90, b"1")], 0.010, autostart=False)
    wire.run_until(Ns(25 * MS))
    task.modify_data(frame(0x80, b"new"))
    wire.run_until(Ns(100 * MS))
    assert [(now - 1) // MS for now, _ in heard] == [0, 10, 20, 30, 40]
    assert [bytes(msg.data) for _, msg in heard] == [b"", b"", b"", b"new", b"new"]
    assert isinstance(other, can.RestartableCyclicTaskABC)
    other.start()
    wire.run_until(Ns(125 * MS))
    other.stop()
    wire.run_until(Ns(200 * MS))
    assert [bytes(msg.data) for _, msg in heard[5:]] == [b"0", b"1", b"0"]
    with pytest.raises(ValueError, match="period"):
        a.send_periodic(frame(1), 0)


def test_a_periodic_frame_can_be_changed_each_time_and_pauses_in_bus_off() -> None:
    wire = Wire()
    a, (_, heard) = wire.port("a", recovers=True), ear(wire)

    def count(msg: can.Message) -> None:
        msg.data[0] += 1

    a.send_periodic(frame(0x80, b"\x00"), 0.001, modifier_callback=count)
    wire.run_until(Ns(9 * MS // 2))
    wire.disturb(is_from("a"), times=32)
    wire.run_until(Ns(41 * MS // 2))
    values = [msg.data[0] for _, msg in heard]
    assert values[:5] == [1, 2, 3, 4, 5]
    assert values[5:] == list(range(values[5], 22))
    assert 8 < values[5] < 15
    a.shutdown()
    wire.run_until(Ns(30 * MS))
    assert len(heard) == len(values)


def test_the_same_program_on_python_can_virtual_and_on_the_wire() -> None:
    def program(one: can.BusABC, two: can.BusABC) -> list[tuple[int, bool, bool, bytes, bool]]:
        two.set_filters([{"can_id": 0, "can_mask": 0x4}])
        for msg in (frame(3, b"abc"), frame(4), frame(2, extended=True), remote(1, 8)):
            one.send(msg, timeout=0.1)
        got = list(iter(lambda: two.recv(0.01), None))
        return [(m.arbitration_id, m.is_extended_id, m.is_remote_frame, bytes(m.data), m.is_rx) for m in got]

    wire = Wire(None)
    with wire.port("one") as ours_one, wire.port("two") as ours_two:
        ours = program(ours_one, ours_two)
    with can.Bus(interface="virtual", channel="x") as one, can.Bus(interface="virtual", channel="x") as two:
        theirs = program(one, two)
    assert ours == theirs
    assert len(ours) == 3


def test_a_port_closes_quietly_and_can_come_back(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    wire = Wire(record=True)
    a, (b, heard) = wire.port("a"), ear(wire)
    with pytest.raises(ValueError, match="'a'"):
        wire.port("a")
    with pytest.raises(ValueError, match="'priority' or 'fifo'"):
        wire.port("z", transmit="best")  # type: ignore[arg-type]
    a.send(frame(1, bytes(8)))
    a.send(frame(2))
    wire.run_until(Ns(10 * BIT))
    a.shutdown()
    a.shutdown()
    with pytest.raises(can.CanOperationError, match="a is shut down"):
        a.send(frame(3))
    with pytest.raises(can.CanOperationError, match="a is shut down"):
        a.recv(0)
    again = wire.port("a")
    wire.run_until(Ns(MS))
    assert ids(heard) == [1]  # it was on the wire; the other was not
    assert sorted(outcomes(wire)) == ["discarded", "sent"]
    again.send(frame(4))
    wire.run_until(Ns(2 * MS))
    assert ids(heard) == [1, 4]
    with pytest.raises(NotImplementedError):
        b.state = can.BusState.PASSIVE
    del wire, a, again, b
    gc.collect()
    assert [record for record in caplog.records if record.levelno >= logging.INFO] == []


def test_flushing_forgets_what_is_queued_but_not_what_is_on_the_wire() -> None:
    wire = Wire(record=True)
    a, (_, heard) = wire.port("a", transmit="fifo"), ear(wire)
    for can_id in (1, 2, 3):
        a.send(frame(can_id))
    wire.run_until(Ns(10 * BIT))
    a.flush_tx_buffer()
    a.send(frame(4))
    wire.run_until(Ns(MS))
    assert ids(heard) == [1, 4]
    assert [(one.can_id, one.outcome) for one in wire.frames[:2]] == [(2, "discarded"), (3, "discarded")]


def test_nobody_can_wait_on_the_wire_while_it_runs() -> None:
    wire = Wire()
    a, b = wire.port("a"), wire.port("b", lambda msg, now: wire.run_until(Ns(MS)))
    a.send(frame(1))
    with pytest.raises(RuntimeError, match="running"):
        wire.run_until(Ns(MS))
    b.listener = None
    a.send(frame(2))
    assert b.recv(1) is not None  # the wire is not stuck


@pytest.mark.parametrize("msg", [can.Message(arbitration_id=0x800, is_extended_id=False), can.Message(is_fd=True)])
def test_a_frame_that_is_none_is_refused_when_sent(msg: can.Message) -> None:
    wire = Wire()
    a, (_, heard) = wire.port("a"), ear(wire)
    with pytest.raises(ValueError, match=r"identifier|frame"):
        a.send(msg)
    wire.run_until(Ns(MS))
    assert heard == []


@pytest.mark.parametrize("bit_rate", [0, -1])
def test_a_wire_needs_a_bit_rate_above_zero(bit_rate: int) -> None:
    with pytest.raises(ValueError, match="bit rate"):
        Wire(bit_rate)
