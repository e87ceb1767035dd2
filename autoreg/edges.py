"""Sub-pixel places of the joints: each station's own grey-level profile across the joint.

A joint is a strip between two slabs: left tone, joint tone, right tone, with two edges of opposite sign
(or one edge where tiles of two tones meet without a joint). Its *centre* is what is measured, by a least
squares fit of that blurred strip; matching one edge would leave half a joint width of bias.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int

from autoreg.profiles import STEP_PX, Profiles

# Neighbouring pixels of texture and of the lens's blur are not independent: the number of free values in a
# profile is about this share of its samples.
INDEPENDENT = 0.5 * STEP_PX
# Variance of grey levels that every mean profile has, whatever it looks like.
NOISE_FLOOR = 0.02
# Profiles whose rooms differ by less are searched together.
ROOM_STEP_PX = 4.0
# Wider strips are searched as if they were so wide.
WIDEST_PX = 2.0**4.5
# So many profiles are fitted at a time: what a processor's cache holds.
BATCH = 512
# Offsets that move by less than this have converged.
STILL_PX = 1e-3
# Shares of the known width from which both edges of a strip are looked for, and the most steps towards them.
STARTS, EDGE_STEPS = (0.6, 1.0), 12


@dataclass(frozen=True)
class Offsets:
    """Where the joint lies off the station's projected centre, along its normal.

    `depth` is the joint's tone against the mean of its slabs', `step` the tone of the far slab against the
    near one's, `strength` the share of the profile's variance that the fit explains.
    """

    offset_px: Float[np.ndarray, " n"]
    sigma_px: Float[np.ndarray, " n"]
    depth: Float[np.ndarray, " n"]
    step: Float[np.ndarray, " n"]
    strength: Float[np.ndarray, " n"]


def _edge(x: Float32[np.ndarray, "*n"]) -> tuple[Float32[np.ndarray, "*n"], Float32[np.ndarray, "*n"]]:
    """A blurred edge of unit height and blur, and exp(-x^2 / 2), its slope up to a factor.

    The normal distribution by Abramowitz and Stegun, 7.1.26 (good to 1e-7).
    """
    bell = np.exp(-0.5 * x * x)
    t = 1.0 / (1.0 + np.float32(0.3275911 * np.sqrt(0.5)) * np.abs(x))
    tail = t * (0.127414796 + t * (-0.142248368 + t * (0.710706871 + t * (-0.726576014 + t * 0.530702715))))
    tail *= bell
    return np.where(x < 0, tail, 1.0 - tail), bell


def _single(values: np.ndarray) -> Float32[np.ndarray, "*n"]:
    return np.asarray(values, np.float32)


def _strips(
    at: Float[np.ndarray, " p"], centre: Float[np.ndarray, " c"], width: float, blur: float
) -> np.ndarray:
    """Step and strip of one width at each centre, orthonormal and without mean: shape (c, p, 2).

    Orthonormal columns make the explained variance a sum of squares. The strip's sign is that of a light one.
    """
    s = at - centre[:, None]
    near, far = (_edge(_single((s + side * 0.5 * width) / blur))[0].astype(float) for side in (1.0, -1.0))
    both = np.stack([near + far, near - far], -1)
    orthonormal, upper = np.linalg.qr(both - both.mean(1, keepdims=True))
    return orthonormal * np.sign(np.diagonal(upper, axis1=1, axis2=2))[:, None, :]


def _explained(centred: Float32[np.ndarray, "n p"], strips: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Components of profiles along the step and along the strip, for each centre: two arrays (n, c)."""
    c, p, _ = strips.shape
    both = centred @ _single(strips.transpose(1, 2, 0).reshape(p, 2 * c))
    return both[:, :c], both[:, c:]


def _alike(
    width_px: Float[np.ndarray, " n"], rooms: Int[np.ndarray, " n"]
) -> Iterator[tuple[np.ndarray, float, int]]:
    """Rows of the profiles that can share a strip, its width (a power of the root of two), and their room."""
    level = np.round(2 * np.log2(np.maximum(width_px, 1.0))).astype(int)
    for key in np.unique(np.stack([level, rooms], 1), axis=0):
        yield np.flatnonzero((level == key[0]) & (rooms == key[1])), 2.0 ** (key[0] / 2), key[1]


