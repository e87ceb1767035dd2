"""Joints between bevelled or worn rims, of which one is in the light beside the dark part.

A bevel that faces the sun is lighter than the slab; on the other side of the joint the bevel is dark, and
between them the bed is. A strip of one tone takes the dark parts for the whole joint, and lies aside by half
of the bevel in the light. Nothing but that bevel tells: it is what looks lighter than the slabs beside the
dark strip. Or the bed is light, and beside it the bevel, or the bed itself, lies in the shade: dark and light
together look like a step, or the shade like the whole of a joint whose bed is about as light as the slabs.
How wide it is, and how light, tell all joints of a family together that show it on their far side; where it
is on the near side it is seen flatly. The middles lie between its outer edge and the other slab's rim.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from autoreg.fitting.joint_parts import FEWEST, Parts, Side, bed_tone, climbed, likelihood_of
from autoreg.joints.joint_looks import Strip

# What is tried: widths of the whole joint, as multiples of its dark part's; shares of it that the bevel takes
# up from above, as deep as it is wide; and the bevel's tone against the slabs'.
WIDER = (1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.3, 2.6, 3.0)
SHARES = (0.1, 0.15, 0.2, 0.25, 0.35, 0.45, 0.55, 0.65)
LIGHT, DARK = (1.1, 1.15, 1.22, 1.3, 1.45, 1.6), (0.5, 0.6, 0.7, 0.8, 0.9)
# At first these of them, for bevels in the light and in the shade.
LIGHT_FIRST = ((1.4, 0.25, 1.1), (1.8, 0.25, 1.22), (2.0, 0.35, 1.1))
DARK_FIRST = ((1.4, 0.25, 0.8), (1.8, 0.25, 0.6), (2.0, 0.35, 0.8))
# For beds in the light beside a shade that was taken for the whole joint, these as well.
SHADE_FIRST = (*DARK_FIRST, (1.8, 0.45, 0.6), (2.6, 0.25, 0.5), (2.6, 0.1, 0.7), (2.6, 0.25, 0.8))
WIDEST = WIDER[-1]
EVERY_WAY = tuple(product((-1, 0, 1), repeat=3))
# Joints in fewer blurs tell nothing.
LEAST_BLURS = 1.5
# A bevel must make joints so much likelier than one tone does, and than walls do; than one tone by more where
# that is dark and the bed would be light: slabs look like beds, too.
LEAST_NATS, LEAST_NATS_WALLS, LEAST_NATS_BEDS = 20.0, 15.0, 40.0
# Beds beside bevels in the shade are light, of this tone against the slabs' at least. Dark ones have walls
# and bevels of any tone beside them.
LIGHT_BED = 0.75
# What is wider than this share of a slab's side is no bevel, but rough or sloping stone.
MOST_OF_SIDE = 0.04
# Without bevels joints may be as wide as this, as shares of the width that a strip fits to all of them ...
AS_WIDE = (0.6, 0.7, 0.8, 0.9, 1.0, 1.15, 1.3, 1.5, 1.8)
# ... or wider by such a factor, with walls lit so high, of such tones.
OF_WALLS = ((1.0, 1.2, 1.4, 1.7), (0.3, 0.5, 0.8, 1.2), (0.5, 0.6, 0.7, 0.8, 0.95, 1.05, 1.1, 1.2, 1.3))
WALLS_AT_FIRST = ((1.4, 0.5, 0.8), (1.4, 0.8, 0.6), (1.2, 0.5, 1.1), (1.4, 0.8, 1.3))


def bevelled(
    side: Side, strip: Strip, family: int, across: float, wall: Parts | None
) -> tuple[float, Parts] | None:
    """How wide and how light the far slabs' bevels are, and by how much likelier; None if none show.

    They are held against joints of one tone, and against walls in the light: as they are known from others,
    and of any look. `across` is the side of a slab across the joints.
    """
    own = strip.width[family]
    wide = np.flatnonzero((own * side.px_per_unit > LEAST_BLURS * side.blur_px) & (side.slope > 0))
    if strip.polarity[family] > 0 or len(wide) < FEWEST:
        return None
    shown = side.take(wide).widest()
    nats = likelihood_of(shown)

    def bevel(wider: float, share: float, tone: float) -> Parts:
        return Parts(wider * own, share, share, tone)

    def any_wall(wider: float, height: float, tone: float) -> Parts:
        return Parts(wider * own, 0.0, height, tone)

    # Where bevels make the joints less likely at first, no others are tried.
    expected = nats(wall or Parts(own))
    bevels = [
        climbed(nats, bevel, (WIDER, SHARES, tones), first, EVERY_WAY)
        for tones, first in (
            (LIGHT, LIGHT_FIRST),
            (DARK, SHADE_FIRST if strip.polarity[family] else DARK_FIRST),
        )
        if max(nats(bevel(*look)) for look in first) > expected
    ]
    bevels = [each for each in bevels if each.tone > 1 or bed_tone(shown, each) > LIGHT_BED]
    # Joints of both families are about as wide from rim to rim, whatever of them is dark.
    widest = WIDEST * min(strip.width)
    bevels = [b for b in bevels if b.level * b.width <= MOST_OF_SIDE * across and b.width <= widest]
    if not bevels:
        return None
    others = [Parts(share * own) for share in AS_WIDE] + ([] if wall is None else [wall])
    plain = max(map(nats, others))

    def clear(each: Parts) -> bool:
        least = LEAST_NATS_BEDS if each.tone < 1 and strip.polarity[family] else LEAST_NATS
        return nats(each) - plain >= least

    found = max(filter(clear, bevels), key=nats, default=None)
    if found is None:
        return None
    wall_like = climbed(nats, any_wall, OF_WALLS, WALLS_AT_FIRST, EVERY_WAY)
    likelier = nats(found) - max(plain, nats(wall_like))
    return None if likelier < LEAST_NATS_WALLS else (likelier, found)
