"""The page about a sweep: figures that fit it, how to read them, and the worst run one click away."""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from sweep_rig import AXES, finish, load, write

from lwa4d_sim.drawing import BLACK
from lwa4d_sim.sweep.plots import BAD, GOOD, Runs, draw_heat_map, draw_sweep, labelled
from lwa4d_sim.sweep.report import report
from lwa4d_sim.sweep.summary import summarise

MAP = {"p": AXES["p"], "loop.latency": {"from": 0, "to": 0.012, "count": 5}}


def page(path: Path, out: Path) -> tuple[str, dict[str, Any]]:
    sweep, folder = load(path), finish(path, out)
    summary = summarise(sweep, folder)
    return report(sweep, folder, summary).read_text(encoding="utf-8"), summary


def stems(folder: Path) -> set[str]:
    return {path.stem for path in folder.glob("*.png")}


def test_a_grid_of_two_axes_gets_maps_and_its_worst_run_a_report(tmp_path: Path) -> None:
    text, summary = page(write(tmp_path, axes=MAP), tmp_path / "out")
    assert stems(tmp_path / "out" / "s") >= {"map_stable", "map_max_error", "map_rms_error", "spread"}
    assert "All 20 runs are stable." in text
    assert text.count("How to read this:") == len(stems(tmp_path / "out" / "s"))
    [link] = re.findall(r'href="(worst/[^"]+)"', text)
    there = tmp_path / "out" / "s" / link
    assert there.is_file()
    told = json.loads((there.parent / "summary.json").read_text())
    [variant] = told["variants"].values()
    assert variant["metrics"]["max_error"] == summary["worst"]["largest_error"]["value"]  # the very same run
    assert set(told["overrides"]) == {"controller.kp", "controller.kd", "loop.latency"}
    assert "<style>" in text
    assert "lwa4d-sim sweep" in text
    assert "nan" not in re.sub(r"data:image[^\"]*", "", text).lower()


def test_unstable_and_failed_runs_are_told(tmp_path: Path) -> None:
    push = {"plant": {"disturbances": [{"at": 0.02, "torque": [0, 0, 0]}]}}
    axes = {
        "plant.disturbances": {"values": [
            [{"at": 0.02, "torque": [0, 0, 0]}], [{"at": 0.02, "torque": [1e8, 0, 0]}], [{"at": 0, "body": "nobody"}]
        ]},
        "controller.kp": {"values": [10, 20]},
    }  # fmt: skip
    text, summary = page(write(tmp_path, push, axes=axes), tmp_path / "out")
    assert "2 of 4 runs are stable (50.0 %)." in text
    assert "2 of the runs could not be made; the first says: " in text
    assert "nobody" in text
    assert set(summary["worst"]) == {"largest_error", "first_unstable"}
    assert (tmp_path / "out" / "s" / "worst" / "first_unstable" / "report.html").is_file()
    assert "share_stable" in stems(tmp_path / "out" / "s")


def test_where_nothing_could_be_made_there_is_still_a_page(tmp_path: Path) -> None:
    path = write(tmp_path, axes={"controller.kp": {"values": [10, 20]}})
    sweep, folder = load(path), finish(path, tmp_path / "out")
    for part in folder.parts():
        part.unlink()
    from lwa4d_sim.sweep import table as sweep_table
    from lwa4d_sim.sweep.work import failure

    points = list(sweep.points())
    sweep_table.write(folder.table, sweep_table.part(points, [failure(point.run, "broken") for point in points]))
    summary = summarise(sweep, folder)
    assert summary["pass_rate"] == {"estimate": None, "low": 0.0, "high": 1.0}
    assert "No run could be made." in report(sweep, folder, summary).read_text()


def runs(size: int = 200, axes: int = 4) -> Runs:
    rng = np.random.default_rng(1)
    values: dict[str, Any] = {f"a{k}": rng.random(size) for k in range(axes)}
    values["kind"] = [("x", "$y$")[k % 2] for k in range(size)]
    stable = values["a0"] < 0.7
    metrics = {
        "max_error": rng.random(size),
        "vibration_1": np.where(stable, 0.01, np.nan),
        "vibration_2": rng.random(size),
    }
    return Runs("many $dollars$", values, stable, metrics)


def test_random_designs_get_shares_spreads_and_parallel_coordinates(tmp_path: Path) -> None:
    made = draw_sweep(runs(), tmp_path)
    assert [picture.path.stem for picture in made] == ["share_stable", "spread", "parallel"]
    assert all(len(picture.caption) > 150 for picture in made)


