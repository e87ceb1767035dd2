"""Which lattice the sides of slabs show: its bond, multiples and parts of its spacings, and rivals.

A lattice found as two combs may be twice as fine, or as coarse, as the slabs, and says nothing of their bond.
The presence of every single slab side tells.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from autoreg.fitting.fit import Fit
from autoreg.ground.ground_frame import turned, with_origin
from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid
from autoreg.paving.bond import FALSE_ALARM_NATS, customary_shift
from autoreg.paving.multiples import divided
from autoreg.paving.patterns import Pattern, best_pattern, broken, outstanding, skipping, true_sides
from autoreg.paving.presence import (
    ALONG_SAMPLES,
    CLOSE_SAMPLES,
    GROUND_COST,
    Presence,
    looked_at_closer,
    presence_of,
)
from autoreg.solve.freedom import log_stretch

# What a hypothesis must beat: spacings x phases of either family, times orientations of the ground.
TESTED_NATS = 2 * float(np.log(7000)) + float(np.log(24))
# Sides of one unbroken line stand and fall together: a line counts as at most this many independent ones.
INDEPENDENT_SIDES = 3.0
# Logarithm by which the sides' ratio in the photo may differ from the given one: coarse fits, uneven slabs
# and nominal sizes without the joint stay below it.
RATIO_TOLERANCE = 0.08
# A start whose sides carry less, in the best pattern of the clearer family, leads nowhere. Nor do most where
# the other family carries less than the second: it did in 200 of 340 that led nowhere, but also in one of 180
# that led to a lattice, of which the start had every second joint, or something beside it.
HOPEFUL_NATS, LEAST_HOPEFUL_NATS = 3.0, 0.0
# A lattice this close to the best one is as good an answer, and another one if its spacings or its shift
# differ by more than these.
RIVAL_NATS, SAME_SPACING, SAME_SHIFT = 3.0, 0.05, 0.05
# How much better a finer lattice must explain the sides between the joints.
SUBDIVIDE_NATS = 6.0
# How much better than a lattice a pattern of its absent sides must explain them to speak against it.
DEPARTS_NATS = 10.0
# Beyond this margin a lattice is plain to see. Where it is less, a small field is looked at by itself, unless
# it is so little that nothing comes of it.
PLAIN_NATS, NOTHING_NATS = 40.0, -25.0
# Crossings of two lattices that are nearer to each other than this, in slabs, are the same.
SAME_PLACE = 1e-3
# Sides that tell it, the largest in the picture, and places between them that they are held against.
SUBDIVIDE_SIDES, SUBDIVIDE_CONTROLS = 180, 900


@dataclass(frozen=True)
class Paving:
    """A lattice on the ground with the pose that sees it.

    `evidence_nats` is the logarithm of the likelihood ratio of this lattice to chance, for the sides along X
    and along Y, unpenalised. `closer` are the sides of a small field, where it was looked at by itself.
    `within` is the convex part of the ground, in the fit's frame, whose sides alone count; None for all.
    """

    fit: Fit
    presence: Presence
    evidence_nats: tuple[float, float]
    closer: Presence | None = None
    within: Float[np.ndarray, "k 2"] | None = None

    @property
    def grid(self) -> Grid:
        """The lattice."""
        return self.fit.grid

    @property
    def clearest(self) -> Presence:
        """The sides that tell most of the bond."""
        return self.closer or self.presence

    @property
    def margin_nats(self) -> float:
        """Evidence beyond what the number of tested hypotheses demands, of the weaker family in any case."""
        return min(
            sum(self.evidence_nats) - TESTED_NATS - FALSE_ALARM_NATS,
            2.0 * (min(self.evidence_nats) - 0.5 * TESTED_NATS),
        )

    @property
    def plain(self) -> bool:
        """Whether it is plain to see over the picture, so that no other lattice need be looked for.

        A small field may be all that a bad fit has met of a large one.
        """
        return self.closer is None and self.margin_nats > PLAIN_NATS


def rival(pavings: tuple[Paving, ...]) -> Paving | None:
    """The first of the pavings whose lattice differs from the best one's and explains the picture as well."""
    best = pavings[0]
    for other in pavings[1:]:
        if other.margin_nats < max(0.0, best.margin_nats - RIVAL_NATS):
            break
        if not alike(best, other, SAME_SPACING):
            return other
    return None


