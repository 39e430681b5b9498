"""A drive on a simulated joint: stops, brake, supervision, faults; and that it never moves when it may not."""

import contextlib
import math
import time
from typing import Any

import pytest
from bus_rig import JOINT, MDEG, MS, Bench, Profile
from hypothesis import given, settings
from hypothesis import strategies as st

from lwa4d_sim.bus import alarms
from lwa4d_sim.bus.cia402 import State, state_of
from lwa4d_sim.bus.device import Device, Loss
from lwa4d_sim.bus.entry import Abort
from lwa4d_sim.interfaces import Ns

BOTH = pytest.mark.parametrize("profile", ["cia402", "lwa4d"])
SPEED = 30_000  # mdeg/s


def moving(
    profile: Profile = "cia402", *, speed: int = SPEED, objects: dict[int, int] | None = None, **options: Any
) -> Bench:
    """An axis that has been moving at constant speed for a while, in velocity mode."""
    bench = Bench(profile, q=-1.5, **options)
    for index, value in (objects or {}).items():
        bench.set(index, 0, value)
    bench.enable(2, 0x7F)
    bench.set(0x6042, 0, speed)
    bench.run(600)
    assert bench.dq == pytest.approx(speed / MDEG, rel=0.03)
    return bench


def deceleration(bench: Bench, begin: int) -> float:
    """Slope of the joint's speed [mdeg/s^2] between nine and three tenths of what it was at ``begin``."""
    first = bench.log[begin - 1][2]
    span = [(ms, dq) for ms, _, dq, _, _ in bench.log[begin:] if 0.3 * first < dq < 0.9 * first]
    (t0, v0), (t1, v1) = span[0], span[-1]
    return (v0 - v1) / (t1 - t0) * 1000 * MDEG


def settled(bench: Bench) -> bool:
    return bench.drive.braked


def test_the_drive_is_a_device() -> None:
    device: Device = Bench().drive
    device.reset(Ns(0))


@BOTH
def test_it_wakes_up_with_closed_brake_and_answers_to_the_profile(profile: Profile) -> None:
    bench = Bench(profile)
    bench.run(100)
    assert (bench.state, bench.drive.braked, bench.drive.steady) == (State.SWITCH_ON_DISABLED, True, True)
    assert bench.q == 0.3
    assert bench.get(0x6064) == round(0.3 * MDEG)
    # bit 9, remote, is not used by the firmware, which says "referenced" in bit 15
    assert (bench.bit(9), bench.bit(15)) == ((True, False) if profile == "cia402" else (False, True))
    assert bench.bit(4)


@BOTH
def test_only_an_enabled_axis_is_let_go(profile: Profile) -> None:
    bench = Bench(profile)
    bench.set(0x6060, 0, 1)
    for word, state, braked in (
        (0x06, State.READY, True),
        (0x07, State.SWITCHED_ON, True),
        (0x0F, State.OPERATION_ENABLED, False),
        (0x07, State.SWITCHED_ON, True),
        (0x0F, State.OPERATION_ENABLED, False),
        (0x06, State.READY, True),
        (0x00, State.SWITCH_ON_DISABLED, True),
    ):
        bench.word(word)
        bench.run(300)
        assert (bench.state, bench.drive.braked) == (state, braked)
    assert bench.q == pytest.approx(0.3, abs=2e-3)


# stops

RAMPS = {"slow": 60_000, "quick": 150_000, "limit": JOINT.torque / 0.6 * MDEG}


