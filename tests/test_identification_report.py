"""What an identification leaves behind: words, pictures, page, numbers, parameters and model agree and are whole."""

import csv
import html
import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from planar_rig import THESIS_MOTION
from scipy.stats import chi2

from lwa4d_sim import Scenario
from lwa4d_sim.errors import IdentificationError, LwaError, ScenarioError
from lwa4d_sim.identification.experiment import Experiment
from lwa4d_sim.identification.findings import Findings, identify
from lwa4d_sim.identification.folder import as_object, claim_for, data_hash, record, write_findings
from lwa4d_sim.identification.grades import LOST, WEAK, WELL, grades, sizes
from lwa4d_sim.identification.inertia import from_pseudo_inertia, standard_parameters
from lwa4d_sim.identification.model_file import write_model
from lwa4d_sim.identification.options import Identify
from lwa4d_sim.identification.parameter_plots import WRONG, draw_parameters
from lwa4d_sim.identification.plots import draw_motions
from lwa4d_sim.identification.problem import Problem
from lwa4d_sim.identification.refine import Refined
from lwa4d_sim.identification.report import digits, write_identification_page
from lwa4d_sim.identification.words import details, headline, listed, meaning, percent, sound
from lwa4d_sim.mjcf import load_model, model_path
from lwa4d_sim.page import NONE
from lwa4d_sim.recordings.recording import Recording
from lwa4d_sim.yaml_text import parse

TEXT = (
    """
# <script>alert("not me")</script>
name: small
"""
    + THESIS_MOTION
    + """  duration: 4.0
controller: {kind: pd_gravity, space: joint, kp: 30.0, kd: 5.0, model: {gravity: [0.0, 0.0, 0.0]}}
loop: {kind: ideal}
identify:
  parameters: thesis
  joints: []
  nominal: {mass_scale: 1.2}
"""
)
TRIED = """  noise: {torque: 0.05, position: 1.0e-5, seed: 3}
  control: {kind: computed_torque, space: joint, p: 10.0}
  validation:
    kind: fourier
    a: [[0.064, -0.335, 0.451, 0.292, 0.523], [0.156, -0.478, 0.078, -0.388, -0.070]]
    b: [[0.125, -0.292, 0.369, -0.557, -0.482], [-0.088, -0.253, 0.207, -0.549, -0.150]]
    duration: 2.0
"""


@dataclass(frozen=True)
class Written:
    """Findings, the model that they came with, and the folder that was written."""

    found: Findings
    model: Path
    folder: Path

    @property
    def page(self) -> str:
        return (self.folder / "report.html").read_text(encoding="utf-8")

    @property
    def record(self) -> Any:
        def refuse(word: str) -> Any:
            raise AssertionError(f"{word} is no JSON")

        return json.loads((self.folder / "identification.json").read_text(), parse_constant=refuse)


def written(place: Path, text: str, **options: Any) -> Written:
    scenario = Scenario.parse(text, source="small.yaml")
    model = place / "scratch" / "deep" / "identified.xml"
    found = identify(Experiment.of(scenario, None), model, **options)
    folder = claim_for(scenario, place / "out")
    write_findings(folder, found, model, data=["--data", "my log.csv"] if found.truth is None else [])
    return Written(found, model, folder)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Written:
    return written(tmp_path_factory.mktemp("simulated"), TEXT + TRIED, repeats=2)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Written:
    """Data of an arm whose second joint stood still, so that p1, p2 and p3 cannot be told apart."""
    return written(tmp_path_factory.mktemp("measured"), TEXT, data=(one_joint(), None))


def one_joint() -> Recording:
    model = load_model("lwa4d_planar")
    data = mujoco.MjData(model)
    t = np.arange(0.0, 5.0, 0.01)
    q, dq, ddq = np.zeros((3, len(t), 2))
    q[:, 0], dq[:, 0], ddq[:, 0] = np.sin(2 * t), 2 * np.cos(2 * t), -4 * np.sin(2 * t)
    tau = np.empty_like(q)
    for k in range(len(t)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], dq[k], ddq[k]
        mujoco.mj_inverse(model, data)
        tau[k] = data.qfrc_inverse
    both = np.repeat(t[:, None], 2, axis=1)
    # a torque that is held around its instant stands for the smooth one
    return Recording(
        joints=("joint2", "joint4"), t=both, q=q, since=both - 0.005, tau=tau, position_step=np.zeros(2),
        torque_step=np.zeros(2), end=float(t[-1]) + 0.005, source="my log.csv",
    )  # fmt: skip


