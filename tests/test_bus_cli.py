"""The commands `lwa4d-sim bus ...`: what they print, and one line with exit code 2 for whatever is wrong."""

import json
import random
import re
import threading
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import can
import canopen
import pytest
import yaml
from cli_rig import Call, Result, caller

from lwa4d_sim.assembly import build_blocks
from lwa4d_sim.bus.arm import BusArm
from lwa4d_sim.bus.build import plan_for, served_arm
from lwa4d_sim.bus.connect import connect
from lwa4d_sim.bus.differences import Difference, differences
from lwa4d_sim.bus.entry import INVALID, Abort
from lwa4d_sim.bus.frames import frame_bits
from lwa4d_sim.bus.serve import monotonic, serve
from lwa4d_sim.bus.survey import Pdo, Surveyor
from lwa4d_sim.bus.wire import Wire
from lwa4d_sim.errors import BusError
from lwa4d_sim.interfaces import Ns
from lwa4d_sim.scenario import Scenario

MS = 1_000_000  # [ns]
SMALL: dict[str, Any] = {
    "name": "small",
    "arm": "lwa4d_3dof",
    "trajectory": {"waypoints": {"space": "joint", "points": [[-1.5, -1.5, 1.5]]}, "segment_time": 0.5},
    "controller": {"kind": "pd_gravity", "kp": 10.0, "kd": 5.0},
    "loop": {"kind": "canopen", "profile": "cia402", "nodes": [3, 4, 5]},
}


