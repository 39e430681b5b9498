"""Every mode of operation on a simulated joint: it gets where it should, and says so in the right order."""

import math
from typing import Any

import pytest
from bus_rig import JOINT, MDEG, MS, Bench, Profile

from lwa4d_sim.bus.cia402 import State
from lwa4d_sim.bus.entry import Abort
from lwa4d_sim.interfaces import Ns

BOTH = pytest.mark.parametrize("profile", ["cia402", "lwa4d"])
NEAR = 0.002  # [rad] the loops follow a moving reference this well, friction and gravity unknown to them


def stamps(bench: Bench, bit: int, ms: int) -> list[int]:
    """When a statusword bit changes in the next while [ms from now]."""
    start, changes, before = bench.now, [], bench.bit(bit)
    for _ in range(ms):
        bench.run(1)
        if bench.bit(bit) is not before:
            before = not before
            changes.append(bench.now - start)
    return changes


@BOTH
def test_without_a_mode_the_axis_is_held(profile: Profile) -> None:
    bench = Bench(profile)
    bench.enable(0)
    assert not bench.drive.braked
    bench.run(500)
    assert bench.q == pytest.approx(0.3, abs=1e-3)
    assert bench.get(0x6061) == 0


# mode 1


@BOTH
def test_a_profile_move_takes_its_trapezoid_and_shakes_hands(profile: Profile) -> None:
    bench = Bench(profile)
    bench.set(0x6081, 0, 20_000)
    bench.set(0x6083, 0, 40_000)
    if profile == "cia402":
        bench.set(0x6084, 0, 40_000)
    bench.enable(1)
    start = bench.get(0x6064)
    bench.set(0x607A, 0, 50_000)
    bench.run(200)
    assert bench.get(0x6062) == start  # nothing moves before the handshake
    assert not bench.bit(12)
    bench.word(0x1F)
    assert bench.bit(12)
    assert not bench.bit(10)
    begin = bench.now
    bench.run(30)
    assert bench.bit(12)  # as long as bit 4 stands
    bench.word(0x0F)
    assert not bench.bit(12)
    bench.until(lambda: bench.bit(10))
    seconds = (50_000 - start) / 20_000 + 20_000 / 40_000
    settling = 10 if profile == "cia402" else 0  # position window time 6068
    assert (bench.now - begin) / 1000 == pytest.approx(seconds, abs=0.1 + settling / 1000)
    assert (bench.now - begin) / 1000 >= seconds
    bench.run(200)
    assert bench.get(0x6064) == pytest.approx(50_000, abs=20)
    assert max(abs(dq) for _, _, dq, _, _ in bench.log) == pytest.approx(20_000 / MDEG, rel=0.05)
    assert not bench.errors


def test_a_second_target_waits_and_a_third_is_not_acknowledged() -> None:
    bench = Bench()
    bench.enable(1)
    for target in (30_000, 0):
        bench.set(0x607A, 0, target)
        bench.word(0x1F)
        bench.word(0x0F)
    assert bench.bit(12)  # the buffer is full: acknowledged until it is free
    bench.set(0x607A, 0, 60_000)
    bench.word(0x1F)  # lost
    bench.word(0x0F)
    bench.until(lambda: not bench.bit(12))
    assert bench.get(0x6062) == pytest.approx(30_000, abs=300)  # the first move was finished
    assert not bench.bit(10)
    bench.until(lambda: bench.bit(10))
    assert bench.get(0x6064) == pytest.approx(0, abs=100)


