"""The modes of operation in which the drive closes the position loop: 1, 7 and 8."""

from lwa4d_sim.bus.axis import RAD_PER_MDEG, Axis
from lwa4d_sim.bus.cia402 import REACHED, SPECIFIC
from lwa4d_sim.bus.mode import Dwell, Loop, Mode
from lwa4d_sim.bus.motion import Point, line, move_to, stop
from lwa4d_sim.interfaces import NS_PER_S, Ns

START, AT_ONCE, RELATIVE = 1 << 4, 1 << 5, 1 << 6  # controlword, profile position
PROCESS_DATA = 0x8900  # emergency: process data monitoring (CiA 402-2; libPowerballArm, schunkErrors.h)


class ProfilePosition(Mode):
    """Mode 1: moves to targets, one running and one waiting."""

    number = 1

    def __init__(self, axis: Axis) -> None:
        super().__init__(axis)
        self._target: float | None = None
        self._asked = 0.0
        self._waiting: float | None = None
        self._acknowledged = False
        self._reached = Dwell()

    def enter(self, now: Ns, word: int) -> None:
        self._target = self._waiting = None
        self._acknowledged = False
        self._asked = self.axis.q
        super().enter(now, word)

    def resume(self, now: Ns) -> None:
        super().resume(now)
        if self._target is not None:
            self._start(now, self._target)

    def control(self, word: int, now: Ns) -> None:
        rising = word & ~self.word & START
        self.word = word
        if rising and not self._acknowledged:
            counts = self.axis.get(0x607A) * self.axis.position_count
            self._asked = counts + (self._asked if word & RELATIVE else 0.0)
            self._acknowledged = True
            if word & AT_ONCE or now >= self.motion.end:
                self._start(now, self._asked)
                self._waiting = None
            else:
                self._waiting = self._asked
        elif not word & START and self._waiting is None:
            self._acknowledged = False

    def demand(self, now: Ns) -> Point:
        if self._waiting is not None and now >= self.motion.end:
            # the next move begins where and when the last one ended, between two looks at it
            self._start(self.motion.end, self._waiting)
            self._waiting = None
            self._acknowledged = bool(self.word & START)
        near = now >= self.motion.end and abs(self.motion.last.q - self.axis.q) <= self.axis.reach
        self._reached.look(near and self._waiting is None, now, self.axis.reach_time)
        return self.motion.at(now)

    def bits(self, now: Ns) -> int:
        reached = self._reached.held and now >= self.motion.end
        return (REACHED if reached else 0) | (SPECIFIC if self._acknowledged else 0)

    def _start(self, now: Ns, target: float) -> None:
        axis = self.axis
        self._target = target
        end = axis.inside(target)
        self.limited = end != target
        at = self.motion.at(now)
        self.motion = move_to(now, at, end, axis.profile_speed, axis.acceleration, axis.deceleration)


class _Cyclic(Mode):
    """Positions that come every period and are joined by lines."""

    beyond = False

    def __init__(self, axis: Axis) -> None:
        super().__init__(axis)
        self.fed: Ns | None = None
        self.set_point = 0.0

    def resume(self, now: Ns) -> None:
        super().resume(now)
        self.fed = None

    def push(self, target: float, now: Ns) -> None:
        """Take a set-point [rad]; it is reached one period from now, unless it lies beyond a limit."""
        axis = self.axis
        q = self.motion.at(now).q
        farthest = axis.speed_max * axis.period / NS_PER_S
        end = axis.inside(target)
        # a margin for the rounding of set-points that run at full speed
        slow = q + min(max(end - q, -farthest), farthest) if abs(end - q) > farthest + 2 * RAD_PER_MDEG else end
        self.limited = slow != target
        # A place that cannot be reached in time is followed as fast as the limit allows; the rest counts as
        # following error. Beyond a software limit the axis waits at the limit.
        self.excess = end - slow
        self.motion = line(now, q, slow, axis.period, beyond=self.beyond)
        self.fed, self.set_point = now, slow


class InterpolatedPosition(_Cyclic):
    """Mode 7: linear interpolation, a buffer of one set-point, torque offset beside it.

    When a set-point fails to come the line goes on for one period, then the axis waits, and after another half period,
    which is left for jitter, it is a fault. With the speed loop switched off (2020 = 0) the torque is 60B2 alone.
    """

    number = 7
    set_points = frozenset({0x60C1, 0x60B2})
    beyond = True

    @property
    def loop(self) -> Loop:  # type: ignore[override]
        return Loop.TORQUE if self.axis.open_loop else Loop.POSITION

    def __init__(self, axis: Axis) -> None:
        super().__init__(axis)
        self.active = False

    def enter(self, now: Ns, word: int) -> None:
        self.active = bool(word & START)
        super().enter(now, word)

    def control(self, word: int, now: Ns) -> None:
        self.word = word
        active = bool(word & START)
        if active != self.active:
            self.active, self.fed, self.excess = active, None, 0.0
            self.motion = stop(now, self.motion.at(now), self.axis.deceleration)

    def write(self, index: int, now: Ns) -> None:
        if index == 0x60C1 and self.active:
            self.push(self.axis.get(0x60C1, 1) * self.axis.position_count, now)

    def torque(self, now: Ns) -> float:
        return float(self.axis.dictionary[0x60B2, 0] * self.axis.newton_metres)

    def fault(self, now: Ns) -> int:
        late = self.fed is not None and 2 * (now - self.fed) > 5 * self.axis.period
        return PROCESS_DATA if late and self.loop is Loop.POSITION else 0

    def bits(self, now: Ns) -> int:
        near = self.fed is not None and abs(self.set_point - self.axis.q) <= self.axis.reach
        return (SPECIFIC if self.active else 0) | (REACHED if near else 0)


class CyclicPosition(_Cyclic):
    """Mode 8: cyclic synchronous position; a set-point that fails to come is held."""

    number = 8
    set_points = frozenset({0x607A, 0x60B0})

    def write(self, index: int, now: Ns) -> None:
        get, count = self.axis.get, self.axis.position_count
        self.push((get(0x607A) + get(0x60B0)) * count, now)

    def demand(self, now: Ns) -> Point:
        q, dq, ddq = self.motion.at(now)
        return Point(q, dq + self.axis.get(0x60B1) * self.axis.speed_count, ddq)

    def torque(self, now: Ns) -> float:
        return float(self.axis.get(0x60B2) * self.axis.newton_metres)

    def bits(self, now: Ns) -> int:
        return SPECIFIC if self.fed is not None else 0
