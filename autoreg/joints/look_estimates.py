"""Joint widths and blur, by least squares over a sample of the profiles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.ground.stations import Stations
from autoreg.joints.edges import Offsets, fit_offsets, strip_misfits
from autoreg.joints.joint_looks import BLURS, NO_JOINT, Strip, sample, width_px_of
from autoreg.joints.profiles import Profiles

# Joint widths, in slab sides, that are tried where nothing is known of them, ...
WIDTHS = np.geomspace(0.004, 0.16, 14)
# ... and the factors that are tried of what is known, up to the widest joints that slabs have.
NEARBY, WIDEST = np.array([0.72, 0.86, 1.0, 1.16, 1.4]), 0.3
# Joints that are neither dark nor light are not wider than this.
MOST_NEUTRAL = 0.05
# A strip has one tone more than a step to fit noise with, of about ten independent values: what that buys, in
# mean log variance; and the part of the variance that it must explain, lest it only bend a step's shape.
NO_JOINT_BONUS, NO_JOINT_GAIN = 0.1, 0.01
# By how much wider a blur is tried with either idea.
WIDER_BLURS = np.array([1.0, 1.3, 1.7])


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
