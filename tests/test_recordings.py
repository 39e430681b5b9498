"""Recordings from run records, tables and CAN logs: the same run by several roads, and input that is wrong."""

import gc
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from canopen.objectdictionary import ObjectDictionary
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lwa4d_sim.assembly import build_blocks
from lwa4d_sim.bus import frame_files
from lwa4d_sim.bus.build import write_sheets
from lwa4d_sim.bus.dictionary import MDEG_PER_RAD
from lwa4d_sim.bus.joints import joints_for
from lwa4d_sim.bus.sheet import load
from lwa4d_sim.errors import IdentificationError, LwaError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import joint_facts, load_model
from lwa4d_sim.record import RunLog
from lwa4d_sim.recordings.beats import even_beat
from lwa4d_sim.recordings.can_log import decode, load_sheets, plain, read_can_log
from lwa4d_sim.recordings.pdo_log import Frame, NodePdos, Pdo
from lwa4d_sim.recordings.reading import Reading, Units
from lwa4d_sim.recordings.recording import Recording
from lwa4d_sim.recordings.run_data import from_run
from lwa4d_sim.recordings.table_file import read_table, resolution
from lwa4d_sim.runner import run
from lwa4d_sim.scenario import Scenario

ARM = "lwa4d_3dof"
FACTS = joint_facts(load_model(ARM))
JOINTS = joints_for(ARM, FACTS)
PROFILES: Any = ("lwa4d", "cia402")
TICK = 10  # plant steps in a period
HELD = {"kind": "filtered_derivative", "time_constant": 0.01, "runs_on": "held"}
MILLIDEGREE = 1 / MDEG_PER_RAD


def scenario(loop: dict[str, Any], time: float = 0.7, kp: float = 20.0) -> Scenario:
    """A short motion of all three joints."""
    start = [-1.57, -1.57, 1.57]
    document = {
        "name": "short",
        "arm": ARM,
        "initial": {"q": start},
        "trajectory": {
            "waypoints": {"space": "joint", "points": [[-1.2, -1.9, 1.3]]},
            "segment_time": time,
            "profile": "quintic",
            "follow": "joint",
        },
        "controller": {"kind": "pd_gravity", "kp": kp, "kd": 3.0},
        "variants": {"only": {"loop": {"velocity": HELD, **loop}}},
    }
    return Scenario.parse(json.dumps(document))


def torque_at(recording: Recording, t: Array) -> Array:
    """Torque (len(t), n) that acts at some instants, NaN before the first."""
    columns = []
    for since, tau in zip(recording.since.T, recording.tau.T, strict=True):
        place = np.searchsorted(since, t + 1e-6, side="right") - 1
        columns.append(np.where(place >= 0, tau[place], np.nan))
    return np.array(columns).T


# -- run records -------------------------------------------------------------------------------------------------------


def test_the_plant_is_recorded_as_it_was() -> None:
    log = run(scenario({"latency": 0.003}, 0.5))
    recording = from_run(log, "plant")
    assert recording.joints == ("joint1", "joint2", "joint4")
    np.testing.assert_array_equal(recording.q, log.q)
    braked = np.isnan(recording.tau[:, 0])
    assert braked.sum() == 3, "until the first command has come, brakes hold the arm"
    np.testing.assert_array_equal(recording.tau[~braked], log.tau[~braked])
    assert recording.end == pytest.approx(0.5)
    assert not recording.position_step.any()
    assert not recording.remarks


LOOPS: dict[str, dict[str, Any]] = {
    "at once": {},
    "next sync": {"actuation": "next_sync", "latency": {"measurement": 0.0016, "command": 0.0024}},
    "slow": {"latency": {"measurement": 0.012, "command": 0.0034}},
    "skew": {"latency": {"measurement": [0.0, 0.012, 0.003], "command": [0.001, 0.004, 0.006]}, "phase": 0.004},
    "limits": {"actuation": "next_sync"},
    "steps": {"position_resolution": MILLIDEGREE, "torque_resolution": [0.01, 0.02, 0.05], "actuation": "next_sync"},
}


@pytest.mark.parametrize("name", LOOPS)
def test_what_the_controller_knew_is_what_the_arm_did(name: str) -> None:
    """Two roads: the recording from the controller's side against plant and ticks."""
    log = run(scenario(LOOPS[name], 0.5, kp=1000.0 if name == "limits" else 20.0))
    recording = from_run(log, "bus")
    assert (np.abs(log.ticks.tau[3:]) > log.tau_max).any() == (name == "limits")
    seen = ~np.isnan(recording.q)
    steps = np.rint(recording.t / 0.001).astype(int)
    true = log.q[np.clip(steps, 0, None), np.arange(3)]
    assert seen[2:].all()
    assert np.abs(recording.q - true)[seen].max() <= recording.position_step.max() / 2 + 1e-12
    np.testing.assert_allclose(recording.t.min(axis=1), log.ticks.t - np.nanmax(log.ticks.age), atol=1e-12)
    # joints whose sample is in time are, tick by tick, what the controller saw
    np.testing.assert_allclose(recording.q[2:], log.ticks.q[2:], atol=1e-12)
    tau = torque_at(recording, log.t[:-1])
    known = ~np.isnan(tau)
    assert known[40:].all()
    np.testing.assert_allclose(tau[known], log.tau[:-1][known], atol=1e-12)
    braked = np.isnan(from_run(log, "plant").tau[:-1])
    assert not known[braked].any()
    assert not recording.torque_step.any()
    assert not recording.remarks or "samples did not reach" in recording.remarks[0]