def test_change_at_once_and_relative_targets() -> None:
    bench = Bench()
    bench.enable(1)
    bench.set(0x607A, 0, 60_000)
    bench.word(0x1F)
    bench.word(0x0F)
    bench.run(800)
    assert bench.dq > 0.1
    bench.set(0x607A, 0, -5_000)
    bench.word(0x3F)
    bench.word(0x0F)
    bench.until(lambda: bench.bit(10))
    assert bench.get(0x6064) == pytest.approx(-5_000, abs=100)
    assert max(q for _, q, _, _, _ in bench.log) < 59 / 180 * math.pi
    for _ in range(2):  # relative to the last target, not to the place
        bench.word(0x5F)
        bench.word(0x0F)
        bench.until(lambda: not bench.bit(10))
        bench.until(lambda: bench.bit(10))
    assert bench.get(0x6062) == -15_000


@BOTH
def test_a_start_bit_that_stood_before_the_drive_was_enabled_starts_nothing(profile: Profile) -> None:
    bench = Bench(profile)
    bench.set(0x6060, 0, 1)
    bench.set(0x607A, 0, 50_000)
    for word in (0x16, 0x17, 0x1F):
        bench.word(word)
    assert bench.state is State.OPERATION_ENABLED
    bench.run(300)
    assert not bench.bit(12)
    assert bench.q == pytest.approx(0.3, abs=2e-3)


@BOTH
def test_halt_stops_a_move_and_its_end_lets_it_go_on(profile: Profile) -> None:
    bench = Bench(profile)
    bench.enable(1)
    bench.set(0x607A, 0, 60_000)
    bench.word(0x1F)
    bench.run(500)
    bench.word(0x11F)
    bench.until(lambda: bench.bit(10))
    bench.run(20)
    assert bench.state is State.OPERATION_ENABLED
    assert bench.bit(12)
    assert bench.drive.braked is (profile == "lwa4d")  # schunk_canopen_driver, SchunkPowerBallNode
    q = bench.q
    bench.run(300)
    assert bench.q == pytest.approx(q, abs=1e-3)
    bench.word(0x1F)
    assert not bench.drive.braked
    bench.until(lambda: bench.bit(10))
    assert bench.get(0x6064) == pytest.approx(60_000, abs=100)


# mode 7


@BOTH
def test_interpolated_positions_are_joined_by_lines(profile: Profile) -> None:
    bench = Bench(profile, q=0.0)
    bench.enable(7)
    bench.set(0x60C1, 1, 5_000)
    bench.run(50)
    assert not bench.bit(12)
    assert bench.get(0x6062) == 0  # not before bit 4
    demand: list[tuple[int, int]] = []

    def master(k: int) -> None:
        bench.set(0x60C1, 1, round(20_000 * (1 - math.cos(0.02 * k))))

    bench._count = 0
    bench.each = master
    bench.word(0x1F)
    assert bench.bit(12)
    for _ in range(1000):
        bench.run(1)
        demand.append((bench.now, bench.get(0x6062)))
    by_time = dict(demand)
    for now, counts in demand[50:]:
        if now % 10 == 0:
            # a set-point is reached one period after it came
            k = now // 10 - demand[0][0] // 10 - 1
            assert counts == pytest.approx(20_000 * (1 - math.cos(0.02 * k)), abs=1)
        elif now % 10 == 5 and now + 5 in by_time:
            assert counts == pytest.approx((by_time[now - 5] + by_time[now + 5]) / 2, abs=2)
    q, now = bench.q, bench.get(0x6062) / MDEG
    assert q == pytest.approx(now, abs=NEAR)
    bench.word(0x0F)  # bit 4 off: the axis stops and holds
    assert not bench.bit(12)
    bench.run(500)
    q = bench.q
    bench.run(200)
    assert bench.q == pytest.approx(q, abs=1e-3)
    assert not bench.errors


def ramp_and_lose(bench: Bench, lost: int) -> None:
    """Set-points at 0.2 rad/s for half a second, then none for some periods, then again."""

    def master(k: int) -> None:
        if not 50 <= k < 50 + lost:
            bench.set(0x60C1, 1, round((0.3 + 0.002 * k) * MDEG))

    bench.enable(7, 0x1F)
    bench._count = 0
    bench.each = master
    bench.run(1500)


