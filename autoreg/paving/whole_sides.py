"""Whether joints are there along whole sides of the slabs, or along the same part of every side.

Two of the three directions in which edges of hexagons run look square to each other by some camera. Every
line that such edges lie on is one for a third of its length, and so are the sides of a lattice of such lines;
chance, worn joints, and what lies on them leave out any part.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from autoreg.fitting.fit import Fit
from autoreg.ground.sides import ALONG_X, ALONG_Y, Sides, visible_sides
from autoreg.paving.patterns import BROKEN_P, PRESENT_P, SURELY_SIGMAS, sigma_apart
from autoreg.paving.side_support import presence_of_these

# Into so many parts sides are divided that are so long in the picture, and at most so many of them.
PARTS, LEAST_SIDE_PX, MOST_SIDES = 3, 15.0, 400
# Fewer parts of one kind tell nothing.
FEWEST = 8


def part_that_is_there(
    picture: Float[np.ndarray, "h w"], fit: Fit, field: Float[np.ndarray, "k 2"]
) -> tuple[float, float] | None:
    """Mean p-values of the part of all sides that is there, and of one that is not, of the clearer family.

    None where the parts are there alike, as far as they tell. The `field` is a convex counter-clockwise
    polygon of the ground.
    """
    sides = visible_sides(
        fit.camera, fit.cam_from_ground, fit.grid, min_px=LEAST_SIDE_PX, limit=MOST_SIDES, field=field
    )
    parts = in_parts(sides)
    p = presence_of_these(picture, fit, parts).p
    # The cross joints of both courses cut the unbroken joints of a running bond into two kinds of pieces.
    kinds = {ALONG_X: 2 * PARTS if fit.grid.shift else PARTS, ALONG_Y: PARTS}
    families = ((np.flatnonzero(parts.family == family), count) for family, count in kinds.items())
    found = [apart(p[rows], parts.cell[rows] % count) for rows, count in families]
    return max((pair for pair in found if pair), key=lambda pair: pair[1] - pair[0], default=None)


def in_parts(sides: Sides) -> Sides:
    """The sides, each divided into its parts, one behind the other; `cell` counts the parts along a line."""
    start, along = sides.ends[:, None, 0], sides.ends[:, None, 1] - sides.ends[:, None, 0]
    share = np.arange(PARTS + 1)[:, None] / PARTS
    points = start + share * along
    ends = np.stack([points[:, :-1], points[:, 1:]], 2).reshape(-1, 2, 2)
    cell = (PARTS * sides.cell[:, None] + np.arange(PARTS)).ravel()
    return Sides(ends, np.repeat(sides.family, PARTS), np.repeat(sides.line, PARTS), cell)


def apart(p: Float[np.ndarray, " n"], kind: np.ndarray) -> tuple[float, float] | None:
    """Mean p-values of the kinds that are there most and least, if one surely is and the other is not."""
    own = [p[kind == k] for k in np.unique(kind)]
    own = sorted((values for values in own if len(values) >= FEWEST), key=lambda values: float(values.mean()))
    if len(own) < 2:
        return None
    there, gone = own[0], own[-1]
    least, most = float(there.mean()), float(gone.mean())
    clear = least < PRESENT_P < BROKEN_P < most and most - least > SURELY_SIGMAS * sigma_apart(there, gone)
    return (least, most) if clear else None
