"""The simulated bus in virtual time: the order of events, timers, and what a user of the wire can do.

At one instant a frame that ends is delivered first, then timers run in the order they were set, and last the bus, if
free, takes the most urgent frame queued by then. A frame begins at the very instant it may, not on a grid of bits.
"""

from collections import deque
from collections.abc import Callable, Iterable
from copy import deepcopy
from functools import partial
from heapq import heappop, heappush
from typing import Any, Literal

import can

from lwa4d_sim.bus.disturbances import NEVER, BitErrors, Disturbance, Match
from lwa4d_sim.bus.medium import Medium
from lwa4d_sim.bus.port import Listener, Timer, WirePort
from lwa4d_sim.bus.transmission import WireFrame
from lwa4d_sim.interfaces import Ns

__all__ = ["BitErrors", "Disturbance", "Timer", "Wire", "WireFrame", "WirePort"]

Tamper = Callable[[can.Message, str, Ns], list[tuple[Ns, can.Message]]]

_BEGIN = Ns(0)


class Wire(Medium):
    """Event kernel and medium.

    Args:
        bit_rate: bits a second; None: a frame costs no time and frames arrive in the order they were sent, errorless.
        start: instant at which simulated time begins [ns].
        errors: law of the bit errors.
        seed: of the bit errors.
        record: whether to keep `frames`.

    Attributes:
        now: simulated time [ns].
        frames: every transmission so far, in the order they ended, when recorded.
        busy: how long the wire was taken so far [ns], interframe spaces and error frames included.
        tamper: called with each frame sent, the port's name and the time; what it returns goes on the wire instead,
            each frame after an extra delay [ns].
    """

    def __init__(
        self,
        bit_rate: int | None = 500_000,
        *,
        start: Ns = _BEGIN,
        errors: BitErrors | None = None,
        seed: int = 0,
        record: bool = False,
    ) -> None:
        super().__init__(bit_rate, start, errors, seed, record)
        self.tamper: Tamper | None = None
        self._timers: list[tuple[int, int, Timer]] = []
        self._running = False

    def port(
        self,
        name: str,
        listener: Listener | None = None,
        *,
        transmit: Literal["priority", "fifo"] = "priority",
        recovers: bool = False,
        hears: bool = True,
        can_filters: can.typechecking.CanFilters | None = None,
    ) -> WirePort:
        """A new node on the wire; the arguments are those of `WirePort`."""
        if any(port.name == name for port in self._ports):
            raise ValueError(f"there is a port {name!r} on this wire already")
        port = WirePort(
            self, name, listener, transmit=transmit, recovers=recovers, hears=hears, can_filters=can_filters
        )
        self._ports += (port,)
        self._watch()
        return port

    @property
    def errors(self) -> BitErrors | None:
        """Law of the bit errors; can be set at any time and holds from the next frame on."""
        law = self._disturbances.law
        return law if law.probability else None

    @errors.setter
    def errors(self, errors: BitErrors | None) -> None:
        self._refuse_if_ideal(errors)
        self._disturbances.set_law(errors)
        self._watch()

    def disturb(self, match: Match, *, times: int = 1, bit: int = 20, at: str | None = None) -> Disturbance:
        """Disturb the next ``times`` transmissions, repetitions included, of the frames that ``match`` chooses.

        Args:
            match: called with the frame and its sender's name.
            times: number of transmissions; 32 in a row take an error free transmitter to bus-off.
            bit: the bit that is read wrong, counted from the start of frame with the stuff bits.
            at: name of the only receiver that reads it wrong, and finds out by the CRC; None: every node does.
        """
        self._refuse_if_ideal(match)
        item = Disturbance(match, times, bit, at)
        self._disturbances.script.append(item)
        self._watch()
        return item

    def call_at(self, t: Ns, callback: Callable[[], None]) -> Timer:
        """Call back at ``t`` [ns], at once (not from within this call) if that is past."""
        timer = Timer(callback)
        self._sequence += 1
        heappush(self._timers, (t if t > self.now else self.now, self._sequence, timer))
        return timer

    def run_until(self, t: Ns) -> None:
        """Let everything happen up to and including the instant ``t`` [ns]."""
        if t >= self.now:
            self._run((), t)

    def run_for(self, inbox: deque[can.Message], deadline: Ns | None) -> None:
        """Run until something is in the inbox, or the deadline [ns], or nothing is left to happen."""
        self._run(inbox, NEVER if deadline is None else deadline)

    def _run(self, inbox: Iterable[Any], limit: int) -> None:
        if self._running:
            raise RuntimeError("the wire is running: a listener or timer cannot wait on it")
        self._running = True
        timers = self._timers
        try:
            while not inbox:
                due = timers[0][0] if timers else NEVER
                if self._frame is not None:
                    if self._end <= due:
                        if self._end > limit:
                            break
                        self.now = Ns(self._end)
                        if self._verdict is None:
                            self._arrive(self._frame)
                        else:
                            self._settle(self._verdict)
                        continue
                elif self._queue and (self._free if self._free > self.now else self.now) < due:
                    if self._free > limit:
                        break
                    if self._free > self.now:
                        self.now = Ns(self._free)
                    self._start()
                    continue
                if due > limit or not timers:
                    break
                callback = heappop(timers)[2].callback
                if callback is not None:
                    self.now = Ns(due)
                    callback()
            if not inbox and self.now < limit < NEVER:
                self.now = Ns(limit)
        finally:
            self._running = False

    def put(self, port: WirePort, msg: can.Message) -> None:
        """Queue a frame of a port; part of `WirePort.send`."""
        if self.tamper is None:
            self._enter(port, msg)
            return
        for delay, instead in self.tamper(deepcopy(msg), port.name, self.now):
            if delay > 0:
                self.call_at(Ns(self.now + delay), partial(self._enter_late, port, instead))
            else:
                self._enter(port, instead)

    def _enter_late(self, port: WirePort, msg: can.Message) -> None:
        if port in self._nodes:
            self._enter(port, msg)
