"""The Cramér-Rao bound of a photo's pose, from the renderer that draws the photo.

For a picture p(theta) and independent Gaussian noise of standard deviation s on every pixel, no unbiased
estimate of theta has a covariance below (J'J)^-1 s^2, J = dp / dtheta (Kay, Fundamentals of Statistical
Signal Processing I, 3.9). J is the central difference of whole rendered pictures, so that blur, joint width,
perspective and the picture's edge are in it as they are in the picture. What else an aligner cannot know is
estimated along: the joints' width, the two tones and the blur.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from autoreg.ground.points import project_ground
from autoreg.synthetic import SyntheticScene, clean_grey
from benchmarks.last_stage import moved

NAMES = ("turn x", "turn y", "turn z", "x", "y", "z")
NUISANCES = ("joint_width_m", "joint_tone", "slab_tone", "blur_px")


@dataclass(frozen=True)
class Bound:
    """The bound of the pose's covariance, with the other parameters unknown, for noise of one grey level."""

    unit_covariance: Float[np.ndarray, "6 6"]

    def sigma(self, noise_grey: float) -> Float[np.ndarray, "6"]:
        """Least standard deviation of each parameter (rad, m)."""
        return noise_grey * np.sqrt(np.diag(self.unit_covariance))

    def crossings_px(
        self, scene: SyntheticScene, ground: Float[np.ndarray, "n 2"], noise_grey: float
    ) -> float:
        """Least RMS distance of the crossings from their true place."""
        J = crossing_jacobian(scene, ground)
        per_point = np.einsum("nij,jk,nik->n", J, self.unit_covariance, J)
        return noise_grey * float(np.sqrt(per_point.mean()))


def cramer_rao(scene: SyntheticScene) -> Bound:
    """The bound for a scene without texture: tones that jump where slabs meet have no derivative.

    Raises:
        ValueError: the scene's slabs are not all of one tone.
    """
    if scene.tone_spread or scene.texture or scene.second_tone is not None:
        raise ValueError("scene: the bound wants slabs of one tone, without texture")
    columns = [_pose_derivative(scene, k).ravel() for k in range(6)]
    columns += [_derivative(scene, name).ravel() for name in NUISANCES]
    J = np.stack(columns, 1)
    unit = np.linalg.norm(J, axis=0)
    information = (J / unit).T @ (J / unit)
    covariance = np.linalg.inv(information) / np.outer(unit, unit)
    return Bound(covariance[:6, :6])


def _pose_derivative(scene: SyntheticScene, k: int) -> Float[np.ndarray, "h w"]:
    # A step moves the picture by a few hundredths of a pixel: small against the blur, far above rounding.
    height = float(scene.cam_from_ground.origin_in_a[2])
    step = np.zeros(6)
    step[k] = 0.03 / scene.camera.fx * (1.0 if k < 3 else height)
    # A turn on the camera's side leaves t where it is, so the eye swings about the ground's origin.
    ends = [replace(scene, cam_from_ground=moved(scene.cam_from_ground, s * step)) for s in (1.0, -1.0)]
    return (clean_grey(ends[0]) - clean_grey(ends[1])) / (2 * step[k])


def _derivative(scene: SyntheticScene, name: str) -> Float[np.ndarray, "h w"]:
    value = float(getattr(scene, name))
    step = 0.02 * value
    ends = [replace(scene, **{name: value + s * step}) for s in (1.0, -1.0)]
    return (clean_grey(ends[0]) - clean_grey(ends[1])) / (2 * step)


def crossing_jacobian(scene: SyntheticScene, ground: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2 6"]:
    """Derivative of the crossings' pixels by the pose."""
    columns: list[np.ndarray] = []
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        ends = [
            project_ground(scene.camera, moved(scene.cam_from_ground, s * step), ground) for s in (1.0, -1.0)
        ]
        columns.append((ends[0] - ends[1]) / 2e-6)
    return np.stack(columns, -1)