@pytest.mark.parametrize("per_joint", [False, True])
def test_samples_that_come_late_or_never_are_gaps_and_said(per_joint: bool) -> None:
    latency = {"kind": "uniform", "low": 0.0, "high": 0.012}
    loop = {"latency": {"measurement": latency}, "loss": 0.1, "per_joint": per_joint, "phase": 0.008}
    log = run(scenario(loop, 1.0))
    recording = from_run(log, "bus")
    assert any("lost or came at random" in remark for remark in recording.remarks)
    assert any("did not reach the controller" in remark for remark in recording.remarks)
    seen = ~np.isnan(recording.q).any(axis=1)
    assert 5 < seen.sum() < 100
    true = log.q[np.rint(recording.t[seen, 0] / 0.001).astype(int)]
    np.testing.assert_array_equal(recording.q[seen], true)
    heard = {tuple(row) for row in log.ticks.q.tolist()}
    assert all(tuple(row) in heard for row in recording.q[seen].tolist()), "only what the controller saw"
    assert (np.diff(recording.t, axis=0) > 0).all()


def test_a_filtering_estimator_does_not_change_the_samples() -> None:
    log = run(scenario({"velocity": {"kind": "kalman"}}, 0.5))
    recording = from_run(log, "bus")
    np.testing.assert_array_equal(recording.q, log.ticks.q_true)
    assert np.abs(recording.q - log.ticks.q).max() > 0


def test_a_record_without_a_bus_has_no_bus_signals() -> None:
    document = {**scenario({}, 0.3).document, "variants": {"only": {"loop": {"kind": "ideal"}}}}
    log = run(Scenario.parse(json.dumps(document)))
    assert len(from_run(log, "plant").t) == 301
    with pytest.raises(IdentificationError, match="ideal loop has no bus; valid signals: plant"):
        from_run(log, "bus")
    with pytest.raises(IdentificationError, match="has 3 joints, the arm 2"):
        from_run(log, "plant", FACTS[:2])
    with pytest.raises(IdentificationError, match="do not fit this version"):
        from_run(replace(log, scenario={"name": "short", "arm": ARM, "nonsense": 1}), "plant")


# -- tables ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def table() -> dict[str, Array]:
    """Columns of a run at 100 Hz, positions in whole millidegrees."""
    log = run(scenario({"position_resolution": MILLIDEGREE, "torque_resolution": 0.01}, 0.8))
    recording = from_run(log, "bus")
    columns = {"t": recording.t[:, 0]}
    columns |= {f"q{j + 1}": recording.q[:, j] for j in range(3)}
    return columns | {f"tau{j + 1}": recording.tau[:, j] for j in range(3)}


def write(columns: dict[str, Any], path: Path, form: str = "%.9g") -> Path:
    if path.suffix == ".parquet":
        pq.write_table(pa.table(columns), path)
    else:
        rows = np.column_stack(list(columns.values()))
        np.savetxt(path, rows, form, delimiter=",", header=",".join(columns), comments="")
    return path


@pytest.mark.parametrize("name", ["arm.csv", "arm.parquet"])
def test_a_table_is_read_as_it_stands(table: dict[str, Array], tmp_path: Path, name: str) -> None:
    recording = read_table(write({"room": table["t"], **table}, tmp_path / name, "%.17g"), FACTS)
    np.testing.assert_array_equal(recording.q, np.column_stack([table[f"q{j}"] for j in (1, 2, 3)]))
    np.testing.assert_array_equal(recording.tau, np.column_stack([table[f"tau{j}"] for j in (1, 2, 3)]))
    np.testing.assert_array_equal(recording.since, recording.t)
    np.testing.assert_allclose(recording.position_step, MILLIDEGREE, rtol=1e-3)
    np.testing.assert_allclose(recording.torque_step, 0.01, rtol=1e-3)
    assert recording.end == pytest.approx(0.8)
    assert recording.joints == tuple(name for name, *_ in FACTS)


@pytest.mark.parametrize(("angle", "factor"), [("deg", 180 / np.pi), ("mdeg", MDEG_PER_RAD)])
def test_units(table: dict[str, Array], tmp_path: Path, angle: Any, factor: float) -> None:
    plain_one = read_table(write(table, tmp_path / "si.csv"), FACTS)
    rated, constant = np.array([peak for *_, peak in FACTS]), np.array([8.0, 9.0, 10.0])
    for torque, scale in (("permil", 1000 / rated), ("mA", 1000 / constant)):
        changed = {name: column * factor if name[0] == "q" else column for name, column in table.items()}
        changed |= {f"tau{j + 1}": table[f"tau{j + 1}"] * scale[j] for j in range(3)}
        units = Units(angle=angle, torque=torque, constant=tuple(constant), delay=0.01)  # type: ignore[arg-type]
        recording = read_table(write(changed, tmp_path / "other.csv", "%.12g"), FACTS, units)
        np.testing.assert_allclose(recording.q, plain_one.q, atol=2e-9)
        np.testing.assert_allclose(recording.tau, plain_one.tau, atol=1e-7)
        np.testing.assert_allclose(recording.since, recording.t + 0.01)
        np.testing.assert_allclose(recording.position_step, MILLIDEGREE, rtol=1e-3)
        np.testing.assert_allclose(recording.torque_step, 0.01, rtol=1e-3)


def test_each_joint_may_have_stamps_of_its_own(table: dict[str, Array], tmp_path: Path) -> None:
    stamps = {f"t{j + 1}": 1.7e9 + table["t"] + 0.001 * j for j in range(3)}
    signals = {name: column for name, column in table.items() if name != "t"}
    recording = read_table(write({**signals, **stamps}, tmp_path / "arm.csv", "%.17g"), FACTS)
    np.testing.assert_allclose(recording.t, table["t"][:, None] + [0, 0.001, 0.002], atol=1e-6)
    np.testing.assert_array_equal(recording.since, recording.t)


