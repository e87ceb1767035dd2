"""What the joints of a photo look like: how wide they are, whether dark or light, and how blurred."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.ground.points import lengths, project_ground
from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.ground.stations import Stations
from autoreg.joints.edges import Offsets, fit_offsets, search_offsets, strip_misfits
from autoreg.joints.profiles import Profiles

# Joint widths, in slab sides, and blurs in pixels that are tried where nothing is known of them, ...
WIDTHS = np.geomspace(0.004, 0.16, 14)
BLURS = np.array([0.5, 0.65, 0.8, 1.0, 1.3, 1.7, 2.2, 2.9, 3.8, 5.0, 6.5])
# ... and the factors that are tried of what is known, up to the widest joints that slabs have.
NEARBY, WIDEST = np.array([0.72, 0.86, 1.0, 1.16, 1.4]), 0.3
# Joint widths, in slab sides, that are tried at first, and by how much a wider one must lower the mean log
# variance: a bare step fits the edge of any.
FIRST_SHARES, WIDER = (0.006, 0.015, 0.035, 0.08), 0.03
# Looks that change by less have settled.
SETTLED = 0.03
# Joint width, in slab sides, where tiles meet without a joint.
NO_JOINT = 0.001
# A strip laid beside a bare step has half the step's depth; a joint between two tones has more than this.
LINED = 0.7
# Joints that are neither dark nor light are not wider than this.
MOST_NEUTRAL = 0.05
# A strip has one tone more than a step to fit noise with, of about ten independent values: what that buys, in
# mean log variance; and the part of the variance that it must explain, lest it only bend a step's shape.
NO_JOINT_BONUS, NO_JOINT_GAIN = 0.1, 0.01
# By how much wider a blur is tried with either idea.
WIDER_BLURS = np.array([1.0, 1.3, 1.7])
# Edges up and down that tell how far bright tiles bloom: so many of either, and such a share of a family's.
LEAST_KIND, KIND_SHARE = 8, 0.2
# Profiles are shaded where a slope of light lowers their mean log variance by more than this: noise alone
# is lowered by a tenth.
SHADED = 0.3
# Grey levels that even the deepest shadow has.
DARK = 8.0
# Stations of either family that tell the looks.
SAMPLE = 90


@dataclass(frozen=True)
class Strip:
    """What a joint looks like: its width on the ground for either family, and the picture's blur.

    `polarity` is -1 where a family's joints are darker than their slabs, +1 where they are lighter, and 0
    where they are neither (tiles of two tones that meet without a joint); once known, it is not asked again.
    Where the camera moved while the shutter was open, no joint of a family looks narrower than `smear_px`. In
    soft shadows and reflections the profiles are `shaded`: light falls off over them.
    """

    width: tuple[float, float]
    blur_px: float
    polarity: tuple[int, int] = (0, 0)
    polarity_known: bool = False
    smear_px: tuple[float, float] = (0.0, 0.0)
    shaded: bool = False

    def like(self, other: Strip) -> bool:
        """Whether widths and blur are the same but for a few percent."""
        mine, theirs = ((*strip.width, strip.blur_px, *strip.smear_px) for strip in (self, other))
        return bool(np.allclose(mine, theirs, rtol=SETTLED))

    def resized(self, scale: float) -> Strip:
        """The looks, but for the blur, in a picture so many times as large."""
        x, y = self.smear_px
        return replace(self, smear_px=(scale * x, scale * y))

    @property
    def smeared(self) -> bool:
        """Whether the joints of either family are."""
        return any(self.smear_px)

    def least_px(self, stations: Stations) -> Float[np.ndarray, " n"]:
        """Width in pixels that no station's joint looks narrower than."""
        return np.where(stations.family == ALONG_X, *self.smear_px)


def width_px_of(strip: Strip, stations: Stations, profiles: Profiles) -> Float[np.ndarray, " n"]:
    """Width of each station's joint in pixels."""
    own = np.where(stations.family == ALONG_X, *strip.width) * profiles.px_per_unit
    return np.maximum(own, strip.least_px(stations))


def projected_width_px(
    camera: Camera, pose: Rigid, stations: Stations, width: tuple[float, float]
) -> Float[np.ndarray, " n"]:
    """What a width on the ground, across the joints of either family, is in the picture."""
    far, near = _edges_px(camera, pose, stations, width)
    return np.nan_to_num(lengths(far - near))


