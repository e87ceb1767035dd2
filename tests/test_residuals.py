import jax
import jax.numpy as jnp
import numpy as np
import pytest
from handmade import LENS, looking
from hypothesis import given, settings
from hypothesis import strategies as st
from plain_residuals import joint_distances

from autoreg.camera import Camera
from autoreg.geometry import rotation_from_vector
from autoreg.solve.joint_data import (
    ASPECT,
    CENTRE,
    FOCAL,
    PARAMETERS,
    RADIAL,
    RATIO,
    ROTATION,
    SECOND_RADIAL,
    TANGENTIAL,
    TRANSLATION,
    JointData,
    parameter_scale,
)
from autoreg.solve.residuals import (
    distances_and_jacobian,
    moved_projection,
    project,
    robust,
    robust_curvature,
    small_rotation,
)

settings.register_profile("autoreg", deadline=None, derandomize=True, max_examples=40)
settings.load_profile("autoreg")

seeds = st.integers(0, 10**6)
compiled_distances, compiled_jacobian = jax.jit(joint_distances), jax.jit(distances_and_jacobian)


@pytest.fixture(autouse=True)
def in_double_precision():
    with jax.enable_x64(True):
        yield


def random_camera(rng: np.random.Generator) -> Camera:
    fx, fy = rng.uniform(500, 3000, 2)
    dist = rng.uniform(-1, 1, 8) * [0.2, 0.1, 0.003, 0.003, 0.05, 0.2, 0.1, 0.05]
    return Camera(1600, 1200, fx, fy, *rng.uniform(400, 900, 2), tuple(dist))


def intrinsics_of(camera: Camera) -> np.ndarray:
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.dist])


def scene(seed: int, n: int = 30) -> tuple[JointData, Camera]:
    """Joints on the ground in front of a camera, measured beside where they are."""
    rng = np.random.default_rng(seed)
    camera = random_camera(rng)
    pose = looking([0.3, -3.0, rng.uniform(1, 2)], [0.0, 1.0, 0.0], rng.uniform(-0.2, 0.2))
    ground = rng.uniform([-1.0, -1.0], [1.0, 3.0], (n, 2))
    angle = rng.uniform(0, 2 * np.pi, n)
    seen = camera.project(pose.apply(np.column_stack([ground, np.zeros(n)])))
    data = JointData(
        ground=ground,
        measured_px=seen + rng.normal(0, 2, (n, 2)),
        normal=np.column_stack([np.cos(angle), np.sin(angle)]),
        weight=rng.uniform(0.2, 2.0, n),
        R=pose.R,
        t=pose.t,
        intrinsics=intrinsics_of(camera),
        scale=parameter_scale(1.5, 1000.0),
    )
    return data, camera


def small_parameters(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed + 1)
    camera = [0.1, 0.02, 0.02, 0.05, 0.05, 0.05, 0.005, 0.005]
    return rng.uniform(-1, 1, PARAMETERS) * ([0.05] * 3 + [0.1] * 3 + [0.1] + camera)


@given(seeds)
def test_points_project_as_by_the_camera(seed):
    rng = np.random.default_rng(seed)
    camera = random_camera(rng)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (20, 2)), np.ones(20)]) * rng.uniform(0.5, 20, (20, 1))
    px = project(jnp.asarray(intrinsics_of(camera)), jnp.asarray(points))
    np.testing.assert_allclose(px, camera.project(points), atol=1e-9)


@given(seeds)
def test_a_small_rotation_is_the_rotation(seed):
    vector = np.random.default_rng(seed).uniform(-0.1, 0.1, 3)
    np.testing.assert_allclose(small_rotation(jnp.asarray(vector)), rotation_from_vector(vector), atol=1e-13)


