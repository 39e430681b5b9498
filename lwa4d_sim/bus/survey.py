"""Looks at a bus and asks who is there, without changing anything: it listens, and it reads objects.

The requests are read requests of SDO alone. A master at work uses the same identifiers for its own: it may then take an
answer that was meant for us for its own.
"""

import statistics
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import can
from canopen.objectdictionary import ObjectDictionary, ODVariable
from canopen.objectdictionary.datatypes import DOMAIN

from lwa4d_sim.bus.client import Client
from lwa4d_sim.bus.frames import frame_bits
from lwa4d_sim.bus.master import Bus
from lwa4d_sim.errors import BusError
from lwa4d_sim.interfaces import NS_PER_S, Ns

SYNC, EMERGENCY, ANSWER, REQUEST, ERROR_CONTROL = 0x080, 0x080, 0x580, 0x600, 0x700  # CiA 301, predefined set
NODES = range(1, 128)
READ_DEVICE_TYPE = bytes((0x40, 0x00, 0x10, 0, 0, 0, 0, 0))  # SDO: initiate upload of 1000
PACE = 0.002  # [s] between the requests of the scan: a controller's queue may be ten frames short (socketcan's default)
PATIENCE = 0.3  # [s] for the last answer, as the SDO client waits
RPDOS, TPDOS = range(0x1400, 0x1404), range(0x1800, 0x1804)  # the drives have no more (Schunk_0_63.dcf)
FIRST_OBJECT = 0x1000
HISTORY = 8  # errors of 1003 that are read


@dataclass(frozen=True, slots=True)
class Pdo:
    """One PDO of a node.

    Attributes:
        name: RPDO or TPDO and its number.
        cob_id: identifier; bit 31 set = not in use.
        kind: transmission type.
        entries: mapped objects: index, sub-index, bits.
    """

    name: str
    cob_id: int
    kind: int
    entries: tuple[tuple[int, int, int], ...]

    @property
    def used(self) -> bool:
        """Whether it is valid and carries anything."""
        return not self.cob_id >> 31 and bool(self.entries)


@dataclass(slots=True)
class NodeFound:
    """One node; what it does not have, or does not tell, is None.

    Attributes:
        node: its id.
        answers: frames with which it answered the one request of the scan; more than one means two nodes of one id.
        nmt: state told by its heartbeat or boot-up.
        heartbeats: heard while listening.
        emergencies: codes heard.
        device: device type 1000.
        name, firmware: 1008, 100A.
        identity: 1018: vendor, product, revision, serial number.
        modes: 6502.
        mode: 6061.
        status: 6041.
        register: error register 1001.
        errors: history 1003, newest first.
        heartbeat: producer time 1017 [ms].
        limits: 607D [mdeg].
        position: 6064 [mdeg].
        pdos: those it has.
    """

    node: int
    answers: int = 0
    nmt: int | None = None
    heartbeats: int = 0
    emergencies: list[int] = field(default_factory=list)
    device: int | None = None
    name: str | None = None
    firmware: str | None = None
    identity: tuple[int | None, ...] = (None,) * 4
    modes: int | None = None
    mode: int | None = None
    status: int | None = None
    register: int | None = None
    errors: list[int] = field(default_factory=list)
    heartbeat: int | None = None
    limits: tuple[int | None, int | None] = (None, None)
    position: int | None = None
    pdos: list[Pdo] = field(default_factory=list)


@dataclass(slots=True)
class Survey:
    """What was seen.

    Attributes:
        seconds: listened before anything was sent.
        frames: heard meanwhile.
        load: share of the time they took, stuff bits included; None without a bit rate.
        error_frames: heard.
        sync_period, sync_jitter: median, and largest deviation from it, of the SYNCs' spacing [s]; None without SYNCs.
        nodes: by id.
    """

    seconds: float
    frames: int
    load: float | None
    error_frames: int
    sync_period: float | None
    sync_jitter: float | None
    nodes: list[NodeFound]


