"""Which lattice the sides of slabs show: its bond, multiples and parts of its spacings.

A lattice found as two combs may be twice as fine, or as coarse, as the slabs, and says nothing of their bond.
The presence of every single slab side tells.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from autoreg.fitting.fit import Fit
from autoreg.ground.ground_frame import turned, with_origin
from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid
from autoreg.paving.bond import customary_shift
from autoreg.paving.lattice_evidence import Paving, has_ratio, presented, same_lattice
from autoreg.paving.multiples import divided
from autoreg.paving.patterns import Pattern, best_pattern, outstanding, skipping, true_sides
from autoreg.paving.presence import Presence
from autoreg.paving.side_support import Effort, presence_of

# A start whose sides carry less, in the best pattern of the clearer family, leads nowhere. Nor do most where
# the other family carries less than the second: it did in 200 of 340 that led nowhere, but also in one of 180
# that led to a lattice, of which the start had every second joint, or something beside it.
HOPEFUL_NATS, LEAST_HOPEFUL_NATS = 3.0, 0.0
# How much better a finer lattice must explain the sides between the joints, and how closely these are looked
# at: the largest in the picture tell.
SUBDIVIDE_NATS, BETWEEN = 6.0, Effort(sides=180, controls=900)
# How much better than a lattice a pattern of its absent sides must explain them to speak against it.
DEPARTS_NATS = 10.0


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


def settle_bond(
    picture: Float[np.ndarray, "h w"], fit: Fit, presence: Presence | None = None
) -> Paving | None:
    """The bond that the presence of a fit's single sides shows, as for `of_true_bond`; it may be known."""
    best = presented(picture, fit, presence)
    return None if best is None else of_true_bond(picture, best)


def of_true_bond(picture: Float[np.ndarray, "h w"], paving: Paving) -> Paving | None:
    """The bond that a lattice's single sides show, with its axes turned to suit it; None if they show none.

    The lattice is coarsened where whole classes of its sides are absent, and refined where sides are found
    between its joints.
    """
    best = paving
    for _ in range(6):
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
            if best.closer and without_absent:
                return None
            break
        best = other
    return None if departs(best.clearest) else best


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
    presence = presence_of(picture, fine, BETWEEN, only=family)
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
