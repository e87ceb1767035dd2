"""How far paving goes on: the photo's own resolution shows slabs that a smaller picture of it does not."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull

from autoreg.ground.sides import visible_sides
from autoreg.paving.side_support import LEAST_SIDE_PX, Effort, LatticeSeen, presence_of_these

# All sides are looked at, few times each: there are many, and a field is told by many of them.
ALL = Effort(sides=20_000, along=6)
# It is worth it where so many times as many sides are seen as were, and for a field so many times as large.
MORE_SIDES, LARGER = 1.3, 1.3


def farther_field(
    picture: Float[np.ndarray, "h w"],
    lattice: LatticeSeen,
    known: Float[np.ndarray, "k 2"],
    looked_at: int,
) -> Float[np.ndarray, "m 2"] | None:
    """The field of a lattice as far as a picture shows it; None where that is hardly farther than is known.

    A convex counter-clockwise polygon around the `known` one, for which so many sides were `looked_at`.
    """
    sides = visible_sides(
        lattice.camera, lattice.cam_from_ground, lattice.grid, min_px=LEAST_SIDE_PX, limit=ALL.sides
    )
    if len(sides) < MORE_SIDES * looked_at:
        return None
    # Joints that are wide here may be seen less well than where the picture is smaller.
    points = np.concatenate([known, presence_of_these(picture, lattice, sides, ALL).field])
    hull, before = ConvexHull(points), ConvexHull(known)
    # The volume of what is flat is its area.
    return points[hull.vertices] if hull.volume > LARGER * before.volume else None
