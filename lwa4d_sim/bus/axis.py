"""The joint as its drive sees it: units, limits, ramps and windows from the dictionary, and the measured motion."""

import math
from typing import Any

from lwa4d_sim.bus.dictionary import Dictionary, Joint
from lwa4d_sim.bus.motion import Point
from lwa4d_sim.interfaces import NS_PER_S, Ns

RAD_PER_MDEG = math.pi / 180_000  # positions are millidegrees at the joint (schunk_canopen_driver)
MDEG_S_PER_RPM = 6000  # 6080 is in revolutions per minute of the joint
MS = 1_000_000  # [ns]

# Reflected rotor inertia per newton metre of peak torque [kg m^2 / (N m)]: 0.19 at the 19 N m of an ERB 115
# (identified: OTFCtrlModRob, init_SchunkModDB.m); ASSUMED for all modules. Only the gains of its own loops follow.
INERTIA_PER_TORQUE = 0.01

STANDSTILL = 0.3 * 1000 * RAD_PER_MDEG  # [rad/s] slower is standing, where 606F is absent or zero (assumed: 0.3 deg/s)
WINDOW = 100 * RAD_PER_MDEG  # [rad] a target this near is reached, where 6067 is absent (assumed)
SPEED_WINDOW = 500 * RAD_PER_MDEG  # [rad/s] likewise for 606D (assumed)
SLOWEST = RAD_PER_MDEG  # [rad/s] and [rad/s^2]: a ramp of zero would never end
SWITCH_MARGIN = 0.01  # [rad] the limit switches of 60FD stand this far before the joint's ends (assumed)
OFF = 0xFFFF_FFFF  # following error window that means no supervision (CiA 402)


