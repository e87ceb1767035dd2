import numpy as np
import pytest
from handmade import CAMERA, POSE, looking
from hypothesis import given, settings
from hypothesis import strategies as st

from autoreg.camera import Camera
from autoreg.errors import InputError
from autoreg.rendering.depth_of_field import Focus, assert_moderate, blur_px, defocused_ground, disc
from autoreg.view import View, Window

VIEW = View(CAMERA, POSE)
WHOLE = Window(0, 0, 640, 480)
AT_ORIGIN = Focus(0.06, np.zeros(3))


@settings(deadline=None, derandomize=True, max_examples=40)
@given(st.floats(1.5, 60.0), st.floats(0.8, 1.25))
def test_a_disc_has_the_sum_1_and_the_spread_of_an_even_ellipse(width, ratio):
    weights = disc(width, ratio * width)
    assert weights.sum() == pytest.approx(1.0)
    assert np.allclose(weights, weights[::-1, ::-1])
    y, x = (np.arange(side) - side // 2 for side in weights.shape)
    # An even disc has the variance width² / 16, and a pixel 1/12; small discs feel the pixel grid.
    for variance, side in (((weights * x**2).sum(), width), ((weights.T * y**2).sum(), ratio * width)):
        assert variance == pytest.approx(side**2 / 16 + 1 / 12, rel=0.02, abs=0.1)


def test_a_point_in_focus_is_sharp_and_others_follow_the_thin_lens():
    points = np.array([[0.0, 0.0, 0.0], [0.3, 1.5, 0.2], [-0.6, -9.0, 0.0]])
    sharp, blurred, behind = blur_px(VIEW, AT_ORIGIN, points)
    assert sharp == pytest.approx(0.0, abs=1e-9)
    at, depth = POSE.apply(points[:2])[:, 2]
    # A lens of focal length f focused at s throws a point at d as a disc f A |d - s| / (s d), f in pixels.
    assert blurred == pytest.approx(CAMERA.fx * 0.06 * (depth - at) / (at * depth))
    assert np.isnan(behind)


def test_ground_without_a_shadow_stays_as_it_is():
    assert defocused_ground(np.ones((480, 640)), VIEW, WHOLE, AT_ORIGIN) == pytest.approx(1.0, abs=1e-6)


def test_a_wide_disc_is_made_with_few_samples_and_is_still_even():
    weights = disc(1501.0, 1400.0)
    assert weights.sum() == pytest.approx(1.0)
    # An even ellipse of this size covers so many pixels.
    assert weights[weights > 0].size == pytest.approx(np.pi / 4 * 1501 * 1400, rel=0.01)
    assert weights.max() == pytest.approx(4 / (np.pi * 1501 * 1400), rel=0.01)


def test_only_lenses_that_some_camera_may_have_are_drawn():
    # The widest disc of ground in the picture is at one of its corners.
    grid = np.stack(np.meshgrid(np.arange(0, 640, 3.0), np.arange(0, 480, 3.0)), -1)
    ground = VIEW.ground_under(grid).reshape(-1, 2)
    seen = np.c_[ground, np.zeros(len(ground))][np.isfinite(ground).all(1)]
    for aperture_m, moderate in ((0.05, True), (1.0, True), (1.1, False), (1e9, False)):
        focus = Focus(aperture_m, np.zeros(3))
        widest = blur_px(VIEW, focus, seen).max()
        assert (widest < 160) == moderate
        if moderate:
            assert_moderate(VIEW, focus, "it")
        else:
            with pytest.raises(InputError, match=r"it has an opening of \S+ mm.* wide, more than 160 "):
                assert_moderate(VIEW, focus, "it")


def test_the_line_in_focus_stays_sharp():
    plane = np.random.default_rng(1).uniform(0, 1, (480, 640))
    blurred = defocused_ground(plane, VIEW, WHOLE, AT_ORIGIN)
    u, v = np.round(VIEW.project(np.zeros(3))).astype(int)
    assert blurred[v, u] == pytest.approx(plane[v, u])
    assert np.abs(blurred - plane)[470:].mean() > 0.2


@pytest.mark.parametrize("spot", [(0.7, 1.6), (-0.6, -0.9), (-0.9, -0.8)])
@pytest.mark.parametrize("window", [WHOLE, Window(40, 30, 580, 440)], ids=["whole", "part"])
def test_a_dot_on_the_ground_becomes_the_disc_of_its_own_depth(spot, window):
    view = View(
        Camera(640, 480, 610.0, 500.0, 400.0, 170.0), looking([-0.6, -2.6, 1.6], [0.2, 0.3, 0.0], 0.3)
    )
    u, v = np.round(view.project(np.array(spot)) - [window.x, window.y]).astype(int)
    plane = np.zeros((window.height, window.width))
    plane[v, u] = 1.0
    found = defocused_ground(plane, view, window, AT_ORIGIN)
    width = float(blur_px(view, AT_ORIGIN, np.array([[*spot, 0.0]]))[0])
    assert width > 3
    y, x = np.indices(plane.shape)
    mass = found.sum()
    # The disc's width changes by some per cent across it.
    assert mass == pytest.approx(1.0, abs=0.05)
    for place, middle, side in ((x, u, width), (y, v, width * 500 / 610)):
        mean = (found * place).sum() / mass
        assert mean == pytest.approx(middle, abs=0.15)
        spread = 4 * np.sqrt((found * (place - mean) ** 2).sum() / mass - 1 / 12)
        assert spread == pytest.approx(side, rel=0.05)
