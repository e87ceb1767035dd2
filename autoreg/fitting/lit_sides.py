"""Joints measured with what of their far slabs lies in the light: sunk ones' walls, and bevelled rims.

A strip of one tone takes a joint's dark part for the whole of it, and so lies too near by as much as the part
in the light takes up. A strip of three parts measures the joint from rim to rim, once all joints that are
seen from one side have told how they divide.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from autoreg.fitting.bare_steps import across_slope
from autoreg.fitting.fit import Fit
from autoreg.fitting.full_width import width_from_above
from autoreg.fitting.joint_parts import Parts, Side, fit_parts, side_of
from autoreg.fitting.lights import lights
from autoreg.fitting.lit_bevels import WIDEST, bevelled
from autoreg.fitting.lit_walls import lighter, walled
from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.joints.edges import LEAST_STRENGTH

# Joints seen from above, below this slope, show their beds whole.
LEAST_SLOPE = 0.15
# So many joints are measured at a time.
BATCH = 60
# Three parts are a mistake where they leave the joints so many times as far from their lines (median), and
# farther by such a share of their width. On ray-traced photos with right ones it was 0.3 to 1.4 times, where
# they made things worse mostly 1.6 to 4.
ROUGHER, ROUGHER_WIDTHS = 1.5, 0.05


class _Looked(NamedTuple):
    """Joints of one family, seen along their normals or against them, and the parts that they show."""

    rows: Int[np.ndarray, " n"]
    way: float
    side: Side
    parts: Parts


def beside_lit_sides(fit: Fit) -> Fit:
    """The fit with the middles of joints measured by strips of three parts, where these are seen."""
    slope, width = across_slope(fit), _full_width(fit)
    lit, lined = lights(fit, np.arange(len(slope))), fit.usable | _taken_for_dark(fit)
    for family, light in product(np.unique(fit.stations.family).tolist(), lit):
        rows = np.flatnonzero(lined & light & (fit.stations.family == family))
        if not len(rows):
            continue
        walls = {way: _walled(fit, rows, way, slope, width) for way in (-1.0, 1.0)}
        bevel = _bevelled(fit, rows, slope, walls)
        if bevel is not None:
            beyond = _measured(fit, bevel, bevel.parts.level * bevel.parts.width)
            if not _rougher(beyond, fit, rows, together=True):
                fit = beyond
                continue
        for wall in walls.values():
            if wall is not None:
                beyond = _measured(fit, wall)
                fit = fit if _rougher(beyond, fit, wall.rows) else beyond
    return fit


def _walled(
    fit: Fit, rows: Int[np.ndarray, " n"], way: float, slope: Float[np.ndarray, " s"], width: float
) -> _Looked | None:
    """Those of some joints that are seen from one side, if walls of theirs are in the light."""
    seen = rows[way * slope[rows] > LEAST_SLOPE]
    if not len(seen):
        return None
    side = side_of(fit, seen, way, slope, width)
    parts = walled(side, fit.strip, int(fit.stations.family[seen[0]]), width)
    return None if parts is None else _Looked(seen, way, side, parts)


def _bevelled(
    fit: Fit, rows: Int[np.ndarray, " n"], slope: Float[np.ndarray, " s"], walls: dict[float, _Looked | None]
) -> _Looked | None:
    """Some joints of a family with the likeliest bevels, if any are in the light."""
    family = int(fit.stations.family[rows[0]])
    across = fit.grid.slab_size[1 if family == ALONG_X else 0]
    found: list[tuple[float, _Looked]] = []
    for way, wall in walls.items():
        side = side_of(fit, rows, way, slope, WIDEST * fit.strip.width[family])
        look = bevelled(side, fit.strip, family, across, None if wall is None else wall.parts)
        if look is not None:
            found.append((look[0], _Looked(rows, way, side, look[1])))
    return max(found, key=lambda each: each[0])[1] if found else None


def _rougher(measured: Fit, fit: Fit, rows: Int[np.ndarray, " n"], *, together: bool = False) -> bool:
    """Whether joints that were measured before lie clearly farther from their lines by three parts.

    Dark walls beyond beds in the light have much the same profile, the other way round: then a width beyond
    the wrong rim moves near joints, where it is large in the picture, away from the far ones. Bevels move all
    joints `together`, from lines that had followed their dark parts.
    """
    had = rows[fit.usable[rows]]
    if not len(had):
        return False
    off = (f.followed_px()[had] for f in (fit, measured))
    was, now = (float(np.median(np.abs(px - together * np.median(px)))) for px in off)
    width_px = fit.strip.width[fit.stations.family[had[0]]] * float(np.median(fit.profiles.px_per_unit[had]))
    return now > max(ROUGHER * was, was + ROUGHER_WIDTHS * width_px)


def _taken_for_dark(fit: Fit) -> Bool[np.ndarray, " n"]:
    """Stations of joints that were refused as they are dark, while most of their family are light.

    The steeper they are seen from above the more of their beds shows, which outweighs the light on the walls.
    """
    light = np.array([lighter(fit.strip, family) for family in (ALONG_X, ALONG_Y)])[fit.stations.family]
    return light & ~fit.usable & (fit.offsets.strength > LEAST_STRENGTH) & (fit.offsets.depth < 0)


def _measured(fit: Fit, looked: _Looked, bevel: float = 0.0) -> Fit:
    """The fit with the middles of some joints measured by strips of three parts, up to bevels so wide."""
    rows, way, side, parts = looked
    batches = np.array_split(np.arange(len(rows)), -(-len(rows) // BATCH))
    farther = np.concatenate([fit_parts(side.take(batch), parts)[1] for batch in batches])
    offset, sigma = fit.offsets.offset_px[rows] + way * farther, fit.offsets.sigma_px[rows]
    rimmed, usable, bevels = fit.rimmed.copy(), fit.usable.copy(), fit.bevel.copy()
    rimmed[rows] = usable[rows] = True
    bevels[rows] = bevel
    return replace(fit.measured_at(rows, offset, sigma), rimmed=rimmed, usable=usable, bevel=bevels)


def _full_width(fit: Fit) -> float:
    """Width of the joints by the family that shows more of it: light walls are no joints among dark ones.

    It may be that either family hides a part.
    """
    dark = [w for w, sign in zip(fit.strip.width, fit.strip.polarity, strict=True) if sign < 0]
    return max(*(dark or fit.strip.width), width_from_above(fit) or 0.0)