def alike(one: Paving, other: Paving, spacing: float) -> bool:
    """Whether two lattices have about the same shift, and the same spacings to so large a share of them."""
    apart = abs(other.grid.shift - one.grid.shift)
    if SAME_SHIFT < apart < 1.0 - SAME_SHIFT:
        return False
    return np.allclose(_sides_in_heights(one), _sides_in_heights(other), rtol=spacing)


def _sides_in_heights(paving: Paving) -> list[float]:
    """The slab's sides in camera heights, the shorter one first: fits differ in their units."""
    height = float(paving.fit.cam_from_ground.origin_in_a[2])
    return sorted(side / height for side in (paving.grid.spacing_x or 0.0, paving.grid.spacing_y))


def suited(
    picture: Float[np.ndarray, "h w"], pavings: tuple[Paving, ...], slab: tuple[float, float], *, halves: bool
) -> tuple[Paving, ...]:
    """The lattices, or coarser ones within them, whose sides are in the ratio of a known slab, best first.

    A few slabs can look like many halves; who knows the slab need not guess, where the camera is known as
    well. By another focal length, slabs in another ratio are more likely than `halves`.
    """
    found = list(pavings)
    for paving in pavings[:3] if halves else ():
        for family in (ALONG_X, ALONG_Y):
            coarser = [p for p in best_pattern(paving.presence, family) if p.period in (2, 3)][:4]
            whole = Pattern(1, 0, 0, 0.0)
            for pattern in coarser:
                pair = (pattern, whole) if family == ALONG_X else (whole, pattern)
                fit = with_pattern(paving.fit, *pair)
                other = None if fit is None or not has_ratio(fit.grid, slab) else presented(picture, fit)
                if other is not None:
                    # Halves of a slab have its shape.
                    alone = of_joints_alone(picture, other)
                    found.append(alone if alone is not None and has_ratio(alone.grid, slab) else other)
    return tuple(sorted((p for p in found if has_ratio(p.grid, slab)), key=lambda p: -p.margin_nats))


def of_joints_alone(picture: Float[np.ndarray, "h w"], paving: Paving) -> Paving | None:
    """The coarser lattice within one whose sides alone are joints; None if they all are.

    Edges of smaller stones beside a field may lie where halves of its slabs would have joints.
    """
    along_x, along_y = (true_sides(paving.clearest, family) for family in (ALONG_X, ALONG_Y))
    if along_x.period == along_y.period == 1 or along_x.advance or along_y.advance:
        return None
    whole = Pattern(1, 0, 0, 0.0)
    wider = with_pattern(paving.fit, whole, along_y) or paving.fit
    fit = with_pattern(wider, along_x, whole) or wider
    return None if fit is paving.fit else presented(picture, fit, within=paving.within)


def has_ratio(grid: Grid, slab: tuple[float, float]) -> bool:
    """Whether a lattice's sides may be in the ratio of a slab's, in either order."""
    if grid.spacing_x is None:
        return True
    return abs(log_stretch(grid.spacing_x, grid.spacing_y, slab)) < RATIO_TOLERANCE


def settle_bond(
    picture: Float[np.ndarray, "h w"], fit: Fit, presence: Presence | None = None
) -> Paving | None:
    """The bond that the presence of the single sides shows, with the lattice's axes turned to suit it.

    The lattice is coarsened where whole classes of its sides are absent, and refined where sides are found
    between its joints. The `presence` of its sides may be known.
    """
    best = presented(picture, fit, presence)
    for _ in range(6):
        if best is None:
            return None
        fit, presence = best.fit, best.clearest
        along_x, along_y = true_sides(presence, ALONG_X), true_sides(presence, ALONG_Y)
        without_absent = with_pattern(fit, along_x, along_y)
        changed = without_absent or _subdivided(picture, fit)
        if changed is None or same_lattice(fit, changed):
            break
        other = presented(picture, changed)
        if other is None:
            break
        # What a staggered pattern promised must hold when the new lattice is measured by itself. A coarser
        # one has fewer lines to count, and is judged by the lines that the finer one predicts in vain.
        coarser = along_x.advance == along_y.advance == 0 and max(along_x.period, along_y.period) in (2, 3)
        if not coarser and sum(other.evidence_nats) < sum(best.evidence_nats) - 1.0:
            # A small field has too few sides to be whole in spite of those that are absent.
            best = None if best.closer and without_absent else best
            break
        best = other
    return None if best is None or departs(best.clearest) else best