@given(seeds)
def test_parameters_move_pose_lattice_and_camera_as_their_names_say(seed):
    data, camera = scene(seed)
    p = small_parameters(seed) * data.scale
    turn = rotation_from_vector(p[ROTATION])
    ground = data.ground * np.exp([0.5 * p[RATIO], -0.5 * p[RATIO]])
    points_cam = (ground @ data.R[:, :2].T + data.t) @ turn.T + p[TRANSLATION]
    fx = camera.fx * np.exp(p[FOCAL])
    fy = camera.fy * np.exp(p[FOCAL] + p[ASPECT])
    k1, k2, p1, p2, *rest = camera.dist
    dx, dy = p[CENTRE]
    by_x, by_y = p[TANGENTIAL]
    dist = (k1 + p[RADIAL], k2 + p[SECOND_RADIAL], p1 + by_x, p2 + by_y, *rest)
    moved = Camera(1600, 1200, fx, fy, camera.cx + dx, camera.cy + dy, dist)
    expected = ((moved.project(points_cam) - data.measured_px) * data.normal).sum(1)
    got = joint_distances(jnp.asarray(small_parameters(seed)), data)
    np.testing.assert_allclose(got, expected, atol=1e-8)


@given(seeds)
def test_the_jacobian_is_what_finite_differences_give(seed):
    data, _ = scene(seed)
    at = small_parameters(seed)
    distances, jacobian = compiled_jacobian(jnp.asarray(at), data)
    np.testing.assert_allclose(distances, compiled_distances(jnp.asarray(at), data), atol=1e-10)
    for i in range(PARAMETERS):
        step = 1e-6 * np.eye(PARAMETERS)[i]
        ahead, behind = (compiled_distances(jnp.asarray(at + s), data) for s in (step, -step))
        difference = (np.asarray(ahead) - np.asarray(behind)) / 2e-6
        tolerance = 1e-6 * max(1.0, np.abs(difference).max())
        np.testing.assert_allclose(jacobian[:, i], difference, atol=tolerance)


def test_the_jacobian_is_finite_where_nothing_moves_and_nothing_bends():
    data, _ = scene(3)
    data = data._replace(intrinsics=np.r_[data.intrinsics[:4], LENS, np.zeros(4)])
    _, jacobian = distances_and_jacobian(jnp.zeros(PARAMETERS), data)
    assert np.isfinite(jacobian).all()
    assert (np.linalg.norm(jacobian, axis=0) > 1).all()


def test_a_projection_without_motion_is_the_pose_and_the_camera():
    data, _ = scene(4)
    projection = moved_projection(jnp.zeros(PARAMETERS), data)
    np.testing.assert_array_equal(projection.intrinsics, data.intrinsics)
    plane = np.column_stack([data.R[:, :2], data.t])
    np.testing.assert_allclose(projection.cam_from_plane, plane, atol=1e-15)


def test_squares_of_robust_residuals_are_cauchys_loss_and_keep_the_sign():
    r = np.r_[-np.geomspace(1e-9, 1e6, 400), 0.0, np.geomspace(1e-9, 1e6, 400)]
    got = np.asarray(robust(jnp.asarray(r))[0])
    np.testing.assert_allclose(got**2, np.log1p(r**2), rtol=1e-12)
    np.testing.assert_array_equal(np.sign(got), np.sign(r))


def test_robust_residuals_have_slope_one_at_zero_and_no_jump_beside_it():
    r = jnp.asarray(np.r_[0.0, np.geomspace(1e-6, 1e-2, 200)])
    _, slope = robust(r)
    # Their series is r - r^3 / 4, up to a term of order r^5.
    np.testing.assert_allclose(slope, 1 - 0.75 * r**2, atol=1e-7)


def test_the_stated_slope_is_the_derivative():
    r = jnp.asarray(np.r_[-np.geomspace(1e-2, 1e4, 100), np.geomspace(1e-2, 1e4, 100)])
    (_, slope), (derivative, _) = jax.jvp(robust, (r,), (jnp.ones_like(r),))
    np.testing.assert_allclose(slope, derivative, rtol=1e-12)


def test_the_curvature_is_the_losss_second_derivative():
    r = jnp.asarray(np.linspace(-5, 5, 101))
    second = jax.vmap(jax.grad(jax.grad(lambda x: 0.5 * jnp.log1p(x * x))))(r)
    np.testing.assert_allclose(robust_curvature(r), second, atol=1e-12)
