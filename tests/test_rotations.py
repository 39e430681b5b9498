import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from lwa4d_sim.interfaces import Array
from lwa4d_sim.rotations import from_rpy, rotation_matrix, rotation_vector, skew, to_rpy

ANGLES = [0.0, 1e-12, 1e-8, 1e-4, 0.3, 1.5, 3.0, np.pi - 1e-4, np.pi - 1e-8, np.pi - 1e-12]


def directions(count: int) -> Array:
    v = np.random.default_rng(0).normal(size=(count, 3))
    v = np.concatenate([v, np.eye(3), -np.eye(3)])
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


@pytest.mark.parametrize("angle", ANGLES)
def test_vector_and_matrix_are_inverse_to_each_other(angle: float) -> None:
    v = angle * directions(200)
    R = rotation_matrix(v)
    np.testing.assert_allclose(R, Rotation.from_rotvec(v).as_matrix(), atol=1e-14)
    back = rotation_vector(R)
    np.testing.assert_allclose(back, v, atol=1e-14)
    np.testing.assert_allclose(rotation_matrix(back), R, atol=3e-15)


def test_a_tiny_rotation_keeps_its_digits() -> None:
    v = 1e-9 * directions(50)
    np.testing.assert_allclose(rotation_vector(rotation_matrix(v)), v, rtol=0, atol=1e-22)


def test_half_a_turn_gives_one_of_the_two_axes() -> None:
    v = np.pi * directions(200)
    back = rotation_vector(rotation_matrix(v))
    np.testing.assert_allclose(np.abs((back * v).sum(-1)), np.pi**2, rtol=1e-14)


@settings(derandomize=True, deadline=None, max_examples=100)
@given(arrays(float, (2, 3), elements=st.floats(-7, 7)))
def test_matrices_are_rotations_and_vectors_the_shortest(v: Array) -> None:
    R = rotation_matrix(v)
    np.testing.assert_allclose(R @ np.swapaxes(R, -1, -2), np.broadcast_to(np.eye(3), R.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-14)
    assert (np.linalg.norm(rotation_vector(R), axis=-1) <= np.pi + 1e-15).all()
    np.testing.assert_allclose(rotation_matrix(rotation_vector(R)), R, atol=1e-14)


def test_skew_is_the_cross_product() -> None:
    v, u = np.random.default_rng(4).normal(size=(2, 5, 4, 3))
    np.testing.assert_allclose((skew(v) @ u[..., None])[..., 0], np.cross(v, u), atol=1e-15)


def test_rpy_turns_about_fixed_axes() -> None:
    rpy = np.random.default_rng(5).uniform(-1.5, 1.5, size=(100, 3))
    np.testing.assert_allclose(from_rpy(rpy), Rotation.from_euler("xyz", rpy).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(to_rpy(from_rpy(rpy)), rpy, atol=1e-13)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9, -np.pi / 2 + 1e-7])
def test_rpy_survives_gimbal_lock(pitch: float) -> None:
    rpy = np.random.default_rng(6).uniform(-3, 3, size=(100, 3))
    rpy[:, 1] = pitch
    R = from_rpy(rpy)
    np.testing.assert_allclose(from_rpy(to_rpy(R)), R, atol=1e-13)