@pytest.fixture
def call(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Call:
    """Runs `lwa4d-sim bus` in a new folder that holds small.yaml."""
    monkeypatch.chdir(tmp_path)
    Path("small.yaml").write_text(yaml.safe_dump(SMALL))
    return caller(capfd, monkeypatch, "bus")


def refused(result: Result, words: str) -> None:
    """One clear line on stderr, exit code 2, nothing on stdout."""
    assert (result.code, result.out) == (2, ""), result
    [line] = result.err.splitlines()
    assert line.startswith("lwa4d-sim: ")
    assert re.search(words, line), line


class Served(NamedTuple):
    """The small arm on a virtual channel."""

    arm: BusArm
    channel: str
    bus: can.BusABC  # somebody else's end


Serve = Callable[..., Served]


def blocks_of(**loop: Any) -> Any:
    document = {**SMALL, "loop": {**SMALL["loop"], **loop}}
    Path("served.yaml").write_text(yaml.safe_dump(document))
    return build_blocks([Scenario.load(Path("served.yaml"), {})], "default", 1)


@pytest.fixture
def served(call: Call, monkeypatch: pytest.MonkeyPatch) -> Iterator[Serve]:
    """Serves the arm in a thread; what is changed about it beforehand is up to the test."""
    # a busy machine may keep the thread from answering for longer than a bus would
    monkeypatch.setattr("lwa4d_sim.bus.client.RESPONSE_TIMEOUT", 3.0)
    monkeypatch.setattr("lwa4d_sim.bus.survey.PATIENCE", 1.0)
    over = threading.Event()
    threads: list[threading.Thread] = []
    buses: list[Any] = []

    def start(change: Callable[[BusArm], object] = lambda arm: None, **loop: Any) -> Served:
        channel = f"served {random.getrandbits(64)}"
        bus = connect("virtual", channel)
        arm = served_arm(blocks_of(**loop), bus, epoch=monotonic(), per_sync=False)
        change(arm)
        threads.append(threading.Thread(target=serve, args=(arm, bus, monotonic, over.is_set)))
        threads[-1].start()
        buses.extend([bus, can.Bus(interface="virtual", channel=channel)])
        return Served(arm, channel, buses[-1])

    yield start
    over.set()
    for thread in threads:
        thread.join()
    for each in buses:
        each.shutdown()


def frames_on(bus: can.BusABC) -> list[can.Message]:
    return list(iter(lambda: bus.recv(0.0), None))


# ---- bad input ----

ON_A_BUS = {"serve": ["small.yaml"], "drive": ["small.yaml", "--arm"], "check": [], "check FILE": ["small.yaml"]}


@pytest.mark.parametrize("command", ON_A_BUS)
def test_an_interface_or_channel_that_is_none(call: Call, command: str) -> None:
    command, arguments = command.split()[0], ON_A_BUS[command]
    refused(
        call(command, *arguments, "-i", "nix", "-c", "a"), "no interface 'nix'; python-can has .*udp_multicast.*virtual"
    )
    for interface, channel in [
        ("udp_multicast", "not an address"),
        ("udp_multicast", "239.1.1.1:70000"),
        ("udp_multicast", "239.1.1.1:" + 5000 * "9"),
        ("kvaser", "0"),
        ("socketcan", "x9"),
    ]:
        result = call(command, *arguments, "-i", interface, "-c", channel)
        refused(result, f"cannot open {interface} channel '{channel.split(':')[0]}")


def test_a_channel_on_which_the_arm_is_already(call: Call, served: Serve) -> None:
    there = served()
    result = call("serve", "small.yaml", "-i", "virtual", "-c", there.channel)
    refused(result, f"virtual channel '{there.channel}' is in use: node 3 answers there already")
    assert all(drive.braked for drive in there.arm.drives)


def test_nobody_answers(call: Call) -> None:
    refused(
        call("drive", "small.yaml", "-i", "virtual", "-c", "empty", "--arm"), "node 3: cannot read object 0x1000:00"
    )
    result = call("check", "-i", "virtual", "-c", "empty", "--seconds", "0.1")
    refused(result, "no node answers on virtual channel 'empty': check power, bit rate, wiring and termination$")


def refuse_mode(arm: BusArm) -> None:
    before = arm.drives[1].written

    def written(index: int, sub: int) -> None:
        if index == 0x6060:
            raise Abort(INVALID)
        before(index, sub)

    arm.drives[1].written = written  # type: ignore[method-assign]


def not_a_drive(arm: BusArm) -> None:
    arm.nodes[2].dictionary.redefine((0x1000, 0), 0x191)


@pytest.mark.parametrize(
    ("change", "profile", "words"),
    [
        (
            lambda arm: None,
            "lwa4d",
            r"node 3: does not support mode 10 of the profile 'cia402'; .* \(0x6502\) are 0x43",
        ),
        (refuse_mode, "cia402", r"node 4: cannot write object 0x6060:00: .*[Vv]alue.* \(SDO abort 0x06090030\)"),
        (not_a_drive, "cia402", r"node 5: is no drive: device type 0x00000191, expected profile 402"),
    ],
    ids=["no such mode", "SDO abort", "other profile"],
)
def test_drives_that_are_not_what_the_scenario_wants(
    call: Call, served: Serve, change: Callable[[BusArm], None], profile: str, words: str
) -> None:
    there = served(change, profile=profile)
    refused(call("drive", "small.yaml", "-i", "virtual", "-c", there.channel, "--arm"), words)
    # and nothing has been enabled on the way: no controlword was sent
    rpdos = [
        msg for msg in frames_on(there.bus) if 0x200 < msg.arbitration_id < 0x580 and msg.arbitration_id & 0x80 == 0
    ]
    assert all(drive.braked for drive in there.arm.drives)
    assert not any(msg.data[0] & 0x0F == 0x0F for msg in rpdos if (msg.arbitration_id & 0x780) == 0x200)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "cannot read the data sheet: No such file"),
        ("", "no data sheet"),
        ("\0\1\2 \n[", "no data sheet: "),
        ("[1000]\nParameterName=x\nObjectType=what\n", "no data sheet: "),
        (
            "[1000]\nParameterName=x\nObjectType=0x7\nDataType=0x99999999999\nAccessType=ro\n",
            "bad.eds: no data sheet: ",
        ),
        (
            "[1000]\nParameterName=x\nObjectType=0x8\nDataType=7\nCompactSubObj=4000000000\n",
            r"\[1000\] has CompactSubObj",
        ),
        (
            "[1400]\nParameterName=x\nObjectType=0x7\nDataType=7\nDefaultValue=$NODEID*fish\n",
            "bad.eds: no data sheet: ",
        ),
    ],
)
def test_a_data_sheet_that_is_none(call: Call, text: str | None, words: str) -> None:
    if text is not None:
        Path("bad.eds").write_text(text)
    result = call("check", "-i", "virtual", "-c", "empty", "--seconds", "0", "--eds", "bad.eds")
    refused(result, words)


