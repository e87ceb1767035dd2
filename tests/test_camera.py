import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from autoreg.camera import Camera, fit_to_photo, same_aspect
from autoreg.errors import InputError

settings.register_profile("autoreg", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("autoreg")

LENS = Camera(1600, 1200, 1147.5, 1148.3, 817.7, 598.7, (-0.15, 0.03, 0.0004, -0.0003, 0.0))
RATIONAL = Camera(1600, 1200, 900.0, 905.0, 790.0, 610.0, (0.3, -0.2, 2e-3, -1e-3, 0.05, 0.4, -0.1, 0.02))


def between(low, high):
    return st.floats(low, high, allow_subnormal=False)


# Plain numbers, of which the tests make cameras: the run-time check of a tuple's items draws one at
# random, and hypothesis allows no randomness but its own while it draws.
cameras = st.tuples(
    between(400, 8000),
    between(0.95, 1.05),
    between(600, 1000),
    between(450, 750),
    st.one_of(
        st.tuples(*[between(-0.6, 0.6)] * 2, *[between(-5e-3, 5e-3)] * 2, between(-0.3, 0.3)),
        st.tuples(
            *[between(-3, 3)] * 2,
            *[between(-5e-3, 5e-3)] * 2,
            between(-1, 1),
            *[between(-0.5, 0.5)] * 3,
        ),
    ),
)


def made(drawn):
    f, aspect, cx, cy, dist = drawn
    return Camera(1600, 1200, f, f * aspect, cx, cy, dist)


def project_ideal(camera, xy):
    return camera.project(np.concatenate([xy, np.ones((len(xy), 1))], 1))


def spiral(radius, n=400):
    """Points that fill a disc evenly."""
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(n)
    r = radius * np.sqrt((np.arange(n) + 0.5) / n)
    return np.stack([r * np.cos(angle), r * np.sin(angle)], 1)


def smallest_stretch(camera, xy, step=1e-6):
    """Smaller eigenvalue of the distortion's (symmetric) Jacobian, by finite differences."""
    columns = [
        (camera.distort(xy + offset) - camera.distort(xy - offset)) / (2 * step)
        for offset in (np.array([step, 0.0]), np.array([0.0, step]))
    ]
    return np.linalg.eigvalsh(np.stack(columns, -1))[:, 0]


# --- the model -----------------------------------------------------------------------------------------


@given(cameras)
def test_projection_is_opencvs(drawn):
    camera = made(drawn)
    points = np.concatenate([spiral(1.0, 50), np.ones((50, 1))], 1) * np.linspace(0.5, 9, 50)[:, None]
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.K, np.array(camera.dist))
    expected = expected.reshape(-1, 2)
    np.testing.assert_allclose(camera.project(points), expected, rtol=1e-12, atol=1e-9)


def test_points_beside_or_behind_the_camera_have_no_pixel():
    points = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    assert np.isnan(LENS.project(points)).any(1).tolist() == [False, True, True]


@given(cameras)
def test_normalising_undoes_the_projection_inside_the_valid_field(drawn):
    camera = made(drawn)
    # Well inside the fold, and no further out than 63°, beyond which the pixels are thousands away.
    xy = spiral(min(0.9 * camera.valid_radius, 2.0))
    # The tangential part can fold a little earlier than the radial one: only the disc around the axis
    # that is free of any fold is the valid field.
    radius = np.hypot(*xy.T)
    folded = smallest_stretch(camera, xy) < 0.02
    xy = xy[radius < radius[folded].min(initial=np.inf)]
    px = project_ideal(camera, xy)
    got = camera.normalise(px)
    assert np.isfinite(got).all()
    assert np.abs(project_ideal(camera, got) - px).max() < 1e-9 * max(1.0, np.abs(px).max() / 1e5)
    np.testing.assert_allclose(got, xy, atol=1e-8)


@given(cameras)
def test_every_pixel_of_the_picture_normalises_to_its_own_ray_or_to_nothing(drawn):
    camera = made(drawn)
    u, v = np.meshgrid(np.linspace(-100, 1700, 30), np.linspace(-100, 1300, 30))
    px = np.stack([u, v], -1)
    rays = camera.unproject(px)
    known = np.isfinite(rays).all(-1)
    assert known.any()
    np.testing.assert_allclose(camera.project(rays[known]), px[known], atol=1e-9)
    assert np.hypot(*rays[known, :2].T).max() <= camera.valid_radius
    assert smallest_stretch(camera, rays[known, :2]).min() > -1e-4