@pytest.mark.parametrize("size", [1, 2, 5])
def test_few_runs_can_be_drawn(size: int, tmp_path: Path) -> None:
    draw_sweep(runs(size), tmp_path)
    draw_sweep(runs(size, axes=1), tmp_path)


def lines(figure: Figure) -> list[Any]:
    return [line for ax in figure.axes for line in ax.lines]


def test_a_map_shows_each_cell_where_it_is_and_the_curve_over_it() -> None:
    x, y = (grid.ravel() for grid in np.meshgrid([1.0, 2.0, 3.0], [0.1, 0.2]))
    z = 10 * x + y
    order = np.random.default_rng(1).permutation(6)
    figure = draw_heat_map("s", ("x", x[order]), ("y", y[order]), ("z", z[order]), boundary=[(1.0, 0.1), (9.0, 0.2)])
    ax = figure.axes[0]
    [mesh] = ax.collections
    np.testing.assert_array_equal(np.asarray(mesh.get_array()).ravel(), z)
    [curve] = lines(figure)[:1]
    assert curve.get_color() == BLACK
    assert curve.get_xdata().tolist() == [1.0, 9.0]
    assert ax.get_xlim() == (0.5, 3.5)  # the map's own, not the curve's
    assert not lines(draw_heat_map("s", ("x", x), ("y", y), ("z", z)))


def test_a_logarithmic_axis_is_drawn_as_one() -> None:
    x, y = (grid.ravel() for grid in np.meshgrid([0.1, 1.0, 10.0], [1.0, 2.0]))
    figure = draw_heat_map("s", ("x", x), ("y", y), ("z", x + y), log=frozenset({"x"}))
    assert (figure.axes[0].get_xscale(), figure.axes[0].get_yscale()) == ("log", "linear")
    np.testing.assert_allclose(figure.axes[0].get_xlim(), [10**-1.5, 10**1.5])


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("loop.latency", "loop.latency [s]"),
        ("variants.can.loop.latency.tail", "variants.can.loop.latency.tail [s]"),
        ("controller.model.payload.mass", "controller.model.payload.mass [kg]"),
        ("plant.mass_scale", "plant.mass_scale"),
        ("loop.loss", "loop.loss"),
    ],
)
def test_axes_have_their_units(name: str, label: str) -> None:
    x = np.array([1.0, 2.0])
    assert draw_heat_map("s", (name, x), ("y", x), ("z", x)).axes[0].get_xlabel() == label
    assert labelled(name, ["none", "5 ms"]) == name


def shown(figure: Figure) -> Any:
    """Cells of a map of two by two."""
    cells: Any = figure.axes[0].collections[0].get_array()
    return np.ma.filled(cells, np.nan).reshape(2, 2)


def test_of_several_runs_in_a_cell_the_worst_counts() -> None:
    x, y = np.array([1.0, 1, 2, 2]), np.array([1.0, 1, 1, 2])
    stable = draw_heat_map("s", ("x", x), ("y", y), ("stable", np.array([1.0, 0, 1, 1])))
    cells = shown(stable)
    np.testing.assert_array_equal(cells, [[0, 1], [np.nan, 1]])
    assert {GOOD, BAD} <= {text.get_color() for text in stable.axes[0].texts}
    errors = draw_heat_map("s", ("x", x), ("y", y), ("e", np.array([3.0, 5, 1, np.nan])))
    cells = shown(errors)
    np.testing.assert_array_equal(cells, [[5, 1], [np.nan, np.nan]])


def call(*arguments: str, cwd: Path) -> "subprocess.CompletedProcess[str]":
    root = str(Path(__file__).parent.parent)
    code = f"import sys; sys.path.insert(0, {root!r}); from lwa4d_sim.cli import main; main()"
    return subprocess.run([sys.executable, "-c", code, "sweep", *arguments], cwd=cwd, capture_output=True, text=True)


def test_the_command(tmp_path: Path) -> None:
    path = write(tmp_path, axes=MAP)
    done = call(str(path), "-o", "out", "-j", "1", "--no-plots", "--json", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    told = json.loads(done.stdout)
    assert told["runs"] == told["stable"] == 20
    assert "report" not in told
    done = call(str(path), "-o", "out", "-j", "1", cwd=tmp_path)
    assert done.returncode == 0
    assert done.stderr == ""  # nothing is left to do
    shown = done.stdout.splitlines()
    assert shown[0] == "s  ->  out/s"
    assert shown[1] == "  20 runs: 20 stable (100.0 %, 95 % interval 83.9 to 100.0 %), 0 errors"
    assert shown[-1] == "report: out/s/report.html"
    done = call(str(path), "-o", "out", "--limit", "3", cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    done = call("nothing_like_it", cwd=tmp_path)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
