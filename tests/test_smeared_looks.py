"""Joints smeared by more than their own width, as by a camera that moves while the shutter is open."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from paved import POSE_ALONE, STACK, gray_of, misses, nudged, true_grid

from autoreg.camera import Camera
from autoreg.fitting import refine
from autoreg.fitting.fit import Fit
from autoreg.joints.joint_looks import Strip
from autoreg.synthetic import SyntheticPhoto, render_paving

SPACING = (0.6, 0.4)
LENGTH_PX = 9
# Joints of 6 mm are seen 1 to 5 pixels wide.
THIN = replace(STACK, camera=Camera(1280, 960, 1120.0, 1124.0, 632.0, 484.0), joint_width_m=0.006)
MOTION_PX = LENGTH_PX * np.sqrt(2.0)
ALONG_U, DOWNWARD = np.ones((1, LENGTH_PX)) / LENGTH_PX, np.eye(LENGTH_PX) / LENGTH_PX


@pytest.fixture(scope="module")
def photo() -> SyntheticPhoto:
    return render_paving(THIN)


def laid(picture: np.ndarray, photo: SyntheticPhoto, blur_px: float = 1.3) -> Fit:
    """The fit of a picture that the photo has become, from what detection at a smaller scale would know."""
    start = nudged(photo.cam_from_ground, 0.2, 0.006, 1)
    strip = Strip((0.008, 0.008), blur_px, (-1, -1), True)
    fit = refine.refine_until_still(
        picture, photo.camera, start, true_grid(photo), free=POSE_ALONE, search=0.04, reach=9.0, strip=strip
    )
    assert fit is not None
    return fit


@pytest.mark.parametrize("way", [DOWNWARD, DOWNWARD[::-1]], ids=["down", "up"])
def test_smeared_joints_are_not_held_by_one_edge(
    way: np.ndarray, photo: SyntheticPhoto, monkeypatch: pytest.MonkeyPatch
):
    picture = cv2.filter2D(gray_of(photo), -1, way)
    fit = laid(picture, photo)
    assert 0.5 * MOTION_PX < max(fit.strip.smear_px) < 1.1 * MOTION_PX
    _, crossing_px = misses(fit.cam_from_ground, SPACING, photo)
    assert crossing_px < 0.02 * MOTION_PX
    # By widths on the ground alone they are.
    monkeypatch.setattr(refine, "smear_px", lambda *joints: (0.0, 0.0))
    assert misses(laid(picture, photo).cam_from_ground, SPACING, photo)[1] > 1.5 * crossing_px


@pytest.mark.parametrize(("way", "across"), [(ALONG_U, 1), (ALONG_U.T, 0)], ids=["u", "v"])
def test_joints_along_the_motion_stay_sharp(way: np.ndarray, across: int, photo: SyntheticPhoto):
    fit = laid(cv2.filter2D(gray_of(photo), -1, way), photo)
    assert fit.strip.smear_px[across] == pytest.approx(LENGTH_PX, rel=0.3)
    assert fit.strip.smear_px[1 - across] == 0.0
    assert misses(fit.cam_from_ground, SPACING, photo)[1] < 0.02 * LENGTH_PX


def test_sharp_joints_are_as_wide_as_they_look(photo: SyntheticPhoto):
    fit = laid(gray_of(photo), photo)
    assert fit.strip.smear_px == (0.0, 0.0)
    assert misses(fit.cam_from_ground, SPACING, photo)[1] < 0.03


def test_joints_out_of_focus_are_not_smeared(photo: SyntheticPhoto):
    fit = laid(cv2.GaussianBlur(gray_of(photo), (0, 0), 4.0), photo, blur_px=3.5)
    assert fit.strip.smear_px == (0.0, 0.0)
    assert misses(fit.cam_from_ground, SPACING, photo)[1] < 0.5
