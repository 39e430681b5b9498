"""The arm at the end of a bus: a plant and a CANopen drive for each joint, moved on by what happens on the bus.

The plant keeps to its own grid. What the bus does at an instant takes effect at the nearest plant step, so that the
error is at most half a step and has no bias.
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import can
import numpy as np

from lwa4d_sim.bus.device import Loss
from lwa4d_sim.bus.dictionary import Joint, drive_dictionary
from lwa4d_sim.bus.drive import Drive
from lwa4d_sim.bus.node import NmtState, Node
from lwa4d_sim.bus.options import Profile
from lwa4d_sim.interfaces import NS_PER_S, Array, Ns

START = Ns(0)
# Identifiers of CiA 301's predefined connection set.
NMT, SYNC, FIRST_PDO, LAST_PDO, FIRST_REQUEST, LAST_REQUEST = 0x000, 0x080, 0x181, 0x57F, 0x601, 0x67F


class Physics(Protocol):
    """The plant as the drives see it; a single arm, N = 1."""

    q: Array
    dq: Array
    timestep: Ns

    def advance(self, tau: Array | None, steps: int) -> tuple[Array, Array]:
        """Step under torque (1, 1, n); None is braked. Returns q and dq (1, steps, n), reused arrays."""
        ...

    def hold(self, joints: Any) -> None:
        """Close the brakes of the joints in a mask (n,) and open all others."""
        ...

    def diverged(self) -> Any:
        """Mask (1,) when the arm was lost since the last call, or None."""
        ...


class SpeedSignal(Protocol):
    """The drives' own speed signal."""

    def observe(self, q: Array, dq: Array) -> None:
        """Take in the motion (1, steps, n)."""
        ...

    def read(self) -> Array:
        """Speed (1, n) now."""
        ...


