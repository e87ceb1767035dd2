"""How the measured joints scatter about their lines, and which of them belong to something else."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.ground.stations import Stations
from autoreg.spread import spread, spread_about

# An outermost line that lies off by so many times what the inner ones do is the rim of something else, if
# there are at least so many lines and it is off by more than this share of a side and so many pixels; they
# are looked for among this part of the lines at either end.
RIM_SIGMAS, RIM_LINES, RIM_SHARE, RIM_PX, RIM_PART = 6.0, 5, 0.015, 0.5, 4
# Joints that tell the scatter.
SCATTER_SAMPLE = 500


def beside_rim(
    off_px: Float[np.ndarray, " n"],
    side_px: Float[np.ndarray, " n"],
    stations: Stations,
    usable: Bool[np.ndarray, " n"],
) -> Bool[np.ndarray, " n"]:
    """Stations of outermost lines that lie off as none of the others: a kerb, or the rim of a board.

    Args:
        off_px: distances from the projected joints.
        side_px: length of a slab side across the joint, as seen there.
        stations: where they were measured.
        usable: those that count.
    """
    off, beside = off_px / side_px, np.zeros(len(off_px), dtype=bool)
    for family in (ALONG_X, ALONG_Y):
        members = np.flatnonzero(usable & (stations.family == family))
        members = members[np.lexsort((off[members], stations.line[members]))]
        lines, start, count = np.unique(stations.line[members], return_index=True, return_counts=True)
        if len(lines) < RIM_LINES:
            continue
        median = members[start + (count - 1) // 2]
        place = off[median]
        most = len(lines) // RIM_PART
        inner = place[most : len(lines) - most]
        away = np.abs(place - np.median(inner))
        limit = RIM_SIGMAS * spread(inner)
        gross = np.flatnonzero((away > max(limit, RIM_SHARE)) & (np.abs(off_px[median]) > RIM_PX))
        # What lies beyond such a line is no paving of this lattice either.
        first, last = gross[gross < most], gross[gross >= len(lines) - most]
        low = first.max() + 1 if len(first) else 0
        high = last.min() if len(last) else len(lines)
        line = stations.line[members]
        beside[members] = (line < lines[low]) | (line > lines[high - 1])
    return beside


def scatter_model(
    distances: np.ndarray,
    sigma_fit: np.ndarray,
    px_per_unit: np.ndarray,
    side: np.ndarray,
    usable: np.ndarray,
) -> Float[np.ndarray, " n"]:
    """Expected scatter of each station: its own measurement, and the slabs' irregularity on the ground.

    The two shares are found by maximum likelihood (Cauchy) over a grid. Stations of one side share their
    slab's displacement, so the irregular part counts once per side.
    """
    rows = np.flatnonzero(usable)
    rows = rows[:: max(1, len(rows) // SCATTER_SAMPLE)]
    r, s, u = np.abs(distances[rows]), sigma_fit[rows], px_per_unit[rows]
    s = np.maximum(s, 0.3 * np.median(s))
    base = spread_about(r) + 1e-6
    shares = np.r_[0.0, np.geomspace(0.05, 2.0, 10)] * base
    share_s, share_u = (
        np.stack(np.meshgrid(shares / np.median(s), shares / np.median(u)), -1).reshape(-1, 2).T
    )
    # Half the spread is a Cauchy's scale for normal residuals.
    gamma2 = 0.45 * (share_s[:, None] ** 2 * s**2 + share_u[:, None] ** 2 * u**2 + 1e-6)
    best = int((0.5 * np.log(gamma2) + np.log1p(r * r / gamma2)).sum(1).argmin())
    share_s, share_u = share_s[best], share_u[best]
    per_side = np.bincount(side[usable], minlength=side.max() + 1)[side]
    smooth = np.maximum(sigma_fit, 0.3 * np.median(s))
    return np.sqrt((share_s * smooth) ** 2 + np.maximum(per_side, 1) * (share_u * px_per_unit) ** 2 + 1e-6)
