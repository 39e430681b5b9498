"""Parameters that real bodies can have, whatever the data, and the MJCF that holds them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lwa4d_sim.arm import ARMS
from lwa4d_sim.edits import ArmEdits, Payload
from lwa4d_sim.errors import IdentificationError, ModelError, RecordError
from lwa4d_sim.identification.consistent import FLOOR, WEIGHT, consistent, is_consistent, margin
from lwa4d_sim.identification.inertia import from_pseudo_inertia, lump, pseudo_inertia, standard_parameters
from lwa4d_sim.identification.model_file import write_model
from lwa4d_sim.interfaces import Array
from lwa4d_sim.mjcf import chain_of, load_model, model_path

# Joint parameters of these tests, one a joint each: viscous, coulomb and armature from 0, an offset without bounds
SPREAD, LOWER = (5.0, 5.0, 0.5, 1.0), (0.0, 0.0, 0.0, -np.inf)
NOMINAL = {name: standard_parameters(load_model(name)) for name in ARMS}


def estimate(R: Array, z: Array, nominal: Array, **changes: Any) -> Array:
    """Consistent parameters of an arm whose joints have `SPREAD` and `LOWER` and nominally nothing."""
    n = len(nominal)
    keys = {
        "n_links": n,
        "spread": np.repeat(SPREAD, n),
        "lower": np.repeat(LOWER, n),
        "upper": np.full(4 * n, np.inf),
    }
    prior = np.concatenate([nominal.ravel(), np.zeros(4 * n)])
    return consistent(R, z, changes.pop("prior", prior), **{**keys, **changes})


def log_cholesky(theta: Array) -> Array:
    """Ten parameters from any ten numbers (Rucker and Wensing 2022): J = U U^T, U triangular, positive diagonal."""
    alpha, d1, d2, d3, s12, s23, s13, t1, t2, t3 = theta
    U = np.exp(alpha) * np.array(
        [[np.exp(d1), s12, s13, t1], [0, np.exp(d2), s23, t2], [0, 0, np.exp(d3), t3], [0, 0, 0, 1]]
    )
    return from_pseudo_inertia(U @ U.T)


def bodies(rng: np.random.Generator, n: int, size: float = 0.5) -> Array:
    """Inertial parameters (n, 10) of random bodies."""
    return np.stack([log_cholesky(size * rng.normal(size=10)) for _ in range(n)])


def whitened(pi: Array) -> Array:
    """Changes of the links' parameters that the metric of ``pi`` (n, 10) counts as one, in columns (10 n, 10 n)."""
    T = np.zeros((pi.size, pi.size))
    for k, J in enumerate(pseudo_inertia(pi)):
        L = np.linalg.cholesky(J)
        T[10 * k : 10 * k + 10, 10 * k : 10 * k + 10] = from_pseudo_inertia(L @ _UNITS @ L.T).T
    return T


def _symmetric_units() -> Array:
    """An orthonormal base of the symmetric 4 x 4 matrices, (10, 4, 4)."""
    units = np.zeros((10, 4, 4))
    for unit, row, column in zip(units, *np.triu_indices(4), strict=True):
        unit[row, column] = unit[column, row] = 1.0 if row == column else np.sqrt(0.5)
    return units


_UNITS = _symmetric_units()


def distance(x: Array, nominal: Array) -> float:
    """Squared distance in the prior's metric, from its formula."""
    n = len(nominal)
    total = float(np.sum((x[10 * n :] / np.repeat(SPREAD, n)) ** 2))
    for pi, prior in zip(x[: 10 * n].reshape(-1, 10), nominal, strict=True):
        change = np.linalg.solve(pseudo_inertia(prior), pseudo_inertia(pi) - pseudo_inertia(prior))
        total += float(np.trace(change @ change))
    return total


# ---- what a body can have ----


def test_the_margin_is_that_of_the_shape() -> None:
    ball, box = np.eye(3), np.diag([5.0, 10.0, 13.0])  # moments of a box of 3 x 2 x 1: second moments 9 : 4 : 1
    at = np.array([0.3, -2.0, 1.0])
    assert margin(lump(2.0, at, ball)) == pytest.approx(1.0)
    assert margin(lump(2.0, at, box)) == pytest.approx(1.0 / 9.0)
    flat, impossible = lump(2.0, at, np.diag([1.0, 1.0, 2.0])), lump(2.0, at, np.diag([1.0, 1.0, 2.5]))
    assert margin(flat) == pytest.approx(0.0, abs=1e-12)
    assert margin(impossible) == pytest.approx(-0.25 / 1.25)
    assert margin(-lump(2.0, at, ball)) == -np.inf
    np.testing.assert_allclose(margin(np.stack([lump(1.0, at, ball), lump(1.0, at, box)])), [1.0, 1.0 / 9.0])


