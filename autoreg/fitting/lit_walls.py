"""Sunk joints seen aslant, with the far slab's wall in the light beside what is left of their beds.

Such a joint has three parts in the picture: from the near slab's rim on its bed, and what of the wall is in
shadow; then the wall in the light, as light as the slabs or lighter; then the far slab. A strip of one tone
takes the dark part for the whole joint, and lies nearer by as much as the wall takes up; by more than half a
joint where the wall is the lighter one. A wall in the shade that is lighter than the bed does less of the
same. The near rim is seen in any case, and the joint's middle lies half a width beyond it. A strip of three
parts measures that, once all joints that are seen from one side have told how high the light reaches and how
light the wall is. The width it cannot tell: it is that of the joints which show more of themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int

from autoreg.fitting.bare_steps import across_slope
from autoreg.fitting.fit import Fit
from autoreg.fitting.full_width import width_from_above
from autoreg.fitting.lights import lights
from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.joints.edges import LEAST_STRENGTH
from autoreg.joints.joint_looks import Strip
from autoreg.joints.strips import INDEPENDENT, edge, single

# Joints seen from above, below this slope, show their beds whole, and say little where half are below the
# other; those in fewer blurs show no parts.
LEAST_SLOPE, LEAST_MEDIAN_SLOPE, LEAST_BLURS = 0.15, 0.3, 2.0
# How high the light reaches, in widths, and the wall's tones against the slabs' that are tried; at first
# these pairs of them.
HEIGHTS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.4)
WALLS = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0, 1.03, 1.06, 1.12, 1.18, 1.25, 1.4)
AT_FIRST = ((0.5, 0.6), (0.5, 0.95), (0.5, 1.12), (0.7, 1.0), (1.0, 0.95))
# So many joints tell both, at least and at most.
FEWEST, SAMPLE = 12, 60
# Places that are tried, from where a strip of one tone was found: as far as this share of the width and so
# many pixels, in so many steps either way.
FARTHEST, FARTHEST_PX, STEPS = 0.6, 0.5, 12
# Three parts must be so much likelier than one; where they are so much less likely at first, no others are
# tried.
LEAST_NATS, HOPELESS_NATS = 20.0, -40.0
# Joints that look narrower than this share of those across them, or light where those are dark, may well hide
# a part: so much likelier is enough for them.
NARROWER, LEAST_NATS_HIDING = 0.9, 5.0
# Other joints' widths tell that these hide a part; without that they may be as narrow as they look, by these
# shares of the width that a strip fits to all of them, blurred far ones among them.
AS_NARROW = (1.0, 0.9, 0.8, 0.7, 0.6)
# Three parts are a mistake where they leave the joints so many times as far from their lines (median), and
# farther by such a share of their width. On ray-traced photos with right ones it was 0.3 to 1.4 times, where
# they made things worse mostly 1.6 to 4.
ROUGHER, ROUGHER_WIDTHS = 1.5, 0.05
# Roughness of slabs that no profile is without, as a share of their tone.
ROUGH = 0.02
# Keeps tones of parts that are hidden finite.
RIDGE = 1e-3


@dataclass(frozen=True)
class _Side:
    """Profiles across the joints of one family that are seen from one side, away from the camera.

    `away_px` are the samples' places from where the joints were found, `tones` their grey levels in those of
    the slabs.
    """

    away_px: Float[np.ndarray, "n p"]
    tones: Float[np.ndarray, "n p"]
    weight: Float[np.ndarray, "n p"]
    px_per_unit: Float[np.ndarray, " n"]
    slope: Float[np.ndarray, " n"]
    blur_px: float

    def take(self, rows: Int[np.ndarray, " k"]) -> _Side:
        """Some of the joints."""
        return replace(
            self,
            away_px=self.away_px[rows],
            tones=self.tones[rows],
            weight=self.weight[rows],
            px_per_unit=self.px_per_unit[rows],
            slope=self.slope[rows],
        )


def beside_lit_walls(fit: Fit) -> Fit:
    """The fit with the middles of sunk joints measured by strips of three parts, where these are seen."""
    slope, width = across_slope(fit), _full_width(fit)
    lit, lined = lights(fit, np.arange(len(slope))), fit.usable | _taken_for_dark(fit)
    for family in np.unique(fit.stations.family):
        for way, light in product((-1.0, 1.0), lit):
            seen = lined & light & (fit.stations.family == family) & (way * slope > LEAST_SLOPE)
            rows = np.flatnonzero(seen)
            if not len(rows):
                continue
            side = _side_of(fit, rows, way, slope, width)
            looks = _looks_of(side, fit.strip, int(family), width)
            if looks is not None:
                measured = _measured(fit, rows, way, side, width, looks)
                fit = fit if _rougher(measured, fit, rows) else measured
    return fit


def _rougher(measured: Fit, fit: Fit, rows: Int[np.ndarray, " n"]) -> bool:
    """Whether joints that were measured before lie clearly farther from their lines by three parts.

    Dark walls beyond beds in the light have much the same profile, the other way round: then a width beyond
    the wrong rim moves near joints, where it is large in the picture, away from the far ones.
    """
    had = rows[fit.usable[rows]]
    if not len(had):
        return False
    was, now = (float(np.median(np.abs(f.followed_px()[had]))) for f in (fit, measured))
    width_px = fit.strip.width[fit.stations.family[had[0]]] * float(np.median(fit.profiles.px_per_unit[had]))
    return now > max(ROUGHER * was, was + ROUGHER_WIDTHS * width_px)


def _taken_for_dark(fit: Fit) -> Bool[np.ndarray, " n"]:
    """Stations of joints that were refused as they are dark, while most of their family are light.

    The steeper they are seen from above the more of their beds shows, which outweighs the light on the walls.
    """
    light = np.array([_lighter(fit.strip, family) for family in (ALONG_X, ALONG_Y)])[fit.stations.family]
    return light & ~fit.usable & (fit.offsets.strength > LEAST_STRENGTH) & (fit.offsets.depth < 0)


def _lighter(strip: Strip, family: int) -> bool:
    """Whether the joints of a family are light where those across them are dark."""
    return strip.polarity[family] > 0 > strip.polarity[1 - family]


def _looks_of(side: _Side, strip: Strip, family: int, width: float) -> tuple[float, float] | None:
    """How high the light reaches and how light the wall is; None if that does not show."""
    wide = np.flatnonzero(width * side.px_per_unit > LEAST_BLURS * side.blur_px)
    if len(wide) < FEWEST or np.median(side.slope[wide]) < LEAST_MEDIAN_SLOPE:
        return None
    own = strip.width[family]
    narrower = own < NARROWER * width
    least_nats = LEAST_NATS_HIDING if narrower or _lighter(strip, family) else LEAST_NATS
    plain = (own, width) if narrower else tuple(share * own for share in AS_NARROW)
    return _likeliest_looks(side.take(wide), plain, width, least_nats)


def _measured(
    fit: Fit,
    rows: Int[np.ndarray, " n"],
    way: float,
    side: _Side,
    width: float,
    looks: tuple[float, float],
) -> Fit:
    """The fit with the middles of one side's joints measured by strips of three parts."""
    parts = np.array_split(np.arange(len(rows)), -(-len(rows) // SAMPLE))
    farther = np.concatenate([_fitted(side.take(part), width, *looks)[1] for part in parts])
    offset, sigma = fit.offsets.offset_px[rows] + way * farther, fit.offsets.sigma_px[rows]
    rimmed, usable = fit.rimmed.copy(), fit.usable.copy()
    rimmed[rows] = usable[rows] = True
    return replace(fit.measured_at(rows, offset, sigma), rimmed=rimmed, usable=usable)


def _full_width(fit: Fit) -> float:
    """Width of the joints by the family that shows more of it: light walls are no joints among dark ones.

    It may be that either family hides a part.
    """
    dark = [w for w, sign in zip(fit.strip.width, fit.strip.polarity, strict=True) if sign < 0]
    return max(*(dark or fit.strip.width), width_from_above(fit) or 0.0)


def _side_of(
    fit: Fit, rows: Int[np.ndarray, " n"], way: float, slope: Float[np.ndarray, " s"], width: float
) -> _Side:
    profiles, blur = fit.profiles.take(rows), fit.strip.blur_px
    away = way * (profiles.at_px - fit.offsets.offset_px[rows][:, None])
    reach = 0.5 * width * profiles.px_per_unit + 3.0 * blur + 2.0
    weight = np.clip(reach[:, None] + 0.5 - np.abs(away), 0.0, 1.0)
    weight *= np.abs(profiles.at_px) <= profiles.room_px[:, None]
    values = profiles.values.astype(float)
    level = (weight * values).sum(1) / weight.sum(1)
    some = (weight > 0).any(0)
    return _Side(
        away[:, some],
        values[:, some] / level[:, None],
        weight[:, some],
        profiles.px_per_unit,
        np.abs(slope[rows]),
        blur,
    )


def _likeliest_looks(
    side: _Side, plain_widths: tuple[float, ...], width: float, least_nats: float
) -> tuple[float, float] | None:
    """How high the light reaches and how light the wall is; None if strips of one tone fit as well.

    These may have any of the `plain_widths`, the likeliest of which comes first. Climbs from the best of a
    few guesses over the values that are tried.
    """
    # The widest show their parts best; every other one of them, so that they are not all of the same slabs.
    widest = np.argsort(-side.px_per_unit, kind="stable")
    side = side.take(np.sort(widest[: 2 * SAMPLE : 2 if len(widest) > SAMPLE else 1]))
    values = 0.5 * INDEPENDENT * side.weight.sum(1)

    def of_one_tone(own_width: float) -> float:
        return float(values @ _fitted(side, own_width, 0.0, 1.0)[0])

    @cache
    def of_three_parts(looks: tuple[int, int]) -> float:
        height, wall = looks
        if not (0 <= height < len(HEIGHTS) and 0 <= wall < len(WALLS)):
            return np.inf
        return float(values @ _fitted(side, width, HEIGHTS[height], WALLS[wall])[0])

    best = min(((HEIGHTS.index(h), WALLS.index(w)) for h, w in AT_FIRST), key=of_three_parts)
    likeliest, *others = dict.fromkeys(plain_widths)
    plain = of_one_tone(likeliest)
    # Other widths could only make one tone likelier.
    if plain - of_three_parts(best) < HOPELESS_NATS:
        return None
    plain = min((plain, *map(of_one_tone, others)))
    if plain - of_three_parts(best) < HOPELESS_NATS:
        return None
    while True:
        h, w = best
        better = min(((h, w), (h - 1, w), (h + 1, w), (h, w - 1), (h, w + 1)), key=of_three_parts)
        if better == best:
            break
        best = better
    return (HEIGHTS[best[0]], WALLS[best[1]]) if plain - of_three_parts(best) > least_nats else None


def _fitted(
    side: _Side, width: float, height: float, wall: float
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Logarithm of each profile's unexplained variance, and the place at which least is left.

    The tones of both slabs and of the dark part are free, the wall's is a multiple of the slabs' mean.
    """
    blur, wide = side.blur_px, width * side.px_per_unit
    every = (FARTHEST * wide + FARTHEST_PX) / STEPS
    places = every[:, None] * np.arange(-STEPS, STEPS + 1)
    at = (side.away_px[:, None, :] - places[..., None]) / blur
    edges = wide[:, None, None] / blur
    lit = np.minimum(height * side.slope, 1.0)[:, None, None]
    near, far = (edge(single(at + way * 0.5 * edges))[0] for way in (1.0, -1.0))
    wall_begins = edge(single(at - (0.5 - lit) * edges))[0] if height else far
    shared = np.float32(0.5 * wall) * (wall_begins - far)
    # What each tone, beyond that of the slabs on the whole, adds to a profile.
    parts = np.stack([1.0 - near + shared, far + shared, near - wall_begins], -2)
    lighter = np.float32(wall - 1.0) * (wall_begins - far)
    left = single(side.tones - 1.0)[:, None, :] - lighter
    weighted = parts * single(side.weight)[:, None, None, :]
    normal = (weighted @ parts.swapaxes(-1, -2)).astype(float)
    samples = side.weight.sum(1)
    normal[..., range(3), range(3)] += RIDGE * samples[:, None, None]
    right = (weighted @ left[..., None]).astype(float)
    explained = (right * np.linalg.solve(normal, right)).sum((-2, -1))
    total = np.einsum("np,nkp,nkp->nk", single(side.weight), left, left).astype(float)
    squares = np.maximum(total - explained, 0.0) / samples[:, None]
    best = np.clip(squares.argmin(1), 1, 2 * STEPS - 1)
    rows = np.arange(len(best))
    before, least, after = (squares[rows, best + k] for k in (-1, 0, 1))
    bend = before - 2.0 * least + after
    beyond = np.where(bend > 0, 0.5 * (before - after) / np.where(bend > 0, bend, 1.0), 0.0)
    beyond = np.clip(beyond, -1.0, 1.0)
    least = least - 0.25 * (before - after) * beyond
    return np.log(np.maximum(least, 0.0) + ROUGH**2), every * (best - STEPS + beyond)