def search_offsets(
    profiles: Profiles, width_px: Float[np.ndarray, " n"], reach_px: float, prior_px: float, blur: float = 0.9
) -> Float[np.ndarray, " n"]:
    """Offset of the strip that explains each profile best, to half a pixel, within `reach_px`.

    A Gaussian prior of `prior_px` settles ties in favour of the predicted place.
    """
    at = profiles.at_px
    candidates = np.arange(-np.floor(reach_px), np.floor(reach_px) + 0.25, 0.5)
    prior = _single(0.5 * (candidates / prior_px) ** 2)
    best = np.zeros(len(profiles.values))
    rooms = np.ceil(profiles.room_px / ROOM_STEP_PX).astype(int)
    for rows, width, room in _alike(np.minimum(width_px, WIDEST_PX), rooms):
        inside = np.abs(at) <= room * ROOM_STEP_PX
        values = profiles.values[np.ix_(rows, inside)]
        centred = values - values.mean(1, keepdims=True)
        total = (centred**2).sum(1, keepdims=True) + 1e-6
        step, strip = _explained(centred, _strips(at[inside], candidates, width, blur))
        left = np.maximum(total - step**2 - strip**2, 1e-3 * total + 1e-6)
        likelihood = -0.5 * INDEPENDENT * inside.sum() * np.log(left) - prior
        best[rows] = candidates[likelihood.argmax(1)]
    return best


def fit_offsets(
    profiles: Profiles,
    start_px: Float[np.ndarray, " n"],
    width_px: Float[np.ndarray, " n"],
    blur: float,
    *,
    iterations: int = 6,
) -> Offsets:
    """Least-squares offset of each strip (variable projection: tones are linear, the offset is not).

    Only the joint and its shoulders are looked at, from where the fit starts.
    """
    reach = 0.5 * width_px + 3.0 * blur + 1.5
    order = np.argsort(reach, kind="stable")
    columns = np.empty((5, len(order)))
    for rows in np.array_split(order, max(1, round(len(order) / BATCH))):
        if len(rows):
            columns[:, rows] = _fitted(
                profiles, rows, start_px[rows], width_px[rows], reach[rows], blur, iterations
            )
    return Offsets(*columns)


def _fitted(
    profiles: Profiles,
    rows: np.ndarray,
    start: np.ndarray,
    width: np.ndarray,
    reach: np.ndarray,
    blur: float,
    iterations: int,
) -> tuple[np.ndarray, ...]:
    """Offset, its sigma, depth, step and strength of some profiles."""
    at, values, weight = _window(profiles, rows, start, reach)
    strip = _Strip(values, weight, _single(width), blur)
    centre = start.copy()
    strip.at(at - _single(centre)[:, None])
    slope = strip.slope()
    for _ in range(iterations):
        weighted = weight * slope
        step = _dot(weighted, strip.misfit) / np.maximum(_dot(weighted, slope), 1e-9)
        step = np.clip(np.clip(step, -0.7, 0.7), start - 2.5 - centre, start + 2.5 - centre)
        if np.abs(step).max() < STILL_PX:
            break
        centre += step
        strip.at(at - _single(centre)[:, None])
        slope = strip.slope()
    information = _dot(weight * slope, slope).astype(float)
    samples = weight.sum(1).astype(float)
    sse = _dot(weight * strip.misfit, strip.misfit).astype(float)
    total = _dot(weight * strip.values, strip.values)
    variance = sse / np.maximum(samples * INDEPENDENT - 4.0, 1.0) + NOISE_FLOOR
    near, far = strip.tones
    # A flat profile, overexposed say, shows no joint.
    strength = 1.0 - (sse + NOISE_FLOOR * samples) / (total + NOISE_FLOOR * samples)
    return centre, np.sqrt(variance / np.maximum(information, 1e-9)), 0.5 * (near - far), near + far, strength