def test_a_gap_is_said_and_no_torque_reaches_over_it(table: dict[str, Array], tmp_path: Path) -> None:
    holed = {name: np.delete(column, range(20, 32)) for name, column in table.items()}
    recording = read_table(write(holed, tmp_path / "arm.csv"), FACTS)
    assert recording.remarks == ("1 gaps of up to 0.13 s; nothing is known of them",)
    assert np.isnan(torque_at(recording, np.array([0.205, 0.25, 0.315]))).all()
    assert not np.isnan(torque_at(recording, np.array([0.195, 0.321]))).any()
    holed = {name: np.delete(column, range(20, 30)) for name, column in table.items()}
    holed["t"] = np.where(holed["t"] > 0.25, holed["t"] + 2.0, holed["t"])
    with pytest.raises(IdentificationError, match=r"2\.\d+ s of 2\.79 s are missing in gaps; more than half"):
        read_table(write(holed, tmp_path / "arm.csv"), FACTS)


def _set(name: str, row: int, value: float) -> Callable[[dict[str, Any]], None]:
    def change(columns: dict[str, Any]) -> None:
        columns[name][row] = value

    return change


def _scaled(names: str, factor: float) -> Callable[[dict[str, Any]], None]:
    def change(columns: dict[str, Any]) -> None:
        for name in columns:
            if name.startswith(names) and not (names == "t" and name != "t"):
                columns[name] *= factor

    return change


def _first(rows: int) -> Callable[[dict[str, Any]], None]:
    def change(columns: dict[str, Any]) -> None:
        for name in columns:
            columns[name] = columns[name][:rows]

    return change


def _still(columns: dict[str, Any]) -> None:
    columns["tau2"][:] = 3.0


WRONG: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "no q2": (lambda c: c.pop("q2"), "has no column q2; the header must have t,q1,q2,q3,tau1"),
    "no time": (lambda c: c.pop("t"), "has no column t;"),
    "more joints": (lambda c: c.update(q4=c["q3"]), "more than 3 joints"),
    "nan": (_set("q2", 7, np.nan), "q2 is nan; it must be a number"),
    "inf": (_set("tau3", 7, np.inf), "tau3 is inf; it must be a number"),
    "back": (_set("t", 7, 0.0), r"t \(=0 s\) must be later than in the row before \(=0.06 s\)"),
    "twice": (_set("t", 7, 0.06), r"t \(=0.06 s\) must be later than"),
    "degrees": (_scaled("q", 180 / np.pi), "looks like degrees; give units"),
    "too quick": (_scaled("t", 0.01), "looks like degrees; give units"),
    "milliseconds": (_scaled("t", 1000.0), "samples are 10 s apart, more than 0.5 s; time must be in seconds"),
    "constant": (_still, "the torque of .* is 3 N m throughout; it must change"),
    "short": (_first(20), "has 20 samples; at least 50 are needed"),
    "one row": (_first(1), "has 1 samples; at least 50 are needed"),
    "empty": (_first(0), "has 0 samples; at least 50 are needed"),
}


@pytest.mark.parametrize("form", ["csv", "parquet"])
@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_with_a_table_is_said_in_one_line(
    table: dict[str, Array], tmp_path: Path, name: str, form: str
) -> None:
    change, message = WRONG[name]
    columns: dict[str, Any] = {key: column.copy() for key, column in table.items()}
    change(columns)
    path = write(columns, tmp_path / f"arm.{form}")
    with pytest.raises(IdentificationError, match=message) as caught:
        read_table(path, FACTS)
    said = str(caught.value)
    assert said.startswith(str(path))
    assert "\n" not in said
    if name in ("nan", "inf", "back", "twice"):
        assert said.startswith(f"{path}:9:" if form == "csv" else f"{path}, row 8:")


def test_other_defects_of_files(table: dict[str, Array], tmp_path: Path) -> None:
    path = tmp_path / "arm.csv"
    good = write(table, path).read_text().splitlines()
    for line, text, message in (
        (5, "1,2,3", ":6: has 3 columns; the header has 7"),
        (5, good[5].replace(good[5].split(",")[3], "left", 1), ":6: q3 is 'left'; it must be a number"),
        (0, good[0].replace("tau3", "q3"), "has no column tau3"),
        (0, good[0] + ",q1", ":1: has the column q1 more than once"),
    ):
        path.write_text("\n".join([*good[:line], text, *good[line + 1 :]]))
        with pytest.raises(IdentificationError, match=re.escape(message)):
            read_table(path, FACTS)
    with pytest.raises(IdentificationError, match="cannot be read"):
        read_table(tmp_path / "absent.csv", FACTS)
    with pytest.raises(IdentificationError, match="cannot be read"):
        read_table(tmp_path / "absent.parquet", FACTS)
    with pytest.raises(IdentificationError, match="torque in mA needs constant"):
        read_table(path, FACTS, Units(torque="mA"))
    with pytest.raises(IdentificationError, match="permil needs rated with a number for each of 3 joints"):
        read_table(path, FACTS, Units(torque="permil", rated=(1.0,)))


@given(st.binary(max_size=400))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_garbage_is_no_table(tmp_path: Path, content: bytes) -> None:
    for name in ("x.csv", "x.parquet"):
        (tmp_path / name).write_bytes(b"t,q1,q2,q3,tau1,tau2,tau3\n" + content if name == "x.csv" else content)
        with pytest.raises(IdentificationError) as caught:
            read_table(tmp_path / name, FACTS)
        assert "\n" not in str(caught.value)