@given(st.lists(st.floats(-1.0, 1.0), min_size=10, max_size=10))
def test_log_cholesky_coordinates_are_always_a_body(theta: list[float]) -> None:
    assert is_consistent(log_cholesky(np.array(theta)))


def test_what_is_no_number_is_no_body() -> None:
    assert not is_consistent(np.full((2, 10), np.nan))


# ---- the convex problem ----


def test_noise_free_data_of_another_arm_give_that_arm() -> None:
    rng = np.random.default_rng(0)
    nominal = NOMINAL["lwa4d_7dof"]
    L = np.linalg.cholesky(pseudo_inertia(nominal))
    links = from_pseudo_inertia(L @ pseudo_inertia(bodies(rng, 7)) @ L.swapaxes(-1, -2))
    truth = np.concatenate([links.ravel(), rng.uniform(0, 1, 28)])
    R = 1e6 * np.triu(rng.normal(size=(98, 98))) + 1e7 * np.eye(98)
    change = np.linalg.solve(whitened(nominal), (estimate(R, R @ truth, nominal) - truth)[:70])
    np.testing.assert_allclose(change, 0.0, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_an_estimate_that_is_possible_moves_by_less_than_a_thousandth_of_its_standard_error(seed: int) -> None:
    """WEIGHT s |dx| standard errors, s <= 1 being the largest standard error and |dx| <= 10 the way from the prior."""
    rng = np.random.default_rng(seed)
    nominal = NOMINAL["lwa4d_3dof"]
    metric = np.zeros((42, 42))
    metric[:30, :30], metric[30:, 30:] = whitened(nominal), np.diag(np.repeat(SPREAD, 3))
    Q = np.linalg.qr(rng.normal(size=(42, 42)))[0]
    A = 10 ** rng.uniform(0, 4, 42)[:, None] * Q  # standard errors from 1 to 1e-4 in nominal sizes
    truth = np.concatenate([np.linalg.solve(whitened(nominal), (0.1 * nominal).ravel()), np.full(12, 0.2)])
    R = A @ np.linalg.inv(metric)
    prior = np.concatenate([nominal.ravel(), np.zeros(12)])
    free = prior + metric @ truth
    x = estimate(R, R @ free, nominal)
    assert 0 < np.linalg.norm(R @ (x - free)) <= WEIGHT * np.linalg.norm(truth)  # over all combinations: Cauchy-Schwarz
    assert WEIGHT * np.linalg.norm(truth) < 1e-3


def test_directions_the_data_do_not_see_stay_at_the_prior() -> None:
    rng = np.random.default_rng(1)
    nominal = NOMINAL["lwa4d_3dof"]
    prior = np.concatenate([nominal.ravel(), np.zeros(12)])
    R = np.zeros((42, 42))
    R[0, [0, 30]] = 1e3, 2e3  # the first link's mass and the first joint's viscous friction, together
    x = estimate(R, R @ prior + 1e2 * np.eye(42)[0], nominal)
    assert R[0] @ x == pytest.approx(R[0] @ prior + 1e2, abs=1e-3)
    np.testing.assert_allclose(x[10:30], prior[10:30], rtol=1e-9, atol=1e-12)  # the other links
    np.testing.assert_allclose(x[31:], 0.0, atol=1e-9)  # and joints
    np.testing.assert_array_equal(estimate(np.zeros((42, 42)), rng.normal(size=42), nominal), prior)
    np.testing.assert_array_equal(estimate(np.zeros((0, 42)), np.zeros(0), nominal), prior)
    # rows that rounding has left of a lower rank know nothing either
    thin = np.vstack([1e6 * R[:1], 1e-10 * rng.normal(size=(41, 42))])
    x = estimate(thin, thin @ prior + rng.normal(size=42), nominal)
    np.testing.assert_allclose(x[10:30], prior[10:30], rtol=1e-6, atol=1e-9)


def edge_case(seed: int, n: int, noise: float) -> tuple[Array, Array, Array]:
    """A factor, a right-hand side with much noise, and the nominal links (n, 10)."""
    rng = np.random.default_rng(seed)
    nominal, size = bodies(rng, n), 14 * n
    R = np.triu(rng.normal(size=(size, size))) + 4 * np.eye(size)
    z = R @ np.concatenate([nominal.ravel(), np.full(4 * n, 0.1)]) + noise * rng.normal(size=size)
    return R, z, nominal


def _nearest_by_log_cholesky(R: Array, z: Array, nominal: Array) -> tuple[float, Array]:
    """The same minimum without a cone: least squares in log-Cholesky coordinates of J - FLOOR J0, from some starts."""
    from scipy.optimize import least_squares

    n = len(nominal)
    L = np.linalg.cholesky(pseudo_inertia(nominal))
    metric = np.linalg.inv(whitened(nominal))

    def parameters(theta: Array) -> Array:
        inner = pseudo_inertia(np.stack([log_cholesky(each) for each in theta[: 10 * n].reshape(n, 10)]))
        links = from_pseudo_inertia(L @ (1.01 * FLOOR * np.eye(4) + inner) @ L.swapaxes(-1, -2))
        return np.concatenate([links.ravel(), theta[10 * n :]])

    def residual(theta: Array) -> Array:
        x = parameters(theta)
        prior = np.concatenate([metric @ (x[: 10 * n] - nominal.ravel()), x[10 * n :] / np.repeat(SPREAD, n)])
        return np.concatenate([R @ x - z, np.sqrt(WEIGHT) * prior])

    low = np.concatenate([np.full(10 * n, -30.0), np.repeat(LOWER, n)])
    best: Any = None
    for seed in range(2):
        start = 0.1 * np.random.default_rng(seed).normal(size=14 * n)
        start[10 * n :] = 0.5
        found = least_squares(residual, start, bounds=(low, np.inf), xtol=1e-15, ftol=1e-15, gtol=1e-12, max_nfev=400)
        best = found if best is None or found.cost < best.cost else best
    return 2.0 * float(best.cost), parameters(best.x)


@pytest.mark.parametrize("seed", [5, 6])
def test_the_minimum_is_that_of_log_cholesky_coordinates(seed: int) -> None:
    """Two roads: a cone and Clarabel, or coordinates without bounds and scipy."""
    R, z, nominal = edge_case(seed, 1, 3.0)
    x = estimate(R, z, nominal)
    cost = float(np.sum((R @ x - z) ** 2)) + WEIGHT * distance(x, nominal)
    other, y = _nearest_by_log_cholesky(R, z, nominal)
    assert margin(x[:10]) < 1e-3  # it is at the edge, or this would show nothing
    assert other * (1 - 1e-5) <= cost <= other * (1 + 1e-7)  # the other road slows down near the edge
    np.testing.assert_allclose(x, y, atol=1e-4)


@pytest.mark.parametrize("noise", [3.0, 100.0, 1e3])
@pytest.mark.parametrize("n", [1, 3])
def test_the_minimum_has_a_certificate(n: int, noise: float) -> None:
    """Slopes that are positive semidefinite, times the way to the edge, bound what any possible x could gain (KKT)."""
    R, z, nominal = edge_case(5, n, noise)
    x = estimate(R, z, nominal)
    T = whitened(nominal)
    y = np.linalg.solve(T, x[: 10 * n] - nominal.ravel())
    slope = 2.0 * R.T @ (R @ x - z)
    links = (T.T @ slope[: 10 * n] + 2.0 * WEIGHT * y).reshape(n, 10)
    joints = slope[10 * n :] + 2.0 * WEIGHT * x[10 * n :] / np.repeat(SPREAD, n) ** 2
    S = np.tensordot(links, _UNITS, 1)
    Y = np.tensordot(y.reshape(n, 10), _UNITS, 1) + (1.0 - 1.01 * FLOOR) * np.eye(4)
    size = np.abs(S).max()
    assert size > 1e-3 * noise  # a bound pushes, or this would show nothing
    assert np.linalg.eigvalsh(S).min() >= -1e-6 * size
    bounded = np.repeat(np.isfinite(LOWER), n)
    assert (joints[bounded] >= -1e-6 * size).all()
    np.testing.assert_allclose(joints[~bounded], 0.0, atol=1e-6 * size)
    gain = float(np.sum(S * Y) + joints[bounded] @ x[10 * n :][bounded])
    assert abs(gain) <= 1e-6 * (float(np.sum((R @ x - z) ** 2)) + WEIGHT * distance(x, nominal))


def test_the_minimum_does_not_depend_on_frames_or_units() -> None:
    """Links described in other frames, turned, shifted and in other units, give the same bodies."""
    rng = np.random.default_rng(6)
    nominal, n = bodies(rng, 2), 2
    R = np.triu(rng.normal(size=(28, 28))) + np.eye(28)
    z = R @ np.concatenate([nominal.ravel(), np.zeros(8)]) + 10.0 * rng.normal(size=28)
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    move = np.eye(4)
    move[:3] = np.column_stack([100.0 * turn, [30.0, -20.0, 10.0]])  # from metres to centimetres, elsewhere

    def moved(x: Array) -> Array:
        return np.concatenate(
            [from_pseudo_inertia(move @ pseudo_inertia(x[:20].reshape(2, 10)) @ move.T).ravel(), x[20:]]
        )

    M = np.column_stack([moved(column) for column in np.eye(28)])
    there = estimate(R @ np.linalg.inv(M), z, moved(np.append(nominal, np.zeros(8)))[:20].reshape(n, 10))
    here = estimate(R, z, nominal)
    assert margin(here[:20].reshape(2, 10)).min() < 1e-2
    np.testing.assert_allclose(np.linalg.solve(M, there), here, rtol=1e-4, atol=1e-4)


def test_bounds_hold_and_a_parameter_can_be_fixed() -> None:
    rng = np.random.default_rng(7)
    nominal = NOMINAL["lwa4d_planar"]
    R, z = np.eye(28), 100.0 * rng.normal(size=28)
    upper = np.array([np.inf, np.inf, 0.3, 0.3, 0.0, 0.2, 1.0, -0.0])
    lower = np.array([0, 0, 0, 0, 0, 0, -1.0, 0.0])
    x = estimate(R, z, nominal, lower=lower, upper=upper)[20:]
    assert (x >= lower).all()
    assert (x <= upper).all()
    assert x[4] == x[7] == 0.0


SCALES = st.floats(-12.0, 12.0).map(lambda power: 10.0**power)


@given(seed=st.integers(0, 2**32 - 1), rank=st.integers(0, 28), size=SCALES, spread=SCALES, noise=SCALES)
@settings(deadline=None, max_examples=100)
def test_whatever_the_data_the_model_is_possible_and_no_worse_than_the_nominal_one(
    seed: int, rank: int, size: float, spread: float, noise: float, tmp_path_factory: pytest.TempPathFactory
) -> None:
    rng = np.random.default_rng(seed)
    nominal = NOMINAL["lwa4d_planar"]
    prior = np.concatenate([nominal.ravel(), np.zeros(8)])
    R = size * np.triu(rng.normal(size=(28, 28))) * spread ** rng.uniform(0, 1, 28)
    R[rank:] = 0.0
    z = R @ prior + noise * rng.normal(size=28)
    x = estimate(R, z, nominal)
    assert np.isfinite(x).all()
    assert is_consistent(x[:20].reshape(2, 10))
    assert (x[20:26] >= 0).all()
    rounding = 100 * np.finfo(float).eps * np.linalg.norm(np.abs(R) @ np.abs(x) + np.abs(z))
    assert np.linalg.norm(R @ x - z) <= np.linalg.norm(R @ prior - z) * (1 + 1e-9) + rounding
    path = tmp_path_factory.mktemp("hostile") / "arm.xml"
    write(
        model_path("lwa4d_planar"), path, x[:20].reshape(2, 10), viscous=x[20:22], coulomb=x[22:24], armature=x[24:26]
    )
    model = load_model(str(path))
    moments = np.asarray(model.body_inertia)[np.asarray(model.jnt_bodyid)]
    assert (moments > 0).all()
    assert (moments.sum(axis=1) >= 2 * moments.max(axis=1)).all()
    np.testing.assert_allclose(standard_parameters(model), x[:20].reshape(2, 10), rtol=1e-9, atol=1e-12 * abs(x).max())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"R": np.full((14, 14), np.nan)}, "factor .* holds nan"),
        ({"z": np.full(14, np.inf)}, "right-hand side .* holds inf"),
        ({"z": np.full(14, 1e200)}, "1e\\+200; check the data's units"),
        ({"R": np.eye(13)}, "shape"),
        ({"prior": np.full(14, np.nan)}, "parameter 1 of the nominal model is nan"),
        ({"prior": np.concatenate([np.zeros(10), np.zeros(4)])}, "link 1 .* has no mass"),
        ({"prior": np.concatenate([lump(1.0, np.zeros(3), np.diag([1.0, 1.0, 3.0])), np.zeros(4)])}, "link 1"),
        ({"prior": np.concatenate([NOMINAL["lwa4d_7dof"][0], [-1.0, 0, 0, 0]])}, "joint parameter 1 .* is -1, outside"),
        ({"spread": np.zeros(4)}, "spread of joint parameter 1 is 0"),
        ({"weight": 0.0}, "weight is 0"),
    ],
)
def test_a_problem_that_makes_no_sense_is_one_clear_error(changes: dict[str, Any], words: str) -> None:
    keys: dict[str, Any] = {"R": np.eye(14), "z": np.zeros(14), **changes}
    with pytest.raises(IdentificationError, match=words) as caught:
        estimate(keys.pop("R"), keys.pop("z"), NOMINAL["lwa4d_7dof"][:1], **keys)
    assert "\n" not in str(caught.value)


