"""The three directions at right angles of a built scene, seen by a calibrated camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from autoreg.blas_threads import one_blas_thread
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.ground.directions import SegmentRays, camera_rays, single_directions
from autoreg.ground.frames import FrameFit, fit_step, frames_through, image_dirs, memberships
from autoreg.segments import Segments

# The longest so many segments vote, and each two of the longest so many name a direction.
VOTERS, SEEDS = 250, 40
# Directions that frames are begun with, frames that are fitted by the voters, steps of their fits, and steps
# that the best then takes by all segments.
FIRST, FITTED, STEPS, LAST_STEPS = 8, 4, 3, 2


@dataclass(frozen=True)
class ManhattanFrame:
    """Three directions at right angles in camera axes.

    The columns of `dirs_cam` are a right-handed frame: two horizontal directions and the vertical, which
    points up in the picture. `support_px` is the length of the segments that agree with each,
    `sigma_rad` the standard deviation of the rotation about the camera's x, y and z axes that the segments'
    own noise explains.
    """

    dirs_cam: Float[np.ndarray, "3 3"]
    support_px: Float[np.ndarray, "3"]
    sigma_rad: Float[np.ndarray, "3"]


@one_blas_thread()
def manhattan_frame(segments: Segments, camera: Camera) -> ManhattanFrame:
    """The frame that the greatest length of segments agrees with.

    Raises:
        Refusal: `one_direction` where no two directions at right angles find support.
    """
    rays = camera_rays(segments, camera)
    voters = rays.take(np.arange(min(len(rays), VOTERS)))
    seeds = np.arange(min(len(rays), SEEDS))
    first = single_directions(voters, seeds, count=FIRST, apart_rad=np.radians(2.0), steps=1)
    fit = frames_through(voters, first, np.zeros(1), peaks=3)
    fit = fit.take(np.argsort(-_score(voters, fit)[1], kind="stable")[:FITTED])
    for _ in range(STEPS):
        fit = fit_step(voters, fit, 3, None, log_focal_prior=None)
    support, score = _score(rays, fit)
    if not len(fit) or np.count_nonzero(support[np.argmax(score)]) < 2:
        raise Refusal(
            "one_direction", "no two directions at right angles: the picture shows too few straight edges"
        )
    best = int(np.argmax(score))
    fit = fit.take(np.array([best]))
    for _ in range(LAST_STEPS):
        fit = fit_step(rays, fit, 3, None, log_focal_prior=None)
    support, _ = _score(rays, fit)
    order, sign = _upright(fit.R[0])
    sigma = np.sqrt(np.diag(np.linalg.pinv(fit.information[0]))[:3])
    return ManhattanFrame(fit.R[0][:, order] * sign, support[0, order], sigma)


def _score(rays: SegmentRays, fit: FrameFit) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, " k"]]:
    """Supporting length of each direction, and their sum."""
    support = memberships(rays, image_dirs(fit.R, fit.log_focal, 3), None) @ rays.weight
    return support, support.sum(1)


def _upright(R: Float[np.ndarray, "3 3"]) -> tuple[list[int], Float[np.ndarray, "3"]]:
    """Order and signs of the columns that put the vertical last, upwards, and the frame right-handed."""
    vertical = int(np.argmax(np.abs(R[1])))
    order = [(vertical + 1) % 3, (vertical + 2) % 3, vertical]
    sign = np.array([1.0, 1.0, 1.0 if R[1, vertical] < 0 else -1.0])
    sign[0] = np.linalg.det(R) * sign[2]
    return order, np.sign(sign)
