"""Whether joints were met at one of their edges only.

A narrow strip laid along one edge of a wide joint fits it as well as can be, and lies half a joint off. But
then the ground beside it is slab on one side and joint on the other, the same way round at every joint, where
the tones of slabs differ either way.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float

from autoreg.fitting.fit import Fit
from autoreg.fitting.refine import WIDE_SEARCH, refine_until_still
from autoreg.geometry import Rigid
from autoreg.ground.ground_frame import with_origin
from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.joints.first_looks import first_look
from autoreg.joints.joint_looks import BLURS, Strip, projected_width_px, sample
from autoreg.joints.profiles import sample_profiles

# Fewer stations than this do not tell it.
FEWEST = 30
# Sides of joints that differ by more, as a share of their contrast, are those of one edge: by 0.36 at most in
# 140 photos with both edges, by 0.46 to 1 with one, and by up to 0.53 where rims are lit on one side.
MOST = 0.4
# Widths that are tried instead, in slab sides, and what is tried of a family that may have been drawn along.
WIDER, DRAWN_ALONG = (0.1, 0.15), 0.25
# Sides that differ by more give cause to ask the profiles how wide the joints are: some of a wide joint's
# stations may lie at one edge and some at the other. They are asked with these shares of a slab's side, where
# slabs are so many pixels wide, and believed if the joints are one of them and so many times as wide as they
# were thought. Beyond a narrow joint a wide strip fits the tones of slabs at times, but not where its sides
# differ.
SUSPECT, CLEARLY_WIDER, SLABS_PX = 0.15, 1.5, (24.0, 400.0)
SHARES = (0.08, 0.1, 0.125, 0.155, 0.19, 0.23, 0.28)
# Joints that are measured anew as wide ones are met as often as before, but for this share of them: where it
# was a rim in the light that one side differed by, 0.35 more of them were missed.
MORE_MISSED = 0.1
# How far the profiles that tell it reach, in slab sides. A picture of larger slabs is reduced until they are
# about so many pixels wide: joints that are wide beside them remain so.
REACH, REDUCED_PX = 0.35, 200.0


def one_edge(fit: Fit) -> tuple[float, float]:
    """By how much the two sides of the joints along X, and along Y, differ, as a share of their contrast.

    The less of the mean difference and of what the signs alone leave of it, each between 0 and 1: zero where
    differences go either way, one where every joint was met at the same edge.
    """
    return _of_family(fit, ALONG_X, np.mean), _of_family(fit, ALONG_Y, np.mean)


def one_edge_of_most(fit: Fit) -> tuple[float, float]:
    """The same, by the median difference and contrast where these tell less than the mean ones.

    Beside the one joint where a field ends there may be anything, and other joints may be faint.
    """
    x, y = (
        min(mean, _of_family(fit, family, np.median))
        for family, mean in zip((ALONG_X, ALONG_Y), one_edge(fit), strict=True)
    )
    return x, y


def _of_family(fit: Fit, family: int, middle: Callable[[Float[np.ndarray, " n"]], np.floating]) -> float:
    rows = np.flatnonzero(fit.usable & (fit.stations.family == family))
    if len(rows) < FEWEST:
        return 0.0
    step, depth = fit.offsets.step[rows], fit.offsets.depth[rows]
    contrast = float(middle(np.abs(depth) + 0.5 * np.abs(step)))
    return min(abs(float(middle(step))) / max(contrast, 1e-9), abs(float(np.sign(step).mean())))


def with_both_edges(
    picture: Float[np.ndarray, "h w"],
    fit: Fit,
    *,
    reach: float,
    field: Float[np.ndarray, "k 2"] | None = None,
) -> Fit:
    """A fit with joints that were met at one edge measured anew as wide ones, if that meets both.

    `reach` and `field` are as for `refine`.
    """

    def as_wide_as(width: tuple[float, float], pose: Rigid) -> Fit:
        again = refine_until_still(
            picture, fit.camera, pose, fit.grid,
            free=fit.free, search=WIDE_SEARCH, reach=reach, field=field,
            strip=Strip(width, fit.strip.blur_px),
        )  # fmt: skip
        return again if again is not None and _meets_more(again, fit) else fit

    if max(one_edge(fit)) > SUSPECT:
        seen = _as_seen(picture, fit)
        if seen is not None and _wider(seen[0], fit):
            fit = as_wide_as(*seen)
    for share in WIDER:
        met = one_edge_of_most(fit)
        if max(met) <= MOST:
            break
        x, y = (
            share * side if edge > DRAWN_ALONG else width
            for edge, side, width in zip(met, fit.grid.slab_size[::-1], fit.strip.width, strict=True)
        )
        fit = as_wide_as((x, y), fit.cam_from_ground)
    return fit


def _meets_more(again: Fit, fit: Fit) -> bool:
    """Whether joints that were measured anew are met at both edges rather than one, and as many of them.

    Joints that had a tone of their own, and are steps between two slabs' when measured anew, are met at none.
    """
    lost = any(now == 0 != then for now, then in zip(again.strip.polarity, fit.strip.polarity, strict=True))
    return not lost and max(one_edge(again)) < max(one_edge(fit)) and again.missed < fit.missed + MORE_MISSED


def met_at_one_edge(picture: Float[np.ndarray, "h w"], fit: Fit) -> float:
    """By what share of their contrast the sides of most joints differ, if they were met at one edge.

    Zero where profiles that reach far beyond them show joints that are no wider than the fit has them: then
    their rims look otherwise than their slabs, as rounded ones in the sun do.
    """
    share = max(one_edge_of_most(fit))
    seen = _as_seen(picture, fit) if share > MOST else None
    return share if seen is None or _wider(seen[0], fit) else 0.0


def _wider(width: tuple[float, float], fit: Fit) -> bool:
    """Whether joints of such widths are clearly wider than a fit has them, of either family."""
    return any(
        now > CLEARLY_WIDER * thought and now > 0.9 * SHARES[0] * side
        for now, thought, side in zip(width, fit.strip.width, fit.grid.slab_size[::-1], strict=True)
    )


def _as_seen(picture: Float[np.ndarray, "h w"], fit: Fit) -> tuple[tuple[float, float], Rigid] | None:
    """How wide the joints are in profiles that reach far beyond, and the pose at which the fit's lie on them.

    None where slabs of a size to tell are too few.
    """
    stations, camera, strip, side = fit.stations, fit.camera, fit.strip, np.array(fit.grid.slab_size)
    slab_px = projected_width_px(camera, fit.cam_from_ground, stations, (side[1], side[0]))
    reduced = max(1, round(float(np.median(slab_px)) / REDUCED_PX))
    if reduced > 1:
        size = (camera.width // reduced, camera.height // reduced)
        picture, camera = cv2.resize(picture, size, interpolation=cv2.INTER_AREA), camera.scaled(*size)
        slab_px = slab_px / reduced
        strip = replace(strip.resized(1.0 / reduced), blur_px=max(strip.blur_px / reduced, BLURS[0]))
    clear = (slab_px > SLABS_PX[0]) & (slab_px < SLABS_PX[1])
    if clear.sum() < FEWEST:
        return None
    rows = np.concatenate([sample(clear & (stations.family == family)) for family in (ALONG_X, ALONG_Y)])
    some, half = stations.take(rows), REACH * slab_px[rows]
    profiles = sample_profiles(picture, camera, fit.cam_from_ground, some, half)
    own = (strip.width[0] / side[1], strip.width[1] / side[0])
    shares = tuple(sorted({*own, *SHARES}))
    off_px, strip = first_look(profiles, some, strip, side, WIDE_SEARCH * slab_px[rows], shares)
    off = off_px / profiles.px_per_unit
    y, x = (float(np.median(np.r_[0.0, off[some.family == family]])) for family in (ALONG_X, ALONG_Y))
    return strip.width, with_origin(fit.cam_from_ground, x, y)
