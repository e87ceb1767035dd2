"""Whether joints were met at one of their edges only.

A narrow strip laid along one edge of a wide joint fits it as well as can be, and lies half a joint off. But
then the ground beside it is slab on one side and joint on the other, the same way round at every joint, where
the tones of slabs differ either way.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from autoreg.fitting.fit import Fit
from autoreg.fitting.refine import WIDE_SEARCH, refine_until_still
from autoreg.ground.sides import ALONG_X, ALONG_Y

# Fewer stations than this do not tell it.
FEWEST = 30
# Sides of joints that differ by more, as a share of their contrast, are those of one edge: by 0.36 at most in
# 140 photos with both edges, by 0.46 to 1 with one.
MOST = 0.4
# Widths that are tried instead, in slab sides, and what is tried of a family that may have been drawn along.
WIDER, DRAWN_ALONG = (0.1, 0.15), 0.25


def one_edge(fit: Fit) -> tuple[float, float]:
    """By how much the two sides of the joints along X, and along Y, differ, as a share of their contrast.

    The less of the mean difference and of what the signs alone leave of it, each between 0 and 1: zero where
    differences go either way, one where every joint was met at the same edge.
    """
    return _of_family(fit, ALONG_X), _of_family(fit, ALONG_Y)


def _of_family(fit: Fit, family: int) -> float:
    rows = np.flatnonzero(fit.usable & (fit.stations.family == family))
    if len(rows) < FEWEST:
        return 0.0
    step, depth = fit.offsets.step[rows], fit.offsets.depth[rows]
    contrast = float(np.mean(np.abs(depth) + 0.5 * np.abs(step)))
    return min(abs(float(step.mean())) / max(contrast, 1e-9), abs(float(np.sign(step).mean())))


def with_both_edges(
    picture: Float[np.ndarray, "h w"],
    fit: Fit,
    *,
    reach: float,
    field: Float[np.ndarray, "k 2"] | None = None,
) -> Fit:
    """A fit with joints that were met at one edge measured anew as wide ones, if that meets both.

    `reach` and `field` are as for `refine`.
    """
    for share in WIDER:
        met = one_edge(fit)
        if max(met) <= MOST:
            break
        sides = (fit.grid.spacing_y, fit.grid.spacing_x or fit.grid.spacing_y)
        x, y = (
            share * side if edge > DRAWN_ALONG else width
            for edge, side, width in zip(met, sides, fit.strip.width, strict=True)
        )
        again = refine_until_still(
            picture, fit.camera, fit.cam_from_ground, fit.grid,
            free=fit.free, search=WIDE_SEARCH, reach=reach, field=field,
            strip=replace(fit.strip, width=(x, y), polarity=(0, 0), polarity_known=False),
        )  # fmt: skip
        if again is not None and max(one_edge(again)) < max(met):
            fit = again
    return fit