@given(
    st.floats(1e-6, 1.0),
    st.floats(-3.0, 3.0),
    st.lists(st.integers(-300, 300), min_size=20, max_size=200),
    st.sampled_from([None, 3]),
)
@settings(max_examples=60, deadline=None)
def test_the_resolution_of_a_quantised_signal_is_found(
    step: float, offset: float, counts: list[int], digits: int | None
) -> None:
    """Also when each value was rounded to a hundredth of the step in writing."""
    counts = [*counts, 0, 1]  # two neighbours, without which nobody can know
    values = offset + step * np.array(counts, float)
    if digits is not None:
        values = np.rint(values / (0.01 * step)) * 0.01 * step
    assert resolution(values) == pytest.approx(step, rel=1e-2)


def test_the_resolution_is_found_behind_rounded_numbers() -> None:
    """Millidegrees in radians with six decimals, and sums whose last bit differs, are still steps of a millidegree."""
    counts = np.concatenate([np.arange(-60, 60), np.arange(100, 3000, 37)])
    assert resolution(np.round(counts * MILLIDEGREE, 6)) == pytest.approx(MILLIDEGREE, rel=1e-3)
    twice = np.concatenate([counts * MILLIDEGREE + 0.3, counts * MILLIDEGREE + 0.1 + 0.2])
    assert len(np.unique(twice)) > len(counts)
    assert resolution(twice) == pytest.approx(MILLIDEGREE, rel=1e-6)


def test_a_smooth_signal_has_no_resolution() -> None:
    rng = np.random.default_rng(1)
    for size in (50, 500, 5000):
        assert resolution(rng.normal(size=size)) == 0.0
        assert resolution(np.sin(np.linspace(0, 7, size))) == 0.0
    assert resolution(np.zeros(9)) == 0.0


# -- CAN logs ----------------------------------------------------------------------------------------------------------


class Bus(NamedTuple):
    """A run over the bus, its frames as a log has them, and its drives' data sheets."""

    log: RunLog
    frames: list[Frame]
    sheets: dict[int, ObjectDictionary]
    paths: list[Path]


def bus_run(folder: Path, profile: str, **loop: Any) -> Bus:
    made = scenario({"kind": "canopen", "profile": profile, **loop})
    log = run(made)
    assert log.frames is not None
    paths = write_sheets(build_blocks([made], "only", 1), folder)
    frames = [plain(msg) for msg in frame_files.messages(log.frames)]
    return Bus(
        log, frames, {joint.node: load(path, joint.node) for joint, path in zip(JOINTS, paths, strict=True)}, paths
    )


@pytest.fixture(scope="module")
def buses(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Bus]:
    return {profile: bus_run(tmp_path_factory.mktemp(profile), profile) for profile in PROFILES}


