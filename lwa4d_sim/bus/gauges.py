"""Statusword and actual values of a drive, as its dictionary shows them."""

import math

from lwa4d_sim.bus.axis import MS, Axis
from lwa4d_sim.bus.cia402 import MOVING, REFERENCED, REMOTE, VOLTAGE, WARNING, State
from lwa4d_sim.bus.motion import Point
from lwa4d_sim.interfaces import NS_PER_S, Ns

# Thermal model of the board, ASSUMED: first order, at peak torque it ends this much above ambient.
HEATING, HEAT_TIME = 40.0, 900.0  # [K], [s]
WARM, HOT = 70.0, 85.0  # [degC] warning (statusword bit 7) and fault 4210 (assumed)


class Gauges:
    """What a drive shows of itself.

    Attributes:
        ambient: [degC]; may be changed at any time.
        temperature: of the board [degC].
    """

    def __init__(self, axis: Axis, ambient: float) -> None:
        self._axis = axis
        self.ambient = self.temperature = ambient
        self._rise = 0.0
        self._last: Ns | None = None
        self._shown: Ns | None = None

    def heat(self, tau: float, now: Ns) -> None:
        """Warm up under the torque [N m] that has acted since the last call."""
        axis = self._axis
        if self._last is not None and now > self._last:
            share = 1.0 - math.exp(-(now - self._last) / NS_PER_S / HEAT_TIME)
            self._rise += share * (HEATING * (tau / axis.joint.torque) ** 2 - self._rise)
        self._last = now
        self.temperature = self.ambient + self._rise
        # 200D:2 is the sampling period of the temperature that the bus sees
        if self._shown is None or not 0 <= now - self._shown < axis.get(0x200D, 2) * MS:
            axis.dictionary[0x200D, 1] = self.temperature
            self._shown = now

    def show(self, state: State, bits: int, ref: Point, error: float) -> None:
        """Write statusword and actual values.

        Args:
            state: power state.
            bits: statusword bits of the mode and of the limits.
            ref: reference of the loops.
            error: following error [rad].
        """
        axis = self._axis
        dictionary = axis.dictionary
        position, speed = axis.position_count, axis.speed_count
        q, dq, tau = axis.q, axis.dq_shown, axis.tau
        torque = tau / axis.newton_metres
        word = state.bits | VOLTAGE | bits
        if self.temperature >= WARM:
            word |= WARNING
        if axis.full:
            word |= REMOTE
            dictionary[0x6074, 0] = torque
            rated = dictionary[0x6075, 0] * axis.joint.torque_constant / 1000  # [N m]
            dictionary[0x6078, 0] = tau / rated * 1000 if rated else 0
            dictionary[0x60FA, 0] = ref.dq / speed
        else:
            word |= REFERENCED
            if not axis.standing:
                word |= MOVING
        dictionary[0x6041, 0] = word
        dictionary[0x6064, 0] = q / position
        dictionary[0x606C, 0] = dq / speed
        dictionary[0x6077, 0] = torque
        dictionary[0x6062, 0] = ref.q / position
        dictionary[0x606B, 0] = ref.dq / speed
        dictionary[0x60F4, 0] = error / position
        count = axis.velocity_count
        dictionary[0x6043, 0] = ref.dq / count
        dictionary[0x6044, 0] = dq / count
        negative, positive = axis.switches()
        dictionary[0x60FD, 0] = negative | positive << 1
