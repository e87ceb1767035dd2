"""A lattice with what speaks for it: the evidence of its sides against chance, and what it is alike.

The presence of every single slab side tells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from autoreg.fitting.fit import Fit
from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid
from autoreg.paving.bond import FALSE_ALARM_NATS
from autoreg.paving.patterns import broken, half_there
from autoreg.paving.presence import GROUND_COST, Presence
from autoreg.paving.side_support import CLOSE, USUAL, looked_at_closer, presence_of
from autoreg.solve.freedom import log_stretch

# What a hypothesis must beat: spacings x phases of either family, times orientations of the ground.
TESTED_NATS = 2 * float(np.log(7000)) + float(np.log(24))
# Sides of one unbroken line stand and fall together: a line counts as at most this many independent ones.
INDEPENDENT_SIDES = 3.0
# Logarithm by which the sides' ratio in the photo may differ from the given one: coarse fits, uneven slabs
# and nominal sizes without the joint stay below it.
RATIO_TOLERANCE = 0.08
# A lattice this close to the best one is as good an answer, and another one if its spacings or its shift
# differ by more than these.
RIVAL_NATS, SAME_SPACING, SAME_SHIFT = 3.0, 0.05, 0.05
# Beyond this margin a lattice is plain to see. Where it is less, a small field is looked at by itself, unless
# it is so little that nothing comes of it.
PLAIN_NATS, NOTHING_NATS = 40.0, -25.0
# Crossings of two lattices that are nearer to each other than this, in slabs, are the same.
SAME_PLACE = 1e-3


@dataclass(frozen=True)
class Paving:
    """A lattice on the ground with the pose that sees it.

    `evidence_nats` is the logarithm of the likelihood ratio of this lattice to chance, for the sides along X
    and along Y, unpenalised. `closer` are the sides of a small field, where it was looked at by itself.
    `within` is the convex part of the ground, in the fit's frame, whose sides alone count; None for all.
    """

    fit: Fit
    presence: Presence
    evidence_nats: tuple[float, float]
    closer: Presence | None = None
    within: Float[np.ndarray, "k 2"] | None = None

    @property
    def grid(self) -> Grid:
        """The lattice."""
        return self.fit.grid

    @property
    def clearest(self) -> Presence:
        """The sides that tell most of the bond."""
        return self.closer or self.presence

    @property
    def margin_nats(self) -> float:
        """Evidence beyond what the number of tested hypotheses demands, of the weaker family in any case."""
        return min(
            sum(self.evidence_nats) - TESTED_NATS - FALSE_ALARM_NATS,
            2.0 * (min(self.evidence_nats) - 0.5 * TESTED_NATS),
        )

    @property
    def plain(self) -> bool:
        """Whether it is plain to see over the picture, so that no other lattice need be looked for.

        A small field may be all that a bad fit has met of a large one.
        """
        return self.closer is None and self.margin_nats > PLAIN_NATS


def presented(
    picture: Float[np.ndarray, "h w"],
    fit: Fit,
    presence: Presence | None = None,
    *,
    within: Float[np.ndarray, "k 2"] | None = None,
) -> Paving | None:
    """A fit with the presence of its sides; None if they are too few, or break off as those of no bond do.

    Where a convex part of the ground is given, in the fit's frame, the sides `within` it alone. Joints that
    are neither dark nor light are steps of tone; where these do no better than chance beside a clear family,
    they may be lines of two tones.
    """
    paving = _presented(picture, fit, presence or presence_of(picture, fit, field=within), within)
    if paving is None or paving.margin_nats > 0 or all(fit.strip.polarity):
        return paving
    if max(paving.evidence_nats) < 0.5 * TESTED_NATS:
        return paving
    pairs = presence_of(picture, fit, field=within, paired=True)
    other = _presented(picture, fit, pairs, within, paired=True) if pairs.looks_nats else None
    return paving if other is None else max(paving, other, key=lambda p: p.margin_nats)


def _presented(
    picture: Float[np.ndarray, "h w"],
    fit: Fit,
    presence: Presence,
    within: Float[np.ndarray, "k 2"] | None,
    *,
    paired: bool = False,
) -> Paving | None:
    """A fit with the presence of its sides, looked at more closely where it is neither plain nor nothing."""
    if len(presence.p) < 6 or (fit.grid.shift and half_there(presence)) or _breaks_off(presence.nearest(0.5)):
        return None
    paving = Paving(fit, presence, line_evidence(presence, fit.grid), within=within)
    if not NOTHING_NATS < paving.margin_nats < PLAIN_NATS:
        return paving
    # Noise hides joints that more samples show; where slabs are uneven, these show no more.
    presence = presence_of(picture, fit, CLOSE, field=within, paired=paired)
    thorough = replace(paving, presence=presence, evidence_nats=line_evidence(presence, fit.grid))
    better = max(paving, thorough, key=lambda p: p.margin_nats)
    effort = CLOSE if better is thorough else USUAL
    closer = looked_at_closer(picture, fit, better.presence, effort, paired=paired)
    if (fit.grid.shift and half_there(closer, few=True)) or _breaks_off(closer, few=True):
        return None
    x, y = _evidence_of(closer, fit.grid)
    price = 0.5 * (GROUND_COST + closer.looks_nats)
    alone = replace(better, evidence_nats=(x - price, y - price), closer=closer)
    return max(better, alone, key=lambda p: p.margin_nats)


def _breaks_off(presence: Presence, *, few: bool = False) -> bool:
    """Whether the joints of either family break off as those of no bond do."""
    return broken(presence, ALONG_X, few=few) or broken(presence, ALONG_Y, few=few)


def line_evidence(presence: Presence, grid: Grid) -> tuple[float, float]:
    """Log likelihood ratio of the lattice, per family, over the part of the picture that suits best.

    Either family pays half the price of the choice; the joints of rows, which are of one, pay the whole.
    """
    options = [
        (*_evidence_of(presence.take(np.flatnonzero(field)), grid), price)
        for field, price in presence.possible_fields
    ]
    if grid.spacing_x is None:
        return max(x - price for x, _, price in options), 0.0
    pairs = [(x - 0.5 * price, y - 0.5 * price) for x, y, price in options]
    return max(pairs, key=lambda pair: min(sum(pair), 2 * min(pair) + 20.0))


def _evidence_of(presence: Presence, grid: Grid) -> tuple[float, float]:
    """Log likelihood ratio of the lattice, per family, with the sides of a line taken together."""
    total: list[float] = []
    for family in (ALONG_X, ALONG_Y):
        rows = np.flatnonzero(presence.sides.family == family)
        line = presence.sides.line[rows]
        if family == ALONG_Y and grid.shift:
            line = line * 10_000 + presence.sides.cell[rows]
        _, inverse = np.unique(line, return_inverse=True)
        count = np.bincount(inverse)
        mean = np.bincount(inverse, weights=presence.llr(rows)) / np.maximum(count, 1)
        total.append(float((mean * np.minimum(count, INDEPENDENT_SIDES)).sum()))
    return total[0], total[1]


def rival(pavings: tuple[Paving, ...]) -> Paving | None:
    """The first of the pavings whose lattice differs from the best one's and explains the picture as well."""
    best = pavings[0]
    for other in pavings[1:]:
        if other.margin_nats < max(0.0, best.margin_nats - RIVAL_NATS):
            break
        if not alike(best, other, SAME_SPACING):
            return other
    return None


