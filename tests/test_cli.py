"""The command line: exit codes, one line on stderr for bad input, and nothing half-written."""

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import pytest
import yaml

from lwa4d_sim import RunLog, cli, results
from lwa4d_sim.console import scenario_path

ROOT = Path(__file__).parent.parent

SMALL: dict[str, Any] = {
    "name": "small",
    "arm": "lwa4d_3dof",
    "trajectory": {"waypoints": {"space": "joint", "points": [[-1.5, -1.5, 1.5]]}, "segment_time": 0.1},
    "controller": {"kind": "pd_gravity", "kp": 10.0, "kd": 5.0},
}
TASK = {"trajectory": {"waypoints": {"space": "task", "points": [[0.5, -0.3, 0.4]]}, "segment_time": 0.1}}

MOTORLESS = '<mujoco><worldbody><body><joint name="j"/><geom size=".1" mass="1"/></body></worldbody></mujoco>'


class Result(NamedTuple):
    code: int
    out: str
    err: str


@pytest.fixture
def call(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Result]:
    """Runs the command line in a new folder and returns exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))

    def run(*arguments: str | Path) -> Result:
        capfd.readouterr()
        monkeypatch.setattr(sys, "argv", ["lwa4d-sim", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        return Result(int(str(end.value.code)), *capfd.readouterr())

    return run


def write(path: str, *changes: dict[str, Any], **more: Any) -> str:
    """A scenario file: the small one with changes of top-level blocks."""
    document: dict[str, Any] = dict(SMALL)
    for change in (*changes, more):
        document |= change
    Path(path).write_text(yaml.safe_dump(document, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return path


def refused(result: Result, words: str) -> None:
    """One line on stderr, exit code 2, nothing on stdout, no folder of results."""
    assert result.code == 2
    assert result.out == ""
    [line] = result.err.splitlines()
    assert line.startswith("lwa4d-sim: ")
    assert words in line, line
    assert "Traceback" not in line
    assert line.isprintable()
    assert not Path("runs").exists()


# ---- what works ----


def test_run_writes_one_folder_and_prints_one_object(call: Callable[..., Result]) -> None:
    write("x.yaml", variants={"ideal": {"loop": {"kind": "ideal"}}, "can": {}}, expect={"can": {"max_error_max": 1.0}})
    result = call("run", "x.yaml", "--json", "--no-plots", "-o", "out")
    assert (result.code, result.err) == (0, "")
    summary = json.loads(result.out)
    assert summary["folder"] == str(Path("out/small"))
    assert summary["variants"].keys() == {"ideal", "can"}
    can = summary["variants"]["can"]
    assert can["expect"]["passed"] is True
    assert can["metrics"]["deviation"][0] > 0
    assert summary["versions"].keys() == {"lwa4d_sim", "mujoco", "numpy"}
    assert summary["hashes"]["models"].keys() == {"lwa4d_3dof"}
    folder = Path("out/small")
    assert {entry.name for entry in folder.iterdir()} == {"summary.json", "ideal.h5", "can.h5"}
    assert json.loads((folder / "summary.json").read_text()) == summary
    log = RunLog.load(folder / "can.h5")
    assert {**log.metrics(), "deviation": can["metrics"]["deviation"]} == can["metrics"]
    assert [entry.name for entry in Path("out").iterdir()] == ["small"]


def test_the_same_file_gives_the_same_results(call: Callable[..., Result]) -> None:
    write("x.yaml", loop={"loss": 0.3, "jitter": 0.002}, plant={"seed": 5})
    for folder in ("a", "b"):
        assert call("run", "x.yaml", "--no-plots", "-o", folder).code == 0
    assert Path("a/small/default.h5").read_bytes() == Path("b/small/default.h5").read_bytes()
    call("run", "x.yaml", "--no-plots", "-o", "c", "--set", "plant.seed=6")
    assert Path("a/small/default.h5").read_bytes() != Path("c/small/default.h5").read_bytes()


def test_an_expectation_that_fails_gives_exit_code_1_and_says_so(call: Callable[..., Result]) -> None:
    write("x.yaml", expect={"default": {"max_error_max": 0.0, "stable": True}})
    result = call("run", "x.yaml", "--no-plots")
    assert result.code == 1
    assert "FAILED  max_error_max: asked 0.0, found" in result.out
    assert "passed  stable" in result.out
    assert Path("runs/small/summary.json").exists()


def test_overrides_are_yaml_and_kept_with_the_results(call: Callable[..., Result]) -> None:
    write("x.yaml")
    options = ["--set", "controller.kp=[1e2, 100, 50]", "--set", "name=other", "--set", "loop={kind: ideal}"]
    summary = json.loads(call("run", "x.yaml", "--no-plots", "--json", *options).out)
    assert summary["overrides"] == {"controller.kp": [100.0, 100, 50], "name": "other", "loop": {"kind": "ideal"}}
    assert Path("runs/other/default.h5").exists()


def test_several_files_give_several_runs(call: Callable[..., Result]) -> None:
    write("a.yaml", name="a")
    write("b.yaml", name="b")
    summaries = json.loads(call("run", "a.yaml", "b.yaml", "--no-plots", "--json").out)["runs"]
    assert [summary["name"] for summary in summaries] == ["a", "b"]


def test_a_run_replaces_its_own_older_results(call: Callable[..., Result]) -> None:
    write("x.yaml", variants={"a": {}, "b": {}})
    assert call("run", "x.yaml", "--no-plots").code == 0
    write("x.yaml", variants={"c": {}})
    assert call("run", "x.yaml", "--no-plots").code == 0
    assert {entry.name for entry in Path("runs/small").iterdir()} == {"summary.json", "c.h5"}
    assert [entry.name for entry in Path("runs").iterdir()] == ["small"]


def test_an_arm_may_be_a_file_beside_the_scenario_and_differ_between_variants(call: Callable[..., Result]) -> None:
    Path("sub").mkdir()
    Path("sub/mine.xml").write_bytes((ROOT / "models/lwa4d_3dof.xml").read_bytes())
    document = {key: value for key, value in SMALL.items() if key != "arm"}
    document["variants"] = {"mine": {"arm": "mine.xml"}, "shipped": {"arm": "lwa4d_3dof"}}
    Path("sub/x.yaml").write_text(yaml.safe_dump(document))
    summary = json.loads(call("run", "sub/x.yaml", "--no-plots", "--json").out)
    assert len(set(summary["hashes"]["models"].values())) == 1
    mine, shipped = (summary["variants"][name]["metrics"] for name in ("mine", "shipped"))
    assert mine == shipped


def test_a_shipped_scenario_goes_by_its_name(call: Callable[..., Result]) -> None:
    assert scenario_path("pd_joint_p2.5").is_file()
    write("pd_joint_p2.5")  # a file of that name comes first
    assert scenario_path("pd_joint_p2.5") == Path("pd_joint_p2.5")
    listed = json.loads(call("scenarios", "--json").out)
    for what in ("scenarios", "sweeps"):
        assert listed[what].keys() == {path.stem for path in (ROOT / what).glob("*.yaml")}
    lines = [line for line in call("scenarios").out.splitlines() if line.startswith("  ")]
    assert [line.split()[0] for line in lines] == [*listed["scenarios"], *listed["sweeps"]]
    assert all(len(line.split(maxsplit=1)) == 2 for line in lines)


def test_the_schema_is_json(call: Callable[..., Result]) -> None:
    assert json.loads(call("schema").out) == json.loads(call("schema", "--json").out)


def test_without_arguments_there_is_help(call: Callable[..., Result]) -> None:
    bare, asked = call(), call("--help")
    assert bare == asked
    assert (bare.code, bare.err) == (0, "")
    for command in ("run", "batch", "report", "schema", "scenarios"):
        assert command in bare.out


# ---- a simulation that diverges ----


def test_a_diverged_run_is_reported_with_the_time_and_without_nan(call: Callable[..., Result]) -> None:
    write("x.yaml", plant={"disturbances": [{"at": 0.05, "force": [1e8, 0, 0]}]}, variants={"wild": {}})
    result = call("run", "x.yaml", "--no-plots")
    assert result.code == 0
    assert result.err == ""
    assert "DIVERGED at 0.05 s" in result.out or "DIVERGED at 0.06 s" in result.out
    text = Path("runs/small/summary.json").read_text()
    assert not {"NaN", "Infinity"} & set(text.replace(",", " ").split())
    metrics = json.loads(text)["variants"]["wild"]["metrics"]
    assert metrics["stable"] is False
    assert 0.05 <= metrics["unstable_since"] == metrics["diverged_at"] < 0.1
    assert metrics["final_error"] == metrics["settling_time"] == [None]


def test_an_expected_divergence_passes(call: Callable[..., Result]) -> None:
    write(
        "x.yaml",
        plant={"disturbances": [{"at": 0.05, "force": [1e8, 0, 0]}]},
        expect={"default": {"stable": False, "diverged_at_max": 0.1}},
    )
    assert call("run", "x.yaml", "--no-plots").code == 0


# ---- bad input ----

PER_JOINT = {
    "initial.q": [0.0, 0.0],
    "plant.mass_scale": [1.0, 1.0],
    "plant.armature": [1.0, 1.0],
    "plant.friction": {"viscous": [1.0, 1.0]},
    "controller.kp": [1.0, 1.0],
    "controller.kd": [1.0, 1.0],
    "controller.model": {"mass_scale": [1.0, 1.0]},
    "loop.latency": [0.0, 0.0],
    "loop": {"latency": {"measurement": [0.0, 0.0]}},
    "loop.position_resolution": [1e-3, 1e-3],
    "loop.torque_resolution": [1e-3, 1e-3],
    "trajectory.segment_time": [1.0, 1.0],
    "trajectory.waypoints.points": [[0.0, 0.0]],
    "trajectory.boundary": {"velocity": [[0.0, 0.0]]},
    "trajectory": {"kind": "fourier", "a": [[1.0]], "b": [[1.0]], "duration": 1.0},
}


@pytest.mark.parametrize("key", PER_JOINT)
def test_a_list_that_is_not_one_a_joint_is_refused(key: str, call: Callable[..., Result]) -> None:
    write("x.yaml")
    result = call("run", "x.yaml", "--set", f"{key}={json.dumps(PER_JOINT[key])}")
    refused(result, "x.yaml")
    assert any(word in result.err for word in (" 2 ", "3 numbers", "1 rows"))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"arm": "nothere.xml"}, "x.yaml:2: arm (='nothere.xml'): "),
        ({"arm": "nothere.xml"}, "no such file"),
        ({"arm": "motorless.xml"}, "j has 0 motors"),
        ({"arm": "broken.xml"}, "XML"),
        ({"arm": "empty.xml"}, "empty"),
        ({"arm": "."}, "no such file"),
        ({"arm": "a\nb"}, "no such file"),
        ({"plant": {"timestep": 1e-12}}, "plant.timestep (=1e-12): 1e-12 s is not a whole number of nanoseconds"),
        ({"plant": {"timestep": 1e-9}}, "more than 20000000 steps"),
        ({"plant": {"timestep": 0.003}}, "0.01 s is not a whole multiple of the plant step 0.003 s; nearest: 0.009"),
        ({"loop": {"period": 0.0105}}, "x.yaml:16: loop.period (=0.0105): 0.0105 s is not a whole multiple of the"),
        ({"loop": {"period": -0.01}}, "loop.period (=-0.01): must be a number above 0"),
        ({"loop": {"phase": 0.01}}, "loop.phase (=0.01): "),
        ({"plant": {"payload": {"mass": -1}}}, "plant.payload.mass (=-1): must be a number of at least 0"),
        ({"plant": {"disturbances": [{"at": 0, "body": "nose"}]}}, "no body 'nose' in the model; its bodies are"),
        ({"plant": {"friction": {"viscous": 1e6}}}, "viscous friction is too stiff"),
        (
            {"controller": {"kind": "pid"}},
            "controller.kind (='pid'): must be one of pd_gravity, computed_torque, package",
        ),
        (
            {"controller": {"kind": "computed_torque"}},
            "x.yaml:11: controller (a mapping): give either p, or both kp and kd",
        ),
        ({"controller": {"kind": "no.such:Law"}}, "No module named 'no'"),
        ({"controller": {"kind": "json:Law"}}, "has no attribute 'Law'"),
        ({"controller": {"kind": "builtins:dict"}}, "has no method torque"),
        ({"trajectory": {"kind": "sampled", "file": "no.csv"}}, "no.csv: cannot be read (No such file or directory)"),
        ({"trajectory": {"kind": "sampled", "file": "."}}, "Is a directory"),
        ({"trajectory": {**SMALL["trajectory"], "segment_time": 0}}, "trajectory.segment_time (=0): must be a number"),
        ({"trajectory": {**SMALL["trajectory"], "segment_time": 1e-12}}, "the motion lasts no time at all"),
        ({"trajectory": {**SMALL["trajectory"], "segment_time": 1e8}}, "more than 20000000 steps"),
        ({"trajectory": {**SMALL["trajectory"], "segment_time": 1e12}}, "must lie within"),
        (
            {"trajectory": {"waypoints": {"space": "task", "points": [[9, 9, 9]]}, "segment_time": 1}},
            "waypoint 1 (9, 9, 9)",
        ),
        (
            {"trajectory": {"waypoints": {"space": "task", "points": [[0, 0]]}, "segment_time": 1}},
            "must hold 3 numbers",
        ),
        ({**TASK, "arm": "lwa4d_7dof"}, "orientations is missing"),
        (
            {"variants": {"ok": {}, "bad": {"initial": {"q": [0]}}}},
            "x.yaml:19: initial.q of variant 'bad' (=[0]): has 1",
        ),
    ],
)
def test_bad_input_gets_one_line_and_leaves_nothing(
    changes: dict[str, Any], words: str, call: Callable[..., Result]
) -> None:
    Path("motorless.xml").write_text(MOTORLESS)
    Path("broken.xml").write_text("<mujoco")
    Path("empty.xml").touch()
    refused(call("run", write("x.yaml", changes)), words)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "must be a mapping with the keys name, arm"),
        (b"\x89PNG\r\n\x1a\n\xff", "it is not a text file (UTF-8)"),
        (b"name: a\n\tarm: b", "x.yaml:2: not valid YAML: "),
        (b"name: a\nname: b", "x.yaml:2: the key 'name' is given twice"),
        (b"- 1", "must be a mapping with the keys name, arm"),
        (b"[" * 100_000, "nests deeper than 50 levels"),
        (b"a: &a [*a]", "aliases"),
        (b"nmae: a", "nmae (='a'): unknown key; did you mean 'name'?"),
        (b"name: .nan", "name (=.nan): must be a finite number"),
    ],
)
def test_a_file_that_is_no_scenario_gets_one_line(content: bytes, words: str, call: Callable[..., Result]) -> None:
    Path("x.yaml").write_bytes(content)
    refused(call("run", "x.yaml"), words)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "nothere.yaml"], "nothere.yaml: cannot read the scenario: No such file or directory"),
        (["run", "."], "cannot read the scenario: Is a directory"),
        (["run", "x" * 5000], "File name too long"),
        (["run", "x.yaml", "x.yaml"], "two of the scenarios are named 'small'"),
        (["run", "x.yaml", "--set", "kp"], "--set kp: must be KEY=VALUE, e.g. controller.kp=2.0"),
        (["run", "x.yaml", "--set", "=1"], "--set =1: must be KEY=VALUE"),
        (
            ["run", "x.yaml", "--set", "controller.kp=[1"],
            "--set controller.kp: not valid YAML: while parsing a flow seq",
        ),
        (["run", "x.yaml", "--set", "controller.kp=.inf"], "--set controller.kp (=.inf): must be a finite number"),
        (["run", "x.yaml", "--set", "controller.kpp=1"], "controller.kpp (=1, overridden): unknown key; did you mean"),
        (["run", "x.yaml", "--set", "controller.kp.a.b=1"], "'a' cannot be set inside the value 10.0"),
        (["run", "x.yaml", "--set", "loop=3"], "loop (=3, overridden): must be a mapping of kind sampled or ideal"),
        (["run", "x.yaml", "--set", "controller=null"], "controller (=null, overridden): must be a mapping of kind"),
        (["run", "x.yaml", "--set", "trajectory.waypoints.points.7=[0,0,0]"], "'7' must be a position from 0 to 0"),
        (
            ["run", "x.yaml", "--set", "variants.can.loop.period=0.0033"],
            "loop.period of variant 'can' (=0.0033, overri",
        ),
        (["run", "x.yaml", "--set", "name=../x"], "name (='../x', overridden): must be text that can name a file"),
        (["run", "x.yaml", "--set", ".".join(2000 * "a") + "=1"], "has more than 50 levels"),
        (["run", "x.yaml", "-o", "x.yaml"], "x.yaml: cannot write results here: Not a directory"),
        (["run", "x.yaml", "-o", "x.yaml/out"], "x.yaml/out: cannot write results here: Not a directory"),
        (["run", "x.yaml", "-o", "/proc/nothere"], "/proc/nothere: cannot write results here: "),
        (["run", "x.yaml", "-o", "/dev/null"], "/dev/null: cannot write results here: Not a directory"),
        (["run"], "Missing argument 'FILE...'"),
        (["run", "x.yaml", "--no-such"], "No such option: --no-such"),
        (["no-such"], "No such command 'no-such'"),
        (["batch", "x.yaml", "-j", "0"], "Invalid value for '-j'"),
        (["batch", "x.yaml", "-j", "many"], "Invalid value for '-j'"),
        (["batch", "nothere"], "nothere: no such file or folder"),
        (["batch", "empty"], "empty: holds no .yaml file"),
        (["batch", "x.yaml", "--junit", "x.yaml/y.xml"], "x.yaml/y.xml: cannot write this file (Not a directory)"),
        (["batch", "x.yaml", "--junit", "/proc/y.xml"], "/proc/y.xml: cannot write this file"),
        (["batch", "x.yaml", "--junit", "empty"], "empty: cannot write this file (it is a folder)"),
        (["batch", "x.yaml", "y.yaml", "-o", "runs"], "x.yaml and y.yaml are both named 'small'"),
    ],
)
def test_bad_arguments_get_one_line(arguments: list[str], words: str, call: Callable[..., Result]) -> None:
    write("x.yaml")
    write("y.yaml")
    Path("empty").mkdir()
    refused(call(*arguments), words)


def test_a_folder_with_something_else_in_it_is_left_alone(call: Callable[..., Result]) -> None:
    write("x.yaml")
    Path("out/small").mkdir(parents=True)
    Path("out/small/thesis.docx").write_text("years of work")
    refused(call("run", "x.yaml", "--no-plots", "-o", "out"), "out/small: holds 'thesis.docx', which no run wrote")
    assert Path("out/small/thesis.docx").read_text() == "years of work"
    assert [entry.name for entry in Path("out").iterdir()] == ["small"]


def test_a_file_where_the_folder_should_be_is_left_alone(call: Callable[..., Result]) -> None:
    write("x.yaml")
    Path("out").mkdir()
    Path("out/small").write_text("mine")
    refused(call("run", "x.yaml", "--no-plots", "-o", "out"), "cannot write results here: Not a directory")
    assert Path("out/small").read_text() == "mine"


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (
            OSError(28, "No space left on device"),
            2,
            "small: cannot write the results ([Errno 28] No space left on device)",
        ),
        (KeyboardInterrupt(), 130, "interrupted; finished results are kept"),
        (MemoryError(), 2, "out of memory"),
    ],
)
def test_a_failure_while_writing_leaves_the_older_results_whole(
    error: BaseException, code: int, words: str, call: Callable[..., Result], monkeypatch: pytest.MonkeyPatch
) -> None:
    write("x.yaml", variants={"a": {}, "b": {}})
    assert call("run", "x.yaml", "--no-plots").code == 0
    before = {entry.name: entry.read_bytes() for entry in Path("runs/small").iterdir()}
    save = RunLog.save

    def fails(log: RunLog, path: Path) -> None:
        if log.variant == "b":
            path.write_bytes(b"half")
            raise error
        save(log, path)

    monkeypatch.setattr(RunLog, "save", fails)
    result = call("run", "x.yaml", "--no-plots", "--set", "controller.kp=50")
    assert result.code == code
    [line] = result.err.splitlines()
    assert words in line
    assert {entry.name: entry.read_bytes() for entry in Path("runs/small").iterdir()} == before
    assert [entry.name for entry in Path("runs").iterdir()] == ["small"]


def test_a_disk_that_fills_up_in_the_middle_of_a_file_leaves_nothing(
    call: Callable[..., Result], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: Any, *args: Any, **kwargs: Any) -> None:
        raise OSError(28, "No space left on device")

    write("x.yaml")
    monkeypatch.setattr(h5py.Group, "create_dataset", full)
    result = call("run", "x.yaml", "--no-plots", "-o", "out")
    assert result.code == 2
    assert "No space left on device" in result.err
    assert list(Path("out").iterdir()) == []


def test_an_interrupted_simulation_leaves_nothing(call: Callable[..., Result], monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    write("x.yaml")
    monkeypatch.setattr(results, "run_all", interrupted)
    assert call("run", "x.yaml") == Result(130, "", "lwa4d-sim: interrupted; finished results are kept\n")
    assert not Path("runs").exists()


def test_an_error_of_the_program_itself_is_not_dressed_up(call: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any) -> None:
        raise ZeroDivisionError

    write("x.yaml")
    monkeypatch.setattr(results, "run_all", broken)
    monkeypatch.setattr(sys, "argv", ["lwa4d-sim", "run", "x.yaml"])
    with pytest.raises(ZeroDivisionError):
        cli.main()


# ---- batch ----


def test_a_batch_tells_of_every_file_and_exits_with_the_worst(call: Callable[..., Result]) -> None:
    Path("all").mkdir()
    write("all/a.yaml", expect={"default": {"stable": True}})
    assert call("batch", "all").code == 0
    write("all/b.yaml", expect={"default": {"max_error_max": 0.0}})
    result = call("batch", "all", "-j", "1", "--junit", "report.xml")
    assert result.code == 1
    assert "all/b.yaml: default: max_error_max: asked 0.0, found" in result.out
    assert "2 scenarios: 1 passed, 1 failed, 0 error" in result.out
    Path("all/c.yml").write_text("name: [")
    result = call("batch", "all", "-j", "1", "--json")
    assert result.code == 2
    assert result.err.startswith("lwa4d-sim: all/c.yml:")
    assert len(result.err.splitlines()) == 1
    rows = json.loads(result.out)["scenarios"]
    assert [(Path(row["file"]).stem, row["verdict"]) for row in rows] == [
        ("a", "passed"),
        ("b", "failed"),
        ("c", "error"),
    ]
    assert not Path("runs").exists()
    assert Path("report.xml").exists()


def test_as_a_program_it_starts_and_a_closed_pipe_is_no_crash(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = f"{sys.executable} -m lwa4d_sim scenarios | true"
    shell = ["bash", "-o", "pipefail", "-c", command]
    done = subprocess.run(shell, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60)
    assert "Traceback" not in done.stderr
    assert math.isfinite(done.returncode)