def test_a_flat_nominal_link_is_thickened_a_little() -> None:
    plate = lump(2.0, np.array([0.1, 0.0, 0.0]), np.diag([1.0, 1.0, 2.0]))
    x = estimate(np.zeros((1, 14)), np.zeros(1), plate[None])
    assert 0 < margin(x[:10]) < 1e-5
    np.testing.assert_allclose(x[:10], plate, rtol=1e-5, atol=1e-12)


# ---- the file ----

# Everything that can go wrong with a file: two folders, a part of its own, meshes, welded bodies, a tilted inertia,
# masses from shapes and made to measure, defaults, a joint that describes its own frame, comments.
ARM = """<!-- An arm by somebody else. -->
<mujoco model="foreign">
  <compiler angle="degree" inertiafromgeom="true" boundmass="0.5" meshdir="shapes"/>
  <include file="parts/assets.xml"/>
  <default><joint damping="1 2 3" armature="0.3"/></default>
  <worldbody>
    <geom type="plane" size="1 1 .1"/>
    <body name="table" pos="0.1 0.2 0.3" euler="0 0 20">
      <geom type="box" size=".2 .2 .01"/>
      <body name="arm1" pos="0 0 0.2" euler="15 0 0">
        <!-- the shoulder -->
        <joint name="turn" axis="0 0.6 0.8" pos="0.01 -0.02 0.03" ref="10"/>
        <geom type="mesh" mesh="wedge"/>
        <body name="spacer" pos="0 0 0.3" euler="0 30 5">
          <geom type="sphere" size="0.05"/>
          <frame pos="0 0.01 0">
            <body name="arm2" pos="0.1 0 0">
              <inertial pos="0.02 0 0.1" euler="20 5 0" mass="2" diaginertia="0.02 0.015 0.01"/>
              <joint name="push" type="slide" axis="1 0 0" range="-0.2 0.3" limited="true" damping="0.2"/>
              <geom type="capsule" size=".03" fromto="0 0 0 0 0 .2"/>
              <body name="arm3" pos="0 0 0.2" euler="0 0 57">
                <joint name="bend" axis="0 1 0" actuatorfrcrange="-5 5" stiffness="2" springref="0.1"/>
                <geom type="box" size="0.03 0.03 0.1" pos="0 0 0.1"/>
                <body name="hand" pos="0 0 0.2" euler="11 0 0">
                  <geom type="sphere" size="0.03"/>
                  <site name="attachment_site" pos="0 0 0.03" euler="0 17 0"/>
                </body>
              </body>
            </body>
          </frame>
        </body>
      </body>
    </body>
  </worldbody>
  <include file="parts/motors.xml"/>
</mujoco>
"""
ASSETS = '<mujocoinclude><asset><mesh name="wedge" file="wedge.obj"/></asset></mujocoinclude>'
MOTORS = """<mujocoinclude>
  <actuator>
    <motor joint="turn"/>
    <motor joint="push" ctrlrange="-100 100" ctrllimited="true"/>
    <motor joint="bend" ctrlrange="-20 20" ctrllimited="true"/>
  </actuator>
</mujocoinclude>"""
WEDGE = "v 0 0 0\nv .2 0 0\nv 0 .1 0\nv 0 0 .3\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    home = tmp_path / "theirs"
    for name, text in {
        "arm.xml": ARM,
        "parts/assets.xml": ASSETS,
        "parts/motors.xml": MOTORS,
        "shapes/wedge.obj": WEDGE,
    }.items():
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        (home / name).write_text(text)
    return home / "arm.xml"


