"""Records on disk: what is written is read back, the page describes it, no half file takes a good one's place."""

import dataclasses
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from lwa4d_sim import RunLog, Scenario, run
from lwa4d_sim.errors import RecordError

PAGE = Path(__file__).parent.parent / "docs" / "record.md"

TEXT = """\
name: näme
arm: lwa4d_3dof
trajectory:
  waypoints: {space: joint, points: [[0.2, -1.3, 1.3], [0, -1.5, 1.5]]}
  segment_time: 0.15
controller: {kind: pd_gravity, kp: 200, kd: 60}
loop: {latency: {measurement: 0.025, command: 0.003}, phase: 0.0, loss: 0.2}
plant: {seed: 3}
variants: {can: {}, ideal: {loop: {kind: ideal}}, wild: {plant: {disturbances: [{at: 0.1, force: [1e+8, 0, 0]}]}}}
"""


@pytest.fixture(scope="module")
def logs() -> dict[str, RunLog]:
    scenario = Scenario.parse(TEXT)
    return {name: run(scenario, name) for name in scenario.variants}


@pytest.fixture(params=["can", "ideal", "wild"])
def log(request: pytest.FixtureRequest, logs: dict[str, RunLog]) -> RunLog:
    return logs[request.param]


def contents(file: Any) -> dict[str, Any]:
    """Every dataset by path."""
    found: dict[str, Any] = {}
    file.visititems(lambda name, item: found.__setitem__(f"/{name}", item) if isinstance(item, h5py.Dataset) else None)
    return found


def arrays(log: RunLog) -> Iterator[tuple[str, Any]]:
    """Every array of a log, by name."""
    yield from ((name, getattr(log, name)) for name in ("t", "q", "dq", "tau", "x", "x_ref", "knots", "tau_max"))
    yield from ((field.name, getattr(log.ticks, field.name)) for field in dataclasses.fields(log.ticks))


def test_the_runs_of_this_file_are_of_all_kinds(logs: dict[str, RunLog]) -> None:
    assert logs["wild"].diverged_at is not None
    assert np.isnan(logs["can"].ticks.q[0]).all()  # nothing heard yet
    assert [text for _, text in logs["can"].events] == ["brakes closed", "brakes released"]
    assert logs["wild"].events[-1][1] == "diverged"


def test_what_is_written_is_read_back(log: RunLog, tmp_path: Path) -> None:
    log.save(tmp_path / "x.h5")
    back = RunLog.load(tmp_path / "x.h5")
    for (name, old), (_, new) in zip(arrays(log), arrays(back), strict=True):
        np.testing.assert_array_equal(new, old, err_msg=name)
    for name in ("name", "variant", "timestep", "period", "seed", "diverged_at", "events", "scenario", "versions"):
        assert getattr(back, name) == getattr(log, name)
    assert back.metrics() == log.metrics()
    json.dumps(back.metrics(), allow_nan=False)


def test_writing_what_was_read_gives_the_same_file(log: RunLog, tmp_path: Path) -> None:
    log.save(tmp_path / "a.h5")
    RunLog.load(tmp_path / "a.h5").save(tmp_path / "b.h5")
    with h5py.File(tmp_path / "a.h5") as a, h5py.File(tmp_path / "b.h5") as b:
        one, other = contents(a), contents(b)
        assert one.keys() == other.keys()
        for path, dataset in one.items():
            np.testing.assert_array_equal(other[path][()], dataset[()], err_msg=path)
            assert dict(other[path].attrs) == dict(dataset.attrs)
        assert dict(a.attrs) == dict(b.attrs)


def test_the_same_run_gives_the_same_bytes(logs: dict[str, RunLog], tmp_path: Path) -> None:
    logs["can"].save(tmp_path / "a.h5")
    run(Scenario.parse(TEXT), "can").save(tmp_path / "b.h5")
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_the_clocks_fit_together(log: RunLog) -> None:
    assert len(log.t) == len(log.q) == len(log.dq) == len(log.tau) == len(log.x) == len(log.x_ref)
    np.testing.assert_array_equal(log.t, np.arange(len(log.t)) * 1e-3)
    at = np.rint(log.ticks.t / 1e-3).astype(int)
    np.testing.assert_array_equal(log.ticks.q_true, log.q[at])
    np.testing.assert_array_equal(log.ticks.dq_true, log.dq[at])


def page_rows() -> list[list[str]]:
    """The cells of every table row on the page."""
    rows = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| `/")]
    return [[cell.strip().strip("`") for cell in row.strip("|").split("|")] for row in rows]


def test_the_page_lists_every_dataset_with_its_shape_and_unit(log: RunLog, tmp_path: Path) -> None:
    log.save(tmp_path / "x.h5")
    sizes = {"T": len(log.q), "K": len(log.ticks.t), "n": 3, "3": 3, "S": 2, "E": len(log.events)}
    with h5py.File(tmp_path / "x.h5") as file:
        found = contents(file)
        told = {row[0]: row[1:] for row in page_rows() if row[0] in found}
        assert told.keys() == found.keys()
        for path, dataset in found.items():
            shape, unit, _ = told[path]
            assert dataset.shape == (() if shape == "-" else tuple(sizes[axis] for axis in shape.split(" x "))), path
            assert dataset.attrs.get("unit", "-") == unit, path
            assert dataset.dtype == np.float64 or unit == "-"


def test_the_page_lists_nothing_that_does_not_exist_and_every_attribute(
    logs: dict[str, RunLog], tmp_path: Path
) -> None:
    logs["wild"].save(tmp_path / "x.h5")
    with h5py.File(tmp_path / "x.h5") as file:
        # of frames, which only a run over a bus has: tests/test_bus_loop.py
        assert {row[0] for row in page_rows() if "/frames/" not in row[0]} == contents(file).keys() | {"/"}
        assert {row[1] for row in page_rows() if row[0] == "/"} == set(file.attrs)
        assert [file[group].attrs.keys() - {"unit"} for group in file] == [set()] * 4


