"""The shape of the package: who may import whom, which library lives where, and what importing must not do."""

import ast
import json
import statistics
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "lwa4d_sim"

# A module imports only from rows above its own. Modules of one row do not know each other.
ROWS = (
    # words
    "errors interfaces",
    # the arm on paper
    "rotations polynomials newton dh joint_friction",
    "chain",
    "inverse dynamics",
    "kinematics arm mjcf_checks edits",
    "mjcf",
    # blocks
    "motion_files motions delays controllers.gains controllers.belief",
    "controllers.task fourier",
    "controllers.shaping",
    "controllers.pd_gravity controllers.computed_torque controllers.custom",
    "trajectories references estimators channels drives plant controllers forecast",
    "observers",
    "compensation",
    # the bus: a CAN controller and its wire, a CANopen node, a CiA 402 drive, and the master
    "bus bus.options bus.frames bus.transmission bus.entry bus.objects bus.mapping bus.device "
    "bus.cia402 bus.motion bus.brake bus.client bus.process bus.candump",
    "bus.confinement bus.response bus.sheet bus.sdo bus.alarms bus.connect bus.fault_options",
    "bus.dictionary",
    "bus.port bus.emergency bus.error_control bus.pdo_rules bus.sync bus.axis bus.joints bus.safety bus.stations",
    "bus.disturbances bus.access bus.pdo bus.gauges bus.mode bus.servo bus.supervision bus.tamper bus.watch",
    "bus.medium bus.node bus.homing bus.position_modes bus.speed_modes bus.torque_modes bus.master",
    "bus.wire bus.steering bus.commission bus.session bus.survey",
    "bus.checks bus.drive",
    "bus.arm bus.differences",
    "bus.serve",
    # loop
    "loop",
    # evidence
    "metrics frame_log",
    "record expect bus.frame_files",
    "recorder",
    "bus.simulation",
    "bus.faults",
    # composition
    "documents",
    "recordings recordings.reading identification",
    "identification.options",
    "settings yaml_text",
    "schema lockstep",
    "lateness",
    "scenario",
    "scenario_file assembly",
    "bus.build",
    "bus.live_run runner",
    # how far from shaking
    "stability stability.filters stability.linear stability.margins stability.assist stability.points",
    "stability.loops",
    "stability.sampled",
    "stability.jitter stability.instants stability.tracking",
    "stability.study",
    "stability.motion stability.maps stability.analysis stability.boundary",
    "tuning",
    "tuned_file",
    # what an experiment left behind
    "recordings.recording recordings.pdo_log",
    "recordings.plausible recordings.beats",
    "recordings.table_file recordings.can_cycles",
    "recordings.can_log",
    "recordings.run_data",
    # what it tells of the arm
    "identification.inertia identification.regressor identification.friction identification.smooth",
    "identification.parameters identification.estimate identification.consistent",
    "identification.base identification.equations identification.model_file",
    "identification.sets identification.noise identification.slack",
    "identification.problem identification.shooting identification.adjustable",
    "identification.study",
    "identification.experiment identification.refine",
    "identification.findings identification.sources",
    # a motion that tells much
    "excitation excitation.clearance excitation.information",
    "excitation.limits",
    "excitation.search",
    "excitation.design",
    "excitation.written",
    # where the tool really is
    "calibration calibration.error_model calibration.exact_xml",
    "calibration.measured calibration.identifiable",
    "calibration.fit calibration.poses calibration.pose_files calibration.arm_file",
    "calibration.study",
    # work
    "verdict folders page stability.guides identification.grades",
    "drawing video stability.findings identification.words",
    "plots bus_timing stability.words stability.tables calibration.words calibration.plots "
    "identification.parameter_plots",
    "bus_plots stability.plots identification.plots",
    "report stability.map_plot stability.report identification.report",
    "results stability.folder calibration.folder identification.folder",
    "batch",
    "sweep sweep.design sweep.work sweep.statistics",
    "sweep.file sweep.workers sweep.plots",
    "sweep.cluster sweep.table sweep.tasks",
    "sweep.search",
    "sweep.folder",
    "sweep.summary sweep.report sweep.theory",
    "console",
    "bus_tables sweep_cli stability_cli tune_cli excite_cli identify_cli calibrate_cli",
    "bus_cli",
    "cli",
    "__main__",
)

# Families of blocks. A block knows the arm on paper and the words, and no block of another family.
BLOCKS = {
    "trajectories": ("motion_files", "motions", "fourier", "trajectories"),
    "references": ("references",),
    "estimators": ("estimators", "forecast", "observers", "compensation"),
    "channels": ("delays", "channels"),
    "drives": ("drives",),
    "plant": ("plant",),
    "controllers": ("controllers", "controllers."),
    "bus": ("bus", "bus."),
}

# Imports inside functions that go up the rows, and why.
UPWARD = {
    "arm": {"dynamics", "kinematics", "mjcf"},  # the public name load_arm stands beside the numbers it loads
}