def write(source: Path, destination: Path, pi: Array, **changes: Any) -> None:
    n = len(pi)
    joints = {
        "armature": np.full(n, 0.1),
        "viscous": np.full(n, 1.0 / 3.0),
        "coulomb": np.full(n, 1.0 / 7.0),
        **changes,
    }
    write_model(source, destination, pi=pi, **{"about": "made by a test -- with --- hyphens-", **joints})


@pytest.mark.parametrize("name", [*ARMS, "foreign"])
def test_what_is_written_is_read_back(name: str, foreign: Path, tmp_path: Path) -> None:
    source = foreign if name == "foreign" else model_path(name)
    old = load_model(str(source))
    pi = bodies(np.random.default_rng(3), old.njnt)
    made = tmp_path / "some folder" / "new.xml"
    write(source, made, pi)
    new = load_model(str(made))
    # 1e-12 of each link's size: mass, the largest first moment it could have, trace of the inertia
    size = np.stack([pi[:, 0], np.sqrt(pi[:, 0] * pi[:, [4, 6, 9]].sum(1)), pi[:, [4, 6, 9]].sum(1)], axis=1)
    assert (np.abs(standard_parameters(new) - pi) <= 1e-12 * np.repeat(size, [1, 3, 6], axis=1)).all()
    for field, value in {"armature": 0.1, "damping": 1.0 / 3.0, "frictionloss": 1.0 / 7.0, "dampingpoly": 0.0}.items():
        np.testing.assert_array_equal(getattr(new, f"dof_{field}"), value)
    for field in (
        "jnt_range",
        "jnt_stiffness",
        "qpos0",
        "qpos_spring",
        "geom_size",
        "geom_pos",
        "mesh_vert",
        "key_qpos",
    ):
        np.testing.assert_array_equal(getattr(new, field), getattr(old, field))
    np.testing.assert_array_equal(chain_of(new).pos, chain_of(old).pos)
    assert made.read_text().startswith("<!-- made by a test")
    assert [path.name for path in made.parent.iterdir()] == ["new.xml"]
    if name == "foreign":
        assert "the shoulder" in made.read_text()
        welded = [new.body(body).mass[0] for body in ("spacer", "hand")]
        assert welded == [0.0, 0.0]


