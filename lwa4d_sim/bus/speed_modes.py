"""The modes of operation that are given a speed: 2, 3 and 9."""

import math

from lwa4d_sim.bus.axis import RAD_PER_MDEG, Axis
from lwa4d_sim.bus.cia402 import REACHED, SPECIFIC
from lwa4d_sim.bus.mode import Dwell, Loop, Mode
from lwa4d_sim.bus.motion import Point, change_speed, move_to, stop, stopping_point
from lwa4d_sim.interfaces import Ns


class CyclicSpeed(Mode):
    """Mode 9: cyclic synchronous velocity, slowed down before a software limit."""

    number = 9
    loop = Loop.SPEED

    def demand(self, now: Ns) -> Point:
        axis = self.axis
        asked = (axis.get(0x60FF) + axis.get(0x60B1)) * axis.speed_count
        speed = min(max(asked, -axis.speed_max), axis.speed_max)
        room = max(axis.high - axis.q if speed > 0 else axis.q - axis.low, 0.0)
        allowed = math.sqrt(2 * axis.quick_deceleration * room)
        speed = min(max(speed, -allowed), allowed)
        self.limited = speed != asked
        return Point(axis.q, speed, 0.0)

    def torque(self, now: Ns) -> float:
        return float(self.axis.get(0x60B2) * self.axis.newton_metres)

    def bits(self, now: Ns) -> int:
        return SPECIFIC


class ProfileSpeed(Mode):
    """Mode 3: ramps to a speed and keeps it, until a software limit."""

    number = 3
    set_points = frozenset({0x60FF})

    def __init__(self, axis: Axis) -> None:
        super().__init__(axis)
        self._target = 0.0
        self._reached = Dwell()

    def resume(self, now: Ns) -> None:
        super().resume(now)
        self._follow(now)

    def write(self, index: int, now: Ns) -> None:
        self._follow(now)

    def _follow(self, now: Ns) -> None:
        axis = self.axis
        self.cruise(now, axis.get(0x60FF) * axis.speed_count, axis.acceleration, axis.deceleration)

    def cruise(self, now: Ns, asked: float, acceleration: float, deceleration: float) -> None:
        """Ramp to a speed [rad/s] and keep it as far as the software limit."""
        axis = self.axis
        speed = min(max(asked, -axis.speed_max), axis.speed_max)
        self.limited, self._target = speed != asked, speed
        self._reached.look(False, now, 0)
        at = self.motion.at(now)
        end = axis.high if speed > 0 else axis.low
        if speed == 0 or math.isinf(end):
            self.motion = change_speed(now, at, speed, acceleration, deceleration)
        elif (end - stopping_point(at, deceleration)) * speed <= 0:
            self.limited = True
            self.motion = stop(now, at, deceleration)
        else:
            # the limit is the end of a move that never gets there, or does
            self.motion = move_to(now, at, end, abs(speed), acceleration, deceleration)

    def demand(self, now: Ns) -> Point:
        axis = self.axis
        self._reached.look(abs(self._target - axis.dq) <= axis.speed_reach, now, axis.speed_reach_time)
        if self._target and now >= self.motion.end and self.motion.last.dq == 0:
            self.limited = True  # arrived at the software limit
        return self.motion.at(now)

    def bits(self, now: Ns) -> int:
        return (REACHED if self._reached.held else 0) | (SPECIFIC if self.axis.standing else 0)


class Velocity(ProfileSpeed):
    """Mode 2: velocity mode with the dimension factor 604C and its own ramps 6048, 6049.

    It moves with controlword bits 4, 5 and 6 all set; bit 5 alone missing freezes the ramp (CiA 402-2).
    """

    number = 2
    set_points = frozenset({0x6042})

    def control(self, word: int, now: Ns) -> None:
        if (word ^ self.word) & 0x70:
            self.word = word
            self._follow(now)
        self.word = word

    def _follow(self, now: Ns) -> None:
        get = self.axis.get
        if self.word & 0x70 == 0x50:
            frozen = self.motion.at(now)
            self.cruise(now, frozen.dq, self._rate(0x6048), self._rate(0x6049))
            return
        asked = get(0x6042) * self.axis.velocity_count if self.word & 0x70 == 0x70 else 0.0
        low, high = get(0x6046, 1) * RAD_PER_MDEG, get(0x6046, 2) * RAD_PER_MDEG
        size = max(min(abs(asked), high or abs(asked)), low)
        speed = 0.0 if asked == 0 else size if asked > 0 else -size
        self.cruise(now, speed, self._rate(0x6048), self._rate(0x6049))
        self.limited |= speed != asked

    def _rate(self, index: int) -> float:
        axis = self.axis
        rate = axis.get(index, 1) * RAD_PER_MDEG / max(axis.get(index, 2), 1)
        return float(rate or axis.acceleration)
