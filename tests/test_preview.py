import numpy as np
import pytest
from handmade import CAMERA, POSE, STACK, alignment, distorted

from autoreg.preview import PreviewEngine
from autoreg.render import staged_window
from autoreg.staging import Ball, Box, Light, Staging, corners
from autoreg.view import View, Window

# From the left and a little behind the camera: shadows fall to the right.
LIGHT = Light(np.array([-0.5, -0.2, np.sqrt(0.71)]))


def drawn(view, staging, window=None):
    window = window or staged_window(view, alignment(camera=view.camera), staging)
    return PreviewEngine().draw(view, STACK, staging, window)


def on_slab(*solids):
    return Staging((0, 0), solids, LIGHT)


BOX = Box(np.array([0.0, 0.0, 0.15]), np.array([0.3, 0.2, 0.3]), (0.8, 0.1, 0.1))
BALL = Ball(np.array([0.0, 0.0, 0.2]), 0.2, (0.1, 0.2, 0.8))


@pytest.mark.parametrize("camera", [CAMERA, distorted()], ids=["pinhole", "lens"])
def test_a_boxs_silhouette_reaches_its_projected_corners(camera):
    view = View(camera, POSE)
    layer = drawn(view, on_slab(BOX))
    px = view.project(np.concatenate([corners(s) for s in on_slab(BOX).solids_on(STACK)]))
    solid = np.argwhere(layer.light.sum(-1) > 0)[:, ::-1] + [layer.window.x, layer.window.y]
    assert solid.min(0) == pytest.approx(px.min(0), abs=1.0)
    assert solid.max(0) == pytest.approx(px.max(0), abs=1.0)


def test_a_balls_area_is_that_of_its_outline():
    # Seen from straight above at distance d, a ball's outline is a circle of tangent radius/sqrt(d^2 - r^2).
    overhead = View(CAMERA, type(POSE)(np.diag([1.0, -1.0, -1.0]), np.array([-0.3, 0.2, 3.0])))
    layer = drawn(overhead, on_slab(BALL))
    area = (1 - layer.transmission)[layer.light.sum(-1) > 0].sum()
    tangent2 = 0.2**2 / (2.8**2 - 0.2**2)
    assert area == pytest.approx(np.pi * tangent2 * CAMERA.fx * CAMERA.fy, rel=0.03)


def test_the_shadow_falls_away_from_the_sun_and_leaves_the_ambient_part():
    view = View(CAMERA, POSE)
    layer = drawn(view, on_slab(BOX), Window(0, 0, 640, 480))
    expected = LIGHT.ambient / (LIGHT.ambient + LIGHT.diffuse * LIGHT.to_sun[2])
    for beside, kept in (([0.25, 0.05, 0.0], expected), ([-0.25, -0.05, 0.0], 1.0)):
        u, v = np.round(view.project(np.array([0.3, 0.2, 0.0]) + beside)).astype(int)
        assert layer.transmission[v, u] == pytest.approx(kept)


def test_faces_are_shaded_by_their_angle_to_the_sun():
    view = View(CAMERA, POSE)
    layer = drawn(view, on_slab(BOX), Window(0, 0, 640, 480))
    top = np.array([0.3, 0.2, 0.3])
    u, v = np.round(view.project(top)).astype(int)
    expected = 0.8 * (LIGHT.ambient + LIGHT.diffuse * LIGHT.to_sun[2])
    assert layer.light[v, u, 0] == pytest.approx(expected)


def test_the_window_holds_all_that_is_drawn():
    view = View(distorted(), POSE)
    staging = on_slab(BOX, BALL)
    whole = drawn(view, staging, Window(0, 0, 640, 480))
    window = staged_window(view, alignment(camera=view.camera), staging)
    outside = np.ones((480, 640), bool)
    outside[window.y : window.y + window.height, window.x : window.x + window.width] = False
    assert window.width * window.height < 640 * 480 / 4
    assert (whole.transmission[outside] == 1).all()
    assert (whole.light[outside] == 0).all()