@pytest.mark.parametrize(
    ("code", "ramp", "end"),
    [
        (0, None, State.SWITCH_ON_DISABLED),
        (1, "slow", State.SWITCH_ON_DISABLED),
        (2, "quick", State.SWITCH_ON_DISABLED),
        (3, "limit", State.SWITCH_ON_DISABLED),
        (4, "limit", State.SWITCH_ON_DISABLED),
        (5, "slow", State.QUICK_STOP),
        (6, "quick", State.QUICK_STOP),
        (7, "limit", State.QUICK_STOP),
        (8, "limit", State.QUICK_STOP),
    ],
)
def test_quick_stop_goes_by_605a(code: int, ramp: str | None, end: State) -> None:
    bench = moving(objects={0x605A: code, 0x6084: 60_000, 0x6085: 150_000})
    begin = bench.now
    state = bench.word(0x02)
    if ramp is None:
        assert (state, bench.drive.braked) == (end, True)
        return
    assert (state, bench.drive.braked) == (State.QUICK_STOP, False)
    took = bench.until(lambda: settled(bench))
    assert bench.state is end
    if ramp != "limit":
        assert deceleration(bench, begin) == pytest.approx(RAMPS[ramp], rel=0.08)
        assert took == pytest.approx(SPEED / RAMPS[ramp] * 1000, abs=60)
    else:
        assert took < 60
    assert abs(bench.log[-2][2]) < 0.02  # it stood when the brake closed
    if end is State.QUICK_STOP:
        assert bench.bit(10)
        bench.word(0x06)
        assert bench.state is State.QUICK_STOP
        after = bench.word(0x7F)
        assert after is State.OPERATION_ENABLED
        bench.run(400)
        assert bench.dq == pytest.approx(SPEED / MDEG, rel=0.05)


@pytest.mark.parametrize(
    ("index", "word", "end"), [(0x605B, 0x06, State.READY), (0x605C, 0x07, State.SWITCHED_ON), (0x605D, 0x17F, None)]
)
@pytest.mark.parametrize("code", [0, 1, 2])
def test_shutdown_disable_and_halt_go_by_their_options(index: int, word: int, end: State | None, code: int) -> None:
    if (index, code) in ((0x605D, 0), (0x605B, 2), (0x605C, 2)):
        return  # no such options
    bench = moving(objects={index: code, 0x6084: 60_000, 0x6085: 150_000})
    begin = bench.now
    state = bench.word(word)
    if code == 0:
        assert (state, bench.drive.braked) == (end, True)
        return
    assert (state, bench.drive.braked) == (State.OPERATION_ENABLED, False)  # until it stands
    bench.until(lambda: settled(bench) if end else bench.bit(10))
    assert deceleration(bench, begin) == pytest.approx(60_000 if code == 1 else 150_000, rel=0.08)
    assert bench.state is (end or State.OPERATION_ENABLED)
    if end is None:
        q = bench.q
        bench.run(500)
        assert not bench.drive.braked
        assert bench.q == pytest.approx(q, abs=1e-3)


@pytest.mark.parametrize(("code", "rate"), [(0, None), (1, 60_000), (2, 150_000)])
def test_a_fault_stops_by_605e(code: int, rate: int | None) -> None:
    bench = moving(objects={0x605E: code, 0x6084: 60_000, 0x6085: 150_000})
    begin = bench.now
    bench.drive.fail(0x2310)
    assert bench.errors == [(0x2310, 0x03)]
    assert bench.get(0x603F) == 0x2310
    if rate is None:
        assert (bench.state, bench.drive.braked) == (State.FAULT, True)
        return
    assert (bench.state, bench.drive.braked) == (State.FAULT_REACTION, False)
    bench.until(lambda: bench.state is State.FAULT)
    assert bench.drive.braked
    assert deceleration(bench, begin) == pytest.approx(rate, rel=0.08)


@pytest.mark.parametrize("word", [0x02, 0x06, 0x07, 0x17F])
def test_the_firmware_always_ramps_quickly_and_brakes(word: int) -> None:
    bench = moving("lwa4d")
    begin = bench.now
    bench.word(word)
    bench.until(lambda: settled(bench))
    assert deceleration(bench, begin) == pytest.approx(JOINT.acceleration * MDEG, rel=0.1)
    assert (
        bench.state
        is {
            0x02: State.SWITCH_ON_DISABLED,
            0x06: State.READY,
            0x07: State.SWITCHED_ON,
            0x17F: State.OPERATION_ENABLED,
        }[word]
    )


