from dataclasses import replace

import cv2
import numpy as np
import pytest
from handmade import CAMERA, POSE, distorted, looking
from hypothesis import given, settings
from hypothesis import strategies as st

from autoreg.view import View, Window, window_around

SETTINGS = settings(deadline=None, derandomize=True, max_examples=40)
VIEWS = [View(CAMERA, POSE), View(distorted(), POSE)]


@pytest.mark.parametrize("view", VIEWS, ids=["pinhole", "lens"])
def test_ground_points_are_found_again_under_their_pixels(view):
    ground = np.stack(np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.8, 1.5, 9)), -1)
    assert np.abs(view.ground_under(view.project(ground)) - ground).max() < 1e-6


def test_projection_is_opencvs():
    view = View(distorted(), POSE)
    points = np.array([[0.1, 0.2, 0.0], [-0.4, 0.9, 0.3], [0.5, -0.3, 0.1]])
    rotation, _ = cv2.Rodrigues(POSE.R)
    expected, _ = cv2.projectPoints(points, rotation, POSE.t, view.camera.K, np.array(view.camera.dist))
    assert np.abs(view.project(points) - expected[:, 0]).max() < 1e-9


def test_no_ground_lies_under_the_sky():
    level = View(CAMERA, looking([0.0, 0.0, 1.6], [0.0, 10.0, 1.6]))
    horizon = level.camera.cy
    found = level.ground_under(np.array([[300.0, horizon - 5], [300.0, horizon + 5]]))
    assert np.isnan(found[0]).all()
    assert np.isfinite(found[1]).all()


def test_what_a_lens_polynomial_folds_back_into_the_picture_is_not_seen():
    view = View(replace(CAMERA, dist=(-0.25, 0.0, 0.0, 0.0)), POSE)
    sideways = POSE.inverse.apply(np.array([[1.8, 0.0, 1.0]]))
    folded = view.camera.project(POSE.apply(sideways))[0]
    assert 0 < folded[0] < 640, "the example does not fold; choose another"
    assert np.isnan(view.project(sideways)).all()


@pytest.mark.parametrize("view", VIEWS, ids=["pinhole", "lens"])
def test_a_joint_that_passes_under_the_camera_is_drawn_from_the_pictures_edge(view):
    px, ground = view.polylines(np.array([[[0.0, -50.0], [0.0, 50.0]]]), 64)
    assert px.shape == (1, 65, 2)
    assert np.abs(view.project(ground[0, 3:-3]) - px[0, 3:-3]).max() < 1e-6
    assert np.abs(ground[0, :, [0, 2]]).max() < 1e-9
    steps = np.linalg.norm(np.diff(px[0], axis=0), axis=1)
    assert steps.max() < 3 * steps.min()
    # Its lowest point lies below the picture, by no more than the margin of the view.
    assert 479 < px[0, :, 1].max() < 600


def test_segments_out_of_sight_are_left_out():
    behind = np.array([[[-1.0, -9.0], [1.0, -9.0]]])
    px, _ = VIEWS[0].polylines(behind, 8)
    assert len(px) == 0


def test_a_reduced_view_sees_the_same_ground_at_pixel_edges():
    half = VIEWS[0].scaled(0.5)
    corner, corner_half = np.array([[639.5, 479.5]]), np.array([[319.5, 239.5]])
    assert half.ground_under(corner_half) == pytest.approx(VIEWS[0].ground_under(corner))


@SETTINGS
@given(st.integers(-50, 700), st.integers(-50, 500), st.integers(0, 300), st.integers(0, 300))
def test_a_window_within_a_picture_holds_the_pixels_that_both_hold(x, y, w, h):
    inner = Window(x, y, w, h).within(640, 480)
    mask = np.zeros((1200, 1400), bool)
    mask[100 + y : 100 + y + h, 100 + x : 100 + x + w] = True
    mask = mask[100:580, 100:740]
    expected = np.zeros_like(mask)
    expected[inner.y : inner.y + inner.height, inner.x : inner.x + inner.width] = True
    assert (mask == expected).all()


def test_a_window_around_points_holds_them_and_the_margin():
    window = window_around(np.array([[10.2, 20.9], [14.0, 22.1]]), 2)
    assert (window.x, window.y) == (8, 18)
    assert (window.width, window.height) == (9, 8)
