"""The modes of operation that are given a torque: 4 and 10."""

from lwa4d_sim.bus.axis import Axis
from lwa4d_sim.bus.cia402 import REACHED, SPECIFIC
from lwa4d_sim.bus.mode import Loop, Mode
from lwa4d_sim.interfaces import NS_PER_S, Ns


class ProfileTorque(Mode):
    """Mode 4: torque with a slope (6087)."""

    number = 4
    set_points = frozenset({0x6071})
    loop = Loop.TORQUE

    def __init__(self, axis: Axis) -> None:
        super().__init__(axis)
        self._from, self._to, self._begin = 0.0, 0.0, Ns(0)

    def resume(self, now: Ns) -> None:
        super().resume(now)
        self._from = self._to = 0.0
        self._follow(now)

    def write(self, index: int, now: Ns) -> None:
        self._follow(now)

    def _follow(self, now: Ns) -> None:
        self._from, self._begin = self.torque(now), now
        self._to = float(self.axis.get(0x6071) * self.axis.newton_metres)

    def torque(self, now: Ns) -> float:
        slope: float = self.axis.get(0x6087) * self.axis.newton_metres
        change = self._to - self._from
        done = slope * max(now - self._begin, 0) / NS_PER_S
        if slope <= 0 or done >= abs(change):
            return self._to
        return self._from + (done if change > 0 else -done)

    def constant(self, now: Ns) -> bool:
        return self.torque(now) == self._to

    def bits(self, now: Ns) -> int:
        return REACHED if self.constant(now) else 0


class CyclicTorque(Mode):
    """Mode 10: cyclic synchronous torque."""

    number = 10
    set_points = frozenset({0x6071, 0x60B2})
    loop = Loop.TORQUE

    def torque(self, now: Ns) -> float:
        values = self.axis.dictionary.values
        return float((values[0x6071, 0] + values[0x60B2, 0]) * self.axis.newton_metres)

    def bits(self, now: Ns) -> int:
        return SPECIFIC