@BOTH
def test_one_missing_set_point_is_extrapolated(profile: Profile) -> None:
    bench = Bench(profile)
    ramp_and_lose(bench, 1)
    assert not bench.errors
    late = [dq for _, _, dq, _, _ in bench.log[400:900]]
    assert min(late) > 0.15  # it went on as if nothing had happened
    assert bench.q == pytest.approx(0.3 + 0.002 * 149, abs=NEAR)


@BOTH
def test_set_points_that_stay_away_are_a_fault(profile: Profile) -> None:
    bench = Bench(profile)
    ramp_and_lose(bench, 5)
    assert bench.errors == [(0x8900, 0x21)]
    assert bench.state is State.FAULT
    assert bench.drive.braked
    stop = next(ms for ms, _, _, _, braked in bench.log if braked and ms > 100)
    assert 520 < stop < 620


@BOTH
def test_a_lost_sync_in_interpolation_is_no_error(profile: Profile) -> None:
    bench = Bench(profile)

    def master(k: int) -> None:
        bench.set(0x60C1, 1, round((0.3 + 0.0002 * bench.now) * MDEG))

    bench.enable(7, 0x1F)
    bench.each = master
    for _ in range(20):
        bench.run(60)
        bench.syncing = False
        bench.run(10)
        bench.syncing = True
    assert not bench.errors
    assert bench.state is State.OPERATION_ENABLED


# mode 8


def test_cyclic_positions_with_offsets_and_a_held_last_one() -> None:
    bench = Bench(q=0.0)
    bench.enable(8)
    assert not bench.bit(12)
    bench.set(0x60B0, 0, 2_000)
    bench.each = lambda k: bench.set(0x607A, 0, 100 * min(k, 100))
    bench._count = 0
    bench.run(500)
    assert bench.bit(12)
    bench.run(1000)
    assert bench.get(0x6064) == pytest.approx(12_000, abs=30)
    bench.each = lambda k: None
    bench.run(500)
    assert not bench.errors
    # a torque offset equal to gravity leaves nothing to the integral
    bench.set(0x60B2, 0, round(bench.gravity * math.cos(bench.q) / JOINT.torque * 1000))
    bench.run(500)
    assert bench.drive._servo._integral == pytest.approx(0.0, abs=0.6)


def test_a_speed_offset_is_added_to_the_feed_forward() -> None:
    bench = Bench(gravity=0.0, q=0.0)
    bench.enable(8)
    bench.set(0x60B1, 0, 4_000)
    bench.set(0x607A, 0, 0)
    assert bench.get(0x606B) == 4_000
    bench.run(300)
    # position and speed loop settle where both agree: kp (0 - q) + offset = 0
    assert bench.q == pytest.approx(4_000 / MDEG / 40, rel=0.05)


# modes 9, 3, 2


def test_cyclic_speed_follows_at_once_with_its_offset() -> None:
    bench = Bench()
    bench.enable(9)
    assert bench.bit(12)
    bench.set(0x60FF, 0, 10_000)
    bench.run(300)
    assert bench.dq == pytest.approx(10_000 / MDEG, rel=0.02)
    bench.set(0x60B1, 0, -25_000)
    bench.run(300)
    assert bench.dq == pytest.approx(-15_000 / MDEG, rel=0.02)
    assert bench.get(0x606C) == pytest.approx(-15_000, rel=0.02)
    assert not bench.errors


def test_profile_speed_ramps_with_its_rates() -> None:
    bench = Bench(gravity=2.0, q=-1.0)
    bench.set(0x6083, 0, 50_000)
    bench.set(0x6084, 0, 100_000)
    bench.enable(3)
    assert bench.bit(12)  # speed is zero
    bench.set(0x60FF, 0, 25_000)
    assert not bench.bit(10)
    up = bench.until(lambda: bench.bit(10))
    assert up == pytest.approx(500 + 10, abs=25)  # ramp and window time, less the window
    assert not bench.bit(12)
    bench.set(0x60FF, 0, 0)
    down = bench.until(lambda: bench.bit(10))
    assert down == pytest.approx(250 + 10, abs=25)
    bench.until(lambda: bench.bit(12))
    assert bench.state is State.OPERATION_ENABLED


