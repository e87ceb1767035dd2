"""Paving whose slabs are too small to be seen where a photo is made smaller: found by a part of it.

A photo is looked into at detection scale, where a large one leaves little of small slabs that are seen from a
window, say. A part of it need not be made as small. What is plain to see in one is looked for in the whole
photo at the part's scale.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from autoreg.camera import Camera
from autoreg.fields import in_whole, seen_again
from autoreg.ground.sight import DETECTION_PIXELS, Box, Sight, see
from autoreg.image import pyramid
from autoreg.paving.lattice_evidence import PLAIN_NATS, Paving
from autoreg.paving.plane_combs import PROMISING_NATS, PlaneCombs, planes_as_they_came
from autoreg.rows.rows import Rows
from autoreg.search.find import find_promising, plain_on
from autoreg.search.hypotheses import hypothesised

# A part is half as wide and as high as what it is a part of, for which that must have been made smaller by
# so much at least.
HALF, SMALLER = 0.5, 1.5
# Where parts lie along the photo's lower edge, as shares of the room that they leave: what is nearest to the
# camera is below, and roofs, whose tiles look as paving does from above, are not.
PLACES = (0.5, 0.0, 1.0)


@dataclass(frozen=True)
class SeenCloser:
    """The paving of a photo, and the photo as it is seen at a scale that shows it."""

    sight: Sight
    found: Paving | Rows


def paving_by_part(sight: Sight, camera: Camera) -> SeenCloser | None:
    """The paving that is plain to see in a part of a large photo, as the whole shows it at the part's scale.

    A lattice, or else the plainest rows: these tell the tilt by how they narrow, which a quarter of the photo
    shows too little of. None where no part shows any, or the whole does not show it on the same ground.

    Args:
        sight: what is seen of the photo.
        camera: its camera. By another one a lattice would suit the part, and not go on beyond it.
    """
    rows: list[Rows] = []
    for share in _shares(*sight.size):
        for part in _promising(sight, camera, share):
            found = find_promising(part.sight, part.planes)
            if found is None or found.margin_nats < PLAIN_NATS:
                continue
            if isinstance(found, Paving):
                lattice = _in_whole(sight, camera, found, share)
                if lattice is not None:
                    return lattice
            elif share == HALF:
                rows.append(found)
    return _plainest(rows, sight, camera) if rows else None


def lattice_by_part(sight: Sight, camera: Camera, R: Float[np.ndarray, "3 3"]) -> SeenCloser | None:
    """The lattice on a known ground, as for `find_on`, that a part of a large photo shows at first sight.

    Of bricks whose cross joints are too short for the whole, rows are all that it shows.
    """
    for share in _shares(*sight.size):
        for box in _boxes(*sight.size, share):
            found = plain_on(see(box.of(sight.gray), toned=sight.toned), camera.cropped(*box), R)
            lattice = None if found is None else _in_whole(sight, camera, found, share)
            if lattice is not None:
                return lattice
    return None


def _in_whole(sight: Sight, camera: Camera, found: Paving, share: float) -> SeenCloser | None:
    """A lattice that a part of such a size shows, as the whole does at its scale."""
    closer = _closer(sight, share)
    lattice = in_whole(closer, camera, found)
    return None if lattice is None else SeenCloser(closer, lattice)


def _plainest(rows: list[Rows], sight: Sight, camera: Camera) -> SeenCloser | None:
    """The plainest of some rows that halves of a photo show, as the whole shows them."""
    closer, plainest = _closer(sight, HALF), max(rows, key=lambda each: each.margin_nats)
    fit, presence = seen_again(closer, camera, plainest.paving)
    if len(presence.p) == 0:
        return None
    return SeenCloser(closer, replace(plainest, paving=replace(plainest.paving, fit=fit, presence=presence)))


@dataclass(frozen=True)
class _Part:
    """What is seen of a part of a photo, and the grounds that its segments suggest, the clearest first."""

    sight: Sight
    planes: list[PlaneCombs]


def _promising(sight: Sight, camera: Camera, share: float) -> list[_Part]:
    """The parts of such a size whose joints are clear at first sight, the clearest first."""
    parts = [_part_of(sight, box, camera) for box in _boxes(*sight.size, share)]
    clear = [part for part in parts if part.planes and part.planes[0].score > PROMISING_NATS]
    return sorted(clear, key=lambda part: -part.planes[0].score)


def _part_of(sight: Sight, box: Box, camera: Camera) -> _Part:
    seen = see(box.of(sight.gray), toned=sight.toned)
    _, grounds = hypothesised(seen.segments, seen.size, camera.cropped(*box))
    return _Part(seen, planes_as_they_came(seen.looks, grounds))


def _shares(width: int, height: int) -> Iterator[float]:
    """The parts' sizes as shares of the photo's, the largest first."""
    share = 1.0
    while width * height * share**2 >= DETECTION_PIXELS * SMALLER**2:
        share *= HALF
        yield share


def _boxes(width: int, height: int, share: float) -> Iterator[Box]:
    """The parts of such a size."""
    size = np.array([width, height])
    part = np.floor(share * size).astype(int)
    for place in PLACES:
        left, top = np.floor((size - part) * [place, 1.0]).astype(int).tolist()
        yield Box(left, top, *part.tolist())


def _closer(sight: Sight, share: float) -> Sight:
    """A photo whose presence of sides is told at the scale of such a part of it."""
    picture = pyramid(sight.gray, round(DETECTION_PIXELS / share**2))[0].astype(np.float32)
    return replace(sight, looks=replace(sight.looks, picture=picture))
