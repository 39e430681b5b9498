"""Calibration finds what can be found, says what cannot and how sure it is; the arm it writes is the arm it means."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.stats import binom, chi2
from test_kinematics import odd
from typer.testing import CliRunner

from lwa4d_sim.arm import ARMS
from lwa4d_sim.calibrate_cli import calibrate as command
from lwa4d_sim.calibration.arm_file import write_arm
from lwa4d_sim.calibration.error_model import ErrorModel
from lwa4d_sim.calibration.fit import fit
from lwa4d_sim.calibration.identifiable import explain, preference, random_poses, rows, split, structure
from lwa4d_sim.calibration.measured import Instrument, Measured, measure
from lwa4d_sim.calibration.pose_files import read_poses, write_poses
from lwa4d_sim.calibration.poses import informative_poses
from lwa4d_sim.calibration.study import calibrate, simulate
from lwa4d_sim.calibration.words import remarks, zeros
from lwa4d_sim.chain import SerialKinematics
from lwa4d_sim.dh import THESIS_DH_3DOF, dh_forward
from lwa4d_sim.errors import IdentificationError, LwaError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import chain_of, load_model
from lwa4d_sim.rotations import rotation_vector
from lwa4d_sim.runner import run
from lwa4d_sim.scenario import Scenario
from lwa4d_sim.yaml_text import parse

POINTS, POSES = Instrument(position=1e-4), Instrument(position=1e-4, angle=1e-3)


def shipped(name: str) -> ErrorModel:
    return ErrorModel(chain_of(load_model(name)))


def drawn(model: ErrorModel, size: float, seed: int) -> Array:
    return size * np.random.default_rng(seed).normal(size=len(model.names))


# the model


@given(seed=st.integers(0, 10**6))
@settings(max_examples=15, deadline=None)
def test_derivatives_are_differences_and_poses_are_those_of_the_corrected_chain(seed: int) -> None:
    model = ErrorModel(odd(seed))
    xi, q = drawn(model, 0.3, seed), np.random.default_rng(seed).normal(size=(2, model.n))
    found, other = model.predict(q, xi), SerialKinematics(model.corrected(xi)).fk(q)
    np.testing.assert_allclose(found.x, other.x, atol=1e-12)
    np.testing.assert_allclose(found.R, other.R, atol=1e-12)
    h = 1e-6  # central differences: truncation 1e-12, rounding 1e-9
    for j, step in enumerate(h * np.eye(len(xi))):
        after, before = model.predict(q, xi + step), model.predict(q, xi - step)
        turn = rotation_vector(after.R @ before.R.swapaxes(-1, -2))
        np.testing.assert_allclose(found.J[:, :, j], np.hstack([after.x - before.x, turn]) / (2 * h), atol=1e-7)


def test_an_offset_is_what_must_be_added_to_the_readings() -> None:
    for chain in (odd(), chain_of(load_model("lwa4d_7dof"))):
        model = ErrorModel(chain)
        q = np.random.default_rng(1).normal(size=(5, model.n))
        for i, j in enumerate(model.offsets):
            xi = np.zeros(len(model.names))
            xi[j] = 0.1
            assert model.names[j] == f"{chain.names[i]}.offset"
            np.testing.assert_allclose(
                model.predict(q, xi).x, SerialKinematics(chain).fk(q + 0.1 * np.eye(model.n)[i]).x, atol=1e-12
            )


# what can be found

# With the tool on axis 7 a tilt of that axis moves the point as a shift does (twice), and joint 7 moves nothing.
POINTS_SEEN = {"lwa4d_7dof": (29, 6), "lwa4d_3dof": (15, 3), "lwa4d_3dof_printed": (15, 3), "lwa4d_planar": (11, 2)}


@pytest.mark.parametrize("name", ARMS)
def test_so_many_coordinates_can_be_found_as_theory_says(name: str) -> None:
    model = shipped(name)
    assert len(structure(model, True).kept) == 4 * model.n + 6
    assert len(structure(model, True, model.offsets).kept) == model.n
    assert (
        len(structure(model, False).kept),
        len(structure(model, False, model.offsets).kept),
    ) == POINTS_SEEN[name]


@given(seed=st.integers(0, 10**6))
@settings(max_examples=15, deadline=None)
def test_the_count_is_that_of_theory_for_any_arm(seed: int) -> None:
    model = ErrorModel(odd(seed))  # five turning joints and a sliding one
    J = model.predict(random_poses(model, 100, np.random.default_rng(seed)), np.zeros(len(model.names))).J
    for whole, tool in ((True, 6), (False, 3)):
        found = split(rows(model, J, whole), preference(model), model.scale)
        assert len(found.kept) == 4 * 5 + 2 + tool


@pytest.mark.parametrize("whole", [True, False])
def test_the_rank_is_that_of_a_singular_value_decomposition(whole: bool) -> None:
    for name in ARMS:
        model = shipped(name)
        q = random_poses(model, 100, np.random.default_rng(5))
        stacked = rows(model, model.predict(q, np.zeros(len(model.names))).J, whole) * model.scale
        assert len(structure(model, whole).kept) == np.linalg.matrix_rank(stacked, tol=1e-8)


def test_what_cannot_be_told_apart_really_does_the_same() -> None:
    """To first order: a lost coordinate, and the kept ones that are said to do the same, move the tool alike."""
    for name in ARMS:
        for whole in (True, False):
            model = shipped(name)
            found = structure(model, whole)
            q = random_poses(model, 20, np.random.default_rng(2))
            h = 1e-6
            for k, j in enumerate(found.lost):
                one, same = np.zeros(len(model.names)), np.zeros(len(model.names))
                one[j], same[found.kept] = h, h * found.C[:, k]
                a, b = model.predict(q, one), model.predict(q, same)
                np.testing.assert_allclose(a.x, b.x, atol=1e3 * h**2)  # second-order terms
                if whole:
                    np.testing.assert_allclose(a.R, b.R, atol=1e3 * h**2)


def test_it_is_told_in_words() -> None:
    model = shipped("lwa4d_3dof")
    assert explain(model, structure(model, False)) == [
        "joint1.dz acts as -joint2.dy",
        "joint2.dz acts as tool.dy",
        "joint2.ry acts as -joint1.offset",
        "joint4.dy acts as 3.049 joint2.offset - 3.049 joint4.offset",  # 1 / 0.328 m
        "joint4.dz acts as tool.dy",
        "tool.dx acts as 2.519 joint4.offset",  # 1 / 0.397 m
        "tool.rx does not move what is measured",
        "tool.ry does not move what is measured",
        "tool.rz does not move what is measured",
    ]


# the fit


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("instrument", [POINTS, POSES])
def test_exact_poses_give_the_exact_arm(name: str, instrument: Instrument) -> None:
    model, rng = shipped(name), np.random.default_rng(3)
    xi = drawn(model, 3e-3, 4)
    kept = structure(model, instrument.angle is not None).kept
    found = fit(model, measure(model, xi, random_poses(model, 40, rng), instrument), kept, instrument)
    q = random_poses(model, 200, rng)
    a, b = model.predict(q, found.xi), model.predict(q, xi)
    # lwa4d_7dof shows tilt and place of axis 7 apart by products of errors only, which the points then keep
    tolerance = 30 * 3e-3**2 if (name, instrument) == ("lwa4d_7dof", POINTS) else 1e-10
    assert np.abs(a.x - b.x).max() < tolerance
    if instrument is POSES:
        assert np.abs(a.R - b.R).max() < 1e-10


def test_a_tracker_that_stands_a_little_off_is_found_as_well() -> None:
    model, xi = shipped("lwa4d_3dof"), np.zeros(24)
    xi[:6] = [0.04, -0.03, 0.02, 0.05, -0.08, 0.1]
    kept = structure(model, True).kept
    found = fit(model, measure(model, xi, random_poses(model, 30, np.random.default_rng(0)), POSES), kept, POSES)
    assert found.ratio < 1e-9


def test_intervals_cover_and_standard_errors_are_those_of_repeats() -> None:
    model, rng = shipped("lwa4d_3dof"), np.random.default_rng(6)
    xi, q = drawn(model, 1e-3, 7), random_poses(model, 25, rng)
    kept = structure(model, True).kept
    truth = fit(model, measure(model, xi, q, POSES), kept, POSES).xi[kept]
    fits = [fit(model, measure(model, xi, q, POSES, rng), kept, POSES) for _ in range(200)]
    estimates = np.array([f.xi[kept] for f in fits])
    covered = (np.abs(estimates - truth) < [f.half for f in fits]).sum(axis=0)
    low, high = binom.interval(1 - 1e-3 / len(kept), 200, 0.95)  # one seed in a thousand fails
    assert low <= covered.min()
    assert covered.max() <= high
    assert abs(covered.mean() / 200 - 0.95) < 0.02
    # of 200 repeats a standard deviation is known to 5 %, so four times that, and the mean of many to a few per cent
    ratios = estimates.std(axis=0) / np.mean([f.std_error for f in fits], axis=0)
    np.testing.assert_allclose(ratios, 1.0, rtol=0.2)
    np.testing.assert_allclose(ratios.mean(), 1.0, rtol=0.05)
    np.testing.assert_allclose(np.mean([f.ratio for f in fits]), 1.0, rtol=0.01)


def test_what_is_found_is_what_was_drawn_and_what_acts_the_same() -> None:
    """To first order, by the other road: the drawn errors, those that are lost added to those that are kept."""
    model = shipped("lwa4d_7dof")
    split, xi = structure(model, True), drawn(model, 1e-6, 8)
    found = fit(model, measure(model, xi, random_poses(model, 40, np.random.default_rng(1)), POSES), split.kept, POSES)
    expected = xi[split.kept] + split.C @ xi[split.lost]
    np.testing.assert_allclose(found.xi[split.kept], expected, atol=1e-9)


def dh_errors(table: Array, q: Array, like: Measured, turn: Array) -> Array:
    T = dh_forward(table, q)
    shift, R = like.x - T[:, :3, 3], T[:, :3, :3] @ turn
    assert like.R is not None
    return np.hstack([shift / 1e-4, rotation_vector(like.R @ R.swapaxes(-1, -2)) / 1e-3]).ravel()


def test_a_denavit_hartenberg_model_finds_the_same_arm() -> None:
    """The thesis's table with errors in it, measured; both models fit, and the larger one only what is noise."""
    model, rng = shipped("lwa4d_3dof"), np.random.default_rng(9)
    q, unseen = random_poses(model, 40, rng), random_poses(model, 100, rng)
    nominal = model.predict(q, np.zeros(24))
    turn = dh_forward(THESIS_DH_3DOF, q[0])[:3, :3].T @ nominal.R[0]  # between the two conventions for the tool
    true = THESIS_DH_3DOF + 1e-3 * rng.normal(size=(3, 4))

    def exact(readings: Array) -> Measured:
        T = dh_forward(true, readings)
        labels = tuple(map(str, range(len(readings))))
        return Measured(q=readings, x=T[:, :3, 3], R=T[:, :3, :3] @ turn, labels=labels, source="table")

    kept = structure(model, True).kept
    found = fit(model, exact(q), kept, POSES)
    predicted, wanted = model.predict(unseen, found.xi), exact(unseen)
    assert wanted.R is not None
    np.testing.assert_allclose(predicted.x, wanted.x, atol=1e-10)
    np.testing.assert_allclose(predicted.R, wanted.R, atol=1e-10)

    noisy = exact(q)
    assert noisy.R is not None
    noise = measure(model, np.zeros(24), q, POSES, rng)
    assert noise.R is not None
    noisy = replace(noisy, x=noisy.x + noise.x - nominal.x, R=noise.R @ nominal.R.swapaxes(-1, -2) @ noisy.R)
    free = [0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 11]  # d2 cannot be told from d3, since axes 2 and 3 are parallel

    def error(z: Array) -> Array:
        table = true.copy().ravel()
        table[free] += z
        return dh_errors(table.reshape(3, 4), q, noisy, turn)

    by_table = 2 * least_squares(error, np.zeros(11), x_scale=1e-3).cost
    by_twists = fit(model, noisy, kept, POSES).ratio ** 2 * (6 * 40 - 18)
    # 18 coordinates contain the table's 11 parameters: the other 7 take chi-squared of 7 out of the residuals
    assert 0.0 < by_table - by_twists < chi2.isf(1e-4, 7)


