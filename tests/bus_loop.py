"""A node and the canopen library's master on a bus without time, thread or wire."""

import queue
from collections import deque
from collections.abc import Callable
from typing import Any

import can
import canopen

from lwa4d_sim.bus.device import Nothing
from lwa4d_sim.bus.dictionary import Dictionary, Entry, Joint, drive_dictionary
from lwa4d_sim.bus.node import Node
from lwa4d_sim.bus.options import Profile
from lwa4d_sim.interfaces import Ns

MS = 1_000_000  # [ns]
NODE = 5
JOINT = Joint(name="PRL 100", low=-3.14, high=3.14, speed=0.4189, acceleration=2.65, torque=176.0)
SCRATCH = 0x2F00  # writable memory of the cia402 profile


def frame(cob_id: int, *data: int | bytes, **flags: Any) -> can.Message:
    """An 11-bit frame; data as numbers or bytes."""
    payload = b"".join(part if isinstance(part, bytes) else bytes((part,)) for part in data)
    return can.Message(arbitration_id=cob_id, data=payload, is_extended_id=False, **flags)


class Recorder(Nothing):
    """A device that notes what it is asked."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self.on_written: Callable[[int, int], None] = lambda index, sub: None
        self.on_refresh: Callable[[], None] = lambda: None

    def advance(self, now: Ns) -> None:
        self.calls.append(("advance", now))

    def refresh(self) -> None:
        self.calls.append(("refresh",))
        self.on_refresh()

    def written(self, index: int, sub: int) -> None:
        self.calls.append(("written", index, sub))
        self.on_written(index, sub)

    def sync(self, now: Ns) -> None:
        self.calls.append(("sync", now))

    def lost(self, reason: str, now: Ns) -> None:
        self.calls.append(("lost", reason, now))

    def reset(self, now: Ns) -> None:
        self.calls.append(("reset", now))

    def named(self, name: str) -> list[tuple[Any, ...]]:
        """Calls of one kind."""
        return [call for call in self.calls if call[0] == name]


class Bench:
    """One node, its frames and its device, at a time that the test sets."""

    def __init__(self, profile: Profile = "cia402", *, on: bool = True, entries: tuple[Entry, ...] = ()) -> None:
        self.dictionary: Dictionary = drive_dictionary(profile, NODE, JOINT)
        self.sent: list[can.Message] = []
        self.device = Recorder()
        self.node = Node(NODE, self.dictionary, self.sent.append, self.device)
        self.now = Ns(0)
        if on:
            self.node.power_on(self.now)
            self.take()

    def take(self) -> list[tuple[int, bytes]]:
        """Identifier and data of the frames sent since the last call."""
        frames = [(msg.arbitration_id, bytes(msg.data)) for msg in self.sent]
        assert not any(msg.is_extended_id or msg.is_remote_frame for msg in self.sent)
        self.sent.clear()
        return frames

    def put(self, cob_id: int, *data: int | bytes, **flags: Any) -> list[tuple[int, bytes]]:
        """Hand a frame to the node; what it sends at once."""
        self.node.receive(frame(cob_id, *data, **flags), self.now)
        return self.take()

    def run(self, until: int) -> list[tuple[int, int, bytes]]:
        """Let time pass to ``until`` [ns]: (time, identifier, data) of what the node sends."""
        seen: list[tuple[int, int, bytes]] = []
        for _ in range(10_000):
            deadline = self.node.poll(self.now)
            seen += [(self.now, *each) for each in self.take()]
            assert deadline is None or deadline > self.now
            if deadline is None or deadline > until:
                self.now = Ns(until)
                return seen
            self.now = deadline
        raise AssertionError("the node never comes to rest")

    def nmt(self, command: int) -> list[tuple[int, bytes]]:
        """A command of network management to this node."""
        return self.put(0x000, command, NODE)

    def start(self) -> None:
        """Make it operational."""
        self.nmt(0x01)
        self.run(self.now)

    def sdo(self, request: str) -> str:
        """Eight bytes in hexadecimal; the answer likewise, empty without one."""
        answers = self.put(0x600 + NODE, bytes.fromhex(request))
        assert all(cob_id == 0x580 + NODE for cob_id, _ in answers)
        return " ".join(data.hex() for _, data in answers)

    def write(self, index: int, sub: int, value: int, size: int) -> int:
        """Expedited download; the abort code, 0 if it was taken."""
        command = 0x23 | (4 - size) << 2
        data = index.to_bytes(2, "little") + bytes((sub,)) + (value % (1 << 32)).to_bytes(4, "little")
        answers = [data for cob_id, data in self.put(0x600 + NODE, command, data) if cob_id == 0x580 + NODE]
        (answer,) = answers
        assert answer[1:4] == data[:3]
        assert answer[0] in (0x60, 0x80)
        return int.from_bytes(answer[4:], "little") if answer[0] == 0x80 else 0


class Loop(canopen.Network):
    """The canopen library's network, joined to a bench: frames are queued and delivered one after the other."""

    def __init__(self, bench: Bench) -> None:
        super().__init__()
        self.bench = bench
        self.tamper: Callable[[int, bytes], bytes | None] = lambda cob_id, data: data
        self._busy = False
        self._queue: deque[tuple[int, bytes, bool]] = deque()

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._queue.append((can_id, bytes(data), remote))
        if self._busy:
            return
        self._busy = True
        while self._queue:
            cob_id, sent, is_remote = self._queue.popleft()
            arrived = self.tamper(cob_id, sent)
            if arrived is not None:
                for answer in self.bench.put(cob_id, arrived, is_remote_frame=is_remote):
                    reply = self.tamper(*answer)
                    if reply is not None:
                        self.notify(answer[0], bytearray(reply), 0.0)
        self._busy = False

    def join(self) -> canopen.RemoteNode:
        """The library's view of the node."""
        remote = canopen.RemoteNode(NODE, self.bench.dictionary.eds(NODE))
        self.add_node(remote)
        remote.sdo.RESPONSE_TIMEOUT = 0.02
        remote.sdo.responses = queue.Queue()
        return remote
