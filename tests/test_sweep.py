"""A sweep's table is the same however it came about, and nothing that was finished is lost."""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sweep_rig import AXES, Here, finish, load, rows, write

from lwa4d_sim.errors import RecordError, ScenarioError, SweepError
from lwa4d_sim.lockstep import group
from lwa4d_sim.metrics import METRICS
from lwa4d_sim.runner import run
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.sweep import tasks as sweep_run
from lwa4d_sim.sweep.folder import spell

RUNS = 24  # of the axes in sweep_rig


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, bytes]:
    """The sweep file, and the bytes of its table as one worker makes it."""
    folder = tmp_path_factory.mktemp("reference")
    path = write(folder)
    return path, finish(path, folder / "out").table.read_bytes()


def test_the_table_has_a_row_a_run_and_says_what_was_varied(reference: tuple[Path, bytes]) -> None:
    path, _ = reference
    table = pq.ParquetFile(path.parent / "out" / "s" / "runs.parquet").read()
    names = table.column_names
    assert names[:6] == ["run", "p", "loop.latency", "plant.payload.mass", "controller.kp", "controller.kd"]
    assert names[-2:] == ["status", "message"]
    metrics = names[6:-2]
    assert {"stable", "max_error", "final_error_1", "final_error_2", "peak_torque_3"} <= set(metrics)
    order = [list(METRICS).index(name if name in METRICS else name.rpartition("_")[0]) for name in metrics]
    assert order == sorted(order)
    assert table["run"].to_pylist() == list(range(RUNS))
    assert table["controller.kd"].to_pylist() == [p / 4 for p in table["p"].to_pylist()]
    assert set(table["status"].to_pylist()) == {"ok"}
    assert str(table.schema.field("stable").type) == "bool"


@pytest.mark.parametrize("number", [0, 5, 23])
def test_a_row_holds_the_metrics_of_the_same_run_alone(number: int, reference: tuple[Path, bytes]) -> None:
    path, _ = reference
    row = pq.ParquetFile(path.parent / "out" / "s" / "runs.parquet").read().to_pylist()[number]
    keys = ("controller.kp", "controller.kd", "loop.latency", "plant.payload.mass")
    alone = run(Scenario.load(path.parent / "small.yaml", {key: row[key] for key in keys}), "can").metrics()
    for name, value in alone.items():
        if isinstance(value, list):
            assert [row[f"{name}_{k}"] for k in range(1, len(value) + 1)] == value
        else:
            assert row[name] == value


@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(size=st.integers(1, 9), stop=st.integers(0, 6), together=st.integers(1, 10))
def test_any_number_of_workers_any_chunks_any_interruption(
    size: int, stop: int, together: int, reference: tuple[Path, bytes], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path, expected = reference
    out = tmp_path_factory.mktemp("out")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweep_run, "MOST_TOGETHER", together)
        first = Here(size, stop=stop)
        try:
            finish(path, out, first)
        except KeyboardInterrupt:
            assert not (out / "s" / "runs.parquet").exists()
    second = Here(3)
    assert finish(path, out, second).table.read_bytes() == expected
    done = [run for task in first.tasks + second.tasks for run in task]
    assert sorted(done) == list(range(RUNS))  # no run was made twice


def test_runs_are_grouped_by_what_can_be_stepped_together(tmp_path: Path) -> None:
    axes = {
        "loop.period": {"values": [0.01, 0.005]},
        "loop.actuation": {"values": ["immediate", "next_sync"]},
        "loop.latency": {"values": [0.003, 0, {"kind": "uniform", "high": 0.01}]},
        "plant.payload.mass": {"values": [1, 2]},
    }
    sweep = load(write(tmp_path, axes=axes))
    parts = sweep_run.groups(sweep, sweep.points())
    assert [len(part) for part in parts] == [6, 6, 6, 6]
    for part in parts:
        assert len({(p.values["loop.period"], p.values["loop.actuation"]) for p in part}) == 1
    first = [str(point.values["loop.latency"]) for point in parts[0]]
    assert first[:4] == ["0", "0", "0.003", "0.003"]  # equal latencies are neighbours
    table = rows(finish(tmp_path / "sweep.yaml", tmp_path / "out"))
    assert [row["status"] for row in table] == ["ok"] * 24
    assert json.loads(table[4]["loop.latency"]) == {"kind": "uniform", "high": 0.01}
    alone = sweep.check_point(next(iter(sweep.points(1)))).variants["can"]
    assert group(alone, 0) == group(alone, 1)