def test_an_axis_driven_by_torque_with_open_loops_stops_on_the_ramp_all_the_same() -> None:
    bench = Bench("lwa4d", q=-1.5, gravity=3.0)
    for index in (0x2020, 0x2030):
        bench.set(index, 0, 0.0)
    bench.set(0x60B2, 0, 500)
    bench.enable(7, 0x1F)
    bench.until(lambda: bench.dq > 0.6)
    begin = bench.now
    assert bench.word(0x02) is State.QUICK_STOP
    bench.until(lambda: settled(bench), 600)
    assert deceleration(bench, begin) == pytest.approx(JOINT.acceleration * MDEG, rel=0.2)
    assert abs(bench.log[-2][2]) < 0.02


@pytest.mark.parametrize("mode", [4, 10])
def test_a_torque_mode_stops_on_the_ramp(mode: int) -> None:
    bench = Bench(q=-1.5, gravity=3.0)
    bench.set(0x6087, 0, 100_000)
    bench.enable(mode)
    bench.set(0x6071, 0, 125)
    bench.until(lambda: bench.dq > 0.6)
    begin = bench.now
    assert bench.word(0x02) is State.QUICK_STOP
    bench.until(lambda: settled(bench), 600)
    assert deceleration(bench, begin) == pytest.approx(JOINT.acceleration * MDEG, rel=0.2)


@BOTH
def test_disable_voltage_takes_torque_and_brake_at_once(profile: Profile) -> None:
    bench = moving(profile)
    bench.word(0x00)
    assert (bench.state, bench.drive.braked) == (State.SWITCH_ON_DISABLED, True)
    assert bench.drive.torque(Ns(bench.now * MS), 0.001) == 0.0


def test_a_ramp_down_that_is_called_off_goes_on() -> None:
    bench = moving(objects={0x6084: 30_000})
    bench.word(0x07)
    bench.run(300)
    assert 0.2 < bench.dq < 0.45
    bench.word(0x7F)
    bench.run(600)
    assert bench.dq == pytest.approx(SPEED / MDEG, rel=0.03)
    assert bench.state is State.OPERATION_ENABLED


def test_an_axis_that_cannot_stop_is_braked_in_the_end_and_told_of_once() -> None:
    bench = moving()
    bench.load = 100.0  # more than the motor can hold
    bench.word(0x02)
    took = bench.until(lambda: settled(bench))
    # a second and a ramp, begun anew when the speed makes it a fault
    assert 1000 < took < 1000 + 1000 + 500
    assert bench.errors == [(0x8400, 0x21)]
    assert bench.state is State.FAULT


def test_stopping_and_going_on_take_over_the_torque_without_a_sag() -> None:
    bench = Bench(q=0.3)
    bench.set(0x605D, 0, 2)
    weight = round(bench.gravity * math.cos(0.3) / JOINT.torque * 1000)
    bench.set(0x6071, 0, weight)
    bench.enable(10)
    bench.run(20)
    q = bench.q
    bench.word(0x10F)  # from a torque mode to the loops
    bench.run(300)
    assert min(q for _, q, *_ in bench.log[-300:]) == pytest.approx(q, abs=4e-4)  # gravity alone would make it 17e-4
    bench.word(0x00)
    bench.set(0x6060, 0, 1)
    for word in (0x06, 0x07):
        bench.word(word)
    bench.run(50)
    q = bench.q
    bench.word(0x0F)
    bench.run(300)
    assert min(q for _, q, *_ in bench.log[-300:]) < q - 6e-4  # voltage was cut: nothing is known of the weight
    bench.word(0x07)
    bench.until(lambda: settled(bench))
    q = bench.q
    bench.word(0x0F)
    bench.run(300)
    assert min(q for _, q, *_ in bench.log[-300:]) == pytest.approx(q, abs=4e-4)


def test_a_stop_begins_where_the_reference_is() -> None:
    bench = moving()
    bench.set(0x2030, 0, 3.0)  # a soft position loop, far behind
    bench.set(0x2034, 0, 0.0)
    bench.set(0x6065, 0, 0xFFFF_FFFF)
    bench.run(300)
    before, behind = bench.get(0x6062), bench.get(0x60F4)
    assert behind > 5_000
    bench.word(0x17F)
    bench.run(1)
    assert bench.get(0x6062) - before == pytest.approx(SPEED / 1000, abs=5)


