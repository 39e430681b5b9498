"""The cycles of a logged bus: which of them count for a recording, and where each joint was and was driven in them."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from lwa4d_sim.bus.dictionary import Joint
from lwa4d_sim.bus.mapping import Key
from lwa4d_sim.bus.stations import OFFSET, POSITION, STATUS, TARGET_TORQUE
from lwa4d_sim.bus.watch import ENABLED, STATE_MASK, SYNC
from lwa4d_sim.errors import IdentificationError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.recordings.beats import PAUSE, Beat, InCycles, even_beat, held, in_cycles
from lwa4d_sim.recordings.pdo_log import Frame, NodePdos, Trace, Traffic, follow
from lwa4d_sim.recordings.reading import Actuation

if TYPE_CHECKING:
    from canopen.objectdictionary import ObjectDictionary

Sheets = Mapping[int, "ObjectDictionary"]
ACTUAL = (0x6077, 0)
STILL = 2  # counts within which a joint stands: an encoder's last digit is never quiet (assumed)
EVEN = 1e-7  # [s]; time stamps that stray by less are rounded, and not worth a word
CROWD = 0.01  # share of the cycles in which a recording may lack a second command (assumed)


class CanCycles:
    """A log by cycles, each from one SYNC to the next; without SYNC, from one position of the first joint to the next.

    Args:
        frames: 11-bit data frames in the order in which they were on the bus.
        sheets: data sheets by node id, one of each joint.
        joints: constants of each joint.
        torque: the object that tells the torque.

    Attributes:
        remarks: what the reader of a result should know.

    Raises:
        IdentificationError: the log lacks an object or its SYNC, or cannot be followed.
    """

    def __init__(self, frames: Sequence[Frame], sheets: Sheets, joints: Sequence[Joint], torque: Key) -> None:
        self._joints, self._sheets, self._torque = joints, sheets, torque
        # in cyclic torque mode the offset is added (CiA 402-2, 60B2)
        self._extra = OFFSET if torque == TARGET_TORQUE else None
        log = self._follow(frames, SYNC)
        for key in (POSITION, torque):
            for joint in joints:
                self._need(joint, key)
        self._synchronous = any(
            any(self._trace(joint, key).synchronous) for joint in joints for key in (POSITION, torque)
        )
        if len(log.beats) < 2:
            if self._synchronous:
                raise IdentificationError("has no SYNC (frame 080), at which its synchronous PDOs are sampled and act")
            log = self._follow(frames, self._trace(joints[0], POSITION).cob_id)
        self._beats = np.array(log.beats)
        self._period = float(np.median(np.diff(self._beats))) if len(log.beats) > 1 else 0.0
        if not self._period > 0:
            raise IdentificationError(f"its {len(log.beats)} cycles take no time; the time stamps are no good")
        if log.strangers:
            self.remarks.append(f"node {', '.join(map(str, log.strangers))} has no data sheet and was left out")
        if log.short:
            self.remarks.append(f"{log.short} PDOs were shorter than their mapping and were left out")

    def _follow(self, frames: Sequence[Frame], beat: int) -> Traffic:
        nodes = [NodePdos(joint.node, self._sheets[joint.node]) for joint in self._joints]
        wanted = [(POSITION, True), (STATUS, True), (self._torque, self._torque == ACTUAL)]
        if self._extra is not None:
            wanted.append((self._extra, False))
        log = follow(frames, nodes, wanted, beat)
        self._traces = log.traces
        self.remarks = []
        if not all(node.changed for node in nodes):
            self.remarks.append(
                "the log does not show how all PDOs were set up; what it does not show is taken from the data sheets"
            )
        return log

    def _trace(self, joint: Joint, key: Key) -> Trace:
        return self._traces[joint.node, key]

    def _need(self, joint: Joint, key: Key) -> None:
        trace, about, what = self._trace(joint, key), f"node {joint.node} ({joint.name})", f"{key[0]:04X}"
        if key[0] not in self._sheets[joint.node]:
            raise IdentificationError(f"{about}: its data sheet has no object {what}")
        if trace.pdo is None:
            kind = "TPDO" if key in (POSITION, ACTUAL) else "RPDO"
            raise IdentificationError(
                f"{about}: no {kind} carries {what} by its data sheet and the set-up in the log; give a DCF with the "
                "mapping that was in use"
            )
        if not trace.values:
            raise IdentificationError(f"{about}: no {trace.pdo} (frame {trace.cob_id:03X}), which would carry {what}")

    def enabled(self) -> tuple[int, int]:
        """First cycle, and the one behind the last, of the longest stretch with every drive in operation enabled.

        Raises:
            IdentificationError: there is none.
        """
        m = len(self._beats)
        on = np.ones(m, bool)
        for joint in self._joints:
            trace = self._trace(joint, STATUS)
            if not trace.values:
                self.remarks.append(f"the log has no statusword 6041 of {joint.name}, which is taken to be enabled")
                continue
            words = in_cycles(trace, 0, m).values
            seen = np.flatnonzero(~np.isnan(words))
            # between two cycles that are known a drive is what both say; before the first and after the last: unknown
            good = np.append((words[seen].astype(np.int64) & STATE_MASK) == ENABLED, False)
            cycles = np.arange(m)
            on &= good[np.searchsorted(seen, cycles, side="right") - 1] & good[np.searchsorted(seen, cycles)]
        # a stretch begins where it is on and was not, or where the beat had paused
        joined = np.append(False, np.diff(self._beats) <= PAUSE * self._period) & on & np.append(False, on[:-1])
        starts = np.flatnonzero(on & ~joined)
        if not len(starts):
            raise IdentificationError("the drives were at no time all in operation enabled (statusword 6041)")
        lengths = np.diff(np.append(starts, m))
        lengths = np.array([int(on[a : a + n].sum()) for a, n in zip(starts, lengths, strict=True)])
        longest = int(np.argmax(lengths))
        first, last = int(starts[longest]), int(starts[longest] + lengths[longest])
        self._leave_out("the drives are not all enabled there, or SYNC has paused", first, m - last)
        return first, last

    def moving(self, first: int, last: int) -> tuple[int, int]:
        """The part of some cycles from the first motion to the last, with the cycle before and after.

        Raises:
            IdentificationError: nothing moves.
        """
        begins, ends = [], []
        for joint in self._joints:
            counts = self.position(joint, first, last).values
            seen = np.flatnonzero(~np.isnan(counts))
            begins += seen[np.abs(counts[seen] - counts[seen[:1]]) > STILL][:1].tolist()
            ends += seen[np.abs(counts[seen] - counts[seen[-1:]]) > STILL][-1:].tolist()
        if not begins:
            raise IdentificationError("no joint moves while the drives are enabled")
        begin, end = max(min(begins) - 1, 0), min(max(ends) + 3, last - first)
        self._leave_out("no joint moves there", begin, last - first - end)
        return first + begin, first + end

    def _leave_out(self, why: str, before: int, after: int) -> None:
        if before or after:
            self.remarks.append(f"{before} cycles at the beginning and {after} at the end were left out: {why}")

    def beat(self, first: int, last: int) -> Beat:
        """Instants of some cycles.

        Raises:
            IdentificationError: too few.
        """
        if last - first < 3:
            raise IdentificationError(f"the drives are enabled and moving in no more than {last - first} cycles")
        stamps = self._beats[first:last]
        if not self._synchronous:
            self.remarks.append("no PDO is synchronous: positions and torques have the time stamps of their frames")
            return Beat(np.arange(len(stamps)), stamps, self._period, 0.0, 0.0, even=False)
        beat = even_beat(stamps)
        if beat.worst > EVEN:
            self.remarks.append(
                f"SYNC comes every {1e3 * beat.period:.6g} ms; its time stamps stray by {1e6 * beat.spread:.2g} us "
                f"(worst {1e6 * beat.worst:.3g} us) and were "
                + ("put on an even beat" if beat.even else "kept, since they wander like a clock and not like jitter")
            )
        lost = int(beat.count[-1]) + 1 - len(stamps)
        if lost:
            self.remarks.append(f"{lost} SYNCs are missing in the log; nothing is known of their cycles")
        return beat

    def position(self, joint: Joint, first: int, last: int) -> InCycles:
        """Positions [count] in some cycles; a counter that wraps around is unrolled."""
        found = in_cycles(self._trace(joint, POSITION), first, last)
        seen = ~np.isnan(found.values)
        found.values[seen] = np.unwrap(found.values[seen], period=2.0**32)
        return found

    def torque(self, joint: Joint, first: int, last: int, actuation: Actuation | None) -> tuple[Array, Array]:
        """Torque [count] that acts in some cycles, and since when [s]; NaN = from the beginning of the cycle.

        Raises:
            IdentificationError: it changes more often than once a cycle.
        """
        m = len(self._beats)
        found = in_cycles(self._trace(joint, self._torque), 0, m)
        if self._torque == ACTUAL:
            since = np.full(m, np.nan) if found.synchronous else found.stamps
            return found.values[first:last], since[first:last]
        next_sync = found.synchronous if actuation is None else actuation == "next_sync"
        if not next_sync and found.crowded > CROWD * m:
            raise IdentificationError(
                f"node {joint.node} ({joint.name}): {found.crowded} torques act at once and come between those that a "
                "recording can hold, one a cycle"
            )
        values, since = held(found, self._beats, self._period, next_sync=next_sync)
        lost = int(np.isnan(found.values[first : last - 1]).sum())
        if lost:
            self.remarks.append(f"{joint.name} got no torque in {lost} cycles; the one before is taken to have held")
        if self._extra is not None and self._trace(joint, self._extra).values:
            offset = in_cycles(self._trace(joint, self._extra), 0, m)
            added, _ = held(offset, self._beats, self._period, next_sync=next_sync)
            values = values + np.where(np.isnan(added), 0.0, added)
        return values[first:last], since[first:last]