def test_chosen_poses_tell_more_than_drawn_ones() -> None:
    model = shipped("lwa4d_7dof")
    kept = structure(model, False).kept

    def information(q: Array) -> float:
        J = rows(model, model.predict(q, np.zeros(len(model.names))).J, False)[:, kept] * model.scale[kept]
        return float(np.linalg.slogdet(J.T @ J)[1])

    chosen = informative_poses(model, kept, POINTS, 30, np.random.default_rng(0))
    assert len(np.unique(chosen, axis=0)) == 30
    assert (chosen >= model.nominal.lower).all()
    assert (chosen <= model.nominal.upper).all()
    drawn_ones = [information(random_poses(model, 30, np.random.default_rng(s))) for s in range(20)]
    assert information(chosen) > max(drawn_ones) + 2.0  # in all seven times as much as the best of twenty draws


def test_a_bad_pose_is_named_and_good_ones_seldom_are() -> None:
    model, rng = shipped("lwa4d_3dof"), np.random.default_rng(11)
    q, kept = random_poses(model, 25, rng), structure(model, False).kept
    good = [measure(model, np.zeros(24), q, POINTS, rng) for _ in range(100)]
    warned = sum(len(fit(model, data, kept, POINTS).outliers) > 0 for data in good)
    assert warned <= binom.isf(1e-3, 100, 0.01)
    x = good[0].x.copy()
    x[7, 2] += 1.5e-3
    study = calibrate(model, replace(good[0], x=x), POINTS, False)
    assert [study.data.labels[k] for k in study.fit.outliers] == ["pose 8"]
    told = remarks(study)
    assert "pose 8 does not fit the others" in told[0]
    assert "times the stated noise" in told[1]
    assert "keep the arm as it is" in told[2]  # it had no errors, and the bad pose bent it
    small = measure(model, drawn(model, 1e-3, 14), q, POINTS, rng)
    assert remarks(calibrate(model, small, POINTS, False)) == []


