"""Points of the ground plane: where they are seen, which lie under a pixel, and which within a field."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from autoreg.camera import Camera
from autoreg.geometry import Rigid


def project_ground(
    camera: Camera, cam_from_ground: Rigid, points: Float[np.ndarray, "*n 2"]
) -> Float[np.ndarray, "*n 2"]:
    """Pixels of points of the ground plane."""
    # Coordinate by coordinate, as `project` takes them: NumPy is slow where the last axis is short.
    in_camera = cam_from_ground.R[:, :2] @ points.reshape(-1, 2).T + cam_from_ground.t[:, None]
    return camera.project(in_camera.T).reshape(points.shape)


def lengths(vectors: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
    """Lengths of plane vectors; NumPy's own norm takes five times as long over so short an axis."""
    x, y = vectors[..., 0], vectors[..., 1]
    return np.sqrt(x * x + y * y)


def on_ground(
    px: Float[np.ndarray, "*n 2"], camera: Camera, cam_from_ground: Rigid
) -> Float[np.ndarray, "*n 2"]:
    """Ground points under pixels; NaN where no ground is seen."""
    rays = camera.unproject(px) @ cam_from_ground.R
    eye = cam_from_ground.origin_in_a
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = eye[:2] - rays[..., :2] * (eye[2] / rays[..., 2:])
    return np.where(rays[..., 2:] < -1e-3, ground, np.nan)


def visible_ground(
    camera: Camera, cam_from_ground: Rigid, reach: float, samples: int = 41
) -> Float[np.ndarray, "n 2"]:
    """Ground points under a grid of pixels, no farther from the camera's foot than `reach` heights."""
    u, v = np.linspace(0, camera.width - 1, samples), np.linspace(0, camera.height - 1, samples)
    xy = camera.normalise(np.stack(np.meshgrid(u, v), -1).reshape(-1, 2))
    ground_from_cam = cam_from_ground.inverse
    rays = np.c_[xy, np.ones(len(xy))] @ ground_from_cam.R.T
    eye = ground_from_cam.t
    down = np.isfinite(rays).all(1) & (rays[:, 2] < -1e-3)
    scale = -eye[2] / rays[down, 2]
    flat = rays[down, :2] * scale[:, None]
    return flat[lengths(flat) < reach * eye[2]] + eye[:2]


def inside_convex(
    points: Float[np.ndarray, "n 2"], polygon: Float[np.ndarray, "k 2"], margin: float
) -> np.ndarray:
    """Which points lie in a convex counter-clockwise polygon, or within `margin` of it."""
    edge = np.roll(polygon, -1, axis=0) - polygon
    inwards = np.stack([-edge[:, 1], edge[:, 0]]) / lengths(edge)
    return (points @ inwards > (polygon.T * inwards).sum(0) - margin).all(1)


def inside_box(
    points: Float[np.ndarray, "n 2"], polygon: Float[np.ndarray, "k 2"], margin: float = 0.0
) -> np.ndarray:
    """Which points lie in the box around a polygon, along the axes, or within so many of its sizes of it."""
    low, high = polygon.min(0), polygon.max(0)
    widened = margin * (high - low)
    return ((points > low - widened) & (points < high + widened)).all(1)