@pytest.mark.parametrize("name", [*ARMS, "foreign"])
def test_nominal_parameters_written_back_are_the_nominal_arm(name: str, foreign: Path, tmp_path: Path) -> None:
    """Two roads: parameters through a file, and MuJoCo's own terms of the source."""
    import mujoco

    source = foreign if name == "foreign" else model_path(name)
    old = load_model(str(source), ArmEdits(armature=0.0, friction=None))
    write(source, tmp_path / "new.xml", standard_parameters(old), armature=np.zeros(old.njnt))
    new = load_model(str(tmp_path / "new.xml"))
    rng = np.random.default_rng(4)
    data, again = mujoco.MjData(old), mujoco.MjData(new)
    for _ in range(5):
        data.qpos[:], data.qvel[:], data.qacc[:] = rng.uniform(-1, 1, (3, old.nv))
        again.qpos[:], again.qvel[:], again.qacc[:] = data.qpos, data.qvel, data.qacc
        bias, mass = [], []
        for model, one in ((old, data), (new, again)):
            mujoco.mj_forward(model, one)
            M = np.empty((model.nv, model.nv))
            mujoco.mj_fullM(model, one, M)
            bias.append(one.qfrc_bias.copy())
            mass.append(M)
        np.testing.assert_allclose(bias[1], bias[0], rtol=1e-11, atol=1e-12 * np.abs(bias[0]).max())
        np.testing.assert_allclose(mass[1], mass[0], rtol=1e-11, atol=1e-12 * np.abs(mass[0]).max())