@pytest.mark.parametrize("command", [["serve"], ["drive"], ["drive", "--arm"], ["check"], ["timing"], ["eds"]])
@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "x.yaml: cannot read the scenario: No such file"),
        ("name: [", "x.yaml:.*"),
        (
            yaml.safe_dump({**SMALL, "loop": {"kind": "ideal"}}),
            "x.yaml: an ideal loop has no bus; choose another variant",
        ),
    ],
    ids=["missing", "no YAML", "no bus"],
)
def test_a_scenario_that_cannot_be_on_a_bus(call: Call, command: list[str], text: str | None, words: str) -> None:
    if text is not None:
        Path("x.yaml").write_text(text)
    name, *options = command
    options += {"timing": [], "eds": ["-o", "sheets"]}.get(name, ["-i", "virtual", "-c", f"{random.getrandbits(64)}"])
    refused(call(name, "x.yaml", *options), words)
    assert not Path("sheets").exists()
    assert not Path("runs").exists()


@pytest.mark.parametrize(
    "command", [["drive", "-i", "virtual", "-c", "a"], ["drive", "-i", "virtual", "-c", "a", "--arm"], ["timing"]]
)
def test_a_period_too_short_for_the_bus(call: Call, command: list[str]) -> None:
    name, *options = command
    result = call(name, "small.yaml", *options, "--set", "loop.period=0.002", "--set", "plant.timestep=0.001")
    refused(
        result, r"small\.yaml:\d+: loop\.bit_rate: 3 drives every 2 ms take up to 1\d\d % of the bus at 500000 bit/s"
    )


def test_a_folder_that_cannot_be_written(call: Call) -> None:
    Path("file").write_text("")
    refused(call("eds", "small.yaml", "-o", "file"), "file")
    refused(call("timing", "small.yaml", "-o", "file"), "file")


def test_a_folder_for_the_record_is_made_before_the_arm_moves(call: Call, served: Serve) -> None:
    there = served(profile="lwa4d")
    Path("file").write_text("")
    refused(call("drive", "small.yaml", "-i", "virtual", "-c", there.channel, "--arm", "-o", "file"), "file")
    assert not [msg for msg in frames_on(there.bus) if msg.arbitration_id == 0x080]


@pytest.mark.parametrize("command", [["serve"], ["drive", "--arm"], ["check"], ["eds", "-o", "sheets"]])
def test_node_ids_that_do_not_fit_are_said_with_their_place(call: Call, command: list[str]) -> None:
    bus = [] if command[0] == "eds" else ["-i", "virtual", "-c", f"{random.getrandbits(64)}"]
    result = call(command[0], "small.yaml", *command[1:], *bus, "--set", "loop.nodes=[1, 1, 2]")
    refused(result, r"small.yaml: loop.nodes .*must be 3 different node ids")


def test_listening_for_ever_is_refused(call: Call) -> None:
    refused(call("check", "-i", "virtual", "-c", "empty", "--seconds", "inf"), "less than or equal to 3600")


# ---- what works ----


