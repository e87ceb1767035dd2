"""Draw a synthetic photo by asking, for samples of every pixel, what the ground under it looks like."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from autoreg.camera import Camera
from autoreg.lattice import Lattice
from autoreg.synthetic.paint import Ground
from autoreg.synthetic.poses import ground_points
from autoreg.synthetic.scene import SyntheticPhoto, SyntheticScene

# So many samples are asked for at a time: what a processor's cache holds of all that is worked out for them.
AT_ONCE = 16384

Grid = Float[np.ndarray, "h w"]
Samples = Float[np.ndarray, " n"]


def render_paving(scene: SyntheticScene) -> SyntheticPhoto:
    """The photo of a scene, with the camera, pose and lattice that it was drawn by.

    Every pixel is the mean of `samples`² sub-pixels, each seen through the exact camera model, and the joints
    enter each sub-pixel by the area that they cover of its footprint on the ground. Tones mix in grey levels,
    so that a joint's centroid lies where its centre line projects.

    Raises:
        ValueError: the camera's distortion cannot be inverted over the whole picture.
    """
    rng = np.random.default_rng(scene.seed)
    grey = _grey(scene, rng)
    return SyntheticPhoto(_developed(scene, grey, rng), scene.camera, scene.cam_from_ground, _truth(scene))


def clean_grey(scene: SyntheticScene) -> Grid:
    """Grey levels of a scene before noise and rounding: what the sensor would see on average."""
    return _grey(scene, np.random.default_rng(scene.seed))


def _grey(scene: SyntheticScene, rng: np.random.Generator) -> Grid:
    ground = Ground(scene, rng)
    x_centre, y_centre = _ground_grid(scene, 0.0, 0.0)
    things = _Things(scene, x_centre, y_centre, rng)
    width_x, width_y = _footprint(x_centre), _footprint(y_centre)
    # The lens blurs before the pixels add up: a blur of whole pixels would let thin joints alias.
    n = scene.samples
    fine = np.empty((n * x_centre.shape[0], n * x_centre.shape[1]))
    offsets = (np.arange(n) + 0.5) / n - 0.5
    for column, du in enumerate(offsets):
        for row, dv in enumerate(offsets):
            x, y = (x_centre, y_centre) if n == 1 else _ground_grid(scene, float(du), float(dv))
            fine[row::n, column::n] = _sample(scene, ground, things, x, y, width_x, width_y)
    fine = _blurred(fine, n * scene.blur_px)
    return fine.reshape(x_centre.shape[0], n, x_centre.shape[1], n).mean((1, 3))


def _ideal_pixels(camera: Camera, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Where pixels would lie without distortion."""
    if not camera.has_distortion:
        return pixels
    xy = camera.normalise(pixels)
    if np.isnan(xy).any():
        raise ValueError(f"the distortion {camera.dist} cannot be inverted over the whole picture")
    return xy * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def _ground_grid(scene: SyntheticScene, du: float, dv: float) -> tuple[Grid, Grid]:
    """Ground coordinates under every pixel, moved by a part of a pixel; NaN above the horizon."""
    camera = scene.camera
    U, V = np.meshgrid(np.arange(camera.width) + du, np.arange(camera.height) + dv)
    pixels = _ideal_pixels(camera, np.column_stack([U.ravel(), V.ravel()]))
    points = ground_points(pixels, camera.K, scene.cam_from_ground)
    return points[:, 0].reshape(U.shape), points[:, 1].reshape(U.shape)


def _footprint(coordinate: Grid) -> Grid:
    """Width of a pixel's footprint along one ground axis: the box with the footprint's own variance."""
    per_row, per_column = np.gradient(coordinate)
    return np.hypot(per_row, per_column)


def _sample(
    scene: SyntheticScene, ground: Ground, things: _Things, x: Grid, y: Grid, width_x: Grid, width_y: Grid
) -> Grid:
    seen = np.isfinite(x) & np.isfinite(width_x) & np.isfinite(width_y)
    tones = np.full(x.shape, scene.sky_tone)
    gx, gy = x[seen], y[seen]
    wx, wy = width_x[seen] / scene.samples, width_y[seen] / scene.samples
    shown = np.empty(len(gx))
    for first in range(0, len(gx), AT_ONCE):
        some = slice(first, first + AT_ONCE)
        place, footprint = (gx[some], gy[some]), (wx[some], wy[some])
        tone = ground.tone(*place, *footprint) * ground.texture(*place, footprint[0] + footprint[1])
        shown[some] = things.over(tone, *place)
    tones[seen] = shown
    return tones