def visible(page: str) -> str:
    """What a reader sees of a page."""
    return html.unescape(re.sub(r"<[^>]*>", " ", re.sub(r"<style>.*?</style>", "", page, flags=re.S)))


def test_the_page_needs_nothing_else_and_shows_every_picture(simulated: Written) -> None:
    pictures = sorted(simulated.folder.glob("*.png"))
    assert {path.stem for path in pictures} == {
        "estimation", "parameters", "ellipses", "bias", "torque", "control", "excitation", "remainder"
    }  # fmt: skip
    sources = re.findall(r'(?:src|href)="([^"]*)"', simulated.page)
    assert all(source.startswith("data:") for source in sources)
    assert sum(source.startswith("data:image/png;base64,") for source in sources) == len(pictures)
    assert all(path.stat().st_size < 300_000 for path in pictures)
    for text in (*headline(simulated.found), *details(simulated.found)):
        assert text in visible(simulated.page)
    assert "nan" not in re.sub(r'data:image[^"]*', "", simulated.page).lower().replace("nominal", "")


def test_what_others_wrote_is_text_on_the_page(simulated: Written, tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_identification_page(path, replace(simulated.found, remarks=("<img src=x> & co",)), [])
    page = path.read_text()
    assert "<script" not in page
    assert "&lt;script&gt;" in page
    assert "&lt;img src=x&gt; &amp; co." in page


def test_the_record_holds_what_was_found(simulated: Written) -> None:
    found, data = simulated.found, simulated.record
    assert {key: data[key] for key in as_object(found)} == as_object(found)
    rows = data["parameters"].values()
    assert list(data["parameters"]) == ["p1", "p2", "p3", "p4", "p5"]
    assert [row["estimate"] for row in rows] == found.fit.estimate.x.tolist()
    assert [row["truth"] for row in rows] == pytest.approx([0.566435, 0.161481, 0.260432, 20.593152, 7.78914], rel=1e-6)
    # two roads to an interval: the table's, and the covariance's diagonal with the normal distribution's quantile
    for row, variance in zip(rows, np.diag(data["covariance"]), strict=True):
        low, high = row["interval"]
        assert (low + high) / 2 == pytest.approx(row["estimate"])
        assert (high - low) / 2 == pytest.approx(1.96 * variance**0.5, rel=1e-3)
    assert set(data["bias"]) == set(found.bias)
    assert data["coverage"].keys() == data["parameters"].keys()
    assert data["repeats"] == 2
    assert data["tried"].keys() == {"nominal", "identified"}
    assert data["lost"] == []
    assert data["command"] == "lwa4d-sim identify small.yaml --variant default --repeats 2"
    assert data["command"] in html.unescape(simulated.page)


def test_the_data_have_a_fingerprint(simulated: Written) -> None:
    recording = simulated.found.recording
    q = recording.q.copy()
    q[7, 1] = np.nextafter(q[7, 1], 1.0)
    assert simulated.record["data"]["sha256"] == data_hash(replace(recording, q=recording.q.copy()))
    assert data_hash(replace(recording, q=q)) != data_hash(recording)


def test_parameter_file_and_model_agree(simulated: Written) -> None:
    document, _ = parse((simulated.folder / "parameters.yaml").read_text(), "parameters.yaml")
    assert document["parameters"] == simulated.record["parameters"]
    model = load_model(str(simulated.folder / "identified.xml"))
    stated = [row["value"] for row in document["model"].values()]
    assert standard_parameters(model).ravel() == pytest.approx(np.array(stated[:20]), rel=1e-9, abs=1e-12)
    # p5 = g m2 lc3 of what MuJoCo reads back
    assert document["parameters"]["p5"]["model"] == pytest.approx(9.81 * standard_parameters(model)[1, 3], rel=1e-9)


def test_the_torques_give_the_stated_errors(simulated: Written) -> None:
    with (simulated.folder / "torque.csv").open() as file:
        heading, *rows = csv.reader(file)
    values = np.array(rows, float)
    columns = {name: values[:, k] for k, name in enumerate(heading)}
    for name, key in (("estimate", "nrmse"), ("identified", "model"), ("nominal", "nominal")):
        for joint, stated in zip(("joint2", "joint4"), simulated.record["validation"][key], strict=True):
            measured = columns[f"{joint} measured [N m]"]
            wrong = measured - columns[f"{joint} {name} [N m]"]
            assert np.sqrt(np.mean(wrong**2)) / measured.std() == pytest.approx(stated, rel=1e-3)


def test_a_model_with_meshes_finds_them_from_its_new_place(simulated: Written, tmp_path: Path) -> None:
    arm = tmp_path / "arm" / "arm.xml"
    (arm.parent / "meshes").mkdir(parents=True)
    (arm.parent / "meshes" / "t.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    text = model_path("lwa4d_planar").read_text()
    text = text.replace("</asset>", '<mesh name="t" file="meshes/t.obj" scale="0.1 0.1 0.1"/></asset>', 1)
    arm.write_text(text.replace("<worldbody>", '<worldbody><geom type="mesh" mesh="t"/>', 1))
    assert "mesh=" in arm.read_text()
    pi = simulated.found.identified[:20].reshape(2, 10)
    zero = np.zeros(2)
    write_model(arm, tmp_path / "a" / "b" / "m.xml", pi=pi, armature=zero, viscous=zero, coulomb=zero, about="test")
    write_findings(tmp_path / "out" / "x-identify", simulated.found, tmp_path / "a" / "b" / "m.xml", plots=False)
    assert load_model(str(tmp_path / "out" / "x-identify" / "identified.xml")).nmesh == 1


def drawn(found: Findings, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Figure]:
    """The figures themselves, by the name of their file."""
    made = {}
    with monkeypatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda figure, path, **_: made.update({path.stem: figure}))
        draw_parameters(found, folder)
        draw_motions(found, folder)
    return made


def test_pictures_show_the_numbers(simulated: Written, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = simulated.found
    assert found.truth is not None
    x, s = found.fit.estimate.x, found.fit.std_error
    truth = found.truth.copy()
    truth[2] = x[2] + 3.0 * s[2]  # outside
    truth[[0, 1, 3, 4]] = x[[0, 1, 3, 4]] + 0.5 * s[[0, 1, 3, 4]]
    found = replace(found, truth=truth)
    figures = drawn(found, tmp_path, monkeypatch)

    bars = figures["parameters"].axes[0]
    size = np.abs(found.problem.value(found.problem.nominal))
    widths = [patch.get_width() for patch in bars.patches if isinstance(patch, Rectangle)]
    assert widths == pytest.approx(100 * 1.96 * s / size, rel=1e-3)
    [outside] = [line for line in bars.lines if line.get_color() == WRONG]
    assert np.asarray(outside.get_ydata()).tolist() == [2]
    assert np.asarray(outside.get_xdata()) == pytest.approx(100 * 3 * s[2] / size[2])

    course = next(ax for ax in figures["estimation"].axes if ax.get_title(loc="left").startswith("C"))
    assert [float(np.asarray(line.get_ydata())[-1]) for line in course.lines[:5]] == pytest.approx(x / truth, rel=1e-6)

    wrong = figures["torque"].axes[1].lines[0]
    v = found.validation
    assert np.asarray(wrong.get_ydata()) == pytest.approx(v.torque[:, 0] - v.predictions["estimate"][:, 0])


def test_an_ellipse_is_where_the_covariance_says(
    simulated: Written, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = simulated.found
    figures = drawn(found, tmp_path, monkeypatch)
    axes = [ax for ax in figures["ellipses"].axes if ax.lines]
    correlation = found.fit.covariance / np.outer(found.fit.std_error, found.fit.std_error)
    strongest = np.sort(np.abs(correlation[np.triu_indices(5, 1)]))[::-1][: len(axes)]
    for ax, expected in zip(axes, strongest, strict=True):
        names, units = zip(*(text.split(" ", 1) for text in (ax.get_xlabel(), ax.get_ylabel())), strict=True)
        power = [int(m[1]) if (m := re.search(r"\^\{(-?\d+)\}", unit)) else 0 for unit in units]
        i, j = (found.problem.parameters.names.index(name) for name in names)
        assert abs(correlation[i, j]) == pytest.approx(expected)
        points = np.array(ax.lines[0].get_data()).T * 10.0 ** np.array(power)
        C = found.fit.covariance[np.ix_([i, j], [i, j])]
        distance = np.einsum("ki,ij,kj->k", points, np.linalg.inv(C), points)
        assert distance == pytest.approx(np.full(len(points), chi2.ppf(0.95, 2)), rel=1e-6)


def test_without_plots_there_are_numbers_only(simulated: Written, tmp_path: Path) -> None:
    write_findings(tmp_path / "x", simulated.found, simulated.model, plots=False)
    assert {path.name for path in (tmp_path / "x").iterdir()} == {
        "identification.json", "parameters.yaml", "identified.xml", "torque.csv"
    }  # fmt: skip


def test_what_the_data_do_not_tell_is_a_dash_and_no_number(measured: Written) -> None:
    data = measured.record
    assert data["lost"] == ["p1", "p2", "p3"]
    for name in data["lost"]:
        row = data["parameters"][name]
        assert (row["estimate"], row["std_error"], row["interval"], row["told"]) == (None, None, None, LOST)
        cells = re.search(rf"<tr><th>{name}<br>.*?</tr>", measured.page, flags=re.S)
        assert cells is not None
        assert cells[0].count(f">{NONE}<") == 3
    assert all(row["truth"] is None for row in data["parameters"].values())
    assert data["covariance"][0] == [None] * 5
    assert any(text.startswith("The data do not tell p1, p2 and p3:") for text in details(measured.found))
    assert not sound(measured.found)
    assert "with reservations" in visible(measured.page)
    assert "nan" not in re.sub(r'data:image[^"]*', "", measured.page).lower().replace("nominal", "")


def test_what_is_told_beside_is_right(measured: Written) -> None:
    rows = measured.record["parameters"]
    assert rows["p4"]["estimate"] == pytest.approx(20.593152, rel=1e-3)
    assert rows["p5"]["estimate"] == pytest.approx(7.78914, rel=1e-3)


def test_of_a_real_arm_no_truth_is_shown(measured: Written) -> None:
    page = visible(measured.page)
    assert "Truth" not in page
    assert "A: the motion that was asked for" not in page
    assert "B: the joint angles" in page
    assert "worst with a 95 % interval of" in headline(measured.found)[0]
    assert not any("hold the truth" in text for text in details(measured.found))
    assert measured.record["command"].endswith("--data 'my log.csv'")
    assert (measured.record["coverage"], measured.record["tried"]) == (None, None)
    assert not (measured.folder / "control.png").exists()


def test_intervals_that_miss_the_truth_are_called_out(simulated: Written) -> None:
    found = simulated.found
    assert found.truth is not None
    far = replace(found, truth=found.truth * 1.5)
    assert headline(far)[0].startswith("The estimate is not to be trusted: only 0 of 5 ")
    assert not sound(far)
    honest = replace(found, truth=found.fit.estimate.x)
    assert headline(honest)[0].startswith("All 5 parameters are well told by 4 s of motion, each to 0.001 %")
    assert sound(honest)
    worse = {**found.validation.nrmse, "estimate": found.validation.nrmse["nominal"] * 2}
    assert not sound(replace(honest, validation=replace(found.validation, nrmse=worse)))


def test_a_parameter_told_weakly_is_named(simulated: Written) -> None:
    found = simulated.found
    covariance = found.fit.covariance.copy()
    covariance[1, 1] = 1.0  # p2 is 0.16
    weak = replace(found, fit=replace(found.fit, covariance=covariance))
    assert grades(weak).told == (WELL, WEAK, WELL, WELL, WELL)
    assert "The data tell p2 only weakly: the 95 % interval is wider than such a parameter is large." in details(weak)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ((0.2, True), (0.1, True), "2 times less than with the nominal one (200 mrad)"),
        ((0.1, True), (0.2, True), "no less than with the nominal one (100 mrad)"),
        ((0.2, False), (0.1, True), "shakes with the nominal model"),
        ((0.2, True), (0.1, False), "shakes with the identified model"),
    ],
)
def test_the_controllers_are_compared(simulated: Written, before: Any, after: Any, words: str) -> None:
    runs = {
        name: {"rms_joint_error": [0.6 * error, 0.8 * error], "stable": stable}
        for name, (error, stable) in (("nominal", before), ("identified", after))
    }
    assert words in details(replace(simulated.found, tried=runs))[-1]


def test_a_refined_model_is_shown(simulated: Written, tmp_path: Path) -> None:
    refined = Refined(
        names=("delay",), units=("s",), start=np.zeros(1), estimate=np.array([0.0123]), std_error=np.array([np.inf]),
        before=np.ones(2), after=np.zeros(2), pieces=3, remarks=(),
    )  # fmt: skip
    found = replace(simulated.found, refined=refined)
    assert record(found)["refined"]["std_error"] == [None]
    write_identification_page(tmp_path / "report.html", found, [])
    assert "0.0123" in visible((tmp_path / "report.html").read_text())


def test_a_folder_is_replaced_whole_or_not_at_all(simulated: Written, tmp_path: Path) -> None:
    folder = tmp_path / "x"
    write_findings(folder, simulated.found, simulated.model, plots=False)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(LwaError):
        write_findings(folder, replace(simulated.found, variant="other"), tmp_path / "no_such.xml")
    broken = replace(simulated.found, identified=np.full_like(simulated.found.identified, -1.0))
    with pytest.raises(IdentificationError):
        write_findings(tmp_path / "y", broken, simulated.model)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["x"]


def test_a_folder_of_something_else_is_left_alone(simulated: Written, tmp_path: Path) -> None:
    scenario = simulated.found.scenario
    assert claim_for(scenario, simulated.folder.parent) == simulated.folder
    (tmp_path / "small-identify").mkdir()
    (tmp_path / "small-identify" / "thesis.tex").touch()
    with pytest.raises(ScenarioError, match=r"thesis\.tex"):
        claim_for(scenario, tmp_path)


PROBLEM = Problem.of(Identify(joints=()), load_model("lwa4d_planar"))


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_no_possible_link_is_larger_than_its_size(seed: int) -> None:
    half = np.random.default_rng(seed).normal(size=(2, 4, 4))
    pi = from_pseudo_inertia(half @ half.swapaxes(1, 2)).ravel()
    nominal = PROBLEM.nominal.copy()
    nominal[:20] = pi
    size = sizes(replace(PROBLEM, nominal=nominal))
    value = dict(zip(PROBLEM.unknowns.names, nominal, strict=True))
    for name, largest in zip(PROBLEM.parameters.names, size, strict=True):
        assert abs(value[name]) <= largest * (1 + 1e-12)


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [(0.26043, 0.0012, "0.2604"), (20.593, 1.0, "20.6"), (0.001, 5.0, "0.001"), (np.nan, 1.0, NONE), (None, None, NONE),
     (1 / 3, None, "0.333333"), (0.0, 0.1, "0"), (-1389.4, 2520.0, "-1.4e+03")],
)  # fmt: skip
def test_a_number_has_the_digits_that_its_error_leaves(value: Any, error: Any, text: str) -> None:
    assert digits(value, error) == text


def test_shares_and_lists_read_well() -> None:
    assert [percent(x) for x in (0.0, 1e-9, 0.00023, 0.0996, 0.0999, 1.337, 1e5)] == [
        "0.001 %", "0.001 %", "0.023 %", "10 %", "10 %", "134 %", "more than 10000 %"
    ]  # fmt: skip
    assert listed(["a"]) == "a"
    assert listed(["a", "b", "c"]) == "a, b and c"
    assert listed(list("abcdefgh")) == "a, b, c, d, e, f and 2 more"


def test_every_name_has_a_meaning() -> None:
    problem = Problem.of(
        Identify(joints=("viscous", "coulomb", "offset", "armature", "gain")), load_model("lwa4d_3dof")
    )
    assert all(meaning(name) for name in problem.unknowns.names)
    assert meaning("p1") == ""


def test_a_loop_that_shook_is_not_to_be_trusted(simulated: Written) -> None:
    found = replace(simulated.found, recording=replace(simulated.found.recording, shook=True))
    assert headline(found)[0] == "The estimate is not to be trusted: the loop shook while the data were taken."
    assert any("lower the gains" in text for text in details(found))
    assert not sound(found)
