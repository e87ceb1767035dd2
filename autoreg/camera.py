"""The calibrated camera: pixels from camera-frame points, and rays from pixels."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from autoreg import distortion
from autoreg.errors import InputError

DIST_LENGTHS = (0, 4, 5, 8)


@dataclass(frozen=True)
class Camera:
    """Pinhole camera with OpenCV's distortion; (0, 0) is the centre of the top-left pixel.

    `dist` holds OpenCV's coefficients (k1 k2 p1 p2 k3 k4 k5 k6), zero-filled to eight; the row or column that
    OpenCV's own calibration returns is taken too.

    Raises:
        ValueError: a size or focal length is not positive, a number is not finite, or `dist` does not
            hold 0, 4, 5 or 8 coefficients.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    dist: tuple[float, ...] = (0.0,) * 8

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            object.__setattr__(self, name, _positive_integer(name, getattr(self, name)))
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, _finite(name, getattr(self, name)))
        for name in ("fx", "fy"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}")
        coefficients = tuple(_finite(f"dist[{i}]", value) for i, value in enumerate(_vector(self.dist)))
        if len(coefficients) not in DIST_LENGTHS:
            raise ValueError(f"dist must hold 0, 4, 5 or 8 coefficients, got {len(coefficients)}")
        object.__setattr__(self, "dist", coefficients + (0.0,) * (8 - len(coefficients)))

    @classmethod
    def from_focal(cls, width: int, height: int, focal_px: float) -> Camera:
        """A camera with square pixels, no distortion, and its principal point at the picture's centre."""
        return cls(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)

    @property
    def K(self) -> Float[np.ndarray, "3 3"]:
        """The intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def has_distortion(self) -> bool:
        """Whether any distortion coefficient differs from zero."""
        return any(self.dist)

    @cached_property
    def valid_radius(self) -> float:
        """Ideal radius (tangent of the angle off the axis) up to which the radial distortion is one-to-one.

        Beyond it the model folds back: `project` then puts points that are far out of view inside the
        picture. It is the first zero of d(r_d)/dr, or of the rational model's denominator.
        """
        if not self.has_distortion:
            return math.inf
        return distortion.first_fold(self.dist)

    def distort(self, xy: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Distorted normalised coordinates of ideal ones (OpenCV's rational and tangential model)."""
        if not self.has_distortion:
            return xy
        return distortion.distort(xy, self.dist)

    def project(self, points_cam: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 2"]:
        """Pixels of camera-frame points; NaN for points that are not in front of the camera."""
        # Column by column: NumPy is slow where the last axis is short.
        x, y, z = np.moveaxis(points_cam, -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            over = np.where(z > 0, 1.0 / z, np.nan)
            xy = self.distort(np.moveaxis(np.stack([x * over, y * over]), 0, -1))
        return np.stack([xy[..., 0] * self.fx + self.cx, xy[..., 1] * self.fy + self.cy], -1)

    def normalise(self, px: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Ideal normalised coordinates of pixels; NaN where no ray inside the valid field lands.

        The inverse of `distort` by Newton's method on the full model, started from a table of the radial
        part. It answers only inside the field where the distortion is one-to-one (`valid_radius`).
        """
        xy_distorted = (px - [self.cx, self.cy]) / [self.fx, self.fy]
        if not self.has_distortion:
            return xy_distorted
        flat = xy_distorted.reshape(-1, 2)
        tolerance = 1e-10 / max(self.fx, self.fy)
        return distortion.undistort(flat, self.dist, self.valid_radius, tolerance).reshape(px.shape)

    def unproject(self, px: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 3"]:
        """Camera-frame rays with z = 1 through pixels; NaN where `normalise` has no answer."""
        xy = self.normalise(px)
        rays = np.ones((*xy.shape[:-1], 3))
        rays[..., :2] = xy
        return rays

    def scaled(self, width: int, height: int) -> Camera:
        """The camera of the same picture resized: pixel *edges* scale, hence the half pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )

    def cropped(self, x: int, y: int, width: int, height: int) -> Camera:
        """The camera of the part of the picture whose top-left pixel is (x, y).

        Raises:
            ValueError: the part reaches outside the picture.
        """
        if min(x, y) < 0 or min(width, height) < 1 or x + width > self.width or y + height > self.height:
            raise ValueError(
                f"crop x,y,w,h = {x},{y},{width},{height} must lie inside {self.width} x {self.height}"
            )
        return replace(self, width=width, height=height, cx=self.cx - x, cy=self.cy - y)

    def turned(self, quarter_turns_clockwise: int) -> Camera:
        """The camera of the same picture turned clockwise by quarter turns."""
        camera = self
        for _ in range(quarter_turns_clockwise % 4):
            # (u, v) goes to (h - 1 - v, u); the tangential pair (p2, p1) turns as the vector (x, y) does.
            k1, k2, p1, p2, k3, k4, k5, k6 = camera.dist
            camera = Camera(
                width=camera.height,
                height=camera.width,
                fx=camera.fy,
                fy=camera.fx,
                cx=camera.height - 1 - camera.cy,
                cy=camera.cx,
                dist=(k1, k2, p2, -p1, k3, k4, k5, k6),
            )
        return camera

    def mirrored(self) -> Camera:
        """The camera of the same picture with left and right exchanged."""
        k1, k2, p1, p2, k3, k4, k5, k6 = self.dist
        return replace(self, cx=self.width - 1 - self.cx, dist=(k1, k2, p1, -p2, k3, k4, k5, k6))


def same_aspect(width_a: int, height_a: int, width_b: int, height_b: int) -> bool:
    """Whether b is a scaled by one factor, each side of b rounded by at most a pixel."""
    low = max((width_b - 1) / width_a, (height_b - 1) / height_a)
    high = min((width_b + 1) / width_a, (height_b + 1) / height_a)
    return low <= high


def fit_to_photo(
    camera: Camera,
    width: int,
    height: int,
    *,
    crop: tuple[int, int, int, int] | None = None,
    photo_turned: int = 0,
    photo_mirrored: bool = False,
) -> tuple[Camera, str | None]:
    """The camera for a photo of this size, and a sentence on what was done to it (None: nothing).

    A camera is taken to be of the stored photos, before EXIF turns them, wherever its size allows that:
    turned by half, or square, either frame has one size.

    Args:
        camera: the calibrated camera.
        width: width of the photo in pixels, after its EXIF orientation was applied.
        height: height of the photo in pixels, likewise.
        crop: x, y, w, h of the part of the calibrated frame that the photo shows.
        photo_turned: quarter turns clockwise that EXIF asked for.
        photo_mirrored: whether EXIF asked for left and right to be exchanged before turning.

    Raises:
        InputError: the sizes contradict each other.
    """
    notes: list[str] = []
    if crop is not None:
        try:
            camera = camera.cropped(*crop)
        except ValueError as error:
            raise InputError(f"{error}, the calibrated frame; correct --crop") from error
        notes.append("cropped to x,y,w,h = " + ",".join(map(str, crop)))
    fits = same_aspect(camera.width, camera.height, width, height)
    fits_turned = same_aspect(camera.height, camera.width, width, height)
    stored = fits_turned if photo_turned % 2 else fits
    if not (fits or stored):
        raise _size_contradiction(camera, width, height, cropped=crop is not None, transposed=fits_turned)
    # It is of the stored photos, which lie as the sensor does, unless its size tells that it is upright.
    if stored:
        if photo_mirrored:
            camera = camera.mirrored()
            notes.append("mirrored as the photo's EXIF orientation says")
        if photo_turned % 4:
            camera = camera.turned(photo_turned)
            notes.append(f"turned clockwise by {90 * (photo_turned % 4)}° with the photo, as its EXIF says")
    if (camera.width, camera.height) != (width, height):
        notes.append(f"scaled from {camera.width} x {camera.height} to {width} x {height}")
        camera = camera.scaled(width, height)
    return camera, "the camera was " + "; ".join(notes) if notes else None


def _size_contradiction(
    camera: Camera, width: int, height: int, *, cropped: bool, transposed: bool
) -> InputError:
    """The error for a photo that the calibrated frame cannot have become by scaling."""
    frame = "the crop of the calibrated frame" if cropped else "the camera file"
    sizes = f"{frame} is {camera.width} x {camera.height} but the photo is {width} x {height}"
    if transposed:
        return InputError(
            f"{sizes}: one of them is on its side, and the photo carries no EXIF rotation that explains it; "
            "turn the photo back as the camera took it, or give a camera calibrated on pictures turned alike"
        )
    advice = "correct --crop x,y,w,h" if cropped else "say with --crop x,y,w,h how the photo was cut from it"
    return InputError(
        f"{sizes}: their aspect ratios {camera.width / camera.height:.4f} and {width / height:.4f} differ, "
        f"so it is no plain resize; {advice}, or give the camera of this photo"
    )


def _positive_integer(name: str, value: object) -> int:
    number = _finite(name, value)
    if number != int(number) or number <= 0:
        raise ValueError(f"{name} must be a positive whole number of pixels, got {value!r}")
    return int(number)


def _vector(dist: object) -> Iterable[object]:
    """The coefficients one by one, of a sequence or of an array with one row or column."""
    if isinstance(dist, np.ndarray) and dist.ndim and sum(n > 1 for n in dist.shape) <= 1:
        return dist.ravel()
    if isinstance(dist, np.ndarray) or not isinstance(dist, Sequence) or isinstance(dist, str):
        raise ValueError(f"dist must be a sequence of 0, 4, 5 or 8 coefficients, got {dist!r}")
    return dist


def _finite(name: str, value: object) -> float:
    try:
        number = float(value)  # pyright: ignore[reportArgumentType]  # anything that numpy makes a scalar
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} must be a number, got {value!r}") from None
    if not math.isfinite(number):
        raise ValueError(f"{name} must be finite, got {value!r}")
    return number
