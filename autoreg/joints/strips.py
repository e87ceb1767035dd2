"""The model of a joint's grey-level profile: a blurred strip of one tone between two slabs."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int

from autoreg.joints.profiles import STEP_PX, Profiles

# Neighbouring pixels of texture and of the lens's blur are not independent: the number of free values in a
# profile is about this share of its samples.
INDEPENDENT = 0.5 * STEP_PX
# Variance of grey levels that every mean profile has, whatever it looks like.
NOISE_FLOOR = 0.02
# So many profiles are fitted at a time: what a processor's cache holds.
BATCH = 512
# Places that move by less than this have converged.
STILL_PX = 1e-3
# Those that move are looked at by themselves where they are at most this part of the profiles.
MOST_LEFT = 0.6


class Window(NamedTuple):
    """Places, values and weights of the samples that are looked at, a row for each profile."""

    at: np.ndarray
    values: np.ndarray
    weight: np.ndarray


def batches(
    profiles: Profiles,
    start_px: Float[np.ndarray, " n"],
    width_px: Float[np.ndarray, " n"],
    blur: float | Float[np.ndarray, " n"],
) -> Iterator[tuple[np.ndarray, Window]]:
    """Rows of profiles that are fitted together, and what is looked at: each joint and its shoulders."""
    reach = 0.5 * width_px + 3.0 * blur + 1.5
    order = np.argsort(reach, kind="stable")
    for rows in np.array_split(order, max(1, round(len(order) / BATCH))):
        if len(rows):
            yield rows, _window(profiles, rows, start_px[rows], reach[rows])


def _window(profiles: Profiles, rows: np.ndarray, start: np.ndarray, reach: np.ndarray) -> Window:
    """Places, values and weights of some profiles' samples within reach of where their joints may lie."""
    count = len(profiles.at_px)
    # Of joints that may lie beyond a profile's end, what is seen is its end.
    start = np.clip(start, profiles.at_px[0], profiles.at_px[-1])
    half = min(int(np.ceil((reach.max() + 0.5) / STEP_PX)) + 1, (count - 1) // 2)
    first = np.clip(
        np.rint((start - profiles.at_px[0]) / STEP_PX).astype(int) - half, 0, count - 1 - 2 * half
    )
    index = first[:, None] + np.arange(2 * half + 1)
    at, values = single(profiles.at_px)[index], profiles.values[rows[:, None], index]
    weight = np.clip(single(reach + 0.5)[:, None] - np.abs(at - single(start)[:, None]), 0.0, 1.0)
    return Window(at, values, weight)


def edge(x: Float32[np.ndarray, "*n"]) -> Float32[np.ndarray, "*n"]:
    """A blurred edge of unit height and blur: the normal distribution, good to 2e-6.

    Half the logarithm of its odds is an odd function, whose polynomial was fitted so that the largest error
    of what comes out is least (the logistic form as of Page, Applied Statistics 26, 1977, of a higher order).
    """
    # In place, since arrays made for every term would take longer than the terms.
    squares = x * x
    odds = np.float32(1.4185285642922875e-06) * squares
    for term in (-3.659997706284412e-05, -8.821984682560949e-05, 0.036392810081458817):
        odds += np.float32(term)
        odds *= squares
    odds += np.float32(0.7978695559905321)
    odds *= x
    np.tanh(odds, out=odds)
    odds *= np.float32(0.5)
    odds += np.float32(0.5)
    return odds


def bell(x: Float32[np.ndarray, "*n"]) -> Float32[np.ndarray, "*n"]:
    """The slope of a blurred edge, up to a factor: exp(-x^2 / 2)."""
    squares = x * x
    squares *= np.float32(-0.5)
    return np.exp(squares, out=squares)


def single(values: np.ndarray) -> Float32[np.ndarray, "*n"]:
    """Values in single precision."""
    return np.asarray(values, np.float32)


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Sum of products along each profile."""
    return np.einsum("np,np->n", a, b)


class StripModel:
    """The strip model on some profiles: tones are the heights of the near and of the far edge.

    Where `shading` is given, a profile of light that falls off, any of it may lie over the strip.
    """

    def __init__(
        self,
        values: np.ndarray,
        weight: np.ndarray,
        width: np.ndarray,
        blur: float | np.ndarray,
        shading: np.ndarray | None = None,
    ) -> None:
        self.weight, self.half = weight, 0.5 * width[:, None]
        self.blur = single(np.broadcast_to(blur, width.shape))[:, None]
        self.samples = weight.sum(1, keepdims=True)
        self.shading = None
        if shading is not None:
            unit = self._centred(np.broadcast_to(shading, weight.shape))
            self.shading = unit / np.sqrt(np.maximum(dot(weight * unit, unit), 1e-9))[:, None]
        self.values = self._centred(values)

    def of(self, rows: Int[np.ndarray, " k"]) -> StripModel:
        """The model on some of the profiles."""
        some = copy(self)
        some.weight, some.half, some.samples = self.weight[rows], self.half[rows], self.samples[rows]
        some.values, some.blur = self.values[rows], self.blur[rows]
        some.shading = None if self.shading is None else self.shading[rows]
        return some

    def _centred(self, columns: np.ndarray) -> np.ndarray:
        centred = columns - dot(self.weight, columns)[:, None] / self.samples
        if self.shading is not None:
            centred -= dot(self.weight * self.shading, centred)[:, None] * self.shading
        return centred

    def at(self, s: np.ndarray) -> None:
        """Take the strip to profile coordinates s, and fit its tones."""
        middle, half = s / self.blur, self.half / self.blur
        self.places = middle + half, middle - half
        self.bells: tuple[np.ndarray, np.ndarray] | None = None
        self.near, self.far = (self._centred(edge(place)) for place in self.places)
        self.weighted_near, self.weighted_far = self.weight * self.near, self.weight * self.far
        a = dot(self.weighted_near, self.near).astype(float)
        b = dot(self.weighted_near, self.far).astype(float)
        c = dot(self.weighted_far, self.far).astype(float)
        # A thin strip's two edges are nearly the same column: a ridge of a thousandth keeps their sum.
        ridge = 5e-4 * self.samples[:, 0] + 1e-3 / 3 * (a + c)
        a, c = a + ridge, c + ridge
        self.inverse = np.stack([c, -b, -b, a]) / (a * c - b * b)
        self.tones = self._tones(self.values)
        self.misfit = self._left(self.values, self.tones)

    def slope(self) -> np.ndarray:
        """The part of the profiles' slope by the offset that the tones cannot imitate."""
        return self._untold(1.0)

    def slope_by_half(self) -> np.ndarray:
        """The part of the profiles' slope by half the width that the tones cannot imitate."""
        return self._untold(-1.0)

    def _untold(self, sign: float) -> np.ndarray:
        if self.bells is None:
            self.bells = bell(self.places[0]), bell(self.places[1])
        near, far = single(sign * self.tones[0]), single(self.tones[1])
        slope = near[:, None] * self.bells[0] + far[:, None] * self.bells[1]
        slope *= np.float32(-1.0 / np.sqrt(2 * np.pi)) / self.blur
        slope = self._centred(slope)
        return self._left(slope, self._tones(slope))

    def _tones(self, columns: np.ndarray) -> np.ndarray:
        p, q = dot(self.weighted_near, columns), dot(self.weighted_far, columns)
        return np.stack(
            [self.inverse[0] * p + self.inverse[1] * q, self.inverse[2] * p + self.inverse[3] * q]
        )

    def _left(self, columns: np.ndarray, tones: np.ndarray) -> np.ndarray:
        left = columns - single(tones[0])[:, None] * self.near
        left -= single(tones[1])[:, None] * self.far
        return left


def still_moving(
    strip: StripModel, moving: Int[np.ndarray, " k"], some: StripModel, *steps: Float[np.ndarray, " k"]
) -> tuple[Int[np.ndarray, " m"], StripModel]:
    """The profiles of `moving` whose places still move, and the model on them, from that on `moving`.

    Most come to rest soon. They are left out where that saves more than it costs.
    """
    far = np.max(np.abs(steps), axis=0) >= STILL_PX
    if not far.any():
        return moving[:0], some
    if np.count_nonzero(far) > MOST_LEFT * len(far):
        return moving, some
    moving = moving[far]
    return moving, strip.of(moving)
