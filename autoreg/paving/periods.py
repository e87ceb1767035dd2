"""The spacing and phase of parallel joints, from the evidence on the rectified ground.

Every predicted joint contributes the logarithm of a likelihood ratio: how likely is the support found there
if a joint lies there, against a random place of the same direction. A spacing that is too fine pays for the
joints that it predicts in vain, one that is too coarse forgoes the joints that it skips, so neither half
nor twice the true spacing can win.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32

from autoreg.ground.rectify import Family, line_support
from autoreg.paving.presence import rank_p

# Share of true joints that cannot be seen (covered, overgrown, worn).
MISSED = 0.08
# Range of the support of visible joints, in standard deviations of the background.
SUPPORT_RANGE = 12.0
# The most that one joint may add, in nats: no single line decides.
CAP = 3.0
PHASES = 48
# Rows that lines must be apart to be told from each other.
MIN_STEP = 5.0
# Columns over which a line's support is taken together.
PIECE = 24
# Parts of a line's length in which a field of paving may lie.
WINDOWS = ((0.0, 1.0), (0.0, 0.5), (0.25, 0.75), (0.5, 1.0))
# Entries of the table in which the support of a place on the ground is looked up, and lines for which that is
# done at a time: what a processor's cache holds.
TABLE, AT_ONCE = 8192, 1024


@dataclass(frozen=True)
class Comb:
    """Parallel lines at `phase + k * spacing`, and how much better they explain the support than chance.

    `lines` are the offsets of the first and the last of them, `along` how far they reach.
    """

    spacing: float
    phase: float
    score: float
    lines: tuple[float, float] = (-np.inf, np.inf)
    along: tuple[float, float] = (-np.inf, np.inf)


def log_likelihood_ratio(z: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Joint against background, from a robust z-score of the support.

    Background: Student's density with five degrees of freedom, heavier than texture usually is. Joint:
    uniform over the range of supports that visible joints have, or missed.
    """
    background = 0.75 / (1.0 + np.maximum(z, 0.0) ** 2 / 5.0) ** 3
    return np.minimum(np.log((1.0 - MISSED) / SUPPORT_RANGE / background + MISSED), CAP)


