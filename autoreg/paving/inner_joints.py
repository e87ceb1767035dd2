"""Joints inside the slabs of a lattice: those of a pattern that repeats as the lattice does, but is none.

The bricks of herringbone come back after some widths either way, and a lattice of such cells, each of many
bricks, has all of its sides. But as many edges that run along the joints lie inside of its cells.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from autoreg.fitting.fit import Fit
from autoreg.ground.points import inside_convex, on_ground
from autoreg.segments import Segments

# Edges along the joints are those that lean by no more; inside a slab they are this share of its side or
# more away from the joints.
ALONG_RAD, INSIDE = np.radians(4.0), 0.2
# Fewer edges than this tell nothing.
FEWEST = 20
# Slabs that are so many times as long as wide look like boards, along which wood has its grain.
BOARD = 3.0


def inner_share(segments: Segments, fit: Fit, field: Float[np.ndarray, "k 2"]) -> float:
    """How much of what runs along a lattice's joints lies inside its slabs, of the family with more of it.

    By length in the picture, over the share that places anywhere would have: 0 where all edges lie on joints,
    1 where they lie anywhere. Of the quarters of the field that with the least counts, since another field
    may reach into its hull. What runs along boards may be their grain, and does not count.

    Args:
        segments: of the whole photo.
        fit: the lattice, at the photo's own resolution.
        field: a convex counter-clockwise polygon of the ground in which it lies.
    """
    grid = fit.grid
    if grid.spacing_x is None:
        return 0.0
    ground = on_ground(segments.ends_px, fit.camera, fit.cam_from_ground)
    middle = ground.mean(1)
    inside = inside_convex(middle, field, 0.0)
    ground, middle, length = ground[inside], middle[inside], segments.length_px[inside]
    x, y = (ground[:, 1] - ground[:, 0]).T
    lean, steep = np.arctan2(y, x), np.sin(ALONG_RAD)
    row = middle[:, 1] / grid.spacing_y
    column = middle[:, 0] / grid.spacing_x - np.floor(row) * grid.shift
    families = (
        (np.abs(np.sin(lean)) < steep, row, grid.spacing_x / grid.spacing_y),
        (np.abs(np.cos(lean)) < steep, column, grid.spacing_y / grid.spacing_x),
    )
    shares = [0.0]
    for along, place, longer in families:
        inner = np.abs(place - np.round(place))[along] > INSIDE
        if inner.sum() >= FEWEST and longer < BOARD:
            beyond = middle[along] > np.median(middle[along], axis=0)
            quarter = beyond @ [1, 2]
            total = np.bincount(quarter, length[along], 4)
            own = np.bincount(quarter, length[along] * inner, 4)
            shares.append(float((own / np.maximum(total, 1e-9)).min()) / (1.0 - 2.0 * INSIDE))
    return max(shares)