def test_a_dry_run_prints_frames_and_opens_no_bus(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*args: Any, **options: Any) -> None:
        raise AssertionError("a bus was opened")

    monkeypatch.setattr(can, "Bus", forbidden)
    result = call("drive", "small.yaml", "-i", "nix", "-c", "nowhere")
    assert (result.code, result.err) == (0, "")
    first, *lines = result.out.splitlines()
    assert first.startswith("dry run: ")
    assert "--arm" in first
    frames = [re.fullmatch(r" *(-?\d+\.\d{6})  ([0-9A-F]{3})#([0-9A-F]*) +(\S.*)", line) for line in lines]
    assert all(frames)
    seen = [(match[2], match[3], match[4]) for match in frames if match]
    assert ("000", "0103", "NMT") in seen
    assert ("080", "", "SYNC") in seen
    # controlwords in the order of the thesis's table 3.3: 6, 7, and only then F
    words = [int(data[:2], 16) for name, data, _ in seen if name == "203"]
    assert [word for k, word in enumerate(words) if k == 0 or word != words[k - 1]][-3:] == [0x06, 0x07, 0x0F]
    times = [float(match[1]) for match in frames if match]
    assert times == sorted(times)


def test_timing_as_an_object(call: Call) -> None:
    result = call("timing", "small.yaml", "--cycles", "20", "--json", "-o", "out")
    assert (result.code, result.err) == (0, "")
    found = json.loads(result.out)
    assert Path(found["picture"]).is_file()
    ids = [frame["id"] for frame in found["frames"]]
    pdos = [base + node for base in (0x180, 0x200, 0x280, 0x300) for node in (3, 4, 5)]
    assert sorted(ids) == sorted([0x080, *pdos])
    for frame in found["frames"]:
        assert frame.keys() == {"id", "bits", "start", "end", "outcome"}
        assert frame["outcome"] == "sent"
        # received the three interframe bits before the bus is free again
        assert frame["end"] - frame["start"] == pytest.approx((frame["bits"] - 3) / 500_000, abs=1e-9)
        assert 0 <= frame["start"] < 0.01
    assert 0.1 < found["load"] < 0.4
    assert found["response"].keys() == {str(each) for each in {*ids, *(0x700 + node for node in (3, 4, 5, 127))}}
    for response in found["response"].values():
        assert response.keys() == {"max", "bound"}
        assert 0 < response["max"] <= response["bound"]


def test_timing_of_a_wire_with_errors(call: Call) -> None:
    """Spoilt frames end when the wire is free again."""
    noise = ("--set", "loop.noise.per_bit=2e-3", "--cycles", "8", "-o", "out")
    frames = json.loads(call("timing", "small.yaml", *noise, "--json").out)["frames"]
    assert {frame["outcome"] for frame in frames} == {"sent", "error"}
    assert all(frame["start"] < frame["end"] for frame in frames)
    assert all(one["end"] <= other["start"] + 1e-9 for one, other in pairwise(frames))
    rows = call("timing", "small.yaml", *noise).out.split("\n\n")[0].splitlines()[1:]
    assert [row.endswith("  error") for row in rows] == [frame["outcome"] == "error" for frame in frames]


def test_sheets_that_the_library_reads(call: Call) -> None:
    result = call("eds", "small.yaml", "-o", "some/where")
    assert (result.code, result.err) == (0, "")
    assert result.out.split() == [str(Path("some/where") / f"node{node}.eds") for node in (3, 4, 5)]
    for node, path in zip((3, 4, 5), result.out.split(), strict=True):
        od: Any = canopen.import_od(path, node)
        assert od[0x1000].default == 0x20192
        assert od[0x1400][1].default == 0x200 + node
        assert od[0x6071].pdo_mappable  # the profile asked for
    assert call("eds", "small.yaml", "-o", "real", "--set", "loop.profile=lwa4d").code == 0
    assert 0x6071 not in canopen.import_od("real/node3.eds", 3)


