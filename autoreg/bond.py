"""How the courses are laid: stack bond, running bond with its shift, or rows without a period.

Given the unbroken joints, the picture falls into courses. In each course the cross joints are a comb of
their own; a bond is a law that ties the phases of these combs together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from autoreg.periods import PHASES, Comb, best_combs, blurred, local_z, log_likelihood_ratio
from autoreg.rectify import Family, Rectified, line_support
from autoreg.stations import Grid

# Cross joints are judged clear of the unbroken joints that end them.
MARGIN = 0.12


@dataclass(frozen=True)
class BondHypothesis:
    """A lattice on the rectified ground, in camera heights.

    `turned`: the unbroken joints are those of the rectified picture's `y` family, so that the lattice's X
    axis is the rectified Y axis. `origin` is a crossing in the rectified axes. `score` is the mean log
    likelihood ratio per course plus that per column, in nats.
    """

    grid: Grid
    turned: bool
    origin: Float[np.ndarray, "2"]
    score: float
    cross_score: float


@dataclass(frozen=True)
class Courses:
    """Log likelihood ratios of a joint at each place of each course; `index` k is the course from k to k + 1."""

    index: Float[np.ndarray, " c"]
    llr: Float[np.ndarray, "c n"]
    seen: Bool[np.ndarray, "c n"]
    z: Float[np.ndarray, "c n"]


def course_support(family: Family, comb: Comb) -> Courses:
    """Support of the family's lines within each course between the other family's joints."""
    along = family.along
    low, high = along[0], along[-1]
    k = np.arange(np.floor((low - comb.phase) / comb.spacing), np.ceil((high - comb.phase) / comb.spacing))
    step = np.gradient(along)
    rows = np.arange(len(along))
    start = np.interp(comb.phase + (k + MARGIN) * comb.spacing, along, rows)
    stop = np.interp(comb.phase + (k + 1 - MARGIN) * comb.spacing, along, rows)
    kept: list[float] = []
    llr: list[np.ndarray] = []
    seen: list[np.ndarray] = []
    zs: list[np.ndarray] = []
    for course, first, last in zip(k, np.ceil(start).astype(int), np.floor(stop).astype(int) + 1, strict=True):
        whole = (1 - 2 * MARGIN) * comb.spacing / float(np.median(step[max(0, first - 1) : last + 1]))
        if last - first < 4 or last - first < 0.5 * whole:
            continue
        part = Family(family.evidence[:, first:last], family.visible[:, first:last], family.offset, along[first:last])
        edges = np.rint(np.linspace(0, last - first, max(1, round((last - first) / 32)) + 1)).astype(int)
        support, samples = line_support(part, edges)
        counted = samples > 0.6 * np.diff(edges)
        valid = (samples.sum(1) > 0.5 * whole) & counted.any(1)
        if valid.sum() < 30:
            continue
        profile = (support * counted).sum(1) / np.maximum(counted.sum(1), 1)
        z = local_z(profile, valid, max(40, len(profile) // 4))
        kept.append(float(course))
        llr.append(np.where(valid, blurred(log_likelihood_ratio(z)), 0.0))
        seen.append(valid)
        zs.append(np.where(valid, z, 0.0))
    n = len(family.offset)
    empty = np.zeros((0, n))
    return Courses(
        np.array(kept),
        np.stack(llr) if llr else empty,
        np.stack(seen) if seen else empty.astype(bool),
        np.stack(zs) if zs else empty,
    )


def best_bonds(courses: Courses, offset: Float[np.ndarray, " n"], spacings: Float[np.ndarray, " a"]) -> np.ndarray:
    """Best score, phase and shift for each spacing of the cross joints: an array of (score, phase, shift).

    The score is the mean over courses of the sum over cross joints.
    """
    n, c = len(offset), len(courses.index)
    result = np.zeros((len(spacings), 3))
    result[:, 0] = -np.inf
    if c == 0:
        return result
    step, rows = np.gradient(offset), np.arange(n)
    wave = np.arange(PHASES)
    # Moving course k by k * shift is a product in the Fourier domain of the phase.
    turn = np.exp(2j * np.pi * ((courses.index[:, None, None] * wave[:, None] * wave) % PHASES) / PHASES)
    for s, a in enumerate(spacings):
        i = np.arange(np.floor(offset[0] / a) - 1, np.ceil(offset[-1] / a) + 2)
        at = (wave / PHASES * a)[:, None] + i * a
        row = np.rint(np.interp(at, offset, rows, left=-1, right=-1)).astype(int)
        inside = row >= 0
        row = np.clip(row, 0, n - 1)
        inside &= a / step[row] >= 5.0
        per_course = (courses.llr[:, row] * inside).sum(-1)
        spectrum = np.fft.fft(per_course, axis=1)
        total = np.fft.ifft(np.einsum("cw,csw->sw", spectrum, turn), axis=1).real
        shift, phase = np.unravel_index(int(total.argmax()), total.shape)
        result[s] = total[shift, phase] / c, phase / PHASES * a, shift / PHASES
    return result


def bond_hypotheses(rectified: Rectified, *, combs: int = 3, keep: int = 4) -> tuple[BondHypothesis, ...]:
    """The best lattices on a rectified ground, best first."""
    found: list[BondHypothesis] = []
    of_family = {False: best_combs(rectified.x, count=combs), True: best_combs(rectified.y, count=combs)}
    for turned in (False, True):
        unbroken, cross = (rectified.y, rectified.x) if turned else (rectified.x, rectified.y)
        for comb in of_family[turned]:
            courses = course_support(cross, comb)
            spacings = _cross_spacings(cross, comb, of_family[not turned])
            scored = best_bonds(courses, cross.offset, spacings)
            tried: list[float] = []
            for i in np.argsort(-scored[:, 0], kind="stable")[:60]:
                score, phase, shift = scored[i]
                a = float(spacings[i])
                if score <= 0 or len(tried) == 2:
                    break
                if any(abs(np.log(a / other)) < 0.03 for other in tried):
                    continue
                tried.append(a)
                columns = course_support(unbroken, Comb(a, phase, 0.0))
                lines = _mean_line_score(columns, unbroken.offset, comb)
                origin = np.array([comb.phase, phase]) if turned else np.array([phase, comb.phase])
                found.append(BondHypothesis(Grid(a, comb.spacing, shift), turned, origin, float(score + lines), float(score)))
    found.sort(key=lambda h: -h.score)
    return tuple(found[:keep])


def _cross_spacings(cross: Family, comb: Comb, combs: tuple[Comb, ...]) -> np.ndarray:
    """Spacings worth trying: multiples of the whole-line spacing, and a coarse grid."""
    finest = 5.0 * float(np.diff(cross.offset).min())
    grid = np.geomspace(max(finest, comb.spacing / 5), min(6 * comb.spacing, float(np.ptp(cross.offset))), 90)
    near = [c.spacing * m * f for c in combs for m in (1, 2, 3, 4, 5) for f in (0.99, 1.0, 1.01)]
    return np.sort(np.r_[grid, np.array([s for s in near if s >= finest])])


def _mean_line_score(columns: Courses, offset: np.ndarray, comb: Comb) -> float:
    """Mean over columns of the summed log likelihood ratios of a comb's lines."""
    if len(columns.index) == 0:
        return 0.0
    k = np.arange(np.floor((offset[0] - comb.phase) / comb.spacing), np.ceil((offset[-1] - comb.phase) / comb.spacing) + 1)
    row = np.rint(np.interp(comb.phase + k * comb.spacing, offset, np.arange(len(offset)), left=-1, right=-1)).astype(int)
    row = row[row >= 0]
    return float(columns.llr[:, row].sum() / len(columns.index))
