"""The grounds that a photo's segments suggest."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from autoreg.camera import Camera
from autoreg.geometry import angle_between_rotations
from autoreg.ground.ground_planes import THOROUGH, ground_planes, ground_planes_unknown_focal, grounds_along
from autoreg.ground.upright import like_wall
from autoreg.paving.plane_combs import Hypothesis
from autoreg.segments import Segments
from autoreg.solve.freedom import Free

# Hypotheses that are taken from the segments, with a camera and without.
HYPOTHESES, HYPOTHESES_NO_FOCAL = 8, 12
# ... and with a camera, where those show nothing, together with these. Grounds nearer to each other than this
# are one.
THOROUGHLY, ALIKE_RAD = 24, np.radians(1.0)
# Where one direction has so large a share of the edges, as a grain of wood has, grounds are turned about it
# by so much at a time: a degree beside the true one the joints are nearly as clear.
GRAIN_SHARE, TURN_RAD = 0.5, np.radians(2.0)
# What is known of an uncalibrated camera's first radial distortion coefficient, which curved joints tell.
RADIAL_SIGMA = 0.1


def hypothesised(
    segments: Segments, size: tuple[int, int], camera: Camera | None, *, walls: bool = True
) -> tuple[Free, list[Hypothesis]]:
    """Grounds that the segments suggest, and what else is solved for while they are looked into.

    Args:
        segments: of the photo.
        size: the photo's width and height.
        camera: its camera, or None for cameras of several focal lengths.
        walls: whether grounds that look like a wall seen from the front are among them.
    """
    if camera is not None:
        free = Free(ratio=True)
        found = [(camera, h.R) for h in ground_planes(segments, camera, max_hypotheses=HYPOTHESES)]
    else:
        free = Free(ratio=True, focal=True, radial=True, radial_sigma=RADIAL_SIGMA)
        guessed = ground_planes_unknown_focal(segments, *size, max_hypotheses=HYPOTHESES_NO_FOCAL)
        found = [(Camera.from_focal(*size, focal), h.R) for h, focal in guessed]
    return free, [(own, R) for own, R in found if walls or not like_wall(R)]


def hypothesised_thoroughly(
    segments: Segments, camera: Camera, before: list[Hypothesis], *, walls: bool = True
) -> list[Hypothesis]:
    """Further grounds, for photos in which a crowd of other edges hides the joints: shadows of bars, say.

    Args:
        segments: of the photo.
        camera: its camera.
        before: the grounds that have shown nothing.
        walls: whether grounds that look like a wall seen from the front are among them.
    """
    found = ground_planes(segments, camera, max_hypotheses=THOROUGHLY, effort=THOROUGH)
    new = [h.R for h in found if not any(_alike(h.R, R) for _, R in before)]
    return [(camera, R) for R in new if walls or not like_wall(R)][: THOROUGHLY - len(before)]


def hypothesised_along_grain(segments: Segments, camera: Camera, *, walls: bool = True) -> list[Hypothesis]:
    """All grounds along a direction that most edges have, for joints which those of a grain outnumber.

    Args:
        segments: of the photo.
        camera: its camera.
        walls: whether grounds that look like a wall seen from the front are among them.
    """
    found = grounds_along(segments, camera, least_share=GRAIN_SHARE, step_rad=TURN_RAD)
    return [(camera, R) for R in found if walls or not like_wall(R)]


def _alike(one: Float[np.ndarray, "3 3"], other: Float[np.ndarray, "3 3"]) -> bool:
    """Whether two grounds have about the same joints."""
    return bool(angle_between_rotations(one, other) < ALIKE_RAD)
