from dataclasses import replace

import numpy as np
import pytest
from handmade import CAMERA, POSE, ROWS, RUNNING, STACK, distorted

from autoreg.check import check_render, choose_marks
from autoreg.preview import PreviewEngine
from autoreg.view import View


class Elsewhere(PreviewEngine):
    """An engine whose camera is not the fitted one."""

    def __init__(self, change):
        self.change = change

    def draw_marks(self, view, marks_ground):
        return super().draw_marks(replace(view, camera=self.change(view.camera)), marks_ground)


@pytest.mark.parametrize("lattice", [STACK, RUNNING, ROWS], ids=["stack", "running", "rows"])
@pytest.mark.parametrize("camera", [CAMERA, distorted()], ids=["pinhole", "lens"])
def test_joints_are_found_where_the_camera_puts_them(camera, lattice):
    check = check_render(PreviewEngine(), View(camera, POSE), lattice)
    assert check.samples > 20
    assert check.rms_px < 0.04
    assert check.max_px < 0.1


def test_a_principal_point_that_is_off_is_seen_as_that_many_pixels():
    check = check_render(Elsewhere(lambda c: replace(c, cy=c.cy + 0.7)), View(CAMERA, POSE), ROWS)
    joint_slope = 0.7  # The least part of a vertical shift that shows across these joints.
    assert 0.7 * joint_slope < check.rms_px < 0.72


def test_a_forgotten_distortion_is_seen():
    check = check_render(Elsewhere(lambda c: c.undistorted()), View(distorted(), POSE), STACK)
    assert check.rms_px > 1.0


def test_marks_are_missing_from_an_empty_layer():
    class Empty(PreviewEngine):
        def draw_marks(self, view, marks_ground):
            return np.zeros((view.camera.height, view.camera.width))

    check = check_render(Empty(), View(CAMERA, POSE), STACK)
    assert check.rms_px > 5.0


def test_large_pictures_are_checked_in_the_photos_own_pixels():
    camera = CAMERA.scaled(6400, 4800)
    check = check_render(PreviewEngine(), View(camera, POSE), STACK)
    assert check.rms_px < 0.04 * np.sqrt(6400 * 4800 / 4e6)
    # A move by 2 pixels of the smaller picture that is rendered is one by 5.5 of the photo's.
    moved = check_render(Elsewhere(lambda c: replace(c, cy=c.cy + 2.0)), View(camera, POSE), ROWS)
    assert 0.7 * 5.5 < moved.rms_px < 5.6


def test_marks_keep_clear_of_each_other():
    marks = choose_marks(View(CAMERA, POSE), RUNNING)
    away = np.linalg.norm(marks.middle_px[:, None] - marks.middle_px, axis=-1)
    np.fill_diagonal(away, np.inf)
    assert away.min() > 14


def test_a_lattice_too_fine_to_see_is_not_checked():
    fine = replace(STACK, spacing_x=0.01, spacing_y=0.01, extent=0.1 * STACK.extent)
    assert check_render(PreviewEngine(), View(CAMERA, POSE), fine) is None