def test_zeros_are_told_for_every_joint() -> None:
    study = simulate(shipped("lwa4d_7dof"), POINTS, 30, 1e-3, 0, True)
    told = zeros(study)
    assert len(told) == 7
    assert told[6] == "joint7: these measurements do not show its zero; it is left as it is"
    assert study.truth is not None
    assert told[0].startswith("joint1: add +0.0")
    drawn_zeros = np.random.default_rng(0).normal(size=7)[:6] * 1e-3
    np.testing.assert_allclose(study.truth[study.model.offsets[:6]], drawn_zeros, atol=1e-12)


# what cannot be found


def refuse(data: Measured, model: ErrorModel, *words: str) -> None:
    with pytest.raises(IdentificationError) as caught:
        calibrate(model, data, POINTS if data.R is None else POSES, False)
    for word in words:
        assert word in str(caught.value)


def test_poses_that_do_not_tell_are_refused_with_what_they_do_not_tell() -> None:
    model, rng = shipped("lwa4d_3dof"), np.random.default_rng(12)
    zero = np.zeros(24)
    q = random_poses(model, 30, rng)
    refuse(measure(model, zero, q[:6], POINTS), model, "5 poses give 15 numbers for 15", "at least 6 poses")
    still = q.copy()
    still[:, 1:] = [-1.0, 1.0]  # only the base turns
    refuse(
        measure(model, zero, still, POSES, rng), model, "too alike to tell 8 of 18", "joint4.rx", "much of its range"
    )
    near = still + 1e-4 * rng.normal(size=q.shape)
    refuse(measure(model, zero, near, POSES, rng), model, "tell too little about", "joint4.rx (± ")
    far = measure(model, zero, q, POINTS)
    refuse(replace(far, x=far.x + 0.5), model, "0.866 m or more off the nominal", "frame of the arm's base")


