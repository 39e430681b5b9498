"""Arm, wire and master in one virtual time: the sampled loop with a real CANopen cycle in the middle."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

import can

from lwa4d_sim.bus.arm import BusArm, Physics, SpeedSignal
from lwa4d_sim.bus.commission import commission
from lwa4d_sim.bus.dictionary import Joint
from lwa4d_sim.bus.master import Master, Plan
from lwa4d_sim.bus.options import Profile, Traffic
from lwa4d_sim.bus.safety import Following
from lwa4d_sim.bus.session import Control, Session
from lwa4d_sim.bus.stations import opening
from lwa4d_sim.bus.wire import Wire, WirePort
from lwa4d_sim.errors import BusError
from lwa4d_sim.frame_log import FrameLog
from lwa4d_sim.interfaces import NS_PER_S, Ns, to_ns
from lwa4d_sim.loop import Tick, Timing
from lwa4d_sim.record import STOPPED, RunLog

# The drives are set up before the run's first instant, with closed brakes. Seven of them need a third of a second at
# 500 kbit/s; 10 s are enough at 20 kbit/s (assumed).
STARTUP = Ns(-10 * NS_PER_S)


class Simulation:
    """A run over the simulated bus.

    Args:
        wire: the bus, at the instant `STARTUP`.
        plant: the arm.
        joints: constants of each joint.
        profile: of the drives.
        source: the drives' speed signal; None when the controller estimates the speed, the drive then knows it exactly.
    """

    def __init__(
        self, wire: Wire, plant: Physics, joints: Sequence[Joint], profile: Profile, source: SpeedSignal | None
    ) -> None:
        self.wire, self._plant = wire, plant
        wire.port("arm", self._received)  # hears for all drives; each speaks, and fails, by a controller of its own
        self.ports: dict[int, WirePort] = {}
        self.cut: set[int] = set()  # nodes that are off the bus, as a fault
        self.notes: list[tuple[Ns, str]] = []
        self.arm = BusArm(plant, joints, profile, source, self._sender)
        self._timer = Ns(2**62)
        self._remind(self.arm.power_on(wire.now))

    def run(
        self, plan: Plan, control: Control, timing: Timing, *, with_speed: bool, following: Following | None = None
    ) -> Iterator[Tick]:
        """Set up, and hand out the running loop, one tick a period.

        Raises:
            BusError: the drives cannot be set up, or not in time.
        """
        self.master_port = self.wire.port("master")
        self.master = Master(self.master_port, lambda: self.wire.now, plan)
        self.session = Session(self.master, control, with_speed=with_speed, following=following)
        commission(self.master, opening(plan.profile))
        if self.wire.now > 0:
            raise BusError(f"the set-up takes longer than {-STARTUP // NS_PER_S} s of the bus's time")
        self.wire.run_until(Ns(0))
        return self._ticks(timing)

    def _ticks(self, timing: Timing) -> Iterator[Tick]:
        for cycle in self.session.cycles(Ns(0), timing.ticks):
            self.arm.catch_up(Ns((cycle.k + 1) * timing.period))
            q, dq, tau = self.arm.collect()
            yield Tick(cycle.k, cycle.state, cycle.command, cycle.age, q, dq, tau, self._plant.diverged())

    def annotated(self, log: RunLog) -> RunLog:
        """The record of the run with the frames and what the master noted."""
        said = [(t / NS_PER_S, text) for t, text in self.master.watch.events if t >= 0]
        said += [(t / NS_PER_S, text) for t, text in self.notes]
        fault = self.session.fault
        if fault is not None:
            at = next((t for t, text in said if text == fault), self.wire.now / NS_PER_S)
            said.append((at, STOPPED + fault))
        events = tuple(sorted([*log.events, *said]))
        return replace(log, frames=FrameLog.of(self.wire.frames), events=events)

    # What may be done to it (`faults`).

    def cut_off(self, node: int, *, power: bool) -> None:
        """Take a drive off the bus; without power its brake closes too."""
        self.cut.add(node)
        self.ports[node].flush_tx_buffer()
        self.arm.silence(node, deaf=True)
        if not power:
            self.arm.switch_off(node, self.wire.now)

    def connect(self, node: int, *, power: bool) -> None:
        """Bring a drive back to the bus; one that was without power starts anew."""
        self.cut.discard(node)
        self.arm.silence(node, deaf=self.ports[node].counters.off)
        if not power:
            self.switch_on(node)

    def switch_on(self, node: int) -> None:
        """A drive starts anew."""
        self._remind(self.arm.switch_on(node, self.wire.now))

    def fail(self, k: int, code: int) -> None:
        """The drive of joint ``k`` finds an error of its own."""
        self.arm.drives[k].advance(self.wire.now)
        self.arm.drives[k].fail(code)

    def freeze(self) -> None:
        """The master's process stands still; its CAN controller still receives."""
        self.session.frozen = True
        late = self._late = list[can.Message]()
        self.master_port.listener = lambda msg, now: late.append(msg)

    def thaw(self) -> None:
        """It goes on and finds what has come meanwhile."""
        self.session.frozen = False
        self.master_port.listener = None
        self.master_port.inbox.extend(self._late)

    def _sender(self, node: int) -> Callable[[can.Message], None]:
        port = self.wire.port(f"node {node}", lambda msg, now: self._told(node, msg, now), recovers=True, hears=False)
        self.ports[node] = port

        def send(msg: can.Message) -> None:
            if node not in self.cut:
                with suppress(can.CanOperationError):  # bus-off: the frame is lost
                    port.send(msg)

        return send

    def _told(self, node: int, msg: can.Message, now: Ns) -> None:
        """What a node's own controller reports: an error state, in which it may be deaf as well."""
        if msg.is_error_frame:
            self.arm.silence(node, deaf=self.ports[node].counters.off or node in self.cut)
            next(each for each in self.arm.nodes if each.node_id == node).receive(msg, now)

    def _received(self, msg: can.Message, now: Ns) -> None:
        self._remind(self.arm.receive(msg, now))

    def _remind(self, deadline: Ns | None) -> None:
        """Be woken at the nodes' next deadline, unless that is already so."""
        if deadline is not None and deadline < self._timer:
            self._timer = deadline
            self.wire.call_at(deadline, self._wake)

    def _wake(self) -> None:
        if self.wire.now < self._timer:
            return
        self._timer = Ns(2**62)
        self._remind(self.arm.poll(self.wire.now))


def add_traffic(wire: Wire, stations: Sequence[Traffic]) -> None:
    """Let other stations send on the wire."""
    for k, traffic in enumerate(stations):
        _send_regularly(wire, wire.port(f"traffic {k + 1}", lambda msg, now: None, recovers=True), traffic)


def _send_regularly(wire: Wire, port: WirePort, traffic: Traffic) -> None:
    msg = can.Message(arbitration_id=traffic.id, data=bytes(traffic.size), is_extended_id=False)
    period = to_ns(traffic.period)

    def fire(due: Ns) -> None:
        with suppress(can.CanOperationError):  # bus-off: the frame is lost
            port.send(msg)
        wire.call_at(Ns(due + period), partial(fire, Ns(due + period)))

    first = to_ns(traffic.offset)
    wire.call_at(first, partial(fire, first))
