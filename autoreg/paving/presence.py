"""Which slab sides are really there, as the support of each among places without a joint tells.

The picture is its own control group. On ground without this lattice a side's place and those of its controls
are exchangeable, so the rank of its support among theirs is a p-value that needs no model of the texture.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from autoreg.ground.points import inside_convex
from autoreg.ground.sides import Sides
from autoreg.paving.paved_part import BOXES, CUTS, field_polygon, picture_boxes

# How sharply the p-values of visible sides gather at zero, and shares of true sides that cannot be seen
# (worn, overgrown, far, covered): the share that suits a photo best is taken.
SHARPNESS = 0.2
MISSED = (0.1, 0.25, 0.4, 0.55, 0.7)
# The paved field may end before the picture does: these shares of the sides, the nearest first, are tried,
# the best of the boxes of the picture, and the best box of the ground. The choice has its price: the chances
# are shared between the three kinds.
FIELD_SHARES = (0.12, 0.2, 0.33, 0.5, 0.7, 1.0)
SHARE_COST = float(np.log(len(FIELD_SHARES) / 0.45))
BOX_COST = float(np.log(sum(count * count for _, count in BOXES) / 0.45))
GROUND_COST = float(np.log((CUTS * (CUTS - 1) // 2) ** 2 / 0.1))
# Sides whose p-value is below this are there, if no more of their own controls than the second have as much
# support.
PRESENT, BEATEN = 0.2, 0.12


@dataclass(frozen=True)
class Presence:
    """The `support` of each side, `p`, its p-value among all controls, its length and place in the picture.

    `beaten` is the share of its own controls that have as much support. In clutter beside smooth slabs any
    place has more than most controls, but no more than its own. `looks_nats` is the price of what the sides
    look like, where they were found to look otherwise than most do.
    """

    sides: Sides
    p: Float[np.ndarray, " n"]
    size_px: Float[np.ndarray, " n"]
    support: Float[np.ndarray, " n"]
    beaten: Float[np.ndarray, " n"]
    at_px: Float[np.ndarray, "n 2"]
    looks_nats: float = 0.0

    @property
    def there(self) -> Bool[np.ndarray, " n"]:
        """Sides that are there, as far as one side by itself can tell."""
        return (self.p < PRESENT) & (self.beaten < BEATEN)

    def llr(self, rows: np.ndarray) -> Float[np.ndarray, " k"]:
        """Log likelihood ratios in nats of sides being there, for the share of missed ones that suits."""
        return max(self.llr_by_missed[:, rows], key=lambda llr: float(llr.sum()))

    @cached_property
    def llr_by_missed(self) -> Float[np.ndarray, "missed n"]:
        """Log likelihood ratios in nats of all sides being there, for each share of missed ones."""
        return each_llr(self.p)

    def largest(self, share: float) -> Bool[np.ndarray, " n"]:
        """Which sides are of the given share that is largest in the picture."""
        chosen = np.zeros(len(self.p), dtype=bool)
        count = max(1, round(share * len(self.p)))
        chosen[np.argsort(-self.size_px, kind="stable")[:count]] = True
        return chosen

    def nearest(self, share: float) -> Presence:
        """The given share of the sides, the largest in the picture first."""
        return self.take(np.flatnonzero(self.largest(share)))

    def inside(self, field: Float[np.ndarray, "k 2"]) -> Presence:
        """The sides whose middle lies in a convex counter-clockwise polygon."""
        return self.take(np.flatnonzero(inside_convex(self.sides.middle, field, 0.0)))

    def take(self, rows: np.ndarray) -> Presence:
        """The chosen sides."""
        return Presence(
            self.sides.take(rows),
            self.p[rows],
            self.size_px[rows],
            self.support[rows],
            self.beaten[rows],
            self.at_px[rows],
            self.looks_nats,
        )

    @cached_property
    def field(self) -> Float[np.ndarray, "k 2"]:
        """Convex hull of the largest field of sides that are there, counter-clockwise."""
        return field_polygon(self.sides, self.there)

    @cached_property
    def possible_fields(self) -> tuple[tuple[Bool[np.ndarray, " n"], float], ...]:
        """Sides that may be all there is of the paving, each choice of them with its price in nats."""
        share_cost, box_cost = SHARE_COST + self.looks_nats, BOX_COST + self.looks_nats
        if len(self.p) == 0:
            return ((np.zeros(0, dtype=bool), share_cost),)
        fields = [(self.largest(share), share_cost) for share in FIELD_SHARES]
        boxes = picture_boxes(self.at_px)
        best = int((self.llr_by_missed @ np.array(boxes, float).T).max(0).argmax())
        return (*fields, (boxes[best], box_cost))


def rank_p(support: Float[np.ndarray, " n"], among: Float[np.ndarray, " m"]) -> Float[np.ndarray, " n"]:
    """The p-value of each support by its rank among that of places like it: the share that has as much."""
    ordered = np.sort(among)
    above = len(ordered) - np.searchsorted(ordered, support, side="left")
    return (1 + above) / (1 + len(ordered))


def p_llr(p: Float[np.ndarray, "*n"], missed: float) -> Float[np.ndarray, "*n"]:
    """Log likelihood ratio of a p-value: a Beta density that gathers at zero, or missed, against uniform.

    Its exponential has expectation one under the null, which makes the product over sides an e-value.
    """
    return np.log((1 - missed) * SHARPNESS * p ** (SHARPNESS - 1) + missed)


def each_llr(p: Float[np.ndarray, " n"]) -> Float[np.ndarray, "missed n"]:
    """Log likelihood ratios in nats of sides with such p-values, for each share of missed ones."""
    return np.array([p_llr(p, missed) for missed in MISSED])


def likeliest_llr(p: Float[np.ndarray, " n"]) -> float:
    """The log likelihood ratio of all of them together, for the share of missed ones that suits."""
    return float(each_llr(p).sum(1).max())
