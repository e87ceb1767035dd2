"""Orientation of the ground made sharper: its joints, projected along themselves, must fall into few lines.

Vanishing points of short, rough joints are known to a degree or two, which smears a line of joints over its
neighbours. The segments of one joint then agree only if the orientation (and the focal length, where it is
unknown) is right: the histogram of their places on the ground is sharpest there.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from autoreg.camera import Camera
from autoreg.geometry import rotation_from_vector
from autoreg.ground.directions import MIN_DEPRESSION
from autoreg.ground.rectify import grid_axes
from autoreg.segments import Segments

BINS = 320
# Segments further than this off a family's direction are not its joints.
DIRECTION_TOLERANCE_RAD = np.radians(5.0)
# Size of the first steps: rotation, logarithm of the focal length.
FIRST_STEP_RAD, FIRST_STEP_FOCAL = np.radians(0.8), 0.06


@dataclass(frozen=True)
class _Points:
    """Points along the segments: ideal coordinates, direction, and weight."""

    xy: Float[np.ndarray, "n 2"]
    along: Float[np.ndarray, "n 2"]
    weight: Float[np.ndarray, " n"]


def sharpen(
    segments: Segments, camera: Camera, R: Float[np.ndarray, "3 3"], *, free_focal: bool
) -> tuple[Camera, Float[np.ndarray, "3 3"]]:
    """The camera and the cam_from_ground rotation, near given ones, that line up the joints best."""
    # Most photos need no sharpening, and none of them should wait for its import.
    from scipy.optimize import minimize

    points = _points(segments, camera)
    axes = grid_axes(camera, R, 12.0, BINS)
    if axes is None or len(points.weight) < 30:
        return camera, R

    def blur(p: np.ndarray) -> float:
        turned = rotation_from_vector(p[:3] * FIRST_STEP_RAD) @ R
        focal = float(np.exp(p[3] * FIRST_STEP_FOCAL)) if free_focal else 1.0
        # A weak pull to the start: it was found by a robust fit, and the sharpness has side peaks.
        return -_sharpness(points, turned, focal, axes) * (1.0 - 0.01 * float(p @ p))

    size = 4 if free_focal else 3
    simplex = np.vstack([np.zeros(size), np.eye(size)])
    found = minimize(
        blur,
        np.zeros(size),
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "maxfev": 220, "xatol": 0.01, "fatol": 1e-4},
    )
    p = found.x
    if free_focal:
        focal = camera.fx * float(np.exp(p[3] * FIRST_STEP_FOCAL))
        camera = Camera.from_focal(camera.width, camera.height, focal)
    return camera, rotation_from_vector(p[:3] * FIRST_STEP_RAD) @ R


def _points(segments: Segments, camera: Camera, limit: int = 1500) -> _Points:
    segments = segments.take(np.arange(min(len(segments), limit)))
    ends = camera.normalise(segments.ends_px)
    along = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=1)
    good = np.isfinite(length) & (length > 0)
    ends, along, length = ends[good], along[good] / length[good, None], length[good]
    places = ends[:, :1] + np.array([0.0, 0.5, 1.0])[:, None] * (ends[:, 1:] - ends[:, :1])
    return _Points(places.reshape(-1, 2), np.repeat(along, 3, axis=0), np.repeat(np.sqrt(length), 3))


def _sharpness(points: _Points, R: np.ndarray, focal: float, axes: tuple[np.ndarray, np.ndarray]) -> float:
    """Sum over both families of the histogram's contrast: what is left of it after a wide smoothing."""
    xy = points.xy / focal
    rays = np.c_[xy, np.ones(len(xy))]
    ground = rays @ R
    below = ground[:, 2] < -MIN_DEPRESSION
    place = ground[:, :2] / np.minimum(ground[:, 2:], -MIN_DEPRESSION) * -1.0
    total = 0.0
    for family in (0, 1):
        # Picture direction of the family at each point.
        d = R[:2, family] - xy * R[2, family]
        d = d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-12)
        off = np.abs(d[:, 0] * points.along[:, 1] - d[:, 1] * points.along[:, 0])
        weight = points.weight * below * np.clip(1.0 - (off / DIRECTION_TOLERANCE_RAD) ** 2, 0.0, 1.0)
        axis = axes[1 - family]
        bin_at = np.interp(place[:, 1 - family], axis, np.arange(len(axis)), left=-1.0, right=-1.0)
        inside = bin_at >= 0
        low = np.floor(bin_at[inside]).astype(int)
        part = bin_at[inside] - low
        w = weight[inside]
        size = len(axis) + 1
        # numpy counts nothing in whole numbers, whatever its weight.
        histogram = np.bincount(low, w * (1 - part), size).astype(float)
        histogram += np.bincount(low + 1, w * part, size)
        fine, smooth = (
            cv2.GaussianBlur(histogram[None], (0, 0), sigma, borderType=cv2.BORDER_REFLECT)
            for sigma in (1.0, 8.0)
        )
        total += float(((fine - smooth) ** 2).sum())
    return total / float(points.weight.sum() ** 2) * 1e3
