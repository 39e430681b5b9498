"""The medium: arbitration, one frame at a time, delivery, repetition, bus-off and return from it."""

from collections import deque
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import partial
from heapq import heapify, heappop, heappush
from typing import Literal

import can

from lwa4d_sim.bus.confinement import (
    ERROR_BUS_OFF,
    ERROR_CONTROLLER,
    ERROR_RESTARTED,
    RECOVERY_SEQUENCES,
    SEQUENCE_BITS,
    SUSPEND_BITS,
    Outcome,
)
from lwa4d_sim.bus.disturbances import BitErrors, Disturbances, Verdict
from lwa4d_sim.bus.frames import INTERFRAME_BITS, arbitration_key, frame_bits
from lwa4d_sim.bus.port import Timer, WirePort
from lwa4d_sim.bus.transmission import Pending, WireFrame
from lwa4d_sim.interfaces import NS_PER_S, Ns


@dataclass(slots=True)
class _Recovery:
    """A node on its way back from bus-off: sequences of recessive bits it still lacks, and where the present begins."""

    missing: int
    since: int
    timer: Timer


class Medium:
    """What all ports share. `Wire` adds the order of events.

    The common case, no error in sight, keeps to `_start` and `_arrive`. Whatever makes a bus interesting sets `_alert`
    and goes through a `Verdict`.
    """

    def __init__(self, bit_rate: int | None, start: Ns, errors: BitErrors | None, seed: int, record: bool) -> None:
        if bit_rate is not None and bit_rate <= 0:
            raise ValueError(f"a bit rate is positive, not {bit_rate}")
        self._num, self._den = (0, 1) if bit_rate is None else (NS_PER_S, bit_rate)  # ns of a bit
        self._ideal = bit_rate is None
        self._refuse_if_ideal(errors)
        self.now = start
        self.frames: list[WireFrame] = []
        self.busy = 0
        self._record = record
        self._disturbances = Disturbances(errors, seed)
        self._ports: tuple[WirePort, ...] = ()
        self._nodes: tuple[WirePort, ...] = ()  # the ports that are not bus-off
        self._hearers: tuple[WirePort, ...] = ()  # those of them that want to have the frames
        self._queue: list[tuple[int, int, Pending]] = []  # frames in the arbitration: at most one a port and lane
        self._sequence = 0
        self._frame: Pending | None = None  # on the wire
        self._verdict: Verdict | None = None  # how that will end; None: as it should
        self._end = 0  # and when
        self._free: int = start  # when the next frame may begin
        self._idle: int = start  # when the last one, with its interframe space, was over
        self._recovering: dict[WirePort, _Recovery] = {}
        self._watch()

    def call_at(self, t: Ns, callback: Callable[[], None]) -> Timer:
        """Call back at ``t`` [ns]."""
        raise NotImplementedError

    def _refuse_if_ideal(self, trouble: object) -> None:
        if self._ideal and trouble is not None:
            raise ValueError("a wire on which frames cost no time has no bits to disturb")

    def _watch(self) -> None:
        """Look again at who takes part, and whether all is well."""
        self._nodes = tuple(port for port in self._ports if not port.counters.off)
        self._hearers = tuple(port for port in self._nodes if port.hears)
        self._alert = not self._ideal and (
            len(self._nodes) < 2
            or bool(self._recovering)
            or bool(self._disturbances.script)
            or any(port.tec or port.rec for port in self._nodes)
        )
        self._free = self._idle  # whoever made others wait may be gone

    def _enter(self, port: WirePort, msg: can.Message) -> None:
        bits = frame_bits(msg)
        can_id, extended, remote = msg.arbitration_id, msg.is_extended_id, msg.is_remote_frame
        msg = can.Message(0.0, can_id, extended, remote, False, None, msg.dlc, msg.data[:])
        self._sequence = seq = self._sequence + 1
        key = seq if self._ideal else arbitration_key(msg)
        lane = key if port.sends_by_priority and not self._ideal else 0
        if self._alert:
            self._free = self._idle
        frame = Pending(msg, port, key, lane, seq, bits, self.now)
        lanes = port.lanes
        if lane not in lanes:
            lanes[lane] = None
            heappush(self._queue, (key, seq, frame))
        elif (waiting := lanes[lane]) is None:
            lanes[lane] = deque((frame,))
        else:
            waiting.append(frame)

    def _start(self) -> None:
        """The most urgent frame goes on the wire."""
        queue = self._queue
        frame = heappop(queue)[2]
        bits = frame.bits - INTERFRAME_BITS
        if self._alert or (queue and queue[0][0] == frame.key) or not self._disturbances.passes(bits):
            self._start_on_alert(frame)
            return
        frame.started = self.now
        frame.attempt += 1
        self._frame = frame
        self._end = self.now + bits * self._num // self._den

    def _arrive(self, frame: Pending) -> None:
        """A frame that met no error is through."""
        now, port, msg = self.now, frame.port, frame.msg
        self._frame = None
        self._free = self._idle = frame.started + frame.bits * self._num // self._den
        self.busy += self._free - frame.started
        self._next(frame)
        if self._record:
            self._note(frame, "sent", now)
        msg.timestamp = now / NS_PER_S
        for other in self._hearers:
            if other is not port:
                other.take(msg, now)

    def _next(self, frame: Pending) -> None:
        """What stood behind a frame that is done with enters the arbitration."""
        lanes, lane = frame.port.lanes, frame.lane
        waiting = lanes.get(lane)
        if waiting:
            follower = waiting.popleft()
            heappush(self._queue, (follower.key, follower.seq, follower))
        else:
            lanes.pop(lane, None)

    def _start_on_alert(self, frame: Pending) -> None:
        """As `_start`, when nodes may pause, collide, be disturbed, or find nobody who answers."""
        now, queue = self.now, self._queue
        rivals = [frame]
        paused: list[Pending] = []
        contenders: list[Pending] = []
        while True:
            while queue and queue[0][0] == rivals[0].key:
                rivals.append(heappop(queue)[2])
            for rival in rivals:
                (paused if rival.port.ready > now else contenders).append(rival)
            if contenders or not queue:
                break
            rivals = [heappop(queue)[2]]
        for rival in paused:
            heappush(queue, (rival.key, rival.seq, rival))
        if not contenders:
            self._free = min(rival.port.ready for rival in paused)  # unless somebody else sends first, see `_enter`
            return
        for rival in contenders:
            rival.started = now
            rival.attempt += 1
        for recovery in self._recovering.values():
            recovery.timer.cancel()
            recovery.missing -= max(0, now - recovery.since) // self._span(SEQUENCE_BITS)
        self._frame = contenders[0]
        self._verdict = self._disturbances.judge(contenders, self._nodes)
        self._end = now + self._span(self._verdict.outcome.bits)

    def _span(self, bits: int) -> int:
        return bits * self._num // self._den

    def _settle(self, verdict: Verdict) -> None:
        """The frame of a verdict, or its error frame, is through."""
        now, nodes, outcome = self.now, self._nodes, verdict.outcome
        msg = copy(verdict.senders[0].msg)
        msg.timestamp = now / NS_PER_S
        started = verdict.senders[0].started
        self._frame = self._verdict = None
        self._free = self._idle = started + self._span(outcome.bits + INTERFRAME_BITS)
        self.busy += self._free - started
        receivers = verdict.receivers(nodes)
        before = {port: port.state for port in nodes}
        verdict.count(nodes)
        for frame in (*verdict.senders, *verdict.losers):
            failed = outcome.failed or frame in verdict.losers
            if self._record:
                arrived = bool(receivers) and frame in verdict.senders
                self._note(frame, "error" if failed else "sent", now if arrived else None)
            if not failed:
                self._next(frame)
            elif frame.port in nodes:
                heappush(self._queue, (frame.key, frame.seq, frame))
            if frame.port.counters.passive:
                frame.port.ready = Ns(self._free + self._span(SUSPEND_BITS))
        changed = [port for port in nodes if port.state is not before[port]]
        for port in changed:
            if port.counters.off:
                self.discard(port)
                if port.recovers:
                    self.recover(port)
        for port, recovery in self._recovering.items():
            # The delimiters and the intermission that end every frame are one sequence of eleven.
            self._recovering[port] = self._wait(port, recovery.missing - 1, self._free)
            recovery.timer.cancel()
        self._watch()
        for port in receivers:
            if port.hears:
                port.take(msg, now)
        for port in changed:
            port.tell(ERROR_BUS_OFF if port.counters.off else ERROR_CONTROLLER, now)

    def _note(self, frame: Pending, outcome: Literal["sent", "error", "discarded"], received: Ns | None) -> None:
        gone = outcome == "discarded"
        started, free = (self.now, self.now) if gone else (frame.started, Ns(self._idle))
        self.frames.append(frame.record(started, received, free, outcome))

    def discard(self, port: WirePort) -> None:
        """Forget the frames a port has queued, but not one that is on the wire."""
        on_wire = [self._frame] if self._frame is not None else []
        if self._verdict is not None:
            on_wire = [*self._verdict.senders, *self._verdict.losers]
        queued = [entry for entry in self._queue if entry[2].port is port]
        self._queue = [entry for entry in self._queue if entry[2].port is not port]
        heapify(self._queue)
        if self._record:
            waiting = [frame for lane in port.lanes.values() for frame in lane or ()]
            for frame in sorted([*(entry[2] for entry in queued), *waiting], key=lambda frame: frame.seq):
                self._note(frame, "discarded", None)
        port.lanes.clear()
        port.lanes.update((frame.lane, None) for frame in on_wire if frame.port is port)

    def leave(self, port: WirePort) -> None:
        """Take a port off the wire; part of `WirePort.shutdown`. A frame it is sending goes through."""
        self.discard(port)
        self._ports = tuple(other for other in self._ports if other is not port)
        if port in self._recovering:
            self._recovering.pop(port).timer.cancel()
        self._watch()

    def recover(self, port: WirePort) -> None:
        """Let a port return from bus-off, after 128 sequences of 11 recessive bits; nothing if it is not bus-off."""
        if not port.counters.off or port in self._recovering or port not in self._ports:
            return
        self._recovering[port] = self._wait(port, RECOVERY_SEQUENCES, max(self.now, self._idle))
        if self._frame is not None:
            self._recovering[port].timer.cancel()  # counts from the end of the frame
            if self._verdict is None:
                self._verdict = Verdict(Outcome(False, self._frame.bits - INTERFRAME_BITS, True), [self._frame], [])
        self._watch()

    def _wait(self, port: WirePort, missing: int, since: int) -> _Recovery:
        timer = self.call_at(Ns(since + self._span(max(0, missing) * SEQUENCE_BITS)), partial(self._restart, port))
        return _Recovery(missing, since, timer)

    def _restart(self, port: WirePort) -> None:
        del self._recovering[port]
        port.counters.restart()
        self._watch()
        port.tell(ERROR_RESTARTED, self.now)