# brake


@BOTH
def test_the_brake_may_take_time_and_nothing_moves_until_then(profile: Profile) -> None:
    bench = Bench(profile, brake_delay=0.08)
    bench.set(0x6060, 0, 1)
    bench.set(0x607A, 0, 40_000)
    for word in (0x06, 0x07, 0x1F):
        bench.word(word)
    assert not bench.drive.steady
    bench.run(79)
    assert (bench.drive.braked, bench.q) == (True, 0.3)
    bench.run(20)
    assert not bench.drive.braked
    assert bench.bit(12)  # the move asked for when it was enabled begins then
    bench.until(lambda: bench.bit(10))
    assert bench.get(0x6064) == pytest.approx(40_000, abs=100)


def test_a_brake_that_is_told_to_close_while_it_opens_stays_closed() -> None:
    bench = Bench(brake_delay=0.08)
    bench.enable(1)
    bench.run(40)
    bench.word(0x02)
    bench.run(100)
    assert (bench.state, bench.drive.braked, bench.q) == (State.SWITCH_ON_DISABLED, True, 0.3)


def test_a_broken_brake_lets_the_joint_fall() -> None:
    bench = Bench()
    bench.run(50)
    assert bench.dq == 0.0
    bench.drive.brake_works = False
    bench.run(200)
    assert bench.q < 0.1
    assert {tau for _, _, _, tau, _ in bench.log} == {0.0}


@BOTH
def test_the_brake_opens_by_hand_only_out_of_control(profile: Profile) -> None:
    bench = Bench(profile)
    bench.set(0x60FE, 1, 0)
    assert bench.drive.braked  # not without the mask
    bench.set(0x60FE, 2, 1)
    assert not bench.drive.braked
    bench.run(50)
    assert bench.q < 0.3
    bench.set(0x60FE, 1, 1)
    assert bench.drive.braked
    bench.set(0x60FE, 1, 0)
    bench.enable(1)
    bench.word(0x00)
    assert bench.drive.braked  # who takes control ends the release
    bench.enable(1)
    bench.set(0x60FE, 1, 1)
    bench.set(0x60FE, 1, 0)
    bench.word(0x00)
    assert bench.drive.braked


# supervision


@BOTH
def test_a_stuck_encoder_ends_in_a_following_error(profile: Profile) -> None:
    bench = moving(profile)
    bench.drive.encoder_stuck = True
    bench.until(lambda: bool(bench.errors), 1000)
    assert bench.errors == [(0x8611, 0x21)]
    bench.until(lambda: bench.state is State.FAULT)
    assert bench.bit(13)
    assert bench.drive.braked
    if profile == "cia402":
        assert bench.get(0x603F) == 0x8611
    bench.drive.encoder_stuck = False
    bench.run(10)
    bench.word(0x80)
    assert (bench.state, bench.gone) == (State.SWITCH_ON_DISABLED, [0x8611])
    assert not bench.bit(13)
    if profile == "cia402":
        assert bench.get(0x603F) == 0


def test_a_following_error_needs_its_time() -> None:
    bench = moving(objects={0x6065: 200, 0x6066: 50})
    bench.drive.encoder_stuck = True
    begin = bench.now
    bench.until(lambda: bench.bit(13))
    assert bench.now - begin == pytest.approx(200 / SPEED * 1000, abs=12)
    assert not bench.errors
    assert bench.until(lambda: bool(bench.errors)) == pytest.approx(50, abs=2)


def test_short_excursions_are_not_added_up() -> None:
    bench = moving(speed=3_000, objects={0x6065: 100, 0x6066: 100})
    for _ in range(6):
        bench.blocked = True
        bench.run(100)  # 100 mdeg take 33 ms
        bench.blocked = False
        bench.run(200)
    assert not bench.errors