def _edges_px(
    camera: Camera, pose: Rigid, stations: Stations, width: tuple[float, float]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Where half a width on the ground beyond each station, and half a width before it, are seen."""
    half = 0.5 * np.where(stations.family == ALONG_X, width[0], width[1])
    across = half[:, None] * stations.direction[:, ::-1]
    far, near = (project_ground(camera, pose, stations.ground + way * across) for way in (1.0, -1.0))
    return far, near


def middle_px(
    camera: Camera, pose: Rigid, stations: Stations, normal: Float[np.ndarray, "n 2"], strip: Strip
) -> Float[np.ndarray, " n"]:
    """How far the middle of a joint's two edges lies off its centre line in the picture, along the normal.

    The nearer half of a joint looks wider than the farther one.
    """
    centre = project_ground(camera, pose, stations.ground)
    far, near = _edges_px(camera, pose, stations, strip.width)
    return ((0.5 * (far + near) - centre) * normal).sum(1)


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


def estimate_strip(
    profiles: Profiles,
    offsets: Offsets,
    stations: Stations,
    strip: Strip,
    usable: np.ndarray,
    side: np.ndarray,
    *,
    thorough: bool,
) -> Strip:
    """Joint width of either family and blur, by least squares over a sample of the stations.

    Near what is known of them, unless `thorough`.
    """
    width, smear, blur, shaded = list(strip.width), list(strip.smear_px), strip.blur_px, strip.shaded
    samples = [sample(usable & (stations.family == family)) for family in (ALONG_X, ALONG_Y)]
    for family, rows in enumerate(samples):
        if len(rows) < 6:
            continue
        across = side[1] if family == ALONG_X else side[0]
        if not thorough and strip.polarity[family] == 0 and width[family] < 1.5 * NO_JOINT * across:
            # Tiles that met without a joint still do.
            continue
        known = not thorough and strip.polarity[family] != 0
        options = (
            across * np.clip(width[family] / across * NEARBY, WIDTHS[0], WIDEST) if known else across * WIDTHS
        )
        if strip.polarity[family] == 0:
            # Between tones that only step up and down, a wide strip fits whatever else is near.
            options = options[options < MOST_NEUTRAL * across]
        scale, offset_px = profiles.px_per_unit[rows], offsets.offset_px[rows]
        widths_px = np.maximum(options[:, None] * scale, smear[family])
        width[family] = _likeliest(profiles, rows, offset_px, options, widths_px, blur, shaded)
        if smear[family] > 0.0:
            options = smear[family] * NEARBY
            widths_px = np.maximum(width[family] * scale, options[:, None])
            smear[family] = _likeliest(profiles, rows, offset_px, options, widths_px, blur, shaded)
        if strip.polarity[family] == 0:
            # Tiles may meet without a joint: a width would then let the edge sit at either of its sides.
            # The two ideas are each given their own offsets and blur before they are compared.
            edge_px = offset_px + _to_edge_px(offsets, rows, strip.width[family] * scale)
            ideas = np.array([max(width[family], 0.015 * across), NO_JOINT * across])
            starts = np.stack([offset_px, edge_px])
            misfits = _idea_misfits(profiles.take(rows), starts, ideas, blur, shaded)
            gain = float(np.exp(misfits[1]) - np.exp(misfits[0]))
            if misfits[1] < misfits[0] + NO_JOINT_BONUS or gain < NO_JOINT_GAIN:
                width[family] = NO_JOINT * across
    rows = np.concatenate(samples)
    strip = replace(strip, width=(width[0], width[1]), smear_px=(smear[0], smear[1]))
    blurs = BLURS if thorough else np.clip(blur * NEARBY, BLURS[0], BLURS[-1])
    width_px, offset_px = width_px_of(strip, stations, profiles)[rows], offsets.offset_px[rows]
    widths_px = np.tile(width_px, (len(blurs), 1))
    return replace(strip, blur_px=_likeliest(profiles, rows, offset_px, blurs, widths_px, blurs, shaded))


def sample(mask: Bool[np.ndarray, " n"], most: int = SAMPLE) -> Int[np.ndarray, " k"]:
    """Index of at most so many of the stations that a mask selects, spread evenly over them."""
    rows = np.flatnonzero(mask)
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(int)] if len(rows) else rows


def _to_edge_px(
    offsets: Offsets, rows: Int[np.ndarray, " n"], width_px: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """How far the one edge of some stations lies off the middle of a strip that was laid beside it.

    Zero where the strip's tone lies halfway between those of its slabs, half its width where it is one's.
    """
    depth, step = offsets.depth[rows], offsets.step[rows]
    return -width_px * np.clip(depth / np.where(step == 0.0, np.inf, step), -0.5, 0.5)


def _idea_misfits(
    profiles: Profiles,
    start_px: Float[np.ndarray, "k n"],
    width: Float[np.ndarray, " k"],
    blur: float,
    shaded: bool,
) -> Float[np.ndarray, " k"]:
    """Misfit of each joint width with the blur that suits it best: a blurred step is like a narrow strip."""
    (k, n), b = start_px.shape, len(WIDER_BLURS)
    blurs = np.tile(blur * WIDER_BLURS, k)
    width_px = np.repeat(width[:, None] * profiles.px_per_unit, b, axis=0)
    # All at once: the arrays are small, and each operation on them has its price.
    every = profiles.take(np.tile(np.arange(n), k * b))
    starts, widths = np.repeat(start_px, b, axis=0), width_px.ravel()
    own = fit_offsets(every, starts.ravel(), widths, np.repeat(blurs, n), iterations=4)
    offset_px = own.offset_px.reshape(k * b, n)
    misfits = strip_misfits(profiles, np.arange(n), offset_px, width_px, blurs, shaded=shaded)
    return misfits.reshape(k, b).min(1)


def _likeliest(
    profiles: Profiles,
    rows: Int[np.ndarray, " n"],
    offset_px: Float[np.ndarray, " n"],
    options: Float[np.ndarray, " k"],
    widths_px: Float[np.ndarray, "k n"],
    blurs: float | Float[np.ndarray, " k"],
    shaded: bool,
) -> float:
    """The option whose widths and blur explain some stations' profiles best."""
    costs = strip_misfits(
        profiles, rows, offset_px, widths_px, np.broadcast_to(blurs, options.shape), shaded=shaded
    )
    if np.ptp(costs) == 0.0:
        # A smear may be wider than the joints are by any option.
        return float(np.median(options))
    return _lowest(np.log(options), costs)


def _lowest(log_at: np.ndarray, cost: np.ndarray) -> float:
    """Place of the minimum, by a parabola through the lowest value and its neighbours."""
    # Options that were clipped to the same bound are one.
    log_at, first = np.unique(log_at, return_index=True)
    cost = cost[first]
    if len(cost) < 3:
        return float(np.exp(log_at[cost.argmin()]))
    i = int(np.clip(cost.argmin(), 1, len(cost) - 2))
    (x0, x1, x2), (y0, y1, y2) = log_at[i - 1 : i + 2], cost[i - 1 : i + 2]
    if cost.argmin() != i:
        return float(np.exp(log_at[cost.argmin()]))
    bend = (y2 - y1) / (x2 - x1) - (y1 - y0) / (x1 - x0)
    slope = (y2 - y0) / (x2 - x0)
    return float(np.exp(np.clip(x1 - 0.5 * slope * (x2 - x0) / max(bend, 1e-12), x0, x2)))


def bloom_px(
    offsets: Offsets, stations: Stations, strip: Strip, usable: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """How far each station's offset is pushed towards the darker slab, where tiles meet without a joint.

    A blurred edge whose brighter side is overexposed, or that was blurred before the light was encoded by a
    curve, looks displaced: all bright tiles look larger. The two kinds of edge, up and down, tell it by the
    difference of their offsets, each family by itself; where a family has one kind alone it cannot be told.
    """
    up = np.sign(offsets.step)
    bloom = np.zeros(len(up))
    for family in (ALONG_X, ALONG_Y):
        if strip.polarity[family] != 0:
            continue
        members = usable & (stations.family == family)
        kinds = [offsets.offset_px[members & (up == way)] for way in (1.0, -1.0)]
        if min(len(kind) for kind in kinds) >= max(LEAST_KIND, KIND_SHARE * members.sum()):
            half = 0.5 * float(np.median(kinds[0]) - np.median(kinds[1]))
            bloom += half * up * (stations.family == family)
    return bloom