def line_llr(z: Float[np.ndarray, " n"], valid: Bool[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Log likelihood ratios of lines, none of which exceeds what its rank among all `valid` ones allows.

    Wide joints look like joints over a good part of the ground, where any line meets them by chance: the
    middle of each counts for more than its rims.
    """
    return np.minimum(log_likelihood_ratio(z), np.log((1.0 - MISSED) / rank_p(z, z[valid]) + MISSED))


def blurred(llr: Float[np.ndarray, " lines *n"], tolerance: int = 1) -> Float[np.ndarray, " lines *n"]:
    """Log of the likelihood ratio averaged over a position that is known to `tolerance` lines."""
    flat = np.exp(llr).reshape(len(llr), -1)
    return np.log(cv2.blur(flat, (1, 2 * tolerance + 1), borderType=cv2.BORDER_REPLICATE)).reshape(llr.shape)


def local_z(
    profile: Float[np.ndarray, " n"], valid: Bool[np.ndarray, " n"], window: int
) -> Float[np.ndarray, " n"]:
    """Robust z-score of each value against its neighbourhood; zero where nothing is known.

    Centre and spread come from the median and the lower half, since joints only push the upper half.
    """
    z = np.zeros(len(profile))
    index = np.flatnonzero(valid)
    if len(index) < 20:
        return z
    values = profile[index]
    centres = np.arange(0, len(values), max(1, len(values) // 24))
    low, high = np.maximum(centres - window // 2, 0), np.minimum(centres + window // 2 + 1, len(values))
    quantiles = np.array([_lower_quantiles(values[a:b]) for a, b in zip(low, high, strict=True)])
    at = np.arange(len(values))
    median = np.interp(at, centres, quantiles[:, 1])
    spread = np.interp(at, centres, np.maximum(quantiles[:, 1] - quantiles[:, 0], 1e-3))
    z[index] = (values - median) / spread
    return z


def _lower_quantiles(values: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """The 16 % quantile and the median, to the nearest value below."""
    at = int(0.16 * (len(values) - 1)), int(0.5 * (len(values) - 1))
    ordered = np.partition(values, at)
    return float(ordered[at[0]]), float(ordered[at[1]])


def line_pieces(
    family: Family, piece: int = PIECE
) -> tuple[Float[np.ndarray, "n p"], Bool[np.ndarray, "n p"]]:
    """Support of each line piece by piece, and which pieces are seen."""
    support, seen = line_support(family, np.arange(0, family.evidence.shape[1], piece))
    return support, seen > 0.6 * piece


def line_z(
    support: Float[np.ndarray, "n p"],
    counted: Bool[np.ndarray, "n p"],
    window: tuple[float, float] = (0.0, 1.0),
) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Robust z-score of the support of each line over a window of its length, and where it is known."""
    first, last = (round(share * support.shape[1]) for share in window)
    support, counted = support[:, first:last], counted[:, first:last]
    pieces = counted.sum(1)
    profile = (support * counted).sum(1) / np.maximum(pieces, 1)
    valid = pieces >= 3
    return local_z(profile, valid, max(40, len(profile) // 5)), valid


@dataclass(frozen=True)
class Lines:
    """The lines of combs; a column is a phase.

    The first lines of all spacings come first, then the second ones of those that have them, and so on:
    `block[k]` is where the lines number k begin, and `order` the spacings, those of the most lines first. So
    sums along combs are sums of whole blocks. `place` is the row of the profile that each line is looked up
    in, or one beyond them all where a line is outside, or too near to the next one to be told from it.
    """

    spacing: Float[np.ndarray, " s"]
    first: Int32[np.ndarray, " s"]
    count: Int32[np.ndarray, " s"]
    order: Int[np.ndarray, " s"]
    block: Int[np.ndarray, " k"]
    place: Int[np.ndarray, "lines phases"]

    def gain(
        self, llr: Float[np.ndarray, " n"], valid: Bool[np.ndarray, " n"]
    ) -> Float32[np.ndarray, "lines phases"]:
        """Log likelihood ratio of each line; zero where it is not seen."""
        return np.append(np.where(valid, llr, 0.0), 0.0).astype(np.float32).take(self.place)

    def blocks(self, values: np.ndarray) -> Iterator[np.ndarray]:
        """The rows of each line number, from the first one on."""
        return (values[a:b] for a, b in pairwise((*self.block.tolist(), len(values))))

    def sorted(self, values: np.ndarray) -> np.ndarray:
        """Values of the spacings by `order`, put back in their own order."""
        placed = np.empty_like(values)
        placed[self.order] = values
        return placed

    def of(self, s: int) -> Int[np.ndarray, " k"]:
        """The rows of one spacing."""
        return self.block[: self.count[s]] + int(np.flatnonzero(self.order == s)[0])


def predicted_lines(offset: Float[np.ndarray, " n"], spacings: Float[np.ndarray, " s"]) -> Lines:
    """All lines of every spacing and phase between the first and the last offset."""
    low, high = float(offset[0]), float(offset[-1])
    # Rows are of the type that NumPy looks up by: it would turn any other into it each time.
    row = np.rint(np.interp(np.linspace(low, high, TABLE), offset, np.arange(len(offset)))).astype(np.intp)
    first = np.floor(low / spacings).astype(np.int32)
    count = np.floor(high / spacings).astype(np.int32) + 1 - first
    order = np.argsort(-count, kind="stable")
    active = np.searchsorted(-count[order], -np.arange(count.max()))
    block = np.cumsum(active) - active
    member = order[np.arange(active.sum()) - np.repeat(block, active)]
    line = (first[member] + np.repeat(np.arange(len(active)), active)).astype(np.float32)
    scale = np.float32((TABLE - 1) / (high - low))
    phase = np.arange(PHASES, dtype=np.float32) / PHASES
    # An entry at either end of the table stands for all places outside.
    finest = np.pad((MIN_STEP * np.gradient(offset)[row]).astype(np.float32), 1, constant_values=np.inf)
    row = np.pad(row, 1, constant_values=len(offset))
    place = np.empty((len(line), PHASES), np.intp)
    for start in range(0, len(line), AT_ONCE):
        some = slice(start, start + AT_ONCE)
        spacing = spacings[member[some], None].astype(np.float32)
        at = np.rint((line[some, None] + phase) * (spacing * scale) - np.float32(low * scale))
        index = (at + 1).astype(np.intp)
        known = finest.take(index, mode="clip") <= spacing
        place[some] = np.where(known, row.take(index, mode="clip"), len(offset))
    return Lines(spacings, first, count, order, block, place)


def comb_scores(
    lines: Lines, llr: Float[np.ndarray, " n"], valid: Bool[np.ndarray, " n"], *, min_lines: int = 2
) -> Float[np.ndarray, "s phases"]:
    """Sum of the log likelihood ratios of every predicted line, for each spacing and phase."""
    # The imaginary parts count the lines that are seen: both are looked up at once.
    both = np.append(np.where(valid, llr + 1j, 0.0), 0.0).astype(np.complex64)
    sums = np.zeros((len(lines.order), PHASES), np.complex64)
    for place in lines.blocks(lines.place):
        sums[: len(place)] += both.take(place)
    return lines.sorted(np.where(sums.imag >= min_lines, sums.real, -np.inf).astype(float))


def _run_scores(lines: Lines, gain: Float32[np.ndarray, "lines phases"]) -> Float32[np.ndarray, "s phases"]:
    """The largest sum over successive lines, for each spacing and phase (Kadane's algorithm).

    Paving may end before the picture does.
    """
    running, best = np.zeros((2, len(lines.order), PHASES), np.float32)
    for block in lines.blocks(gain):
        now, most = running[: len(block)], best[: len(block)]
        now += block
        np.maximum(now, 0.0, out=now)
        np.maximum(most, now, out=most)
    return lines.sorted(best)


def _best_run(gain: Float32[np.ndarray, " n"]) -> tuple[int, int]:
    """First and last of the successive lines with the largest sum."""
    sums = np.r_[0.0, np.cumsum(gain)]
    low = np.minimum.accumulate(sums)
    last = int((sums - low).argmax())
    return int(sums[: last + 1].argmin()), max(last - 1, 0)


def best_combs(
    family: Family, *, count: int = 4, local: bool = False, piece: int = PIECE
) -> tuple[Comb, ...]:
    """The best spacings of the lines of a family, best first; empty if chance explains them all.

    With `local`, lines that are there in a part of the ground only are found as well, at the price of the
    part's choice.
    """
    support, counted = line_pieces(family, piece)
    z, valid = line_z(support, counted)
    if valid.sum() < 20:
        return ()
    spacings = _spacings(family.offset, valid)
    lines = predicted_lines(family.offset, spacings)
    scores = comb_scores(lines, blurred(line_llr(z, valid)), valid)
    found = list(distinct(spacings, scores, count))
    for window in WINDOWS if local else ():
        z, valid = line_z(support, counted, window)
        if valid.sum() < 20:
            continue
        gain = lines.gain(blurred(line_llr(z, valid)), valid)
        cost = np.log(len(WINDOWS)) + np.log(lines.count)[:, None]
        ends = np.array(window) * (len(family.along) - 1)
        along = tuple(np.interp(ends, np.arange(len(family.along)), family.along).tolist())
        for comb in distinct(spacings, _run_scores(lines, gain) - cost, count):
            s = int(np.abs(spacings - comb.spacing).argmin())
            run = _best_run(gain[lines.of(s), round(comb.phase / comb.spacing * PHASES)])
            low, high = ((int(lines.first[s]) + k) * comb.spacing + comb.phase for k in run)
            found.append(replace(comb, lines=(low, high), along=along))
    return tuple(sorted(found, key=lambda comb: -comb.score)[:count])


def _spacings(offset: Float[np.ndarray, " n"], valid: Bool[np.ndarray, " n"]) -> Float[np.ndarray, " s"]:
    span = float(np.ptp(offset[valid]))
    return np.geomspace(max(MIN_STEP * float(np.diff(offset).min()), span / 150.0), span / 1.5, 400)


def distinct(spacings: np.ndarray, scores: np.ndarray, count: int, apart: float = 0.025) -> tuple[Comb, ...]:
    """The best combs whose spacings differ by more than `apart`, best first."""
    best, phase = scores.max(1), scores.argmax(1)
    chosen: list[int] = []
    for i in np.argsort(-best, kind="stable"):
        if best[i] <= 0 or len(chosen) == count:
            break
        if all(abs(np.log(spacings[i] / spacings[j])) > apart for j in chosen):
            chosen.append(int(i))
    return tuple(
        Comb(float(spacings[i]), float(phase[i] / PHASES * spacings[i]), float(best[i])) for i in chosen
    )
