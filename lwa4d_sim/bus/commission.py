"""Finds, checks and sets up the drives, up to switched on with closed brakes.

The order is the thesis's (Table 3.3): PDOs and parameters, mode by SDO, NMT start, controlwords 0x06 and 0x07. 0x0F
comes with the first torque.
"""

import struct
from collections.abc import Callable, Sequence
from contextlib import suppress

from lwa4d_sim.bus.master import MASTER_NODE, PRE_OPERATIONAL, TRIES, Master
from lwa4d_sim.bus.stations import NEVER, TARGET_SPEED, Key, Station
from lwa4d_sim.bus.watch import NMT, STATE_MASK
from lwa4d_sim.errors import BusError
from lwa4d_sim.interfaces import Ns

START = 0x01  # NMT command
SHUTDOWN, SWITCH_ON, FAULT_RESET = 0x06, 0x07, 0x80  # CiA 402 controlwords
READY, SWITCHED_ON, FAULT = 0x21, 0x23, 0x08  # CiA 402 statuswords under the mask, and the bit of a fault
SYNCHRONOUS, EVENT = 1, 255  # PDO transmission types (CiA 301)
SEARCHED = 0x01  # bit of 2050: commutation search completed (Schunk_0_63.dcf)
ANOTHER = Ns(5_000_000)  # [ns] in which a second device with an id would have answered too (assumed)
# A drive misses its set-points as it misses SYNC: after six periods (200E of the LWA4D, Schunk_0_63.dcf).
TIME_OUT = 6
Kept = tuple[int, Key, bytes]  # node, object, value
ABSENT = (0x06020000, 0x06090011)  # SDO aborts: no such object, no such sub-index


def commission(master: Master, parameters: Sequence[tuple[Key, str, float]] = ()) -> list[Kept]:
    """Find, check and set up every drive; ends with all of them operational and switched on, brakes closed.

    Args:
        master: fresh.
        parameters: further objects to write to each drive: (index, sub), `struct` format, value.

    Returns:
        What these objects held before, for `put_back`.

    Raises:
        BusError: a drive does not answer, is not what it should be, refuses, or does not switch on. What these objects
            held is put back, as far as the drives let it.
    """
    for station in master.stations:
        master.frame(NMT, bytes([PRE_OPERATIONAL, station.node]))
    for station in master.stations:
        _identify(master, station)
    kept = [
        (station.node, key, master.client.read(station.node, *key))
        for station in master.stations
        for key, *_ in parameters
    ]
    try:
        for station in master.stations:
            _set_up(master, station, parameters)
        _switch_on(master)
    except BusError:
        with suppress(BusError):
            put_back(master, kept)
        raise
    return kept


def _switch_on(master: Master) -> None:
    for station in master.stations:
        master.frame(NMT, bytes([START, station.node]))
    # what waited behind the requests, boot-up messages above all, comes now
    master.wait(Ns(master.clock() + master.plan.period))
    master.watch.start(master.clock())
    for station in master.stations:
        station.values.update({TARGET_SPEED: 0, (0x60B2, 0): 0, (0x6071, 0): 0, (0x6081, 0): 10_000})
    _reach(master, FAULT_RESET, lambda status: not status & FAULT)
    _reach(master, SHUTDOWN, lambda status: status & STATE_MASK == READY)
    _reach(master, SWITCH_ON, lambda status: status & STATE_MASK == SWITCHED_ON)
    for station in master.stations:
        _time_out(master, station)
    master.watch.enabled = False


def put_back(master: Master, kept: Sequence[Kept]) -> None:
    """Give the drives' own parameters back, after the arm has stopped: a drive without gains could not stop by itself.

    Raises:
        BusError: a drive does not answer or refuses; the others have theirs.
    """
    failed: dict[int, BusError] = {}
    for node, key, data in kept:
        if node in failed:
            continue
        try:
            master.client.write(node, *key, data)
        except BusError as error:
            failed[node] = error
    if failed:
        raise next(iter(failed.values()))


def _identify(master: Master, station: Station) -> None:
    node, answered = station.node, station.answers
    device = int.from_bytes(master.client.read(node, 0x1000), "little")
    master.wait(Ns(master.clock() + ANOTHER))
    if station.answers > answered + 1:
        raise BusError(f"node {node}: two answers to one request; two devices have this node id")
    if station.boots > 1:
        raise BusError(
            f"node {node}: has started {station.boots} times; two devices have this node id, or its supply fails"
        )
    if device & 0xFFFF != 402:
        raise BusError(f"node {node}: is no drive: device type 0x{device:08X}, expected profile 402")
    modes = int.from_bytes(master.client.read(node, 0x6502), "little")
    if not modes >> master.layout.bit & 1:
        raise BusError(
            f"node {node}: does not support mode {master.layout.mode} of the profile '{master.plan.profile}'; "
            f"its modes (0x6502) are 0x{modes:X}"
        )
    if master.plan.profile == "lwa4d" and not master.client.read(node, 0x2050)[0] & SEARCHED:
        raise BusError(f"node {node}: must search its commutation first (0x2050 bit 0); see docs/commissioning.md")


