"""What joints of unknown looks look like: where they lie, how wide they are, and whether dark or light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.ground.stations import Stations
from autoreg.joints.edges import fit_offsets, search_offsets, strip_misfits
from autoreg.joints.joint_looks import Strip, sample, width_px_of
from autoreg.joints.profiles import Profiles

# Joint widths, in slab sides, that are tried at first, and by how much a wider one must lower the mean log
# variance: a bare step fits the edge of any.
FIRST_SHARES, WIDER = (0.006, 0.015, 0.035, 0.08), 0.03
# Profiles are shaded where a slope of light lowers their mean log variance by more than this: noise alone
# is lowered by a tenth.
SHADED = 0.3
# A strip laid beside a bare step has half the step's depth; a joint between two tones has more than this.
LINED = 0.7


def search_joints(
    profiles: Profiles, stations: Stations, strip: Strip, reach_px: np.ndarray, widest_px: float | None = None
) -> Float[np.ndarray, " n"]:
    """Offset of each joint, to half a pixel, within its own reach.

    `widest_px` is the reach of the widest search that these joints are part of, if they are not all of it.
    """
    width = width_px_of(strip, stations, profiles)
    reach = float(reach_px.max()) if widest_px is None else widest_px
    start = search_offsets(profiles, width, reach, reach / 2.0, strip.blur_px)
    return np.clip(start, -reach_px, reach_px)


def first_look(
    profiles: Profiles,
    stations: Stations,
    strip: Strip,
    side: np.ndarray,
    reach_px: np.ndarray,
    shares: tuple[float, ...] = FIRST_SHARES,
) -> tuple[np.ndarray, Strip]:
    """Joint widths that explain the profiles best, from a few guesses, and the offsets found with them.

    Each family has its own. All guesses are judged by all that is seen of a profile: within its own reach a
    narrow strip explains one edge of a wide joint as well as a wide one explains both. A sample tells which
    guess is right, and whether the profiles are shaded. The guesses are `shares` of a slab's side.
    """
    rows = np.sort(np.concatenate([sample(stations.family == family) for family in (ALONG_X, ALONG_Y)]))
    some, places, reach = profiles.take(rows), stations.take(rows), float(reach_px.max())

    def looked(
        profiles: Profiles, stations: Stations, guess: Strip, reach_px: np.ndarray
    ) -> Float[np.ndarray, " n"]:
        found = search_joints(profiles, stations, guess, reach_px, reach)
        width_px = width_px_of(guess, stations, profiles)
        return fit_offsets(profiles, found, width_px, guess.blur_px, iterations=2).offset_px

    blur = np.array([strip.blur_px])
    # Of even and of falling light, by family and guess; a family of which nothing is seen keeps what it has.
    misfits = np.full((2, 2, len(shares)), np.nan)
    guesses = [replace(strip, width=(share * side[1], share * side[0])) for share in shares]
    for k, guess in enumerate(guesses):
        offset_px = looked(some, places, guess, reach_px[rows])
        for family in (ALONG_X, ALONG_Y):
            own = np.flatnonzero(places.family == family)
            if len(own) == 0:
                continue
            width_px = width_px_of(guess, places, some)[None, own]
            for shaded in (False, True):
                left = strip_misfits(some, own, offset_px[own], width_px, blur, shaded=shaded)
                misfits[int(shaded), family, k] = left[0]
    known, width = ~np.isnan(misfits[0, :, 0]), list(strip.width)
    even, falling = (light[known].min(initial=np.inf) for light in misfits)
    shaded = bool(known.any() and even - falling > SHADED)
    for family in np.flatnonzero(known):
        least = np.inf
        for guess, misfit in zip(guesses, misfits[int(shaded), family], strict=True):
            if misfit < least - WIDER:
                least, width[family] = misfit, guess.width[family]
    strip = replace(strip, width=(width[0], width[1]), shaded=shaded)
    return looked(profiles, stations, strip, reach_px), strip


def joint_polarity(
    profiles: Profiles, stations: Stations, start: np.ndarray, strip: Strip, side: np.ndarray
) -> tuple[int, int]:
    """Whether most joints of either family are dark (-1) or light (+1), or neither (0).

    Judged on a sample, with joints of a usual width at least: a strip without width has no tone of its own.
    """
    signs: list[int] = []
    for family in (ALONG_X, ALONG_Y):
        rows = sample(stations.family == family)
        across = side[1] if family == ALONG_X else side[0]
        width_px = np.maximum(max(strip.width[family], 0.015 * across) * profiles.px_per_unit[rows], 1.0)
        looks = fit_offsets(profiles.take(rows), start[rows], width_px, strip.blur_px, iterations=3)
        strong = looks.strength > 0.4
        lined = strong & (np.abs(looks.depth) > LINED * np.abs(looks.step))
        # In a floor of two tones the steps outweigh whatever lies between the tiles.
        if lined.sum() < max(6, 0.4 * strong.sum()):
            signs.append(0)
            continue
        dark = float(np.mean(looks.depth[lined] < 0))
        signs.append(-1 if dark > 0.75 else 1 if dark < 0.25 else 0)
    return signs[0], signs[1]
