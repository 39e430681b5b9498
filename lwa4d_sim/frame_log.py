"""The frames of a run on a bus, as columns: what was sent, by whom, and when."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lwa4d_sim.interfaces import IntArray

#: How a transmission ended, by number.
OUTCOMES = ("sent", "error", "discarded")
_FIELDS = ("can_id", "extended", "remote", "dlc", "data", "bits", "attempt", "outcome", "node")
_TIMES = ("queued", "started", "received")
_UNITS = {"id": "", "extended": "", "remote": "", "size": "B", "data": "", "bits": "bit", "attempt": "", "outcome": ""}
_UNITS |= {"node": "", "queued": "ns", "started": "ns", "received": "ns"}


@dataclass(frozen=True, slots=True, eq=False)
class FrameLog:
    """F transmissions in the order of their end.

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
        # one pass that turns rows into columns is much quicker than one pass a column
        column = (
            dict(zip(rows[0]._fields, zip(*rows, strict=True), strict=True))
            if rows
            else dict.fromkeys(_FIELDS + _TIMES, ())
        )
        names = tuple(dict.fromkeys(column["node"]))
        number = {name: k for k, name in enumerate(names)}
        outcome = {name: k for k, name in enumerate(OUTCOMES)}
        never = int(np.iinfo(np.int64).min)
        data = b"".join([bytes(one).ljust(8, b"\0") for one in column["data"]])
        return FrameLog(
            id=np.array(column["can_id"], np.int64),
            extended=np.array(column["extended"], bool),
            remote=np.array(column["remote"], bool),
            size=np.array(column["dlc"], np.int64),
            data=np.frombuffer(data, np.uint8).reshape(-1, 8),
            bits=np.array(column["bits"], np.int64),
            attempt=np.array(column["attempt"], np.int64),
            outcome=np.array([outcome[one] for one in column["outcome"]], np.int64),
            node=np.array([number[one] for one in column["node"]], np.int64),
            queued=np.array(column["queued"], np.int64),
            started=np.array(column["started"], np.int64),
            received=np.array([never if one is None else one for one in column["received"]], np.int64),
            names=names,
        )

    def __len__(self) -> int:
        return len(self.id)

    def columns(self) -> dict[str, tuple[Any, str]]:
        """Column and unit by name."""
        return {key: (getattr(self, key), unit) for key, unit in _UNITS.items()}

    @staticmethod
    def read(group: Any) -> "FrameLog":
        """From the HDF5 group that holds `columns` and the attribute ``names``.

        Raises:
            ValueError: the columns do not fit each other, or hold what no frame can have.
        """
        log = FrameLog(**{key: group[key][:] for key in _UNITS}, names=tuple(group.attrs["names"].split("\n")))
        for key in _UNITS:
            column, kinds = getattr(log, key), "b" if key in ("extended", "remote") else "iu"
            if column.shape != ((len(log), 8) if key == "data" else (len(log),)) or column.dtype.kind not in kinds:
                raise ValueError(f"frames/{key} does not fit the other columns")
        for key, end in (("size", 9), ("outcome", len(OUTCOMES)), ("node", len(log.names))):
            if ((getattr(log, key) < 0) | (getattr(log, key) >= end)).any():
                raise ValueError(f"frames/{key} holds a number that is none of 0 to {end - 1}")
        return log