# Where each library is known. NumPy and annotated_types (rules on numbers) may be used anywhere.
LIBRARIES = {
    "mujoco": {
        "assembly",
        "calibration.arm_file",
        "calibration.exact_xml",
        "dynamics",
        "excitation.clearance",
        "identification.adjustable",
        "identification.inertia",
        "identification.refine",
        "mjcf",
        "mjcf_checks",
        "plant",
        "video",
    },
    "scipy": {
        "calibration.fit",
        "calibration.words",
        "estimators",
        "excitation.search",
        "identification.consistent",
        "identification.equations",
        "identification.noise",
        "identification.refine",
        "identification.smooth",
        "recordings.beats",
        "stability.assist",
        "stability.boundary",
        "stability.jitter",
        "stability.loops",
        "stability.sampled",
        "stability.tracking",
        "sweep.design",
        "sweep.search",
        "trajectories",
        "tuning",
    },
    "clarabel": {"identification.consistent"},
    "pydantic": {"schema"},
    "pydantic_core": {"schema"},
    "yaml": {"yaml_text"},
    "h5py": {"record"},
    "pyarrow": {"recordings.table_file", "sweep.table"},
    "distributed": {"sweep.cluster"},
    "matplotlib": {
        "bus_plots",
        "calibration.plots",
        "drawing",
        "identification.parameter_plots",
        "identification.plots",
        "plots",
        "stability.map_plot",
        "stability.plots",
        "sweep.plots",
    },
    "PIL": {"plots", "video"},
    "imageio": {"video"},
    "jinja2": {"page"},
    "typer": {
        "bus_cli",
        "calibrate_cli",
        "cli",
        "console",
        "excite_cli",
        "identify_cli",
        "stability_cli",
        "sweep_cli",
        "tune_cli",
    },
    "rich": {"bus_tables", "cli", "console", "identify_cli", "stability_cli"},
}
ANYWHERE = {"numpy", "annotated_types"}
BUS_ONLY = {"can", "canopen"}
LONGEST = 300  # lines of a module

MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}


@dataclass(frozen=True)
class Import:
    """One module imported by another: full name, and whether at load, inside a function or for types only."""

    name: str
    late: bool
    typing: bool


def imports(path: Path) -> Iterator[Import]:
    """Every import in a file; `from a import b` names a.b where that is a module, else a."""

    def visit(node: ast.AST, late: bool, typing: bool) -> Iterator[Import]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                yield from (Import(alias.name, late, typing) for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                assert child.level == 0, f"{path}: relative import"
                for alias in child.names:
                    inner = f"{child.module}.{alias.name}"
                    is_module = inner.removeprefix("lwa4d_sim.") in MODULES
                    yield Import(inner if is_module else str(child.module), late, typing)
            in_function = isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
            for_types = isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)
            yield from visit(child, late or in_function, typing or for_types)

    yield from visit(ast.parse(path.read_text(encoding="utf-8")), False, False)


def ours(module: str) -> list[tuple[str, bool]]:
    """(module of this package, late) that a module imports when it runs."""
    found = [one for one in imports(MODULES[module]) if one.name.startswith("lwa4d_sim.") and not one.typing]
    return [(one.name.removeprefix("lwa4d_sim."), one.late) for one in found]


def row(module: str) -> int:
    return next(i for i, names in enumerate(ROWS) if module in names.split())


def test_every_module_has_a_row_and_every_row_its_modules() -> None:
    listed = [name for names in ROWS for name in names.split()]
    assert sorted(listed) == sorted(MODULES.keys() - {"__init__"})


@pytest.mark.parametrize("module", sorted(MODULES.keys() - {"__init__"}))
def test_a_module_imports_only_from_rows_above(module: str) -> None:
    for other, late in ours(module):
        if not (late and other in UPWARD.get(module, ())):
            assert row(other) < row(module), f"{module} imports {other}"


def test_the_exceptions_are_needed() -> None:
    for module, others in UPWARD.items():
        assert {other for other, late in ours(module) if late and row(other) >= row(module)} <= others
        assert others <= {other for other, late in ours(module) if late}


def test_nothing_is_imported_in_a_circle_at_load() -> None:
    """Follows from the rows; this is the other road, without them."""
    done: set[str] = set()

    def follow(module: str, above: tuple[str, ...]) -> None:
        assert module not in above, " -> ".join([*above, module])
        if module not in done:
            for other, late in ours(module):
                # importing a submodule loads its package first, unless it is being loaded already
                package = other.rpartition(".")[0]
                for loaded in (other, package) if package and package not in (*above, module) else (other,):
                    if not late:
                        follow(loaded, (*above, module))
            done.add(module)

    for module in MODULES:
        follow(module, ())


def family(module: str) -> str | None:
    for name, members in BLOCKS.items():
        if module in members or any(member.endswith(".") and module.startswith(member) for member in members):
            return name
    return None


def test_no_block_imports_another() -> None:
    for module in MODULES:
        mine = family(module)
        if mine is not None:
            for other, _ in ours(module):
                assert family(other) in (None, mine), f"{module} imports {other}"


def test_every_family_of_blocks_exists() -> None:
    assert {family(module) for module in MODULES} == {*BLOCKS, None}


