"""Who has the axis: its mode, or a stop that ends with the brake.

The power state, the halt bit and a wish for another mode each may take the axis away from the mode. What they want is
worked out anew after every event, so that there is one rule for every order in which things happen.
"""

from collections.abc import Callable
from enum import Enum

from lwa4d_sim.bus import alarms
from lwa4d_sim.bus.axis import Axis
from lwa4d_sim.bus.brake import Brake
from lwa4d_sim.bus.cia402 import ENERGISED, HALT, LIMITED, REACHED, SPECIFIC, Command, Machine, State
from lwa4d_sim.bus.homing import Homing
from lwa4d_sim.bus.mode import Loop, Mode
from lwa4d_sim.bus.motion import Motion, Point, rest, stop
from lwa4d_sim.bus.position_modes import START, CyclicPosition, InterpolatedPosition, ProfilePosition
from lwa4d_sim.bus.servo import Servo
from lwa4d_sim.bus.speed_modes import CyclicSpeed, ProfileSpeed, Velocity
from lwa4d_sim.bus.torque_modes import CyclicTorque, ProfileTorque
from lwa4d_sim.interfaces import NS_PER_S, Ns

MODES: tuple[type[Mode], ...] = (
    *(Mode, ProfilePosition, Velocity, ProfileSpeed, ProfileTorque, Homing, InterpolatedPosition),
    *(CyclicPosition, CyclicSpeed, CyclicTorque),
)
UNSEARCHED = frozenset({0, 7})  # modes that need no commutation search before them
CYCLIC = frozenset({8, 9, 10})  # modes whose statusword bit 12 says that the set-point is followed

SEARCH_SYNCS = 50  # SYNCs that the commutation search takes (assumed; the FZI driver waits for up to 50 periods)
SEARCHED, VERIFIED = 1, 2  # bits of 2050: commutation search done, pseudo-absolute position verified
PATIENCE = NS_PER_S  # [ns] after the end of a ramp the brake closes even if the axis still moves (assumed: 1 s)


class Why(Enum):
    """Why the mode does not have the axis, and the object that says how to stop; RUN: it has."""

    OFF = 0
    RUN = 1
    MODE = 0x6060  # the axis is to stand still before it takes another mode
    HALT = 0x605D
    DISABLE = 0x605C
    SHUTDOWN = 0x605B
    QUICK_STOP = 0x605A
    FAULT = 0x605E


_RAMPS = {5: Why.DISABLE, 8: Why.SHUTDOWN}
_COAST = 0  # option code: no ramp
_SLOW_DOWN = 1  # option code, for a change of mode (assumed)
_FIXED = 2  # option code of the firmware, which has no objects for them: quick stop ramp (Schunk_0_63.dcf)


