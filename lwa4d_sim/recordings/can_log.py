"""A recording from the CAN log of an arm with CANopen drives.

A synchronous position was sampled at the SYNC before it, and a synchronous command acts at the SYNC after it; all
others count from when their frame came, joint by joint.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lwa4d_sim.bus import frame_files
from lwa4d_sim.bus.dictionary import MDEG_PER_RAD, Joint
from lwa4d_sim.bus.sheet import load
from lwa4d_sim.bus.stations import LAYOUTS, torque_counts_per_newton_metre
from lwa4d_sim.errors import BusError, IdentificationError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.recordings.can_cycles import ACTUAL, CanCycles, Sheets
from lwa4d_sim.recordings.pdo_log import Frame
from lwa4d_sim.recordings.plausible import check_plausible
from lwa4d_sim.recordings.reading import Reading
from lwa4d_sim.recordings.recording import Recording

if TYPE_CHECKING:
    from canopen.objectdictionary import ObjectDictionary


AS_IT_IS = Reading()


def read_can_log(
    path: Path, sheets: Sheets | Sequence[Path], joints: Sequence[Joint], reading: Reading = AS_IT_IS
) -> Recording:
    """Read a CAN log.

    Args:
        path: in any format that python-can reads: candump -L (.log), ASC, BLF, ...
        sheets: data sheets (EDS) or configurations (DCF) of the drives, by node id or as files (`load_sheets`).
        joints: constants of each joint, its node id among them (`lwa4d_sim.bus.joints.joints_for`).
        reading: how.

    Raises:
        IdentificationError: not a log, or one without what is needed; the line says what.
        BusError: a data sheet cannot be read.
    """
    known = sheets if isinstance(sheets, Mapping) else load_sheets(sheets, joints)
    try:
        frames = [plain(msg) for msg in frame_files.read(path) if not (msg.is_extended_id or msg.is_remote_frame)]
    except BusError as error:
        raise IdentificationError(" ".join(str(error).split())) from error
    return decode(frames, known, joints, str(path), reading)


def plain(msg: Any) -> Frame:
    """Time stamp, identifier and data of python-can's message."""
    return float(msg.timestamp), int(msg.arbitration_id), bytes(msg.data)


def load_sheets(paths: Sequence[Path], joints: Sequence[Joint]) -> Sheets:
    """Data sheets by node id: of the node that the file names, as a DCF does, else in the order of the joints.

    A single file without a node id is every drive's.

    Raises:
        BusError: a file cannot be read.
        IdentificationError: their number does not fit the joints.
    """
    sheets: dict[int, ObjectDictionary] = {}
    nameless: list[Path] = []
    for path in paths:
        sheet = load(path)
        if sheet.node_id is None:
            nameless.append(path)
        else:
            sheets[sheet.node_id] = sheet
    left = [joint.node for joint in joints if joint.node not in sheets]
    if len(nameless) > 1 and len(nameless) != len(left):
        raise IdentificationError(
            f"{nameless[0]}: is one of {len(nameless)} data sheets without a node id, for {len(left)} drives; give one "
            "for all, or one for each in the order of the joints"
        )
    for k, node in enumerate(left if nameless else ()):
        sheets[node] = load(nameless[k % len(nameless)], node)
    return sheets


def decode(
    frames: Iterable[Frame],
    sheets: Sheets,
    joints: Sequence[Joint],
    source: str,
    reading: Reading = AS_IT_IS,
    remarks: Sequence[str] = (),
) -> Recording:
    """A recording from the frames of a log: the longest stretch in which all drives were enabled, as far as one moved.

    Args:
        frames: 11-bit data frames in the order in which they were on the bus.
        sheets: data sheets by node id.
        joints: constants of each joint.
        source: name of the log for errors and the report.
        reading: how.
        remarks: made before.

    Raises:
        IdentificationError: see `read_can_log`.
    """
    n, command, profile = len(joints), reading.torque == "command", reading.profile or "lwa4d"
    for joint in joints:
        if joint.node not in sheets:
            given = ", ".join(map(str, sorted(sheets))) or "none"
            raise IdentificationError(f"{source}: node {joint.node} ({joint.name}) has no data sheet; given: {given}")
    default = [torque_counts_per_newton_metre(profile, joint) for joint in joints]
    per_newton_metre = _scale("torque_counts", reading.torque_counts, default)
    per_radian = _scale("position_counts", reading.position_counts, [MDEG_PER_RAD] * n)
    try:
        log = CanCycles(list(frames), sheets, joints, LAYOUTS[profile].torque if command else ACTUAL)
        first, last = log.moving(*log.enabled())
        beat = log.beat(first, last)
        rows = beat.count[:-1]  # at the last beat the last torque ends
        shape = (int(beat.count[-1]), n)
        t = np.repeat(beat.t[:-1, None], n, axis=1)
        q, since, tau = np.full(shape, np.nan), t.copy(), np.full(shape, np.nan)
        for j, joint in enumerate(joints):
            place = log.position(joint, first, last)
            q[rows, j] = place.values[:-1]
            if not place.synchronous:
                t[rows, j] = np.where(np.isnan(place.stamps[:-1]), t[rows, j], place.stamps[:-1])
            if place.crowded:
                log.remarks.append(
                    f"{place.crowded} positions of {joint.name} between those of the cycles were left out"
                )
            counts, came = log.torque(joint, first, last, reading.actuation)
            tau[rows, j] = counts[:-1]
            since[rows, j] = np.where(np.isnan(came[:-1]), since[rows, j], came[:-1])
    except IdentificationError as error:
        raise IdentificationError(f"{source}: {error}") from error
    tau /= per_newton_metre
    if command:
        peak = np.array([joint.torque for joint in joints])
        tau = np.clip(tau, -peak, peak)  # as the drive does
    start = beat.t[0]
    recording = Recording(
        joints=tuple(joint.name for joint in joints),
        t=t - start,
        q=q / per_radian,
        since=since - start,
        tau=tau,
        position_step=1 / np.abs(per_radian),
        torque_step=np.zeros(n) if command else 1 / np.abs(per_newton_metre),
        end=float(beat.t[-1] - start),
        source=source,
        remarks=(*remarks, *log.remarks),
    )
    check_plausible(recording, [None if j.low is None or j.high is None else (j.low, j.high) for j in joints])
    return recording


def _scale(name: str, given: Sequence[float] | None, default: Sequence[float]) -> Array:
    if given is None:
        return np.array(default)
    if len(given) != len(default) or not all(np.isfinite(given)) or not all(given):
        raise IdentificationError(f"{name} must be {len(default)} numbers other than 0, one for each joint")
    return np.array(given)