def test_no_supervision_with_the_window_off() -> None:
    bench = moving(objects={0x6065: 0xFFFF_FFFF})
    bench.blocked = True
    bench.run(1000)
    assert not bench.errors
    assert bench.bit(11)  # but the torque limit shows
    assert abs(bench.get(0x60F4)) > 10_000


def test_a_runaway_is_a_fault() -> None:
    bench = moving()
    bench.gravity = -600.0
    bench.set(0x6065, 0, 0xFFFF_FFFF)
    bench.until(lambda: bool(bench.errors))
    assert bench.errors[0] == (0x8400, 0x21)


@BOTH
def test_the_sync_watchdog_stops_and_tells(profile: Profile) -> None:
    bench = moving(profile)
    begin = bench.now
    bench.syncing = False
    bench.until(lambda: bool(bench.errors))
    assert bench.errors == [(0x8100, 0x11)]
    assert bench.now - begin == pytest.approx(6 * 10, abs=10)  # 200E = 6 times 60C2 = 10 ms
    assert state_of(bench.status) is State.QUICK_STOP
    bench.until(lambda: settled(bench))
    assert bench.state is State.SWITCH_ON_DISABLED
    bench.run(500)
    assert len(bench.errors) == 1
    bench.syncing = True
    bench.run(20)
    assert bench.gone == [0x8100]
    assert bench.state is State.SWITCH_ON_DISABLED  # never by itself


@pytest.mark.parametrize(("factor", "synced"), [(0, True), (6, False)])
def test_the_watchdog_is_off_at_zero_and_without_any_sync(factor: int, synced: bool) -> None:
    bench = Bench()
    bench.syncing = synced
    bench.set(0x200E, 0, factor)
    bench.run(50)
    bench.enable(1)
    bench.syncing = False
    bench.run(1000)
    assert not bench.errors
    assert bench.drive.poll(Ns(bench.now * MS)) is None


def test_one_missed_sync_is_nothing_and_the_deadline_is_announced() -> None:
    bench = moving()
    bench.syncing = False
    bench.run(25)
    deadline = bench.drive.poll(Ns(bench.now * MS))
    assert deadline is not None
    assert 25 * MS <= deadline - bench.now * MS < 60 * MS
    bench.syncing = True
    bench.run(100)
    assert not bench.errors
    assert bench.dq == pytest.approx(SPEED / MDEG, rel=0.03)


def test_the_watchdog_of_an_axis_that_is_enabled_late_begins_then() -> None:
    bench = Bench()
    bench.run(100)
    bench.syncing = False
    bench.run(1000)
    bench.enable(1)
    bench.run(50)
    assert not bench.errors
    bench.run(20)
    assert bench.errors == [(0x8100, 0x11)]


LOSSES: tuple[Loss, ...] = ("heartbeat", "guarding", "nmt_stop", "bus_off", "sync", "rpdo")


@pytest.mark.parametrize("reason", LOSSES)
@pytest.mark.parametrize(
    ("option", "state", "end"),
    [
        (0, State.OPERATION_ENABLED, State.OPERATION_ENABLED),
        (1, State.FAULT_REACTION, State.FAULT),
        (2, State.SWITCH_ON_DISABLED, State.SWITCH_ON_DISABLED),
        (3, State.QUICK_STOP, State.SWITCH_ON_DISABLED),
    ],
)
def test_losing_the_master_goes_by_6007(reason: Loss, option: int, state: State, end: State) -> None:
    bench = moving(objects={0x6007: option})
    bench.drive.lost(reason, Ns(bench.now * MS))
    assert bench.state is state
    bench.run(1000)
    assert bench.state is end
    assert bench.drive.braked is (option != 0)
    assert not bench.errors  # the node has told already
    assert bench.get(0x603F) == (alarms.LOSS_CODES[reason] if option == 1 else 0)


