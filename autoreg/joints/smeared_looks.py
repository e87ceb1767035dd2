"""How wide joints look that are smeared by more than their own width: alike in pixels, near and far."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool

from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.ground.stations import Stations
from autoreg.joints.edges import fit_offsets, search_offsets, strip_misfits
from autoreg.joints.joint_looks import Strip, sample
from autoreg.joints.profiles import Profiles
from autoreg.joints.smear import FEWEST

# Looks that smeared joints are tried with: no narrower than so many pixels, and else as wide as such parts of
# the width that is taken for theirs.
NARROWEST_PX, OWN_PARTS = np.r_[0.0, np.geomspace(3.0, 18.0, 5)], np.array([0.35, 0.6, 1.0])
# They are looked for within so many pixels, at most as wide as such a part of what is seen to either side.
# The mean log variance must be lower by so much: sharp joints of right lattices lower it by up to 0.06,
# smears of 4 pixels by 0 to 0.6, and those of 6 to 12 by 0.4 to 2.
SEARCH_PX, MOST_OF_ROOM, CLEARER = 6.0, 1.6, 0.25
# Narrower ones, in blurs, are of pictures out of focus.
LEAST_BLURS = 3.0
# Stations of either family that tell it.
SAMPLE = 24


def smear_px(
    profiles: Profiles, stations: Stations, strip: Strip, usable: Bool[np.ndarray, " n"]
) -> tuple[float, float]:
    """Width in pixels that no joint of either family looks narrower than; 0 where there is no such width.

    A width on the ground that is fitted to smeared joints is too large for the near ones, and for the far
    ones too small: a strip that is too narrow holds on to one edge, whichever is nearer.
    """
    found = [0.0, 0.0]
    for family in (ALONG_X, ALONG_Y):
        # What is wider looks no wider by any of these smears.
        own_px = strip.width[family] * profiles.px_per_unit
        rows = sample(usable & (own_px < NARROWEST_PX[-1]) & (stations.family == family), SAMPLE)
        if strip.polarity[family] == 0 or len(rows) < FEWEST:
            continue
        parts_px = OWN_PARTS[:, None, None] * own_px[rows]
        narrowest_px = NARROWEST_PX[(NARROWEST_PX == 0.0) | (LEAST_BLURS * strip.blur_px < NARROWEST_PX)]
        tried = np.maximum(parts_px, narrowest_px[:, None]).reshape(-1, len(rows))
        # Slabs are to be seen on either side.
        tried = np.minimum(tried, MOST_OF_ROOM * profiles.room_px[rows])
        # Where the joints lie is asked of all widths at once.
        every, width_px = profiles.take(np.tile(rows, len(tried))), tried.ravel()
        start = search_offsets(every, width_px, SEARCH_PX, SEARCH_PX, strip.blur_px)
        placed = fit_offsets(every, start, width_px, strip.blur_px, iterations=1).offset_px
        blurs = np.full(len(tried), strip.blur_px)
        misfits = strip_misfits(
            profiles, rows, placed.reshape(tried.shape), tried, blurs, shaded=strip.shaded
        )
        least = misfits.reshape(len(OWN_PARTS), -1).min(0)
        if least.min() < least[0] - CLEARER:
            found[family] = float(narrowest_px[least.argmin()])
    return found[0], found[1]