@pytest.mark.parametrize("tilt", [1e-6, 1e-7, 1e-9])
def test_principal_axes_a_little_off_the_bodys_stay_so(tilt: float, tmp_path: Path) -> None:
    """MuJoCo takes an inertial frame for the body's own where they are closer than about a microradian."""
    I = np.diag([0.3, 0.2, 0.4])
    I[0, 2] = I[2, 0] = 0.1 * tilt
    pi = np.tile(lump(2.0, np.zeros(3), I), (2, 1))
    write(model_path("lwa4d_planar"), tmp_path / "new.xml", pi)
    np.testing.assert_allclose(standard_parameters(load_model(str(tmp_path / "new.xml"))), pi, atol=1e-15)


def test_a_written_model_can_be_written_again_and_changed(foreign: Path, tmp_path: Path) -> None:
    pi = bodies(np.random.default_rng(8), 3)
    write(foreign, tmp_path / "once.xml", pi)
    write(tmp_path / "once.xml", tmp_path / "deep" / "twice.xml", 2.0 * pi)
    np.testing.assert_allclose(
        standard_parameters(load_model(str(tmp_path / "deep" / "twice.xml"))), 2.0 * pi, rtol=1e-9
    )
    load_model(str(tmp_path / "once.xml"), ArmEdits(payload=Payload(mass=1.0), mass_scale=1.1), tool_body=True)


