"""Pictures of ground that is laid with tiles of any shape, such as hexagons."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.ground.points import project_ground


def hexagons(across_m: float, reach_m: float, joint_m: float = 0.006) -> Float[np.ndarray, "n 6 2"]:
    """Corners of hexagonal tiles, so far across from side to side, around the origin."""
    radius, count = across_m / np.sqrt(3), int(reach_m / across_m) + 1
    i, j = (v.ravel() for v in np.meshgrid(*2 * [np.arange(-count, count + 1)]))
    middle = np.stack([(i + 0.5 * (j % 2)) * across_m, 1.5 * j * radius], 1)
    angle = np.radians(30 + 60 * np.arange(6))
    return middle[:, None] + (radius - joint_m / np.sqrt(3)) * np.stack([np.cos(angle), np.sin(angle)], -1)


def photo_of(
    tiles: Float[np.ndarray, "n k 2"], camera: Camera, pose: Rigid, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w"]:
    """Light tiles of slightly uneven tone on a dark bed, with blur and noise."""
    tiles = tiles[(tiles @ pose.R[2, :2] + pose.t[2] > 0.2).all(1)]
    px = project_ground(camera, pose, tiles.reshape(-1, 2)).reshape(*tiles.shape)
    fine = np.full((2 * camera.height, 2 * camera.width), 60, np.uint8)
    tones = rng.normal(150, 6, len(px))
    for own, tone in zip(px, tones, strict=True):
        if np.abs(own).max() < 1e4:
            # Pixels' centres in sixteenths of the finer ones.
            corners = np.rint((2 * own + 0.5) * 16).astype(np.int32)
            cv2.fillConvexPoly(fine, corners, float(tone), cv2.LINE_AA, 4)
    grey = cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA).astype(float)
    grey = cv2.GaussianBlur(grey, (0, 0), 0.7) + 2.0 * rng.standard_normal(grey.shape)
    return np.clip(grey, 0, 255).astype(np.uint8)
