"""Joints of which the bed itself is seen, by its own hue: they lie a little lower than the slabs."""

from __future__ import annotations

import numpy as np

from autoreg.fitting.bare_steps import across_slope
from autoreg.fitting.fit import Fit

# How much lower, as a share of how wide they look: on ray-traced pavings with sand and mortar between worn
# and bevelled rims by -0.1 to 0.4 of it (nine photos, mean 0.16).
BED_BELOW = 0.15


def on_slabs_level(fit: Fit) -> Fit:
    """The fit with its joints measured where their beds would be seen if they filled them to the brim."""
    rows = np.flatnonzero(fit.usable)
    below = BED_BELOW * np.array(fit.strip.width)[fit.stations.family[rows]]
    nearer_px = below * across_slope(fit)[rows] * fit.profiles.px_per_unit[rows]
    return fit.measured_at(rows, fit.offsets.offset_px[rows] + nearer_px, fit.offsets.sigma_px[rows])
