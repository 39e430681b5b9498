"""One CiA 402 drive behind its node: loops, supervision, faults and what the bus may ask of it.

Two profiles answer to the same program. With the objects of CiA 402 the option codes say how to stop; the firmware has
none, and there every stop is the quick stop ramp and then the brake (Schunk_0_63.dcf).
"""

import math
from collections.abc import Callable
from typing import Any

from lwa4d_sim.bus import alarms
from lwa4d_sim.bus.axis import RAD_PER_MDEG, Axis
from lwa4d_sim.bus.brake import Brake
from lwa4d_sim.bus.cia402 import BLOCKED, DEVIATION, ENERGISED, LIMITED, Command, State
from lwa4d_sim.bus.device import Loss
from lwa4d_sim.bus.dictionary import Dictionary, Joint
from lwa4d_sim.bus.entry import INVALID, Abort
from lwa4d_sim.bus.gauges import HOT, Gauges
from lwa4d_sim.bus.homing import METHODS
from lwa4d_sim.bus.mode import Loop
from lwa4d_sim.bus.servo import GAINS, Servo
from lwa4d_sim.bus.steering import Steering, Why
from lwa4d_sim.bus.supervision import Supervision
from lwa4d_sim.interfaces import NS_PER_S, Ns

SET_POINTS = frozenset({0x6042, 0x6071, 0x607A, 0x60B0, 0x60B1, 0x60B2, 0x60C1, 0x60FF})
LOOP_PARAMETERS = range(0x2010, 0x2035)


