from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lwa4d_sim.arm import load_arm
from lwa4d_sim.errors import TrajectoryError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.motions import JointMotion
from lwa4d_sim.trajectories import SampledMotion

PLANAR = load_arm("lwa4d_planar").kinematics
HEADERS = ("t,q1,q2", "t,q1,q2,dq1,dq2", "t,q1,q2,dq1,dq2,ddq1,ddq2")
T = np.array([0.0, 0.3, 0.5, 1.1, 1.2, 2.0])


def polynomial(degree: int) -> list[Array]:
    """A random polynomial of two joints at T: position, speed, acceleration."""
    c = np.random.default_rng(degree).normal(size=(degree + 1, 2))
    return [np.polynomial.polynomial.polyval(T, np.polynomial.polynomial.polyder(c, k)).T for k in range(3)]


def build(path: Path) -> JointMotion:
    return SampledMotion(file=path.name).build(PLANAR, np.zeros(2), path.parent)


def save(path: Path, t: Array, columns: list[Array]) -> Path:
    table = np.column_stack([t, *columns])
    if path.suffix == ".npy":
        np.save(path, table)
    elif path.suffix == ".npz":
        named: dict[str, Any] = dict(zip(("q", "dq", "ddq"), columns, strict=False))
        np.savez(path, t=t, **named)
    else:
        np.savetxt(path, table, delimiter=",", header=HEADERS[len(columns) - 1], comments="", fmt="%.17g")
    return path


@pytest.mark.parametrize(("given", "degree"), [(1, 3), (2, 3), (3, 5)])
@pytest.mark.parametrize("suffix", [".csv", ".npy", ".npz"])
def test_a_polynomial_comes_back_between_its_samples(tmp_path: Path, suffix: str, given: int, degree: int) -> None:
    values = polynomial(degree)
    motion = build(save(tmp_path / f"motion{suffix}", T + 100.0, values[:given]))  # time counts from the first sample
    assert motion.duration == pytest.approx(2.0)
    np.testing.assert_allclose(motion.joint(T[:-1]).ddq, values[2][:-1], atol=1e-9)
    c = np.random.default_rng(degree).normal(size=(degree + 1, 2))
    t = np.linspace(0, 1.99, 50)
    ref = motion.joint(t)
    for k, got in enumerate((ref.q, ref.dq, ref.ddq)):
        expected = np.polynomial.polynomial.polyval(t, np.polynomial.polynomial.polyder(c, k)).T
        np.testing.assert_allclose(got, expected, atol=1e-9)
    assert not motion.joint(np.array([2.0, 5.0])).dq.any()


def test_blank_lines_spaces_and_a_byte_order_mark_do_no_harm(tmp_path: Path) -> None:
    path = tmp_path / "m.csv"
    path.write_text("\ufefft, q1, q2\n0, 1, 2\n\n1, 2, 3\n", encoding="utf-8")
    np.testing.assert_allclose(build(path).joint(np.array([0.5])).q, [[1.5, 2.5]], atol=1e-15)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"m\.csv:1: header is ''; valid: t,q1,q2 or t,q1,q2,dq1,dq2 or"),
        ("t,q1\n0,0\n1,1\n", r"m\.csv:1: header is 't,q1'"),
        ("t,q2,q1\n0,0,0\n1,1,1\n", r"m\.csv:1: header is 't,q2,q1'"),
        ("t,q1,q2\n0,0,0\n", r"m\.csv: has 1 samples; a motion needs at least 2"),
        ("t,q1,q2\n0,0,0\n1,0\n", r"m\.csv:3: has 2 columns; the header has 3"),
        ("t,q1,q2\n0,0,0\n\n1,x,0\n", r"m\.csv:4: could not convert string to float: 'x'"),
        ("t,q1,q2\n0,0,0\n1,nan,0\n", r"m\.csv:3: holds a number that is not finite"),
        ("t,q1,q2\n0,0,0\n1,0,0\n\n1,0,0\n", r"m\.csv:5: t \(=1 s\) must be later than .*\(=1 s\)"),
    ],
)
def test_defects_are_named_by_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(TrajectoryError, match=message):
        build(tmp_path / "m.csv")


def test_defects_of_numpy_files_are_named(tmp_path: Path) -> None:
    def refused(name: str, message: str) -> None:
        with pytest.raises(TrajectoryError, match=message):
            build(tmp_path / name)

    q = np.zeros((3, 2))
    np.save(tmp_path / "a.npy", np.zeros((3, 4)))
    refused("a.npy", r"a\.npy: has 4 columns; valid: t,q1,q2")
    np.save(tmp_path / "b.npy", np.zeros(3))
    refused("b.npy", r"has shape \(3,\); it must have two axes")
    np.save(tmp_path / "c.npy", np.array([[0.0, 1, 1], [2, 1, 1], [1, 1, 1]]))
    refused("c.npy", r"c\.npy, row 3: t \(=1 s\) must be later")
    np.save(tmp_path / "d.npy", np.array([object()]), allow_pickle=True)
    refused("d.npy", "is not a NumPy file of numbers")
    (tmp_path / "e.npy").write_text("t,q1,q2")
    refused("e.npy", "is not a NumPy file of numbers")
    np.savez(tmp_path / "f.npz", t=np.arange(3.0), q=q, tau=q)
    refused("f.npz", "holds t, q, tau; valid: t and q")
    np.savez(tmp_path / "g.npz", t=np.arange(3.0), q=np.zeros((3, 4)))
    refused("g.npz", r"q has shape \(3, 4\); it must have \(3, 2\)")
    np.savez(tmp_path / "h.npz", t=np.arange(3.0))
    refused("h.npz", "holds t; valid: t and q")
    (tmp_path / "i.npz").write_bytes(b"PK\x03\x04 broken")
    refused("i.npz", "is not a NumPy file of numbers")
    refused("none.csv", r"none\.csv: cannot be read \(No such file or directory\)")
