from dataclasses import replace

import numpy as np
import pytest
from handmade import CAMERA, POSE, ROWS, RUNNING, STACK, alignment, distorted, plan_for

from autoreg.rendering.check import check_render, choose_marks
from autoreg.rendering.objects import Scene
from autoreg.rendering.preview import PreviewEngine
from autoreg.view import View


def plan(camera, lattice):
    return plan_for(Scene(), alignment(lattice, camera))


class Elsewhere(PreviewEngine):
    """An engine whose camera is not the fitted one."""

    def __init__(self, change):
        self.change = change

    def draw_marks(self, plan, *window):
        view = replace(plan.view, camera=self.change(plan.view.camera))
        return super().draw_marks(replace(plan, view=view), *window)


@pytest.mark.parametrize("lattice", [STACK, RUNNING, ROWS], ids=["stack", "running", "rows"])
@pytest.mark.parametrize("camera", [CAMERA, distorted()], ids=["pinhole", "lens"])
def test_joints_are_found_where_the_camera_puts_them(camera, lattice):
    check = check_render(PreviewEngine(), plan(camera, lattice))
    assert check.samples > 20
    assert check.rms_px < 0.02
    assert check.max_px < 0.1


def test_a_principal_point_that_is_off_is_seen_as_that_many_pixels():
    check = check_render(Elsewhere(lambda c: replace(c, cy=c.cy + 0.7)), plan(CAMERA, ROWS))
    joint_slope = 0.7  # The least part of a vertical shift that shows across these joints.
    assert 0.7 * joint_slope < check.rms_px < 0.72


def test_a_forgotten_distortion_is_seen():
    class Unbent(PreviewEngine):
        def draw_marks(self, plan, marks_ground, straight, width, height):
            # The middle of the straight picture, as if it were the bent one.
            whole = super().draw_marks(plan, marks_ground, straight, width, height)
            return np.roll(whole, (1, 2), (0, 1))

    check = check_render(Unbent(), plan(distorted(), STACK))
    assert check.rms_px > 1.0


def test_marks_are_missing_from_an_empty_layer():
    class Empty(PreviewEngine):
        def draw_marks(self, plan, marks_ground, straight, width, height):
            return np.zeros((height, width))

    check = check_render(Empty(), plan(CAMERA, STACK))
    assert check.rms_px > 5.0


def test_large_pictures_are_checked_in_the_photos_own_pixels():
    camera = CAMERA.scaled(3200, 2400)
    check = check_render(PreviewEngine(), plan(camera, STACK))
    assert check.rms_px < 0.04 * np.sqrt(3200 * 2400 / 4e6)
    moved = check_render(Elsewhere(lambda c: replace(c, cy=c.cy + 5.5)), plan(camera, ROWS))
    assert 0.7 * 5.5 < moved.rms_px < 5.6


def test_marks_keep_clear_of_each_other():
    marks = choose_marks(View(CAMERA, POSE), RUNNING)
    away = np.linalg.norm(marks.middle_px[:, None] - marks.middle_px, axis=-1)
    np.fill_diagonal(away, np.inf)
    assert away.min() > 14


def test_a_lattice_too_fine_to_see_is_not_checked():
    fine = replace(STACK, spacing_x=0.01, spacing_y=0.01, extent=0.1 * STACK.extent)
    assert check_render(PreviewEngine(), plan(CAMERA, fine)) is None
