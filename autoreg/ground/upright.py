"""Which planes a camera may see as ground, and which look like walls, by how the camera would be held."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

# A camera is not rolled further than this, unless it looks down so steeply that roll means nothing.
MAX_ROLL_RAD = np.radians(50.0)
STEEP_RAD = np.radians(42.0)
# Joints may lead from a ground that a camera may see to one that lies this far beyond.
LED_RAD = np.radians(5.0)
# Beyond this a plane seen steeply is taken for a wall if it faces to a side, and a joint direction is plumb
# in the picture: a camera held level shows walls so.
FRONTAL_RAD, PLUMB_RAD = np.radians(25.0), np.radians(2.5)
# A plane seen more aslant than the first is like a wall's where it would be ground only for a camera that was
# rolled farther, and has joints that stand upright for one that was rolled by no more than the second.
ASLANT_RAD, UPRIGHT_RAD = np.radians(8.0), np.radians(15.0)
# Hands hold cameras level to so much.
LEVEL_RAD = np.radians(6.0)

# What is told of each plane, or of the only one.
Told = Bool[np.ndarray, "*k"] | np.bool_


def possible_up(up: Float[np.ndarray, "*k 3"], spare_rad: float = 0.0) -> Told:
    """Whether the normal of a ground, pointing to the camera's side, has a roll that cameras have.

    Or would have it but for `spare_rad`, by which either limit is wider.
    """
    return (up[..., 2] < -np.cos(STEEP_RAD + spare_rad)) | hardly_rolled(up, spare_rad)


def upside_down(up: Float[np.ndarray, "*k 3"]) -> Bool[np.ndarray, "*k"]:
    """Whether a plane's normal points away from a camera that stands above it."""
    steep = np.abs(up[..., 2]) > np.cos(STEEP_RAD)
    return np.where(steep, up[..., 2] > 0, up[..., 1] > 0)


def hardly_rolled(up: Float[np.ndarray, "*k 3"], spare_rad: float = 0.0) -> Told:
    """Whether the normal of a ground points up in the picture, as that of an upright camera's does."""
    return np.abs(up[..., 0]) < np.tan(MAX_ROLL_RAD + spare_rad) * -up[..., 1]


def roll_deg(R: Float[np.ndarray, "3 3"]) -> float:
    """How far a camera is rolled that sees a ground so: 180 degrees where its horizon lies below."""
    return float(np.rad2deg(np.abs(np.arctan2(R[0, 2], -R[1, 2]))))


def stands_plumb(R: Float[np.ndarray, "*k 3 3"]) -> Bool[np.ndarray, "*k"]:
    """Whether planes seen aslant face to a side, with joints that are plumb in the picture, as walls do."""
    up, joints = R[..., 2], R[..., :2]
    upright = np.abs(joints[..., 1, :]).max(-1) > 0.7
    plumb = upright & (np.abs(joints[..., 0, :]).min(-1) < np.sin(PLUMB_RAD))
    sideways = np.abs(up[..., 0]) > np.abs(up[..., 1])
    return (np.abs(up[..., 2]) < np.cos(FRONTAL_RAD)) & sideways & plumb


def like_upright_wall(R: Float[np.ndarray, "3 3"]) -> bool:
    """Whether a plane is ground only for a camera that was rolled far, and a wall for one held upright."""
    up, x, y = R[:, 2], R[0, :2], np.abs(R[1, :2])
    upright = ((y > np.sqrt(0.5)) & (np.abs(x) < np.tan(UPRIGHT_RAD) * y)).any()
    return bool(-up[2] < np.cos(ASLANT_RAD) and not hardly_rolled(up) and upright)


def like_wall(R: Float[np.ndarray, "3 3"]) -> bool:
    """Whether a ground looks like a wall: its joints lie level in the picture, and it faces the camera.

    Or its horizon lies below, as that of a wall does which the camera looks down on, or to a side.
    """
    level = np.abs(R[0, :2]).min() < np.sin(LEVEL_RAD)
    facing = level and (-R[2, 2] > np.cos(FRONTAL_RAD) or R[1, 2] > 0)
    return bool(facing or like_upright_wall(R))