@given(cameras)
def test_the_valid_field_ends_where_the_radial_distortion_stops_growing(drawn):
    camera = made(drawn)
    assume(camera.valid_radius < 100)
    k1, k2, _, _, k3, k4, k5, k6 = camera.dist
    radial = Camera(1600, 1200, 1000.0, 1000.0, 800.0, 600.0, (k1, k2, 0.0, 0.0, k3, k4, k5, k6))
    assert radial.valid_radius == camera.valid_radius
    r = np.linspace(0, 1, 2001) * camera.valid_radius
    inside = radial.distort(np.stack([r[:-1], 0 * r[:-1]], 1))[:, 0]
    assert (np.diff(inside) > 0).all()


def test_barrel_distortion_folds_at_its_textbook_radius():
    # d/dr (r - 0.3 r^3) = 1 - 0.9 r^2
    camera = Camera(1600, 1200, 1000.0, 1000.0, 800.0, 600.0, (-0.3, 0.0, 0.0, 0.0))
    assert camera.valid_radius == pytest.approx(1 / np.sqrt(0.9), rel=1e-12)
    edge = 1000 * camera.distort(np.array([camera.valid_radius, 0.0]))[0]
    px = 800.0 + edge * np.array([0.999, 1.001])
    xy = camera.normalise(np.stack([px, [600.0, 600.0]], 1))
    assert np.isfinite(xy[0]).all()
    assert np.isnan(xy[1]).all()


def test_a_distortion_that_never_folds_is_valid_far_beyond_any_lens():
    assert Camera(1600, 1200, 1e3, 1e3, 800.0, 600.0, (0.1, 0.0, 0.0, 0.0)).valid_radius >= 100
    assert Camera(1600, 1200, 1e3, 1e3, 800.0, 600.0).valid_radius == np.inf


def test_the_pole_of_a_rational_distortion_bounds_its_valid_field():
    # r / (1 - 0.25 r^2) grows all the way to its pole at r = 2.
    camera = Camera(1600, 1200, 1e3, 1e3, 800.0, 600.0, (0.0, 0.0, 0.0, 0.0, 0.0, -0.25, 0.0, 0.0))
    assert camera.valid_radius == pytest.approx(2.0, rel=1e-12)
    xy = spiral(1.95)
    np.testing.assert_allclose(camera.normalise(project_ideal(camera, xy)), xy, atol=1e-9)


def test_points_that_are_no_numbers_stay_none_and_disturb_no_others():
    px = np.array([[np.nan, 1.0], [np.inf, 5.0], [300.0, 200.0], [1e200, 0.0]])
    xy = LENS.normalise(px)
    assert np.isnan(xy[[0, 1]]).any(1).all()
    np.testing.assert_allclose(project_ideal(LENS, xy[2:3]), px[2:3], atol=1e-9)


@pytest.mark.parametrize("camera", [LENS, replace(LENS, dist=())])
@pytest.mark.parametrize("shape", [(2,), (0, 2), (3, 2), (2, 5, 2)])
def test_unprojecting_keeps_the_shape_and_gives_rays_with_z_one(camera, shape):
    px = np.linspace(100, 900, int(np.prod(shape))).reshape(shape)
    rays = camera.unproject(px)
    assert rays.shape == (*shape[:-1], 3)
    assert (rays[..., 2] == 1).all()
    np.testing.assert_allclose(camera.project(rays), px, atol=1e-9)


def test_a_million_pixels_normalise_in_two_seconds_of_one_core():
    px = np.random.default_rng(0).uniform(0, 1, (1_000_000, 2)) * [1599, 1199]
    start = time.process_time()
    LENS.normalise(px)
    assert time.process_time() - start < 2.0


# --- cameras of changed pictures: the pictures themselves are changed, and a blob is found again --------

BLOB_SIZE = (640, 480)


def blob_picture(centre_px):
    v, u = np.mgrid[: BLOB_SIZE[1], : BLOB_SIZE[0]]
    return 200 * np.exp(-((u - centre_px[0]) ** 2 + (v - centre_px[1]) ** 2) / (2 * 6.0**2))


def centroid(picture):
    v, u = np.mgrid[: picture.shape[0], : picture.shape[1]]
    return np.array([(picture * u).sum(), (picture * v).sum()]) / picture.sum()