def test_the_loop_knows_nothing_but_the_words() -> None:
    assert {name for name, _ in ours("loop")} == {"interfaces"}


def test_only_the_command_line_is_above_the_work_and_nobody_imports_it() -> None:
    importers = {module for module in MODULES for other, _ in ours(module) if other == "cli"}
    assert importers == {"__main__"}


def test_a_library_is_imported_where_the_table_says() -> None:
    found: dict[str, set[str]] = {}
    for module, path in MODULES.items():
        for one in imports(path):
            top = one.name.split(".")[0]
            if top not in sys.stdlib_module_names and top != "lwa4d_sim" and not one.typing:
                found.setdefault(top, set()).add(module)
    for library in BUS_ONLY:
        assert all(module.startswith("bus.") for module in found.pop(library)), library
    assert {library: where for library, where in found.items() if library not in ANYWHERE} == LIBRARIES


@pytest.mark.parametrize(
    "library", ["scipy", "h5py", "imageio", "jinja2", "rich", "PIL", "pyarrow", "distributed", "clarabel"]
)
def test_what_is_slow_to_import_and_seldom_needed_is_imported_in_functions(library: str) -> None:
    for path in MODULES.values():
        for one in imports(path):
            assert one.late or one.name.split(".")[0] != library, f"{path} imports {library} at load"


@pytest.mark.parametrize("module", MODULES)
def test_a_module_says_in_one_line_why_it_exists_and_is_not_too_long(module: str) -> None:
    text = MODULES[module].read_text(encoding="utf-8")
    first = (ast.get_docstring(ast.parse(text)) or "").splitlines()
    assert first, "no docstring"
    assert first[0].endswith((".", "'s.")), first[0]
    assert len(text.splitlines()) <= LONGEST


def test_modules_are_short_as_a_rule() -> None:
    assert statistics.median(len(path.read_text().splitlines()) for path in MODULES.values()) <= 160


def test_nothing_is_printed_but_by_the_command_line() -> None:
    for module, path in MODULES.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("print", "input"):
                assert module in (*LIBRARIES["typer"], "console")


def test_no_name_means_two_things() -> None:
    """`qd` is a speed to some and a desired position to others; `tau` is a torque and never a delay."""
    for path in [*MODULES.values(), *(ROOT / "tests").glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [getattr(node, field, None) for field in ("id", "arg", "attr", "name")]
            assert not {"qd", "qdd", "q_d", "tau_delay"} & set(map(str, names)), path


def python(code: str, *arguments: str, cwd: Path = ROOT) -> str:
    """Run code in a fresh interpreter; what it prints."""
    command = [
        sys.executable,
        "-W",
        "error",
        "-c",
        f"import sys; sys.path.insert(0, {str(ROOT)!r})\n{code}",
        *arguments,
    ]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


def test_importing_the_package_imports_nothing_else() -> None:
    loaded = json.loads(python("import lwa4d_sim, json; print(json.dumps([m.split('.')[0] for m in sys.modules]))"))
    assert not {"numpy", *LIBRARIES} & set(loaded)


def test_importing_every_module_says_nothing_and_writes_nothing(tmp_path: Path) -> None:
    names = [f"lwa4d_sim.{module}" for module in MODULES if module != "__init__"]
    code = f"import importlib, threading\nfor name in {names}: importlib.import_module(name)\n"
    code += "assert threading.active_count() == 1\nimport multiprocessing\nassert not multiprocessing.active_children()"
    assert python(code, cwd=tmp_path) == ""
    assert list(tmp_path.iterdir()) == []


CALL = """
import json
from lwa4d_sim.cli import main
try:
    main()
except SystemExit as end:
    assert not end.code, end.code
print(json.dumps(sorted({m.split('.')[0] for m in sys.modules})))
"""

SCENARIO = """
name: x
arm: lwa4d_3dof
trajectory: {waypoints: {space: joint, points: [[-1.5, -1.5, 1.5]]}, segment_time: 0.1}
controller: {kind: pd_gravity, kp: 10, kd: 5}
variants: {ideal: {loop: {kind: ideal}}, can: {}}
"""


@pytest.mark.parametrize(
    ("arguments", "absent"),
    [
        (["run", "x.yaml", "--no-plots"], {"scipy", "matplotlib", "PIL", "imageio", "jinja2", "rich", "pandas"}),
        (["--help"], {"scipy", "matplotlib", "PIL", "imageio", "jinja2", "mujoco", "numpy", "h5py"}),
        (["schema"], {"scipy", "matplotlib", "PIL", "imageio", "jinja2", "h5py"}),
        (["scenarios"], {"scipy", "matplotlib", "PIL", "imageio", "jinja2", "mujoco", "h5py"}),
    ],
)
def test_a_command_loads_only_what_it_needs(arguments: list[str], absent: set[str], tmp_path: Path) -> None:
    (tmp_path / "x.yaml").write_text(SCENARIO)
    loaded = set(json.loads(python(CALL, *arguments, cwd=tmp_path).splitlines()[-1]))
    assert "lwa4d_sim" in loaded
    assert not absent & loaded
