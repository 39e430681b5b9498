"""A node's connection to the simulated wire, with the interface of python-can.

All in simulated time and in the caller's thread: `recv` lets the wire run on, periodic sending is a timer of the wire.
A `can.Notifier` reads in a thread of its own and has no place here; a listener of the port takes its part.
"""

from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Literal, Protocol

import can
from can.broadcastmanager import (
    CyclicSendTaskABC,
    LimitedDurationCyclicSendTaskABC,
    ModifiableCyclicTaskABC,
    RestartableCyclicTaskABC,
)

from lwa4d_sim.bus.confinement import Counters
from lwa4d_sim.bus.transmission import Pending
from lwa4d_sim.interfaces import NS_PER_S, Ns, to_ns

Listener = Callable[[can.Message, Ns], None]


class Timer:
    """A call the wire will make. `cancel` forgets it."""

    __slots__ = ("callback",)

    def __init__(self, callback: Callable[[], None]) -> None:
        self.callback: Callable[[], None] | None = callback

    def cancel(self) -> None:
        """Never call it; no harm if it was called or cancelled before."""
        self.callback = None


class Carrier(Protocol):
    """The wire as a port sees it."""

    now: Ns

    def put(self, port: "WirePort", msg: can.Message) -> None:
        """Queue a frame of the port, from now on in the arbitration."""
        ...

    def call_at(self, t: Ns, callback: Callable[[], None]) -> Timer:
        """Call back at ``t``."""
        ...

    def run_for(self, inbox: deque[can.Message], deadline: Ns | None) -> None:
        """Run until something is in the inbox, or the deadline, or nothing is left to happen."""
        ...

    def discard(self, port: "WirePort") -> None:
        """Forget the frames the port has queued."""
        ...

    def leave(self, port: "WirePort") -> None:
        """Take the port off the wire."""
        ...

    def recover(self, port: "WirePort") -> None:
        """Begin the recovery of a port from bus-off."""
        ...