# files


HEADER = "q1,q2,q3,x,y,z"


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (
            ["q1,q2,x,y,z", "0,0,0,0,0"],
            "row 1: the header is 'q1,q2,x,y,z'; valid: q1,q2,q3,x,y,z or q1,q2,q3,x,y,z,roll",
        ),
        ([HEADER], "holds no poses"),
        ([HEADER, "0,0,0,0,0"], "row 2: has 5 columns; the header has 6"),
        ([HEADER, "0,0,0,0,0,0", "0,0,0,0,nan,0"], "row 3, column y (='nan'): must be a finite number"),
        ([HEADER, "0,0,zero,0,0,0"], "row 2, column q3 (='zero'): must be a finite number"),
        (
            [HEADER, "", "0,-90,0,0,0,0"],
            "row 3, column q2 (=-90): must be from -3.8108 to 0.669204 rad; is it in degrees?",
        ),
        ([HEADER, "0,0,0,725,0,300"], "row 2, column x (=725): must be from -2.05 to 2.05 m; is it in millimetres?"),
        (
            [HEADER + ",roll,pitch,yaw", "0,0,0,0,0,0,0,90,0"],
            "column pitch (=90): must be from -12.5664 to 12.5664 rad",
        ),
    ],
)
def test_a_bad_file_is_refused_with_row_and_column(tmp_path: Path, lines: Sequence[str], words: str) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(IdentificationError) as caught:
        read_poses(path, shipped("lwa4d_3dof"))
    assert words in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_none_is_refused(tmp_path: Path) -> None:
    model = shipped("lwa4d_3dof")
    for path, words in ((tmp_path / "no.csv", "cannot be read"), (tmp_path, "cannot be read")):
        with pytest.raises(IdentificationError, match=words):
            read_poses(path, model)
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(IdentificationError, match="is not a CSV file"):
        read_poses(tmp_path / "bytes.csv", model)


