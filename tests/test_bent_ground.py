"""Paving falls to its gutters: ground bent by millimetres in a metre is paving, seen by a right camera."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from jaxtyping import UInt8

from autoreg.align import align
from autoreg.camera import Camera
from autoreg.ground.points import on_ground, project_ground
from autoreg.image import as_gray
from autoreg.synthetic import SyntheticScene, look_at_ground, render_paving

SLAB = (0.63, 0.475)
CAMERA = Camera.from_focal(800, 600, 640.0)
# The ground lies so far below the plane at its top at a distance of one metre, and grows with its square.
DROP_M = 0.004


def scene(pitch_deg: float, heading_deg: float, seed: int) -> SyntheticScene:
    """Slabs in a half bond that do not lie aside."""
    pose = look_at_ground(
        pitch_deg=pitch_deg, height_m=1.6, heading_deg=heading_deg, roll_deg=1.0, foot_m=(0.1, 0.2)
    )
    return SyntheticScene(
        camera=CAMERA, cam_from_ground=pose, spacing_m=SLAB, shift=0.5, colour=False, seed=seed
    )


def domed(flat: SyntheticScene) -> UInt8[np.ndarray, "h w"]:
    """The photo of a scene as it looks where its ground falls off to all sides from beside the camera."""
    camera, pose = flat.camera, flat.cam_from_ground
    u, v = np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height)))
    plane = on_ground(np.stack([u, v], -1).reshape(-1, 2), camera, pose)
    x, y, height = pose.origin_in_a
    eye, ground = np.array([x, y]), plane
    for _ in range(30):
        below = np.minimum(DROP_M * (ground**2).sum(1), 0.5 * height)
        ground = eye + (plane - eye) * (1.0 + below / height)[:, None]
    seen = project_ground(camera, pose, ground).reshape(*u.shape, 2)
    at = np.nan_to_num(seen, nan=-10.0).astype(np.float32)
    gray = as_gray(render_paving(flat).pixels)
    bent = cv2.remap(gray, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.clip(bent, 0, 255).astype(np.uint8)


def test_joints_that_bow_over_bent_ground_are_no_arcs():
    found = align(domed(scene(28.0, 1.81, 3)), CAMERA, slab=SLAB)
    assert found.lattice.kind == "running"
    assert found.camera.consistent is not False


def test_a_right_camera_is_not_called_wrong_over_bent_ground():
    # Courses that lie across the view and bow: by a bent lens far off its axis they would be straight.
    found = align(domed(scene(36.44, 88.85, 8)), CAMERA, slab=SLAB)
    assert found.camera.consistent is not False
    assert found.camera.focal_from_photo_px == pytest.approx(CAMERA.fx, rel=0.03)


def test_a_wrong_camera_is_called_wrong_over_bent_ground():
    wrong = replace(CAMERA, fx=1.15 * CAMERA.fx, fy=1.15 * CAMERA.fy)
    found = align(domed(scene(36.44, 35.0, 8)), wrong, slab=SLAB)
    assert found.camera.consistent is False
    assert found.camera.focal_from_photo_px == pytest.approx(CAMERA.fx, rel=0.01)