def test_check_of_a_served_arm(call: Call, served: Serve) -> None:
    there = served()
    result = call("check", "small.yaml", "-i", "virtual", "-c", there.channel, "--seconds", "0.2", "--json")
    assert (result.code, result.err) == (0, "")
    found = json.loads(result.out)
    assert [node["node"] for node in found["nodes"]] == [3, 4, 5]
    assert (found["sync_period"], found["error_frames"], found["differences"]) == (None, 0, [])
    for number, node in enumerate(found["nodes"], start=1):
        assert node["answers"] == 1
        assert node["device"] == 0x20192
        assert (node["name"], node["firmware"]) == (f"joint{(1, 2, 4)[number - 1]}", "0.63")
        assert node["identity"] == [0, 0, 63, number + 2]
        assert (node["modes"], node["mode"], node["register"], node["errors"]) == (0x3EF, 0, 0, [])
        assert node["status"] & 0x4F == 0x40
        assert node["position"] == there.arm.nodes[number - 1].dictionary[0x6064, 0]
        assert {"name": "RPDO2", "cob_id": 0x302 + number, "kind": 1}.items() <= node["pdos"][1].items()
        assert node["pdos"][1]["entries"] == [[0x60FF, 0, 32], [0x60B2, 0, 16]]
    # it reads: every request is an upload, and nothing else was sent
    sent = [msg for msg in frames_on(there.bus) if not 0x580 < msg.arbitration_id < 0x600]
    assert sum(msg.arbitration_id > 0x600 for msg in sent) > 127
    for msg in sent:
        assert 0x600 < msg.arbitration_id < 0x680 or msg.arbitration_id in (0x703, 0x704, 0x705)
        assert msg.arbitration_id > 0x700 or msg.data[0] in (0x40, 0x60, 0x70)  # initiate upload, its segments


def test_check_as_tables(call: Call, served: Serve) -> None:
    there = served(not_a_drive, profile="lwa4d")
    result = call("check", "small.yaml", "-i", "virtual", "-c", there.channel, "--seconds", "0.2")
    assert (result.code, result.err) == (1, "")
    assert re.search(r"^3 +joint1 +0\.63 +0x20192 +0 0 63 3 ", result.out, re.MULTILINE)
    assert re.search(r"^4 +PP VL IP \(0x43\) +0 +switch on disabled \(0x\w{4}\) ", result.out, re.MULTILINE)
    assert re.search(r"^5 +RPDO1 +205 +255 +6040/16 60B2/16 60C1:1/32", result.out, re.MULTILINE)
    assert re.search(r"^  nodes 3, 4: does not support mode 10 of the profile 'cia402'", result.out, re.MULTILINE)
    assert "  node 5: is no drive: device type 0x00000191, expected profile 402\n" in result.out
    assert "  nodes 3, 4: RPDO1 maps 6040/16 60B2/16 60C1:1/32, type 255; in the scenario 6040/16 6071/16" in result.out


def test_check_beside_a_data_sheet(call: Call, served: Serve) -> None:
    there = served(profile="lwa4d")
    call("eds", "small.yaml", "-o", "rich")
    call("eds", "small.yaml", "-o", "poor", "--set", "loop.profile=lwa4d")
    options = ["-i", "virtual", "-c", there.channel, "--seconds", "0", "--json"]
    assert json.loads(call("check", *options, "--eds", "poor/node3.eds").out)["differences"] == []
    result = call("check", *options, "--eds", "rich/node3.eds")
    assert result.code == 1
    [found] = json.loads(result.out)["differences"]
    assert found["nodes"] == [3, 4, 5]
    assert {"6071", "605A", "6007", "1010:1"} <= set(found["text"].split())
    assert not {"6064", "1000", "6040"} & set(found["text"].split())