def departs(presence: Presence) -> bool:
    """Whether the sides that are absent follow a pattern that no lattice was found for: some other paving."""
    for family in (ALONG_X, ALONG_Y):
        if skipping(presence, family):
            return True
        patterns = best_pattern(presence, family)
        whole = next(pattern for pattern in patterns if pattern.period == 1)
        if patterns[0].score - whole.score > DEPARTS_NATS:
            return True
    return False


def hopeful(presence: Presence, *, both: bool) -> bool:
    """Whether some regular choice of a lattice's sides is clearly there in one family, or is in `both`."""
    best = [best_pattern(presence, family)[0].score for family in (ALONG_X, ALONG_Y)]
    return max(best) > HOPEFUL_NATS and (min(best) > LEAST_HOPEFUL_NATS or not both)


def same_lattice(one: Fit, other: Fit) -> bool:
    """Whether two fits have the same joints, up to rounding; their origins may be different crossings."""
    grids = [(fit.grid.spacing_x or 0.0, fit.grid.spacing_y, fit.grid.shift) for fit in (one, other)]
    R = one.cam_from_ground.R
    if not (np.allclose(grids[0], grids[1]) and np.allclose(R, other.cam_from_ground.R)):
        return False
    x, y, _ = R.T @ (other.cam_from_ground.t - one.cam_from_ground.t)
    row = y / one.grid.spacing_y
    places = np.array([row, x / (one.grid.spacing_x or np.inf) - row * one.grid.shift])
    return bool(np.abs(places - np.round(places)).max() < SAME_PLACE)


def presented(
    picture: Float[np.ndarray, "h w"],
    fit: Fit,
    presence: Presence | None = None,
    *,
    within: Float[np.ndarray, "k 2"] | None = None,
) -> Paving | None:
    """A fit with the presence of its sides; None if they are too few, or break off as those of no bond do.

    Where a convex part of the ground is given, in the fit's frame, the sides `within` it alone.
    """
    presence = presence or presence_of(picture, fit, field=within)
    if len(presence.p) < 6 or broken(presence, ALONG_X) or broken(presence, ALONG_Y):
        return None
    paving = Paving(fit, presence, line_evidence(presence, fit.grid), within=within)
    if not NOTHING_NATS < paving.margin_nats < PLAIN_NATS:
        return paving
    # Noise hides joints that more samples show; where slabs are uneven, these show no more.
    presence = presence_of(picture, fit, field=within, along_samples=CLOSE_SAMPLES)
    thorough = replace(paving, presence=presence, evidence_nats=line_evidence(presence, fit.grid))
    better = max(paving, thorough, key=lambda p: p.margin_nats)
    samples = CLOSE_SAMPLES if better is thorough else ALONG_SAMPLES
    price = 0.5 * GROUND_COST
    closer = looked_at_closer(picture, fit, better.presence, samples)
    x, y = _evidence_of(closer, fit.grid)
    alone = replace(better, evidence_nats=(x - price, y - price), closer=closer)
    return max(better, alone, key=lambda p: p.margin_nats)


def _subdivided(picture: Float[np.ndarray, "h w"], fit: Fit) -> Fit | None:
    """The fit with a finer lattice, if sides are there between the joints of the one it has."""
    if fit.grid.spacing_x is None:
        return None
    families = (ALONG_Y,) if fit.grid.shift else (ALONG_X, ALONG_Y)
    for factor in (2, 3):
        for family in families:
            found = _finer(picture, fit, factor, family)
            if found is not None:
                return found
    return None


