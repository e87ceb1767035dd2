"""Places of both edges of the joints, each for itself: how wide a joint looks, and where its middle is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from autoreg.joints.profiles import Profiles
from autoreg.joints.strips import (
    INDEPENDENT,
    NOISE_FLOOR,
    StripModel,
    Window,
    batches,
    dot,
    single,
    still_moving,
)

# Joints at least this many blurs wide show both edges apart.
APART_BLURS = 2.5
# Shares of the known width from which both edges of a strip are looked for, and the most steps towards them.
STARTS, EDGE_STEPS = (0.6, 1.0), 12


@dataclass(frozen=True)
class Widths:
    """Each joint's middle along its station's normal, and its width, where its two edges are told apart.

    Sigmas are infinite where they are not.
    """

    middle_px: Float[np.ndarray, " n"]
    width_px: Float[np.ndarray, " n"]
    sigma_middle_px: Float[np.ndarray, " n"]
    sigma_width_px: Float[np.ndarray, " n"]


def fit_widths(
    profiles: Profiles,
    start_px: Float[np.ndarray, " n"],
    width_px: Float[np.ndarray, " n"],
    blur: float,
    rows: Int[np.ndarray, " m"] | None = None,
) -> Widths:
    """Least-squares places of both edges of each strip, or of those of some `rows`, the others untold.

    They are looked for from where a strip of known width was fitted. An edge that is hidden, or looks like
    its slab, leaves a narrower strip that lies off: two widths are started from.
    """
    rows = np.arange(len(start_px)) if rows is None else rows
    some, start, width = profiles.take(rows), start_px[rows], width_px[rows]
    columns = np.stack([start_px, width_px, *np.full((2, len(start_px)), np.inf)])
    for part, window in batches(some, start, width, blur):
        found = [_both_edges(window, start[part], width[part], share, blur) for share in STARTS]
        better = found[1][0] < found[0][0]
        columns[:, rows[part]] = np.where(better, found[1][1:], found[0][1:])
    return Widths(*columns)


def _both_edges(
    window: Window, start: np.ndarray, width: np.ndarray, share: float, blur: float
) -> np.ndarray:
    """Unexplained squares, middle, width and their sigmas, from a share of the known width (Gauss-Newton)."""
    at, values, weight = window
    strip = StripModel(values, weight, single(share * width), blur)
    centre, half = start.copy(), 0.5 * share * width
    variances = np.zeros((2, len(start)))
    moving, some = np.arange(len(start)), strip
    for _ in range(EDGE_STEPS):
        some.half = single(half[moving])[:, None]
        some.at(at[moving] - single(centre[moving])[:, None])
        slopes = some.slope(), some.slope_by_half()
        weighted = [some.weight * slope for slope in slopes]
        pulls = [dot(each, some.misfit).astype(float) for each in weighted]
        # A little damping keeps steps of hardly visible edges finite.
        squares = [1.01 * dot(*pair).astype(float) + 1e-6 for pair in zip(weighted, slopes, strict=True)]
        mixed = dot(weighted[0], slopes[1]).astype(float)
        determinant = squares[0] * squares[1] - mixed**2
        variances[:, moving] = np.stack(squares[::-1]) / determinant
        pulled = variances[:, moving] * np.stack(pulls) - mixed / determinant * np.stack(pulls[::-1])
        steps = np.clip(pulled, -0.7, 0.7)
        centre[moving] += steps[0]
        half[moving] = np.maximum(half[moving] + steps[1], 0.05 * width[moving])
        moving, some = still_moving(strip, moving, some, *steps)
        if not len(moving):
            break
    strip.half = single(half)[:, None]
    strip.at(at - single(centre)[:, None])
    sse = dot(weight * strip.misfit, strip.misfit).astype(float)
    variance = sse / np.maximum(weight.sum(1).astype(float) * INDEPENDENT - 5.0, 1.0) + NOISE_FLOOR
    sigma_centre, sigma_half = np.sqrt(variance * variances)
    told = (np.abs(centre - start) < 0.5 * width + 1.0) & (half > 0.1 * width) & (half < 0.9 * width)
    found = np.stack([sse, centre, 2.0 * half, sigma_centre, 2.0 * sigma_half])
    untold = np.stack([np.full(len(start), np.inf), start, width, *np.full((2, len(start)), np.inf)])
    return np.where(told, found, untold)