def test_canopen_runs_go_alone(tmp_path: Path) -> None:
    path = write(tmp_path, {"variants": {"bus": {"loop": {"kind": "canopen"}}}}, axes={"p": AXES["p"]})
    here = Here()
    table = rows(finish(path, tmp_path / "out", here))
    assert [len(task) for task in here.tasks] == [1, 1, 1, 1]
    assert [row["status"] for row in table] == ["ok"] * 4


def test_seeds_repeat_every_point(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        {"plant": {"seed": 7}, "loop": {"jitter": 0.02}},
        seeds=3,
        axes={"p": {"values": [10, 20], "keys": {"controller.kp": 1}}},
    )
    table = rows(finish(path, tmp_path / "out"))
    assert [(row["p"], row["plant.seed"]) for row in table] == [(p, s) for p in (10, 20) for s in (7, 8, 9)]
    assert len({row["rms_error"] for row in table}) == 6


def test_a_run_that_diverges_is_a_row(tmp_path: Path) -> None:
    push = {"plant": {"disturbances": [{"at": 0.02, "force": [0, 0, 0], "torque": [1e8, 0, 0]}]}}
    table = rows(finish(write(tmp_path, push, axes={"p": AXES["p"]}), tmp_path / "out"))
    assert [row["stable"] for row in table] == [False] * 4
    assert all(row["diverged_at"] < 0.1 and row["status"] == "ok" for row in table)
    assert all(row["final_error_2"] is None for row in table)


def test_a_point_that_cannot_be_built_is_an_error_row_and_spoils_no_other(tmp_path: Path) -> None:
    points = [[-1.4, -1.1, 1.6], [0.0], [-1.3, -1.1, 1.6]]
    path = write(tmp_path, axes={"trajectory.waypoints.points": {"values": [[point] for point in points]}})
    folder = finish(path, tmp_path / "out")
    table = rows(folder)
    assert [row["status"] for row in table] == ["ok", "error", "ok"]
    assert table[1]["stable"] is None
    assert "needs 3" in table[1]["message"] or "3" in table[1]["message"]
    assert table[1]["message"].isprintable()
    again = Here()
    assert rows(finish(path, tmp_path / "out", again)) == table
    assert again.tasks == [[1]]  # what failed is tried again, and nothing else


LAW = """
import os
class Law:
    def __init__(self, kp, how):
        self.kp, self.how = kp, how
    def torque(self, state, ref, model):
        if self.how == "raise":
            raise ZeroDivisionError("my\\nfault")
        if self.how == "die":
            os._exit(9)
        return self.kp * (ref.q - state.q) - state.dq + model.at(state.q).h
"""


def test_a_law_that_raises_spoils_only_its_own_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "laws_of_sweep.py").write_text(LAW)
    monkeypatch.syspath_prepend(tmp_path)
    own = {"controller": {"kind": "laws_of_sweep:Law", "kp": 10.0, "how": ""}}
    path = write(tmp_path, own, axes={"controller.how": {"values": ["", "raise"]}, "controller.kp": {"values": [5, 9]}})
    table = rows(finish(path, tmp_path / "out"))
    assert [row["status"] for row in table] == ["ok", "ok", "error", "error"]
    assert "raised ZeroDivisionError: my\\nfault (laws_of_sweep.py, line " in table[2]["message"]