class WirePort(can.BusABC):
    """One CAN controller on a `Wire`; get one from `Wire.port`.

    A received message is handed to all ports alike: treat it as read-only.

    Attributes:
        name: name of the node in the wire's record.
        counters: its error counters.
        sends_by_priority: whether the controller offers its most urgent frame (mailboxes) or the oldest (a queue).
        recovers: whether it returns from bus-off by itself.
        hears: whether it wants the frames of others; without, it acknowledges them and is told of error states only.
        listener: called with each received message and its reception instant, or None: messages queue for `recv`.
        inbox: received messages that wait for `recv`.
        lanes: frames queued behind those in the arbitration; the wire's.
        ready: instant from which it may send [ns]; an error passive node pauses after its own frames. The wire's.
    """

    def __init__(
        self,
        wire: Carrier,
        name: str,
        listener: Listener | None = None,
        *,
        transmit: Literal["priority", "fifo"] = "priority",
        recovers: bool = False,
        hears: bool = True,
        can_filters: can.typechecking.CanFilters | None = None,
    ) -> None:
        if transmit not in ("priority", "fifo"):
            raise ValueError(f"a port transmits by 'priority' or 'fifo', not {transmit!r}")
        self._wire = wire
        self.name = self.channel_info = name
        self.counters = Counters()
        self.sends_by_priority = transmit == "priority"
        self.recovers = recovers
        self.hears = hears
        self.listener = listener
        self.inbox: deque[can.Message] = deque()
        self.lanes: dict[int, deque[Pending] | None] = {}
        self.ready = wire.now
        super().__init__(channel=name, can_filters=can_filters)

    @property
    def tec(self) -> int:
        """Transmit error counter."""
        return self.counters.tec

    @property
    def rec(self) -> int:
        """Receive error counter."""
        return self.counters.rec

    @property
    def state(self) -> can.BusState:
        """ACTIVE: error active. PASSIVE: error passive. ERROR: bus-off."""
        return self.counters.state

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        raise NotImplementedError("the state follows from what happens on the wire")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Queue a copy of the frame for transmission; never waits, whatever ``timeout`` says.

        Raises:
            can.CanOperationError: the port is bus-off or shut down.
            ValueError: not a well-formed classic CAN frame.
        """
        if self.counters.off:
            raise can.CanOperationError(f"{self.name} is bus-off")
        self._open()
        self._wire.put(self, msg)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next received message, or None when ``timeout`` [s] of simulated time have passed without one.

        Simulated time moves on while it waits, so everything else on the wire happens meanwhile.

        Raises:
            can.CanOperationError: the port is shut down, or waits without end on a wire where nothing will happen.
        """
        self._open()
        inbox = self.inbox
        if not inbox:
            deadline = None if timeout is None else Ns(self._wire.now + max(0, to_ns(timeout)))
            self._wire.run_for(inbox, deadline)
            if not inbox:
                if timeout is None:
                    raise can.CanOperationError(f"{self.name} waits without a timeout, and nothing is left to happen")
                return None
        return inbox.popleft()

    def flush_tx_buffer(self) -> None:
        """Forget queued frames, but not one that is on the wire."""
        self._wire.discard(self)

    def recover(self) -> None:
        """Leave bus-off, after 128 times 11 recessive bits on the wire; nothing if it is not bus-off."""
        self._wire.recover(self)

    def shutdown(self) -> None:
        """Leave the wire; queued frames are forgotten. Can be called again."""
        if not self._is_shutdown:
            super().shutdown()
            self._wire.leave(self)

    def _open(self) -> None:
        if self._is_shutdown:
            raise can.CanOperationError(f"{self.name} is shut down")

    def _apply_filters(self, filters: can.typechecking.CanFilters | None) -> None:
        """Nothing to set in hardware; `take` asks at each reception."""

    def take(self, msg: can.Message, now: Ns) -> None:
        """Receive a message, if the filters let it through; called by the wire."""
        if self._filters is not None and not self._matches_filters(msg):
            return
        if self.listener is not None:
            self.listener(msg, now)
        else:
            self.inbox.append(msg)

    def tell(self, kind: int, now: Ns) -> None:
        """Receive an error frame, filtered or not: the error state has changed; called by the wire."""
        msg = self.counters.report(kind, self.name, now / NS_PER_S)
        if self.listener is not None:
            self.listener(msg, now)
        else:
            self.inbox.append(msg)

    def _send_periodic_internal(
        self,
        msgs: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None = None,
        autostart: bool = True,
        modifier_callback: Callable[[can.Message], None] | None = None,
    ) -> CyclicSendTaskABC:
        task = _Periodic(self, self._wire, msgs, period, duration, modifier_callback)
        if autostart:
            task.start()
        return task

    def __del__(self) -> None:
        """Says nothing: unlike a device, a simulated port that is dropped need not be closed."""


class _Periodic(LimitedDurationCyclicSendTaskABC, ModifiableCyclicTaskABC, RestartableCyclicTaskABC):
    """Frames sent one after the other, one a period, by a timer of the wire."""

    def __init__(
        self,
        port: WirePort,
        wire: Carrier,
        messages: Sequence[can.Message] | can.Message,
        period: float,
        duration: float | None,
        modifier: Callable[[can.Message], None] | None,
    ) -> None:
        super().__init__(messages, period, duration)
        if self.period_ns <= 0:
            raise ValueError(f"a period of {period} s cannot be kept")
        self._port, self._wire, self._modifier = port, wire, modifier
        self._timer: Timer | None = None

    def start(self) -> None:
        """Send the first frame now."""
        self.stop()
        self._end = None if self.duration is None else self._wire.now + to_ns(self.duration)
        self._count = 0
        self._timer = self._wire.call_at(self._wire.now, self._beat)

    def stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _beat(self) -> None:
        now = self._wire.now
        if self._end is not None and now >= self._end:
            self._timer = None
            return
        self._timer = self._wire.call_at(Ns(now + self.period_ns), self._beat)
        msg = self.messages[self._count % len(self.messages)]
        self._count += 1
        if self._modifier is not None:
            self._modifier(msg)
        with suppress(can.CanOperationError):  # bus-off now; it may come back
            self._port.send(msg)
