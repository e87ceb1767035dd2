"""Photos whose camera is not known: the stated uncertainty holds the truth of cameras as they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import autoreg
from autoreg.camera import Camera
from autoreg.geometry import rotation_from_vector, vector_from_rotation
from autoreg.synthetic import SyntheticScene, look_at_ground, render_paving

SLAB_M = 0.4
# 99.9 % quantile of the chi-square of three degrees of freedom.
HARDLY_EVER = 16.3


def taken(camera: Camera, heading_deg: float, seed: int) -> SyntheticScene:
    """Paving that is seen by a camera held a little aslant: pixels that are not square look like shear."""
    return SyntheticScene(
        camera=camera,
        cam_from_ground=look_at_ground(
            pitch_deg=38.0, height_m=1.6, heading_deg=heading_deg, roll_deg=4.0, foot_m=(0.13, 0.21)
        ),
        spacing_m=(SLAB_M, SLAB_M),
        joint_width_m=0.012,
        seed=seed,
        colour=False,
    )


def off_by(alignment: autoreg.Alignment, truth: np.ndarray) -> np.ndarray:
    """Rotation vector of the alignment's pose from the truth, for the quarter turn that is nearest."""
    quarters = [rotation_from_vector(np.array([0.0, 0.0, k * np.pi / 2])) for k in range(4)]
    R = alignment.pose.cam_from_ground.R
    return min((vector_from_rotation(R @ (truth @ turn).T) for turn in quarters), key=np.linalg.norm)


@pytest.mark.parametrize(
    ("taller", "right", "lower", "heading_deg"), [(1.005, 9.0, -6.0, 33.0), (0.996, -12.0, 8.0, 62.0)]
)
def test_pixels_that_are_not_square_and_a_lens_that_is_not_in_the_middle_are_allowed_for(
    taller: float, right: float, lower: float, heading_deg: float
) -> None:
    plain = Camera.from_focal(800, 600, 700.0)
    camera = replace(plain, fy=taller * plain.fy, cx=plain.cx + right, cy=plain.cy + lower)
    scene = taken(camera, heading_deg, round(heading_deg))
    found = autoreg.align(render_paving(scene).pixels, None, slab=(SLAB_M, SLAB_M))
    error = off_by(found, scene.cam_from_ground.R)
    squared = float(error @ np.linalg.solve(found.pose.covariance[:3, :3], error))
    assert squared < HARDLY_EVER
    assert np.degrees(np.linalg.norm(error)) < 3.0
    focal, sigma = found.camera.focal_from_photo_px, found.camera.focal_from_photo_sigma_px
    assert focal is not None
    assert sigma is not None
    assert abs(focal - camera.fx) < 3.3 * sigma


@pytest.mark.parametrize("heading_deg", [25.0, pytest.param(64.0, marks=pytest.mark.slow)])
def test_a_bent_lens_is_allowed_for_in_all_that_bends_it(heading_deg: float) -> None:
    plain = Camera.from_focal(1000, 750, 800.0)
    camera = replace(plain, dist=(-0.16, 0.05, 8e-4, -6e-4))
    scene = taken(camera, heading_deg, round(heading_deg))
    found = autoreg.align(render_paving(scene).pixels, None, slab=(SLAB_M, SLAB_M))
    error = off_by(found, scene.cam_from_ground.R)
    squared = float(error @ np.linalg.solve(found.pose.covariance[:3, :3], error))
    assert squared < HARDLY_EVER
    assert np.degrees(np.linalg.norm(error)) < 1.0
