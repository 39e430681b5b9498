"""SDO server: the canopen library's client in all transfers, the standard's frames by hand, and hostile clients."""

from binascii import crc_hqx

import canopen
import pytest
from bus_loop import MS, NODE, SCRATCH, Bench, Loop
from canopen.sdo.exceptions import SdoAbortedError
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lwa4d_sim.bus.sdo import BUFFER, SdoServer
from lwa4d_sim.interfaces import Ns

SCRATCH_HEX = "002f00"  # multiplexer of the scratch memory


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.fixture
def remote(bench: Bench) -> canopen.RemoteNode:
    return Loop(bench).join()


# The canopen library's client.


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None, max_examples=60)
@given(data=st.binary(max_size=2000), up=st.sampled_from("ebBs"), down=st.sampled_from("ebBs"))
def test_every_transfer_carries_the_same_bytes(remote: canopen.RemoteNode, data: bytes, up: str, down: str) -> None:
    """e: whatever the client finds best, s: segments, b: blocks with CRC, B: without."""
    if down in "es" or not data:  # the client does not finish a block download of nothing
        remote.sdo.download(SCRATCH, 0, data, force_segment=down == "s")
    else:
        stream = remote.sdo.open(
            SCRATCH, 0, "wb", buffering=7, size=len(data), block_transfer=True, request_crc_support=down == "b"
        )
        with stream:
            stream.write(data)
    if up in "es":
        assert remote.sdo.upload(SCRATCH, 0) == data
    else:
        with remote.sdo.open(SCRATCH, 0, "rb", block_transfer=True, request_crc_support=up == "b") as stream:
            assert stream.read() == data


@pytest.mark.parametrize("lost", [1, 2, 100, 130])  # the client itself fails when the last of a block is lost
def test_a_segment_lost_in_a_block_is_sent_again(bench: Bench, lost: int) -> None:
    loop = Loop(bench)
    remote = loop.join()
    data = bytes(k * 7 % 251 for k in range(2000))
    seen = {0x600 + NODE: 0, 0x580 + NODE: 0}

    def drop(cob_id: int, frame: bytes) -> bytes | None:
        if frame[0] & 0x7F == (lost - 1) % 127 + 1 and frame[1:4] != b"\x00\x2f\x00":
            seen[cob_id] += 1
            if seen[cob_id] == (lost - 1) // 127 + 1:
                return None
        return frame

    with remote.sdo.open(SCRATCH, 0, "wb", buffering=7, size=len(data), block_transfer=True) as stream:
        loop.tamper = drop
        stream.write(data)
    loop.tamper = lambda cob_id, frame: frame
    assert bench.dictionary[SCRATCH, 0] == data
    with remote.sdo.open(SCRATCH, 0, "rb", block_transfer=True) as stream:
        loop.tamper = drop
        assert stream.read() == data


@pytest.mark.parametrize(
    ("index", "sub", "data", "code"),
    [
        (0x2345, 0, b"\0", 0x06020000),  # no such object
        (0x1000, 5, b"\0", 0x06090011),  # a variable has no sub-indices
        (0x1400, 7, b"\0", 0x06090011),
        (0x6041, 0, b"\0\0", 0x06010002),  # read-only
        (0x1008, 0, b"x", 0x06010002),  # constant
        (0x6040, 0, b"\0", 0x06070013),
        (0x6040, 0, b"\0\0\0", 0x06070012),
        (0x6060, 0, b"\0\0", 0x06070012),
        (0x605A, 0, b"\x09\0", 0x06090031),
        (0x60C0, 0, b"\xfe\xff", 0x06090032),
        (0x1017, 0, b"\0\x80", 0x06090031),
        (0x1400, 2, b"\xf1", 0x06090030),  # 241, reserved
        (0x2024, 0, b"\0\0\xc0\x7f", 0x06090030),  # NaN
        (0x1010, 1, b"evas", 0x08000020),
        (0x1011, 1, b"save", 0x08000020),
        (0x1003, 0, b"\1", 0x06090030),
        (0x2008, 0, b"\xff", 0x06090030),  # not text
    ],
)
@pytest.mark.parametrize("segments", [False, True])
def test_a_wrong_write_is_refused_with_the_right_code(
    remote: canopen.RemoteNode, index: int, sub: int, data: bytes, code: int, segments: bool
) -> None:
    with pytest.raises(SdoAbortedError) as refused:
        remote.sdo.download(index, sub, data, force_segment=segments)
    assert refused.value.code == code
    assert remote.sdo.upload(0x1000, 0) == bytes.fromhex("92010200")  # and the server is ready