def one_step_a_sync(spacing: int, silence: int) -> list[int]:
    """Positions [mdeg] after each SYNC of a move of joint 1, SYNCs so many milliseconds apart after a silence."""
    bus: Any = type("", (), {"send": lambda self, msg: None})()
    arm = served_arm(blocks_of(), bus, epoch=Ns(0), per_sync=True)
    now = Ns(0)
    arm.power_on(now)

    def put(cob_id: int, *data: int) -> None:
        arm.receive(can.Message(arbitration_id=cob_id, data=bytes(data), is_extended_id=False), now)

    def run(count: int) -> None:
        nonlocal now
        for _ in range(count * spacing):
            now = Ns(now + MS)
            arm.poll(now)
            arm.catch_up(now)
            if now % (spacing * MS) == 0:
                put(0x080)
                seen.append(arm.nodes[0].dictionary[0x6064, 0])

    seen: list[int] = []
    now = Ns(silence * spacing * MS)
    put(0x000, 0x01, 0)
    put(0x603, 0x2F, 0x60, 0x60, 0, 1, 0, 0, 0)
    for word in (0x06, 0x07, 0x0F):
        put(0x603, 0x2B, 0x40, 0x60, 0, word, 0, 0, 0)
        run(2)
    put(0x603, 0x23, 0x7A, 0x60, 0, *(seen[0] + 3000).to_bytes(4, "little", signed=True))
    put(0x603, 0x2B, 0x40, 0x60, 0, 0x1F, 0, 0, 0)
    run(50)
    return seen


def test_an_arm_of_one_step_a_sync_knows_no_other_time(call: Call) -> None:
    """The motion is a function of the number of SYNCs alone, whatever the clock of the bus says."""
    expected = one_step_a_sync(10, 0)
    assert abs(expected[-1] - expected[0] - 3000) < 100
    assert one_step_a_sync(25, 0) == expected
    assert one_step_a_sync(3, 5000) == expected


# ---- in virtual time, against what was put on the wire ----


def blank(wire: Wire, **options: Any) -> Surveyor:
    return Surveyor(wire.port("surveyor"), lambda: wire.now, **options)


def test_load_and_sync_are_those_of_the_frames_sent() -> None:
    wire = Wire(500_000)
    other = wire.port("other", lambda msg, now: None)
    spacing = [10, 10, 12, 8, 10, 10, 10, 10, 10]
    sent = [can.Message(arbitration_id=0x080, is_extended_id=False)]
    sent.append(can.Message(arbitration_id=0x1ABCDEF, data=bytes(8), is_extended_id=True))
    sent.append(can.Message(arbitration_id=0x181, data=b"\x0f\x0f\x0f", is_extended_id=False))
    at = 5
    for gap in spacing:
        for msg in sent:
            wire.call_at(Ns(at * MS), lambda msg=msg: other.send(msg))  # type: ignore[misc]
        at += gap
    beat = can.Message(arbitration_id=0x70B, data=b"\x7f", is_extended_id=False)
    wire.call_at(Ns(50 * MS), lambda: other.send(beat))
    found = blank(wire).survey(500_000, 0.1)
    assert found.seconds == pytest.approx(0.1)
    assert found.frames == 3 * len(spacing) + 1
    bits = len(spacing) * sum(map(frame_bits, sent)) + frame_bits(beat)
    assert found.load == pytest.approx(bits / 500_000 / 0.1)
    assert found.sync_period == pytest.approx(0.010, abs=1e-9)
    assert found.sync_jitter == pytest.approx(0.002, abs=1e-9)
    # heard, but silent when asked
    assert [(node.node, node.answers, node.nmt, node.heartbeats) for node in found.nodes] == [(11, 0, 127, 1)]


