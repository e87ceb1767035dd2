"""Strips of three parts: a joint's bed, and beside it what one slab's rim or wall shows.

Across such a joint follow one slab's tone, that of the bed, that of the rim or wall, which all joints that
are seen alike share, and the other slab's. Mostly the bed is dark, and the other part in the light.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int

from autoreg.fitting.fit import Fit
from autoreg.joints.strips import INDEPENDENT, edge, single

# Places that are tried, from where a strip of one tone was found: as far as this share of the width and so
# many pixels, in so many steps either way.
FARTHEST, FARTHEST_PX, STEPS = 0.6, 0.5, 12
# So many joints tell how all that are seen alike divide, at least and at most.
FEWEST, SAMPLE = 12, 60
# Roughness of slabs that no profile is without, as a share of their tone.
ROUGH = 0.02
# Keeps tones of parts that are hidden finite.
RIDGE = 1e-3


class Parts(NamedTuple):
    """How a joint of such a width divides.

    In the light is a share of it, `level`, and so much more, `height`, for every unit of the slope of the
    view. `tone` is that of the part in the light against the slabs'.
    """

    width: float
    level: float = 0.0
    height: float = 0.0
    tone: float = 1.0


@dataclass(frozen=True)
class Side:
    """Profiles across the joints of one family, towards the slabs whose rims may be in the light.

    `away_px` are the samples' places from where the joints were found, `tones` their grey levels in those of
    the slabs. The `slope` is positive where those slabs are the far ones.
    """

    away_px: Float[np.ndarray, "n p"]
    tones: Float[np.ndarray, "n p"]
    weight: Float[np.ndarray, "n p"]
    px_per_unit: Float[np.ndarray, " n"]
    slope: Float[np.ndarray, " n"]
    blur_px: float

    def take(self, rows: Int[np.ndarray, " k"]) -> Side:
        """Some of the joints."""
        return replace(
            self,
            away_px=self.away_px[rows],
            tones=self.tones[rows],
            weight=self.weight[rows],
            px_per_unit=self.px_per_unit[rows],
            slope=self.slope[rows],
        )

    def widest(self) -> Side:
        """The joints that show their parts best.

        Every other one of these, where there are more, so that they are not all of the same slabs.
        """
        order = np.argsort(-self.px_per_unit, kind="stable")
        return self.take(np.sort(order[: 2 * SAMPLE : 2 if len(order) > SAMPLE else 1]))


def side_of(
    fit: Fit, rows: Int[np.ndarray, " n"], way: float, slope: Float[np.ndarray, " s"], width: float
) -> Side:
    """The profiles of some stations, along their normals or against them, as far as such joints reach."""
    profiles, blur = fit.profiles.take(rows), fit.strip.blur_px
    away = way * (profiles.at_px - fit.offsets.offset_px[rows][:, None])
    reach = 0.5 * width * profiles.px_per_unit + 3.0 * blur + 2.0
    weight = np.clip(reach[:, None] + 0.5 - np.abs(away), 0.0, 1.0)
    weight *= np.abs(profiles.at_px) <= profiles.room_px[:, None]
    values = profiles.values.astype(float)
    level = (weight * values).sum(1) / weight.sum(1)
    some = (weight > 0).any(0)
    return Side(
        away[:, some],
        values[:, some] / level[:, None],
        weight[:, some],
        profiles.px_per_unit,
        way * slope[rows],
        blur,
    )


def fit_parts(side: Side, parts: Parts) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Logarithm of each profile's unexplained variance, and the place at which least is left.

    The tones of both slabs and of the dark part are free, that of the part in the light is a multiple of the
    slabs' mean.
    """
    every = (FARTHEST * parts.width * side.px_per_unit + FARTHEST_PX) / STEPS
    columns, left = _drawn(side, parts, every[:, None] * np.arange(-STEPS, STEPS + 1))
    weight, samples = single(side.weight)[:, None, :], side.weight.sum(1)[:, None]
    total = _dot(weight * left, left)
    squares = np.maximum(total - _explained(columns, weight, left, RIDGE * samples), 0.0) / samples
    best = np.clip(squares.argmin(1), 1, 2 * STEPS - 1)
    rows = np.arange(len(best))
    before, least, after = (squares[rows, best + k] for k in (-1, 0, 1))
    bend = before - 2.0 * least + after
    beyond = np.where(bend > 0, 0.5 * (before - after) / np.where(bend > 0, bend, 1.0), 0.0)
    beyond = np.clip(beyond, -1.0, 1.0)
    least = least - 0.25 * (before - after) * beyond
    return np.log(np.maximum(least, 0.0) + ROUGH**2), every * (best - STEPS + beyond)


