"""The documentation tells the truth: commands and snippets run, links lead somewhere, tables hold what runs show."""

import ast
import json
import os
import re
import runpy
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from lwa4d_sim import metrics
from lwa4d_sim.arm import Arm, load_arm
from lwa4d_sim.bus.stations import LAYOUTS
from lwa4d_sim.interfaces import Array
from lwa4d_sim.runner import run
from lwa4d_sim.scenario import Scenario

ROOT = Path(__file__).parent.parent
PAGES = [
    ROOT / "README.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "docs").glob("*.md")),
    ROOT / "models" / "README.md",
]
README = (ROOT / "README.md").read_text(encoding="utf-8")
TIMING = (ROOT / "docs" / "timing.md").read_text(encoding="utf-8")
VALIDATION = (ROOT / "docs" / "validation.md").read_text(encoding="utf-8")
TUNING = (ROOT / "docs" / "tuning.md").read_text(encoding="utf-8")

# Commands on the pages that are not run here, each with the reason.
NOT_RUN = {
    "make ": "builds an environment, or runs these very tests",
    "pip install ": "changes the environment; tests/test_wheel.py installs what ships",
    "apt-get ": "changes the computer",
    "pytest": "these very tests",
    "lwa4d-sim bus serve": "waits for a master; tests/test_bus_live.py",
    "lwa4d-sim bus drive": "needs somebody who serves; tests/test_bus_live.py",
    "lwa4d-sim bus check": "needs a bus; tests/test_bus_cli.py",
    "lwa4d-sim bus replay": "needs a bus; tests/test_bus_live.py",
    "lwa4d-sim sweep gain_latency": "takes minutes; tests/test_sweep_file.py and tests/test_sweep.py",
    "lwa4d-sim batch scenarios": "tests/test_thesis.py runs the same files",
    "lwa4d-sim run pd_joint_p2.5 --video": "needs OpenGL; tests/test_video.py",
}


def blocks(text: str, language: str) -> list[str]:
    """Fenced blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def commands(text: str) -> Iterator[str]:
    """Lines of the shell blocks that are to be run."""
    for block in blocks(text, "sh"):
        for line in block.splitlines():
            if line and not line.startswith(tuple(NOT_RUN)):
                yield line


def tables(text: str) -> list[list[list[str]]]:
    """Markdown tables as rows of cells, the rule below the heading left out."""
    found = re.findall(r"(?:^\|.*\|\n)+", text, re.MULTILINE)
    split = [[[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()] for table in found]
    return [[row for row in table if set("".join(row)) - set("-: ")] for table in split]


def table(text: str, first: str) -> list[list[str]]:
    """Rows below the heading of the table whose heading begins with ``first``."""
    return next(rows[1:] for rows in tables(text) if rows[0][0] == first)


def call(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run one documented line in ``folder`` as a shell with the installed program would."""
    words = shlex.split(line, comments=True)
    paths = [str(ROOT)]
    while "=" in words[0]:
        name, _, value = words.pop(0).partition("=")
        assert name == "PYTHONPATH"
        paths.append(value)
    assert words[0] == "lwa4d-sim", f"neither run nor listed in NOT_RUN: {line}"
    # -P: an installed program does not look for modules in the folder it is called from
    program = [sys.executable, "-P", "-m", "lwa4d_sim", *words[1:]]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    return subprocess.run(program, cwd=folder, env=environment, capture_output=True, text=True)


