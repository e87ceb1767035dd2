"""The solver's data: measured joints, the pose around which it moves them, and what its parameters are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# Parameters: rotation vector (rad) and translation of a small motion on the camera's side, logarithm of the
# spacing ratio, logarithm of the focal length, principal point (px), first radial distortion coefficient,
# logarithm of what fy is longer than fx by, second radial coefficient, and the two tangential ones.
PARAMETERS = 15
ROTATION, TRANSLATION, RATIO = slice(0, 3), slice(3, 6), 6
FOCAL, CENTRE_X, CENTRE_Y, RADIAL, ASPECT, SECOND_RADIAL, TANGENTIAL_X, TANGENTIAL_Y = range(7, 15)
# A motion has them, and behind them the change of a running bond's shift, which no solve makes.
SHIFT = PARAMETERS
MOTION = PARAMETERS + 1
# What the answer's frame depends on: a small motion of the pose, the sides' ratio, and the shift.
ANSWER = (*range(6), RATIO, SHIFT)
CENTRE, TANGENTIAL = slice(CENTRE_X, CENTRE_Y + 1), slice(TANGENTIAL_X, TANGENTIAL_Y + 1)


class JointData(NamedTuple):
    """Measured joints, the pose around which small motions are taken, and the camera.

    A padded row has zero weight. `intrinsics` are fx fy cx cy and the eight distortion coefficients; `scale`
    is the size of one unit of each parameter. Where a function is traced, jax's
    arrays stand in these places.
    """

    ground: Float[np.ndarray, "n 2"]
    measured_px: Float[np.ndarray, "n 2"]
    normal: Float[np.ndarray, "n 2"]
    weight: Float[np.ndarray, " n"]
    R: Float[np.ndarray, "3 3"]
    t: Float[np.ndarray, "3"]
    intrinsics: Float[np.ndarray, "12"]
    scale: Float[np.ndarray, " p"]


def parameter_scale(height: float, focal_px: float) -> Float[np.ndarray, " p"]:
    """One unit of each parameter, for a camera of such a height over the ground and such a focal length."""
    return np.array([1.0] * 3 + [height] * 3 + [1.0, 1.0, focal_px, focal_px] + [1.0] * 5)
