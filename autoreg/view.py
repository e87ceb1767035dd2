"""What a camera that stands on the ground sees: pixels of ground points, and the ground under pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from autoreg.camera import Camera
from autoreg.geometry import Rigid


@dataclass(frozen=True)
class Window:
    """A rectangle of whole pixels; (x, y) is its top-left pixel in the photo, and may lie outside it."""

    x: int
    y: int
    width: int
    height: int

    def pixels(self) -> Float[np.ndarray, "h w 2"]:
        """The photo pixel of each pixel of the window."""
        u, v = np.meshgrid(self.x + np.arange(self.width), self.y + np.arange(self.height))
        return np.stack([u, v], -1).astype(np.float64)

    def within(self, width: int, height: int) -> Window:
        """The part that lies inside a picture of this size; its sides are 0 if there is none."""
        x0, y0 = min(max(self.x, 0), width), min(max(self.y, 0), height)
        x1, y1 = (
            min(max(self.x + self.width, x0), width),
            min(max(self.y + self.height, y0), height),
        )
        return Window(x0, y0, x1 - x0, y1 - y0)


def window_around(points_px: Float[np.ndarray, "*n 2"], margin: int) -> Window:
    """The smallest window that holds the points and a margin."""
    flat = points_px.reshape(-1, 2)
    low = np.floor(flat.min(0)).astype(int) - margin
    high = np.ceil(flat.max(0)).astype(int) + margin
    return Window(int(low[0]), int(low[1]), int(high[0] - low[0]) + 1, int(high[1] - low[1]) + 1)


@dataclass(frozen=True)
class View:
    """A camera and where it stands."""

    camera: Camera
    cam_from_ground: Rigid

    @property
    def eye(self) -> Float[np.ndarray, "3"]:
        """The camera's place in the ground frame."""
        return self.cam_from_ground.origin_in_a

    def scaled(self, scale: float) -> View:
        """The same view in a picture `scale` times as large to the nearest whole pixel."""
        c = self.camera
        return replace(self, camera=c.scaled(round(c.width * scale), round(c.height * scale)))

    def project(self, points: Float[np.ndarray, "*n d"]) -> Float[np.ndarray, "*n 2"]:
        """Pixels of points in the ground frame, (x, y) on the ground or (x, y, z); NaN where not seen.

        A point far outside the picture is not seen: a distortion polynomial holds no further than the
        picture it was fitted to, and beyond folds such points back into it.
        """
        points_cam = self.cam_from_ground.apply(_spatial(points))
        px = self.camera.project(points_cam)
        return np.where(self._in_cone(points_cam)[..., None], px, np.nan)

    def directions(self, px: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
        """Rays through pixels in the ground frame, of length 1 along the optical axis; NaN where none."""
        return self.camera.unproject(px) @ self.cam_from_ground.R

    def ground_under(self, px: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Where the rays through pixels meet the ground; NaN at and above the horizon."""
        rays = self.directions(px)
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = -self.eye[2] / rays[..., 2]
        return np.where((reach > 0)[..., None], self.eye[:2] + reach[..., None] * rays[..., :2], np.nan)

    def looked_over(self, places: int) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
        """Pixels spread evenly over the picture, so many along either side, and the ground under them."""
        c = self.camera
        u, v = np.meshgrid(np.linspace(0, c.width - 1, places), np.linspace(0, c.height - 1, places))
        px = np.stack([u, v], -1).reshape(-1, 2)
        return px, self.ground_under(px)

    def polylines(
        self, segments: Float[np.ndarray, "n 2 d"], pieces: int
    ) -> tuple[Float[np.ndarray, "k m 2"], Float[np.ndarray, "k m 3"]]:
        """Segments of the ground frame as they appear: pixels, and the ground points that they show.

        Each is first cut to what the picture sees, and left out if that is nothing. Its points are spaced
        evenly in the picture, so that a line that starts at the camera's feet stays smooth.
        """
        ends = self.cam_from_ground.apply(_spatial(segments))
        low, high = np.zeros(len(ends)), np.ones(len(ends))
        for plane in self._cone:
            side = ends @ plane
            with np.errstate(divide="ignore", invalid="ignore"):
                cut = side[:, 0] / (side[:, 0] - side[:, 1])
            inside = side > 0
            low = np.where(~inside[:, 0] & inside[:, 1], np.maximum(low, cut), low)
            high = np.where(inside[:, 0] & ~inside[:, 1], np.minimum(high, cut), high)
            high = np.where(inside.any(1), high, -1.0)
        seen = high > low
        ends, low, high = ends[seen], low[seen, None], high[seen, None]
        start = ends[:, 0] + low * (ends[:, 1] - ends[:, 0])
        end = ends[:, 0] + high * (ends[:, 1] - ends[:, 0])
        s = np.linspace(0.0, 1.0, pieces + 1)
        # Even steps s in the picture are steps t along the segment, by the ends' depths.
        near = s * start[:, 2:3]
        t = near / (near + (1 - s) * end[:, 2:3])
        points_cam = start[:, None] + t[..., None] * (end - start)[:, None]
        return self.camera.project(points_cam), self.cam_from_ground.inverse.apply(points_cam)

    def _in_cone(self, points_cam: Float[np.ndarray, "*n 3"]) -> Bool[np.ndarray, "*n"]:
        return np.asarray(np.all(points_cam @ self._cone.T > 0, axis=-1))

    @cached_property
    def _cone(self) -> Float[np.ndarray, "5 3"]:
        """Normals, pointing inwards, of five planes through the eye: four sides of the picture, and ahead."""
        t = np.linspace(0.0, 1.0, 33)
        sides = [(t, 0 * t), (t, 0 * t + 1), (0 * t, t), (0 * t + 1, t)]
        border = np.concatenate([np.stack(side, 1) for side in sides])
        edge = border * [self.camera.width, self.camera.height] - 0.5
        xy = self.camera.normalise(edge)
        low, high = np.nanmin(xy, 0), np.nanmax(xy, 0)
        pad = 0.05 * (high - low)
        (x0, y0), (x1, y1) = low - pad, high + pad
        return np.array([[1, 0, -x0], [-1, 0, x1], [0, 1, -y0], [0, -1, y1], [0, 0, 1.0]])


def _spatial(points: Float[np.ndarray, "*n d"]) -> Float[np.ndarray, "*n 3"]:
    """Points with a height; (x, y) lie on the ground."""
    if points.shape[-1] == 3:
        return points
    return np.concatenate([points, np.zeros((*points.shape[:-1], 1))], -1)
