"""Sunk joints seen aslant, with the far slab's wall in the light beside what is left of their beds.

Such a joint has three parts in the picture: from the near slab's rim on its bed, and what of the wall is in
shadow; then the wall in the light, as light as the slabs or lighter; then the far slab. A strip of one tone
takes the dark part for the whole joint, and lies nearer by as much as the wall takes up; by more than half a
joint where the wall is the lighter one. A wall in the shade that is lighter than the bed does less of the
same. The near rim is seen in any case, and the joint's middle lies half a width beyond it. How high the light
reaches and how light the wall is all joints tell that are seen from one side. The width they cannot tell: it
is that of the joints which show more of themselves.
"""

from __future__ import annotations

import numpy as np

from autoreg.fitting.joint_parts import FEWEST, Parts, Side, climbed, likelihood_of
from autoreg.joints.joint_looks import Strip

# Joints say little where half are seen below this slope; those in fewer blurs show no parts.
LEAST_MEDIAN_SLOPE, LEAST_BLURS = 0.3, 2.0
# How high the light reaches, in widths, and the wall's tones against the slabs' that are tried; at first
# these pairs of them.
HEIGHTS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.4)
WALLS = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0, 1.03, 1.06, 1.12, 1.18, 1.25, 1.4)
AT_FIRST = ((0.5, 0.6), (0.5, 0.95), (0.5, 1.12), (0.7, 1.0), (1.0, 0.95))
ONE_AT_A_TIME = ((-1, 0), (1, 0), (0, -1), (0, 1))
# Three parts must be so much likelier than one; where they are so much less likely at first, no others are
# tried.
LEAST_NATS, HOPELESS_NATS = 20.0, -40.0
# Joints that look narrower than this share of those across them, or light where those are dark, may well hide
# a part: so much likelier is enough for them.
NARROWER, LEAST_NATS_HIDING = 0.9, 5.0
# Other joints' widths tell that these hide a part; without that they may be as narrow as they look, by these
# shares of the width that a strip fits to all of them, blurred far ones among them.
AS_NARROW = (1.0, 0.9, 0.8, 0.7, 0.6)


def walled(side: Side, strip: Strip, family: int, width: float) -> Parts | None:
    """How high the light reaches and how light the wall is; None if that does not show."""
    wide = np.flatnonzero(width * side.px_per_unit > LEAST_BLURS * side.blur_px)
    if len(wide) < FEWEST or np.median(side.slope[wide]) < LEAST_MEDIAN_SLOPE:
        return None
    own = strip.width[family]
    narrower = own < NARROWER * width
    least_nats = LEAST_NATS_HIDING if narrower or lighter(strip, family) else LEAST_NATS
    plain = (own, width) if narrower else tuple(share * own for share in AS_NARROW)
    return _likeliest_looks(side.take(wide), plain, width, least_nats)


def lighter(strip: Strip, family: int) -> bool:
    """Whether the joints of a family are light where those across them are dark."""
    return strip.polarity[family] > 0 > strip.polarity[1 - family]


def _likeliest_looks(
    side: Side, plain_widths: tuple[float, ...], width: float, least_nats: float
) -> Parts | None:
    """How high the light reaches and how light the wall is; None if strips of one tone fit as well.

    These may have any of the `plain_widths`, the likeliest of which comes first. Climbs from the best of a
    few guesses over the values that are tried.
    """
    nats = likelihood_of(side.widest())

    def wall(height: float, tone: float) -> Parts:
        return Parts(width, 0.0, height, tone)

    first = max(nats(wall(*looks)) for looks in AT_FIRST)
    likeliest, *others = (Parts(each) for each in dict.fromkeys(plain_widths))
    plain = nats(likeliest)
    # Other widths could only make one tone likelier.
    if first - plain < HOPELESS_NATS:
        return None
    plain = max((plain, *map(nats, others)))
    if first - plain < HOPELESS_NATS:
        return None
    best = climbed(nats, wall, (HEIGHTS, WALLS), AT_FIRST, ONE_AT_A_TIME)
    return best if nats(best) - plain > least_nats else None
