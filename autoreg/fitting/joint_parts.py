"""Strips of three parts: a joint's bed, and beside it what one slab's rim or wall shows.

Across such a joint follow one slab's tone, that of the bed, that of the rim or wall, which all joints that
are seen alike share, and the other slab's. Mostly the bed is dark, and the other part in the light.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

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
    return _fitted(side, parts, _products(side, parts, _places(side, parts.width)))


def _fitted(
    side: Side, parts: Parts, products: Float[np.ndarray, "5 5 n k"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The same from the products along the profiles, which the tone of the part in the light leaves alone."""
    samples = side.weight.sum(1)[:, None]
    squares = np.maximum(_left_over(_in_tone(products, parts.tone), RIDGE * samples), 0.0) / samples
    best = np.clip(squares.argmin(1), 1, 2 * STEPS - 1)
    rows = np.arange(len(best))
    before, least, after = (squares[rows, best + k] for k in (-1, 0, 1))
    bend = before - 2.0 * least + after
    beyond = np.where(bend > 0, 0.5 * (before - after) / np.where(bend > 0, bend, 1.0), 0.0)
    beyond = np.clip(beyond, -1.0, 1.0)
    least = least - 0.25 * (before - after) * beyond
    return np.log(np.maximum(least, 0.0) + ROUGH**2), _step_px(side, parts.width) * (best - STEPS + beyond)


def bed_tone(side: Side, parts: Parts) -> float:
    """Tone of what a joint shows beside its part in the light, against the slabs': the median of all."""
    products = _products(side, parts, fit_parts(side, parts)[1][:, None])
    A = np.moveaxis(_in_tone(products, parts.tone)[..., 0], -1, 0)
    normal = A[:, :3, :3] + RIDGE * side.weight.sum(1)[:, None, None] * np.eye(3)
    tones = 1.0 + np.linalg.solve(normal, A[:, :3, 3:])[..., 0]
    return float(np.median(2.0 * tones[:, 2] / (tones[:, 0] + tones[:, 1])))


def _step_px(side: Side, width: float) -> Float[np.ndarray, " n"]:
    return (FARTHEST * width * side.px_per_unit + FARTHEST_PX) / STEPS


def _places(side: Side, width: float) -> Float[np.ndarray, "n k"]:
    """Places that are tried for joints of such a width, in pixels."""
    return _step_px(side, width)[:, None] * np.arange(-STEPS, STEPS + 1)


def _products(side: Side, parts: Parts, places_px: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "5 5 n k"]:
    """Weighted sums along profiles of the products of all that parts at some places look like, two by two.

    That is the near slab, the far slab, the bed and the part in the light, each by itself and of unit tone,
    and what the profiles have beyond the slabs' tone. Whatever tone the part in the light has, all that is
    asked of it is in these.
    """
    width, level, height, _ = parts
    at = single(side.away_px / side.blur_px)[:, None, :] - single(places_px / side.blur_px)[..., None]
    edges = single(0.5 * width * side.px_per_unit / side.blur_px)[:, None, None]
    near, far = edge(at + edges), edge(at - edges)
    lit = single(np.clip(level + height * side.slope, 0.0, 1.0))[:, None, None]
    light = edge(at - (1 - 2 * lit) * edges) - far if level or height else np.zeros_like(far)
    beyond = np.broadcast_to(single(side.tones - 1.0)[:, None, :], far.shape)
    looks, weight = (1 - near, far, near - far - light, light, beyond), single(side.weight)[:, None, :]
    products = np.empty((5, 5, *places_px.shape))
    for i, one in enumerate(looks):
        weighted = weight * one
        for j in range(i, 5):
            products[i, j] = products[j, i] = np.einsum("nkp,nkp->nk", weighted, looks[j])
    return products


def _in_tone(products: Float[np.ndarray, "5 5 n k"], tone: float) -> Float[np.ndarray, "4 4 n k"]:
    """The products of what the tones of near slab, far slab and bed add to profiles, and of what is left.

    The part in the light is so many times as light as both slabs on the mean, and adds to theirs.
    """
    shared = np.array(
        [[1, 0, 0, 0.5 * tone, 0], [0, 1, 0, 0.5 * tone, 0], [0, 0, 1, 0, 0], [0, 0, 0, 1 - tone, 1]]
    )
    return np.tensordot(shared, np.tensordot(shared, products, 1), (1, 1))


def _left_over(products: Float[np.ndarray, "4 4 n k"], ridge: np.ndarray) -> Float[np.ndarray, "n k"]:
    """What three columns leave of the weighted squares along profiles, their heights held by a ridge.

    By elimination, column by column, of all profiles at once.
    """
    left = products.copy()
    for i in range(3):
        pivot = left[i, i] + ridge
        for j in range(i + 1, 4):
            ratio = left[i, j] / pivot
            for k in range(j, 4):
                left[j, k] = left[j, k] - ratio * left[i, k]
    return left[3, 3]


def likelihood_of(side: Side) -> Callable[[Parts], float]:
    """Log likelihood of parts by the joints of a side, up to a constant; what was asked is kept."""
    values = 0.5 * INDEPENDENT * side.weight.sum(1)

    @cache
    def products(width: float, level: float, height: float) -> np.ndarray:
        return _products(side, Parts(width, level, height), _places(side, width))

    @cache
    def nats(parts: Parts) -> float:
        return -float(values @ _fitted(side, parts, products(*parts[:3]))[0])

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
