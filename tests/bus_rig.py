"""One drive on a test bench: a joint of one mass with friction and gravity, and a bus that only writes objects."""

import math
from collections.abc import Callable
from typing import Any, Literal

from lwa4d_sim.bus.cia402 import State, state_of
from lwa4d_sim.bus.dictionary import Joint, drive_dictionary
from lwa4d_sim.bus.drive import Drive
from lwa4d_sim.interfaces import Ns

MS = 1_000_000
MDEG = 180_000 / math.pi  # counts in one radian
JOINT = Joint(name="bench", low=-2.0, high=2.0, speed=1.0, acceleration=5.0, torque=40.0)

Profile = Literal["lwa4d", "cia402"]


class Bench:
    """J ddq = tau - viscous dq - coulomb sign(dq) - gravity cos(q), in steps of 1 ms; SYNC every ``period``."""

    def __init__(self, profile: Profile = "cia402", *, gravity: float = 8.0, q: float = 0.3, **options: Any) -> None:
        self.inertia, self.viscous, self.coulomb, self.gravity = 0.6, 1.0, 0.5, gravity
        self.q, self.dq, self.now = q, 0.0, 0
        self.blocked, self.load = False, 0.0  # held from outside; torque from outside [N m]
        self.errors: list[tuple[int, int]] = []
        self.gone: list[int] = []
        self.log: list[tuple[int, float, float, float, bool]] = []  # ms, q, dq, tau, braked
        self.dictionary = drive_dictionary(profile, 3, JOINT)
        self.drive = Drive(
            self.dictionary,
            JOINT,
            lambda code, register: self.errors.append((code, register)),
            self.gone.append,
            self._catch_up,
            **{"inertia": self.inertia, **options},
        )
        self.drive.measure(self.q, self.dq)
        self.period = 10
        self.each: Callable[[int], None] = lambda k: None  # what the master does before each SYNC
        self.syncing = True
        self._count = 0
        self.set(0x60C2, 1, self.period)

    # what a bus does

    def set(self, index: int, sub: int, value: Any) -> None:
        """Write an object."""
        self.drive.advance(Ns(self.now * MS))
        old = self.dictionary[index, sub]
        self.dictionary[index, sub] = value
        try:
            self.drive.written(index, sub)
        except Exception:
            self.dictionary[index, sub] = old
            raise

    def get(self, index: int, sub: int = 0) -> Any:
        """Read an object."""
        self.drive.advance(Ns(self.now * MS))
        self.drive.refresh()
        return self.dictionary[index, sub]

    def word(self, value: int) -> State:
        """Write the controlword; the state after it."""
        self.set(0x6040, 0, value)
        return self.state

    @property
    def status(self) -> int:
        return int(self.get(0x6041))

    @property
    def state(self) -> State:
        found = state_of(self.status)
        assert found is not None
        return found

    def bit(self, number: int) -> bool:
        return bool(self.status >> number & 1)

    def run(self, ms: int) -> None:
        """Let time pass, with SYNCs."""
        for _ in range(ms):
            if self.now % self.period == 0 and self.syncing:
                self.drive.advance(Ns(self.now * MS))
                self.each(self._count)
                self.drive.sync(Ns(self.now * MS))
                self._count += 1
            self.drive.poll(Ns(self.now * MS))
            self.now += 1
            self.drive.advance(Ns(self.now * MS))

    def until(self, condition: Callable[[], bool], ms: int = 5000) -> int:
        """Let time pass until a condition holds; how long [ms]."""
        start = self.now
        while not condition():
            assert self.now - start < ms, f"not within {ms} ms: status {self.status:04X}, errors {self.errors}"
            self.run(1)
        return self.now - start

    def enable(self, mode: int, word: int = 0x0F) -> None:
        """To operation enabled in a mode."""
        self.set(0x6060, 0, mode)
        for each in (0x06, 0x07, word):
            self.word(each)
        assert self.state is State.OPERATION_ENABLED, self.errors
        assert self.get(0x6061) == mode

    # the joint

    def _catch_up(self, now: Ns) -> None:
        while len(self.log) * MS < now:
            t = Ns(len(self.log) * MS)
            tau = self.drive.torque(t, 0.001)
            assert math.isfinite(tau)
            if self.drive.braked or self.blocked:
                self.dq = 0.0
            else:
                for _ in range(4):  # small enough to neglect the integration error
                    push = tau + self.load - self.viscous * self.dq - self.gravity * math.cos(self.q)
                    rub = self.coulomb * math.tanh(self.dq / 1e-3)
                    self.dq += (push - rub) / self.inertia * 0.00025
                    self.q += self.dq * 0.00025
            self.log.append((len(self.log), self.q, self.dq, tau, self.drive.braked))
            self.drive.measure(self.q, self.dq)