@pytest.mark.parametrize("deaths", [1, 2])
def test_a_task_whose_worker_dies_is_tried_again(deaths: int, reference: tuple[Path, bytes], tmp_path: Path) -> None:
    path, expected = reference
    here = Here(2, deaths={5: deaths, 20: deaths})
    assert finish(path, tmp_path, here).table.read_bytes() == expected


def test_a_run_that_always_kills_its_worker_is_given_up_alone(reference: tuple[Path, bytes], tmp_path: Path) -> None:
    path, _ = reference
    here = Here(2, deaths={13: 99})
    table = rows(finish(path, tmp_path, here))
    assert [row["run"] for row in table if row["status"] == "error"] == [13]
    assert table[13]["message"] == "the process that ran it was killed 3 times; is there enough memory?"
    assert sum(13 in task for task in here.tasks) == 3


def test_another_sweep_in_the_folder_is_refused_and_thrown_away_when_asked(tmp_path: Path) -> None:
    finish(write(tmp_path, axes={"p": AXES["p"]}), tmp_path / "out")
    other = write(tmp_path, axes={"p": {**AXES["p"], "count": 2}})
    with pytest.raises(SweepError, match="holds another sweep; throw it away with --fresh"):
        finish(other, tmp_path / "out")
    assert len(rows(finish(other, tmp_path / "out", fresh=True))) == 2
    (tmp_path / "small.yaml").write_text((tmp_path / "small.yaml").read_text().replace("5.0", "6.0"))
    with pytest.raises(SweepError, match="--fresh"):  # the scenario counts as well
        finish(other, tmp_path / "out")


def test_a_folder_that_a_full_disk_left_empty_is_taken(tmp_path: Path) -> None:
    path = write(tmp_path, axes={"p": AXES["p"]})
    (tmp_path / "out" / "s" / "parts").mkdir(parents=True)
    (tmp_path / "out" / "s" / "sweep.yaml").write_text("half")
    assert len(rows(finish(path, tmp_path / "out"))) == 4
    (tmp_path / "out" / "s" / "sweep.json").unlink()
    with pytest.raises(SweepError, match="holds another sweep"):  # nobody knows of what its parts are
        finish(path, tmp_path / "out")


def test_a_folder_begun_with_other_software_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, axes={"p": AXES["p"]})
    about = finish(path, tmp_path / "out").path / "sweep.json"
    about.write_text(about.read_text().replace('"mujoco": "', '"mujoco": "0.'))
    with pytest.raises(SweepError, match=r"begun with mujoco 0\..*, this is .*--fresh"):
        finish(path, tmp_path / "out")


def test_a_folder_with_something_else_in_it_is_left_alone(tmp_path: Path) -> None:
    path = write(tmp_path)
    (tmp_path / "out" / "s").mkdir(parents=True)
    (tmp_path / "out" / "s" / "thesis.txt").write_text("years of work")
    for fresh in (False, True):
        with pytest.raises(SweepError, match=r"holds 'thesis\.txt', which no sweep wrote"):
            finish(path, tmp_path / "out", fresh=fresh)


def test_too_many_runs_are_refused_with_what_they_would_cost(tmp_path: Path) -> None:
    axes = {**AXES, "plant.seed": {"from": 1, "to": 1_000_000, "count": 1_000_000}}
    del axes["p"]
    axes["plant.seed"] = {"values": list(range(1000))}
    axes["controller.kp"] = {"from": 1, "to": 2, "count": 1_000_000}
    path = write(tmp_path, axes=axes)
    with pytest.raises(SweepError) as error:
        finish(path, tmp_path / "out")
    assert "6,000,000,000 runs are more than the limit of 20,000; they take about " in str(error.value)
    assert str(error.value).endswith(" on 1 process; raise it with --limit")
    assert not (tmp_path / "out").exists()
    with pytest.raises(SweepError, match="24 runs are more than the limit of 23"):
        finish(write(tmp_path), tmp_path / "out", limit=23)
    assert len(rows(finish(write(tmp_path), tmp_path / "out", limit=24))) == 24


