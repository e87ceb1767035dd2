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


def edge(x: Float32[np.ndarray, "*n"]) -> tuple[Float32[np.ndarray, "*n"], Float32[np.ndarray, "*n"]]:
    """A blurred edge of unit height and blur, and exp(-x^2 / 2), its slope up to a factor.

    The normal distribution by Abramowitz and Stegun, 7.1.26 (good to 1e-7).
    """
    # In place, since arrays made for every term would take longer than the terms.
    bell = x * x
    bell *= np.float32(-0.5)
    np.exp(bell, out=bell)
    t = np.abs(x)
    t *= np.float32(0.3275911 * np.sqrt(0.5))
    t += 1.0
    np.reciprocal(t, out=t)
    tail = np.float32(0.530702715) * t
    for term in (-0.726576014, 0.710706871, -0.142248368, 0.127414796):
        tail += np.float32(term)
        tail *= t
    tail *= bell
    tail -= x >= 0
    return np.abs(tail, out=tail), bell


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
        near, self.near_bell = edge((s + self.half) / self.blur)
        far, self.far_bell = edge((s - self.half) / self.blur)
        # A thin strip's two edges are nearly the same column: a ridge of a thousandth keeps their sum.
        squares = self.samples[:, 0] + dot(self.weight, near * near + far * far)
        self.near, self.far = self._centred(near), self._centred(far)
        self.weighted_near, self.weighted_far = self.weight * self.near, self.weight * self.far
        ridge = 1e-3 / 3 * squares.astype(float)
        a = dot(self.weighted_near, self.near) + ridge
        b = dot(self.weighted_near, self.far).astype(float)
        c = dot(self.weighted_far, self.far) + ridge
        self.inverse = np.stack([c, -b, -b, a]) / (a * c - b * b)
        self.tones = self._tones(self.values)
        self.misfit = self._left(self.values, self.tones)

    def slope(self) -> np.ndarray:
        """The part of the profiles' slope by the offset that the tones cannot imitate."""
        return self._untold(
            single(self.tones[0])[:, None] * self.near_bell + single(self.tones[1])[:, None] * self.far_bell
        )

    def slope_by_half(self) -> np.ndarray:
        """The part of the profiles' slope by half the width that the tones cannot imitate."""
        return self._untold(
            single(self.tones[1])[:, None] * self.far_bell - single(self.tones[0])[:, None] * self.near_bell
        )

    def _untold(self, bells: np.ndarray) -> np.ndarray:
        slope = self._centred(bells * (np.float32(-1.0 / np.sqrt(2 * np.pi)) / self.blur))
        return self._left(slope, self._tones(slope))

    def _tones(self, columns: np.ndarray) -> np.ndarray:
        p, q = dot(self.weighted_near, columns), dot(self.weighted_far, columns)
        return np.stack(
            [self.inverse[0] * p + self.inverse[1] * q, self.inverse[2] * p + self.inverse[3] * q]
        )

    def _left(self, columns: np.ndarray, tones: np.ndarray) -> np.ndarray:
        return columns - single(tones[0])[:, None] * self.near - single(tones[1])[:, None] * self.far


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