def test_poses_come_back_from_a_file_as_they_were(tmp_path: Path) -> None:
    model = shipped("lwa4d_7dof")
    for instrument in (POINTS, POSES):
        data = measure(model, drawn(model, 1e-3, 0), random_poses(model, 10, np.random.default_rng(0)), instrument)
        write_poses(tmp_path / "p.csv", data)
        again = read_poses(tmp_path / "p.csv", model)
        np.testing.assert_array_equal(again.q, data.q)
        np.testing.assert_array_equal(again.x, data.x)
        if data.R is not None and again.R is not None:
            np.testing.assert_allclose(again.R, data.R, atol=1e-15)
        assert (again.R is None, again.labels[0]) == (data.R is None, "row 2")


FRAMES = """
<mujoco model="frames"><compiler angle="degree" eulerseq="XYZ"/><worldbody>
 <frame pos="0.1 0.2 0.3" euler="10 20 30">
  <body pos="0.123456789012345 0 0" axisangle="1 2 3 33">
   <joint name="a" axis="0 1 0.3" pos="0.01 0 0" ref="20" range="-100 123.456789"/><geom size="0.1" mass="1"/>
   <frame euler="1 2 3" pos="1 1 1"><body name="b" pos="0 0 0.2"><geom size="0.1"/>
    <body name="c" euler="10 20 30.123456789012" pos="0 0 0.1">
     <inertial pos="0.1 0.01 0.02" mass="1.23456789" fullinertia="0.1 0.2 0.2 0.01 0.02 0.03"/>
     <joint name="s" type="slide" axis="1 1 0.2" ref="0.1" pos="0.3 0.1 0"/>
     <body pos="0.1 0.1 0.1" zaxis="1 2 3"><geom size="0.1" mass="1"/><site euler="1 3 4"/>TOOL</body>
    </body></body></frame></body></frame></worldbody>
 <actuator><motor joint="a"/><motor joint="s"/></actuator><keyframe><key name="home" qpos="0.123456789 0.1"/></keyframe>
</mujoco>"""
TOOL = '<site name="tcp" euler="10 3 1" pos="0.3 0 0"/>'


