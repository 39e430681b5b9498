"""The command `lwa4d-sim stability`: what it prints and writes, and one line with exit code 2 for whatever is wrong."""

import csv
import json
import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from cli_rig import Call, Result, caller
from PIL import Image

from lwa4d_sim.errors import RecordError
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.stability import folder, guides
from lwa4d_sim.stability.analysis import PointStability
from lwa4d_sim.stability.findings import CURVES, Findings, find, with_charts
from lwa4d_sim.stability.margins import Mode
from lwa4d_sim.stability.words import headline, moves

PAGE = (Path(__file__).parent.parent / "docs" / "stability.md").read_text(encoding="utf-8")
SMALL: dict[str, Any] = {
    "name": "small",
    "arm": "lwa4d_3dof",
    "initial": {"q": [0, -1.0, 1.0]},
    "trajectory": {
        "waypoints": {"space": "joint", "points": [[0.3, -0.6, 0.9], [-0.3, -0.2, 0.5]]},
        "segment_time": 0.5,
    },
    "controller": {"kind": "pd_gravity", "kp": 2.0, "kd": 3.0},
    "variants": {"ideal": {"loop": {"kind": "ideal"}}, "can": {}, "late": {"loop": {"actuation": "next_sync"}}},
}
PICTURES = {"latency", "period", "workspace", "eigenvalues", "modes", "motion"}


@pytest.fixture
def call(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Call:
    """Runs `lwa4d-sim stability` in a new folder that holds small.yaml."""
    monkeypatch.chdir(tmp_path)
    Path("small.yaml").write_text(yaml.safe_dump(SMALL))
    return caller(capfd, monkeypatch, "stability")


def refused(result: Result, words: str) -> None:
    """One clear line on stderr, exit code 2, nothing on stdout, nothing written."""
    assert (result.code, result.out) == (2, ""), result
    [line] = result.err.splitlines()
    assert line.startswith("lwa4d-sim: ")
    assert re.search(words, line), line
    given = {"small.yaml", "blind.py", "laws_with_faults.py", "one.xml", "one.yaml", "__pycache__"}
    assert {path.name for path in Path().iterdir()} <= given


def test_json_keeps_its_contract(call: Call) -> None:
    result = call("small.yaml", "--no-plots", "--json")
    assert (result.code, result.err) == (0, "")
    answer = json.loads(result.out)
    assert {"points", "variant", "remarks", "folder", "verdict"} <= answer.keys()
    assert (answer["variant"], answer["folder"]) == ("can", None)
    points = answer["points"]
    np.testing.assert_allclose([point["q"] for point in points], [[0.3, -0.6, 0.9], [-0.3, -0.2, 0.5]], rtol=1e-12)
    for point in points:
        assert 0 < point["spectral_radius"] < 1 < point["gain_margin"]
        assert 0 < point["jitter_margin"] <= point["delay_margin"]
        assert len(point["mode"]["share"]) == 3
    assert not Path("runs").exists()


def test_what_is_infinite_or_unknown_is_null(call: Call) -> None:
    [point, _] = json.loads(call("small.yaml", "--variant", "ideal", "--no-plots", "--json").out)["points"]
    assert point["gain_margin"] is None
    assert point["jitter_margin"] is None
    assert point["delay_margin"] > 0


def test_a_factor_of_the_gain_margin_is_the_limit(call: Call) -> None:
    """Gains times the margin and a little less are stable, a little more are not."""
    [_, point] = json.loads(call("small.yaml", "--no-plots", "--json").out)["points"]
    for factor, stable in ((0.999, True), (1.001, False)):
        k = factor * point["gain_margin"]
        gains = ("--set", f"controller.kp={2.0 * k}", "--set", f"controller.kd={3.0 * k}")
        result = call("small.yaml", "--no-plots", "--json", *gains)
        assert result.code == 0
        [_, moved] = json.loads(result.out)["points"]
        assert (moved["spectral_radius"] < 1) == stable
        assert moved["gain_margin"] == pytest.approx(1 / factor, abs=1e-6)


def test_poses_take_the_place_of_the_waypoints(call: Call) -> None:
    result = call("small.yaml", "--no-plots", "--json", "--pose=-0.3,-0.2,0.5", "--pose", "0.5,-0.6,0.9")
    poses = json.loads(result.out)["points"]
    points = json.loads(call("small.yaml", "--no-plots", "--json").out)["points"]
    assert poses[0]["gain_margin"] == pytest.approx(points[1]["gain_margin"], rel=1e-9)
    assert poses[1]["gain_margin"] == pytest.approx(points[0]["gain_margin"], rel=1e-6)  # turned about the vertical
    assert [pose["name"] for pose in poses] == ["pose 1", "pose 2"]


def test_the_table_is_that_of_the_page(call: Call) -> None:
    shown = next(block for block in re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL) if "spectral radius" in block)
    printed = call("pd_joint_p2.5", "--no-plots").out
    assert [line.rstrip() for line in printed.splitlines()][1:6] == shown.splitlines()
    assert "The loop is unstable at waypoints 3 and 4, worst at waypoint 4" in printed
    assert "The limit there is 0.680 times these gains, where joint 3 shakes at 11.0 Hz." in printed


