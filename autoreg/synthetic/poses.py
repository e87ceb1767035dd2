"""Camera poses over the ground, by the angles a photographer would name."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from autoreg.geometry import Rigid


def look_at_ground(
    *,
    pitch_deg: float,
    height_m: float,
    heading_deg: float = 0.0,
    roll_deg: float = 0.0,
    foot_m: tuple[float, float] = (0.0, 0.0),
) -> Rigid:
    """Pose `cam_from_ground` of a camera at a height above the ground that looks down by `pitch_deg`.

    Args:
        pitch_deg: angle below the horizon; 90 looks straight down, 0 is level, negative looks up.
        height_m: height of the camera above the ground.
        heading_deg: direction of view on the ground, counter-clockwise from +Y seen from above.
        roll_deg: turn of the camera about its own view, clockwise as the photographer sees it.
        foot_m: the ground point under the camera.
    """
    pitch, heading, roll = np.deg2rad([pitch_deg, heading_deg, roll_deg])
    ahead = np.array([-np.sin(heading), np.cos(heading), 0.0])
    right = np.array([np.cos(heading), np.sin(heading), 0.0])
    forward = np.cos(pitch) * ahead - np.sin(pitch) * np.array([0.0, 0.0, 1.0])
    down = np.cross(forward, right)
    turned_right = np.cos(roll) * right + np.sin(roll) * down
    R = np.stack([turned_right, np.cross(forward, turned_right), forward])
    return Rigid(R, -R @ np.array([foot_m[0], foot_m[1], height_m]))


def ground_points(
    pixels_xy: Float[np.ndarray, "n 2"], camera_K: Float[np.ndarray, "3 3"], cam_from_ground: Rigid
) -> Float[np.ndarray, "n 2"]:
    """Ground points (Z = 0) under pixels of an undistorted camera; NaN for pixels above the horizon."""
    ray_of_pixel, eye = cam_from_ground.R.T @ np.linalg.inv(camera_K), cam_from_ground.origin_in_a
    u, v = pixels_xy[:, 0], pixels_xy[:, 1]
    x, y, z = (along[0] * u + along[1] * v + along[2] for along in ray_of_pixel)
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(z < 0, -eye[2] / z, np.nan)
    return np.stack([eye[0] + x * reach, eye[1] + y * reach], 1)
