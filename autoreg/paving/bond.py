"""How the courses are laid: stack bond, running bond with its shift, or rows without a period.

Given the unbroken joints, the picture falls into courses. In each course the cross joints are a comb of
their own; a bond is a law that ties the phases of these combs together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from autoreg.ground.bond_shift import nearest_customary
from autoreg.ground.rectify import Family, Rectified, line_support
from autoreg.ground.sides import Grid
from autoreg.paving.periods import MIN_STEP, PHASES, Comb, best_combs, blurred, line_llr, local_z

# Cross joints are judged clear of the unbroken joints that end them.
MARGIN = 0.12
# Samples of the courses' autocorrelation.
AUTOCORRELATION = 4096
# Either family must carry at least this much evidence for a bond to be looked into.
WORTH_NATS = 5.0
# Spacings of cross joints that are looked for among their places, in widths of a course.
CLOSEST, WIDEST = 0.4, 12.0
# How finely spacings and shifts are tried, against the least that the places can tell.
FINELY = 8
# Chance of one false alarm in this many photos without a lattice.
FALSE_ALARM_NATS = float(np.log(1000.0))
# A coarser spacing is preferred to parts of it that suit the places so much better at the most.
AS_GOOD = 0.8


@dataclass(frozen=True)
class BondHypothesis:
    """A lattice on the rectified ground, in camera heights.

    `turned`: the unbroken joints are those of the rectified picture's `y` family, so that the lattice's X
    axis is the rectified Y axis. `origin` is a crossing in the rectified axes. `score` is the log likelihood
    ratio of all its sides against chance, in nats.
    """

    grid: Grid
    turned: bool
    origin: Float[np.ndarray, "2"]
    score: float


@dataclass(frozen=True)
class Courses:
    """Log likelihood ratios of a joint at each place of each course.

    `index` k is the course from k to k + 1.
    """

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
    firsts, lasts = np.ceil(start).astype(int), np.floor(stop).astype(int) + 1
    for course, first, last in zip(k, firsts, lasts, strict=True):
        whole = (1 - 2 * MARGIN) * comb.spacing / float(np.median(step[max(0, first - 1) : last + 1]))
        if last - first < 4 or last - first < 0.5 * whole:
            continue
        columns = slice(first, last)
        part = family.part(columns)
        edges = np.rint(np.linspace(0, last - first, max(1, round((last - first) / 32)) + 1)).astype(int)
        support, samples = line_support(part, edges)
        counted = samples > 0.6 * np.diff(edges)
        valid = (samples.sum(1) > 0.5 * whole) & counted.any(1)
        if valid.sum() < 30:
            continue
        profile = (support * counted).sum(1) / np.maximum(counted.sum(1), 1)
        z = local_z(profile, valid, max(40, len(profile) // 4))
        kept.append(float(course))
        llr.append(np.where(valid, blurred(line_llr(z, valid)), 0.0))
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


def best_bonds(
    courses: Courses, offset: Float[np.ndarray, " n"], spacings: Float[np.ndarray, " a"]
) -> Float[np.ndarray, "a 3"]:
    """Best score, phase and shift for each spacing of the cross joints: an array of (score, phase, shift).

    The score is the mean over courses of the sum over cross joints.
    """
    n, c = len(offset), len(courses.index)
    if c == 0 or len(spacings) == 0:
        return np.column_stack([np.full(len(spacings), -np.inf), np.zeros((len(spacings), 2))])
    step, rows = np.gradient(offset), np.arange(n)
    wave = np.arange(PHASES)
    # Moving course k by k * shift is a product in the Fourier domain of the phase.
    turn = np.exp(2j * np.pi * ((courses.index[:, None, None] * wave[:, None] * wave) % PHASES) / PHASES)
    # Whatever is outside, or too near to the next one to be told from it, stands in one more row of zeros.
    by_place = np.vstack([courses.llr.T, np.zeros(c)])
    per_course = np.empty((PHASES, len(spacings), c))
    for s, a in enumerate(spacings):
        i = np.arange(np.floor(offset[0] / a) - 1, np.ceil(offset[-1] / a) + 2)
        at = (wave / PHASES * a)[:, None] + i * a
        row = np.rint(np.interp(at, offset, rows, left=-1, right=-1)).astype(np.intp)
        row[(row < 0) | (a / step[row] < MIN_STEP)] = n
        per_course[:, s] = by_place.take(row, axis=0).sum(1)
    moved = np.fft.fft(per_course, axis=0) @ turn.transpose(2, 0, 1)
    total = np.fft.ifft(moved, axis=0).real.transpose(1, 2, 0).reshape(len(spacings), -1)
    shift, phase = np.divmod(total.argmax(1), PHASES)
    return np.stack([total.max(1) / c, phase / PHASES * spacings, shift / PHASES], 1)


def bond_hypotheses(rectified: Rectified, *, combs: int = 3, keep: int = 4) -> tuple[BondHypothesis, ...]:
    """The best lattices on a rectified ground, best first."""
    found: list[BondHypothesis] = []
    of_family = {False: best_combs(rectified.x, count=combs), True: best_combs(rectified.y, count=combs)}
    for turned in (False, True):
        unbroken, cross = (rectified.y, rectified.x) if turned else (rectified.x, rectified.y)
        for comb in of_family[turned]:
            courses = course_support(cross, comb)
            spacings = _cross_spacings(courses, cross, comb, of_family[not turned])
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
                lines = _line_score(columns, unbroken.offset, comb)
                if min(lines, score * len(courses.index)) < WORTH_NATS:
                    continue
                # Turned by a quarter, course k becomes course -1 - k.
                origin = (comb.phase, phase - shift * a) if turned else (phase, comb.phase)
                grid = Grid(a, comb.spacing, customary_shift(float(-shift % 1.0 if turned else shift)))
                score_nats = lines + float(score) * len(courses.index)
                found.append(BondHypothesis(grid, turned, np.array(origin), score_nats))
    found.sort(key=lambda h: -h.score)
    return tuple(found[:keep])


def bond_of_places(
    along: Float[np.ndarray, " n"], course: Int[np.ndarray, " n"], width: float
) -> tuple[Grid, float] | None:
    """The bond that cross joints at such places of their courses have, and the phase of course 0; or None.

    The places' power at a frequency along the courses and one across them, the largest there is (Scargle
    1982), is exponential where they follow no law. It does not ask for joints that are not seen.

    Args:
        along: places along the courses.
        course: the course that each is in.
        width: of a course, in the places' unit.
    """
    n = len(along)
    if n == 0 or np.ptp(along) < width:
        return None
    first, courses = int(course.min()), int(np.ptp(course)) + 1
    frequency = np.arange(1.0 / (WIDEST * width), 1.0 / (CLOSEST * width), 1.0 / (FINELY * np.ptp(along)))
    shifts = np.arange(FINELY * courses) / (FINELY * courses)
    waves = np.exp(2j * np.pi * frequency[:, None] * along)
    by_course = waves @ (course[:, None] - first == np.arange(courses))
    moved = by_course @ np.exp(-2j * np.pi * np.arange(courses)[:, None] * shifts)
    power = np.abs(moved) ** 2 / n
    if power.max() < np.log(power.size) + FALSE_ALARM_NATS:
        return None
    best = power.max(1)
    coarsest = int(np.flatnonzero(best > AS_GOOD * best.max())[0])
    # The top of this peak, of which the first that is good enough is the side.
    while coarsest + 1 < len(best) and best[coarsest + 1] > best[coarsest]:
        coarsest += 1
    shift = int(power[coarsest].argmax())
    a = 1.0 / float(frequency[coarsest])
    phase = float(np.angle(moved[coarsest, shift])) / (2.0 * np.pi) - first * float(shifts[shift])
    return Grid(a, width, customary_shift(float(shifts[shift]))), (phase % 1.0) * a


def customary_shift(shift: float) -> float:
    """The shift in use by pavers next to a measured one, if there is one within the phases' resolution."""
    nearest = nearest_customary(shift)
    return nearest % 1.0 if abs(nearest - shift) < 1.2 / PHASES else shift