def _finer(picture: Float[np.ndarray, "h w"], fit: Fit, factor: int, family: int) -> Fit | None:
    """The fit with so many times as many joints of a family, or some of them, if these are there."""
    fine = divided(fit, family, factor)
    if fine is None:
        return None
    presence = presence_of(
        picture, fine, limit=SUBDIVIDE_SIDES, only=family, controls_wanted=SUBDIVIDE_CONTROLS
    )
    best = best_pattern(presence, family)
    same = Pattern(factor, carry(fit.grid, factor), 0, 0.0)
    known = next(p for p in best if p.same_sides(same))
    if best[0].score - known.score <= SUBDIVIDE_NATS:
        return None
    stronger = outstanding(presence, family)
    if stronger is not None and not stronger.same_sides(best[0]):
        return None
    whole = Pattern(1, 0, 0, 0.0)
    x, y = (best[0], whole) if family == ALONG_X else (whole, best[0])
    return with_pattern(fine, x, y) or fine


def carry(grid: Grid, factor: int) -> int:
    """How the columns of a lattice advance from row to row in the same lattice with finer columns."""
    return int(np.floor(grid.shift * factor)) % factor


def with_pattern(fit: Fit, along_x: Pattern, along_y: Pattern) -> Fit | None:
    """The fit with the lattice that a pattern of present sides means; None if it is the one it has."""
    grid, pose = fit.grid, fit.cam_from_ground
    a, b = grid.spacing_x, grid.spacing_y
    if a is None or along_x.period == along_y.period == 1:
        return None
    if along_y.period > 1 and (grid.shift or along_x.period == 1 or along_y.advance == 0):
        # Present are the columns phase + advance * row + k * period of each row.
        shift = customary_shift(((along_y.advance + grid.shift) / along_y.period) % 1.0)
        origin = with_origin(pose, along_y.phase * a, 0.0)
        return replace(fit, grid=Grid(a * along_y.period, b, shift), cam_from_ground=origin)
    if grid.shift:
        return None
    if along_x.advance == 0:
        origin = with_origin(pose, 0.0, along_x.phase * b)
        return replace(fit, grid=Grid(a, b * along_x.period), cam_from_ground=origin)
    if along_y.period > 1:
        return None
    # The unbroken joints run along Y: the new X axis is Y, the new Y axis is -X. The new course 0 is the old
    # column -1, hence the one advance in its phase.
    moved = with_origin(pose, 0.0, (along_x.phase - along_x.advance) * b)
    shift = (-along_x.advance / along_x.period) % 1.0
    return replace(
        fit,
        grid=Grid(b * along_x.period, a, shift),
        cam_from_ground=turned(moved),
        strip=replace(fit.strip, width=fit.strip.width[::-1], polarity=fit.strip.polarity[::-1]),
    )


def line_evidence(presence: Presence, grid: Grid) -> tuple[float, float]:
    """Log likelihood ratio of the lattice, per family, over the part of the picture that suits best."""
    options = [
        tuple(evidence - 0.5 * price for evidence in _evidence_of(presence.take(np.flatnonzero(field)), grid))
        for field, price in presence.possible_fields
    ]
    x, y = max(options, key=lambda pair: min(sum(pair), 2 * min(pair) + 20.0))
    return x, y


def _evidence_of(presence: Presence, grid: Grid) -> tuple[float, float]:
    """Log likelihood ratio of the lattice, per family, with the sides of a line taken together."""
    total: list[float] = []
    for family in (ALONG_X, ALONG_Y):
        rows = np.flatnonzero(presence.sides.family == family)
        line = presence.sides.line[rows]
        if family == ALONG_Y and grid.shift:
            line = line * 10_000 + presence.sides.cell[rows]
        _, inverse = np.unique(line, return_inverse=True)
        count = np.bincount(inverse)
        mean = np.bincount(inverse, weights=presence.llr(rows)) / np.maximum(count, 1)
        total.append(float((mean * np.minimum(count, INDEPENDENT_SIDES)).sum()))
    return total[0], total[1]
