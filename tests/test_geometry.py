import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autoreg.geometry import (
    Rigid,
    angle_between_rotations,
    nearest_rotation,
    rotation_from_vector,
    vector_from_rotation,
)

settings.register_profile("autoreg", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("autoreg")

coordinates = st.floats(-10, 10)
vectors = st.tuples(coordinates, coordinates, coordinates).map(np.array)
rotations = vectors.map(lambda v: rotation_from_vector(v * (3.1 / max(3.1, float(np.linalg.norm(v))))))
rigids = st.builds(Rigid, rotations, vectors)


def assert_same_motion(a: Rigid, b: Rigid) -> None:
    assert np.rad2deg(angle_between_rotations(a.R, b.R)) < 1e-10
    np.testing.assert_allclose(a.t, b.t, atol=1e-12)


@given(vectors)
def test_a_rotation_is_orthogonal_and_keeps_the_handedness(vector):
    R = rotation_from_vector(vector)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-13)
    assert np.linalg.det(R) == pytest.approx(1.0, abs=1e-13)


@given(vectors)
def test_a_rotation_leaves_its_axis_alone(vector):
    np.testing.assert_allclose(rotation_from_vector(vector) @ vector, vector, atol=1e-12)


def test_a_quarter_turn_about_z_takes_x_to_y():
    R = rotation_from_vector(np.array([0.0, 0.0, np.pi / 2]))
    np.testing.assert_allclose(R @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)


@given(vectors.filter(lambda v: np.linalg.norm(v) < 3.1))
def test_the_vector_of_a_rotation_gives_it_back(vector):
    np.testing.assert_allclose(vector_from_rotation(rotation_from_vector(vector)), vector, atol=1e-12)


@pytest.mark.parametrize("angle", [1e-12, 1e-8, 1e-4, 1.0, np.pi - 1e-6, np.pi])
def test_the_angle_between_rotations_is_exact_from_the_smallest_to_half_a_turn(angle):
    R = rotation_from_vector(angle * np.array([2.0, -1.0, 2.0]) / 3.0)
    Q = rotation_from_vector(np.array([0.3, 1.2, -0.7]))
    assert angle_between_rotations(R, np.eye(3)) == pytest.approx(angle, rel=1e-9)
    assert angle_between_rotations(Q @ R, Q) == pytest.approx(angle, rel=1e-3, abs=1e-15)


@given(rotations, rotations)
def test_the_angle_between_rotations_does_not_depend_on_their_order(Ra, Rb):
    assert angle_between_rotations(Ra, Rb) == pytest.approx(angle_between_rotations(Rb, Ra), abs=1e-12)


@given(rotations, st.floats(1e-9, 1e-2))
def test_the_nearest_rotation_undoes_a_stretch(R, size):
    stretched = R @ np.diag([1 + size, 1.0, 1 - size])
    assert np.rad2deg(angle_between_rotations(nearest_rotation(stretched), R)) < 1e-10


def test_the_nearest_rotation_of_a_reflection_is_a_rotation():
    assert np.linalg.det(nearest_rotation(np.diag([1.0, 1.0, -0.9]))) == pytest.approx(1.0)


@given(rigids, rigids, rigids)
def test_composition_is_associative(a, b, c):
    assert_same_motion((a @ b) @ c, a @ (b @ c))


@given(rigids)
def test_a_motion_and_its_inverse_cancel_on_both_sides(motion):
    identity = Rigid(np.eye(3), np.zeros(3))
    assert_same_motion(motion @ motion.inverse, identity)
    assert_same_motion(motion.inverse @ motion, identity)


@given(rigids, rigids, vectors)
def test_composition_applies_the_right_motion_first(c_from_b, b_from_a, point):
    np.testing.assert_allclose(
        (c_from_b @ b_from_a).apply(point), c_from_b.apply(b_from_a.apply(point)), atol=1e-12
    )


@given(rigids)
def test_the_origin_in_a_goes_to_zero_in_b(motion):
    np.testing.assert_allclose(motion.apply(motion.origin_in_a), np.zeros(3), atol=1e-12)


def test_a_motion_applies_to_points_of_any_leading_shape():
    motion = Rigid(rotation_from_vector(np.array([0.1, 0.2, 0.3])), np.array([1.0, 2.0, 3.0]))
    points = np.arange(24.0).reshape(2, 4, 3)
    np.testing.assert_allclose(motion.apply(points)[1, 2], motion.apply(points[1, 2]), atol=1e-14)
