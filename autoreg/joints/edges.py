"""Sub-pixel places of the joints: each station's own grey-level profile across the joint.

A joint is a strip between two slabs: left tone, joint tone, right tone, with two edges of opposite sign
(or one edge where tiles of two tones meet without a joint). Its *centre* is what is measured, by a least
squares fit of that blurred strip; matching one edge would leave half a joint width of bias.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float32, Int

from autoreg.joints.profiles import STEP_PX, Profiles
from autoreg.joints.strips import (
    INDEPENDENT,
    NOISE_FLOOR,
    StripModel,
    Window,
    batches,
    dot,
    edge,
    single,
    still_moving,
)
from autoreg.numbering import numbered

# Profiles whose rooms differ by less are searched together.
ROOM_STEP_PX = 4.0
# Wider strips are searched as if they were so wide.
WIDEST_PX = 2.0**4.5
# Columns that are shorter than this are rounding errors.
LEAST_NORM = 1e-6
# A strip that explains no more than this share of a profile's variance shows no joint.
LEAST_STRENGTH = 0.25


@dataclass(frozen=True)
class Offsets:
    """Where the joint lies off the station's projected centre, along its normal.

    `depth` is the joint's tone against the mean of its slabs', `step` the tone of the far slab against the
    near one's, `strength` the share of the profile's variance that the fit explains.
    """

    offset_px: Float[np.ndarray, " n"]
    sigma_px: Float[np.ndarray, " n"]
    depth: Float[np.ndarray, " n"]
    step: Float[np.ndarray, " n"]
    strength: Float[np.ndarray, " n"]


def _candidates(halves: int) -> Float[np.ndarray, " c"]:
    """Offsets that are tried, in pixels: so many half pixels either way."""
    return 0.5 * np.arange(-halves, halves + 1)


# The same looks are held against a photo's profiles again and again.
@lru_cache(maxsize=128)
def _looks(
    samples: int, halves: int, width: float, blur: float
) -> Float32[np.ndarray, "{samples} {6*halves+3}"]:
    """Steps at all candidates, behind them strips of one width, and pairs of a light and a dark one.

    As columns of so many samples, which are orthonormal at each candidate and without mean: that makes the
    explained variance a sum of squares. The strip's sign is that of a light one.
    """
    s = (np.arange(samples) - samples // 2) * STEP_PX - _candidates(halves)[:, None]
    near, middle, far = (edge(single((s + side * width) / blur)).astype(float) for side in (1.0, 0.0, -1.0))
    near_rim, far_rim = (edge(single((s + side * 0.5 * width) / blur)).astype(float) for side in (1.0, -1.0))
    columns: list[np.ndarray] = []
    for column in (near_rim + far_rim, near_rim - far_rim, near - 2.0 * middle + far):
        own = column - column.mean(1, keepdims=True)
        for other in columns:
            own -= (other * own).sum(1, keepdims=True) * other
        # Where one edge lies beyond the samples a strip is no more than a step.
        columns.append(own / np.maximum(np.linalg.norm(own, axis=1, keepdims=True), LEAST_NORM))
    every = np.ascontiguousarray(single(np.concatenate(columns)).T)
    every.setflags(write=False)
    return every


def _explained(centred: Float32[np.ndarray, "n p"], looks: np.ndarray, kinds: int = 2) -> list[np.ndarray]:
    """Components of profiles along so many kinds of looks, for each centre: arrays (n, c)."""
    count = looks.shape[1] // 3
    every = centred @ looks[:, : kinds * count]
    return [every[:, k * count : (k + 1) * count] for k in range(kinds)]


def _alike(
    width_px: Float[np.ndarray, " n"], rooms: Int[np.ndarray, " n"]
) -> Iterator[tuple[np.ndarray, float, int]]:
    """Rows of the profiles that can share a strip, its width (a power of the root of two), and their room."""
    level = np.round(2 * np.log2(np.maximum(width_px, 1.0))).astype(int)
    number, first = numbered(level, rooms)
    for k, one in enumerate(first):
        yield np.flatnonzero(number == k), 2.0 ** (int(level[one]) / 2), int(rooms[one])


def search_offsets(
    profiles: Profiles, width_px: Float[np.ndarray, " n"], reach_px: float, prior_px: float, blur: float = 0.9
) -> Float[np.ndarray, " n"]:
    """Offset of the strip that explains each profile best, to half a pixel, within `reach_px`.

    A Gaussian prior of `prior_px` settles ties in favour of the predicted place.
    """
    at = profiles.at_px
    halves = 2 * int(reach_px)
    candidates = _candidates(halves)
    prior = single(0.5 * (candidates / prior_px) ** 2)
    best = np.zeros(len(profiles.values))
    rooms = np.ceil(profiles.room_px / ROOM_STEP_PX).astype(int)
    for rows, width, room in _alike(np.minimum(width_px, WIDEST_PX), rooms):
        inside = np.abs(at) <= room * ROOM_STEP_PX
        values = profiles.values[np.ix_(rows, inside)]
        centred = values - values.mean(1, keepdims=True)
        total = (centred**2).sum(1, keepdims=True) + 1e-6
        step, strip = _explained(centred, _looks(int(inside.sum()), halves, width, blur))
        left = np.maximum(total - step**2 - strip**2, 1e-3 * total + 1e-6)
        likelihood = -0.5 * INDEPENDENT * inside.sum() * np.log(left) - prior
        best[rows] = candidates[likelihood.argmax(1)]
    return best


def fit_offsets(
    profiles: Profiles,
    start_px: Float[np.ndarray, " n"],
    width_px: Float[np.ndarray, " n"],
    blur: float | Float[np.ndarray, " n"],
    *,
    iterations: int = 6,
) -> Offsets:
    """Least-squares offset of each strip (variable projection: tones are linear, the offset is not).

    Only the joint and its shoulders are looked at, from where the fit starts. All share a blur, or each has
    its own.
    """
    columns, each = np.empty((5, len(start_px))), np.broadcast_to(blur, start_px.shape)
    for rows, window in batches(profiles, start_px, width_px, blur):
        columns[:, rows] = _fitted(window, start_px[rows], width_px[rows], each[rows], iterations)
    return Offsets(*columns)


def _fitted(
    window: Window, start: np.ndarray, width: np.ndarray, blur: np.ndarray, iterations: int
) -> tuple[np.ndarray, ...]:
    """Offset, its sigma, depth, step and strength of some profiles."""
    at, values, weight = window
    strip = StripModel(values, weight, single(width), blur)
    centre, moving, some = start.copy(), np.arange(len(start)), strip
    for _ in range(iterations):
        some.at(at[moving] - single(centre[moving])[:, None])
        slope = some.slope()
        weighted = some.weight * slope
        step = dot(weighted, some.misfit) / np.maximum(dot(weighted, slope), 1e-9)
        away = centre[moving] - start[moving]
        step = np.clip(np.clip(step, -0.7, 0.7), -2.5 - away, 2.5 - away)
        centre[moving] += step
        moving, some = still_moving(strip, moving, some, step)
        if not len(moving):
            break
    strip.at(at - single(centre)[:, None])
    slope = strip.slope()
    information = dot(weight * slope, slope).astype(float)
    samples = weight.sum(1).astype(float)
    sse = dot(weight * strip.misfit, strip.misfit).astype(float)
    total = dot(weight * strip.values, strip.values)
    variance = sse / np.maximum(samples * INDEPENDENT - 4.0, 1.0) + NOISE_FLOOR
    near, far = strip.tones
    # A flat profile, overexposed say, shows no joint.
    strength = 1.0 - (sse + NOISE_FLOOR * samples) / (total + NOISE_FLOOR * samples)
    return centre, np.sqrt(variance / np.maximum(information, 1e-9)), 0.5 * (near - far), near + far, strength


def strip_support(
    profiles: Profiles,
    width_px: Float[np.ndarray, " n"],
    blur: float,
    tolerance_px: float,
    room_px: Float[np.ndarray, " n"],
    polarity: Int[np.ndarray, " n"],
    *,
    paired: bool = False,
) -> Float[np.ndarray, " n"]:
    """Share of each profile's variance that a strip within `tolerance_px` of the predicted place explains.

    Only what lies within `room_px` of the place is looked at, so that a neighbouring joint has no say. Where
    the joints are known to be dark or light, a step of tone alone is no joint, nor is a strip of the other
    kind. Those that are neither are steps, or strips of any kind; or, `paired`, a light strip and a dark one
    side by side in any shares, as a light bed and the shade of a wall are, and a step alone is none.
    """
    at = profiles.at_px
    halves = int(2 * tolerance_px)
    support = np.zeros(len(profiles.values))
    for rows, width, room in _alike(width_px, np.round(room_px).astype(int)):
        inside = np.abs(at) <= room
        values = profiles.values[rows][:, inside]
        centred = values - values.mean(1, keepdims=True)
        # A grey level of noise keeps flat profiles from scoring by chance.
        total = ((centred**2).sum(1) + 0.5 * inside.sum())[:, None]
        step, strip, pair = _explained(centred, _looks(int(inside.sum()), halves, width, blur), 3)
        sign, beside = polarity[rows, None], total - step**2
        lined = np.where(strip * sign > 0, strip**2 / beside, 0.0)
        neutral = (strip**2 + pair**2) / beside if paired else (step**2 + strip**2) / total
        support[rows] = np.where(sign == 0, neutral, lined).max(1)
    return support


def strip_misfits(
    profiles: Profiles,
    rows: Int[np.ndarray, " n"],
    offset_px: Float[np.ndarray, "... n"],
    width_px: Float[np.ndarray, "k n"],
    blur: Float[np.ndarray, " k"],
    *,
    shaded: bool = False,
) -> Float[np.ndarray, " k"]:
    """Mean logarithm of some stations' unexplained variance, for each of several widths and blurs.

    `offset_px` is where the joints of those stations lie, or where they do for each width and blur. Where the
    profiles are `shaded`, light that falls off is left out: a wide blur would fit it better than a narrow
    strip does the joint.
    """
    k, n = width_px.shape
    inside = (np.abs(profiles.at_px) <= profiles.room_px[rows, None]).astype(np.float32)
    # All at once: the arrays are small, and each operation on them has its price.
    strip = StripModel(
        np.tile(profiles.values[rows], (k, 1)),
        np.tile(inside, (k, 1)),
        single(width_px.ravel()),
        np.repeat(blur, n),
        shading=single(profiles.at_px) if shaded else None,
    )
    strip.at(single(profiles.at_px) - single(np.broadcast_to(offset_px, (k, n)).reshape(-1, 1)))
    values = profiles.values[rows]
    centred = values - dot(inside, values)[:, None] / inside.sum(1, keepdims=True)
    left, total = dot(strip.weight * strip.misfit, strip.misfit), np.tile(dot(inside * centred, centred), k)
    return np.log(left / np.maximum(total, 1e-9) + 1e-3).reshape(k, n).mean(1).astype(float)
