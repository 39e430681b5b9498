"""Wireshark's CANopen dissector reads a log of the simulated wire: other people's idea of what these frames mean."""

import shutil
import subprocess
from collections import Counter
from pathlib import Path

import can
import pytest

from lwa4d_sim.assembly import build_blocks
from lwa4d_sim.bus.build import canopen_run
from lwa4d_sim.bus.frame_files import write
from lwa4d_sim.console import shipped_scenarios
from lwa4d_sim.frame_log import FrameLog
from lwa4d_sim.scenario import Scenario

pytestmark = pytest.mark.skipif(
    shutil.which("tshark") is None, reason="needs tshark (Debian: apt-get install tshark), Wireshark's CANopen decoder"
)

CYCLES = 40
NODES = range(3, 10)
# Names of the columns below; the first two are what tshark found wrong, if anything.
FIELDS = "_ws.malformed _ws.expert.severity frame.protocols can.id canopen.cob_id canopen.node_id _ws.col.Info"
FIELDS += " canopen.sdo.main_idx canopen.sdo.abort_code canopen.em.err_code canopen.em.err_reg canopen.nmt_guard.state"
FIELDS += " canopen.nmt_ctrl.cd canopen.nmt_ctrl.node_id"


def dissect(log: Path) -> list[dict[str, str]]:
    """What tshark says about each frame."""
    names = FIELDS.split()
    arguments = ["tshark", "-r", str(log), "-d", "can.subdissector,canopen", "-T", "fields", "-E", "separator=/t"]
    for name in names:
        arguments += ["-e", name]
    done = subprocess.run(arguments, capture_output=True, text=True, check=True, timeout=120)
    lines = done.stdout.splitlines()
    return [dict(zip(names, line.split("\t"), strict=True)) for line in lines]


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[dict[str, str]], FrameLog]:
    """A run of some cycles, near its end a SYNC that is too long, and its frames as tshark sees them."""
    scenario = Scenario.load(shipped_scenarios() / "canopen7_live.yaml")
    simulation, ticks = canopen_run(build_blocks([scenario], "canopen", 1))
    stranger = simulation.wire.port("stranger", lambda msg, now: None)
    for k, _ in enumerate(ticks):
        if k == CYCLES:
            stranger.send(can.Message(arbitration_id=0x080, data=b"\x01\x02", is_extended_id=False))
        if k == CYCLES + 1:
            break
    simulation.master.client.read(3, 0x1018, 1)
    log = FrameLog.of(simulation.wire.frames)
    path = tmp_path_factory.mktemp("tshark") / "run.log"
    write(log, path)
    return dissect(path), log


def test_every_frame_is_read_and_none_is_malformed(seen: tuple[list[dict[str, str]], FrameLog]) -> None:
    rows, log = seen
    assert len(rows) == len(log)
    assert [int(row["can.id"], 0) for row in rows] == log.id.tolist()
    assert not any(row["_ws.malformed"] or row["_ws.expert.severity"] for row in rows)
    kinds = Counter(row["_ws.col.Info"].split()[0] for row in rows)
    assert set(kinds) == {"NMT", "NMT:", "SYNC", "EMCY", "Default-SDO", "PDO1", "PDO2"}, kinds


def test_each_service_means_what_we_meant(seen: tuple[list[dict[str, str]], FrameLog]) -> None:
    rows, _ = seen
    info = [row["_ws.col.Info"] for row in rows]
    count = Counter((text, row["canopen.node_id"]) for text, row in zip(info, rows, strict=True))
    for node in NODES:
        mine = {text: number for (text, who), number in count.items() if who and int(who, 0) == node}
        assert all(mine[f"PDO{k} ({way})"] >= CYCLES for k in (1, 2) for way in ("tx", "rx"))
        answers, requests = (
            sum(n for text, n in mine.items() if text.startswith(f"Default-SDO ({way})")) for way in ("tx", "rx")
        )
        assert answers == requests > 20
    assert sum(text == "SYNC" for text in info) >= CYCLES
    started = {int(row["canopen.nmt_ctrl.node_id"], 0) for row in rows if row["canopen.nmt_ctrl.cd"] in ("0x01", "1")}
    assert started == set(NODES)


def test_boot_up_heartbeats_and_emergencies(seen: tuple[list[dict[str, str]], FrameLog]) -> None:
    rows, _ = seen
    guard = [row for row in rows if row["canopen.nmt_guard.state"]]
    for node in NODES:
        states = [int(row["canopen.nmt_guard.state"], 0) for row in guard if int(row["can.id"], 0) == 0x700 + node]
        assert states[0] == 0  # boot-up
        assert 5 in states  # operational
        errors = [row["canopen.em.err_code"] for row in rows if int(row["can.id"], 0) == 0x080 + node]
        assert [int(code, 0) for code in errors[:1]] == [0x8240]  # SYNC of a wrong length
    assert not any(row["canopen.sdo.abort_code"] for row in rows)