@BOTH
def test_velocity_mode_needs_its_three_bits_and_knows_its_factor(profile: Profile) -> None:
    bench = Bench(profile, gravity=2.0, q=-1.0)
    bench.enable(2)
    bench.set(0x6042, 0, 10_000)  # 1 count = 1 mdeg/s with 604C = 1, 6000
    bench.run(500)
    assert abs(bench.dq) < 0.01
    bench.word(0x7F)
    bench.run(500)
    assert bench.dq == pytest.approx(10_000 / MDEG, rel=0.02)
    assert bench.get(0x6044) == pytest.approx(10_000, rel=0.02)
    assert bench.get(0x6043) == 10_000
    bench.set(0x6042, 0, 20_000)
    bench.run(4)
    bench.word(0x5F)  # bit 5 off: the ramp is frozen where it is
    bench.run(1)
    frozen = bench.get(0x6043)
    assert 10_000 < frozen < 20_000
    bench.run(200)
    assert bench.get(0x6043) == pytest.approx(frozen, abs=2)
    bench.word(0x3F)  # bit 6 off: to zero
    bench.run(300)
    assert abs(bench.dq) < 0.01
    bench.set(0x604C, 2, 24_000)  # schunk_robots' overlay: 1 count = 4 mdeg/s
    bench.set(0x6042, 0, -2_500)
    bench.word(0x7F)
    bench.run(500)
    assert bench.dq == pytest.approx(-10_000 / MDEG, rel=0.02)
    assert bench.get(0x6044) == pytest.approx(-2_500, rel=0.02)
    bench.set(0x6046, 2, 5_000)
    bench.set(0x6042, 0, -2_500)
    bench.run(300)
    assert bench.dq == pytest.approx(-5_000 / MDEG, rel=0.03)
    assert bench.bit(11)


def test_velocity_mode_has_ramps_of_its_own() -> None:
    bench = Bench(gravity=0.0, q=-1.0)
    for index, (speed, time) in {0x6048: (20_000, 2), 0x6049: (20_000, 1)}.items():
        bench.set(index, 1, speed)
        bench.set(index, 2, time)
    bench.enable(2, 0x7F)
    bench.set(0x6042, 0, 10_000)
    bench.run(500)
    assert bench.get(0x6043) == pytest.approx(5_000, abs=20)
    bench.run(600)
    bench.set(0x6042, 0, 0)
    bench.run(250)
    assert bench.get(0x6043) == pytest.approx(5_000, abs=20)


# modes 4 and 10


@pytest.mark.parametrize("mode", [4, 10])
def test_torque_is_what_is_asked_and_stays(mode: int) -> None:
    bench = Bench(gravity=0.0)
    bench.set(0x6087, 0, 1_000_000)
    bench.enable(mode)
    bench.set(0x6071, 0, 100)
    bench.run(3)
    tau = 0.1 * JOINT.torque
    assert bench.drive.torque(Ns(bench.now * MS), 0.001) == tau
    assert bench.get(0x6077) == 100
    bench.run(2)
    assert bench.drive.steady
    rate = (tau - bench.coulomb - bench.viscous * bench.dq) / bench.inertia
    before = bench.dq
    bench.run(1)
    assert (bench.dq - before) / 0.001 == pytest.approx(rate, rel=0.02)
    assert not bench.bit(11)