class Steering:
    """Of one drive.

    Args:
        axis: the joint.
        brake: its brake.
        servo: its loops.
        fail: reports a fault.

    Attributes:
        machine: the power state.
        mode: the mode that is active (6061).
        asked: the mode that was asked for (6060).
        why: who has the axis.
        stop: the ramp while the mode has not.
        stood: the ramp is over and the axis stands.
        searched: the commutation search is done.
    """

    def __init__(self, axis: Axis, brake: Brake, servo: Servo, fail: Callable[[int], object]) -> None:
        self._axis, self._brake, self._servo, self._fail = axis, brake, servo, fail
        self._modes = {kind.number: kind(axis) for kind in MODES}
        self.machine = Machine()
        self.machine.finish()
        self.asked: int = axis.get(0x6060)
        self.word = 0
        self._before = 0  # controlword before the one that enabled
        self.why = Why.OFF
        self.stop: Motion = rest(Ns(0), axis.q)
        self.stood = True
        self.searched = True
        self._syncs = 0
        self._fresh = True  # the mode begins, and does not go on
        brake.close()
        self._switch()

    def has(self, number: int) -> bool:
        """Whether this drive knows a mode."""
        return number == 0 or (number in self._modes and bool(self._axis.get(0x6502) >> number - 1 & 1))

    def control(self, word: int, now: Ns, *, resettable: bool) -> bool:
        """Take a controlword; whether it has reset a fault."""
        before, self.word = self.word, word
        self._set_stays()
        arrow = self.machine.command(word, resettable=resettable)
        if arrow is not None and arrow.target is State.OPERATION_ENABLED:
            self._before, self._fresh = before, True
        elif self.machine.state is State.OPERATION_ENABLED and not self._fresh:
            self.mode.control(self.bits, now)
        return arrow is not None and arrow.number == 15

    def ask(self, wish: Command) -> None:
        """A command that the drive gives itself."""
        self._set_stays()
        self.machine.request(wish)

    @property
    def bits(self) -> int:
        """Controlword for the mode: bit 4 starts nothing before the commutation search is done."""
        return self.word if self.searched else self.word & ~START

    def search(self, *, done: bool) -> None:
        """Set whether the commutation search is done."""
        self.searched, self._syncs = done, 0
        self._axis.dictionary[0x2050, 0] = VERIFIED | (SEARCHED if done else 0)

    def sync(self, now: Ns) -> None:
        """SYNC: in mode 7 it carries the commutation search on (schunk_canopen_driver); the axis stands."""
        if not self.searched and self.why is Why.RUN and self.mode.number == 7:
            self._syncs += 1
            if self._syncs >= SEARCH_SYNCS:
                self.search(done=True)
                self.mode.control(self.bits, now)

    def settle(self, now: Ns) -> None:
        """Work out who has the axis now, and begin what follows from a change."""
        why = self._reason()
        if why is Why.OFF:
            self._brake.close()
            self.why, self.stood = why, True
            if self.asked != self.mode.number:
                self._switch()
        elif why is not self.why:
            before, self.why = self.why, why
            if why is Why.RUN:
                self._run(now, before)
            else:
                self._begin_stop(now, before)

    def opened(self, now: Ns) -> None:
        """The brake has opened."""
        self._servo.preset(self._axis.tau_held)
        if self.why is Why.RUN:
            self._start(now)
        else:
            self.stop = rest(now, self._axis.q)

    def standing(self, now: Ns) -> bool:
        """Whether a stop has just come to its end."""
        over = not self.stood and now >= self.stop.end
        return over and (self._axis.standing or now >= self.stop.end + PATIENCE)

    def stand(self, now: Ns) -> None:
        """A stop is over: take what follows from it."""
        self.stood = True
        if self.why is Why.MODE:
            self._switch()
        elif self.why is not Why.HALT or not self._axis.full:
            self._axis.tau_held = self._axis.tau
            self._brake.close()
            if self.why is not Why.HALT:
                self.machine.finish()
        self.settle(now)

    def reference(self, now: Ns) -> tuple[Point, float]:
        """Where the loops are to be, and the following error [rad]; without loops, where the joint is."""
        axis, mode = self._axis, self.mode
        if self._brake.closed or (self.why is Why.RUN and mode.loop is Loop.TORQUE):
            return axis.here, 0.0
        if self.why is not Why.RUN:
            ref = self.stop.at(now)
            return ref, ref.q - axis.q
        ref = mode.demand(now)
        return ref, ref.q - axis.q + mode.excess if mode.loop is Loop.POSITION else 0.0

    def status(self, now: Ns) -> int:
        """Statusword bits 10 to 13: those of the mode, and of a stop that bit 10 reports."""
        bits = 0
        if self.why is Why.RUN:
            bits = self.mode.bits(now) | (LIMITED if self.mode.limited else 0)
        elif self.why is Why.HALT:
            bits = self.mode.bits(now) & ~(REACHED | SPECIFIC if self.mode.number in CYCLIC else REACHED)
        if self.stood and self.why in (Why.HALT, Why.QUICK_STOP) and self._axis.standing:
            bits |= REACHED
        return bits

    def _reason(self) -> Why:
        machine = self.machine
        if machine.state is State.OPERATION_ENABLED:
            if machine.ending is not None:
                return _RAMPS[machine.ending.number]
            if self.asked != self.mode.number:
                return Why.MODE
            return Why.HALT if self.word & HALT else Why.RUN
        if machine.state not in ENERGISED:
            return Why.OFF
        return Why.FAULT if machine.state is State.FAULT_REACTION else Why.QUICK_STOP

    def _run(self, now: Ns, before: Why) -> None:
        if not self.searched and self.mode.number not in UNSEARCHED:
            self._fail(alarms.COMMUTATION)
        elif self._brake.closed:
            self._brake.open(now)
            if self._brake.opened(now):
                self.opened(now)
        else:
            self._start(now)

    def _start(self, now: Ns) -> None:
        if self._fresh:
            self._fresh = False
            self.mode.enter(now, self._before if self.searched else self._before & ~START)
            self.mode.control(self.bits, now)
        else:
            self.mode.resume(now)

    def _begin_stop(self, now: Ns, before: Why) -> None:
        axis, brake = self._axis, self._brake
        self.stood = False
        if brake.closed:
            self.stop = rest(now, axis.q)
            if self.why is Why.HALT and axis.full:  # with the objects of CiA 402 a halted axis is held by its loops
                brake.open(now)
                if brake.opened(now):
                    self.opened(now)
            else:
                self.stand(now)
            return
        option = axis.get(self.why.value, default=_FIXED) if self.why is not Why.MODE else _SLOW_DOWN
        if option == _COAST:
            self.stand(now)
            return
        at = axis.here
        if before is Why.RUN:
            if self.mode.loop is Loop.POSITION and self.why is not Why.FAULT:
                at = self.mode.demand(now)
            elif self.mode.loop is Loop.TORQUE:
                self._servo.preset(axis.tau)
        elif self.why is not Why.FAULT:
            at = self.stop.at(now)
        self.stop = stop(now, at, axis.ramp(option if option < 5 else option - 4))

    def _switch(self) -> None:
        """Make the mode that was asked for the active one."""
        self.mode = self._modes[self.asked]
        self._axis.dictionary[0x6061, 0] = self.asked
        self._before, self._fresh = self.word, True

    def _set_stays(self) -> None:
        self.machine.stays = self._axis.get(0x605A, default=_FIXED) > 4