@pytest.mark.parametrize("arm", [*ARMS, "frames", "no tool"])
def test_the_written_arm_is_the_calibrated_one_and_else_the_same(arm: str, tmp_path: Path) -> None:
    if arm not in ARMS:
        source = tmp_path / "arm.xml"
        source.write_text(FRAMES.replace("TOOL", TOOL if arm == "frames" else ""))
        arm = str(source)
    model = shipped(arm)
    xi = drawn(model, 0.1, 13)
    write_arm(tmp_path / "out.xml", arm, model, xi)
    old, new = load_model(arm), load_model(str(tmp_path / "out.xml"))
    q = random_poses(model, 50, np.random.default_rng(1))
    a, b = SerialKinematics(chain_of(new)).fk(q), SerialKinematics(model.corrected(xi)).fk(q)
    np.testing.assert_allclose(a.x, b.x, atol=1e-12)
    np.testing.assert_allclose(a.R, b.R, atol=1e-12)
    for field in ("body_mass", "body_inertia", "body_ipos", "jnt_range", "jnt_axis", "key_qpos", "qpos0"):
        np.testing.assert_allclose(getattr(new, field), getattr(old, field), rtol=1e-15, err_msg=field)
    assert [new.joint(j).name for j in range(new.njnt)] == [old.joint(j).name for j in range(old.njnt)]
    np.testing.assert_array_equal(new.actuator_ctrlrange, old.actuator_ctrlrange)