class BusArm:
    """A plant and its drives behind one connection to a bus.

    Args:
        plant: the arm.
        joints: what each drive knows about its joint.
        profile: which drive (`lwa4d` or `cia402`).
        source: the speed that the drives report; None = the true one.
        sender: given a node id, what puts that node's frames on the bus.
        epoch: the instant of the plant's first step [ns]; before it the arm stands still.
        per_sync: move the plant on by so much [ns] at each SYNC instead of by the clock.
    """

    def __init__(
        self,
        plant: Physics,
        joints: Sequence[Joint],
        profile: Profile,
        source: SpeedSignal | None,
        sender: Callable[[int], Callable[[can.Message], None]],
        epoch: Ns = START,
        per_sync: Ns | None = None,
    ) -> None:
        self._plant, self._source = plant, source
        self._epoch, self._dt = epoch, plant.timestep
        self._per_sync, self._syncs = per_sync, 0
        self._step = 0
        self._held = np.zeros(len(joints), bool)
        self._pieces: list[tuple[Array, Array, Array]] = []
        self.drives: list[Drive] = []
        self.nodes: list[Node] = []
        for joint in joints:
            dictionary = drive_dictionary(profile, joint.node, joint)
            # the drive reports through its node, which is made right after it
            emergency = _Emergency()
            drive = Drive(dictionary, joint, emergency.raised, emergency.recovered, self.catch_up)
            device = drive if per_sync is None else _InPlantTime(drive, self)
            node = Node(joint.node, dictionary, sender(joint.node), device)
            emergency.node = node
            self.drives.append(drive)
            self.nodes.append(node)
        self.deaf: set[int] = set()
        self._deadlines: list[Ns | None] = [None] * len(joints)
        self._listeners: dict[int, list[int]] = {}
        self._settled = False
        self._measure()

    def power_on(self, now: Ns) -> Ns | None:
        """Switch all drives on; returns the first instant at which `poll` wants to be called."""
        self._settled = False
        for node in self.nodes:
            node.power_on(now)
        return self.poll(now)

    def receive(self, msg: can.Message, now: Ns) -> Ns | None:
        """Hand a frame to the nodes it concerns; returns the next instant at which one of these wants to be polled."""
        if msg.is_extended_id or msg.is_error_frame or msg.is_remote_frame:
            concerned: Sequence[int] = [k for k, node in enumerate(self.nodes) if node.node_id not in self.deaf]
            set_point = False
        else:
            cob_id = msg.arbitration_id
            if cob_id == SYNC:
                self._syncs += 1
            concerned = self._concerned(cob_id)
            # only requests and network management move PDOs
            self._settled = NMT < cob_id < FIRST_REQUEST or cob_id > LAST_REQUEST
            set_point = FIRST_PDO <= cob_id <= LAST_PDO
        deadline: Ns | None = None
        for k in concerned:
            node = self.nodes[k]
            node.receive(msg, now)
            if set_point and self._deadlines[k] is not None:
                continue  # a set-point only puts its timer off, and starts it before the next SYNC's poll
            self._deadlines[k] = mine = node.poll(now)
            if mine is not None and (deadline is None or mine < deadline):
                deadline = mine
        return deadline

    def silence(self, node_id: int, *, deaf: bool) -> None:
        """Cut a node's receiver off the bus, or connect it again."""
        (self.deaf.add if deaf else self.deaf.discard)(node_id)
        self._settled = False

    def switch_on(self, node_id: int, now: Ns) -> Ns | None:
        """Let one drive start anew; returns as `poll`."""
        k = self._index(node_id)
        self.nodes[k].power_on(now)
        self._deadlines[k] = None
        return self.poll(now)

    def switch_off(self, node_id: int, now: Ns) -> None:
        """Take one drive's supply away: its brake closes."""
        k = self._index(node_id)
        self.catch_up(now)
        self.nodes[k].state = NmtState.INITIALISING  # in which it has no timers
        self.drives[k].reset(now)
        self._deadlines[k] = None

    def poll(self, now: Ns) -> Ns | None:
        """Let the nodes' timers act; returns the next instant at which they want to, or None."""
        for k, deadline in enumerate(self._deadlines):
            if deadline is None or deadline <= now:
                self._deadlines[k] = self.nodes[k].poll(now)
                self._settled = False
        return min((t for t in self._deadlines if t is not None), default=None)

    def catch_up(self, now: Ns) -> None:
        """Step the plant to the step nearest to ``now``."""
        elapsed = now - self._epoch if self._per_sync is None else self._syncs * self._per_sync
        target = (2 * elapsed + self._dt) // (2 * self._dt)
        while self._step < target:
            steps = target - self._step if all(drive.steady for drive in self.drives) else 1
            self._move(steps)
            self._measure()

    def collect(self) -> tuple[Array, Array, Array]:
        """q, dq and torque (1, steps, n) of the plant steps since the last call; NaN torque = all brakes closed."""
        pieces, self._pieces = self._pieces, []
        if len(pieces) == 1:
            return pieces[0]
        q, dq, tau = (np.concatenate(part, axis=1) for part in zip(*pieces, strict=True))
        return q, dq, tau

    def forget(self) -> None:
        """Drop the motion recorded since the last `collect`."""
        self._pieces.clear()

    @property
    def plant_time(self) -> Ns:
        """The instant up to which the plant has been stepped."""
        return Ns(self._epoch + self._step * self._dt)

    def _move(self, steps: int) -> None:
        now = self.plant_time
        seconds = self._dt / NS_PER_S
        tau = np.array([[[drive.torque(now, seconds) for drive in self.drives]]])
        braked = np.array([drive.braked for drive in self.drives])
        if braked.all():
            q, dq = self._plant.advance(None, steps)
            tau = np.full((1, steps, len(self.drives)), np.nan)
        else:
            if (braked != self._held).any():
                self._plant.hold(braked)
                self._held = braked
            tau[0, 0, braked] = 0.0
            q, dq = self._plant.advance(tau, steps)
            tau = np.broadcast_to(tau, q.shape)
        if self._source is not None:
            self._source.observe(q, dq)
        self._pieces.append((q.copy(), dq.copy(), tau))
        self._step += steps

    def _measure(self) -> None:
        # the drives' own loops have the speed at once; its filter is on the way to the bus
        shown = self._plant.dq if self._source is None else self._source.read()
        rows = (array[0].tolist() for array in (self._plant.q, self._plant.dq, shown))
        for drive, q, dq, reported in zip(self.drives, *rows, strict=True):
            drive.measure(q, dq, reported)

    def _index(self, node_id: int) -> int:
        return next(k for k, node in enumerate(self.nodes) if node.node_id == node_id)

    def _concerned(self, cob_id: int) -> Sequence[int]:
        """Indices of the nodes that listen to an identifier now."""
        if not self._settled:
            self._listeners = {}
            for k, node in enumerate(self.nodes):
                for each in node.data_ids if node.node_id not in self.deaf else ():
                    self._listeners.setdefault(each, []).append(k)
        return self._listeners.get(cob_id, ())


class _InPlantTime:
    """A drive whose plant moves on at each SYNC only: without SYNC no time passes for its ramps and watchdog."""

    def __init__(self, drive: Drive, arm: BusArm) -> None:
        self._drive, self._arm = drive, arm
        self.refresh, self.written = drive.refresh, drive.written

    def advance(self, now: Ns) -> None:
        self._arm.catch_up(now)
        self._drive.advance(self._arm.plant_time)

    def sync(self, now: Ns) -> None:
        self._drive.sync(self._arm.plant_time)

    def lost(self, reason: Loss, now: Ns) -> None:
        self._drive.lost(reason, self._arm.plant_time)

    def reset(self, now: Ns) -> None:
        self._drive.reset(self._arm.plant_time)

    def poll(self, now: Ns) -> None:
        self._drive.poll(self._arm.plant_time)  # the next SYNC polls again


class _Emergency:
    """Carries a drive's reports to its node."""

    node: Node

    def raised(self, code: int, register: int) -> None:
        self.node.emergency(code, register)

    def recovered(self, code: int) -> None:
        self.node.recovered(code)
