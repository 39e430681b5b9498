"""Mode 6, homing: at the present place (35, 37), at a limit switch (17, 18) or at the index (33, 34).

The drive has no switches and no index of its own in the EDS. ASSUMED: limit switches stand just before the joint's
ends, and the index is at joint angle zero of each turn.
"""

import math
from enum import Enum

from lwa4d_sim.bus.axis import RAD_PER_MDEG, SLOWEST, Axis
from lwa4d_sim.bus.cia402 import DEVIATION, REACHED, SPECIFIC
from lwa4d_sim.bus.mode import Mode
from lwa4d_sim.bus.motion import Point, change_speed, rest, stop
from lwa4d_sim.interfaces import Ns

METHODS = frozenset({17, 18, 33, 34, 35, 37})
START = 1 << 4  # controlword


class _Phase(Enum):
    IDLE = REACHED  # not started, or interrupted (CiA 402-2, bits 13, 12 and 10)
    SEARCH = 0
    LEAVE = 0x1_0000  # off the switch again; no bit of its own
    DONE = SPECIFIC | REACHED
    FAILED = DEVIATION | REACHED


class Homing(Mode):
    """Mode 6. A zero once found is kept when homing fails or is interrupted."""

    number = 6

    def __init__(self, axis: Axis) -> None:
        super().__init__(axis)
        self._phase = _Phase.IDLE
        self._method = 0
        self._started = 0

    def enter(self, now: Ns, word: int) -> None:
        self._phase = _Phase.IDLE
        super().enter(now, word)

    def resume(self, now: Ns) -> None:
        super().resume(now)
        if self._phase in (_Phase.SEARCH, _Phase.LEAVE):
            self._begin(now)

    def control(self, word: int, now: Ns) -> None:
        changed, self.word = word ^ self.word, word
        if not changed & START:
            return
        if word & START:
            self._begin(now)
        elif self._phase in (_Phase.SEARCH, _Phase.LEAVE):
            self._end(now, _Phase.IDLE)

    def demand(self, now: Ns) -> Point:
        axis = self.axis
        if self._phase is _Phase.SEARCH:
            at_switch = any(axis.switches())
            if self._method in (33, 34):
                if self._turn() != self._started:
                    self._home(now)
                elif at_switch:
                    self._end(now, _Phase.FAILED)
            elif axis.switches()[self._method == 18]:
                self._phase = _Phase.LEAVE
                self._run(now, 1.0 if self._method == 17 else -1.0, 2)
        elif self._phase is _Phase.LEAVE and not any(axis.switches()):
            self._home(now)
        return self.motion.at(now)

    def bits(self, now: Ns) -> int:
        if self._phase is _Phase.FAILED and not self.axis.standing:
            return DEVIATION
        return self._phase.value & 0xFFFF

    def _begin(self, now: Ns) -> None:
        axis = self.axis
        self._method = axis.get(0x6098)
        self._phase = _Phase.SEARCH
        ends = {17: axis.joint.low, 18: axis.joint.high}
        if self._method in (35, 37):
            self._home(now)
        elif self._method not in METHODS or ends.get(self._method, 0.0) is None:
            self._end(now, _Phase.FAILED)
        elif self._method in ends:
            self._run(now, -1.0 if self._method == 17 else 1.0, 1)
        else:
            self._started = self._turn()
            self._run(now, -1.0 if self._method == 33 else 1.0, 2)

    def _turn(self) -> int:
        """Which turn of the joint: it changes where the index is."""
        return math.floor((self.axis.q + self.axis.zero) / math.tau)

    def _run(self, now: Ns, direction: float, sub: int) -> None:
        axis = self.axis
        speed = min(max(axis.get(0x6099, sub) * RAD_PER_MDEG, SLOWEST), axis.speed_max)
        rate = max(axis.get(0x609A) * RAD_PER_MDEG, SLOWEST)
        self.motion = change_speed(now, self.motion.at(now), direction * speed, rate, rate)

    def _home(self, now: Ns) -> None:
        """This place is home: the zero of the drive lies 607C beyond it (CiA 402-2)."""
        axis = self.axis
        q, dq, ddq = self.motion.at(now)
        home = -axis.get(0x607C) * axis.position_count
        shift = home - axis.q
        axis.q += shift
        axis.zero -= shift
        self.motion = rest(now, q + shift)
        if dq:
            self.motion = stop(now, Point(q + shift, dq, ddq), axis.quick_deceleration)
        self._phase = _Phase.DONE

    def _end(self, now: Ns, phase: _Phase) -> None:
        self.motion = stop(now, self.motion.at(now), self.axis.quick_deceleration)
        self._phase = phase