def _window(
    profiles: Profiles, rows: np.ndarray, start: np.ndarray, reach: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places, values and weights of some profiles' samples within reach of where their joints may lie."""
    count = len(profiles.at_px)
    half = min(int(np.ceil((reach.max() + 0.5) / STEP_PX)) + 1, (count - 1) // 2)
    first = np.clip(
        np.rint((start - profiles.at_px[0]) / STEP_PX).astype(int) - half, 0, count - 1 - 2 * half
    )
    index = first[:, None] + np.arange(2 * half + 1)
    at, values = _single(profiles.at_px)[index], profiles.values[rows[:, None], index]
    weight = np.clip(_single(reach + 0.5)[:, None] - np.abs(at - _single(start)[:, None]), 0.0, 1.0)
    return at, values, weight


@dataclass(frozen=True)
class Widths:
    """Each joint's middle along its station's normal, and its width, where its two edges are told apart.

    Sigmas are infinite where they are not.
    """

    middle_px: Float[np.ndarray, " n"]
    width_px: Float[np.ndarray, " n"]
    sigma_middle_px: Float[np.ndarray, " n"]
    sigma_width_px: Float[np.ndarray, " n"]


def fit_widths(
    profiles: Profiles, start_px: Float[np.ndarray, " n"], width_px: Float[np.ndarray, " n"], blur: float
) -> Widths:
    """Least-squares places of both edges of each strip, from where one of a known width was fitted.

    An edge that is hidden, or looks like its slab, leaves a narrower strip that lies off: two widths are
    started from.
    """
    reach = 0.5 * width_px + 3.0 * blur + 1.5
    order = np.argsort(reach, kind="stable")
    columns = np.empty((4, len(order)))
    for rows in np.array_split(order, max(1, round(len(order) / BATCH))):
        if len(rows):
            at, values, weight = _window(profiles, rows, start_px[rows], reach[rows])
            found = [
                _both_edges(at, values, weight, start_px[rows], width_px[rows], share, blur)
                for share in STARTS
            ]
            better = found[1][0] < found[0][0]
            columns[:, rows] = np.where(better, found[1][1:], found[0][1:])
    return Widths(*columns)


def _both_edges(
    at: np.ndarray,
    values: np.ndarray,
    weight: np.ndarray,
    start: np.ndarray,
    width: np.ndarray,
    share: float,
    blur: float,
) -> np.ndarray:
    """Unexplained squares, middle, width and their sigmas, from a share of the known width (Gauss-Newton)."""
    strip = _Strip(values, weight, _single(share * width), blur)
    centre, half = start.copy(), 0.5 * share * width
    variances = np.zeros((2, len(start)))
    for _ in range(EDGE_STEPS):
        strip.half = _single(half)[:, None]
        strip.at(at - _single(centre)[:, None])
        slopes = strip.slope(), strip.slope_by_half()
        pulls = [_dot(weight * slope, strip.misfit).astype(float) for slope in slopes]
        # A little damping keeps steps of hardly visible edges finite.
        squares = [1.01 * _dot(weight * slope, slope).astype(float) + 1e-6 for slope in slopes]
        mixed = _dot(weight * slopes[0], slopes[1]).astype(float)
        variances = np.stack(squares[::-1]) / (squares[0] * squares[1] - mixed**2)
        pulled = variances * np.stack(pulls)
        pulled -= mixed / (squares[0] * squares[1] - mixed**2) * np.stack(pulls[::-1])
        steps = np.clip(pulled, -0.7, 0.7)
        centre += steps[0]
        half = np.maximum(half + steps[1], 0.05 * width)
        if np.abs(steps).max() < STILL_PX:
            break
    sse = _dot(weight * strip.misfit, strip.misfit).astype(float)
    variance = sse / np.maximum(weight.sum(1).astype(float) * INDEPENDENT - 5.0, 1.0) + NOISE_FLOOR
    sigma_centre, sigma_half = np.sqrt(variance * variances)
    told = (np.abs(centre - start) < 0.5 * width + 1.0) & (half > 0.1 * width) & (half < 0.9 * width)
    found = np.stack([sse, centre, 2.0 * half, sigma_centre, 2.0 * sigma_half])
    untold = np.stack([np.full(len(start), np.inf), start, width, *np.full((2, len(start)), np.inf)])
    return np.where(told, found, untold)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Sum of products along each profile."""
    return np.einsum("np,np->n", a, b)


class _Strip:
    """The strip model on some profiles: tones are the heights of the near and of the far edge."""

    def __init__(
        self, values: np.ndarray, weight: np.ndarray, width: np.ndarray, blur: float | np.ndarray
    ) -> None:
        self.weight, self.half, self.blur = weight, 0.5 * width[:, None], _single(np.asarray(blur))
        self.samples = weight.sum(1, keepdims=True)
        self.values = self._centred(values)

    def _centred(self, columns: np.ndarray) -> np.ndarray:
        return columns - _dot(self.weight, columns)[:, None] / self.samples

    def at(self, s: np.ndarray) -> None:
        """Take the strip to profile coordinates s, and fit its tones."""
        near, self.near_bell = _edge((s + self.half) / self.blur)
        far, self.far_bell = _edge((s - self.half) / self.blur)
        # A thin strip's two edges are nearly the same column: a ridge of a thousandth keeps their sum.
        squares = self.samples[:, 0] + _dot(self.weight, near * near + far * far)
        self.near, self.far = self._centred(near), self._centred(far)
        self.weighted_near, self.weighted_far = self.weight * self.near, self.weight * self.far
        ridge = 1e-3 / 3 * squares.astype(float)
        a = _dot(self.weighted_near, self.near) + ridge
        b = _dot(self.weighted_near, self.far).astype(float)
        c = _dot(self.weighted_far, self.far) + ridge
        self.inverse = np.stack([c, -b, -b, a]) / (a * c - b * b)
        self.tones = self._tones(self.values)
        self.misfit = self._left(self.values, self.tones)

    def slope(self) -> np.ndarray:
        """The part of the profiles' slope by the offset that the tones cannot imitate."""
        return self._untold(
            _single(self.tones[0])[:, None] * self.near_bell + _single(self.tones[1])[:, None] * self.far_bell
        )

    def slope_by_half(self) -> np.ndarray:
        """The part of the profiles' slope by half the width that the tones cannot imitate."""
        return self._untold(
            _single(self.tones[1])[:, None] * self.far_bell - _single(self.tones[0])[:, None] * self.near_bell
        )

    def _untold(self, bells: np.ndarray) -> np.ndarray:
        slope = self._centred(bells * (np.float32(-1.0 / np.sqrt(2 * np.pi)) / self.blur))
        return self._left(slope, self._tones(slope))

    def _tones(self, columns: np.ndarray) -> np.ndarray:
        p, q = _dot(self.weighted_near, columns), _dot(self.weighted_far, columns)
        return np.stack(
            [self.inverse[0] * p + self.inverse[1] * q, self.inverse[2] * p + self.inverse[3] * q]
        )

    def _left(self, columns: np.ndarray, tones: np.ndarray) -> np.ndarray:
        return columns - _single(tones[0])[:, None] * self.near - _single(tones[1])[:, None] * self.far


def strip_support(
    profiles: Profiles,
    width_px: Float[np.ndarray, " n"],
    blur: float,
    tolerance_px: float,
    room_px: Float[np.ndarray, " n"],
    polarity: Int[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """Share of each profile's variance that a strip within `tolerance_px` of the predicted place explains.

    Only what lies within `room_px` of the place is looked at, so that a neighbouring joint has no say. Where
    the joints are known to be dark or light, a step of tone alone is no joint, nor is a strip of the other
    kind.
    """
    at = profiles.at_px
    candidates = np.arange(-tolerance_px, tolerance_px + 0.25, 0.5)
    support = np.zeros(len(profiles.values))
    for rows, width, room in _alike(width_px, np.round(room_px).astype(int)):
        inside = np.abs(at) <= room
        values = profiles.values[rows][:, inside]
        centred = values - values.mean(1, keepdims=True)
        # A grey level of noise keeps flat profiles from scoring by chance.
        total = ((centred**2).sum(1) + 0.5 * inside.sum())[:, None]
        step, strip = _explained(centred, _strips(at[inside], candidates, width, blur))
        sign = polarity[rows, None]
        lined = np.where(strip * sign > 0, strip**2 / (total - step**2), 0.0)
        support[rows] = np.where(sign == 0, (step**2 + strip**2) / total, lined).max(1)
    return support


def strip_misfits(
    profiles: Profiles,
    rows: Int[np.ndarray, " n"],
    offset_px: Float[np.ndarray, " n"],
    width_px: Float[np.ndarray, "k n"],
    blur: Float[np.ndarray, " k"],
) -> Float[np.ndarray, " k"]:
    """Mean logarithm of some stations' unexplained variance, for each of several widths and blurs.

    `offset_px` is where the joints of those stations lie.
    """
    k, n = width_px.shape
    inside = (np.abs(profiles.at_px) <= profiles.room_px[rows, None]).astype(np.float32)
    # All at once: the arrays are small, and each operation on them has its price.
    strip = _Strip(
        np.tile(profiles.values[rows], (k, 1)),
        np.tile(inside, (k, 1)),
        _single(width_px.ravel()),
        np.repeat(_single(blur), n)[:, None],
    )
    strip.at(np.tile(_single(profiles.at_px) - _single(offset_px)[:, None], (k, 1)))
    left, total = (_dot(strip.weight * v, v) for v in (strip.misfit, strip.values))
    return np.log(left / np.maximum(total, 1e-9) + 1e-3).reshape(k, n).mean(1).astype(float)