@pytest.fixture(params=[(0.21, -0.14), (-0.25, 0.11)])
def seen(request):
    """A camera, a point of the scene, and the picture of a blob there."""
    dist = (-0.2, 0.05, 3e-2, -2e-2, 0.01, 0.02, 0.01, 0.005)
    camera = Camera(*BLOB_SIZE, 700.0, 650.0, 331.2, 222.9, dist)
    point = np.array([*request.param, 1.0])
    return camera, point, blob_picture(camera.project(point))


@pytest.mark.parametrize("size", [(320, 240), (1280, 960), (213, 160), (500, 480)])
def test_a_scaled_camera_sees_what_the_resized_picture_shows(seen, size):
    camera, point, picture = seen
    way = cv2.INTER_AREA if size[0] < BLOB_SIZE[0] else cv2.INTER_LINEAR
    resized = cv2.resize(picture, size, interpolation=way)
    scaled = camera.scaled(*size)
    assert (scaled.width, scaled.height) == size
    np.testing.assert_allclose(scaled.project(point), centroid(resized), atol=2e-3)


def test_a_cropped_camera_sees_what_the_cropped_picture_shows(seen):
    camera, point, picture = seen
    cropped = camera.cropped(31, 17, 560, 440)
    assert (cropped.width, cropped.height) == (560, 440)
    np.testing.assert_allclose(cropped.project(point), centroid(picture[17:457, 31:591]), atol=1e-6)


@pytest.mark.parametrize("quarters", [-1, 0, 1, 2, 3, 4, 6])
def test_a_turned_camera_sees_what_the_turned_picture_shows(seen, quarters):
    camera, (x, y, z), picture = seen
    turned_picture = np.rot90(picture, -quarters)
    turned = camera.turned(quarters)
    assert (turned.height, turned.width) == turned_picture.shape
    for _ in range(quarters % 4):
        x, y = -y, x
    np.testing.assert_allclose(turned.project(np.array([x, y, z])), centroid(turned_picture), atol=1e-6)


def test_a_mirrored_camera_sees_what_the_mirrored_picture_shows(seen):
    camera, point, picture = seen
    mirrored = camera.mirrored().project(point * [-1, 1, 1])
    np.testing.assert_allclose(mirrored, centroid(picture[:, ::-1]), atol=1e-6)


def test_four_quarter_turns_are_none():
    assert LENS.turned(1).turned(1).turned(1).turned(1) == LENS


def test_a_camera_from_a_focal_length_looks_through_the_middle_of_the_picture():
    camera = Camera.from_focal(640, 481, 700.0)
    assert (camera.cx, camera.cy, camera.fx, camera.fy) == (319.5, 240.0, 700.0, 700.0)


@pytest.mark.parametrize("part", [(-1, 0, 10, 10), (0, 0, 1601, 10), (1000, 1000, 10, 201), (0, 0, 0, 5)])
def test_a_crop_that_reaches_outside_the_picture_is_an_error(part):
    with pytest.raises(ValueError, match="1600 x 1200"):
        LENS.cropped(*part)


# --- validation ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("width", 0),
        ("height", -5),
        ("fx", 0.0),
        ("fy", -1.0),
        ("fx", float("nan")),
        ("cx", float("inf")),
        ("cy", float("nan")),
        ("dist", (0.1, float("nan"), 0.0, 0.0)),
        ("dist", (0.1, 0.2, 0.3)),
        ("dist", (0.0,) * 12),
    ],
)
def test_a_camera_names_the_field_that_is_wrong(name, value):
    fields = {"width": 10, "height": 10, "fx": 5.0, "fy": 5.0, "cx": 4.5, "cy": 4.5, name: value}
    with pytest.raises(ValueError, match=name):
        Camera(**fields)


@pytest.mark.parametrize("n", [0, 4, 5, 8])
def test_distortion_is_always_filled_up_to_eight(n):
    assert Camera(10, 10, 5.0, 5.0, 4.5, 4.5, (0.125,) * n).dist == (0.125,) * n + (0.0,) * (8 - n)


def test_numpys_numbers_become_plain_ones():
    camera = Camera(10, 8, np.float64(5.0), 5.0, 4.5, 3.5, (np.float64(0.1),) * 4)
    assert [type(value) for value in (camera.fx, *camera.dist)] == [float] * 9


# --- the camera file and the photo's size --------------------------------------------------------------


def test_a_camera_of_the_photos_size_is_taken_as_it_is():
    assert fit_to_photo(LENS, 1600, 1200) == (LENS, None)