def test_everything_is_written(call: Call, tmp_path: Path) -> None:
    result = call("small.yaml", "--set", "controller.kp=2.5", "--size", "4", "-o", "out")
    assert (result.code, result.err) == (0, "")
    folder = tmp_path / "out" / "small-stability"
    assert [path.name for path in folder.parent.iterdir()] == ["small-stability"]
    assert {path.stem for path in folder.glob("*.png")} == PICTURES == {path.stem for path in folder.glob("*.csv")}
    data = json.loads((folder / "stability.json").read_text())
    assert data["scenario"] == Path("small.yaml").read_text()
    assert data["overrides"] == {"controller.kp": 2.5}
    assert data["settings"]["controller"]["kp"] == 2.5
    assert {"lwa4d_sim", "mujoco", "numpy"} <= data["versions"].keys()
    for path in folder.glob("*.png"):
        with Image.open(path) as picture:
            assert picture.info["Description"]

    page = (folder / "report.html").read_text()
    assert data["verdict"] in page
    text = re.sub(r"\s+", " ", page)
    for guide in (guides.LATENCY, guides.PERIOD, guides.POLES, guides.MODES):
        assert guide in text
    assert page.count("<figure>") == len(PICTURES)
    assert "http" not in re.sub(r"data:image/png;base64,[\w+/=]+", "", page)
    assert "lwa4d-sim stability small.yaml --variant can --set controller.kp=2.5 --size 4" in text


def test_the_command_on_the_page_gives_the_same_again(call: Call, tmp_path: Path) -> None:
    call("small.yaml", "--variant", "late", "--pose=-0.3,-0.2,0.5", "--joints", "1,3", "--size", "4", "-o", "out")
    page = (tmp_path / "out" / "small-stability" / "report.html").read_text()
    found = re.search(r"<pre>lwa4d-sim stability (.*)</pre>", page)
    assert found is not None
    before = (tmp_path / "out" / "small-stability" / "workspace.csv").read_bytes()
    assert call(*shlex.split(found[1]), "-o", "again").code == 0
    assert (tmp_path / "again" / "small-stability" / "workspace.csv").read_bytes() == before


def test_tables_say_their_units_and_hold_the_margins(call: Call, tmp_path: Path) -> None:
    answer = json.loads(call("small.yaml", "--size", "4", "-o", "out", "--json").out)
    folder = tmp_path / "out" / "small-stability"
    assert answer["folder"] == str(Path("out") / "small-stability")
    tables = {path.stem: list(csv.reader(path.read_text().splitlines())) for path in folder.glob("*.csv")}
    for name, (heading, *rows) in tables.items():
        assert all(len(row) == len(heading) for row in rows), name
        assert all("[" in cell or cell in ("operating point", "joint that moves most") for cell in heading), name
    margins = [point["gain_margin"] for point in answer["points"]]
    assert [float(cell) for cell in tables["latency"][1]] == pytest.approx([0.0, *margins], rel=1e-6)
    assert len(tables["workspace"]) == 1 + 4 * 4
    assert [float(row[1]) for row in tables["modes"][1:]] == pytest.approx(margins, rel=1e-6)