def first_cycle(recording: Recording, log: RunLog) -> int:
    """The run's cycle with which a recording begins: the only one at which all positions fit."""
    reading = np.rint(log.q * MDEG_PER_RAD) / MDEG_PER_RAD
    known = ~np.isnan(recording.q)
    fits = []
    for k in range(len(reading) // TICK - len(recording.q) + 1):
        part = reading[TICK * k :: TICK][: len(recording.q)]
        if (np.abs(part - recording.q)[known] < 0.01 * MILLIDEGREE).all():
            fits.append(k)
    assert len(fits) == 1, "positions to the count, at one place only"
    return fits[0]


def same_as_run(recording: Recording, log: RunLog) -> None:
    """Positions to the count, torques at every plant step."""
    start = first_cycle(recording, log) * TICK
    np.testing.assert_allclose(recording.t, 0.01 * np.arange(len(recording.t))[:, None] + [0, 0, 0], atol=1e-7)
    end = round(recording.end / 0.001)
    steps = np.arange(end)
    tau = torque_at(recording, steps * 0.001)
    known = ~np.isnan(tau)
    np.testing.assert_allclose(tau[known], log.tau[start : start + end][known], atol=1e-9)


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("form", ["log", "asc", "blf"])
def test_a_log_tells_what_the_arm_did(buses: dict[str, Bus], tmp_path: Path, profile: Any, form: str) -> None:
    """Decoded from the file alone against the simulated plant: every position to the count, every torque exactly."""
    bus = buses[profile]
    assert bus.log.frames is not None
    path = tmp_path / f"bus.{form}"
    frame_files.write(bus.log.frames, path)
    torques: Any = ("command", "actual")
    for torque in torques:
        reading = Reading(profile=profile, torque=torque)
        recording = read_can_log(path, bus.paths, JOINTS, reading)
        same_as_run(recording, bus.log)
        assert len(recording.q) >= 64, "all but the first cycles of 70"
        assert not np.isnan(recording.q).any()
        assert not np.isnan(recording.tau).any()
        assert recording.joints == tuple(joint.name for joint in JOINTS)
        np.testing.assert_allclose(recording.position_step, MILLIDEGREE)
        assert (recording.torque_step > 0).all() == (torque == "actual")
        assert recording.period == pytest.approx(0.01, abs=1e-9)
        assert not any("set up" in remark for remark in recording.remarks)


@pytest.mark.parametrize("profile", PROFILES)
def test_a_record_over_the_bus_is_read_like_a_log(buses: dict[str, Bus], profile: Any) -> None:
    bus = buses[profile]
    recording = from_run(bus.log, "bus")
    from_log = decode(bus.frames, bus.sheets, JOINTS, "log", Reading(profile=profile))
    np.testing.assert_array_equal(recording.q, from_log.q)
    np.testing.assert_array_equal(recording.tau, from_log.tau)
    assert recording.source == "run short, only"
    with pytest.raises(IdentificationError, match="has no frames"):
        from_run(replace(bus.log, frames=None), "bus")


@pytest.mark.parametrize("profile", PROFILES)
def test_a_log_that_begins_in_the_middle_is_read_by_the_data_sheets(buses: dict[str, Bus], profile: Any) -> None:
    bus = buses[profile]
    late = [frame for frame in bus.frames if frame[0] >= frame_files.ORIGIN]
    # by its data sheet the firmware takes set-points when they come; this bus was set up otherwise
    actuation: Any = "next_sync" if profile == "lwa4d" else None
    recording = decode(late, bus.sheets, JOINTS, "log", Reading(profile=profile, actuation=actuation))
    same_as_run(recording, bus.log)
    assert any("does not show how all PDOs were set up" in remark for remark in recording.remarks)


def test_a_configuration_tells_what_a_data_sheet_does_not(buses: dict[str, Bus]) -> None:
    """In a DCF stands how the drives were set up, beside the defaults."""
    bus = buses["lwa4d"]
    late = [frame for frame in bus.frames if frame[0] >= frame_files.ORIGIN]
    old = "[1400sub2]\n"
    sheets = {
        j.node: _change_pdo(path, j.node, old, old + "ParameterValue=1\n")
        for j, path in zip(JOINTS, bus.paths, strict=True)
    }
    same_as_run(decode(late, sheets, JOINTS, "log"), bus.log)


@pytest.mark.parametrize("profile", PROFILES)
def test_commands_that_act_on_arrival_have_the_stamps_of_their_frames(tmp_path: Path, profile: Any) -> None:
    """Joint by joint the torque of the plant changes at the step nearest to the recorded instant."""
    bus = bus_run(tmp_path, profile, actuation="immediate")
    recording = decode(bus.frames, bus.sheets, JOINTS, "log", Reading(profile=profile))
    start = first_cycle(recording, bus.log) * TICK
    assert len({round(1e6 * (since - t)) for since, t in zip(recording.since[5], recording.t[5], strict=True)}) == 3
    for j in range(3):
        changes = np.flatnonzero(np.diff(bus.log.tau[start : start + TICK * len(recording.t), j])) + 1
        # a SYNC is received 94 us after its cycle began
        instants = np.rint((recording.since[:, j] + 94e-6) / 0.001).astype(int)
        assert set(changes.tolist()) <= set(instants.tolist())
        np.testing.assert_allclose(bus.log.tau[start + instants, j], recording.tau[:, j], atol=1e-9)


def test_without_sync_each_joint_has_the_stamps_of_its_frames(buses: dict[str, Bus]) -> None:
    """The firmware's set-points are event-driven by its data sheet; here its measurements are so too."""
    bus = buses["lwa4d"]
    frames = [frame for frame in bus.frames if frame[0] >= frame_files.ORIGIN and frame[1] != 0x080]
    first = "[1800sub2]\nParameterName=TPDO 1 transmission type\nObjectType=0x7\nDataType=0x0005\nAccessType=rw\n"
    old, new = f"{first}DefaultValue=1", f"{first}DefaultValue=254"
    sheets = {j.node: _change_pdo(path, j.node, old, new) for j, path in zip(JOINTS, bus.paths, strict=True)}
    recording = decode(frames, sheets, JOINTS, "log")
    start = first_cycle(recording, bus.log)
    for j, joint in enumerate(JOINTS):
        came = np.array([frame[0] for frame in frames if frame[1] == 0x180 + joint.node])
        sent = np.array([frame[0] for frame in frames if frame[1] == 0x200 + joint.node])
        origin = [frame[0] for frame in frames if frame[1] == 0x180 + JOINTS[0].node][start]
        np.testing.assert_allclose(recording.t[:, j], came[start:][: len(recording.t)] - origin, atol=1e-9)
        np.testing.assert_allclose(recording.since[:, j], sent[start:][: len(recording.t)] - origin, atol=1e-9)
    assert any("no PDO is synchronous" in remark for remark in recording.remarks)
    # each acts one cycle before the run let it, which had been set up to wait for SYNC
    steps = TICK * (start + 1 + np.arange(len(recording.t)))
    np.testing.assert_allclose(recording.tau, bus.log.tau[steps], atol=1e-9)


def cut(frames: list[Frame], first: float, last: float, what: Callable[[int], bool]) -> list[Frame]:
    """Frames without those of some identifiers between two instants of the run [s]."""
    a, b = first + frame_files.ORIGIN, last + frame_files.ORIGIN
    return [frame for frame in frames if not (a <= frame[0] < b and what(frame[1]))]


@pytest.mark.parametrize(
    ("what", "positions", "torques", "remark"),
    [
        # the logger slept for 4 cycles: 20 to 23; the command for 24 is missing too
        (lambda i: True, range(20, 24), range(20, 25), "4 SYNCs are missing"),
        (lambda i: i == 0x184, range(20, 24), (), ""),
        (lambda i: i == 0x204, (), (), "got no torque in 4 cycles"),
    ],
)
def test_frames_that_are_missing_are_gaps_and_nothing_else(
    buses: dict[str, Bus], what: Any, positions: Any, torques: Any, remark: str
) -> None:
    bus = buses["cia402"]
    whole = decode(bus.frames, bus.sheets, JOINTS, "log", Reading(profile="cia402"))
    start = first_cycle(whole, bus.log)
    recording = decode(cut(bus.frames, 0.2, 0.24, what), bus.sheets, JOINTS, "log", Reading(profile="cia402"))
    np.testing.assert_allclose(recording.t, whole.t, atol=1e-7)
    assert np.flatnonzero(np.isnan(recording.q[:, 1])).tolist() == [k - start for k in positions]
    assert np.flatnonzero(np.isnan(recording.tau[:, 1])).tolist() == [k - start for k in torques]
    known = ~np.isnan(recording.q)
    np.testing.assert_array_equal(recording.q[known], whole.q[known])
    assert any(remark in said for said in recording.remarks)
    same = recording.tau == whole.tau
    if remark.startswith("got no"):
        held = [k - start for k in range(21, 25)]
        assert (recording.tau[held, 1] == recording.tau[held[0] - 1, 1]).all(), "the one before holds"
        same[held] = True
    assert same[~np.isnan(recording.tau)].all()


def test_a_late_position_belongs_to_the_cycle_before(buses: dict[str, Bus]) -> None:
    bus = buses["cia402"]
    whole = decode(bus.frames, bus.sheets, JOINTS, "log", Reading(profile="cia402"))
    frames = list(bus.frames)
    mine = [k for k, frame in enumerate(frames) if frame[1] == 0x184 and frame[0] > 10.3]
    late = frames.pop(mine[0])
    place = next(k for k in range(mine[0], len(frames)) if frames[k][1] == 0x080) + 1
    frames.insert(place, (frames[place][0], *late[1:]))
    recording = decode(frames, bus.sheets, JOINTS, "log", Reading(profile="cia402"))
    np.testing.assert_array_equal(recording.q, whole.q)


def test_only_enabled_and_moving_cycles_count(buses: dict[str, Bus]) -> None:
    bus = buses["cia402"]
    whole = decode(bus.frames, bus.sheets, JOINTS, "log", Reading(profile="cia402"))
    begin = first_cycle(whole, bus.log)

    def changed(status: Callable[[float], bool], still: Callable[[float], bool]) -> list[Frame]:
        """Joint 2 is disabled and all stand at certain instants of the run [s]."""
        frames, held = [], dict[int, bytes]()
        for stamp, cob_id, data in bus.frames:
            t = stamp - frame_files.ORIGIN
            if t >= 0 and cob_id in (0x183, 0x184, 0x186):
                if still(t):
                    data = data[:4] + held.get(cob_id, data[4:])
                held[cob_id] = data[4:]
                if cob_id == 0x184 and status(t):
                    data = b"\x33" + data[1:]
            frames.append((stamp, cob_id, data))
        return frames

    def read(status: Callable[[float], bool], still: Callable[[float], bool]) -> Recording:
        return decode(changed(status, still), bus.sheets, JOINTS, "log", Reading(profile="cia402"))

    def never(t: float) -> bool:
        return False

    # from cycle 13 on; the last row is where all are known to be enabled to its end
    recording = read(lambda t: 0.1 < t < 0.13, never)
    np.testing.assert_array_equal(recording.q, whole.q[13 - begin :])
    assert any(remark.startswith("18 cycles at the beginning and 0 at the end") for remark in recording.remarks)
    recording = read(lambda t: t > 0.6, never)
    np.testing.assert_array_equal(recording.q, whole.q[: 59 - begin])
    # at rest up to cycle 9, and from cycle 65 on, where they arrive at their last position
    recording = read(never, lambda t: t < 0.1)
    np.testing.assert_array_equal(recording.q[1:], whole.q[10 - begin :])
    recording = read(never, lambda t: t > 0.651)
    assert recording.end == pytest.approx(0.01 * (66 - begin))
    assert any("no joint moves there" in remark for remark in recording.remarks)
    # what is between two words that were seen is enabled if both say so
    gone = cut(changed(lambda t: t > 0.6, never), 0.55, 0.6, lambda i: i == 0x184)
    recording = decode(gone, bus.sheets, JOINTS, "log", Reading(profile="cia402"))
    np.testing.assert_array_equal(recording.q, whole.q[: 54 - begin])
    paused = [(stamp + (5.0 if stamp > 10.0999 else 0.0), *rest) for stamp, *rest in bus.frames]
    recording = decode(paused, bus.sheets, JOINTS, "log", Reading(profile="cia402"))  # type: ignore[arg-type]
    np.testing.assert_array_equal(recording.q, whole.q[10 - begin :])
    with pytest.raises(IdentificationError, match="log: no joint moves while the drives are enabled"):
        read(never, lambda t: True)
    with pytest.raises(IdentificationError, match="enabled and moving in no more than 2 cycles"):
        read(lambda t: not 0.3 < t < 0.319, never)


def test_a_counter_that_wraps_is_unrolled(buses: dict[str, Bus]) -> None:
    bus = buses["cia402"]
    whole = decode(bus.frames, bus.sheets, JOINTS, "log", Reading(profile="cia402"))
    middle = round(float(whole.q[30, 1]) * MDEG_PER_RAD)

    def shifted(frame: Frame) -> Frame:
        if frame[1] != 0x184:
            return frame
        count = int.from_bytes(frame[2][4:8], "little", signed=True) - middle + 2**31
        return frame[0], frame[1], frame[2][:4] + (count % 2**32).to_bytes(4, "little")

    free = [replace(joint, low=None, high=None) for joint in JOINTS]
    recording = decode([shifted(f) for f in bus.frames], bus.sheets, free, "log", Reading(profile="cia402"))
    np.testing.assert_allclose(np.diff(recording.q[:, 1]), np.diff(whole.q[:, 1]), atol=1e-7)


def test_a_command_counts_as_the_drive_takes_it(buses: dict[str, Bus]) -> None:
    """No more than the peak torque; and in cyclic torque mode with the offset 60B2 added."""
    bus = buses["cia402"]
    whole = decode(bus.frames, bus.sheets, JOINTS, "log", Reading(profile="cia402"))
    count = JOINTS[1].torque / 1000

    def offset(frame: Frame, cob_id: int, place: int, value: int) -> Frame:
        if frame[1] != cob_id or frame[0] < frame_files.ORIGIN + 0.4:
            return frame
        data = frame[2][:place] + value.to_bytes(2, "little", signed=True) + frame[2][place + 2 :]
        return frame[0], frame[1], data

    # what is sent in cycle 40 acts in cycle 41
    late = np.arange(len(whole.tau)) + first_cycle(whole, bus.log) >= 41
    for change, there in (
        ((0x304, 4, -7), whole.tau[:, 1] - 7 * count),
        ((0x304, 4, 3000), JOINTS[1].torque),
        ((0x304, 4, -3000), -JOINTS[1].torque),
    ):
        frames = [offset(frame, *change) for frame in bus.frames]
        recording = decode(frames, bus.sheets, JOINTS, "log", Reading(profile="cia402"))
        np.testing.assert_allclose(recording.tau[:, 1], np.where(late, there, whole.tau[:, 1]), atol=1e-9)
        np.testing.assert_array_equal(recording.tau[:, 0], whole.tau[:, 0])


def test_only_confirmed_settings_count_and_only_until_the_next_start(buses: dict[str, Bus]) -> None:
    node = NodePdos(3, buses["lwa4d"].sheets[3])

    def torque_pdo() -> Pdo:
        return next(pdo for pdo in node.pdos() if (0x60B2, 0) in pdo.packing.keys)

    assert not torque_pdo().synchronous
    write = bytes([0x2F, 0x00, 0x14, 0x02, 1, 0xA5, 0xA5, 0xA5])  # 1400:2 = 1; the rest is not used
    confirmed, aborted = bytes([0x60, 0x00, 0x14, 0x02, 0, 0, 0, 0]), bytes([0x80, 0x00, 0x14, 0x02, 0, 0, 9, 6])
    other = bytes([0x60, 0x00, 0x14, 0x01, 0, 0, 0, 0])
    for answer in (aborted, other):
        assert not node.hear(0x603, write)
        assert not node.hear(0x583, answer)
        assert not node.hear(0x583, confirmed), "the answer to nothing"
        assert not torque_pdo().synchronous
    assert not node.changed
    node.hear(0x603, write)
    assert node.hear(0x583, confirmed)
    assert torque_pdo().synchronous
    assert node.changed
    assert not node.hear(0x703, b"\x05"), "a heartbeat"
    assert node.hear(0x703, b"\x00")
    assert not torque_pdo().synchronous
    node.hear(0x603, bytes([0x23, 0x00, 0x14, 0x01, 0x03, 0x02, 0, 0x80]))  # 1400:1 = 80000203: off
    assert node.hear(0x583, other)
    assert not any((0x60B2, 0) in pdo.packing.keys for pdo in node.pdos())


def test_jitter_of_the_stamps_is_taken_out_but_not_a_clock_that_wanders() -> None:
    rng = np.random.default_rng(3)
    true = 5.0 + 0.0100003 * np.arange(3000)
    jitter = rng.exponential(5e-5, 3000)
    late = np.where(rng.random(3000) < 0.01, rng.uniform(0, 9e-3, 3000), 0.0)
    late[1000:1005] = 0.04 - 0.01 * np.arange(5)  # the logger was busy for four periods
    missing = np.delete(np.arange(3000), [700, 701, 1500])
    beat = even_beat((true + jitter + late)[missing])
    assert beat.even
    np.testing.assert_array_equal(beat.count, missing)
    # half a mean of the jitter at most is left, the same for all
    assert np.abs(beat.t - true - np.mean(beat.t - true)).max() < 4e-6
    assert beat.worst == pytest.approx(0.04, rel=0.01)
    wandering = true + np.cumsum(rng.normal(0, 5e-5, 3000))
    beat = even_beat(wandering)
    assert not beat.even
    np.testing.assert_array_equal(beat.t, wandering)


def _without(sheet: ObjectDictionary, index: int) -> ObjectDictionary:
    thin = ObjectDictionary()  # type: ignore[no-untyped-call]
    for other in sheet:
        if other != index:
            thin.add_object(sheet[other])
    return thin


def _change_pdo(path: Path, node: int, old: str, new: str) -> ObjectDictionary:
    text = path.read_text()
    assert old in text
    other = path.with_name("other.eds")
    other.write_text(text.replace(old, new))
    return load(other, node)


def test_what_a_log_lacks_is_named(buses: dict[str, Bus]) -> None:
    bus = buses["lwa4d"]
    late = [frame for frame in bus.frames if frame[0] >= frame_files.ORIGIN]
    name = JOINTS[1].name

    def said(frames: list[Frame], sheets: Any = bus.sheets, joints: Any = JOINTS, reading: Any = None) -> str:
        with pytest.raises(IdentificationError) as caught:
            decode(frames, sheets, joints, "bus.log", reading or Reading())
        assert str(caught.value).startswith("bus.log: ")
        assert "\n" not in str(caught.value)
        return str(caught.value).removeprefix("bus.log: ")

    no_sync = [frame for frame in bus.frames if frame[1] != 0x080]
    assert said(no_sync) == "has no SYNC (frame 080), at which its synchronous PDOs are sampled and act"
    assert said([]) == f"node 3 ({JOINTS[0].name}): no TPDO1 (frame 183), which would carry 6064"
    silent = [frame for frame in bus.frames if frame[1] != 0x184]
    assert said(silent) == f"node 4 ({name}): no TPDO1 (frame 184), which would carry 6064"
    deaf = [frame for frame in bus.frames if frame[1] != 0x204]
    assert said(deaf) == f"node 4 ({name}): no RPDO1 (frame 204), which would carry 60B2"
    assert said(bus.frames, reading=Reading(profile="cia402")) == (
        f"node 3 ({JOINTS[0].name}): its data sheet has no object 6071"
    )
    assert said(bus.frames, {3: bus.sheets[3]}) == f"node 4 ({name}) has no data sheet; given: 3"
    thin = {**bus.sheets, 4: _without(bus.sheets[4], 0x6064)}
    assert said(bus.frames, thin) == f"node 4 ({name}): its data sheet has no object 6064"
    other = {**bus.sheets, 4: _change_pdo(bus.paths[1], 4, "=1617166368", "=1627193376")}
    assert said(late, other).startswith(f"node 4 ({name}): no TPDO carries 6064 by its data sheet")
    idle = [frame for frame in bus.frames if frame[0] < frame_files.ORIGIN + 0.005]
    assert said(idle) == "the drives were at no time all in operation enabled (statusword 6041)"
    short = [frame for frame in bus.frames if frame[0] < frame_files.ORIGIN + 0.3]
    assert "at least 50 are needed" in said(short)
    backwards = [*late[:100], late[50], *late[100:]]
    assert said(backwards).startswith("frame 101: time stamp 10.")
    assert "must not run backwards" in said(backwards)
    assert "looks like degrees" in said(bus.frames, reading=Reading(position_counts=(1000.0,) * 3))
    with pytest.raises(IdentificationError, match="torque_counts must be 3 numbers other than 0"):
        decode(bus.frames, bus.sheets, JOINTS, "bus.log", Reading(torque_counts=(1.0, 0.0, 1.0)))


def test_strangers_and_short_pdos_are_said(buses: dict[str, Bus]) -> None:
    bus = buses["lwa4d"]
    extra = [(10.3, 0x70B, b"\x05"), (10.4, 0x184, b"\x27")]
    frames = sorted([*bus.frames, *extra], key=lambda frame: frame[0])
    remarks = decode(frames, bus.sheets, JOINTS, "log").remarks
    assert any("node 11 has no data sheet" in remark for remark in remarks)
    assert any("1 PDOs were shorter" in remark for remark in remarks)


def test_data_sheets_are_given_their_nodes(buses: dict[str, Bus], tmp_path: Path) -> None:
    paths = buses["lwa4d"].paths
    assert sorted(load_sheets(paths, JOINTS)) == [3, 4, 6]
    records: Any = load_sheets(paths[:1], JOINTS)[6]
    assert records[0x1400][1].default == 0x206
    named = tmp_path / "named.dcf"
    named.write_text(paths[0].read_text() + "\n[DeviceComissioning]\nNodeID=4\n")
    assert sorted(load_sheets([named, paths[0]], JOINTS)) == [3, 4, 6]
    with pytest.raises(IdentificationError, match="one of 2 data sheets without a node id, for 3 drives"):
        load_sheets(paths[:2], JOINTS)
    with pytest.raises(LwaError, match="cannot read the data sheet"):
        load_sheets([tmp_path / "absent.eds"], JOINTS)


def refusal(read: Callable[[], Recording]) -> str | None:
    """What is said against some input, or None where a recording could be made of it; nothing else may be raised."""
    try:
        recording = read()
    except LwaError as error:
        return str(error)
    assert len(recording.q) >= 50
    return None


# python-can does not close a BLF file whose header it cannot read
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@given(st.binary(max_size=300), st.sampled_from(["log", "asc", "blf", "trc", "csv", "xyz"]))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_garbage_is_no_log(buses: dict[str, Bus], tmp_path: Path, content: bytes, form: str) -> None:
    path = tmp_path / f"garbage.{form}"
    path.write_bytes(content)
    with pytest.raises(LwaError) as caught:
        read_can_log(path, buses["lwa4d"].sheets, JOINTS)
    assert "\n" not in str(caught.value)
    if form == "blf":
        del caught
        gc.collect()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@given(st.data())
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_file_that_is_cut_or_spoilt_is_read_or_refused(buses: dict[str, Bus], tmp_path: Path, data: Any) -> None:
    form = data.draw(st.sampled_from(["log", "asc", "blf"]))
    whole = tmp_path / f"whole.{form}"
    log = buses["lwa4d"].log
    if not whole.exists():
        assert log.frames is not None
        frame_files.write(log.frames, whole)
    content = bytearray(whole.read_bytes())
    for _ in range(data.draw(st.integers(0, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / f"spoilt.{form}"
    path.write_bytes(content[: data.draw(st.integers(1, len(content)))])
    said = refusal(lambda: read_can_log(path, buses["lwa4d"].sheets, JOINTS))
    assert said is None or "\n" not in said
    if form == "blf":
        gc.collect()


frame_bytes = st.tuples(
    st.sampled_from([0x080, 0x183, 0x184, 0x186, 0x203, 0x603, 0x583, 0x703, 0x000]), st.binary(max_size=8)
)


@given(st.lists(st.tuples(st.integers(0, 2000), frame_bytes), max_size=30))
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_frames_among_the_others_are_read_or_refused(
    buses: dict[str, Bus], extra: list[tuple[int, tuple[int, bytes]]]
) -> None:
    bus = buses["lwa4d"]
    frames = list(bus.frames)
    for place, (cob_id, content) in extra:
        frames.insert(place, (frames[min(place, len(frames) - 1)][0], cob_id, content))
    said = refusal(lambda: decode(frames, bus.sheets, JOINTS, "log"))
    assert said is None or "\n" not in said
