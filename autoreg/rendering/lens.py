"""From the straight picture that an engine draws to the photo's own bent one, and back."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from autoreg.camera import Camera
from autoreg.errors import RenderError
from autoreg.rendering.layer import bands
from autoreg.view import View, Window, window_around

# No engine bends rays as a lens does: each draws the straight picture that holds all rays of the bent one.
# Beyond this many pixels a lens is too wide for that.
_MOST_PIXELS = 120_000_000


def straight_window(view: View, window: Window) -> Window:
    """The window of the distortion-free picture (same K) that holds every ray of a window of the photo.

    Raises:
        RenderError: the lens model has no rays there, or the window would be huge.
    """
    if not view.camera.has_distortion or not window.width * window.height:
        return window
    u = np.linspace(window.x - 0.5, window.x + window.width - 0.5, 65)
    v = np.linspace(window.y - 0.5, window.y + window.height - 0.5, 65)
    straight = straight_pixels(view, np.stack(np.meshgrid(u, v), -1))
    if not np.isfinite(straight).any():
        raise RenderError("the lens model has no rays for this part of the picture; check the camera's dist")
    found = window_around(straight[np.isfinite(straight).all(-1)], 4)
    if found.width * found.height > _MOST_PIXELS:
        raise RenderError(
            f"without its distortion this part of the photo has {found.width} x {found.height} pixels, more "
            f"than {_MOST_PIXELS // 1_000_000} million; the lens is too wide for a straight picture"
        )
    return found


def straight_pixels(view: View, px: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """Where pixels of the photo lie in the picture of a lens without distortion; NaN where no ray does."""
    c = view.camera
    return c.normalise(px) * [c.fx, c.fy] + [c.cx, c.cy]


def window_view(view: View, window: Window, width: int, height: int) -> View:
    """The distortion-free view whose picture is a window, drawn `width` x `height` pixels large."""
    c = view.camera
    sx, sy = width / window.width, height / window.height
    camera = Camera(
        width,
        height,
        c.fx * sx,
        c.fy * sy,
        (c.cx - window.x + 0.5) * sx - 0.5,
        (c.cy - window.y + 0.5) * sy - 0.5,
    )
    return View(camera, view.cam_from_ground)


def bend(
    planes: Float[np.ndarray, "a b c"],
    view: View,
    straight: Window,
    window: Window,
    outside: tuple[float, ...],
    size: tuple[int, int] | None = None,
) -> Float[np.ndarray, "h w c"]:
    """A straight picture's planes as the lens shows them in a window of the photo.

    Args:
        planes: the straight window, of any size in pixels.
        view: the photo's own camera.
        straight: the part of the straight picture that the planes show.
        window: the wanted part of the photo.
        outside: what each plane holds where the lens has no ray.
        size: width and height in pixels of the answer; None is the window's own.
    """
    width, height = size or (window.width, window.height)
    if not view.camera.has_distortion and planes.shape[:2] == (height, width):
        return planes
    bent = np.empty((height, width, planes.shape[-1]), planes.dtype)
    # Pixel edges scale, hence the half pixels.
    u = window.x - 0.5 + (np.arange(width) + 0.5) * window.width / width
    v = window.y - 0.5 + (np.arange(height) + 0.5) * window.height / height
    scale = [planes.shape[1] / max(straight.width, 1), planes.shape[0] / max(straight.height, 1)]
    for rows in bands(width, height):
        px = np.stack(np.meshgrid(u, v[rows]), -1)
        at = (straight_pixels(view, px) - [straight.x, straight.y] + 0.5) * scale - 0.5
        bent[rows] = _sampled(planes, at, np.array(outside))
    return bent


def _sampled(
    planes: Float[np.ndarray, "a b c"], at: Float[np.ndarray, "h w 2"], outside: Float[np.ndarray, " c"]
) -> Float[np.ndarray, "h w c"]:
    """Planes between their pixels, linearly: a smoother kernel rings, and touches the photo around solids.

    OpenCV's remap is not used because it rounds places to 1/32 pixel.
    """
    height, width = planes.shape[:2]
    known = np.asarray(np.isfinite(at).all(-1))
    x = np.clip(np.where(known, at[..., 0], 0.0), 0.0, width - 1.0)
    y = np.clip(np.where(known, at[..., 1], 0.0), 0.0, height - 1.0)
    x0, y0 = (
        np.minimum(x.astype(np.int64), max(width - 2, 0)),
        np.minimum(y.astype(np.int64), max(height - 2, 0)),
    )
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    upper = planes[y0, x0] * (1 - fx) + planes[y0, x1] * fx
    lower = planes[y1, x0] * (1 - fx) + planes[y1, x1] * fx
    return np.where(known[..., None], upper * (1 - fy) + lower * fy, outside)


def straightened(photo: UInt8[np.ndarray, "h w 3"], camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
    """The photo as a lens without distortion and with the same K would have taken it."""
    if not camera.has_distortion:
        return photo
    straight = cv2.undistort(photo, camera.K, np.array(camera.dist))
    # Past its fold the lens model shows parts of the photo a second time; those rays it knows nothing of.
    x2 = ((np.arange(camera.width) - camera.cx) / camera.fx) ** 2
    y2 = ((np.arange(camera.height) - camera.cy) / camera.fy) ** 2
    if x2.max() + y2.max() > camera.valid_radius**2:
        straight[x2 + y2[:, None] > camera.valid_radius**2] = 0
    return straight