@pytest.fixture(scope="module")
def tour(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that the README has the reader write."""
    folder = tmp_path_factory.mktemp("tour")
    for language in ("yaml", "python", "xml"):
        for block in blocks(README, language):
            name = re.match(r"(?:#|<!--) (\w+\.\w+)", block)
            if name:
                (folder / name[1]).write_text(block, encoding="utf-8")
    return folder


@pytest.mark.slow
def test_every_command_of_the_readme_runs(tour: Path) -> None:
    lines = list(commands(README))
    assert len(lines) >= 10
    for line in lines:
        expected = re.search(r"# exit code (\d)", line)
        done = call(line, tour)
        assert done.returncode == (int(expected[1]) if expected else 0), f"{line}\n{done.stdout}\n{done.stderr}"
        assert done.stderr == "", line
    assert (tour / "junit.xml").is_file()
    assert (tour / "comparison.html").is_file()


@pytest.mark.slow
def test_what_the_readme_prints_is_what_is_printed(tour: Path) -> None:
    printed = call("lwa4d-sim run pd_joint_p2.5 -o runs --no-plots", tour).stdout.splitlines()
    shown = blocks(README, "text")[0].splitlines()
    assert printed[: len(shown)] == shown


def test_the_python_of_the_readme_runs(
    tour: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tour)
    for block in blocks(README, "python"):
        exec(block, {})
    printed = capsys.readouterr().out
    assert "10 stable" in printed
    assert "30 unstable" in printed


def test_matlab_names_of_the_readme_exist(tour: Path) -> None:
    assert call("lwa4d-sim run reach.yaml -o runs --no-plots", tour).returncode == 0
    asked = [
        found for block in blocks(README, "matlab") for found in re.findall(r"h5read\('([^']+)', '([^']+)'\)", block)
    ]
    assert asked
    for file, name in asked:
        with h5py.File(tour / file) as record:
            assert name in record


@pytest.mark.slow
def test_what_the_page_of_tuning_prints_is_what_is_printed(tmp_path: Path) -> None:
    done = call(next(commands(TUNING)), tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines() == blocks(TUNING, "text")[0].splitlines()


@pytest.mark.slow
@pytest.mark.parametrize("row", table(TUNING, "`pd_joint_p2.5`, `can`"), ids=lambda row: row[0].strip("`"))
def test_the_table_of_tuned_gains(row: list[str], tmp_path: Path) -> None:
    answer = json.loads(call(f"lwa4d-sim tune pd_joint_p2.5 {row[0].strip('`')} --json", tmp_path).stdout)["after"]
    ran = answer["metrics"]
    millimetres = [1e3 * ran["rms_error"], 1e3 * max(ran["final_error"])]
    shown = [f"{answer['bandwidth']:.3f}", *(f"{x:.2f}" for x in (answer["peak"], *millimetres))]
    assert row[1:] == shown


@pytest.mark.parametrize("name", ["errata", "validation", "benchmarks", "timing", "models", "canopen", "architecture"])
def test_every_command_of_the_pages_is_known(name: str) -> None:
    assert not list(commands((ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")))


def slugs(text: str) -> set[str]:
    """Anchors that GitHub gives the headings."""
    text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    heads = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith("https://"):
            continue
        path, _, anchor = target.partition("#")
        place = (page.parent / path).resolve() if path else page
        assert place.exists(), f"{page.name}: {target}"
        if anchor:
            assert anchor in slugs(place.read_text(encoding="utf-8")), f"{page.name}: {target}"


def test_every_page_is_reached_from_the_readme() -> None:
    seen, todo = set(), [ROOT / "README.md"]
    while todo:
        page = todo.pop()
        if page in seen:
            continue
        seen.add(page)
        targets = re.findall(r"\]\(([^)\s#]+\.md)", page.read_text(encoding="utf-8"))
        todo += [(page.parent / target).resolve() for target in targets]
    assert set(PAGES) <= seen


def test_pictures_are_small_and_shown() -> None:
    pictures = [*(ROOT / "docs" / "images").iterdir(), ROOT / "docs" / "timing.svg"]
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    for picture in pictures:
        assert picture.stat().st_size < 300_000
        assert picture.name in text


def test_tests_and_scenarios_that_the_pages_name_exist() -> None:
    tests = "".join(file.read_text(encoding="utf-8") for file in (ROOT / "tests").glob("test_*.py"))
    shipped = {file.stem for file in (ROOT / "scenarios").glob("*.yaml")}
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for file, name in re.findall(r"(test_\w+\.py)::(test_\w+)", text):
            assert f"def {name}(" in (ROOT / "tests" / file).read_text(encoding="utf-8"), f"{page.name}: {name}"
        for name in re.findall(r"`(test_\w+)`", text):
            assert f"def {name}(" in tests, f"{page.name}: {name}"
        for name in re.findall(r"`((?:pd|ct)7?_(?:joint|task|drivetrain|one)\w*(?:\.\d+\w*)?)`", text):
            assert name in shipped, f"{page.name}: {name}"


def imports(file: Path) -> set[str]:
    """Modules of the package that ``file`` imports when it is itself imported."""
    found = set()
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("lwa4d_sim"):
            module = str(node.module).removeprefix("lwa4d_sim").strip(".")
            found.update([module] if module else [alias.name for alias in node.names])
    return found


def test_the_map_of_the_code_is_complete_and_its_order_is_that_of_the_imports() -> None:
    listed = re.findall(r"`([\w.]+)`", " ".join(row[1] for row in table(README, "layer")))
    package = ROOT / "lwa4d_sim"
    files = {
        ".".join(file.relative_to(package).with_suffix("").parts).removesuffix(".__init__"): file
        for file in package.rglob("*.py")
        if file.parent != package or not file.stem.startswith("__")
    }
    assert sorted(listed) == sorted(files)
    for k, name in enumerate(listed):
        late = imports(files[name]) - set(listed[:k])
        assert not late, f"{name} imports {late}, which the map has behind it"


def test_the_table_of_pdos_is_the_master_s() -> None:
    rows = table((ROOT / "docs" / "canopen.md").read_text(encoding="utf-8"), "PDO")
    for column, layout in (2, LAYOUTS["lwa4d"]), (3, LAYOUTS["cia402"]):
        said = {row[0]: row[2] if row[column] == "the same" else row[column] for row in rows}
        for pdo, items in zip(("RPDO1", "RPDO2", "TPDO1", "TPDO2"), (*layout.receive, *layout.transmit), strict=True):
            found = re.findall(r"([0-9A-F]{4})(?::(\d))?/(\d+)", said[pdo])
            assert [(int(index, 16), int(sub or 0), int(bits)) for index, sub, bits in found] == [
                item[:3] for item in items
            ]


def test_the_table_of_benchmarks_is_that_of_the_program() -> None:
    rows = table((ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8"), "what")
    shown = [(row[0].replace("`", ""), float(row[1])) for row in rows]
    program = runpy.run_path(str(ROOT / "benchmarks" / "__main__.py"))
    assert shown == [(what, limit) for _, what, limit in program["BENCHMARKS"].values()]


def test_thresholds_of_the_verdict_are_those_of_the_code() -> None:
    section = VALIDATION.split("## What `stable` means")[1].split("\n## ")[0]
    assert f"cubic fitted over {metrics.SMOOTH_WINDOW:g} s" in section
    assert f"above {metrics.VIBRATION_FLOOR:g} rad/s" in section
    assert metrics.VIBRATION_SHARE == 0.1
    assert "above a tenth of the joint's rms speed" in section
    assert f"more than {metrics.DECAY:g} times" in section
    assert f"above {metrics.VIBRATION_LIMIT:g} rad/s in any case" in section
    assert f"faster than {metrics.RUNAWAY:g} rad/s" in section


# timing.md ----------------------------------------------------------------------------------------------------------

QUANTUM = 2.0**-20  # [N m] torque of the marker's first call, tiny, so that the arm hardly moves
MARKER = f"""
class Marker:
    def __init__(self):
        self.calls = 0

    def torque(self, state, ref, model):
        self.calls += 1
        return 0 * state.q + self.calls * {QUANTUM!r}
"""


@pytest.mark.parametrize("row", table(TIMING, "measurement latency"), ids=" ".join)
def test_the_table_of_delays(row: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "documented_marker.py").write_text(MARKER)
    monkeypatch.syspath_prepend(tmp_path)
    up, down, actuation = float(row[0]), float(row[1]), row[2]
    computed, age, acts = map(int, row[3:])
    document = {
        "name": "delays",
        "arm": "lwa4d_3dof",
        "initial": {"q": [0, -1, 1]},
        "plant": {"gravity": [0, 0, 0]},
        "trajectory": {"waypoints": {"space": "joint", "points": [[0, -1, 1]]}, "segment_time": 0.1},
        "controller": {"kind": "documented_marker:Marker"},
        "loop": {
            "latency": {"measurement": up / 1e3, "command": down / 1e3},
            "actuation": actuation,
            "velocity": {"kind": "true"},
        },
    }
    log = run(Scenario.parse(json.dumps(document)))
    first = int(np.flatnonzero(~np.isnan(log.ticks.age))[0])
    sample = round(1e3 * (log.ticks.t[first] - log.ticks.age[first]))  # [ms]
    assert round(1e3 * log.ticks.t[first]) - sample == computed
    assert round(1e3 * log.ticks.age[first]) == age
    assert int(np.argmax(log.tau[:, 0] == QUANTUM)) - sample == acts


# validation.md ------------------------------------------------------------------------------------------------------

WAYPOINTS = np.array([[-0.5, -0.3, 0.6], [-0.5, -0.3, 0.05], [0.5, -0.4, 0.05], [0.5, -0.4, 0.6]])
PERIOD = T_F = 0.01  # [s]


def spectral_radius(arm: Arm, q: Array, p: float, runs_on: str, actuation: str) -> float:
    """Largest eigenvalue over one period of PD+G (kp = p, kd = 5/3 p) with its filter, linearised at rest at ``q``.

    The state is e = q - q_ref, de and the filter's two lags y1, y2; the inputs, held over a period, are torque and e.
    """
    unit, none, h = np.eye(3), np.zeros((3, 3)), 1e-6
    inverse = np.linalg.inv(arm.dynamics.M(q))
    slope = np.stack([(arm.dynamics.g(q + h * d) - arm.dynamics.g(q - h * d)) / (2 * h) for d in unit], axis=1)
    before, behind = (unit / T_F, none) if runs_on == "continuous" else (none, unit / T_F)
    A = np.block(
        [
            [none, unit, none, none],
            [-inverse @ slope, none, none, none],
            [before, none, -unit / T_F, none],
            [none, none, unit / T_F, -unit / T_F],
        ]
    )
    B = np.block([[none, none], [inverse, none], [none, behind], [none, none]])
    exact = expm(PERIOD * np.block([[A, B], [np.zeros((6, 18))]]))
    F, torque, held = exact[:12, :12], exact[:12, 12:15], exact[:12, 15:]
    kd = 5 / 3 * p
    law = np.hstack([slope - p * unit, none, -kd / T_F * unit, kd / T_F * unit])  # speed (y1 - y2) / T_F
    F = F + held @ np.eye(3, 12)
    F = np.block([[F, torque], [law, none]]) if actuation == "next_sync" else F + torque @ law
    return float(np.abs(np.linalg.eigvals(F)).max())


@pytest.mark.parametrize("row", table(VALIDATION, "arm"), ids=lambda row: " ".join(row[:3]))
def test_gain_limits_by_eigenvalues(row: list[str]) -> None:
    arm = load_arm(row[0].strip("`"))
    poses = arm.kinematics.ik(WAYPOINTS, elbow="up")
    found = [brentq(lambda p: spectral_radius(arm, q, p, row[1], row[2]) - 1, 0.2, 12) for q in poses]  # noqa: B023
    np.testing.assert_allclose([float(cell) for cell in row[3:]], found, atol=6e-4)
