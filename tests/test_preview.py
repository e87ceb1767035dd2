import cv2
import numpy as np
import pytest
from handmade import CAMERA, POSE, STACK, alignment, distorted, photo_for, plan_for

from autoreg.rendering.objects import Box, Light, Material, Object, OnSlab, Scene, Sphere
from autoreg.rendering.preview import PreviewEngine, _looked_up
from autoreg.rendering.render import render, staged_window
from autoreg.view import View, Window

# From the left and a little behind the camera: shadows fall to the right.
LIGHT = Light((202.0, 57.0), sky=0.3, exposure=0.8)
BOX = Object("box", Box((0.3, 0.2, 0.3)), OnSlab(0, 0), Material((0.8, 0.1, 0.1)))
BALL = Object("ball", Sphere(0.2), OnSlab(0, 0), Material((0.1, 0.2, 0.8)))
WHOLE = Window(0, 0, 640, 480)


def drawn(*things, camera=CAMERA, pose=POSE, joints=False):
    plan = plan_for(Scene(things, LIGHT, joints), alignment(STACK, camera, pose))
    return plan, PreviewEngine().draw(plan, WHOLE)


def test_a_boxs_silhouette_reaches_its_projected_corners():
    plan, layer = drawn(BOX)
    px = plan.view.project(plan.staging.solids[0].corners)
    solid = np.argwhere(layer.light.sum(-1) > 0)[:, ::-1]
    assert solid.min(0) == pytest.approx(px.min(0), abs=1.0)
    assert solid.max(0) == pytest.approx(px.max(0), abs=1.0)


def test_through_a_lens_the_composite_shows_the_box_at_its_bent_corners():
    plan = plan_for(Scene((BOX,), LIGHT), alignment(STACK, distorted()))
    made = render(PreviewEngine(), plan, photo_for())
    px = View(distorted(), POSE).project(plan.staging.solids[0].corners)
    red = np.argwhere((made.layer[..., 2] > 60) & (made.layer[..., 3] > 128))[:, ::-1]
    # Bending mixes neighbours, so that an outline may reach half a pixel farther.
    assert red.min(0) == pytest.approx(px.min(0), abs=1.5)
    assert red.max(0) == pytest.approx(px.max(0), abs=1.5)
    assert made.check.rms_px < 0.02


def test_a_balls_area_is_that_of_its_outline():
    # Seen from straight above at distance d, a ball's outline is a circle of tangent radius/sqrt(d^2 - r^2).
    overhead = type(POSE)(np.diag([1.0, -1.0, -1.0]), np.array([-0.3, 0.2, 3.0]))
    _, layer = drawn(BALL, pose=overhead)
    covered = (layer.light.sum(-1) > 0) & (layer.transmission < 0.29)
    tangent2 = 0.2**2 / (2.8**2 - 0.2**2)
    assert covered.sum() == pytest.approx(np.pi * tangent2 * CAMERA.fx * CAMERA.fy, rel=0.02)


def test_the_shadow_falls_away_from_the_sun_and_leaves_the_skys_part():
    plan, layer = drawn(BOX)
    for beside, kept in (([0.25, 0.05, 0.0], 0.3), ([-0.25, -0.05, 0.0], 1.0)):
        u, v = np.round(plan.view.project(np.array([0.3, 0.2, 0.0]) + beside)).astype(int)
        assert layer.transmission[v, u] == pytest.approx(kept)


def test_faces_are_shaded_by_their_angle_to_the_sun():
    plan, layer = drawn(BOX)
    u, v = np.round(plan.view.project(np.array([0.3, 0.2, 0.3]))).astype(int)
    # A level face gets all of the light, and nothing of what the ground throws up.
    lamps = plan.staging.lamps
    assert layer.light[v, u, 0] == pytest.approx(0.8 * lamps.whitest * 0.8, rel=1e-6)


def test_the_nearer_object_hides_the_farther_one_whatever_their_order():
    far = Object("far", Box((0.4, 0.1, 0.4)), OnSlab(0, 2), Material((0.0, 1.0, 0.0)))
    near = Object("near", Box((0.4, 0.1, 0.8)), OnSlab(0, 0), Material((1.0, 0.0, 0.0)))
    pictures = [drawn(*order)[1].light for order in ((far, near), (near, far))]
    assert np.array_equal(*pictures)
    red, green = (pictures[0][..., k] > 0 for k in (0, 1))
    assert red.sum() > 2000
    # Where both would be seen, only the near one is.
    alone = drawn(far)[1].light[..., 1] > 0
    assert (alone & red).sum() > 50
    # Single pixels along its outline show both.
    inside = cv2.erode((drawn(near)[1].light[..., 0] > 0).astype(np.uint8), np.ones((3, 3))) > 0
    assert not (green & inside).any()


def test_a_picture_shows_its_own_edges_and_is_repeated_beyond_them():
    image = np.arange(8.0).reshape(2, 4, 1) * [1.0, 1.0, 1.0]
    uv = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0], [1.1, 0.9], [-0.1, -0.9]])
    assert _looked_up(image, uv)[:, 0].tolist() == [0, 3, 7, 4, 0, 7]


def test_lines_lie_on_the_joints():
    plan, layer = drawn(joints=True)
    u, v = np.round(plan.view.project(np.array([[0.6, 0.1], [0.6, 0.8], [0.2, 0.4]]))).astype(int).T
    assert (layer.light[v, u, 0] > 0.2).all()
    u, v = np.round(plan.view.project(np.array([0.3, 0.2]))).astype(int)
    assert layer.light[v, u].sum() == 0


def test_the_window_holds_all_that_is_drawn():
    plan, layer = drawn(BOX, BALL)
    window = staged_window(plan)
    outside = np.ones((480, 640), bool)
    outside[window.y : window.y + window.height, window.x : window.x + window.width] = False
    assert window.width * window.height < 640 * 480 / 2
    assert (layer.transmission[outside] == 1).all()
    assert (layer.light[outside] == 0).all()


def test_an_object_that_reaches_behind_the_camera_is_cut_and_not_folded():
    wall = Object("wall", Box((0.2, 12.0, 0.5)), OnSlab(2, 0), Material((0.5, 0.5, 0.5)))
    _, layer = drawn(wall)
    covered = layer.light.sum(-1) > 0
    assert 1000 < covered.sum() < 640 * 480 / 2
    assert not covered[:, :200].any()
