"""Joints measured where they are projected: stations, their profiles, and the strips that these show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.ground.sides import ALONG_X, Grid, visible_sides
from autoreg.ground.stations import Stations, place_stations
from autoreg.joints.edges import LEAST_STRENGTH, Offsets, fit_offsets
from autoreg.joints.first_looks import first_look, joint_polarity, search_joints
from autoreg.joints.joint_looks import DARK, Strip, bloom_px, middle_px, projected_width_px, width_px_of
from autoreg.joints.look_estimates import estimate_strip
from autoreg.joints.profiles import Profiles, sample_profiles

# The widest search, in slab sides, that finds the joints for good.
NARROW = 0.04
# Where joints are neither dark nor light, those whose contrast, against the light around them, is below this
# part of what is usual are none.
FAINT = 0.1
# The most sides that are looked at, the largest ones in the picture: a known field is measured all over.
MOST_IN_VIEW, MOST_IN_FIELD = 6_000, 20_000
# What stations keep off the ends of their side, as a share of it: at least so much, and so much more than the
# width of the joint that crosses there, of which half lies within the side, and more where it is seen aslant.
LEAST_MARGIN, BESIDE_CROSSING = 0.1, 0.05
# What is seen on either side of a joint, and the farthest that profiles reach for wide ones, in pixels.
SHOULDERS_PX, WIDEST_HALF_PX = 6.0, 40.0
# ... and where nothing is known of the joints.
UNKNOWN_HALF_PX = 16.0
# The least that profiles reach while joints are searched and afterwards, and what is measured without search.
LEAST_SEARCH_PX, LEAST_HALF_PX, LEAST_REACH_PX = 10.0, 7.0, 1.5


@dataclass(frozen=True)
class Measured:
    """Where the joints of a lattice lie in the picture, station by station.

    The offsets are of the middles between the slabs' rims, along the stations' normals from where the pose
    has them. `across` is the side of a slab across each station's joint, in the unit of the pose.
    """

    stations: Stations
    profiles: Profiles
    offsets: Offsets
    usable: Bool[np.ndarray, " n"]
    strip: Strip
    across: Float[np.ndarray, " n"]


def measure(
    picture: Float[np.ndarray, "h w"],
    camera: Camera,
    pose: Rigid,
    grid: Grid,
    strip: Strip | None,
    *,
    search: float,
    reach: float,
    field: Float[np.ndarray, "k 2"] | None,
    limit: int,
) -> Measured | None:
    """The joints of a lattice, measured where a pose has them; None where too few can be.

    Joints of unknown looks are measured again with the looks that the first measurement told, and so are
    those that are found for good where they look otherwise than thought.

    Args:
        picture: grey levels that `camera` belongs to.
        camera: its camera.
        pose: cam_from_ground.
        grid: the lattice, in the unit of the pose.
        strip: looks of the joints, if known.
        search: half width of the search, in slab sides; 0 for joints that lie where they are predicted.
        reach: how far to look, in camera heights.
        field: where on the ground the paving is, a convex polygon; everywhere if None.
        limit: the most stations that are measured.
    """
    most = MOST_IN_VIEW if field is None else MOST_IN_FIELD
    sides = visible_sides(camera, pose, grid, reach=reach, field=field, limit=most)
    if len(sides) < 6:
        return None
    side = np.array(grid.slab_size)
    # What crosses a side is of the other family.
    x, y = (0.0, 0.0) if strip is None else strip.width
    crossing = np.where(sides.family == ALONG_X, y / side[0], x / side[1])
    margin = np.maximum(LEAST_MARGIN, BESIDE_CROSSING + crossing)
    stations = place_stations(sides, camera, pose, limit=limit, margin=margin)
    across = np.where(stations.family == ALONG_X, side[1], side[0])
    least = LEAST_SEARCH_PX if search else LEAST_HALF_PX
    half = _reach_of_profiles(camera, pose, stations, side, strip, least)
    profiles = sample_profiles(picture, camera, pose, stations, half + 3.0)
    reach_px = np.clip(search * (across * profiles.px_per_unit), LEAST_REACH_PX, least)
    known = strip is not None
    if strip is None:
        strip = Strip((0.02 * side[1], 0.02 * side[0]), 0.9)
        start, strip = first_look(profiles, stations, strip, side, reach_px)
    elif search:
        start = search_joints(profiles, stations, strip, reach_px)
    else:
        start = np.zeros(len(stations))
    widest_px = 2 * (half - SHOULDERS_PX + 3.0)

    def measured(
        start: Float[np.ndarray, " n"], strip: Strip
    ) -> tuple[Offsets, Bool[np.ndarray, " n"], Strip] | None:
        return _offsets_and_looks(profiles, stations, start, strip, widest_px, reach_px, side, known=known)

    found = measured(start, strip)
    again = not known or 0 < search <= NARROW
    if found is not None and again and not (known and found[2].like(strip)):
        offsets, _, strip = found
        found = measured(offsets.offset_px, strip)
    if found is None:
        return None
    offsets, usable, strip = found
    middle = middle_px(camera, pose, stations, profiles.normal, strip)
    offsets = replace(offsets, offset_px=offsets.offset_px - middle)
    bloom = bloom_px(offsets, stations, strip, usable)
    offsets = replace(offsets, offset_px=offsets.offset_px - bloom)
    return Measured(stations, profiles, offsets, usable, strip, across)


def _reach_of_profiles(
    camera: Camera,
    pose: Rigid,
    stations: Stations,
    side: Float[np.ndarray, "2"],
    strip: Strip | None,
    least: float,
) -> Float[np.ndarray, " n"]:
    """How far the profile of each station must reach to either side, in pixels."""
    if strip is None:
        # As wide as joints can be that nothing is known of, but clear of the neighbours.
        slab_px = projected_width_px(camera, pose, stations, (side[1], side[0]))
        return np.clip(0.35 * slab_px, least, UNKNOWN_HALF_PX)
    wide_px = projected_width_px(camera, pose, stations, strip.width)
    wide_px = np.maximum(wide_px, strip.least_px(stations))
    return np.clip(0.5 * wide_px + SHOULDERS_PX, least, WIDEST_HALF_PX)


def _offsets_and_looks(
    profiles: Profiles,
    stations: Stations,
    start: np.ndarray,
    strip: Strip,
    widest_px: np.ndarray,
    reach_px: np.ndarray,
    side: np.ndarray,
    *,
    known: bool,
) -> tuple[Offsets, np.ndarray, Strip] | None:
    """Offsets from a start, which of them can be used, and the joints' looks by those; None if too few.

    Looks that are `known` change little.
    """
    width_px = width_px_of(strip, stations, profiles)
    offsets = fit_offsets(profiles, start, np.minimum(width_px, widest_px), strip.blur_px)
    usable = (offsets.strength > LEAST_STRENGTH) & np.isfinite(offsets.offset_px)
    usable &= np.abs(offsets.offset_px) < reach_px + LEAST_REACH_PX
    if known:
        # A strip that is too narrow holds on to one edge.
        usable &= width_px <= widest_px
    polarity = strip.polarity
    if not strip.polarity_known:
        polarity = joint_polarity(profiles, stations, offsets.offset_px, strip, side)
    sign = np.array(polarity)[stations.family]
    usable &= (sign == 0) | (offsets.depth * sign > 0)
    contrast = (np.abs(offsets.depth) + 0.5 * np.abs(offsets.step)) / (profiles.values.mean(1) + DARK)
    if usable.any():
        usable &= (sign != 0) | (contrast > FAINT * np.median(contrast[usable]))
    if usable.sum() < 12:
        return None
    strip = replace(strip, polarity=polarity)
    strip = estimate_strip(profiles, offsets, stations, strip, usable, side, thorough=not known)
    return offsets, usable, strip