@pytest.mark.parametrize(
    ("index", "sub", "code"),
    [(0x2345, 0, 0x06020000), (0x1000, 5, 0x06090011), (0x1018, 9, 0x06090011), (0x2008, 0, 0x06010001)],
)
@pytest.mark.parametrize("block", [False, True])
def test_a_wrong_read_is_refused_with_the_right_code(
    remote: canopen.RemoteNode, index: int, sub: int, code: int, block: bool
) -> None:
    with pytest.raises(SdoAbortedError) as refused:
        remote.sdo.open(index, sub, "rb", buffering=0, block_transfer=block)
    assert refused.value.code == code


def test_long_values_of_the_firmware_come_in_segments_and_blocks() -> None:
    bench = Bench("lwa4d")
    remote = Loop(bench).join()
    image = bench.dictionary[0x2007, 1]
    assert remote.sdo.upload(0x2007, 1) == image
    with remote.sdo.open(0x2007, 1, "rb", block_transfer=True) as stream:
        assert stream.read() == image
    assert remote.sdo[0x1008].raw == "PRL 100"


# Frames by hand: request > answer; an empty answer is silence. 8 bytes in hexadecimal.

DIALOGUES = {
    "expedited": "2b40600006000000>6040600000000000 4040600000000000>4b40600006000000",
    "expedited without size": "2240600007000000>6040600000000000 4040600000000000>4b40600007000000",
    "segments, first toggle wrong": f"21{SCRATCH_HEX}02000000>60{SCRATCH_HEX}00000000 "
    f"1b61620000000000>80{SCRATCH_HEX}00000305 0b61620000000000>8000000001000405",
    "segment never announced": "0061620000000000>8000000001000405",
    "segment asked for without upload": "6000000000000000>8000000001000405",
    "upload, second toggle wrong": "4008100000000000>4108100007000000 7000000000000000>8008100000000305",
    "upload in segments": "4008100000000000>4108100007000000 6000000000000000>0150524c20313030",
    "unknown command": "e040600000000000>8040600001000405",
    "size told is too long": f"21406000{'05000000'}>8040600012000706",
    "size told is beyond all": "21002f00ffffffff>80002f0012000706",
    "fewer bytes than told": f"21{SCRATCH_HEX}03000000>60{SCRATCH_HEX}00000000 "
    f"0b61620000000000>80{SCRATCH_HEX}10000706",
    "more bytes than told": f"21{SCRATCH_HEX}01000000>60{SCRATCH_HEX}00000000 0b61620000000000>80{SCRATCH_HEX}12000706",
    "client gives up": f"21{SCRATCH_HEX}02000000>60{SCRATCH_HEX}00000000 80{SCRATCH_HEX}00000405> "
    "0061620000000000>8000000001000405",
    "a new request ends the old": f"21{SCRATCH_HEX}02000000>60{SCRATCH_HEX}00000000 "
    "4000100000000000>4300100092010200 0061620000000000>8000000001000405",
    "block upload of short data the plain way": "a04060007f150000>4b40600000000000",
    "block size 0": "a408100000000000>8008100002000405",
    "block size 128": "a408100080000000>8008100002000405",
    "block start without request": "a300000000000000>8000000001000405",
    "block acknowledged beyond": "a00810007f000000>c208100007000000 a300000000000000>8150524c20313030 "
    "a2027f0000000000>8008100003000405",
    "block upload": "a40810007f000000>c608100007000000 a300000000000000>8150524c20313030 "
    "a2017f0000000000>c1%s0000000000 a100000000000000>",
    "end of a block download first": f"c2{SCRATCH_HEX}02000000>a0{SCRATCH_HEX}7f000000 "
    f"0000000000000000>80{SCRATCH_HEX}03000405",
    "block download": f"c6{SCRATCH_HEX}02000000>a4{SCRATCH_HEX}7f000000 8161620000000000>a2017f0000000000 "
    "d5%s0000000000>a100000000000000",
    "block download, wrong CRC": f"c6{SCRATCH_HEX}02000000>a4{SCRATCH_HEX}7f000000 "
    f"8161620000000000>a2017f0000000000 d5ffff0000000000>80{SCRATCH_HEX}04000405",
    "block download, other size": f"c2{SCRATCH_HEX}02000000>a0{SCRATCH_HEX}7f000000 "
    f"8161620000000000>a2017f0000000000 d900000000000000>80{SCRATCH_HEX}10000706",
    "block download, read-only": "c241600002000000>8041600002000106",
}
for name, text in (("block upload", b"PRL 100"), ("block download", b"ab")):
    DIALOGUES[name] %= crc_hqx(text, 0).to_bytes(2, "little").hex()


