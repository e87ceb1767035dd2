"""What is plain to see on the likeliest ground, and what that tells of a camera, or of which way is up."""

from __future__ import annotations

import numpy as np

from autoreg.answer.camera_refusals import camera_contradicted
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.ground.sight import Looks, Sight, see
from autoreg.ground.upright import roll_deg
from autoreg.paving.lattice_evidence import PLAIN_NATS, Paving, has_ratio
from autoreg.paving.lay import lay_combs
from autoreg.paving.plane_combs import Hypothesis, promising_plane
from autoreg.search.hypotheses import hypothesised
from autoreg.segments import Segments
from autoreg.solve.freedom import Free

# Logarithm by which the joints' own focal length differs from a given one, at least, that is to blame.
SAME_FOCAL = 0.03
# Beyond this another quarter turn makes a photo stand upright.
MOST_ROLL_DEG = 45.0


def at_a_glance(looks: Looks, segments: Segments, hypotheses: list[Hypothesis], free: Free) -> Paving | None:
    """The lattice on the likeliest ground, where it is plain to see."""
    plane = promising_plane(looks, segments, hypotheses)
    return None if plane is None else lay_combs(looks, plane, free)


def promises(sight: Sight, camera: Camera | None) -> bool:
    """Whether a photo shows enough of two families of joints, at the first glance, to look for a lattice."""
    _, hypotheses = hypothesised(sight.segments, sight.size, camera)
    return promising_plane(sight.looks, sight.segments, hypotheses) is not None


def other_camera(
    sight: Sight, camera: Camera, found: Paving | None = None, slab: tuple[float, float] | None = None
) -> Refusal | None:
    """Why a camera is to blame for showing no lattice, or only the one found: the joints clearly fit another.

    A small field that is seen by the right camera, the joints' own camera explains hardly better; one that is
    left of a large field by a wrong camera, it explains far better. Sides of a `slab`, where they are given,
    must be in the ratio that the joints have by their own camera.
    """
    free, hypotheses = hypothesised(sight.segments, sight.size, None)
    other = at_a_glance(sight.looks, sight.segments, hypotheses, free)
    explained = 0.0 if found is None else found.margin_nats
    if other is None or other.margin_nats < explained + PLAIN_NATS:
        return None
    focal = other.fit.camera.scaled(camera.width, camera.height).fx
    alike = abs(np.log(focal / camera.fx)) < SAME_FOCAL
    blamed = not alike if slab is None else has_ratio(other.grid, slab)
    return camera_contradicted(camera, focal) if blamed else None


def upright_by(sight: Sight, camera: Camera | None) -> int | None:
    """By how many quarter turns clockwise a photo shows a lattice on the ground that is plain to see, if so.

    For a photo that shows none as it is: it may stand on its side, or be of a wall. Ground whose upward side
    is not that of the turned photo would be as good, or as bad, without the turn.
    """
    small = sight.looks.picture
    height, width = small.shape
    for quarters in (1, 2, 3):
        turned = see(np.ascontiguousarray(np.rot90(small.astype(np.uint8), -quarters)))
        own = None if camera is None else camera.scaled(width, height).turned(quarters)
        # What is plain to see by a known camera, the coarser segments tell.
        segments = turned.segments if own is None else turned.detection.coarse
        free, hypotheses = hypothesised(segments, turned.size, own)
        found = at_a_glance(turned.looks, segments, hypotheses, free)
        if found is not None and found.plain and roll_deg(found.fit.cam_from_ground.R) < MOST_ROLL_DEG:
            return quarters
    return None
