"""What a lens with an opening does to points before and behind the distance it is focused on."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int

from autoreg.errors import InputError
from autoreg.view import View, Window

# Widths in pixels for which a picture is blurred evenly; between two of them it is mixed.
_STEP = 1.25
_LEAST_PX = 0.25
# Samples per pixel side of a disc's coverage, and per side of the whole disc, where that is fewer.
_FINE, _MOST_FINE = 16, 2048
# No photo's discs of blur are wider than this part of its longer side, and their cost grows with their area.
_WIDEST = 0.25


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


def assert_moderate(view: View, focus: Focus, lens: str) -> None:
    """Raise unless the ground in the picture is blurred as some lens may blur it.

    Args:
        view: the photo's camera.
        focus: the lens.
        lens: what messages call it.

    Raises:
        InputError: its discs of blur are too wide.
    """
    c = view.camera
    # As the absolute value of what only bends up, it is largest at a corner.
    u, v = np.array([0, c.width - 1]), np.array([0, c.height - 1])
    widest, limit = float(_ground_blur_px(view, u, v, focus).max()), _WIDEST * max(c.width, c.height)
    if not widest <= limit:
        raise InputError(
            f"{lens} has an opening of {1000 * focus.aperture_m:.3g} mm, which makes discs of blur up to "
            f"{widest:.3g} pixels wide, more than {limit:.0f} (a quarter of the photo's longer side); give "
            "--dof a larger f-number or a shorter focal length, as in --dof 2.8,24"
        )


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
    c = view.camera
    u, v = window.x + np.arange(window.width), window.y + np.arange(window.height)
    width = _ground_blur_px(view, u, v, focus)
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
    fine = int(np.clip(_MOST_FINE // (2 * max(half) + 1), 1, _FINE))
    y, x = (
        ((np.arange((2 * k + 1) * fine) + 0.5) / fine - k - 0.5) / (0.5 * max(side, 1e-9))
        for k, side in zip(half, (height, width), strict=True)
    )
    inside = (x**2 + y[:, None] ** 2 < 1.0).astype(float)
    weights = inside.reshape(2 * half[0] + 1, fine, 2 * half[1] + 1, fine).mean((1, 3))
    total = weights.sum()
    return weights / total if total > 0 else np.ones((1, 1))


def _ground_blur_px(
    view: View, u: Int[np.ndarray, " w"], v: Int[np.ndarray, " h"], focus: Focus
) -> Float[np.ndarray, "h w"]:
    """Width of the disc of blur of the ground at columns u and rows v of the straight picture."""
    c = view.camera
    # The ray (x, y, 1) meets the ground at this 1/depth; above the horizon nothing is nearer than infinity.
    down = -view.cam_from_ground.R[:, 2] / view.eye[2]
    closeness = (u - c.cx) / c.fx * down[0] + ((v - c.cy) / c.fy * down[1] + down[2])[:, None]
    return c.fx * focus.aperture_m * np.abs(_closeness(view, focus) - np.maximum(closeness, 0.0))


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
