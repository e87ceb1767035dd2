"""How wide sunk joints are, by how much narrower they look the more they are seen aslant.

The near slab's rim hides a part of a sunk joint, and where the far slab's wall is as light as the slabs that
is missing as well. If nearly all of a photo's joints are so, none looks as wide as it is.
"""

from __future__ import annotations

import numpy as np

from autoreg.fitting.bare_steps import across_slope
from autoreg.fitting.fit import Fit
from autoreg.spread import spread_about

# So many joints tell how wide they would look from straight above, if their widths shrink with the slope of
# the view by so many standard deviations; joints differ in width by such a share.
FEWEST_SEEN, CLEAR_SIGMAS, UNEVEN_SHARE = 20, 5.0, 0.1
# Some of them must be seen from nearly there: so large a part at slopes below this.
SEEN_SHARE, FROM_ABOVE = 0.15, 0.3
# Rounds of a regression in which what lies off by so many standard deviations counts half.
ROUNDS, HALF_SIGMAS = 12, 2.4


def width_from_above(fit: Fit) -> float | None:
    """Width on the ground that joints with two visible edges would have from straight above.

    None where they do not clearly look narrower the more they are seen aslant.
    """
    rows = np.flatnonzero(fit.apart)
    rows = rows[np.isfinite(fit.widths.sigma_width_px[rows])]
    slope = np.abs(across_slope(fit)[rows])
    if len(rows) < FEWEST_SEEN or np.mean(slope < FROM_ABOVE) < SEEN_SHARE:
        return None
    scale = fit.profiles.px_per_unit[rows]
    width, sigma = fit.widths.width_px[rows] / scale, fit.widths.sigma_width_px[rows] / scale
    sigma = np.hypot(sigma, UNEVEN_SHARE * float(np.median(width)))
    columns, kept = np.stack([np.ones_like(slope), slope], 1) / sigma[:, None], np.ones_like(slope)
    from_above, growth, covariance = 0.0, 0.0, np.eye(2)
    for _ in range(ROUNDS):
        weighted = columns * kept[:, None]
        covariance = np.linalg.pinv(weighted.T @ columns)
        from_above, growth = (float(v) for v in covariance @ (weighted.T @ (width / sigma)))
        off = (width - from_above - growth * slope) / sigma
        kept = 1.0 / (1.0 + (off / (HALF_SIGMAS * max(spread_about(off), 1e-6))) ** 2)
    return from_above if -growth > CLEAR_SIGMAS * float(np.sqrt(covariance[1, 1])) else None
