"""SocketCAN for real: processes that meet on the interface vcan0 of a Linux kernel booted under QEMU."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

VCAN = Path(__file__).parent.parent / "scripts" / "vcan"
NOT_TO_BE_HAD = 77  # exit code of scripts/vcan where QEMU or the kernel cannot be had

# The guest's clock skips idle time, and to wait for a file of the host is idle time: a second of importing may take the
# guest a minute. Hence the long time-outs, which cost nothing when they do run out, and some cycles to warm up.
WAIT = 1000  # [s of the guest]
WARM_UP = 10
ANSWER = """
import pathlib, sys, can
with can.Bus(interface="socketcan", channel="vcan0", can_filters=[{"can_id": 0x080, "can_mask": 0x7FF}]) as bus:
    pathlib.Path(sys.argv[1]).touch()
    for _ in range(int(sys.argv[2])):
        sync = bus.recv(timeout=float(sys.argv[3]))
        bus.send(can.Message(arbitration_id=0x183, is_extended_id=False, data=bytes(reversed(sync.data))))
"""
ASK = """
import sys, time, can
with can.Bus(interface="socketcan", channel="vcan0") as bus:
    start = time.monotonic()
    for k in range(int(sys.argv[1])):
        time.sleep(max(0.0, start + 0.01 * (k + 1) - time.monotonic()))
        bus.send(can.Message(arbitration_id=0x080, is_extended_id=False, data=[k, 0xFF]))
        answer = bus.recv(timeout=float(sys.argv[2]))
        assert (answer.arbitration_id, list(answer.data)) == (0x183, [0xFF, k]), answer
"""
GUEST = """
set -eu
candump -L vcan0 >$TMPDIR/frames.log & LOG=$!
{python} {out}/answer.py $TMPDIR/ready {cycles} {wait} & ANSWER=$!
until [ -e $TMPDIR/ready ]; do sleep 0.1; done
{python} {out}/ask.py {cycles} {wait}
wait $ANSWER
sleep 0.1; kill $LOG
cp $TMPDIR/frames.log {out}
"""


def in_guest(out: Path, script: str) -> subprocess.CompletedProcess[str]:
    """Run a shell script in the guest, its output folder ``out``; skip the test where there can be no guest."""
    (out / "guest.sh").write_text(script)
    done = subprocess.run([VCAN, out, "bash", out / "guest.sh"], capture_output=True, text=True)
    if done.returncode == NOT_TO_BE_HAD:
        pytest.skip(done.stderr.splitlines()[-1])
    return done


@pytest.mark.slow
def test_two_processes_meet_on_vcan0_in_a_regular_cycle(tmp_path: Path) -> None:
    cycles = 100
    (tmp_path / "ask.py").write_text(ASK)
    (tmp_path / "answer.py").write_text(ANSWER)
    done = in_guest(tmp_path, GUEST.format(python=sys.executable, out=tmp_path, cycles=cycles, wait=WAIT))
    assert done.returncode == 0, done.stdout + done.stderr
    log = (tmp_path / "frames.log").read_text()
    frames = re.findall(r"^\((\d+)\.(\d{6})\) vcan0 (\w+)#(\w+)$", log, re.MULTILINE)
    assert len(frames) == len(log.splitlines())
    expected = [frame for k in range(cycles) for frame in (("080", f"{k:02X}FF"), ("183", f"FF{k:02X}"))]
    assert [(name, data) for _, _, name, data in frames] == expected
    times = [int(seconds) * 10**6 + int(micros) for seconds, micros, _, _ in frames]  # [us]
    syncs, answers = times[2 * WARM_UP :: 2], times[2 * WARM_UP + 1 :: 2]
    # Bounds of a machine of its own: no 10 ms cycle of Python is that regular on a shared one.
    assert all(abs(later - sooner - 10_000) < 500 for sooner, later in zip(syncs, syncs[1:], strict=False))
    assert all(answer - sync < 2_000 for sync, answer in zip(syncs, answers, strict=True))


@pytest.mark.slow
def test_the_guest_has_the_libraries_the_exit_code_and_no_way_to_write_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "out dir").mkdir()
    script = f"""
        {sys.executable} -c 'import mujoco, can, canopen, lwa4d_sim.runner; print("libraries")'
        touch {tmp_path}/elsewhere 2>/dev/null && echo written
        ip -br link show vcan0
        exit 7
    """
    done = in_guest(tmp_path / "out dir", script)
    assert done.returncode == 7, done.stdout + done.stderr
    assert re.fullmatch(r"libraries\nvcan0 .*UP.*\n", done.stdout), done.stdout
    assert not (tmp_path / "elsewhere").exists()
