"""Every mistake in a sweep file is one line that says file, line, key and what would be valid."""

import re
from pathlib import Path
from typing import Any

import pytest
from sweep_rig import AXES, load, write

from lwa4d_sim.console import shipped_scenarios
from lwa4d_sim.errors import LwaError, ScenarioError
from lwa4d_sim.sweep.file import Sweep, SweepSettings
from lwa4d_sim.sweep_cli import shipped_sweeps, sweep_path

P = {"from": 1, "to": 2, "count": 3, "keys": {"controller.kp": 1}}
WRONG: list[tuple[dict[str, Any], str]] = [
    ({"name": None}, "sweep.yaml: name: is missing; it must be text"),
    ({"name": "a/b"}, "name (='a/b'): must be text that can name a file"),
    ({"scenario": None}, "scenario: is missing; it must be text"),
    ({"scenario": "none.yaml"}, "none.yaml: cannot read the scenario: No such file or directory"),
    ({"scenari": "x"}, "scenari (='x'): unknown key; did you mean 'scenario'?"),
    ({"variant": "cam"}, "variant (='cam'): no such variant; small.yaml has can, late, ideal"),
    ({"set": {"controller.Kp": 3}}, "unknown key; did you mean 'kp'?"),
    ({"set": 3}, "set (=3): must be a mapping"),
    ({"axes": None}, "axes: is missing; it must be a mapping"),
    ({"axes": {}}, "axes: is empty; name at least one axis"),
    ({"axes": {"p": 3}}, "axes.p (=3): must be a mapping"),
    ({"axes": {"p": {**P, "keys": {}}}}, "axes.p.keys: is empty"),
    ({"axes": {"p": {**P, "keys": {"controller.kp": "x"}}}}, "axes.p.keys.controller.kp (='x'): must be a number"),
    ({"axes": {"p": {**P, "keys": {"controller.kp": 1e9}}}}, "axes.p.keys.controller.kp (=1000000000.0): must lie"),
    ({"axes": {"p": {**P, "count": 1}}}, "axes.p: count must be at least 2 where from and to differ"),
    ({"axes": {"p": {**P, "count": 0}}}, "axes.p.count (=0): must be a whole number of at least 1"),
    ({"axes": {"p": {**P, "count": 2.5}}}, "axes.p.count (=2.5): must be a whole number of at least 1"),
    ({"axes": {"p": {**P, "step": 2}}}, "axes.p.step (=2): unknown key; valid here: law, from, to, count, scale, keys"),
    ({"axes": {"p": {"from": 1, "count": 2}}}, "axes.p.to: is missing; it must be a number"),
    ({"axes": {"p": {**P, "from": 0, "scale": "log"}}}, "axes.p: from and to must be above 0 on a log scale"),
    ({"axes": {"p": {"from": 1, "to": 2}}}, "axes.p: a grid needs values, or from, to and count"),
    ({"axes": {"controller.kp": {"values": []}}}, "kp.values: must be a list of one or more values of any kind"),
    ({"axes": {" ": P}}, "axes. : an axis needs a name"),
    ({"scenario": "none.yaml", "set": {"controller.kp": 3}}, "scenario (='none.yaml'): "),
    ({"scenario": "sweep.yaml"}, "is a sweep; it belongs to lwa4d-sim sweep"),
    ({"axes": {"p": {"values": ["a"], "keys": {"controller.kp": 2}}}}, "factors other than 1 need values"),
    ({"axes": {"run": P}}, "axes.run: cannot be an axis: the table has a column of its own of this name"),
    ({"axes": {"stable": P}}, "axes.stable: cannot be an axis"),
    ({"axes": {"p": P, "controller.kp": {"values": [1]}}}, "moves controller.kp, which axis p moves too"),
    ({"axes": {"plant.seed": {"values": [1]}}, "seeds": 2}, "moves plant.seed, which seeds moves too"),
    ({"seeds": 0}, "seeds (=0): must be a whole number of at least 1"),
    ({"metrics": ["max_eror"]}, "metrics: no metric 'max_eror'; there are stable, "),
    ({"metrics": []}, "metrics: must be a list of one or more texts"),
    ({"design": {"samples": 3}}, "design.kind: is missing; give one of grid, random, "),
    ({"design": {"kind": "girid"}}, "design.kind (='girid'): must be one of grid, "),
    ({"design": {"kind": "random"}}, "design.samples: is missing; it must be a whole number of at least 1"),
    ({"design": {"kind": "sobol", "samples": 100}}, "design: samples (=100) must be a power of 2; nearest: 64 or 128"),
    ({"design": {"kind": "random", "samples": 4}}, "axes.p.count (=4): belongs to a grid"),
    ({"design": {"kind": "worst_case", "objective": "error"}}, "objective (='error'): must be one of unstable_since"),
    ({"design": {"kind": "worst_case"}, "axes": {"controller.kp": {"values": [1]}}}, "kp: a search needs from and to"),
    ({"design": {"kind": "random", "samples": 4}, "axes": {"x": {"law": "normal", "mean": 1, "deviation": 0}}},
     "axes.x.deviation (=0): must be a number above 0"),
    ({"design": {"kind": "random", "samples": 4},
      "axes": {"x": {"law": "normal", "mean": 1, "deviation": 1, "min": 2, "max": 1}}},
     "axes.x: max (=1.0) must be above min (=2.0)"),
]  # fmt: skip