def bed_tone(side: Side, parts: Parts) -> float:
    """Tone of what a joint shows beside its part in the light, against the slabs': the median of all."""
    columns, left = _drawn(side, parts, fit_parts(side, parts)[1][:, None])
    A = np.stack(columns, -1)[:, 0].astype(float)
    weighted = side.weight[..., None] * A
    normal = weighted.swapaxes(1, 2) @ A + RIDGE * side.weight.sum(1)[:, None, None] * np.eye(len(columns))
    tones = 1.0 + np.linalg.solve(normal, weighted.swapaxes(1, 2) @ left.astype(float).swapaxes(1, 2))[..., 0]
    return float(np.median(2.0 * tones[:, 2] / (tones[:, 0] + tones[:, 1])))


def _drawn(
    side: Side, parts: Parts, places_px: Float[np.ndarray, "n k"]
) -> tuple[tuple[Float32[np.ndarray, "n k p"], ...], Float32[np.ndarray, "n k p"]]:
    """What the near slab's, the far slab's and the bed's tone add to profiles of joints at some places.

    The tones are those beyond the slabs' on the whole. With them what is left of the profiles for these.
    """
    width, level, height, tone = parts
    at = single(side.away_px / side.blur_px)[:, None, :] - single(places_px / side.blur_px)[..., None]
    edges = single(0.5 * width * side.px_per_unit / side.blur_px)[:, None, None]
    near, far = edge(at + edges), edge(at - edges)
    lit = single(np.clip(level + height * side.slope, 0.0, 1.0))[:, None, None]
    light = edge(at - (1 - 2 * lit) * edges) - far if level or height else np.zeros_like(far)
    shared = np.float32(0.5 * tone) * light
    left = single(side.tones - 1.0)[:, None, :] - np.float32(tone - 1.0) * light
    return (1 - near + shared, far + shared, near - far - light), left


def _explained(
    columns: Sequence[np.ndarray], weight: np.ndarray, left: np.ndarray, ridge: np.ndarray
) -> Float[np.ndarray, "n k"]:
    """What columns explain of the weighted squares along profiles, their heights held by a ridge.

    By elimination, column by column, of all profiles at once.
    """
    weighted, count = [weight * column for column in columns], len(columns)
    right = [_dot(column, left) for column in weighted]
    normal = {(i, j): _dot(weighted[i], columns[j]) for i in range(count) for j in range(i, count)}
    explained = np.zeros(right[0].shape)
    for i in range(count):
        pivot = normal[i, i] + ridge
        explained += right[i] ** 2 / pivot
        for j in range(i + 1, count):
            ratio = normal[i, j] / pivot
            right[j] = right[j] - ratio * right[i]
            for k in range(j, count):
                normal[j, k] = normal[j, k] - ratio * normal[i, k]
    return explained


def _dot(a: np.ndarray, b: np.ndarray) -> Float[np.ndarray, "n k"]:
    """Sums of products along profiles."""
    return np.einsum("nkp,nkp->nk", a, b).astype(float)


def likelihood_of(side: Side) -> Callable[[Parts], float]:
    """Log likelihood of parts by the joints of a side, up to a constant; what was asked is kept."""
    values = 0.5 * INDEPENDENT * side.weight.sum(1)

    @cache
    def nats(parts: Parts) -> float:
        return -float(values @ fit_parts(side, parts)[0])

    return nats


def climbed(
    nats: Callable[[Parts], float],
    parts: Callable[..., Parts],
    tried: tuple[tuple[float, ...], ...],
    first: tuple[tuple[float, ...], ...],
    steps: Iterable[tuple[int, ...]],
) -> Parts:
    """The likeliest parts: climbs from the best of a few looks over the values that are `tried`.

    `parts` makes them of a look, a value of each kind; `steps` lead to the looks that are next to one.
    """
    steps = tuple(steps)

    def look(place: tuple[int, ...]) -> Parts:
        return parts(*(values[k] for values, k in zip(tried, place, strict=True)))

    def likelihood(place: tuple[int, ...]) -> float:
        return nats(look(place))

    starts = [tuple(values.index(v) for values, v in zip(tried, looks, strict=True)) for looks in first]
    best = max(starts, key=likelihood)
    while True:
        around = (tuple(k + by for k, by in zip(best, step, strict=True)) for step in steps)
        inside = [p for p in around if all(0 <= k < len(v) for k, v in zip(p, tried, strict=True))]
        better = max(inside, key=likelihood)
        if likelihood(better) <= likelihood(best):
            return look(best)
        best = better