def test_an_ideal_loop_has_no_curves_over_latency(call: Call, tmp_path: Path) -> None:
    assert call("small.yaml", "--variant", "ideal", "--size", "3", "-o", "out").code == 0
    folder = tmp_path / "out" / "small-stability"
    assert {path.stem for path in folder.glob("*.png")} == {"workspace", "modes", "motion"}


BAD = [
    (["nosuch"], "nosuch: cannot read"),
    (["small.yaml", "--variant", "nope"], "no variant 'nope'; it has can, ideal, late"),
    (["small.yaml", "--pose", "1,2"], r"--pose 1,2: the arm has 3 joints; give 3 angles \[rad\], e\.g\. 0,0\.5,0\.5"),
    (["small.yaml", "--pose", "1,two,3"], r"--pose 1,two,3: must be 3 angles"),
    (["small.yaml", "--pose", "nan,0,0"], r"--pose nan,0,0"),
    (["small.yaml", "--joints", "2,9"], r"--joints 2,9: must be two different joints of 1 to 3"),
    (["small.yaml", "--joints", "2,2"], r"--joints 2,2"),
    (["small.yaml", "--joints", "2"], r"--joints 2: must be two joint numbers"),
    (["small.yaml", "--size", "1"], r"--size"),
    (["small.yaml", "--set", "loop.period=0"], r"loop\.period"),
    (
        ["small.yaml", "--set", "loop.period=100"],
        r"loop\.period .*grow beyond all numbers within 100 s; give a shorter",
    ),
    (["small.yaml", "--set", "loop.latency=3"], r"loop\.latency .*data are 300 periods late in all; .* takes 50"),
    (["small.yaml", "--set", "controller={kind: 'blind:Nothing'}"], r"controller"),
]


@pytest.mark.parametrize(("arguments", "words"), BAD)
def test_bad_input_is_one_line(arguments: list[str], words: str, call: Call) -> None:
    refused(call(*arguments, "-o", "out"), words)


def test_a_folder_of_somebody_else_is_left_alone(call: Call, tmp_path: Path) -> None:
    theirs = tmp_path / "out" / "small-stability"
    theirs.mkdir(parents=True)
    (theirs / "thesis.docx").write_text("mine")
    result = call("small.yaml", "-o", "out")
    assert result.code == 2
    assert "thesis.docx" in result.err
    assert [path.name for path in theirs.iterdir()] == ["thesis.docx"]


def test_the_folder_is_whole_or_not_there(call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise RecordError("disk full")

    monkeypatch.setattr(folder, "write_stability_page", full)
    result = call("small.yaml", "--size", "3", "-o", "out")
    assert (result.code, result.out) == (2, "")
    assert "disk full" in result.err
    assert list((tmp_path / "out").iterdir()) == []


# words --------------------------------------------------------------------------------------------------------------


def findings(*points: dict[str, Any]) -> Findings:
    """Made-up margins."""
    found, _ = find(Scenario.parse(yaml.safe_dump(SMALL)), "can")
    plain = PointStability(
        0.0, np.zeros(3), np.zeros(3), 0.9, np.inf, np.inf, 0.001, Mode(11.04, np.array([0.1, 0.6, 1.0]), 1.0)
    )
    made = [replace(plain, **point) for point in points]
    return replace(found, points=made, names=[f"waypoint {k + 1}" for k in range(len(made))])


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([{}], "The loop is stable at waypoint 1. No limit of the gains or of the delay was found."),
        (
            [{"gain_margin": 2.0, "delay_margin": 0.004}, {"gain_margin": 1.36, "delay_margin": 0.0061}],
            "The loop is stable at both waypoints. Tightest is waypoint 2: there all gains may be 1.36 times as large "
            "before joints 3 and 2 shake at 11.0 Hz, or commands may come 6.1 ms later.",
        ),
        (
            [{}, {"spectral_radius": 1.02, "gain_margin": 0.68}],
            "At waypoint 2 the loop is unstable: a disturbance grows by 2 % from tick to tick. The limit there is "
            "0.680 times these gains, where joints 3 and 2 shake at 11.0 Hz.",
        ),
        (
            [{"spectral_radius": 1.5, "gain_margin": 0.0}, {"spectral_radius": 1.02, "gain_margin": 0.68}],
            "The loop is unstable everywhere looked at, worst at waypoint 1: a disturbance grows by 50 % from tick to "
            "tick, and no factor on the gains helps.",
        ),
        (
            [{"spectral_radius": 1.002, "gain_margin": 2.1}],
            "At waypoint 1 the loop is unstable: a disturbance grows by 0.2 % from tick to tick. These gains are too "
            "weak: it takes 2.10 times as much.",
        ),
        (
            [{}, {}, {"spectral_radius": np.inf, "gain_margin": 0.1}, {"spectral_radius": 1.1, "gain_margin": 0.5}],
            "The loop is unstable at waypoints 3 and 4, worst at waypoint 3: a disturbance grows at once beyond all "
            "bounds. The limit there is 0.100 times these gains, where joints 3 and 2 shake at 11.0 Hz.",
        ),
    ],
)
def test_the_verdict_in_words(points: list[dict[str, Any]], words: str) -> None:
    assert headline(findings(*points)) == words


