"""Whether a lattice is a multiple of the slabs: joints that repeat between those that it predicts.

Every fifth or seventh joint of small slabs is as real as all of them, and the places between, which others
are held against, hit the rest only now and then. Folded over all cells they show at once: at k / n of the
spacing there is as much support as at the joints themselves.
"""

from __future__ import annotations

from dataclasses import replace
from math import gcd

import numpy as np
from jaxtyping import Float

from autoreg.fitting.fit import Fit
from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid
from autoreg.paving.presence import Presence
from autoreg.paving.side_support import support_beside

# The most slabs that may have been taken for one.
MOST = 12
# Cells less long than this, in their other side, are no such multiples: what is left would be planks.
LONG = 1.6
# Sides that are looked at, the largest in the picture.
LOOKED_AT = 100
# How sure it must be that there are joints between, in standard deviations of chance, and how near to the
# joints' own support theirs must come, from that of any place. By a wrong perspective some are missed.
SURE_SIGMAS, AS_CLEAR = 6.0, 0.33


def divided(fit: Fit, family: int, count: int) -> Fit | None:
    """The fit with so many times as many joints of a family; None where their shift is not known."""
    grid = fit.grid
    if family == ALONG_Y:
        width = None if grid.spacing_x is None else grid.spacing_x / count
        return replace(fit, grid=Grid(width, grid.spacing_y, (grid.shift * count) % 1.0))
    if grid.shift:
        return None
    return replace(fit, grid=Grid(grid.spacing_x, grid.spacing_y / count))


def too_long(grid: Grid) -> bool:
    """Whether the cells of a lattice are longer than any number of slabs that is looked for in them."""
    a, b = grid.spacing_x, grid.spacing_y
    return a is not None and max(a, b) > MOST * min(a, b)


def slabs_in_one(picture: Float[np.ndarray, "h w"], fit: Fit, presence: Presence) -> tuple[int, int]:
    """The family whose joints are too far apart, and how many slabs lie between two of them: 1 if not so.

    Asked of the longer side of the lattice's cells.
    """
    a, b = fit.grid.spacing_x, fit.grid.spacing_y
    if a is None or max(a, b) < LONG * min(a, b):
        return ALONG_Y, 1
    family = ALONG_Y if a > b else ALONG_X
    mine = presence.take(np.flatnonzero((presence.sides.family == family) & presence.there))
    if len(mine.p) == 0:
        return family, 1
    sides = mine.nearest(min(1.0, LOOKED_AT / len(mine.p))).sides
    parts = [(k, n) for n in range(2, MOST + 1) for k in range(1, n) if gcd(k, n) == 1]
    shares = np.array([0.0, *(k / n for k, n in parts)])
    support, _, _ = support_beside(picture, fit, sides, shares)
    # Ranks among the places of one cell know nothing of its contrast: uniform, if no place differs.
    # Those alike, as many without any support are, share their ranks.
    less, alike = support[:, None] > support, support[:, None] == support
    rank = (less + 0.5 * alike).mean(1)
    own, *others = rank.mean(1)
    mean = dict(zip(parts, others, strict=True))
    best, found = SURE_SIGMAS, 1
    for n in range(2, MOST + 1):
        there = np.array([mean[k // gcd(k, n), n // gcd(k, n)] for k in range(1, n)])
        sigmas = (there.mean() - 0.5) * np.sqrt(12.0 * len(sides) * len(there))
        if sigmas > best and there.mean() - 0.5 > AS_CLEAR * (own - 0.5):
            best, found = sigmas, n
    return family, found
