"""Whether a picture is smeared: blurred along one direction more than across it, as by an unsteady hand.

Joints across the motion then look wider than they are by some pixels, however far off they lie, as no relief
makes them, nor blur that is alike all round. Texture tells a small smear: it has fine and coarse differences
in about the same ratio along whatever direction it is seen, also where the view foreshortens it, and a smear
takes away the fine ones along its own. Where noise hides the texture, the widths tell a large one.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from autoreg.spread import spread_about

# So many squares either way, of so many pixels a side, are looked at.
TILES, TILE_PX = 6, 64
# Steps of a coarse difference, along the axes and along the diagonals; a fine one is of one step.
ALONG_AXES, ALONG_DIAGONALS = 6, 4
# The largest differences, of joints and of what lies on the slabs, count as much as those of this share, told
# by one in so many.
TRIMMED, SOME = 0.8, 5
# Differences in grey levels that even a flat picture is given.
LEAST_GREY = 0.05
# Nine in ten pavings that are not smeared have less than 1.25; smears of 2.5 pixels give 1.3 to 2.2, of six
# 1.5 to 2.8. Where small slabs' joints look like a smear, the pose does without their widths.
SMEARED = 1.3
# Widths of at least so many joints tell a smear by the part of them that is the same in pixels: if it is
# larger than this by so many standard deviations, and than what grows with the joints' scale. Relief gives up
# to 2.6 px, of which it is never that sure.
FEWEST, SMEAR_PX, CLEAR_SIGMAS = 10, 2.0, 3.0
ROBUST_STEPS, LEAST_SIGMA_PX = 6, 0.05


def smeared(picture: Float[np.ndarray, "h w"], at_px: Float[np.ndarray, "n 2"]) -> bool:
    """Whether a picture is smeared where some of its pixels (u, v) lie."""
    return smear(picture, at_px) > SMEARED


def smear(picture: Float[np.ndarray, "h w"], at_px: Float[np.ndarray, "n 2"]) -> float:
    """How many times smoother the picture is along one direction than across it: one where it is alike.

    Seen along the axes and along the diagonals, in squares spread over the box around some pixels (u, v).
    """
    if len(at_px) == 0:
        return 1.0
    height, width = picture.shape
    side = min(TILE_PX, height, width)
    low, high = at_px.min(0), at_px.max(0) - side
    u, v = (np.linspace(a, max(a, b), TILES) for a, b in zip(low, high, strict=True))
    corner = np.rint(np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)).astype(int)
    corner = np.unique(np.clip(corner, 0, [width - side, height - side]), axis=0)
    tiles = np.array([picture[y : y + side, x : x + side] for x, y in corner.tolist()])
    mirrored = tiles[:, :, ::-1]
    pairs = (
        (_roughness(tiles, 1, 0, ALONG_AXES), _roughness(tiles, 0, 1, ALONG_AXES)),
        (_roughness(tiles, 1, 1, ALONG_DIAGONALS), _roughness(mirrored, 1, 1, ALONG_DIAGONALS)),
    )
    return max(max(a / b, b / a) for a, b in pairs)


def _roughness(tiles: Float[np.ndarray, "m s s"], x: int, y: int, steps: int) -> float:
    """Differences of one step (x, y) over those of so many."""
    fine, coarse = _difference(tiles, x, y), _difference(tiles, steps * x, steps * y)
    return (fine + LEAST_GREY) / (coarse + LEAST_GREY)


def _difference(tiles: Float[np.ndarray, "m s s"], x: int, y: int) -> float:
    """Mean difference of grey levels that lie (x, y) apart."""
    side = tiles.shape[1]
    off = np.abs(tiles[:, y:, x:] - tiles[:, : side - y, : side - x]).ravel()
    some = off[::SOME]
    at = int(TRIMMED * (len(some) - 1))
    return float(np.minimum(off, np.partition(some, at)[at]).mean())


def alike_in_px(
    width_px: Float[np.ndarray, " n"], sigma_px: Float[np.ndarray, " n"], scale: Float[np.ndarray, " n"]
) -> bool:
    """Whether joints look about as wide in pixels wherever they lie; `scale` is how large they are seen."""
    if len(width_px) < FEWEST:
        return False
    sigma_px = np.maximum(sigma_px, LEAST_SIGMA_PX)
    columns = np.stack([scale / np.median(scale), np.ones(len(scale))], 1)
    parts, unsure, weight = np.zeros(2), np.inf, 1.0 / sigma_px
    for _ in range(ROBUST_STEPS):
        weighted = columns * weight[:, None]
        covariance = np.linalg.pinv(weighted.T @ weighted)
        parts = covariance @ (weighted.T @ (width_px * weight))
        off = np.abs(width_px - columns @ parts) / sigma_px
        spread = spread_about(off) + 1e-6
        unsure = spread * float(np.sqrt(covariance[1, 1]))
        weight = 1.0 / sigma_px / np.hypot(1.0, 0.5 * off / spread)
    growing, constant = parts
    return bool(constant - CLEAR_SIGMAS * unsure > SMEAR_PX and constant > growing)
