"""The frames of a run on a bus, as columns: what was sent, by whom, and when."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lwa4d_sim.interfaces import IntArray

#: How a transmission ended, by number.
OUTCOMES = ("sent", "error", "discarded")
_UNITS = {"id": "", "extended": "", "remote": "", "size": "B", "data": "", "bits": "bit", "attempt": "", "outcome": ""}
_UNITS |= {"node": "", "queued": "ns", "started": "ns", "received": "ns"}


@dataclass(frozen=True, slots=True, eq=False)
class FrameLog:
    """F transmissions in the order of their start.

    Attributes:
        id: CAN identifier (F,).
        extended, remote: kind of frame (F,).
        size: data bytes (F,).
        data: (F, 8), unused bytes 0.
        bits: length on the wire, stuffing and interframe space included (F,).
        attempt: 1, or more for a repetition (F,).
        outcome: index into `OUTCOMES` (F,).
        node: index into `names` (F,).
        queued, started, received: instants [ns] (F,), before the run's start below 0; -2^63 if not received.
        names: of the stations.
    """

    id: IntArray
    extended: NDArray[np.bool_]
    remote: NDArray[np.bool_]
    size: IntArray
    data: NDArray[np.uint8]
    bits: IntArray
    attempt: IntArray
    outcome: IntArray
    node: IntArray
    queued: IntArray
    started: IntArray
    received: IntArray
    names: tuple[str, ...]

    @staticmethod
    def of(frames: Iterable[Any]) -> "FrameLog":
        """The columns of a list of transmissions (`lwa4d_sim.bus.wire.WireFrame`)."""
        rows = list(frames)
        names = tuple(dict.fromkeys(frame.node for frame in rows))
        number = {name: k for k, name in enumerate(names)}

        def column(values: Iterable[Any]) -> IntArray:
            return np.fromiter(values, np.int64, len(rows))

        never = int(np.iinfo(np.int64).min)
        data = b"".join(bytes(frame.data).ljust(8, b"\0") for frame in rows)
        return FrameLog(
            id=column(frame.can_id for frame in rows),
            extended=column(frame.extended for frame in rows).astype(bool),
            remote=column(frame.remote for frame in rows).astype(bool),
            size=column(frame.dlc for frame in rows),
            data=np.frombuffer(data, np.uint8).reshape(-1, 8),
            bits=column(frame.bits for frame in rows),
            attempt=column(frame.attempt for frame in rows),
            outcome=column(OUTCOMES.index(frame.outcome) for frame in rows),
            node=column(number[frame.node] for frame in rows),
            queued=column(frame.queued for frame in rows),
            started=column(frame.started for frame in rows),
            received=column(never if frame.received is None else frame.received for frame in rows),
            names=names,
        )

    def __len__(self) -> int:
        return len(self.id)

    def columns(self) -> dict[str, tuple[Any, str]]:
        """Column and unit by name."""
        return {key: (getattr(self, key), unit) for key, unit in _UNITS.items()}

    @staticmethod
    def read(group: Any) -> "FrameLog":
        """From the HDF5 group that holds `columns` and the attribute ``names``."""
        return FrameLog(**{key: group[key][:] for key in _UNITS}, names=tuple(group.attrs["names"].split("\n")))