def test_the_python_of_the_page_runs(logs: dict[str, RunLog], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    logs["can"].save(Path("can.h5"))
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    assert len(blocks) == 2
    for block in blocks:
        names: dict[str, Any] = {}
        exec(block, names)
    assert names["log"].variant == "can"


def test_matlab_names_on_the_page_exist(logs: dict[str, RunLog], tmp_path: Path) -> None:
    logs["can"].save(tmp_path / "can.h5")
    with h5py.File(tmp_path / "can.h5") as file:
        for path in re.findall(r"h5read\('can.h5', '([^']+)'", PAGE.read_text(encoding="utf-8")):
            assert path in file
        for path, attribute in re.findall(
            r"h5readatt\('can.h5', '([^']+)', '([^']+)'", PAGE.read_text(encoding="utf-8")
        ):
            assert attribute in file[path].attrs


def test_a_scenario_of_any_length_fits(logs: dict[str, RunLog], tmp_path: Path) -> None:
    long = dataclasses.replace(logs["can"], scenario={"points": [[0.123456789, i] for i in range(20_000)]})
    long.save(tmp_path / "x.h5")
    assert RunLog.load(tmp_path / "x.h5").scenario == long.scenario


def test_a_record_replaces_an_older_one(logs: dict[str, RunLog], tmp_path: Path) -> None:
    path = tmp_path / "x.h5"
    logs["ideal"].save(path)
    logs["can"].save(path)
    assert RunLog.load(path).variant == "can"
    assert [entry.name for entry in tmp_path.iterdir()] == ["x.h5"]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), RuntimeError("Unable to flush file")])
def test_a_failure_in_the_middle_leaves_the_older_record_whole(
    error: Exception, logs: dict[str, RunLog], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "x.h5"
    logs["ideal"].save(path)
    before = path.read_bytes()
    write, left = h5py.Group.create_dataset, [9]

    def full(self: Any, *args: Any, **kwargs: Any) -> Any:
        left[0] -= 1
        if left[0] < 0:
            raise error
        return write(self, *args, **kwargs)

    monkeypatch.setattr(h5py.Group, "create_dataset", full)
    with pytest.raises(RecordError, match=r"x\.h5: cannot write the record"):
        logs["can"].save(path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["x.h5"]


@pytest.mark.parametrize("place", ["missing/x.h5", "file/x.h5", "x" * 300 + ".h5"])
def test_a_place_that_cannot_be_written_is_named(place: str, logs: dict[str, RunLog], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("here")
    with pytest.raises(RecordError, match="cannot write the record"):
        logs["can"].save(tmp_path / place)
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


def foreign(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["x"] = 1.0


def other_format(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file.attrs["format"] = 99


def without(part: str) -> Any:
    def remove(path: Path) -> None:
        with h5py.File(path, "a") as file:
            del file[part]

    return remove


def with_number(part: str) -> Any:
    def replace(path: Path) -> None:
        with h5py.File(path, "a") as file:
            del file[part]
            file[part] = 1.0

    return replace


def no_json(path: Path) -> None:
    with h5py.File(path, "a") as file:
        del file["parameters/scenario"]
        file["parameters"].create_dataset("scenario", data="{", dtype=h5py.string_dtype())


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda path: path.unlink(), "No such file"),
        (lambda path: (path.unlink(), path.mkdir()), "x.h5"),
        (lambda path: path.write_bytes(b""), "x.h5"),
        (lambda path: path.write_text("name: x"), "signature not found"),
        (lambda path: path.write_bytes(path.read_bytes()[:5000]), "truncated"),
        (lambda path: path.write_bytes(path.read_bytes()[:600] + 400 * b"\xff" + path.read_bytes()[1000:]), "x.h5"),
        (foreign, "format None, this version reads 1"),
        (other_format, "format 99, this version reads 1"),
        (without("plant"), "plant"),
        (without("ticks/age"), "age"),
        (without("events/text"), "text"),
        (with_number("plant"), "x.h5"),
        (with_number("plant/q"), "x.h5"),
        (with_number("parameters/scenario"), "x.h5"),
        (with_number("events/text"), "x.h5"),
        (no_json, "x.h5"),
    ],
)
def test_a_file_that_is_no_record_is_refused(spoil: Any, words: str, logs: dict[str, RunLog], tmp_path: Path) -> None:
    path = tmp_path / "x.h5"
    logs["can"].save(path)
    spoil(path)
    with pytest.raises(RecordError) as error:
        RunLog.load(path)
    assert str(error.value).startswith(f"{path}: not a readable run record")
    assert words in str(error.value)


def test_a_full_disk_is_an_error_and_no_crash(tmp_path: Path) -> None:
    """A limit on the size of files stands for the disk; HDF5 itself would end the process with a signal."""
    code = (
        "import resource, sys; from pathlib import Path; from lwa4d_sim import RunLog; from lwa4d_sim.errors import *\n"
        "log = RunLog.load(Path('whole.h5')); resource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))\n"
        "try: log.save(Path('small.h5'))\n"
        "except RecordError as error: print(error)\n"
    )
    log = run(Scenario.parse(TEXT), "ideal")
    log.save(tmp_path / "whole.h5")
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert re.fullmatch(r"small\.h5: cannot write the record \(.*File too large\)\n", done.stdout)
    assert [path.name for path in tmp_path.iterdir()] == ["whole.h5"]
