"""The loops inside the drive: position, proportional; speed, proportional and integral; torque as asked.

Objects 2020 to 2034 of the firmware name a cascade with gain KR, reset time TN, derivative time TD and KC in each
loop, and feed-forwards; what they mean exactly, and their values, are not public. ASSUMED here:

    torque = inertia * (KR2020 * (e + integral(e) / TN2021) + KS_FeedForward2024 * ddq_ref) + offset
    e = KR2030 * (q_ref - q) + KP_FeedForward2034 * dq_ref - dq

TD, KC, TN of the position loop and the current loop (2010 to 2013) are kept but have no effect: the torque follows at
once. With a torque held for dt the speed loop is stable while KR2020 dt (inertia / true inertia) stays below about 1.
"""

from lwa4d_sim.bus.axis import Axis
from lwa4d_sim.bus.motion import Point

# Gains after power-on, ASSUMED: a speed loop of 200 rad/s, a fifth of the rate of 1 ms plant steps, and a position loop
# five times slower. Gains in 1/s, reset time in s, feed-forwards as shares.
GAINS = {0x2020: 200.0, 0x2021: 0.04, 0x2024: 1.0, 0x2030: 40.0, 0x2034: 1.0}


class Servo:
    """Cascade of one axis.

    Attributes:
        saturated: the torque or the speed asked for was beyond the limit.
    """

    def __init__(self, axis: Axis) -> None:
        self._axis = axis
        self._integral = 0.0
        self.saturated = False

    def preset(self, tau: float) -> None:
        """Go on from the torque ``tau`` [N m] without a step."""
        self._integral = tau
        self.saturated = False

    def torque(self, ref: Point, offset: float, dt: float, *, position: bool, stopping: bool = False) -> float:
        """Torque for the next ``dt`` [s].

        Args:
            ref: where the axis is to be.
            offset: torque added [N m].
            dt: [s].
            position: whether the position loop is closed.
            stopping: loops that are switched off (2020 or 2030 = 0) take their gains after power-on, for otherwise
                nothing would stop the axis (assumed).
        """
        axis = self._axis
        speed_gain, position_gain = axis.speed_gain, axis.position_gain
        if stopping:
            speed_gain, position_gain = speed_gain or GAINS[0x2020], position_gain or GAINS[0x2030]
        speed = axis.speed_share * ref.dq
        if position:
            speed += position_gain * (ref.q - axis.q)
        fastest = axis.speed_max
        self.saturated = False
        if not -fastest <= speed <= fastest:
            # what rounding of a profile at full speed adds is no reason to tell of a limit
            self.saturated = abs(speed) > 1.05 * fastest
            speed = fastest if speed > 0 else -fastest
        error = speed - axis.dq
        gain = axis.inertia * speed_gain
        tau = gain * error + axis.inertia * axis.acceleration_share * ref.ddq + offset + self._integral
        limit = axis.torque_max
        if abs(tau) > limit:
            # the integral stands while the torque is limited, or it would have to be unwound later
            self.saturated = True
            return limit if tau > 0 else -limit
        if axis.speed_time > 0:
            self._integral += gain * error * dt / axis.speed_time
        return tau