class _Things:
    """What lies on the ground, and what throws a shadow on it, at places that the photo shows."""

    def __init__(self, scene: SyntheticScene, x: Grid, y: Grid, rng: np.random.Generator) -> None:
        self._scene = scene
        seen = np.column_stack([x[np.isfinite(x)], y[np.isfinite(x)]])
        eye = scene.cam_from_ground.origin_in_a
        near = seen[np.linalg.norm(seen - eye[:2], axis=1) < 5 * abs(eye[2])]
        count = scene.shadows + scene.clutter
        places = near[rng.integers(0, len(near), count)] if len(near) else np.zeros((count, 2))
        self._places = places
        self._turns = rng.uniform(0, 2 * np.pi, count)
        self._sizes = rng.uniform(0.03, 0.12, (count, 2)) * abs(eye[2])
        self._tones = rng.uniform(20, 235, count)
        self._round = rng.uniform(size=count) < 0.5

    def over(self, tones: Samples, x: Samples, y: Samples) -> Samples:
        """The tones of ground samples after shadows and clutter."""
        for k in range(len(self._places)):
            p, q = self._local(k, x, y)
            if k < self._scene.shadows:
                tones = np.where(self._shaded(k, p, q), self._scene.shade * tones, tones)
            else:
                tones = np.where(self._hidden(k, p, q), self._tones[k], tones)
        return tones

    def _local(self, k: int, x: Samples, y: Samples) -> tuple[Samples, Samples]:
        cos, sin = np.cos(self._turns[k]), np.sin(self._turns[k])
        dx, dy = x - self._places[k, 0], y - self._places[k, 1]
        return cos * dx + sin * dy, cos * dy - sin * dx

    def _shaded(self, k: int, p: Samples, q: Samples) -> Bool[np.ndarray, " n"]:
        # A shadow reaches in from outside: an endless strip with one end in the photo.
        return (p > 0) & (np.abs(q) < 3 * self._sizes[k, 0])

    def _hidden(self, k: int, p: Samples, q: Samples) -> Bool[np.ndarray, " n"]:
        if self._round[k]:
            return np.hypot(p, q) < self._sizes[k, 0]
        return (np.abs(p) < self._sizes[k, 0]) & (np.abs(q) < self._sizes[k, 1])


def _blurred(grey: Grid, sigma_px: float) -> Grid:
    """The picture under a Gaussian point spread, its edges repeated."""
    if sigma_px <= 0:
        return grey
    reach = int(np.ceil(4 * sigma_px))
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_px) ** 2)
    taps /= taps.sum()
    return cv2.sepFilter2D(grey, cv2.CV_64F, taps, taps, borderType=cv2.BORDER_REPLICATE)


def _developed(
    scene: SyntheticScene, grey: Grid, rng: np.random.Generator
) -> UInt8[np.ndarray, "h w 3"] | UInt8[np.ndarray, "h w"]:
    """Eight-bit pixels: a warm tint where colour is asked for, the sensor's noise, rounding."""
    values = grey[..., None] * np.array([0.94, 1.0, 1.04]) if scene.colour else grey
    if scene.noise_grey > 0:
        values = values + scene.noise_grey * rng.standard_normal(values.shape, np.float32)
    return np.clip(np.round(values), 0, 255).astype(np.uint8)


def _truth(scene: SyntheticScene) -> Lattice | None:
    if scene.kind not in ("lattice", "rows"):
        return None
    rows = scene.kind == "rows"
    return Lattice(
        kind="rows" if rows else "running" if scene.shift else "stack",
        spacing_x=None if rows else scene.spacing_m[0],
        spacing_y=scene.spacing_m[1],
        shift=None if rows else scene.shift,
        joint_width=scene.joint_width_m,
        extent=_extent(scene),
    )


def _extent(scene: SyntheticScene) -> Float[np.ndarray, "n 2"]:
    """Ground polygon of the picture's outline, cut off at twenty camera heights."""
    camera = scene.camera
    u, v = np.linspace(0, camera.width - 1, 60), np.linspace(0, camera.height - 1, 60)
    right, bottom = np.full(60, camera.width - 1.0), np.full(60, camera.height - 1.0)
    outline = np.concatenate(
        [
            np.column_stack([u, 0 * u]),
            np.column_stack([right, v]),
            np.column_stack([u[::-1], bottom]),
            np.column_stack([0 * v, v[::-1]]),
        ]
    )
    points = ground_points(_ideal_pixels(camera, outline), camera.K, scene.cam_from_ground)
    eye = scene.cam_from_ground.origin_in_a
    with np.errstate(invalid="ignore"):
        return points[np.linalg.norm(points - eye[:2], axis=1) < 20 * abs(eye[2])]