@pytest.mark.parametrize("name", DIALOGUES)
def test_frames_of_the_standard(bench: Bench, name: str) -> None:
    for step in DIALOGUES[name].split(" "):
        if step:
            request, answer = step.split(">")
            assert bench.sdo(request) == answer, request
    assert bench.sdo("4000100000000000") == "4300100092010200"


def test_a_block_that_came_in_part_is_sent_again_from_there(bench: Bench) -> None:
    bench.dictionary[SCRATCH, 0] = bytes(range(30))
    bench.sdo(f"a0{SCRATCH_HEX}03000000")
    first = bench.sdo("a300000000000000").split()
    assert first == [f"0{k + 1}" + bytes(range(7 * k, 7 * k + 7)).hex() for k in range(3)]
    again = bench.sdo("a202040000000000").split()
    assert again == ["01" + first[2][2:], "0215161718191a1b", "831c1d0000000000"]
    assert bench.sdo("a200040000000000").split() == again
    assert bench.sdo("a203040000000000")[:2] == f"{0xC1 | 5 << 2:02x}"


def test_a_last_segment_after_a_gap_is_not_the_end(bench: Bench) -> None:
    assert bench.sdo(f"c2{SCRATCH_HEX}0f000000") == f"a0{SCRATCH_HEX}7f000000"
    assert bench.sdo("0161626364656667") == ""
    assert bench.sdo("836f000000000000") == "a2017f0000000000"
    assert bench.sdo("0168696a6b6c6d6e") == ""
    assert bench.sdo("826f000000000000") == "a2027f0000000000"
    assert bench.sdo("d900000000000000") == "a100000000000000"
    assert bench.dictionary[SCRATCH, 0] == b"abcdefghijklmno"


@pytest.mark.parametrize("length", range(8))
def test_a_short_request_is_no_request(bench: Bench, length: int) -> None:
    assert bench.put(0x600 + NODE, bytes.fromhex("4000100000000000")[:length]) == []
    assert bench.sdo("4000100000000000") == "4300100092010200"


@pytest.mark.parametrize(
    "opening",
    [
        [f"21{SCRATCH_HEX}10000000"],
        [f"21{SCRATCH_HEX}10000000", "0061626364656667"],
        ["4008100000000000"],
        ["a40810007f000000", "a300000000000000"],
        [f"c2{SCRATCH_HEX}10000000", "0161626364656667"],
    ],
)
def test_a_client_that_stops_is_given_up_after_a_second(bench: Bench, opening: list[str]) -> None:
    for request in opening:
        bench.run(bench.now + 300 * MS)
        bench.sdo(request)
    begun = bench.now
    ended = [(t, data) for t, cob_id, data in bench.run(begun + 5000 * MS) if cob_id == 0x580 + NODE]
    named = bytes.fromhex("081000" if "0810" in opening[0] else SCRATCH_HEX)
    assert ended == [(begun + 1000 * MS, b"\x80" + named + bytes.fromhex("00000405"))]
    assert bench.sdo("0061620000000000") == "8000000001000405"  # nothing is open