def test_torque_has_a_slope_in_mode_4_and_says_when_it_is_over() -> None:
    bench = Bench(gravity=0.0, q=-1.5)
    bench.coulomb = 10.0
    bench.set(0x6087, 0, 500)
    bench.enable(4)
    assert bench.bit(10)
    bench.set(0x6071, 0, 100)
    begin = bench.now
    assert not bench.bit(10)
    assert not bench.drive.steady
    bench.run(100)
    assert bench.log[begin + 100 - 1][3] == pytest.approx(0.05 * JOINT.torque, rel=0.03)
    assert bench.until(lambda: bench.bit(10)) == pytest.approx(100, abs=2)
    bench.run(5)
    assert bench.drive.steady
    bench.set(0x6071, 0, 50)  # from the middle of a ramp on to another
    bench.run(50)
    bench.set(0x6071, 0, 100)
    bench.run(10)
    assert bench.drive.axis.tau == pytest.approx((0.1 - 0.025 + 0.005) * JOINT.torque, rel=0.02)


def test_torque_offset_and_limit() -> None:
    bench = Bench(gravity=0.0)
    bench.enable(10)
    bench.set(0x6071, 0, 300)
    bench.set(0x60B2, 0, -250)
    assert bench.drive.axis.tau == pytest.approx(0.05 * JOINT.torque)
    assert bench.bit(12)
    bench.set(0x6072, 0, 20)
    assert bench.drive.axis.tau == pytest.approx(0.02 * JOINT.torque)
    assert bench.bit(11)
    bench.set(0x6072, 0, 1000)
    bench.set(0x6073, 0, 10)  # the current limit counts as well
    assert bench.drive.axis.tau == pytest.approx(0.01 * JOINT.torque)
    bench.set(0x6073, 0, 1000)
    bench.set(0x6071, 0, -32_768)
    assert bench.drive.axis.tau == -JOINT.torque
    assert bench.get(0x6077) == -1000


def test_a_torque_mode_watches_the_speed_when_told_to() -> None:
    bench = Bench(gravity=0.0)
    bench.enable(10)
    assert bench.drive.steady
    bench.set(0x6080, 0, 9)  # rpm: 54 deg/s, the joint is rated for 57
    assert not bench.drive.steady
    bench.set(0x6071, 0, 500)
    bench.run(1000)
    assert bench.dq < 54_000 / MDEG * 1.001
    assert bench.dq > 54_000 / MDEG * 0.9
    assert bench.bit(11)


def test_the_firmware_takes_torque_as_current_offset_with_its_loops_open() -> None:
    bench = Bench("lwa4d", gravity=0.0)
    for index in (0x2020, 0x2030, 0x2024):
        bench.set(index, 0, 0.0)
    bench.enable(7, 0x1F)
    bench.set(0x60B2, 0, 250)  # mA at 10 N m/A
    bench.set(0x60C1, 1, 60_000)
    assert bench.drive.steady
    assert bench.drive.axis.tau == pytest.approx(2.5)
    bench.run(200)
    assert {tau for _, _, _, tau, _ in bench.log[-200:]} == {bench.drive.axis.tau}
    assert bench.get(0x6077) == 250
    assert bench.get(0x60F4) == 0
    bench.run(2000)
    assert bench.errors == []  # no following error: no loop is to follow; and the set-point is held
    bench.set(0x60B2, 0, 32_767)
    assert bench.drive.axis.tau == pytest.approx(JOINT.torque)
    assert bench.bit(11)


def test_with_closed_loops_the_current_offset_is_added() -> None:
    bench = Bench("lwa4d", q=0.0)
    bench.enable(7, 0x1F)
    bench.run(1000)
    held = bench.drive._servo._integral
    assert held == pytest.approx(bench.gravity, abs=0.6)
    bench.set(0x60B2, 0, 800)
    bench.run(1000)
    assert bench.drive._servo._integral == pytest.approx(held - 8.0, abs=0.1)
    assert bench.get(0x6077) == pytest.approx(800, abs=60)


# mode 6