class Drive:
    """The device behind a node.

    Args:
        dictionary: of the node; its profile decides how the drive answers.
        joint: constants of the joint.
        emergency: reports an error: emergency code and error register.
        recovered: says that an error is gone.
        catch_up: moves the plant on to an instant, with calls of `measure` and `torque`.
        inertia: for which the drive's own loops are tuned [kg m^2]; default from the peak torque (assumed).
        brake_delay: time the brake takes to open [s]; not public, default none.
        searched: the commutation search was done before power-on. If not, the axis must first be enabled in mode 7
            while SYNC runs; any other mode is a fault.
        ambient: temperature [degC].

    Attributes:
        steady: the torque cannot change before the next event on the bus.
        encoder_stuck: fault to be injected: the position stays as it is read, the speed is zero.
        brake: its ``works`` is the other fault to be injected.
        axis: the joint in the drive's eyes; its ``inertia`` may be changed at any time.
        gauges, steering: what the drive shows; and power state, mode, who has the axis.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        joint: Joint,
        emergency: Callable[[int, int], None],
        recovered: Callable[[int], None],
        catch_up: Callable[[Ns], None],
        *,
        inertia: float | None = None,
        brake_delay: float = 0.0,
        searched: bool = True,
        ambient: float = 25.0,
    ) -> None:
        self._dictionary = dictionary
        self._faults = alarms.Faults(emergency, recovered)
        self._catch_up = catch_up
        for index, gain in GAINS.items():
            dictionary.redefine((index, 0), gain)
        self.axis = Axis(dictionary, joint, inertia)
        self.gauges = Gauges(self.axis, ambient)
        self.brake = Brake(round(brake_delay * NS_PER_S))
        self.encoder_stuck = False
        self._searched_before = searched
        self.reset(Ns(0))

    @property
    def braked(self) -> bool:
        """The brake holds the joint."""
        return self.brake.holds

    @property
    def brake_works(self) -> bool:
        """False: the brake holds nothing."""
        return self.brake.works

    @brake_works.setter
    def brake_works(self, works: bool) -> None:
        self.brake.works = works

    def measure(self, q: float, dq: float, shown: float | None = None) -> None:
        """Take the joint's angle [rad] and speed [rad/s], and the speed that 606C is to show, if it is another."""
        axis = self.axis
        if self.encoder_stuck:
            axis.dq = axis.dq_shown = 0.0
        elif math.isfinite(q) and math.isfinite(dq):
            axis.q = round(q / RAD_PER_MDEG) * RAD_PER_MDEG - axis.zero
            axis.dq, axis.dq_shown = dq, dq if shown is None else shown
            self._blind = False
        else:
            self._blind = True
            self.fail(alarms.ENCODER)

    def torque(self, now: Ns, dt: float) -> float:
        """Torque [N m] for the next plant step of ``dt`` [s]."""
        axis = self.axis
        if not self.steady:
            if self.brake.opened(now):
                self.steering.opened(now)
            axis.tau = self._loops(now, dt)
        return axis.tau

    def _loops(self, now: Ns, dt: float) -> float:
        """One round of the loops that are closed."""
        axis, steering = self.axis, self.steering
        if self.brake.closed:
            return 0.0
        mode = steering.mode
        offset, excess, position, code = 0.0, 0.0, True, 0
        stopping = steering.why is not Why.RUN
        if not stopping:
            if mode.loop is Loop.TORQUE:
                self._supervision.forget()
                self._settle(now)
                return self._limited(mode.torque(now))
            ref, offset, excess = mode.demand(now), mode.torque(now), mode.excess
            position, code = mode.loop is Loop.POSITION, mode.fault(now)
        else:
            if steering.standing(now):
                steering.stand(now)
                self._settle(now)
                return self._loops(now, dt)
            ref = steering.stop.at(now)
        tau = self._servo.torque(ref, offset, dt, position=position, stopping=stopping)
        if not math.isfinite(tau):
            self._servo.preset(0.0)
            code = alarms.PARAMETER
        elif steering.why is not Why.FAULT:
            code = code or self._supervision.follow(ref.q - axis.q + excess if position else 0.0, now)
        if code and self.fail(code):
            return self._loops(now, dt)
        return tau if math.isfinite(tau) else 0.0

    def _limited(self, tau: float) -> float:
        """Torque of a torque mode within the limits of torque and, where it is watched, of speed."""
        axis = self.axis
        high = axis.torque_max
        low = -high
        if axis.speed_guard < math.inf:
            stiffness = axis.inertia * GAINS[0x2020]
            high = min(max(stiffness * (axis.speed_guard - axis.dq), low), high)
            low = max(min(-stiffness * (axis.speed_guard + axis.dq), high), low)
        self._clipped = not low <= tau <= high
        return min(max(tau, low), high)

    def reset(self, now: Ns) -> None:
        """As after power-on: brake closed, SWITCH ON DISABLED."""
        self._now = now
        axis = self.axis
        axis.load()
        axis.tau = axis.tau_held = 0.0
        self._servo, self._supervision = Servo(axis), Supervision(axis)
        self.steering = Steering(axis, self.brake, self._servo, self.fail)
        self._clipped = False
        self._parameters: dict[tuple[int, int], Any] = {}  # as last taken over
        self._faults.active.clear()
        self._blind = False
        self.steering.search(done=self._searched_before)
        self._settle(now)

    def advance(self, now: Ns) -> None:
        """Bring the plant up to now."""
        self._now = now
        self._catch_up(now)

    def refresh(self) -> None:
        """Actual values and statusword into the dictionary."""
        now, axis, steering = self._now, self.axis, self.steering
        self.gauges.heat(axis.tau, now)
        if self.gauges.temperature >= HOT:
            self.fail(alarms.OVERHEATED)
        ref, error = steering.reference(now)
        bits = steering.status(now)
        if alarms.FOLLOWING in self._faults.active or abs(error) > axis.window:
            bits |= DEVIATION
        if self._clipped or self._servo.saturated or axis.outside:
            bits |= LIMITED
        if self._servo.saturated and axis.standing and not axis.full:
            bits |= BLOCKED
        self.gauges.show(steering.machine.state, bits, ref, error)

    def written(self, index: int, sub: int) -> None:
        """React to a write from the bus.

        Raises:
            Abort: a mode, homing method or gain that the drive does not have.
        """
        now, dictionary, steering = self._now, self._dictionary, self.steering
        value = dictionary[index, sub]
        if index == 0x6040:
            if value != steering.word or steering.why is not Why.RUN:
                self._control(value, now)
            return
        if index in SET_POINTS:
            mode = steering.mode
            if index in mode.set_points and steering.why is Why.RUN and not self.brake.closed:
                mode.write(index, now)
                if mode.loop is Loop.TORQUE:
                    self._settle(now)
            return
        if self._parameters.get((index, sub)) == value and index != 0x60FE:
            return
        if index == 0x6060:
            if not steering.has(value):
                raise Abort(INVALID)
            steering.asked = value
        elif index == 0x60FE:
            in_control = steering.machine.state in ENERGISED
            self.brake.by_hand(dictionary[0x60FE, 1], dictionary[0x60FE, 2], in_control=in_control)
        elif (index == 0x6098 and value not in METHODS) or (index in LOOP_PARAMETERS and not 0 <= value < math.inf):
            raise Abort(INVALID)
        self._parameters[index, sub] = value
        self.axis.load()
        self._settle(now)

    def sync(self, now: Ns) -> None:
        """SYNC: feeds the watchdog and the commutation search."""
        if self._supervision.sync(now):
            self._faults.recovered(alarms.SYNC_LOST)
        self.steering.sync(now)

    def lost(self, reason: Loss, now: Ns) -> None:
        """The master is lost: abort connection option 6007, in the firmware always a quick stop."""
        option = self.axis.get(0x6007, default=3)
        if option == 1:
            self.fail(alarms.LOSS_CODES[reason], report=False)
        elif option and self.steering.machine.state is State.OPERATION_ENABLED:
            self.steering.ask(Command.DISABLE_VOLTAGE if option == 2 else Command.QUICK_STOP)
            self._settle(now)

    def poll(self, now: Ns) -> Ns | None:
        """SYNC watchdog: a quick stop and an emergency."""
        if self.steering.machine.state is not State.OPERATION_ENABLED:
            return None
        deadline = self._supervision.sync_deadline()
        if deadline is None or now < deadline:
            return deadline
        self._supervision.silent = True
        self._faults.emergency(alarms.SYNC_LOST, alarms.register(alarms.SYNC_LOST))
        self.steering.ask(Command.QUICK_STOP)
        self._settle(now)
        return None

    def fail(self, code: int, *, report: bool = True) -> bool:
        """A fault: its reaction and, once, its emergency. Whether it is new and so changes anything.

        Args:
            code: emergency code, as in libPowerballArm, schunkErrors.h.
            report: send the emergency; False if the node does it.
        """
        if code in self._faults.active:
            return False
        if code in alarms.UNDER_VOLTAGE:
            self.steering.search(done=self._searched_before)
        if self.steering.machine.fault() and self.axis.full:
            self._dictionary[0x603F, 0] = code
        self._faults.come(code, report=report)
        self._settle(self._now)
        return True

    def _control(self, word: int, now: Ns) -> None:
        steering = self.steering
        enabled = steering.machine.state is State.OPERATION_ENABLED
        resettable = not self._blind and self.gauges.temperature < HOT
        if steering.control(word, now, resettable=resettable):
            self._faults.reset()
            self._supervision.forget()
            if self.axis.full:
                self._dictionary[0x603F, 0] = 0
        if not enabled and steering.machine.state is State.OPERATION_ENABLED:
            self._supervision.enabled(now)
        self._settle(now)

    def _settle(self, now: Ns) -> None:
        """After an event: who has the axis, and whether its torque stays as it is."""
        steering, axis = self.steering, self.axis
        steering.settle(now)
        mode = steering.mode
        if self.brake.closed:
            axis.tau, self._clipped = 0.0, False
            self.steady = self.brake.opening is None
            self._supervision.forget()
        elif steering.why is Why.RUN and mode.loop is Loop.TORQUE:
            self.steady = math.isinf(axis.speed_guard) and mode.constant(now)
            if self.steady:
                axis.tau = self._limited(mode.torque(now))
        else:
            self.steady = self._clipped = False