def _set_up(master: Master, station: Station, parameters: Sequence[tuple[Key, str, float]]) -> None:
    node, write = station.node, master.client.write
    write(node, 0x1017, 0, struct.pack("<H", master.plan.heartbeat))
    if master.plan.heartbeat:
        consumer = MASTER_NODE << 16 | 3 * master.plan.heartbeat
        write(node, 0x1016, 1, struct.pack("<I", consumer))
    count, exponent = interpolation_period(master.plan.period)
    write(node, 0x60C2, 1, struct.pack("<B", count))
    write(node, 0x60C2, 2, struct.pack("<b", exponent))
    receive_type = EVENT if master.plan.immediate else SYNCHRONOUS
    for i, mapping in enumerate(master.layout.receive):
        _map(master, node, 0x1400 + i, 0x200 + 0x100 * i + node, receive_type, mapping)
    for i, mapping in enumerate(master.layout.transmit):
        _map(master, node, 0x1800 + i, 0x180 + 0x100 * i + node, SYNCHRONOUS, mapping)
    for (index, sub), form, value in parameters:
        write(node, index, sub, struct.pack(form, value))
    write(node, 0x6060, 0, struct.pack("<b", master.layout.mode))
    for _ in range(TRIES):
        (mode,) = struct.unpack("<b", master.client.read(node, 0x6061))
        if mode == master.layout.mode:
            return
        master.wait(Ns(master.clock() + master.plan.period))
    raise BusError(f"node {node}: does not change to mode {master.layout.mode}; 0x6061 says {mode}")


def interpolation_period(period: Ns) -> tuple[int, int]:
    """A SYNC period as 60C2 has it: a number up to 255, and the power of ten [s] that it counts.

    Raises:
        BusError: it cannot be said so.
    """
    for exponent in (-3, -4, -5, -6):
        count, rest = divmod(period, 10 ** (9 + exponent))
        if not rest and count <= 255:
            return count, exponent
    raise BusError(f"a drive cannot be told a period of {period / 1e6:g} ms: 60C2 has three digits up to 255")


def _time_out(master: Master, station: Station) -> None:
    """Let the drive miss its set-points (1400:5), if it can; the time begins with the next RPDO."""
    milliseconds = max(1, round(TIME_OUT * master.plan.period / 1e6))
    try:
        master.client.write(station.node, 0x1400, 5, struct.pack("<H", min(milliseconds, 0xFFFF)))
    except BusError as error:
        if getattr(error.__cause__, "code", None) not in ABSENT:
            raise


def _map(
    master: Master, node: int, index: int, cob_id: int, kind: int, items: Sequence[tuple[int, int, int, bool]]
) -> None:
    """The thesis's four steps: switch off, set identifier and type, write the entries, write the count back."""
    write, table = master.client.write, index + 0x200
    write(node, index, 1, struct.pack("<I", 1 << 31 | cob_id))
    write(node, table, 0, b"\0")
    write(node, index, 2, bytes([kind]))
    for k, (obj, sub, bits, _) in enumerate(items, start=1):
        write(node, table, k, struct.pack("<I", obj << 16 | sub << 8 | bits))
    write(node, table, 0, bytes([len(items)]))
    write(node, index, 1, struct.pack("<I", cob_id))


def _reach(master: Master, control: int, there: Callable[[int], bool]) -> None:
    """Send a controlword every cycle until every drive has got there."""
    for attempt in range(TRIES):
        start = master.clock()
        master.sync()
        master.gather()
        if all(station.stamp != NEVER and there(station.status) for station in master.stations):
            master.wait(Ns(start + master.plan.period))
            return
        # a fault is reset by the rising edge alone
        master.command(None, 0 if control == FAULT_RESET and attempt % 2 else control)
        master.wait(Ns(start + master.plan.period))
    stuck = next(s for s in master.stations if s.stamp == NEVER or not there(s.status))
    said = f"its statusword is 0x{stuck.status:04X}" if stuck.stamp != NEVER else "it sends no TPDO"
    raise BusError(f"node {stuck.node}: does not follow controlword 0x{control:02X}; {said}")