@pytest.mark.parametrize("method", [35, 37])
def test_homing_here(method: int) -> None:
    bench = Bench(q=0.5)
    bench.set(0x6098, 0, method)
    bench.set(0x607C, 0, 10_000)
    bench.enable(6)
    assert (bench.bit(13), bench.bit(12), bench.bit(10)) == (False, False, True)  # not started
    bench.word(0x1F)
    assert (bench.bit(13), bench.bit(12), bench.bit(10)) == (False, True, True)
    # zero = home + 607C
    assert bench.get(0x6064) == pytest.approx(-10_000, abs=30)
    bench.run(300)
    assert bench.q == pytest.approx(0.5, abs=2e-3)  # only the numbers have changed
    assert bench.get(0x6064) == pytest.approx(-10_000 + (bench.q - 0.5) * MDEG, abs=2)


@pytest.mark.parametrize(("method", "q", "home"), [(17, -1.5, -1.99), (18, 1.5, 1.99), (33, 0.2, 0.0), (34, -0.2, 0.0)])
def test_homing_to_a_switch_or_an_index(method: int, q: float, home: float) -> None:
    bench = Bench(q=q, gravity=2.0)
    bench.set(0x6099, 1, 20_000)
    bench.set(0x6099, 2, 5_000)
    bench.set(0x6098, 0, method)
    bench.enable(6)
    bench.word(0x1F)
    assert (bench.bit(13), bench.bit(12), bench.bit(10)) == (False, False, False)  # in progress
    bench.until(lambda: bench.bit(12), 8000)
    assert bench.bit(10)
    bench.run(200)
    assert bench.get(0x6064) / MDEG == pytest.approx(bench.q - home, abs=2e-4)
    assert bench.state is State.OPERATION_ENABLED
    # and the modes to come count from there
    bench.set(0x6060, 0, 1)
    bench.run(10)
    bench.set(0x607A, 0, 0)
    bench.word(0x0F)
    bench.word(0x1F)
    bench.run(2000)
    assert bench.q == pytest.approx(home, abs=1e-3)


def test_homing_that_cannot_succeed_says_so() -> None:
    bench = Bench(q=0.5, gravity=2.0)
    with pytest.raises(Abort) as refusal:
        bench.set(0x6098, 0, 3)
    assert refusal.value.code == 0x06090030
    bench.set(0x6098, 0, 34)  # upwards there is no index before the end of the joint
    bench.set(0x6099, 2, 10_000)
    bench.enable(6)
    bench.word(0x1F)
    bench.until(lambda: bench.bit(13), 20_000)
    bench.until(lambda: bench.bit(10))
    assert not bench.bit(12)
    assert bench.drive.axis.zero == 0.0
    assert 1.9 < bench.q < 2.0


def test_homing_is_interrupted_by_its_bit_and_taken_up_after_a_halt() -> None:
    bench = Bench(q=-1.0, gravity=2.0)
    bench.set(0x6098, 0, 17)
    bench.set(0x6099, 1, 20_000)
    bench.enable(6)
    bench.word(0x1F)
    bench.run(500)
    bench.word(0x11F)
    bench.until(lambda: bench.bit(10))
    assert abs(bench.dq) < 0.01
    bench.word(0x1F)
    bench.run(300)
    assert bench.dq < -0.2
    bench.word(0x0F)
    bench.run(500)
    assert abs(bench.dq) < 0.01
    assert (bench.bit(13), bench.bit(12), bench.bit(10)) == (False, False, True)


# limits, in every mode that has them


def test_targets_beyond_the_software_limits_are_clamped_and_told() -> None:
    bench = Bench(q=0.0, gravity=2.0)
    bench.set(0x607D, 1, -20_000)
    bench.set(0x607D, 2, 20_000)
    bench.enable(1)
    bench.set(0x607A, 0, 90_000)
    bench.word(0x1F)
    bench.word(0x0F)
    assert bench.bit(11)
    bench.until(lambda: bench.bit(10))
    assert bench.get(0x6064) == pytest.approx(20_000, abs=100)
    bench.set(0x607A, 0, 0)
    bench.word(0x1F)
    bench.word(0x0F)
    assert not bench.bit(11)
    assert not bench.errors


