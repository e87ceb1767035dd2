"""Where segments of both joint directions crowd: paving that fills a small part of the photo."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float

from autoreg.camera import Camera
from autoreg.ground.directions import MIN_DEPRESSION, agreement, camera_rays
from autoreg.ground.rectify import Window
from autoreg.segments import Segments

# Columns of square cells that the picture is parted into, and how far their counts are spread, in cells.
CELLS, SPREAD_CELLS = 32, 1.2
# Places along a segment that are counted.
PLACES = np.linspace(0.0, 1.0, 9)
# Cells of a crowd have more than this share of what the fullest has.
CROWDED = 0.3
# How much further than its segments a crowd reaches, as a share of its size.
MARGIN = 0.06


def crowded_window(segments: Segments, camera: Camera, R: Float[np.ndarray, "3 3"]) -> Window | None:
    """The box of the ground in which the largest crowd of segments along both X and Y lies, if there is any.

    Args:
        segments: of the whole photo.
        camera: its camera.
        R: cam_from_ground rotation of a ground hypothesis.
    """
    if not len(segments):
        return None
    rays = camera_rays(segments, camera)
    places = rays.ends[:, :1] + PLACES[:, None] * (rays.ends[:, 1:] - rays.ends[:, :1])
    ground = places @ R
    below = ground[..., 2] < -MIN_DEPRESSION
    weight = agreement(rays, R[:, :2].T)[..., None] * rays.weight[:, None] * below
    px = camera.project(places.reshape(-1, 3)).reshape(*ground.shape[:2], 2)
    inside = _in_largest_crowd(px, weight, camera) & (weight.max(0) > 0)
    if not inside.any():
        return None
    at = ground[inside][:, :2] / -ground[inside][:, 2:]
    low, high = at.min(0), at.max(0)
    low, high = low - MARGIN * (high - low), high + MARGIN * (high - low)
    return Window((float(low[0]), float(low[1])), (float(high[0]), float(high[1])))


def _in_largest_crowd(
    px: Float[np.ndarray, "n p 2"], weight: Float[np.ndarray, "2 n p"], camera: Camera
) -> Bool[np.ndarray, "n p"]:
    """Which places are in the largest connected part of the picture where both families weigh much."""
    cell_px = camera.width / CELLS
    rows = int(np.ceil(camera.height / cell_px))
    column, row = (np.clip((px[..., k] / cell_px).astype(int), 0, n - 1) for k, n in ((0, CELLS), (1, rows)))
    cell = row * CELLS + column
    families = (np.bincount(cell.ravel(), w.ravel(), rows * CELLS).reshape(rows, CELLS) for w in weight)
    both = np.minimum(*(cv2.GaussianBlur(family, (0, 0), SPREAD_CELLS) for family in families))
    count, label = cv2.connectedComponents((both > CROWDED * both.max()).astype(np.uint8))
    if count == 1:
        return np.zeros(cell.shape, bool)
    largest = 1 + int(np.argmax(np.bincount(label.ravel(), both.ravel(), count)[1:]))
    return label.ravel()[cell] == largest
