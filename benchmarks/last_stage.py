"""autoreg's own last stage, as `align` ends a photo with a camera file, from a given start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from autoreg.answer.full_resolution import REACH, from_what_shows
from autoreg.answer.last_step import likeliest, rested
from autoreg.camera import Camera
from autoreg.fitting.fit import Fit
from autoreg.fitting.measure import NARROW
from autoreg.fitting.refine import refine_until_still
from autoreg.geometry import Rigid, nearest_rotation, rotation_from_vector, vector_from_rotation
from autoreg.ground.points import on_ground, project_ground
from autoreg.ground.sides import Grid
from autoreg.solve.freedom import Free
from autoreg.synthetic import SyntheticScene


@dataclass(frozen=True)
class Finish:
    """What the last stage makes of a start: the pose and its covariance as they are reported, and the fit."""

    cam_from_ground: Rigid
    covariance: Float[np.ndarray, "6 6"]
    fit: Fit


def finish(
    picture: Float[np.ndarray, "h w"],
    camera: Camera,
    start: Rigid,
    grid: Grid,
    *,
    search: float = NARROW,
) -> Finish | None:
    """The answer from a start near the truth; None if nothing can be measured there."""
    fit = refine_until_still(picture, camera, start, grid, free=Free(), search=search, reach=REACH)
    if fit is None:
        return None
    fit = from_what_shows(fit)
    last = rested(picture, likeliest(picture, fit), REACH)
    return Finish(last.fit.cam_from_ground, last.covariance, fit)


def pose_error(found: Rigid, true: Rigid) -> Float[np.ndarray, "6"]:
    """(Rotation vector, translation) of the motion on the camera's side from the truth to `found`."""
    return np.r_[vector_from_rotation(found.R @ true.R.T), found.t - true.t]


def moved(pose: Rigid, motion: Float[np.ndarray, "6"]) -> Rigid:
    """The pose whose `pose_error` from the given one is `motion`."""
    turn = rotation_from_vector(motion[:3])
    return Rigid(nearest_rotation(turn @ pose.R), pose.t + motion[3:])


def nudged(pose: Rigid, turn_deg: float, share: float, rng: np.random.Generator) -> Rigid:
    """The pose turned in a random direction, and its translation off by a share of the camera's height."""
    axis, way = rng.standard_normal((2, 3))
    motion = np.r_[
        np.deg2rad(turn_deg) * axis / np.linalg.norm(axis),
        share * pose.origin_in_a[2] * way / np.linalg.norm(way),
    ]
    # The camera turns about itself: its translation swings along.
    turn = rotation_from_vector(motion[:3])
    return Rigid(turn @ pose.R, turn @ pose.t + motion[3:])


def grid_of(scene: SyntheticScene) -> Grid:
    """The lattice that a scene is drawn by."""
    return Grid(*scene.spacing_m, scene.shift)


def crossings_of(
    scene: SyntheticScene, margin_px: float = 10.0, heights: float = 6.0
) -> Float[np.ndarray, "n 2"]:
    """Ground points of the joint crossings that the scene's camera sees within so many camera heights."""
    (a, b), eye = scene.spacing_m, scene.cam_from_ground.origin_in_a
    reach = heights * eye[2]
    rows = np.arange(np.floor((eye[1] - reach) / b), np.ceil((eye[1] + reach) / b) + 1)
    columns = np.arange(-np.ceil(reach / a) - 1, np.ceil(reach / a) + 2)
    j, i = (v.ravel() for v in np.meshgrid(rows, columns, indexing="ij"))
    ground = np.stack([(np.round(eye[0] / a - j * scene.shift) + i + j * scene.shift) * a, j * b], 1)
    px = project_ground(scene.camera, scene.cam_from_ground, ground)
    size = np.array([scene.camera.width, scene.camera.height]) - 1
    with np.errstate(invalid="ignore"):
        seen = ((px >= margin_px) & (px <= size - margin_px)).all(1)
        # Beyond its valid field a lens's model folds back into the picture.
        back = on_ground(px, scene.camera, scene.cam_from_ground)
        seen &= np.linalg.norm(back - ground, axis=1) < 1e-3 * min(a, b)
    return ground[seen & (np.linalg.norm(ground - eye[:2], axis=1) <= reach)]


def crossings_error_px(found: Rigid, scene: SyntheticScene, ground: Float[np.ndarray, "n 2"]) -> float:
    """RMS distance in pixels of projected crossings from where they truly are."""
    off = project_ground(scene.camera, found, ground) - project_ground(
        scene.camera, scene.cam_from_ground, ground
    )
    return float(np.sqrt(np.mean((off**2).sum(1))))