@pytest.mark.parametrize(("mode", "key", "word"), [(3, 0x60FF, 0x0F), (9, 0x60FF, 0x0F), (2, 0x6042, 0x7F)])
def test_speeds_end_at_the_software_limits(mode: int, key: int, word: int) -> None:
    bench = Bench(q=0.0, gravity=2.0)
    bench.set(0x607D, 1, -20_000)
    bench.set(0x607D, 2, 30_000)
    bench.enable(mode, word)
    for speed, limit in ((25_000, 30_000), (-25_000, -20_000)):
        bench.set(key, 0, speed)
        bench.run(300)
        assert abs(bench.dq) > 0.3
        bench.run(3000)
        assert bench.bit(11)
        assert bench.get(0x6064) == pytest.approx(limit, abs=150)
        assert max(abs(q) for _, q, _, _, _ in bench.log) < 30_300 / MDEG
    assert not bench.errors


@pytest.mark.parametrize(("mode", "key", "word"), [(7, (0x60C1, 1), 0x1F), (8, (0x607A, 0), 0x0F)])
def test_set_points_beyond_the_software_limits_wait_at_the_limit(mode: int, key: tuple[int, int], word: int) -> None:
    bench = Bench(q=0.3, gravity=2.0)
    bench.set(0x607D, 1, -20_000)
    bench.set(0x607D, 2, 20_000)
    bench.enable(mode, word)
    bench._count = 0
    bench.each = lambda k: bench.set(*key, 17_189 + 50 * k)
    bench.run(2000)
    assert bench.bit(11)
    assert bench.get(0x6064) == pytest.approx(20_000, abs=60)
    assert not bench.errors


@pytest.mark.parametrize(("mode", "key", "word"), [(7, (0x60C1, 1), 0x1F), (8, (0x607A, 0), 0x0F)])
def test_a_jump_of_the_set_point_is_a_following_error_and_not_a_jump(
    mode: int, key: tuple[int, int], word: int
) -> None:
    bench = Bench(q=0.3)
    bench.enable(mode, word)
    bench.each = lambda k: bench.set(*key, 17_189 if k < 100 else 80_000)
    bench.until(lambda: bool(bench.errors))
    assert bench.errors == [(0x8611, 0x21)]
    bench.until(lambda: bench.state is State.FAULT)
    assert bench.get(0x603F) == 0x8611
    assert max(dq for _, _, dq, _, _ in bench.log) < 1.1 * JOINT.speed
    assert bench.q < 0.3 + 0.2  # far from the 1.4 rad asked for


@pytest.mark.parametrize(("mode", "key", "word"), [(7, (0x60C1, 1), 0x1F), (8, (0x607A, 0), 0x0F)])
def test_unwatched_a_jump_is_followed_at_the_speed_limit(mode: int, key: tuple[int, int], word: int) -> None:
    bench = Bench(q=0.3)
    bench.set(0x6065, 0, 0xFFFF_FFFF)
    bench.enable(mode, word)
    bench.each = lambda k: bench.set(*key, 80_000)
    bench.run(101)
    begin = bench.get(0x6062)
    bench.run(500)
    assert bench.get(0x6062) - begin == pytest.approx(0.5 * JOINT.speed * MDEG, rel=0.01)
    assert bench.bit(11)
    bench.run(2000)
    assert bench.get(0x6064) == pytest.approx(80_000, abs=50)
    assert not bench.bit(11)