def _cross_spacings(courses: Courses, cross: Family, comb: Comb, combs: tuple[Comb, ...]) -> np.ndarray:
    """Spacings worth trying: peaks of the courses' autocorrelation, and multiples of the whole-line spacing.

    The autocorrelation of each course alone knows the spacing whatever the shift from course to course.
    """
    if len(courses.index) == 0:
        return np.zeros(0)
    offset = cross.offset
    finest = MIN_STEP * float(np.diff(offset).min())
    widest = min(8 * comb.spacing, 0.8 * float(np.ptp(offset)))
    uniform = np.linspace(offset[0], offset[-1], AUTOCORRELATION)
    row = np.rint(np.interp(uniform, offset, np.arange(len(offset)))).astype(int)
    hits = np.maximum(courses.llr[:, row], 0.0)
    seen = courses.seen[:, row].astype(float)
    # A hit is smeared over about one percent of the spacing that is looked for.
    power = np.zeros(AUTOCORRELATION)
    flat = seen * hits.sum(1, keepdims=True) / np.maximum(seen.sum(1, keepdims=True), 1.0)
    for signal, sign in ((hits, 1.0), (flat, -1.0)):
        spectrum = np.fft.rfft(signal, 2 * AUTOCORRELATION, axis=1)
        power += sign * np.fft.irfft((np.abs(spectrum) ** 2).sum(0))[:AUTOCORRELATION]
    power = np.convolve(power, np.ones(5) / 5, "same")
    lag = uniform - uniform[0]
    peaks = np.flatnonzero((power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:])) + 1
    peaks = peaks[(lag[peaks] > max(finest, comb.spacing / 6)) & (lag[peaks] < widest)]
    peaks = peaks[np.argsort(-power[peaks], kind="stable")[:8]]
    near = [lag[p] / m * f for p in peaks for m in (1, 2) for f in np.linspace(0.985, 1.015, 7)]
    near += [c.spacing * m * f for c in combs[:2] for m in (1, 2, 3, 4, 5) for f in (0.993, 1.0, 1.007)]
    return np.sort(np.array([s for s in near if finest <= s <= widest]))


def _line_score(columns: Courses, offset: np.ndarray, comb: Comb) -> float:
    """Log likelihood ratio of a comb's lines, column by column."""
    if len(columns.index) == 0:
        return 0.0
    first, last = (offset[[0, -1]] - comb.phase) / comb.spacing
    at = comb.phase + np.arange(np.floor(first), np.ceil(last) + 1) * comb.spacing
    row = np.rint(np.interp(at, offset, np.arange(len(offset)), left=-1, right=-1)).astype(int)
    return float(columns.llr[:, row[row >= 0]].sum())
