from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from made_logs import made_log, pair
from PIL import Image

from lwa4d_sim import drawing
from lwa4d_sim.drawing import Curve, Ink, envelope, inks
from lwa4d_sim.errors import RecordError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.plots import draw_all, pictures
from lwa4d_sim.record import RunLog

_FLOATS = st.floats(-1e9, 1e9) | st.just(float("nan"))


@settings(derandomize=True, deadline=None, max_examples=60)
@given(arrays(np.float64, st.integers(1, 400), elements=_FLOATS), st.integers(1, 40))
def test_envelope_keeps_the_extremes_of_every_stretch(y: Array, buckets: int) -> None:
    kept = envelope(y, buckets)
    assert (np.diff(kept) > 0).all()
    assert kept[0] == 0
    assert kept[-1] == len(y) - 1
    size = -(-len(y) // buckets)
    for start in range(0, len(y), size):
        stretch = y[start : start + size]
        drawn = y[kept[(kept >= start) & (kept < start + size)]]
        finite = stretch[~np.isnan(stretch)]
        if finite.size:
            assert np.nanmax(drawn) == finite.max()
            assert np.nanmin(drawn) == finite.min()
        # what is missing stays missing: no line may cross a gap
        assert np.isnan(drawn).any() == np.isnan(stretch).any()


def test_envelope_saves_work_and_loses_no_peak() -> None:
    y = np.sin(np.arange(200_000) / 50)
    y[123_457] = 40.0
    kept = envelope(y, 900)
    assert len(kept) < 2100
    assert 123_457 in kept


@pytest.mark.parametrize("trouble", [None, "diverged"])
def test_draws_every_figure(tmp_path: Path, trouble: str | None) -> None:
    logs = pair()
    if trouble:
        logs["can"] = made_log("can", steps=3300, shakes_from=2.5, diverged_at=3.3)
        assert logs["can"].metrics()["final_error"][1] is None
    drawn = draw_all(logs, tmp_path)
    assert [p.path.name for p in drawn] == ["tool.png", "torques.png", "joint_error.png", "velocity.png", "path.png"]
    for picture in drawn:
        with Image.open(picture.path) as image:
            image.load()
            assert image.width == 960
            assert len(set(image.convert("L").resize((96, 60)).get_flattened_data())) > 10
        assert len(picture.caption) > 80
    assert pictures(tmp_path) == drawn  # title and caption travel in the file


def test_a_velocity_figure_for_each_sampled_variant_and_the_age_where_it_varies(tmp_path: Path) -> None:
    late = made_log("late")
    late = replace(late, ticks=replace(late.ticks, age=np.where(late.ticks.t > 1, 0.004, np.nan)))
    logs = {**pair(), "late": late}
    assert "age.png" not in {p.path.name for p in draw_all(logs, tmp_path)}
    age = np.linspace(0, 0.02, len(late.ticks.t))
    logs["late"] = replace(late, ticks=replace(late.ticks, age=age))
    names = [p.path.name for p in draw_all(logs, tmp_path)]
    assert names[3:] == ["velocity_can.png", "velocity_late.png", "path.png", "age.png"]


@pytest.mark.parametrize("steps", [1, 12])
def test_draws_the_shortest_logs(tmp_path: Path, steps: int) -> None:
    logs = {"a": made_log("a", steps=steps, diverged_at=1e-3 * steps), "b": made_log("b", steps=steps)}
    assert draw_all(logs, tmp_path)


def test_draws_arms_of_different_size_together(tmp_path: Path) -> None:
    draw_all({"three": made_log(n=3), "seven": made_log(n=7)}, tmp_path)
    with Image.open(tmp_path / "torques.png") as image:
        assert image.height > 7 * 150


def test_any_name_can_be_drawn(tmp_path: Path) -> None:
    names = ["$x_{", "$a$", "_hidden", "手臂", "🤖", "a\nb", "%s {0}", "x" * 500]
    logs = {name: made_log(name, name=names[k - 1], ideal=True, shakes_from=1.0) for k, name in enumerate(names)}
    assert len(draw_all(logs, tmp_path)) == 4


def test_says_whether_a_motor_reaches_its_limit(tmp_path: Path) -> None:
    strong, weak = made_log(limit=50.0, ideal=True), made_log(limit=4.0, ideal=True)
    assert "No motor ever" in draw_all({"can": strong}, tmp_path)[1].caption
    assert "at its limit" in draw_all({"can": weak}, tmp_path)[1].caption


def _panel(logs: dict[str, RunLog]) -> tuple[float, float]:
    ink = inks(logs)
    _, axes = drawing.rows(logs, ink, "t", ["y"])
    drawing.draw(axes, [Curve(ink[name], log.t, log.dq) for name, log in logs.items()], "rad/s")
    low, high = axes[0][0].get_ylim()
    return low, high


def test_a_diverged_run_leaves_the_others_room_and_a_vibration_is_shown_whole() -> None:
    calm, shaking = made_log("ideal", ideal=True), made_log(shakes_from=2.5)
    low, high = _panel({"ideal": calm, "can": shaking})
    assert low < shaking.dq[:, 0].min()
    assert high > shaking.dq[:, 0].max()
    diverged = made_log(steps=3500, shakes_from=2.5, diverged_at=3.5)
    assert diverged.dq[:, 0].max() > 1000
    low, high = _panel({"ideal": calm, "can": diverged})
    assert high - low < 10 * np.ptp(calm.dq[:, 0])
    assert low < calm.dq[:, 0].min() < calm.dq[:, 0].max() < high
    low, high = _panel({"can": diverged})
    assert high - low < 10 * np.ptp(calm.dq[:, 0])


def test_onsets_are_told_once_each() -> None:
    ink = Ink("can", "_CAN", "#000000", 1, 1, since=2.0, diverged_at=3.0)
    assert ink.onsets == {2.0: "can: shakes from 2.00 s", 3.0: "can: diverged at 3.00 s, run ends"}
    assert list(replace(ink, since=3.0).onsets.values()) == ["can: diverged at 3.00 s, run ends"]
    assert replace(ink, since=None, diverged_at=None).onsets == {}


def test_figures_that_cannot_be_written_or_read(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=r"tool\.png: cannot write the figure"):
        draw_all(pair(), tmp_path / "absent")
    (tmp_path / "tool.png").write_bytes(b"GIF89a")
    with pytest.raises(RecordError, match=r"tool\.png: not a readable PNG"):
        pictures(tmp_path)