@pytest.mark.parametrize("reason", LOSSES)
def test_the_firmware_stops_quickly_when_the_master_is_lost(reason: Loss) -> None:
    bench = moving("lwa4d")
    bench.drive.lost(reason, Ns(bench.now * MS))
    assert state_of(bench.status) is State.QUICK_STOP
    bench.until(lambda: settled(bench))
    assert bench.state is State.SWITCH_ON_DISABLED


def test_losing_the_master_of_an_axis_at_rest_changes_nothing() -> None:
    bench = Bench("lwa4d")
    bench.word(0x06)
    bench.drive.lost("heartbeat", Ns(bench.now * MS))
    assert bench.state is State.READY


@BOTH
def test_a_reset_in_motion_is_a_power_on(profile: Profile) -> None:
    bench = moving(profile)
    bench.drive.fail(0x2310)
    bench.dictionary.reset()
    bench.drive.reset(Ns(bench.now * MS))
    assert (bench.state, bench.drive.braked, bench.get(0x6061)) == (State.SWITCH_ON_DISABLED, True, 0)
    bench.set(0x60C2, 1, 10)
    bench.word(0x0F)
    assert bench.state is State.SWITCH_ON_DISABLED
    bench.enable(1)
    bench.run(200)
    assert abs(bench.dq) < 0.01


# faults


@pytest.mark.parametrize(
    ("code", "bit"),
    [
        (0x2100, 1),
        (0x2310, 1),
        (0x2350, 1),
        (0x3211, 2),
        (0x3212, 2),
        (0x3222, 2),
        (0x4210, 3),
        (0x4310, 3),
        (0x5520, None),
        (0x6320, None),
        (0x7122, None),
        (0x7305, None),
        (0x8110, 4),
        (0x8210, 4),
        (0x8250, 4),
        (0x8400, 5),
        (0x8611, 5),
        (0x8900, 5),
    ],
)
@BOTH
def test_every_code_of_the_modules_can_be_injected_once(profile: Profile, code: int, bit: int | None) -> None:
    bench = Bench(profile)
    assert bench.drive.fail(code)
    assert not bench.drive.fail(code)
    assert bench.errors == [(code, 1 | (1 << bit if bit else 0))]
    assert bench.state is State.FAULT
    for word in (0x06, 0x0F, 0x00):
        assert bench.word(word) is State.FAULT
    assert bench.word(0x80) is State.SWITCH_ON_DISABLED
    assert bench.gone == [code]


def test_a_measurement_that_is_no_number_is_an_encoder_fault_as_long_as_it_lasts() -> None:
    bench = moving()
    bench.drive.measure(math.nan, 0.0)
    assert bench.errors == [(0x7305, 0x01)]
    bench.drive.measure(0.0, math.inf)
    assert math.isfinite(bench.drive.torque(Ns(bench.now * MS), 0.001))
    bench.drive.refresh()
    assert bench.word(0x80) is not State.SWITCH_ON_DISABLED
    bench.drive.measure(math.nan, math.nan)
    # the bench measures again and well with each step
    bench.run(1000)
    bench.word(0x00)
    assert bench.word(0x80) is State.SWITCH_ON_DISABLED


@pytest.mark.parametrize("value", [math.inf, math.nan, -1.0])
@BOTH
def test_a_gain_that_is_no_number_is_refused(profile: Profile, value: float) -> None:
    bench = Bench(profile)
    for index in (0x2020, 0x2021, 0x2030, 0x2034):
        with pytest.raises(Abort):
            bench.set(index, 0, value)


def test_a_gain_so_large_that_the_torque_is_no_number_is_a_fault() -> None:
    bench = moving()
    bench.set(0x2024, 0, 3e38)  # infinity times no acceleration
    bench.set(0x6065, 0, 0xFFFF_FFFF)
    bench.drive.axis.inertia = 1e308
    bench.drive.torque(Ns(bench.now * MS), 0.001)
    assert bench.errors
    assert bench.errors[0] == (0x6320, 0x01)
    bench.run(2000)  # and the bench asserts that every torque is finite
    assert bench.state is State.FAULT


