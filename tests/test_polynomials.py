import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from lwa4d_sim.errors import TrajectoryError
from lwa4d_sim.interfaces import Array
from lwa4d_sim.polynomials import PiecewisePolynomial, boundary_polynomial, differentiate, evaluate

FACTORIAL = np.array([1.0, 1.0, 2.0, 6.0])


@pytest.mark.parametrize(
    ("d", "expected"),
    [
        (1, [0, 1]),
        (2, [0, 0, 3, -2]),
        (3, [0, 0, 0, 10, -15, 6]),
        (4, [0, 0, 0, 0, 35, -84, 70, -20]),
    ],
)
def test_rest_to_rest_polynomials_are_the_known_ones(d: int, expected: list[float]) -> None:
    start, end = np.zeros(d), np.eye(d)[0]
    np.testing.assert_allclose(boundary_polynomial(1.0, start, end), expected, atol=1e-12)
    # Stretched to T, the coefficient of t^k shrinks by T^k.
    np.testing.assert_allclose(boundary_polynomial(2.0, start, end), expected / 2.0 ** np.arange(2 * d), atol=1e-12)


def boundary_values(d: int) -> st.SearchStrategy[Array]:
    return arrays(float, (2, d, 2), elements=st.floats(-10, 10))


@settings(derandomize=True, deadline=None, max_examples=150)
@given(T=st.floats(0.05, 20.0), values=st.integers(1, 4).flatmap(boundary_values))
def test_boundary_values_are_met(T: float, values: Array) -> None:
    start, end = values
    d = start.shape[0]
    c = boundary_polynomial(T, start, end)
    assert c.shape == (2 * d, 2)
    # In units of the interval a derivative of order k counts T^k; that is the scale on which digits can be asked for.
    scale = 1.0 + sum(T**k * np.abs(values[:, k]).max() for k in range(d))
    for k in range(d):
        np.testing.assert_allclose(evaluate(c, 0.0, k) * T**k / scale, start[k] * T**k / scale, atol=1e-12)
        # At T large terms cancel: forty times the rounding of their sum, which for the jerk of a septic is 1e-11.
        terms = evaluate(np.abs(c), T, k).max() * T**k / scale
        atol = 1e-14 * (1.0 + terms)
        np.testing.assert_allclose(evaluate(c, T, k) * T**k / scale, end[k] * T**k / scale, atol=atol)


def test_boundary_values_of_a_polynomial_give_it_back() -> None:
    rng = np.random.default_rng(1)
    for d in range(1, 5):
        c = rng.normal(size=(2 * d, 3))
        derivatives = [np.polynomial.polynomial.polyder(c, k) for k in range(d)]
        ends = [[np.polynomial.polynomial.polyval(t, dc) for dc in derivatives] for t in (0.0, 1.7)]
        np.testing.assert_allclose(boundary_polynomial(1.7, *ends), c, atol=1e-11)


def test_derivatives_agree_with_numpy() -> None:
    rng = np.random.default_rng(2)
    c, t = rng.normal(size=(6, 4)), rng.uniform(-2, 2, size=(50, 1))
    for k in range(8):
        expected = np.polynomial.polynomial.polyval(t[:, 0], np.polynomial.polynomial.polyder(c, k)).T
        np.testing.assert_allclose(evaluate(c, t, k), expected, rtol=1e-12, atol=1e-11)
    assert differentiate(c, 6).shape == (0, 4)


def test_each_column_may_have_its_own_time() -> None:
    rng = np.random.default_rng(3)
    T, start, end = np.array([0.5, 2.0, 7.0]), rng.normal(size=(3, 3, 2)), rng.normal(size=(3, 3, 2))
    together = boundary_polynomial(T[:, None], start, end)
    for s in range(3):
        np.testing.assert_allclose(together[:, s], boundary_polynomial(T[s], start[:, s], end[:, s]), rtol=1e-13)


def test_segments_join_and_a_knot_belongs_to_the_segment_it_starts() -> None:
    T = np.full(30, 0.1)  # 0.1 + 0.1 + ... misses 0.3, 0.6, ... by rounding
    steps = PiecewisePolynomial(T, np.arange(30.0)[None, :, None])
    np.testing.assert_array_equal(steps(np.arange(30) * 100 / 1000)[0][:, 0], np.arange(30))
    assert steps(np.array([0.1 - 1e-8]))[0] == 0.0
    assert steps(np.array([99.0]))[0] == 29.0


@pytest.mark.parametrize("T", [0.0, -1.0, np.nan])
def test_time_must_be_positive(T: float) -> None:
    with pytest.raises(TrajectoryError, match=r"T \(=.*\) must be a positive time"):
        boundary_polynomial(T, [0.0], [1.0])


def test_both_ends_need_the_same_shape() -> None:
    with pytest.raises(TrajectoryError, match=r"start \(shape \(1,\)\) and end \(shape \(2,\)\)"):
        boundary_polynomial(1.0, [0.0], [1.0, 0.0])
