"""What an aligned photo is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.lattice import Lattice

# Where a camera came from.
CameraSource = Literal["file", "exif", "photo"]
ScaleSource = Literal["slab", "camera_height", "none"]


@dataclass(frozen=True)
class CameraReport:
    """The camera that was used, where it came from, and what the photo's own joints say of it."""

    camera: Camera
    source: CameraSource
    consistent: bool | None
    focal_from_photo_px: float | None
    focal_from_photo_sigma_px: float | None


def height_by_motion(cam_from_ground: Rigid) -> Float[np.ndarray, "6"]:
    """Change of the camera's height by a small motion (rotation vector, translation) on its side."""
    up, t = cam_from_ground.R[:, 2], cam_from_ground.t
    # The height is -up . t, and a small turn w moves up by w x up.
    return -np.r_[np.cross(up, t), up]


@dataclass(frozen=True)
class Pose:
    """`cam_from_ground` with the covariance of (rotation vector in radians, translation in metres).

    The covariance is that of a small motion on the camera's side: R = exp(w) R_true, t = t_true + dt.
    """

    cam_from_ground: Rigid
    covariance: Float[np.ndarray, "6 6"]

    @property
    def sigma_turn(self) -> float:
        """Standard deviation of a turn of the camera, in radians, about the axis that is known least."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))

    @property
    def sigma_height(self) -> float:
        """Standard deviation of the camera's height above the ground, in metres."""
        by_motion = height_by_motion(self.cam_from_ground)
        # It is known exactly where the scale was taken from it.
        return float(np.sqrt(max(by_motion @ self.covariance @ by_motion, 0.0)))


@dataclass(frozen=True)
class Residual:
    """How far the photographed joints lie from the fitted ones."""

    rms_px: float
    median_px: float
    p95_px: float
    joints: int
    samples: int
    inlier_fraction: float


@dataclass(frozen=True)
class JointFit:
    """One joint line that carried the fit: family "x" runs along X (its index counts along Y)."""

    family: Literal["x", "y"]
    index: int
    ends_px: Float[np.ndarray, "2 2"]
    rms_px: float


@dataclass(frozen=True)
class Alignment:
    """An aligned photo."""

    width: int
    height: int
    camera: CameraReport
    pose: Pose
    scale_source: ScaleSource
    lattice: Lattice
    residual: Residual
    joints: tuple[JointFit, ...]
    warnings: tuple[str, ...] = ()