def test_who_shakes() -> None:
    assert moves(np.array([0.2, 1.0, 0.4])) == "joint 2 shakes"
    assert moves(np.array([0.7, 1.0, 0.9])) == "joints 2, 3 and 1 shake"


def test_commands_of_the_page_run(call: Call) -> None:
    lines = [line for block in re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL) for line in block.splitlines()]
    assert len(lines) == 3
    for line in lines:
        words = shlex.split(line)
        assert words[:2] == ["lwa4d-sim", "stability"]
        result = call(*words[2:], "--no-plots")
        assert (result.code, result.err) == (0, ""), line


LAWS = """
import numpy as np

class Raises:
    def torque(self, state, ref, model): raise ZeroDivisionError("my fault")

class Blank:
    def torque(self, state, ref, model): return np.full_like(state.q, np.nan)

class Integrates:
    total = 0.0
    def torque(self, state, ref, model):
        self.total = self.total + (ref.q - state.q)
        return 2.0 * (ref.q - state.q) - 3.0 * state.dq + self.total
"""


@pytest.mark.parametrize(
    ("law", "words"),
    [
        (
            "Raises",
            r"raised ZeroDivisionError: my fault \(laws_with_faults\.py, line 5\); it was asked for 26 arms at once",
        ),
        ("Blank", r"torque\(\) has no finite slope near q = 0\.3, -0\.6, 0\.9"),
        ("Integrates", r"torque\(\) answers differently when asked the same again; a law with a memory cannot be"),
    ],
)
def test_a_law_of_ones_own_that_has_no_slope(
    law: str, words: str, call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "laws_with_faults.py").write_text(LAWS)
    monkeypatch.syspath_prepend(str(tmp_path))
    refused(call("small.yaml", "--set", f"controller={{kind: 'laws_with_faults:{law}'}}", "-o", "out"), words)


def test_the_bar_ends_where_the_work_ends() -> None:
    steps: list[None] = []
    scenario = Scenario.parse(yaml.safe_dump(SMALL))
    found, points = find(scenario)
    with_charts(found, points, None, 4, lambda: steps.append(None))
    assert len(steps) == 4 + CURVES


def test_an_arm_of_one_joint_has_no_map(call: Call, tmp_path: Path) -> None:
    (tmp_path / "one.xml").write_text(ONE_JOINT)
    changes = {"arm": "one.xml", "initial": {"q": [0.1]}}
    changes["trajectory"] = {"waypoints": {"space": "joint", "points": [[0.3]]}, "segment_time": 0.5}
    (tmp_path / "one.yaml").write_text(yaml.safe_dump({**SMALL, **changes}))
    refused(call("one.yaml", "--joints", "1,2", "-o", "out"), "a map moves two joints, and the arm has one")
    assert call("one.yaml", "--no-plots").code == 0


ONE_JOINT = """
<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="2"/>
<site name="tcp" pos=".3 0 0"/></body></worldbody><actuator><motor joint="a"/></actuator></mujoco>
"""