def test_friction_too_stiff_for_the_source_takes_another_integrator(tmp_path: Path) -> None:
    pi = NOMINAL["lwa4d_7dof"]
    write(model_path("lwa4d_7dof"), tmp_path / "stiff.xml", pi, viscous=np.full(7, 1e3), armature=np.zeros(7))
    load_model(str(tmp_path / "stiff.xml"))
    assert "too stiff" in (tmp_path / "stiff.xml").read_text()
    with pytest.raises(ModelError, match="too stiff"):
        load_model(str(tmp_path / "stiff.xml"), integrator="RK4")
    write(model_path("lwa4d_7dof"), tmp_path / "soft.xml", pi, armature=np.full(7, 0.1))
    assert 'integrator="RK4"' in (tmp_path / "soft.xml").read_text()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"pi": np.tile(lump(1.0, np.zeros(3), np.diag([1.0, 1.0, 2.5])), (3, 1))}, "link 1: no body has this inertia"),
        ({"pi": np.full((3, 10), np.nan)}, "link 1: m is nan"),
        ({"pi": NOMINAL["lwa4d_planar"]}, "2 links do not fit an arm of 3"),
        ({"viscous": np.array([0.0, -1.0, 0.0])}, "joint 2: damping is -1; it must be at least 0"),
        ({"armature": np.array([0.0, 0.0, np.inf])}, "joint 3: armature is inf"),
    ],
)
def test_what_cannot_be_is_not_written(changes: dict[str, Any], words: str, tmp_path: Path) -> None:
    pi = changes.pop("pi", NOMINAL["lwa4d_3dof"])
    with pytest.raises(IdentificationError, match=words):
        write(model_path("lwa4d_3dof"), tmp_path / "new.xml", pi, **changes)
    assert not list(tmp_path.iterdir())


def test_sources_that_cannot_be_edited_are_refused_and_nothing_is_left(foreign: Path, tmp_path: Path) -> None:
    pi = bodies(np.random.default_rng(9), 3)
    out = tmp_path / "out"
    with pytest.raises(IdentificationError, match="is the nominal model itself"):
        write(foreign, foreign.parent / "." / "arm.xml", pi)
    doubled = ARM.replace('<body name="table"', '<replicate count="1"><body name="table"').replace(
        "</worldbody>", "</replicate></worldbody>"
    )
    (foreign.parent / "copies.xml").write_text(doubled)
    with pytest.raises(IdentificationError, match="replicates or attaches"):
        write(foreign.parent / "copies.xml", out / "new.xml", pi)
    with pytest.raises(ModelError, match="no such file"):
        write(tmp_path / "nowhere.xml", out / "new.xml", pi)
    assert not out.exists()
    out.write_text("a file where a folder should be")
    with pytest.raises(RecordError, match="cannot write the model"):
        write(foreign, out / "new.xml", pi)
    (tmp_path / "folder" / "new.xml").mkdir(parents=True)
    with pytest.raises(RecordError, match="cannot write the model"):
        write(foreign, tmp_path / "folder" / "new.xml", pi)
    assert [path.name for path in (tmp_path / "folder").iterdir()] == ["new.xml"]