class Axis:
    """Everything in SI units and in the drive's coordinate, which is the joint angle less ``zero``.

    Attributes:
        q, dq: measured position [rad] and speed [rad/s].
        dq_shown: speed as the bus reads it [rad/s].
        tau: torque that acts [N m].
        tau_held: torque with which the loops held the axis when the brake last closed [N m].
        zero: joint angle of the drive's zero [rad]; homing moves it.
        inertia: that the loops are tuned for [kg m^2]; may be changed at any time.
        newton_metres: of one count of 6071, 6077 and 60B2: per mille of 6076, or milliamperes in profile `lwa4d`.
        position_count, speed_count: [rad] and [rad/s] of one count, negative where 607E turns the axis round.
        velocity_count: [rad/s] of one count of 6042 to 6044.
        full: the dictionary has what CiA 402 has and the firmware lacks.
    """

    def __init__(self, dictionary: Dictionary, joint: Joint, inertia: float | None) -> None:
        self.dictionary, self.joint = dictionary, joint
        self.full = (0x605A, 0) in dictionary
        self.inertia = INERTIA_PER_TORQUE * joint.torque if inertia is None else inertia
        self.q = self.dq = self.dq_shown = self.zero = 0.0
        self.tau = self.tau_held = 0.0
        self.load()

    def get(self, index: int, sub: int = 0, default: Any = 0) -> Any:
        """Value of an object, or the default if this drive does not have it."""
        return self.dictionary.values.get((index, sub), default)

    def load(self) -> None:
        """Read all parameters again; called after any of them was written."""
        joint, get = self.joint, self.get
        polarity = get(0x607E)
        self.position_count = -RAD_PER_MDEG if polarity & 0x80 else RAD_PER_MDEG
        self.speed_count = -RAD_PER_MDEG if polarity & 0x40 else RAD_PER_MDEG
        # the firmware's rule, socanmatic, schunk.eds: count [mdeg/s] = denominator / numerator / 6000
        self.velocity_count = get(0x604C, 2) / (get(0x604C, 1) or 1) / MDEG_S_PER_RPM * self.speed_count or RAD_PER_MDEG
        self.newton_metres = get(0x6076) / 1e6 if self.full else joint.torque_constant / 1000

        rated_current = get(0x6075) / 1000  # [A]
        # 6073 counts per mille of the rated current; where that is unknown it says nothing
        current = get(0x6073, default=1000) / 1000 * rated_current if rated_current else math.inf
        torque = get(0x6072) * self.newton_metres if self.full else math.inf
        self.torque_max = min(joint.torque, torque, current * joint.torque_constant)

        # zero is no limit
        motor = get(0x6080) * MDEG_S_PER_RPM * RAD_PER_MDEG or math.inf
        self.speed_max = min(get(0x607F) * RAD_PER_MDEG or math.inf, motor)
        if self.speed_max == math.inf:
            self.speed_max = joint.speed
        self.speed_guard = motor  # in torque modes; with it the drive must look at every instant
        self.profile_speed = min(max(get(0x6081) * RAD_PER_MDEG, SLOWEST), self.speed_max)
        fastest = (get(0x60C5) * RAD_PER_MDEG or math.inf, get(0x60C6) * RAD_PER_MDEG or math.inf)
        acceleration = get(0x6083) * RAD_PER_MDEG or joint.acceleration
        self.acceleration = max(min(acceleration, fastest[0]), SLOWEST)
        self.deceleration = max(min(get(0x6084) * RAD_PER_MDEG or acceleration, fastest[1]), SLOWEST)
        self.quick_deceleration = max(get(0x6085) * RAD_PER_MDEG or joint.acceleration, SLOWEST)

        low, high = get(0x607D, 1), get(0x607D, 2)
        self.low, self.high = -math.inf, math.inf
        if low < high:
            self.low, self.high = sorted((low * self.position_count, high * self.position_count))
        self.period = Ns(max(round(get(0x60C2, 1) * 10.0 ** get(0x60C2, 2) * NS_PER_S), MS))
        window = get(0x6065, default=OFF)
        self.window = math.inf if window == OFF else window * RAD_PER_MDEG
        self.window_time = get(0x6066) * MS
        self.reach, self.reach_time = get(0x6067) * RAD_PER_MDEG or WINDOW, get(0x6068) * MS
        self.speed_reach, self.speed_reach_time = get(0x606D) * RAD_PER_MDEG or SPEED_WINDOW, get(0x606E) * MS
        self.standstill = get(0x606F) * RAD_PER_MDEG or STANDSTILL

        self.speed_gain: float = get(0x2020)
        self.speed_time: float = get(0x2021)
        self.acceleration_share: float = get(0x2024)
        self.position_gain: float = get(0x2030)
        self.speed_share: float = get(0x2034)

    @property
    def open_loop(self) -> bool:
        """The speed loop is switched off (2020 = 0), and with it the position loop around it."""
        return bool(self.speed_gain == 0)

    @property
    def here(self) -> Point:
        """Where the joint is, as the start of a motion."""
        return Point(self.q, self.dq, 0.0)

    @property
    def standing(self) -> bool:
        """Slower than the threshold."""
        return abs(self.dq) < self.standstill

    @property
    def outside(self) -> bool:
        """Beyond a software limit by more than the window of a reached target."""
        return not self.low - self.reach <= self.q <= self.high + self.reach

    def inside(self, q: float) -> float:
        """The nearest position within the software limits."""
        return min(max(q, self.low), self.high)

    def switches(self) -> tuple[bool, bool]:
        """The negative and the positive limit switch."""
        q, low, high = self.q + self.zero, self.joint.low, self.joint.high
        return low is not None and q <= low + SWITCH_MARGIN, high is not None and q >= high - SWITCH_MARGIN

    def ramp(self, option: int) -> float:
        """Deceleration of an option code (605A to 605E) [rad/s^2].

        Codes 3 and 4, current and voltage limit: as much as the torque limit can do.
        """
        if option == 1:
            return self.deceleration
        if option == 2:
            return self.quick_deceleration
        return max(self.torque_max / self.inertia, self.quick_deceleration)