def told_twice(pavings: Sequence[Paving]) -> bool:
    """Whether the clearest of some lattices is clear enough to be plain, and another start led to it as well.

    What a bad fit meets of a large field, another start does not meet again.
    """
    clear = sorted((p for p in pavings if p.margin_nats > PLAIN_NATS), key=lambda p: -p.margin_nats)
    return any(alike(clear[0], other, SAME_SPACING) for other in clear[1:])


def alike(one: Paving, other: Paving, spacing: float) -> bool:
    """Whether two lattices have about the same shift, and the same spacings to so large a share of them."""
    apart = abs(other.grid.shift - one.grid.shift)
    if SAME_SHIFT < apart < 1.0 - SAME_SHIFT:
        return False
    return np.allclose(_sides_in_heights(one), _sides_in_heights(other), rtol=spacing)


def _sides_in_heights(paving: Paving) -> list[float]:
    """The slab's sides in camera heights, the shorter one first: fits differ in their units."""
    height = float(paving.fit.cam_from_ground.origin_in_a[2])
    return sorted(side / height for side in (paving.grid.spacing_x or 0.0, paving.grid.spacing_y))


def has_ratio(grid: Grid, slab: tuple[float, float]) -> bool:
    """Whether a lattice's sides may be in the ratio of a slab's, in either order."""
    if grid.spacing_x is None:
        return True
    return abs(log_stretch(grid.spacing_x, grid.spacing_y, slab)) < RATIO_TOLERANCE


def same_lattice(one: Fit, other: Fit) -> bool:
    """Whether two fits have the same joints, up to rounding; their origins may be different crossings."""
    grids = [(fit.grid.spacing_x or 0.0, fit.grid.spacing_y, fit.grid.shift) for fit in (one, other)]
    R = one.cam_from_ground.R
    if not (np.allclose(grids[0], grids[1]) and np.allclose(R, other.cam_from_ground.R)):
        return False
    x, y, _ = R.T @ (other.cam_from_ground.t - one.cam_from_ground.t)
    row = y / one.grid.spacing_y
    places = np.array([row, x / (one.grid.spacing_x or np.inf) - row * one.grid.shift])
    return bool(np.abs(places - np.round(places)).max() < SAME_PLACE)
