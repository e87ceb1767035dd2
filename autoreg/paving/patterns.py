"""Sides that are absent in a regular pattern: the slabs form a coarser lattice, another bond, or none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int

from autoreg.ground.points import lengths
from autoreg.ground.sides import ALONG_X
from autoreg.paving.presence import MISSED, Presence

# Mean p-values of a class of sides that is absent, and of one that is there.
BROKEN_P, PRESENT_P = 0.35, 0.15
# A class that looks weakly there, as marks of other kinds make it, is absent none the less where it stands
# out by so many standard deviations: in 80 photos of lattices one does by 2.6 at most, in herringbone by 12.
SURELY_SIGMAS = 6.0
# Periods that are looked for, how many classes of each may be absent, and the standard deviations by which
# they then stand out from the next where those that are there are worn: in 140 families of joints of lattices
# that are none the less whole one does by 2.0 at most. Two of five are absent in pinwheels of large and small
# squares whose sides are as two to one, by 8 and more.
BREAKS = ((3, 1, 3.0), (4, 1, 3.0), (5, 2, 4.5))
# ... and where the others are plainly there: in patterns by 3.6 and more, by 1.2 where a patch of moss hid
# some of a few bricks' joints.
PRESENT_SIGMAS = 3.0
# Pieces of an unbroken joint are as long as others if they are at least by this factor.
AS_LONG = 0.95
# Each class must hold so many sides, and in a small field so many: herringbone's held 24 and more there.
LEAST_OF_CLASS, LEAST_OF_FEW = 5, 12
# A single line may be worn or covered as a whole: of lines, with so many sides, so many are asked for in
# every class.
FEWEST_SIDES, FEWEST_LINES = 4, 3
# Joints stand out if they are stronger than what lies beside them so much more often than weaker, in so many
# pairs at least. In lattices of true joints they are by 0.46 at most, where every second or third is by 0.7.
STRONGER, FEWEST_PAIRS = 0.65, 16
# Neighbouring joints that are both there are too few for a lattice of slabs below this share of what chance
# would leave, and so many standard deviations of that. In 130 families of joints of lattices they are no less
# than nineteen in twenty of it.
BESIDE_SHARE, BESIDE_SIGMAS = 0.6, 3.5
# How much better a pattern of absent sides must explain them than all sides being there.
DEPARTURE_NATS = 3.0


@dataclass(frozen=True)
class Pattern:
    """Which sides of a fine lattice belong to the true one.

    `family` x sides present where (line - cell * advance) % period == phase, likewise for y. `period` 1 is
    all of them.
    """

    period: int
    advance: int
    phase: int
    score: float

    def same_sides(self, other: Pattern) -> bool:
        """Whether both are of the same sides."""
        mine, theirs = ((p.period, p.advance, p.phase) for p in (self, other))
        return mine == theirs


def best_pattern(
    presence: Presence, family: int, periods: tuple[int, ...] = (1, 2, 3, 4, 5, 6)
) -> list[Pattern]:
    """Patterns of one family's sides, best first, by the sum of log likelihood ratios.

    Absent sides are held against a pattern that predicts them and for one that does not, so neither half
    nor twice the spacing can win.
    """
    rows = np.flatnonzero(presence.sides.family == family)
    line, cell = presence.sides.line[rows], presence.sides.cell[rows]
    keys = [(m, q, r) for m in periods for q in range(m) for r in range(m)]
    # Twice the spacing is as good a lattice as any; the others must earn their freedom.
    cost = [np.log(m) if q == 0 and m <= 2 else 2 * np.log(m) + DEPARTURE_NATS for m, q, _ in keys]
    ways = np.concatenate([_residues(line, cell, m, q) for m in periods for q in range(m)], 1)
    by_missed = presence.llr_by_missed[:, rows].astype(np.float32)
    fields, prices = zip(*presence.possible_fields, strict=True)
    held = np.array(fields)[:, rows]
    weights = (held[:, None] * by_missed).reshape(len(held) * len(MISSED), len(rows))
    sums = weights @ ways
    best = (sums.reshape(len(held), len(MISSED), -1).max(1) - np.array(prices)[:, None]).max(0) - cost
    found = [Pattern(m, q, r, float(score)) for (m, q, r), score in zip(keys, best, strict=True)]
    return sorted(found, key=lambda pattern: -pattern.score)


def _residues(line: np.ndarray, cell: np.ndarray, period: int, advance: int) -> Float32[np.ndarray, "n m"]:
    """Ones where a side is of a residue class of the lattice counted obliquely."""
    residue = (line - cell * advance) % period
    return (residue[:, None] == np.arange(period)).astype(np.float32)


def true_sides(presence: Presence, family: int) -> Pattern:
    """Which sides of a family are there, and are joints."""
    best = best_pattern(presence, family)[0]
    return (outstanding(presence, family) or best) if best.period == 1 else best


def outstanding(presence: Presence, family: int) -> Pattern | None:
    """The sides of a regular class that are joints, while those between them are other marks; or None.

    A shadow's edge or a vein may lie on a predicted joint, which then does not look absent. But joints of one
    kind are about as strong as their neighbours: where each of a class is stronger than those beside it, and
    these are weakly there, they are none.
    """
    inside = presence.inside(presence.field)
    rows = np.flatnonzero(inside.sides.family == family)
    line, cell = inside.sides.line[rows], inside.sides.cell[rows]
    p, support = inside.p[rows], inside.support[rows]
    classes = [
        (m, q, r, chosen)
        for m in (2, 3)
        for q in range(m)
        for r, chosen in enumerate(_residues(line, cell, m, q).T > 0)
        if chosen.any() and not chosen.all() and p[~chosen].mean() >= PRESENT_P
    ]
    if not classes:
        return None
    best, most = None, STRONGER
    mine, theirs, apart = _neighbours(line, cell)
    for m, q, r, chosen in classes:
        pairs = np.flatnonzero(chosen[mine] & ~chosen[theirs] & (apart < m))
        if len(pairs) < FEWEST_PAIRS:
            continue
        stronger = float(np.sign(support[mine[pairs]] - support[theirs[pairs]]).mean())
        if stronger > most:
            best, most = Pattern(m, q, r, stronger), stronger
    return best


def _neighbours(line: Int[np.ndarray, " n"], cell: Int[np.ndarray, " n"]) -> Int[np.ndarray, "3 k"]:
    """Pairs of sides of one cell that lie one or two lines apart, either way round, and how many."""
    sides = list(zip(line.tolist(), cell.tolist(), strict=True))
    at = {side: k for k, side in enumerate(sides)}
    pairs = [
        (k, at[own + d, place], abs(d))
        for k, (own, place) in enumerate(sides)
        for d in (-2, -1, 1, 2)
        if (own + d, place) in at
    ]
    return np.array(pairs, dtype=int).reshape(-1, 3).T


def skipping(presence: Presence, family: int) -> bool:
    """Whether hardly any two neighbouring joints of a family are both there, though many single ones are.

    Slabs of twice the length, which begin at one of two places in every course as it comes, leave every
    other joint of each course out, and no regular class of them all.
    """
    inside = presence.inside(presence.field)
    rows = np.flatnonzero(inside.sides.family == family)
    there = inside.there[rows]
    one, other, apart = _neighbours(inside.sides.line[rows], inside.sides.cell[rows])
    pairs = np.flatnonzero((apart == 1) & (one < other))
    if len(pairs) == 0:
        return False
    share, both = float(there.mean()), int((there[one[pairs]] & there[other[pairs]]).sum())
    expected = len(pairs) * share**2
    sigma = np.sqrt(expected) * (1.0 - share)
    return bool(both < BESIDE_SHARE * expected and both < expected - BESIDE_SIGMAS * sigma)


def broken(presence: Presence, family: int, *, few: bool = False) -> bool:
    """Whether the joints of a family break off at regular intervals, as those of herringbone do.

    The sides of one residue class, counted obliquely over the lattice, or of two, are then absent while all
    others are there; no stack or running bond of whole slabs looks like that. Whole lines that break off so
    are those of courses of two widths in turn, or of the edges of joints as wide as half of their slabs.
    Of a `few` sides the absent class must stand out from the next even where that is plainly there.
    """
    rows = np.flatnonzero(presence.sides.family == family)
    line, p = presence.sides.line[rows], presence.p[rows]
    if len(rows) == 0:
        return False
    # Counted by place: the rows of a running bond count their sides from starts of their own.
    ends = presence.sides.ends[rows][:, :, 0 if family == ALONG_X else 1]
    cell = np.floor(ends.mean(1) / np.median(np.ptp(ends, axis=1)) + 1e-6).astype(int)
    for m, most, sigmas in BREAKS:
        for q in range(m):
            residue = (line - cell * q) % m
            count = np.bincount(residue, minlength=m)
            if count.min() < (LEAST_OF_FEW if few else LEAST_OF_CLASS):
                continue
            mean = np.bincount(residue, weights=p, minlength=m) / count
            scatter = np.sqrt(((p - mean[residue]) ** 2).sum() / max(len(p) - m, 1))
            order = np.argsort(mean)
            for absent in range(1, most + 1):
                there, gone = order[-absent - 1], order[-absent]
                unit = float(scatter * np.sqrt(1 / count[gone] + 1 / count[there]))
                present = mean[there] < PRESENT_P and not few
                clear = _absent(
                    float(mean[gone]), float(mean[there]), unit, PRESENT_SIGMAS if present else sigmas
                )
                if clear and (q > 0 or _whole_lines(line, p, m, int(gone))):
                    return True
    return False


def half_there(presence: Presence, *, few: bool = False) -> bool:
    """Whether every other piece of a running bond's unbroken joints is absent, while the others are there.

    The cross joints of both courses cut them into such pieces. Edges of hexagons lie so, one of each, where
    two of their three directions are taken for square to each other; of slabs the longer pieces are seen at
    least as well as the others.
    """
    rows = np.flatnonzero(presence.sides.family == ALONG_X)
    p, second = presence.p[rows], presence.sides.cell[rows] % 2 == 1
    length = lengths(presence.sides.ends[rows, 1] - presence.sides.ends[rows, 0])
    kinds = [np.flatnonzero(second == kind) for kind in (False, True)]
    if min(map(len, kinds)) < (LEAST_OF_FEW if few else LEAST_OF_CLASS):
        return False
    there, gone = sorted(kinds, key=lambda kind: float(p[kind].mean()))
    if np.median(length[gone]) < AS_LONG * np.median(length[there]):
        return False
    most, least = float(p[gone].mean()), float(p[there].mean())
    sigmas = PRESENT_SIGMAS if least < PRESENT_P else SURELY_SIGMAS
    return _absent(most, least, sigma_apart(p[gone], p[there]), sigmas)


def sigma_apart(one: Float[np.ndarray, " n"], other: Float[np.ndarray, " m"]) -> float:
    """Standard deviation of the difference of two means."""
    return float(np.sqrt(one.var() / len(one) + other.var() / len(other)))


def _absent(gone: float, there: float, sigma: float, sigmas: float) -> bool:
    """Whether by mean p-values sides of one class are absent beside another: by so many standard deviations.

    Those that look weakly there stand out by more.
    """
    if gone > BROKEN_P and gone - there > sigmas * sigma:
        return True
    return gone > PRESENT_P and gone - there > SURELY_SIGMAS * sigma


def _whole_lines(line: Int[np.ndarray, " n"], p: Float[np.ndarray, " n"], period: int, phase: int) -> bool:
    """Whether each line of a class is there less than any other, with enough of every class to tell."""
    lines, of_line, count = np.unique(line, return_inverse=True, return_counts=True)
    long = count >= FEWEST_SIDES
    mean, residue = (np.bincount(of_line, weights=p) / count)[long], lines[long] % period
    enough = np.bincount(residue, minlength=period).min() >= FEWEST_LINES
    return bool(enough and mean[residue == phase].min() > mean[residue != phase].max())