def test_an_endless_download_is_ended_at_the_capacity_of_its_object(bench: Bench) -> None:
    for index, capacity in ((0x2008, 64), (SCRATCH, 65536)):
        mux = index.to_bytes(2, "little").hex() + "00"
        assert bench.sdo(f"20{mux}00000000") == f"60{mux}00000000"
        for k in range(capacity // 7):
            answer = bench.sdo(("10" if k % 2 else "00") + "61" * 7)
            assert answer == ("30" if k % 2 else "20") + "00" * 7
        k = capacity // 7
        assert bench.sdo(("10" if k % 2 else "00") + "61" * 7) == f"80{mux}12000706"
    assert bench.dictionary[SCRATCH, 0] == b""


def test_an_endless_block_download_is_ended_too(bench: Bench) -> None:
    bench.sdo("c008200000000000")
    answers = [bench.sdo(f"{k:02x}" + "61" * 7) for k in range(1, 20)]
    first = next(k for k, answer in enumerate(answers) if answer)
    assert answers[first] == "8008200012000706"
    assert first <= 64 // 7 + 1  # one segment of padding beyond the 64 bytes of the object


def test_the_buffer_has_an_end_whatever_an_object_takes() -> None:
    class Endless:
        def read(self, index: int, sub: int) -> bytes:
            return b""

        def write(self, index: int, sub: int, data: bytes) -> None:
            raise AssertionError

        def capacity(self, index: int, sub: int) -> int:
            return 1 << 40

    sent: list[bytes] = []
    server = SdoServer(Endless(), sent.append)
    server.receive(bytes.fromhex("2100200000000100"), Ns(0))
    assert sent.pop()[0] == 0x60
    server.receive(bytes.fromhex("2100200001000100"), Ns(0))
    assert sent.pop() == bytes.fromhex("8000200005000405")
    server.receive(bytes.fromhex("2000200000000000"), Ns(0))
    for k in range(BUFFER // 7 + 1):
        server.receive(bytes((k % 2 << 4,)) + bytes(7), Ns(0))
    assert sent.pop() == bytes.fromhex("8000200005000405")


# Any client at all.

REQUESTS = st.one_of(
    st.binary(min_size=8, max_size=8),
    st.tuples(
        st.sampled_from([*range(0x20, 0x30), 0x40, 0x80, 0xA0, 0xA1, 0xA2, 0xA3, 0xA4, 0xC0, 0xC1, 0xC2, 0xC4, 0xC6]),
        st.sampled_from([0x2F00, 0x1008, 0x6040, 0x2008, 0x1A00, 0x1017]),
        st.integers(0, 2),
        st.integers(0, 40),
    ).map(lambda t: bytes((t[0],)) + t[1].to_bytes(2, "little") + bytes((t[2],)) + t[3].to_bytes(4, "little")),
    st.integers(0, 255).map(lambda command: bytes((command,)) + b"abcdefg"),
)


@settings(deadline=None, max_examples=200)
@given(st.lists(REQUESTS, max_size=40))
def test_no_client_breaks_the_server(requests: list[bytes]) -> None:
    bench = Bench()
    for request in requests:
        answers = bench.put(0x600 + NODE, request)
        assert all(cob_id == 0x580 + NODE and len(data) == 8 for cob_id, data in answers)
        assert len(answers) <= 127  # a block
        if len(answers) > 1:
            assert [data[0] & 0x7F for _, data in answers] == list(range(1, len(answers) + 1))
        assert all(len(value) <= 65536 for value in bench.dictionary.values.values() if isinstance(value, bytes))
    bench.sdo("8000000000000000")
    assert bench.sdo("4000100000000000") == "4300100092010200"
    for key, value in bench.dictionary.values.items():  # nothing that the tables forbid got in
        entry = bench.dictionary.entry(*key)
        assert entry.access in ("rw", "wo") or value == entry.default
        assert not entry.bits or entry.within(value)
