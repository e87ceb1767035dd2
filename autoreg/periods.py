"""The spacing and phase of parallel joints, from the evidence on the rectified ground.

Every predicted joint contributes the logarithm of a likelihood ratio: how likely is the support found there
if a joint lies there, against a random place of the same direction. A spacing that is too fine pays for the
joints that it predicts in vain, one that is too coarse forgoes the joints that it skips, so neither half
nor twice the true spacing can win.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from autoreg.rectify import Family, line_support

# Share of true joints that cannot be seen (covered, overgrown, worn).
MISSED = 0.08
# Range of the support of visible joints, in standard deviations of the background.
SUPPORT_RANGE = 12.0
# The most that one joint may add, in nats: no single line decides.
CAP = 3.0
PHASES = 48
# Entries of the table in which the support of a place on the ground is looked up.
TABLE = 8192


@dataclass(frozen=True)
class Comb:
    """Parallel lines at `phase + k * spacing`, and how much better they explain the support than chance."""

    spacing: float
    phase: float
    score: float


def log_likelihood_ratio(z: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Joint against background, from a robust z-score of the support.

    Background: Student's density with five degrees of freedom, heavier than texture usually is. Joint:
    uniform over the range of supports that visible joints have, or missed.
    """
    background = 0.75 / (1.0 + np.maximum(z, 0.0) ** 2 / 5.0) ** 3
    return np.minimum(np.log((1.0 - MISSED) / SUPPORT_RANGE / background + MISSED), CAP)


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
    cuts = [values[max(0, c - window // 2) : c + window // 2 + 1] for c in centres]
    quantiles = np.array([np.quantile(cut, [0.16, 0.5]) for cut in cuts])
    at = np.arange(len(values))
    median = np.interp(at, centres, quantiles[:, 1])
    spread = np.interp(at, centres, np.maximum(quantiles[:, 1] - quantiles[:, 0], 1e-3))
    z[index] = (values - median) / spread
    return z


def line_z(family: Family, piece: int = 24) -> tuple[Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Robust z-score of the support of each whole line, and where it is known."""
    edges = np.arange(0, family.evidence.shape[1], piece)
    support, seen = line_support(family, edges)
    counted = seen > 0.6 * piece
    pieces = counted.sum(1)
    profile = (support * counted).sum(1) / np.maximum(pieces, 1)
    valid = pieces >= 3
    return local_z(profile, valid, max(40, len(profile) // 5)), valid


def comb_scores(
    llr: Float[np.ndarray, " n"],
    valid: Bool[np.ndarray, " n"],
    offset: Float[np.ndarray, " n"],
    spacings: Float[np.ndarray, " s"],
    *,
    min_lines: int = 2,
    min_step: float = 5.0,
) -> Float[np.ndarray, "s phases"]:
    """Sum of the log likelihood ratios of every predicted line, for each spacing and phase.

    Lines that lie closer than `min_step` rows to the next one are not counted: they cannot be told apart.
    """
    low, high = float(offset[0]), float(offset[-1])
    # The table is finer than the rows, so that a place is looked up without searching for its row.
    at = np.linspace(low, high, TABLE)
    row = np.rint(np.interp(at, offset, np.arange(len(offset)))).astype(int)
    known = valid[row]
    gain = np.where(known, llr[row], 0.0)
    finest = np.where(known, min_step * np.gradient(offset)[row], np.inf)
    # Place p of a spacing is p / PHASES of it: line p // PHASES of phase p % PHASES.
    first = np.ceil(low / spacings * PHASES).astype(int)
    count = np.floor(high / spacings * PHASES).astype(int) + 1 - first
    which = np.repeat(np.arange(len(spacings)), count)
    place = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count - first, count)
    spacing = spacings[which]
    index = np.rint((place * (spacing / PHASES) - low) * ((TABLE - 1) / (high - low))).astype(int)
    index = np.clip(index, 0, TABLE - 1)
    told = finest[index] <= spacing
    cell = which * PHASES + place % PHASES
    size = len(spacings) * PHASES
    total = np.bincount(cell, gain[index] * told, size)
    lines = np.bincount(cell, told, size)
    return np.where(lines >= min_lines, total, -np.inf).reshape(-1, PHASES)


def best_combs(family: Family, *, count: int = 4) -> tuple[Comb, ...]:
    """The best spacings of the lines of a family, best first; empty if chance explains them all."""
    z, valid = line_z(family)
    if valid.sum() < 20:
        return ()
    offset = family.offset
    llr = blurred(log_likelihood_ratio(z))
    span = float(np.ptp(offset[valid]))
    spacings = np.geomspace(max(5.0 * float(np.diff(offset).min()), span / 150.0), span / 1.5, 400)
    return distinct(spacings, comb_scores(llr, valid, offset, spacings), count)


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
