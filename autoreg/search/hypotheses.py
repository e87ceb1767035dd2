"""The grounds that a photo's segments suggest."""

from __future__ import annotations

from autoreg.camera import Camera
from autoreg.ground.ground_planes import ground_planes, ground_planes_unknown_focal, like_wall
from autoreg.paving.plane_combs import Hypothesis
from autoreg.segments import Segments
from autoreg.solve.freedom import Free

# Hypotheses that are taken from the segments, with a camera and without.
HYPOTHESES, HYPOTHESES_NO_FOCAL = 8, 12
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