def test_two_nodes_of_one_id_are_told(call: Call) -> None:
    wire = Wire(None)
    ports: list[Any] = []

    def answer(k: int, msg: can.Message) -> None:
        if msg.arbitration_id == 0x607:
            index = bytes(msg.data[1:4])
            data = (
                b"\x43" + index + (0x191).to_bytes(4, "little")
                if index[:2] == b"\x00\x10"
                else b"\x80" + index + bytes(4)
            )
            ports[k].send(can.Message(arbitration_id=0x587, data=data, is_extended_id=False))

    ports.append(wire.port("twin 1", lambda msg, now: answer(0, msg)))
    ports.append(wire.port("twin 2", lambda msg, now: answer(1, msg)))
    found = blank(wire).survey(None, 0.0)
    assert [(node.node, node.answers, node.device, node.name) for node in found.nodes] == [(7, 2, None, None)]
    assert found.load is None
    blocks = blocks_of()
    said = [str(each) for each in differences(found, plan_for(blocks, blocks.settings.loop), None)]
    assert "node 7: is not in the scenario" in said
    assert "nodes 3, 4, 5: is missing" in said


def test_what_differs_is_said_of_each_thing(call: Call) -> None:
    blocks = blocks_of()
    plan = plan_for(blocks, blocks.settings.loop)
    wire = Wire(None)

    def received(msg: can.Message, now: Ns) -> None:
        arm.receive(msg, now)

    port = wire.port("arm", received)
    arm = BusArm(blocks.plant, plan.joints, "cia402", None, lambda node: port.send)
    arm.power_on(wire.now)
    found = blank(wire).survey(None, 0.0)
    assert differences(found, plan, 500_000) == []
    node = found.nodes[1]

    def said(rewritten: bool = False) -> list[str]:
        found_now = differences(found, plan, 500_000)
        assert all(isinstance(each, Difference) and each.rewritten == rewritten for each in found_now)
        return [str(each) for each in found_now]

    limits, node.limits = node.limits, (-1000, node.limits[1])
    assert said() == [f"node 4: lower position limit (607D:1) is -1000 mdeg, in the scenario {limits[0]} mdeg"]
    node.limits = limits
    modes, node.modes = node.modes, 0x200
    assert said() == ["node 4: supports the modes 0x200, a drive of the profile 'cia402' 0x3EF"]
    node.modes = modes
    pdos, node.pdos = node.pdos, [pdo for pdo in node.pdos if pdo.name != "TPDO2"]
    assert said() == ["node 4: has no TPDO2"]
    node.pdos = [Pdo("TPDO3", 0x384, 1, ((0x6064, 0, 32),)) if pdo.name == "TPDO3" else pdo for pdo in pdos]
    assert said() == ["node 4: TPDO3 is in use (6064/32), and the scenario's master leaves it so"]
    node.pdos = [Pdo("RPDO1", 0x204, 255, pdo.entries) if pdo.name == "RPDO1" else pdo for pdo in pdos]
    entries = "6040/16 6071/16 607A/32"
    assert said(rewritten=True) == [f"node 4: RPDO1 maps {entries}, type 255; in the scenario {entries}, type 1"]
    node.pdos = pdos
    node.answers = 2
    assert said() == ["node 4: 2 answers to one request: two nodes have this id"]
    node.answers = 0
    assert said() == ["node 4: does not answer requests"]
    node.answers = 1
    found.sync_period, found.sync_jitter = 0.02, 0.0
    assert said() == [
        "a SYNC producer is at work; the scenario's master would be the second",
        "SYNC comes every 20.000 ms, in the scenario every 10 ms",
    ]
    found.sync_period = None
    found.load = 0.9
    assert said()[0].startswith("the scenario's frames and those heard take up to 1")


def test_a_bus_that_fails_is_a_clear_error() -> None:
    class Broken:
        channel_info = "broken"

        def send(self, msg: can.Message, timeout: float | None = None) -> None:
            raise can.CanOperationError("no buffer space")

        def recv(self, timeout: float | None = None) -> can.Message | None:
            raise can.CanOperationError("network is down")

    surveyor = Surveyor(Broken(), monotonic)
    with pytest.raises(BusError, match="cannot send on broken: no buffer space"):
        surveyor.survey(None, 0.0)
    with pytest.raises(BusError, match="cannot receive from broken: network is down"):
        surveyor.survey(None, 0.1)