def test_meshes_and_included_files_are_found_from_elsewhere(tmp_path: Path) -> None:
    there = tmp_path / "there"
    (there / "assets").mkdir(parents=True)
    (there / "assets" / "t.obj").write_text(
        "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    )
    (there / "rest.xml").write_text(
        '<mujocoinclude><body pos="0.3 0 0"><joint name="b" axis="0 0 1"/><geom type="mesh" mesh="t"/></body>'
        "</mujocoinclude>"
    )
    (there / "arm.xml").write_text(
        '<mujoco><compiler angle="radian" meshdir="assets"/><asset><mesh name="t" file="t.obj"/></asset><worldbody>'
        '<body><joint name="a" axis="0 1 0"/><geom type="mesh" mesh="t"/><include file="rest.xml"/></body></worldbody>'
        '<actuator><motor joint="a"/><motor joint="b"/></actuator></mujoco>'
    )
    arm = str(there / "arm.xml")
    write_arm(tmp_path / "out.xml", arm, shipped(arm), np.zeros(18))
    np.testing.assert_allclose(load_model(str(tmp_path / "out.xml")).body_inertia, load_model(arm).body_inertia)


# the command

APP = typer.Typer()
APP.command()(command)


def call(*arguments: object) -> dict[str, Any]:
    done = CliRunner().invoke(APP, [str(a) for a in (*arguments, "--json")], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    answer: dict[str, Any] = json.loads(done.stdout)
    return answer


def test_the_command_writes_an_arm_that_other_commands_take(tmp_path: Path) -> None:
    answer = call("lwa4d_3dof", "--simulate", 40, "--angle-noise", 1e-3, "-o", tmp_path)
    assert answer["identifiable"] == len(answer["parameters"]) == 18
    within = [row["low"] < row["truth"] < row["high"] for row in answer["parameters"].values()]
    assert sum(within) >= binom.isf(0.9999, 18, 0.95)
    rms = answer["rms"]
    # three coordinates of 0.1 mm; on unseen poses what the estimate is off comes to it
    assert rms["before"] > 10 * rms["after"]
    assert rms["after"] < 1.0e-4 * np.sqrt(3) * 1.2
    assert rms["held_out"] < 1.0e-4 * np.sqrt(3) * 1.5
    folder = Path(answer["folder"])
    names = ["errors.png", "lwa4d_3dof_calibrated.xml", "parameters.yaml", "poses.csv", "poses_held_out.csv"]
    assert sorted(path.name for path in folder.iterdir()) == names
    told = parse((folder / "parameters.yaml").read_text(), "parameters.yaml")[0]
    assert told["parameters"] == answer["parameters"]

    # the same poses from the file give nearly the same arm: there every fifth pose is held out
    again = call("lwa4d_3dof", "--poses", folder / "poses.csv", "--angle-noise", 1e-3, "-o", tmp_path / "file")
    assert again["poses"] == {"fit": 32, "held_out": 8}
    for name, row in again["parameters"].items():
        assert row["estimate"] == pytest.approx(answer["parameters"][name]["estimate"], abs=5 * row["std_error"])
        assert row["truth"] is None

    # and the calibrated arm, calibrated again with them, has nothing left to correct
    arm = folder / "lwa4d_3dof_calibrated.xml"
    third = call(arm, "--poses", folder / "poses.csv", "--angle-noise", 1e-3, "-o", tmp_path)
    assert third["rms"]["before"] < 1.0e-4 * np.sqrt(3) * 1.2
    text = (
        f"name: x\narm: {arm}\n"
        "trajectory: {waypoints: {space: task, points: [[0.3, -0.3, 0.6], [0.31, -0.3, 0.6]]}, segment_time: 0.1}\n"
        "initial: {q: [-1.5, -1.5, 1.5]}\ncontroller: {kind: computed_torque, p: 10}\nvariants: {can: {}}\n"
    )
    assert run(Scenario.parse(text)).metrics()["stable"]


def test_the_table_says_what_was_found(tmp_path: Path) -> None:
    done = CliRunner().invoke(APP, ["lwa4d_planar", "--simulate", "20", "--joints-only", "-o", str(tmp_path)])
    assert done.exit_code == 0, done.output
    lines = done.stdout.splitlines()
    assert lines[0] == f"lwa4d_planar, 20 poses  ->  {tmp_path / 'lwa4d_planar-calibration'}"
    assert [line.split()[0] for line in lines if ".offset" in line] == ["joint2.offset", "joint4.offset"]
    assert sum("deg to its readings" in line for line in lines) == 2
    assert sum(line.startswith("rms error of the tool") for line in lines) == 2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["lwa4d_3dof"], "--poses FILE"),
        (["lwa4d_3dof", "--simulate", "20", "--poses", "p.csv"], "--poses FILE"),
        (["lwa4d_3dof", "--simulate", "20", "--noise", "0"], "--noise (=0): must be from 1e-09 to 0.1"),
        (["lwa4d_3dof", "--simulate", "20", "--noise", "nan"], "--noise (=nan)"),
        (["lwa4d_3dof", "--simulate", "20", "--error", "1"], "--error (=1): must be from 0 to 0.01"),
        (["lwa4d_3dof", "--simulate", "20", "--angle-noise", "5"], "--angle-noise (=5)"),
        (["lwa4d_3dof", "--simulate", "4"], "4 poses give 12 numbers for 15"),
        (["lwa4d_3dof", "--poses", "p.csv"], "p.csv: cannot be read"),
        (["no_arm", "--simulate", "20"], "no such file"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(tmp_path: Path, arguments: list[str], words: str) -> None:
    with pytest.raises(LwaError) as caught:
        CliRunner().invoke(APP, [*arguments, "-o", str(tmp_path / "runs")], catch_exceptions=False)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []
