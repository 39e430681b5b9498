"""The search for the worst case: finds a known one, the same every time, and goes on where it was."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest
from sweep_rig import Here, finish, load, rows, write

from lwa4d_sim.errors import ScenarioError
from lwa4d_sim.sweep.file import Point
from lwa4d_sim.sweep.search import duration, score, search
from lwa4d_sim.sweep.summary import summarise

REGION: dict[str, Any] = {"controller.kp": {"from": 10, "to": 40}, "plant.payload.mass": {"from": 0.01, "to": 3}}


def design(**keys: Any) -> dict[str, Any]:
    return {"kind": "worst_case", "evaluations": 48, "seed": 3, **keys}


def hill(points: Sequence[Point]) -> list[Mapping[str, Any]]:
    """Highest at kp = 31.7, mass = 0.42."""
    out: list[Mapping[str, Any]] = []
    for point in points:
        kp, mass = point.values.values()
        height = math.exp(-((kp - 31.7) ** 2) / 90 - (mass - 0.42) ** 2)
        out.append({"status": "ok", "stable": True, "max_error": height})
    return out


def test_the_top_of_a_known_hill_is_found(tmp_path: Path) -> None:
    sweep = load(write(tmp_path, axes=REGION, design=design(evaluations=2000)))
    points = search(sweep, hill)
    best = max(points, key=lambda point: hill([point])[0]["max_error"])
    assert list(best.values.values()) == pytest.approx([31.7, 0.42], abs=0.02)
    assert len(points) <= 2000
    assert [point.run for point in points] == list(range(len(points)))
    assert all(10 <= point.values["controller.kp"] <= 40 for point in points)


def test_the_seed_decides_the_points(tmp_path: Path) -> None:
    def looked(seed: int) -> list[Any]:
        sweep = load(write(tmp_path, axes=REGION, design=design(seed=seed, evaluations=200)))
        return [tuple(point.values.values()) for point in search(sweep, hill)]

    assert looked(1) == looked(1)
    assert looked(1) != looked(2)


def test_what_is_worse() -> None:
    def row(**values: Any) -> dict[str, Any]:
        return {"status": "ok", "stable": True, "max_error": 0.1, **values}

    ranked = [
        row(status="error"),
        row(max_error=None),
        row(),
        row(max_error=0.2),
        row(max_error=9e5),
        row(stable=False, unstable_since=8.0),
        row(stable=False, unstable_since=2.0),
        row(stable=False, unstable_since=0.0),
    ]
    scores = [score(each, "max_error", 10.0) for each in ranked]
    assert scores[0] == scores[1] == -math.inf
    assert scores[1:] == sorted(set(scores[1:]))
    assert score(row(final_error_1=0.1, final_error_2=0.3, final_error_10=None), "final_error", 1.0) == 0.3
    assert score(row(rms_joint_error_1=7.0, max_joint_error_1=0.5), "max_joint_error", 1.0) == 0.5


def test_a_search_makes_a_table_of_all_it_looked_at(tmp_path: Path) -> None:
    path = write(tmp_path, axes=REGION, design=design())
    whole = finish(path, tmp_path / "whole", Here(2))
    table = rows(whole)
    assert 16 <= len(table) <= 48
    assert {row["status"] for row in table} == {"ok"}
    summary = summarise(load(path), whole)
    worst = summary["worst"]["worst_case"]
    assert worst["value"] == max(row["max_error"] for row in table)
    errors = [row["max_error"] for row in table]
    assert sum(errors[-20:]) > sum(errors[:20])  # generations of 20 climb
    # cut off at any task, it goes on to the same table and makes no run twice
    for stop in (1, 3):
        first, second = Here(3, stop=stop), Here(1)
        with pytest.raises(KeyboardInterrupt):
            finish(path, tmp_path / str(stop), first)
        assert finish(path, tmp_path / str(stop), second).table.read_bytes() == whole.table.read_bytes()
        made = [run for task in first.tasks + second.tasks for run in task]
        assert sorted(made) == list(range(len(table)))


def test_the_duration_is_that_of_the_motion(tmp_path: Path) -> None:
    sweep = load(write(tmp_path, axes=REGION, design=design()))
    assert duration(sweep) == pytest.approx(0.1)


def test_a_region_that_does_not_fit_is_one_line_and_writes_nothing(tmp_path: Path) -> None:
    path = write(tmp_path, axes={"controller.kp": {"from": -1, "to": 5}}, design=design())
    with pytest.raises(ScenarioError, match=r"axes\.controller\.kp: .*must be a number of at least 0"):
        finish(path, tmp_path / "out", Here(1))
    assert not (tmp_path / "out").exists()


def test_what_a_search_meets_is_told_as_it_is(tmp_path: Path) -> None:
    sweep = load(write(tmp_path, axes=REGION, design=design()))

    def evaluate(points: Sequence[Point]) -> list[Mapping[str, Any]]:
        raise ScenarioError("of one point")

    with pytest.raises(ScenarioError, match=r"^of one point$"):
        search(sweep, evaluate)