@pytest.mark.parametrize(("mode", "word"), [(1, 0x1F), (3, 0x0F), (8, 0x0F), (9, 0x0F)])
@pytest.mark.parametrize("limit", [0x607F, 0x6080])
def test_no_mode_is_faster_than_its_speed_limits(mode: int, word: int, limit: int) -> None:
    bench = Bench(q=-1.0, gravity=2.0)
    bench.set(limit, 0, 30_000 if limit == 0x607F else 5)
    bench.set(0x6065, 0, 0xFFFFFFFF)
    bench.set(0x6081, 0, 500_000)
    bench.set(0x60FF, 0, 500_000)
    bench.set(0x607A, 0, 60_000)
    bench.enable(mode, word)
    bench.each = lambda k: bench.set(0x607A, 0, 60_000)
    bench.run(2000)
    fastest = max(dq for _, _, dq, _, _ in bench.log) * MDEG
    assert 0.9 * 30_000 < fastest < 1.1 * 30_000
    assert not bench.errors


def test_polarity_turns_the_axis_round() -> None:
    bench = Bench(q=0.3, gravity=2.0)
    bench.set(0x607E, 0, 0xC0)
    bench.run(1)
    assert bench.get(0x6064) == pytest.approx(-0.3 * MDEG, abs=1)
    bench.set(0x607D, 1, -90_000)
    bench.set(0x607D, 2, 10_000)
    assert (bench.drive.axis.low, bench.drive.axis.high) == pytest.approx((-10_000 / MDEG, 90_000 / MDEG))
    bench.enable(3)
    bench.set(0x60FF, 0, -10_000)
    bench.run(500)
    assert bench.dq == pytest.approx(10_000 / MDEG, rel=0.03)
    assert bench.get(0x606C) == pytest.approx(-10_000, rel=0.03)


# choosing a mode


@BOTH
def test_a_mode_that_the_drive_has_not_is_refused(profile: Profile) -> None:
    bench = Bench(profile)
    supported = bench.get(0x6502)
    for mode in range(-128, 128):
        if mode == 0 or (mode > 0 and supported >> (mode - 1) & 1):
            bench.set(0x6060, 0, mode)
            assert bench.get(0x6061) == mode
        else:
            before = bench.get(0x6061)
            with pytest.raises(Abort) as refusal:
                bench.set(0x6060, 0, mode)
            assert refusal.value.code == 0x06090030
            assert bench.get(0x6061) == before
    modes = {"cia402": [1, 2, 3, 4, 6, 7, 8, 9, 10], "lwa4d": [1, 2, 7]}[profile]
    assert [k + 1 for k in range(32) if supported >> k & 1] == modes


MOVERS: list[tuple[int, dict[int, Any], int]] = [
    (1, {0x607A: 60_000}, 0x1F),
    (3, {0x60FF: 20_000}, 0x0F),
    (9, {0x60FF: 20_000}, 0x0F),
    (10, {0x6071: 250}, 0x0F),
]


@pytest.mark.parametrize("new", [1, 3, 4, 6, 7, 8, 9, 10])
@pytest.mark.parametrize(("old", "targets", "word"), MOVERS)
def test_a_mode_changes_only_when_the_axis_has_stopped(old: int, targets: dict[int, Any], word: int, new: int) -> None:
    if new == old:
        return
    bench = Bench(q=-1.2)
    for index, value in targets.items():
        bench.set(index, 0, value)
    bench.enable(old, word)
    bench.until(lambda: abs(bench.dq) > 0.15)
    bench.set(0x60FF, 0, 0)
    bench.set(0x6071, 0, 0)
    if new in (3, 9) and old in (3, 9):
        bench.set(0x60FF, 0, 20_000)
    bench.set(0x6060, 0, new)
    asked = bench.now
    waited = bench.until(lambda: bench.get(0x6061) == new)
    assert waited > (0 if old in (3, 9) and new not in (3, 9) else 10)
    assert min(abs(dq) for _, _, dq, _, _ in bench.log[asked - 1 :]) < 0.01
    assert bench.state is State.OPERATION_ENABLED
    assert not bench.errors