def test_temperature_follows_the_torque_and_ends_in_a_fault() -> None:
    bench = Bench(gravity=0.0)
    bench.blocked = True
    bench.set(0x200D, 2, 1000)
    bench.enable(10)
    assert bench.get(0x200D, 1) == pytest.approx(25.0)
    bench.set(0x6071, 0, 1000)
    bench.get(0x6041)
    bench.run(2000)
    warm = bench.get(0x200D, 1)
    assert warm == pytest.approx(25.0 + 40.0 * (1 - math.exp(-2.0 / 900)), rel=1e-4)
    bench.drive.gauges.ambient = 72.0
    bench.run(10)
    assert bench.bit(7)
    bench.drive.gauges.ambient = 90.0
    bench.run(10)
    bench.get(0x6041)
    assert bench.errors == [(0x4210, 0x09)]
    bench.run(1000)
    bench.get(0x6041)
    assert bench.word(0x80) is State.FAULT
    bench.drive.gauges.ambient = 25.0
    bench.run(10)
    bench.get(0x6041)
    bench.word(0x00)
    assert bench.word(0x80) is State.SWITCH_ON_DISABLED


@BOTH
def test_current_and_torque_shown_are_those_that_act(profile: Profile) -> None:
    bench = Bench(profile, gravity=12.0, q=0.0)
    bench.enable(1)
    bench.run(1000)
    if profile == "lwa4d":
        assert bench.get(0x6077) == pytest.approx(1200, abs=60)  # mA at 10 N m/A
    else:
        assert bench.get(0x6077) == pytest.approx(300, abs=15)  # per mille of 40 N m
        assert bench.get(0x6078) == pytest.approx(300, abs=15)  # of 4 A
        assert bench.get(0x6074) == bench.get(0x6077)
    bench.word(0x00)
    assert bench.get(0x6077) == 0


# commutation search


@BOTH
def test_before_the_commutation_search_only_mode_7_is_let_move(profile: Profile) -> None:
    bench = Bench(profile, searched=False)
    assert bench.get(0x2050) == 2
    bench.set(0x6060, 0, 1)
    for word in (0x06, 0x07, 0x0F):
        bench.word(word)
    assert bench.errors == [(0x7122, 0x01)]
    assert bench.drive.braked
    assert bench.state is State.FAULT
    bench.word(0x80)
    bench.enable(7, 0x1F)
    bench.each = lambda k: bench.set(0x60C1, 1, 17_500)
    bench.syncing = False
    bench.run(50)
    bench.syncing = True
    bench.run(400)
    assert (bench.get(0x2050), bench.bit(12)) == (2, False)
    assert bench.q == pytest.approx(0.3, abs=0.01)
    bench.run(200)
    assert bench.get(0x2050) == 3
    assert bench.bit(12)
    bench.each = lambda k: None
    bench.word(0x0F)
    bench.set(0x6060, 0, 1)
    bench.run(500)
    assert (bench.state, bench.get(0x6061)) == (State.OPERATION_ENABLED, 1)
    bench.drive.fail(0x3222)  # a drop of the motor supply forces it again
    assert bench.get(0x2050) == 2


def test_leaving_mode_7_before_the_search_is_over_is_a_fault() -> None:
    bench = Bench(searched=False)
    bench.enable(7)
    bench.run(100)
    bench.set(0x6060, 0, 10)
    bench.run(300)
    assert bench.errors == [(0x7122, 0x01)]
    assert bench.state is State.FAULT


# never

