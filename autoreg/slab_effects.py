"""How far irregular slabs, relief, bright tiles and bent ground move each station across its joint.

These are the columns of the mixed model's random effects, in pixels, each for a size of one.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix

from autoreg.refine import Fit
from autoreg.stations import ALONG_X, ALONG_Y

# Slope across the joint (ground distance over camera height) at which the relief stops growing.
KNEES = (0.4, 0.8, 1.6, 3.2, 8.0)
# A slab side's place is not known better than this, whatever its profiles say: texture, interpolation, JPEG.
SIDE_FLOOR_PX = 0.01


def slab_effects(
    fit: Fit, rows: np.ndarray, a: float, b: float, side: float
) -> tuple[csr_matrix, csr_matrix, csr_matrix]:
    """Pixels that each station moves per unit of its two slabs' places, heights, and turns times a side."""
    stations, n = fit.stations.take(rows), len(rows)
    k = 0.5 * fit.profiles.px_per_unit[rows]
    along_x = stations.family == ALONG_X
    keys, lever = [], []
    for beyond in (0, 1):
        row = np.where(along_x, stations.line - 1 + beyond, np.floor(stations.ground[:, 1] / b)).astype(int)
        place = stations.ground[:, 0] / a - row * fit.grid.shift
        column = np.where(along_x, np.floor(place), np.round(place) - 1 + beyond).astype(int)
        middle = np.stack([(column + 0.5 + row * fit.grid.shift) * a, (row + 0.5) * b], 1)
        away = stations.ground - middle
        # A positive turn moves a slab's sides along X by +x, those along Y by -y.
        lever.append(k * np.where(along_x, away[:, 0], -away[:, 1]))
        keys.append(np.stack([row, column], 1))
    names, slab = np.unique(np.concatenate(keys), axis=0, return_inverse=True)
    both, axis = np.tile(np.arange(n), 2), np.tile(stations.family, 2)
    slope = _slope(fit, rows)

    def effect(value: np.ndarray, column: np.ndarray, count: int) -> csr_matrix:
        return csr_matrix((value, (both, column)), shape=(n, count))

    return (
        effect(np.tile(k, 2), 2 * slab + axis, 2 * len(names)),
        effect(np.tile(k * slope, 2), slab, len(names)),
        effect(np.concatenate(lever) / side, slab, len(names)),
    )


def _slope(fit: Fit, rows: np.ndarray) -> Float[np.ndarray, " n"]:
    """How far a unit of height moves each station across its joint, seen from the camera."""
    eye = fit.cam_from_ground.origin_in_a
    away = fit.stations.ground[rows] - eye[:2]
    return np.where(fit.stations.family[rows] == ALONG_X, away[:, 1], away[:, 0]) / eye[2]


def relief_effects(fit: Fit, rows: np.ndarray) -> Float[np.ndarray, "n r"]:
    """Pixels that each station moves by the relief, for joint walls of the four directions.

    A wall's light is the same all over the photo, so that each direction has one shift, which grows with
    the slope of the view until the bed is hidden. A shadow on the bed moves a family even from above.
    """
    slope, family = _slope(fit, rows), fit.stations.family[rows]
    half = 0.5 * float(np.mean(fit.strip.width)) * fit.profiles.px_per_unit[rows]
    columns: list[np.ndarray] = []
    for own in (ALONG_X, ALONG_Y):
        for facing in (-1.0, 1.0):
            seen = half * facing * ((family == own) & (np.sign(slope) == facing))
            columns += [seen * np.minimum(np.abs(slope) / knee, 1.0) / np.sqrt(len(KNEES)) for knee in KNEES]
        shaded = half * (family == own)
        columns.append(0.7 * shaded)
        columns += [0.5 * shaded * np.maximum(0.0, 1.0 - np.abs(slope) / knee) for knee in (0.8, 2.0)]
    # The same covariance in fewer columns.
    U, size, _ = np.linalg.svd(np.stack(columns, 1), full_matrices=False)
    return (U * size)[:, size > 0.01 * size[0]]


def bow_effects(fit: Fit, rows: np.ndarray) -> Float[np.ndarray, "n 3"]:
    """Pixels that each station moves where the ground is bent along X, along Y, or twisted, by its extent."""
    ground = fit.stations.ground[rows]
    low, high = ground.min(0), ground.max(0)
    extent = float(np.max(high - low))
    x, y = ((2 * ground - low - high) / extent).T
    rise = extent * fit.profiles.px_per_unit[rows] * _slope(fit, rows)
    return rise[:, None] * np.stack([x * x, y * y, x * y], 1)


def bloom_effects(fit: Fit, rows: np.ndarray) -> Float[np.ndarray, "n r"]:
    """Pixels that each station moves where bright tiles look larger by one, for families without joints."""
    up, family = np.sign(fit.offsets.step[rows]), fit.stations.family[rows]
    bare = [own for own in (ALONG_X, ALONG_Y) if fit.strip.polarity[own] == 0]
    return (up * (family == np.array(bare)[:, None])).T if bare else np.zeros((len(rows), 0))


def shared_by(fit: Fit, rows: Int[np.ndarray, " n"]) -> tuple[Int[np.ndarray, " n"], ...]:
    """Numbers of what stations have in common: the line, and the field of one slab's size."""
    stations = fit.stations.take(rows)
    line = np.stack([stations.family, stations.line], 1)
    cell = np.floor(stations.ground / [fit.grid.spacing_x or fit.grid.spacing_y, fit.grid.spacing_y])
    return tuple(np.unique(key, axis=0, return_inverse=True)[1].ravel() for key in (line, cell))


def own_noise(fit: Fit, rows: np.ndarray) -> Float[np.ndarray, " n"]:
    """Scatter of single stations: their profiles' claim, scaled to how neighbours on one side differ."""
    claim = fit.offsets.sigma_px[rows]
    claim = np.maximum(claim, 0.3 * float(np.median(claim)))
    side = fit.stations.side[rows]
    pair = np.flatnonzero(side[1:] == side[:-1])
    if len(pair) >= 10:
        step = np.abs(np.diff(fit.distances_px[rows]))[pair] / np.hypot(claim[pair], claim[pair + 1])
        claim = claim * 1.48 * float(np.median(step))
    # The floor holds for a side as a whole, however many stations it has.
    return np.hypot(claim, SIDE_FLOOR_PX * np.sqrt(np.bincount(side)[side]))