@pytest.mark.parametrize(
    ("seconds", "words"), [(0.01, "1 s"), (59, "59 s"), (170, "2.8 min"), (32_400, "9.0 h"), (2e6, "23 days")]
)
def test_durations_in_words(seconds: float, words: str) -> None:
    assert spell(seconds) == words


FULL = """
import resource, signal, sys
limit, path, out, *sys.path = sys.argv[1:]
from pathlib import Path
from sweep_rig import finish
from lwa4d_sim.errors import RecordError
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(limit), int(limit)))
try:
    finish(Path(path), Path(out))
except RecordError as error:
    print(error)
"""


def test_a_full_disk_leaves_nothing_half_written(tmp_path: Path) -> None:
    """A limit on the size of files stands for the disk: first no part fits, then all do but not the table."""
    path, out = write(tmp_path), tmp_path / "out"
    whole = finish(path, tmp_path / "whole")
    largest = max(part.stat().st_size for part in whole.parts())
    assert whole.table.stat().st_size > largest
    for limit, what in ((5_000, "parts"), (largest, "runs.parquet")):
        arguments = [str(limit), str(path), str(out), *sys.path]
        done = subprocess.run([sys.executable, "-B", "-c", FULL, *arguments], capture_output=True, text=True)
        assert done.stderr == ""
        assert re.fullmatch(f".*{what}.*: cannot write the table .*what was finished before is kept\n", done.stdout)
        assert not list(out.rglob("*.part"))
    assert len(list((out / "s" / "parts").iterdir())) == len(whole.parts())
    here = Here()
    assert finish(path, out, here).table.read_bytes() == whole.table.read_bytes()
    assert not here.tasks


def test_an_unreadable_part_says_what_to_do(tmp_path: Path) -> None:
    path = write(tmp_path, axes={"p": AXES["p"]})
    [part] = finish(path, tmp_path / "out").parts()
    part.write_bytes(b"PAR1 but not really")
    with pytest.raises(RecordError, match=rf"{part.name}: not a readable table .*delete it"):
        finish(path, tmp_path / "out")


def test_metrics_may_be_chosen(tmp_path: Path) -> None:
    path = write(tmp_path, axes={"p": AXES["p"]}, metrics=["vibration", "max_error"])
    assert list(rows(finish(path, tmp_path / "out"))[0]) == [
        "run", "p", "controller.kp", "controller.kd", "stable", "max_error", "vibration_1", "vibration_2", "status",
        "message",
    ]  # fmt: skip


def test_whole_numbers_texts_and_flags_keep_their_types(tmp_path: Path) -> None:
    axes: dict[str, Any] = {
        "plant.seed": {"values": [1, 2]},
        "loop.per_joint": {"values": [True, False]},
        "loop.actuation": {"values": ["immediate"]},
        "controller.kp": {"values": [10, 12.5]},
    }
    folder = finish(write(tmp_path, axes=axes), tmp_path / "out")
    schema = pq.read_schema(folder.table)
    kinds = [str(schema.field(name).type) for name in axes]
    assert kinds == ["int64", "bool", "string", "double"]
    assert np.isfinite(pq.ParquetFile(folder.table).read()["max_error"].to_numpy()).all()


def test_values_that_do_not_fit_are_found_before_anything_runs(tmp_path: Path) -> None:
    path = write(tmp_path, axes={**AXES, "plant.payload.mass": {"values": [1, -1]}})
    here = Here()
    with pytest.raises(ScenarioError, match=r"sweep\.yaml:\d+: axes\.plant\.payload\.mass: .*must be a number"):
        finish(path, tmp_path / "out", here)
    assert not here.tasks
    assert not (tmp_path / "out").exists()