class Surveyor:
    """Walks over a bus.

    Args:
        bus: any python-can bus.
        clock: the instant now [ns].
    """

    def __init__(self, bus: Bus, clock: Callable[[], Ns]) -> None:
        self._bus, self._clock = bus, clock
        self._client = Client(self._send, self._wait)
        self._nodes: dict[int, NodeFound] = {}
        self._scanning = True
        self._syncs: list[float] = []
        self._heard: Counter[str] = Counter()

    def survey(self, bit_rate: int | None, seconds: float) -> Survey:
        """Listen, scan all node ids, and read what there is to read.

        Raises:
            BusError: nobody answers, or the bus is gone.
        """
        start = self._clock()
        self._wait(seconds, lambda: False)
        listened = (self._clock() - start) / NS_PER_S
        heard, syncs = self._heard.copy(), list(self._syncs)
        self.answering(NODES)
        if not any(found.answers or found.nmt is not None for found in self._nodes.values()):
            raise BusError(
                f"no node answers on {self._bus.channel_info}: check power, bit rate, wiring and termination"
                + (f"; {heard['frames']} frames were heard" if heard["frames"] else "")
            )
        for found in self._nodes.values():
            if found.answers == 1:  # what two nodes of one id say at once is nobody's
                self._read(found)
        gaps = [later - earlier for earlier, later in pairwise(syncs)]
        period = statistics.median(gaps) if gaps else None
        return Survey(
            seconds=listened,
            frames=heard["frames"],
            load=heard["bits"] / bit_rate / listened if bit_rate and listened > 0 else None,
            error_frames=heard["errors"],
            sync_period=period,
            sync_jitter=max(abs(gap - period) for gap in gaps) if period is not None else None,
            nodes=[self._nodes[node] for node in sorted(self._nodes)],
        )

    def _send(self, msg: can.Message) -> None:
        try:
            self._bus.send(msg)
        except can.CanError as error:
            raise BusError(f"cannot send on {self._bus.channel_info}: {error}") from error

    def _wait(self, seconds: float, done: Callable[[], bool]) -> bool:
        end = self._clock() + round(seconds * NS_PER_S)
        while not done():
            left = end - self._clock()
            if left <= 0:
                return False
            try:
                msg = self._bus.recv(left / NS_PER_S)
            except can.CanError as error:
                raise BusError(f"cannot receive from {self._bus.channel_info}: {error}") from error
            if msg is not None:
                self._take(msg)
        return True

    def _take(self, msg: can.Message) -> None:
        if msg.is_error_frame:
            self._heard["errors"] += 1
            return
        self._heard["frames"] += 1
        self._heard["bits"] += frame_bits(msg)
        if msg.is_extended_id or msg.is_remote_frame:
            return
        cob_id, data = msg.arbitration_id, bytes(msg.data)
        if cob_id == SYNC:
            self._syncs.append(msg.timestamp)
        elif cob_id - EMERGENCY in NODES and len(data) >= 2:
            self._found(cob_id - EMERGENCY).emergencies.append(int.from_bytes(data[:2], "little"))
        elif cob_id - ERROR_CONTROL in NODES and len(data) == 1:
            found = self._found(cob_id - ERROR_CONTROL)
            found.nmt, found.heartbeats = data[0] & 0x7F, found.heartbeats + 1
        elif cob_id - ANSWER in NODES and len(data) == 8:
            if not self._scanning:
                self._client.notify(cob_id, bytearray(data), msg.timestamp)
            elif data[1:4] == READ_DEVICE_TYPE[1:4]:
                self._found(cob_id - ANSWER).answers += 1

    def _found(self, node: int) -> NodeFound:
        return self._nodes.setdefault(node, NodeFound(node))

    def answering(self, nodes: Iterable[int]) -> list[int]:
        """Which of these nodes answer a request.

        Raises:
            BusError: the bus is gone.
        """
        for node in nodes:
            self._send(can.Message(arbitration_id=REQUEST + node, data=READ_DEVICE_TYPE, is_extended_id=False))
            self._wait(PACE, lambda: False)
        self._wait(PATIENCE, lambda: False)
        self._scanning = False
        return sorted(found.node for found in self._nodes.values() if found.answers)

    def lacking(self, node: int, sheet: ObjectDictionary) -> list[str]:
        """Objects of a data sheet that a node refuses to be read.

        Raises:
            BusError: the node no longer answers.
        """
        lacking = []
        for entry in sheet.values():
            members = [entry] if isinstance(entry, ODVariable) else list(entry.values())
            for one in members:
                # what is below 1000 are data types, and domains may be long
                if one.index < FIRST_OBJECT or not one.readable or one.data_type == DOMAIN:
                    continue
                if self._object(node, one.index, one.subindex) is None:
                    lacking.append(f"{one.index:04X}" + ("" if one is entry else f":{one.subindex}"))
        return lacking

    def _read(self, found: NodeFound) -> None:
        number, text = self._number, self._text
        node = found.node
        found.device, found.name, found.firmware = number(node, 0x1000), text(node, 0x1008), text(node, 0x100A)
        found.identity = tuple(number(node, 0x1018, sub) for sub in range(1, 5))
        found.modes, found.mode = number(node, 0x6502), number(node, 0x6061, signed=True)
        found.status, found.register = number(node, 0x6041), number(node, 0x1001)
        errors = [number(node, 0x1003, sub) for sub in range(1, min(number(node, 0x1003) or 0, HISTORY) + 1)]
        found.errors = [error for error in errors if error is not None]
        found.heartbeat = number(node, 0x1017)
        found.limits = number(node, 0x607D, 1, signed=True), number(node, 0x607D, 2, signed=True)
        found.position = number(node, 0x6064, signed=True)
        found.pdos = [
            pdo for kind, indices in (("RPDO", RPDOS), ("TPDO", TPDOS)) for pdo in self._pdos(node, kind, indices)
        ]

    def _pdos(self, node: int, kind: str, indices: Sequence[int]) -> list[Pdo]:
        found = []
        for i, index in enumerate(indices, start=1):
            cob_id, transmission = self._number(node, index, 1), self._number(node, index, 2)
            if cob_id is None or transmission is None:
                continue
            count = min(self._number(node, index + 0x200) or 0, 64)
            mapped = [self._number(node, index + 0x200, sub) or 0 for sub in range(1, count + 1)]
            entries = tuple((entry >> 16, entry >> 8 & 0xFF, entry & 0xFF) for entry in mapped)
            found.append(Pdo(f"{kind}{i}", cob_id, transmission, entries))
        return found

    def _object(self, node: int, index: int, sub: int) -> bytes | None:
        try:
            return self._client.read(node, index, sub)
        except BusError as error:
            if "SDO abort" in str(error):
                return None
            raise

    def _number(self, node: int, index: int, sub: int = 0, *, signed: bool = False) -> int | None:
        data = self._object(node, index, sub)
        return None if data is None else int.from_bytes(data, "little", signed=signed)

    def _text(self, node: int, index: int) -> str | None:
        data = self._object(node, index, 0)
        return None if data is None else data.decode("ascii", "replace").strip("\0 ")
