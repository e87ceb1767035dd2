from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from paved import POSE_ALONE, STACK, gray_of, misses, nudged, true_grid

from autoreg.answer.last_step import likeliest
from autoreg.camera import Camera
from autoreg.fitting.fit import Fit
from autoreg.fitting.refine import refine
from autoreg.joints.smear import SMEARED, alike_in_px, smear, smeared
from autoreg.slabs import measured_joints
from autoreg.slabs.slab_model import estimate_motion
from autoreg.synthetic import SyntheticPhoto, render_paving

CORNERS = np.array([[20.0, 20.0], [620.0, 460.0]])
# A hand's motion of five pixels, along the picture's axes and along its diagonals.
ALONG_U, ALONG_V = np.ones((1, 5)) / 5, np.ones((5, 1)) / 5
DOWNWARD, UPWARD = np.eye(5) / 5, np.eye(5)[::-1] / 5


def texture(foreshortened: int = 1) -> np.ndarray:
    """Stone of many scales, down to what no pixel sees, foreshortened along v, with a sensor's noise."""
    rng = np.random.default_rng(4)
    stone = np.full((960 * foreshortened, 1280), 120.0)
    for size in (1.0, 2.0, 4.0, 8.0, 16.0, 32.0):
        grain = cv2.GaussianBlur(rng.normal(size=stone.shape), (0, 0), size)
        stone += 4.0 * grain / grain.std()
    seen = cv2.resize(stone, (640, 480), interpolation=cv2.INTER_AREA)
    return seen + rng.normal(size=seen.shape)


def moved(picture: np.ndarray, way: np.ndarray) -> np.ndarray:
    return cv2.filter2D(picture, -1, way)


def fitted(picture: np.ndarray, photo: SyntheticPhoto) -> Fit:
    """The fit of a picture that the photo has become, started a little off the true pose."""
    start = nudged(photo.cam_from_ground, 0.1, 0.002, 1)
    fit = refine(
        picture, photo.camera, start, true_grid(photo), free=POSE_ALONE, search=0.1, reaches=(3.0, 6.0, 9.0)
    )
    assert fit is not None
    return fit


@pytest.fixture(scope="module")
def photo() -> SyntheticPhoto:
    camera = Camera(1280, 960, 1120.0, 1124.0, 632.0, 484.0)
    return render_paving(replace(STACK, camera=camera, joint_width_m=0.008))


@pytest.mark.parametrize("way", [ALONG_U, ALONG_V, DOWNWARD, UPWARD], ids=["u", "v", "down", "up"])
def test_a_moved_picture_is_smeared_whatever_its_direction(way: np.ndarray):
    assert smear(moved(texture(), way), CORNERS) > SMEARED


def test_a_sharp_picture_or_one_out_of_focus_is_not():
    assert smear(texture(), CORNERS) < 1.1
    assert smear(cv2.GaussianBlur(texture(), (0, 0), 2.0), CORNERS) < 1.1
    assert smear(texture(foreshortened=2), CORNERS) < SMEARED
    assert smear(np.full((480, 640), 90.0), CORNERS) == pytest.approx(1.0)


def test_small_pictures_and_few_pixels_can_be_asked():
    assert smear(texture()[:40, :50], np.array([[3.0, 3.0]])) >= 1.0
    assert smear(texture(), np.zeros((0, 2))) == 1.0


@pytest.mark.parametrize("way", [ALONG_U, ALONG_V], ids=["u", "v"])
def test_widths_of_joints_in_a_smeared_picture_do_not_move_the_pose(
    way: np.ndarray, photo: SyntheticPhoto, monkeypatch: pytest.MonkeyPatch
):
    picture = moved(gray_of(photo), way)
    fit = fitted(picture, photo)
    at_px = fit.profiles.centre_px[fit.usable]
    assert smeared(picture, at_px)
    assert not smeared(gray_of(photo), at_px)
    spacing = (0.6, 0.4)
    settled = likeliest(picture, fit)
    angle_deg, crossing_px = misses(settled.fit.cam_from_ground, spacing, photo)
    assert angle_deg < 0.005
    assert crossing_px < 0.06
    # Taken for what relief does to them, they would.
    monkeypatch.setattr(measured_joints, "alike_in_px", lambda *widths: False)
    told = estimate_motion(fit, fit.free.mask, fit.free.prior(fit.camera, fit.grid))
    assert misses(fit.moved(told.parameters).cam_from_ground, spacing, photo)[1] > 10 * crossing_px


@pytest.mark.parametrize("way", [np.ones((1, 9)) / 9, np.ones((9, 1)) / 9], ids=["u", "v"])
def test_where_noise_hides_the_texture_the_widths_tell_a_smear(way: np.ndarray, photo: SyntheticPhoto):
    rng = np.random.default_rng(2)
    picture = moved(gray_of(photo), way)
    picture += rng.normal(scale=6.0, size=picture.shape).astype(np.float32)
    fit = fitted(picture, photo)
    assert not smeared(picture, fit.profiles.centre_px[fit.usable])
    _, crossing_px = misses(likeliest(picture, fit).fit.cam_from_ground, (0.6, 0.4), photo)
    assert crossing_px < 0.15


def test_widths_that_grow_with_the_scale_are_no_smear():
    rng = np.random.default_rng(0)
    scale, noise = rng.uniform(200.0, 500.0, 80), rng.normal(scale=0.2, size=80)
    sigma = np.full(80, 0.2)
    for width_m, constant_px, alike in ((0.01, 0.0, False), (0.008, 2.0, False), (0.001, 5.0, True)):
        assert alike_in_px(width_m * scale + constant_px + noise, sigma, scale) is alike
    # Few joints, or joints that are all as far off, tell nothing.
    assert not alike_in_px(np.full(5, 6.0), np.full(5, 0.1), scale[:5])
    assert not alike_in_px(6.0 + noise, sigma, np.full(80, 300.0) + 0.1 * rng.normal(size=80))
