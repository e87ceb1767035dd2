from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from paved import nudged

from autoreg.geometry import angle_between_rotations
from autoreg.ground.sharpen import sharpen
from autoreg.segments import Segments, detect_segments
from autoreg.synthetic import SyntheticPhoto


@pytest.fixture(scope="module")
def segments(stack_photo: SyntheticPhoto) -> Segments:
    return detect_segments(stack_photo.pixels.mean(-1).astype(np.uint8))


def degrees_off(R: np.ndarray, photo: SyntheticPhoto) -> float:
    return float(np.rad2deg(angle_between_rotations(R, photo.cam_from_ground.R)))


@pytest.mark.parametrize("seed", range(4))
def test_an_orientation_a_degree_off_is_brought_closer(
    stack_photo: SyntheticPhoto, segments: Segments, seed: int
):
    start = nudged(stack_photo.cam_from_ground, 1.0, 0.0, seed).R
    _, R = sharpen(segments, stack_photo.camera, start, free_focal=False)
    assert degrees_off(R, stack_photo) < 0.35


def test_the_true_orientation_stays(stack_photo: SyntheticPhoto, segments: Segments):
    camera, R = sharpen(segments, stack_photo.camera, stack_photo.cam_from_ground.R, free_focal=False)
    assert camera == stack_photo.camera
    assert degrees_off(R, stack_photo) < 0.2
    assert pytest.approx(np.eye(3), abs=1e-9) == R @ R.T


def test_a_wrong_focal_length_is_brought_closer(stack_photo: SyntheticPhoto, segments: Segments):
    true = stack_photo.camera
    start = replace(true, fx=1.06 * true.fx, fy=1.06 * true.fy)
    camera, _ = sharpen(segments, start, stack_photo.cam_from_ground.R, free_focal=True)
    assert camera.fx == pytest.approx(true.fx, rel=0.04)
    assert (camera.width, camera.height) == (true.width, true.height)


def test_a_handful_of_segments_changes_nothing(stack_photo: SyntheticPhoto, segments: Segments):
    start = nudged(stack_photo.cam_from_ground, 1.0, 0.0).R
    camera, R = sharpen(segments.take(np.arange(4)), stack_photo.camera, start, free_focal=True)
    assert camera == stack_photo.camera
    assert (start == R).all()


def test_the_same_segments_give_the_same_orientation_twice(stack_photo: SyntheticPhoto, segments: Segments):
    start = nudged(stack_photo.cam_from_ground, 0.7, 0.0).R
    once, again = (sharpen(segments, stack_photo.camera, start, free_focal=True) for _ in range(2))
    assert once[0] == again[0]
    assert (once[1] == again[1]).all()


def test_segments_that_leave_the_ground_on_the_way_are_no_error(
    stack_photo: SyntheticPhoto, segments: Segments
):
    """All of them above the horizon of a level camera: nothing is left to count."""
    camera = stack_photo.camera
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    above = np.flatnonzero(segments.ends_px[..., 1].max(1) < 0.4 * camera.height)
    found, R = sharpen(segments.take(above), camera, level, free_focal=True)
    assert np.isfinite(R).all()
    assert np.isfinite(found.fx)