@pytest.mark.parametrize(("keys", "message"), WRONG, ids=lambda value: value if isinstance(value, str) else "")
def test_a_mistake_is_one_line(keys: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = write(tmp_path, **keys)
    with pytest.raises(ScenarioError) as error:
        load(path)
    text = str(error.value)
    assert text.startswith(str(path))
    assert message in text
    assert text.isprintable()


LATE: list[tuple[dict[str, Any], str]] = [
    ({"axes": {"controller.kq": {"values": [1]}}}, "axes.controller.kq: "),
    ({"axes": {"nonsense": {"values": [1]}}}, "nonsense"),
    ({"axes": {"controller.kp": {"values": [-1.0]}}}, "must be a number of at least 0"),
    ({"axes": {"loop.actuation": {"values": ["next_sync"]}}, "variant": "late"}, "moves nothing: variant 'late' sets"),
    ({"axes": {"arm": {"values": ["none.xml"]}}}, "no such file"),
    ({"axes": {"name": {"values": ["a", "b"]}}}, "axes.name: moves nothing in variant 'can', which is what runs"),
    ({"axes": {"variants.late.loop.latency": {"values": [0.01]}}}, "moves nothing in variant 'can'"),
    ({"axes": {"variants.none.loop.latency": {"values": [0.01]}}}, "moves nothing in variant 'can'"),
    ({"axes": {"expect.can.stable": {"values": [True]}}}, "axes.expect.can.stable: moves nothing in variant 'can'"),
    ({"axes": {"plant.timestep": {"values": [0.003]}}}, "is not a whole multiple of the plant step 0.003 s"),
]


@pytest.mark.parametrize(("keys", "message"), LATE, ids=lambda value: value if isinstance(value, str) else "")
def test_what_does_not_fit_the_scenario_is_one_line_too(keys: dict[str, Any], message: str, tmp_path: Path) -> None:
    scenario = {"variants": {"can": {}, "late": {"loop": {"actuation": "immediate"}}}}
    sweep = load(write(tmp_path, scenario, **keys))
    with pytest.raises(LwaError) as error:
        sweep.check_first()
    text = str(error.value)
    assert text.startswith(str(tmp_path / "sweep.yaml"))
    assert message in text
    assert text.isprintable()


def test_the_line_is_that_of_the_axis(tmp_path: Path) -> None:
    (path := tmp_path / "x.yaml").write_text(
        "name: x\nscenario: small.yaml\naxes:\n  a: {values: [1], keys: {controller.kp: 1}}\n"
        "  controller.kd: {values: [1, -1]}\n"
    )
    write(tmp_path)
    sweep = load(path)
    with pytest.raises(ScenarioError, match=rf"^{path}:5: axes\.controller\.kd: .*\(=-1, overridden\)"):
        [sweep.check_point(point) for point in sweep.points()]


def test_a_scenario_is_no_sweep(tmp_path: Path) -> None:
    write(tmp_path)
    with pytest.raises(ScenarioError, match=r"small\.yaml: is a scenario; a sweep names one under 'scenario'"):
        load(tmp_path / "small.yaml")


def test_only_keys_are_offered(tmp_path: Path) -> None:
    (path := tmp_path / "x.yaml").write_text("")
    with pytest.raises(ScenarioError, match=r"keys name, scenario, variant, set, design, axes, seeds, metrics$"):
        load(path)


@pytest.mark.parametrize("text", ["", "3", "[1]", "name: [", "\x00"])
def test_what_is_no_mapping_is_no_sweep(text: str, tmp_path: Path) -> None:
    (path := tmp_path / "x.yaml").write_text(text)
    with pytest.raises(ScenarioError, match=str(path)):
        load(path)


def test_a_shipped_scenario_goes_by_its_name(tmp_path: Path) -> None:
    path = write(tmp_path, scenario="pd_joint_p1.25", axes={"controller.kp": {"values": [1]}})
    assert Sweep.load(path, shipped_scenarios()).scenario.name == "pd_joint_p1.25"


def test_points_say_what_they_override(tmp_path: Path) -> None:
    sweep = load(write(tmp_path, axes={**AXES, "plant.payload.mass": {"values": [2]}}))
    points = list(sweep.points())
    assert sweep.count == len(points) == 12
    assert points[1].values == {"p": 10.0, "loop.latency": 0.006, "plant.payload.mass": 2}
    assert points[1].overrides == {
        "controller.kp": 10.0,
        "controller.kd": 2.5,
        "loop.latency": 0.006,
        "plant.payload.mass": 2,
    }


@pytest.mark.parametrize("path", sorted(shipped_sweeps().glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_sweeps_fit_their_scenarios(path: Path) -> None:
    assert sweep_path(path.stem) == path
    sweep = Sweep.load(path, shipped_scenarios())
    assert sweep.name == path.stem
    assert path.read_text(encoding="utf-8").startswith("# ")
    sweep.check_first()
    for point in sweep.points(40):
        sweep.check_point(point)


def test_what_ships() -> None:
    assert {path.stem for path in shipped_sweeps().glob("*.yaml")} == {
        "gain_latency",
        "gain_period",
        "robustness_ct",
        "worst_case_ct",
    }


PAGE = (Path(__file__).parent.parent / "docs" / "sweeps.md").read_text(encoding="utf-8")


def test_the_page_names_every_key_every_design_and_every_shipped_sweep() -> None:
    for name in (*SweepSettings.__annotations__, *(path.stem for path in shipped_sweeps().glob("*.yaml"))):
        assert f"`{name}`" in PAGE or name.startswith("__"), name
    for kind in ("grid", "random", "latin_hypercube", "sobol", "worst_case"):
        assert f"{{kind: {kind}" in PAGE


def test_the_example_of_the_page_is_a_sweep(tmp_path: Path) -> None:
    [text] = re.findall(r"^```yaml\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    (path := tmp_path / "gains.yaml").write_text(text)
    sweep = Sweep.load(path, shipped_scenarios())
    sweep.check_first()
    assert sweep.count == 16
    assert "16 runs" in PAGE
