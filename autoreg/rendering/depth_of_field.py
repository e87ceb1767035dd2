"""What a lens with an opening does to points before and behind the distance it is focused on."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from autoreg.view import View, Window

# Widths in pixels for which a picture is blurred evenly; between two of them it is mixed.
_STEP = 1.25
_LEAST_PX = 0.25
# Samples per pixel side of a disc's coverage.
_FINE = 16


@dataclass(frozen=True)
class Focus:
    """A real lens: the diameter of its opening, and the ground point that it is focused on."""

    aperture_m: float
    point: Float[np.ndarray, "3"]


def blur_px(view: View, focus: Focus, ground: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Width in the picture of a point's disc of blur: f A |1/focus - 1/depth|, with depths (thin lens).

    A point at the camera or behind it has none: NaN.
    """
    depth = view.cam_from_ground.apply(ground)[..., 2]
    with np.errstate(divide="ignore"):
        return view.camera.fx * focus.aperture_m * np.abs(_closeness(view, focus) - 1.0 / _positive(depth))


def defocused_ground(
    plane: Float[np.ndarray, "h w"], view: View, window: Window, focus: Focus
) -> Float[np.ndarray, "h w"]:
    """A picture of the ground as the lens blurs it, from a sharp one through a pinhole.

    Each pixel becomes the mean over its own disc of blur. That is exact where the disc's width does not
    change across it, and on a plane it changes slowly: with 1/depth, which is linear in the picture.

    Args:
        plane: a window of the straight picture; beyond its border its last pixels go on.
        view: the photo's camera.
        window: which part of the straight picture it is.
        focus: the lens.
    """
    c, eye = view.camera, view.eye
    u, v = window.x + np.arange(window.width), window.y + np.arange(window.height)
    # The ray (x, y, 1) meets the ground at this 1/depth; above the horizon nothing is nearer than infinity.
    down = -view.cam_from_ground.R[:, 2] / eye[2]
    closeness = (u - c.cx) / c.fx * down[0] + ((v - c.cy) / c.fy * down[1] + down[2])[:, None]
    width = c.fx * focus.aperture_m * np.abs(_closeness(view, focus) - np.maximum(closeness, 0.0))
    levels = _levels(float(width.max(initial=0.0)))
    blurred = np.zeros_like(plane)
    for n, level in enumerate(levels):
        part = np.interp(width, levels, np.eye(len(levels))[n])
        rows, columns = (np.flatnonzero(part.any(axis)) for axis in (1, 0))
        if len(rows):
            place = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
            blurred[place] += part[place] * _blurred(plane, place, level, level * c.fy / c.fx)
    return blurred


def disc(width: float, height: float) -> Float[np.ndarray, "a b"]:
    """Weights of pixels, with the sum 1, for an even ellipse around the middle one."""
    half = [int(np.ceil(0.5 * (side - 1))) if side > 1 else 0 for side in (height, width)]
    y, x = (
        ((np.arange((2 * k + 1) * _FINE) + 0.5) / _FINE - k - 0.5) / (0.5 * max(side, 1e-9))
        for k, side in zip(half, (height, width), strict=True)
    )
    inside = (x**2 + y[:, None] ** 2 < 1.0).astype(float)
    weights = inside.reshape(2 * half[0] + 1, _FINE, 2 * half[1] + 1, _FINE).mean((1, 3))
    total = weights.sum()
    return weights / total if total > 0 else np.ones((1, 1))


def _levels(widest: float) -> Float[np.ndarray, " n"]:
    """Widths from 0 to beyond the widest, each a little larger than the one before."""
    count = int(np.ceil(np.log(max(widest, _LEAST_PX) / _LEAST_PX) / np.log(_STEP))) + 1
    return np.concatenate([[0.0], _LEAST_PX * _STEP ** np.arange(count)])


def _blurred(
    plane: Float[np.ndarray, "h w"], place: tuple[slice, slice], width: float, height: float
) -> Float[np.ndarray, "a b"]:
    """A part of the picture, blurred evenly; what lies around it flows in."""
    kernel = disc(width, height)
    if kernel.size == 1:
        return plane[place]
    margins = [side // 2 for side in kernel.shape]
    starts = [max(part.start - margin, 0) for part, margin in zip(place, margins, strict=True)]
    around = plane[starts[0] : place[0].stop + margins[0], starts[1] : place[1].stop + margins[1]]
    mixed = cv2.filter2D(around, -1, kernel, borderType=cv2.BORDER_REPLICATE)
    y, x = place[0].start - starts[0], place[1].start - starts[1]
    return mixed[y : y + place[0].stop - place[0].start, x : x + place[1].stop - place[1].start]


def _closeness(view: View, focus: Focus) -> float:
    return 1.0 / float(view.cam_from_ground.apply(focus.point)[2])


def _positive(depth: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    return np.where(depth > 0, depth, np.nan)