@pytest.mark.parametrize(
    "size", [(800, 600), (3200, 2400), (1000, 750), (333, 250), (333, 249), (4000, 3000)]
)
def test_a_camera_of_the_same_aspect_is_scaled_and_this_is_said(size):
    camera, note = fit_to_photo(LENS, *size)
    assert camera == LENS.scaled(*size)
    assert f"scaled from 1600 x 1200 to {size[0]} x {size[1]}" in note


@given(st.integers(64, 6000), st.integers(64, 6000), between(0.2, 4.0))
def test_rounding_a_resize_up_or_down_keeps_the_aspect(width, height, factor):
    for rounding in (np.floor, np.round, np.ceil):
        resized = [max(1, int(rounding(side * factor))) for side in (width, height)]
        assert same_aspect(width, height, *resized)


@pytest.mark.parametrize("size", [(1200, 1600), (600, 800)])
def test_a_transposed_camera_is_refused_with_advice(size):
    with pytest.raises(InputError, match=r"on its side.*turn the photo"):
        fit_to_photo(LENS, *size)


@pytest.mark.parametrize("quarters", [1, 3])
def test_a_transposed_camera_turns_with_a_photo_that_exif_turned(quarters):
    camera, note = fit_to_photo(LENS, 1200, 1600, photo_turned=quarters)
    assert camera == LENS.turned(quarters)
    assert f"{90 * quarters}°" in note
    camera, note = fit_to_photo(LENS, 600, 800, photo_turned=quarters)
    assert camera == LENS.turned(quarters).scaled(600, 800)
    assert "turned" in note
    assert "scaled" in note


def test_an_upside_down_photo_does_not_explain_a_transposed_camera():
    with pytest.raises(InputError, match="on its side"):
        fit_to_photo(LENS, 1200, 1600, photo_turned=2)


def test_a_camera_calibrated_upright_fits_an_upright_photo_that_exif_turned():
    upright = LENS.turned(1)
    assert fit_to_photo(upright, 1200, 1600, photo_turned=1) == (upright, None)


@pytest.mark.parametrize("quarters", [1, 3])
def test_nor_is_a_camera_calibrated_upright_mirrored(quarters):
    upright = LENS.turned(1)
    assert fit_to_photo(upright, 1200, 1600, photo_turned=quarters, photo_mirrored=True) == (upright, None)


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_camera_turns_by_half_with_the_photo(mirrored):
    camera, note = fit_to_photo(LENS, 1600, 1200, photo_turned=2, photo_mirrored=mirrored)
    assert camera == (LENS.mirrored() if mirrored else LENS).turned(2)
    assert "180°" in note


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_square_camera_turns_with_the_photo(quarters):
    square = LENS.cropped(200, 0, 1200, 1200)
    camera, note = fit_to_photo(square, 1200, 1200, photo_turned=quarters)
    assert camera == square.turned(quarters)
    assert f"{90 * quarters}°" in note


def test_a_mirrored_photo_mirrors_the_camera():
    camera, note = fit_to_photo(LENS, 1200, 1600, photo_turned=1, photo_mirrored=True)
    assert camera == LENS.mirrored().turned(1)
    assert "mirrored" in note


@pytest.mark.parametrize("size", [(1600, 1000), (1500, 1200), (1280, 720), (64, 64), (1596, 1200)])
def test_any_other_size_is_refused_with_the_sizes_and_the_way_out(size):
    with pytest.raises(InputError, match=rf"1600 x 1200.*{size[0]} x {size[1]}.*--crop"):
        fit_to_photo(LENS, *size)


def test_a_crop_makes_the_camera_fit():
    camera, note = fit_to_photo(LENS, 1000, 900, crop=(100, 50, 1000, 900))
    assert camera == LENS.cropped(100, 50, 1000, 900)
    assert "100,50,1000,900" in note


def test_a_cropped_and_then_resized_photo_is_cropped_and_scaled():
    camera, note = fit_to_photo(LENS, 500, 450, crop=(100, 50, 1000, 900))
    assert camera == LENS.cropped(100, 50, 1000, 900).scaled(500, 450)
    assert "scaled from 1000 x 900 to 500 x 450" in note


def test_a_crop_of_another_shape_than_the_photo_is_refused():
    with pytest.raises(InputError, match=r"crop of the calibrated frame is 1000 x 900.*correct --crop"):
        fit_to_photo(LENS, 800, 600, crop=(100, 50, 1000, 900))


def test_a_crop_outside_the_calibrated_frame_is_refused():
    with pytest.raises(InputError, match=r"1600 x 1200, the calibrated frame; correct --crop"):
        fit_to_photo(LENS, 800, 600, crop=(1000, 0, 800, 600))