ANY = st.integers(-(2**31), 2**31 - 1)
OBJECTS = {
    (0x6071, 0): st.integers(-32768, 32767),
    (0x60B2, 0): st.integers(-32768, 32767),
    (0x607A, 0): ANY | st.integers(-100_000, 100_000),
    (0x60C1, 1): ANY | st.integers(-100_000, 100_000),
    (0x60FF, 0): ANY | st.integers(-60_000, 60_000),
    (0x6042, 0): st.integers(-32768, 32767),
    (0x60B0, 0): ANY,
    (0x60B1, 0): ANY,
    (0x6081, 0): st.integers(0, 2**32 - 1),
    (0x6083, 0): st.integers(0, 2**32 - 1),
    (0x605A, 0): st.integers(0, 8),
    (0x605D, 0): st.integers(1, 4),
    (0x6072, 0): st.integers(0, 1000),
    (0x607E, 0): st.sampled_from([0, 0x40, 0x80, 0xC0]),
    (0x60FE, 1): st.integers(0, 1),
    (0x200E, 0): st.integers(0, 8),
    (0x2020, 0): st.sampled_from([0.0, 200.0]),
}
WORDS = st.sampled_from([0x00, 0x02, 0x06, 0x07, 0x0F, 0x0F, 0x1F, 0x1F, 0x7F, 0x10F, 0x80]) | st.integers(0, 0xFFFF)
STEPS = st.one_of(
    st.tuples(st.just((0x6040, 0)), WORDS),
    st.tuples(st.just((0x6060, 0)), st.integers(0, 10)),
    st.sampled_from(sorted(OBJECTS)).flatmap(lambda key: st.tuples(st.just(key), OBJECTS[key])),
    st.tuples(st.just(None), st.integers(1, 60)),
    st.tuples(st.just("fault"), st.sampled_from([0x2310, 0x3222, 0x8611])),
    st.tuples(st.just("lost"), st.sampled_from(LOSSES)),
)


@BOTH
@settings(max_examples=60, deadline=None)
@given(steps=st.lists(STEPS, max_size=50), delay=st.sampled_from([0.0, 0.02]))
def test_whatever_is_written_the_limits_hold_and_a_disabled_axis_stands(
    profile: Profile, steps: list[Any], delay: float
) -> None:
    bench = Bench(profile, gravity=4.0, brake_delay=delay)
    bench.set(0x60FE, 2, 0)
    enabled = {State.OPERATION_ENABLED, State.QUICK_STOP, State.FAULT_REACTION}
    for word in (0x06, 0x07, 0x0F):  # most walks should begin where something can happen
        bench.word(word)
    for key, value in steps:
        before = len(bench.log)
        if key is None:
            bench.run(value)
        elif key == "fault":
            bench.drive.fail(value)
        elif key == "lost":
            bench.drive.lost(value, Ns(bench.now * MS))
        elif key in bench.dictionary:
            with contextlib.nullcontext() if key != (0x6060, 0) else contextlib.suppress(Abort):
                bench.set(key[0], key[1], value)
        drive = bench.drive
        drive.refresh()
        state = state_of(bench.dictionary[0x6041, 0])
        assert state is drive.steering.machine.state
        if state not in enabled:
            assert drive.braked
            assert drive.torque(Ns(bench.now * MS), 0.001) == 0.0
        limit = drive.axis.torque_max
        assert abs(drive.axis.tau) <= (limit if key is None else JOINT.torque) + 1e-9
        assert all(abs(tau) <= JOINT.torque for _, _, _, tau, _ in bench.log[before:])
        torque_driven = drive.steering.mode.number in (4, 10) or drive.axis.open_loop
        if torque_driven:
            bench.dq = min(max(bench.dq, -1.0), 1.0)  # a torque gives any speed; what follows it is not to be blamed
        elif not any(braked for *_, braked in bench.log[-200:]) and len(bench.log) > 200:
            assert abs(bench.dq) < 1.25 * JOINT.speed


def test_a_torque_set_point_is_cheap() -> None:
    """A few microseconds, with much room for a busy machine: no more than a tenth of what the loops take."""
    bench = Bench(gravity=0.0)
    bench.enable(10)
    bench.set(0x6071, 0, 10)
    torque = bench.drive.torque

    def cost(calls: int = 2000) -> float:
        begin = time.perf_counter()
        for _ in range(calls):
            torque(Ns(0), 0.001)
        return (time.perf_counter() - begin) / calls

    held = min(cost() for _ in range(5))
    bench.set(0x6060, 0, 1)
    bench.run(200)
    assert bench.get(0x6061) == 1
    assert held < min(cost() for _ in range(5)) / 3
