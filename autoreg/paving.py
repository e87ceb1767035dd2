"""From a hypothesis of the ground's orientation to the slab lattice that lies on it.

The two families of joints are found as combs on the rectified ground; their common pose is refined by the
joints themselves; then the presence of every single slab side tells the bond.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from autoreg.bond import BondHypothesis, bond_hypotheses, customary_shift
from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.image import pyramid
from autoreg.periods import Comb, best_combs
from autoreg.presence import (
    FIELD_COST,
    FIELD_SHARES,
    Pattern,
    Presence,
    best_pattern,
    broken,
    field_polygon,
    side_presence,
    with_origin,
)
from autoreg.rectify import near_reach, rectify
from autoreg.refine import Fit, Free, refine
from autoreg.segments import Segments
from autoreg.sharpen import sharpen
from autoreg.stations import ALONG_X, ALONG_Y, Grid

# What a hypothesis must beat: spacings x phases of either family, times orientations of the ground.
TESTED_NATS = 2 * float(np.log(7000)) + float(np.log(24))
# Chance of one false alarm in this many photos without a lattice.
FALSE_ALARM_NATS = float(np.log(1000.0))
# Sides of one unbroken line stand and fall together: a line counts as at most this many independent ones.
INDEPENDENT_SIDES = 3.0
# Beyond this margin no other start is tried.
CERTAIN_NATS = 40.0
# The most starts tried on one plane after its first.
MOST_STARTS = 6
# Logarithm by which the sides' ratio in the photo may differ from the given one: coarse fits, uneven slabs
# and nominal sizes without the joint stay below it.
RATIO_TOLERANCE = 0.08
# A lattice this close to the best one is as good an answer.
RIVAL_NATS = 3.0
# How much better a finer lattice must explain the sides between the joints.
SUBDIVIDE_NATS = 6.0
# Size of the first look, and its and the second look's numbers of rows on the ground.
COARSE_PIXELS, COARSE_LINES, FINE_LINES = 110_000, 320, 800
# Planes whose joints carry less than this are not worth another start.
HOPELESS_NATS = 8.0
# Old ground axes from those turned by a quarter: the new X axis is the old Y, the new Y the old -X.
QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Paving:
    """A lattice on the ground with the pose that sees it.

    `evidence_nats` is the logarithm of the likelihood ratio of this lattice to chance, for the sides along X
    and along Y, unpenalised.
    """

    fit: Fit
    presence: Presence
    evidence_nats: tuple[float, float]

    @property
    def grid(self) -> Grid:
        """The lattice."""
        return self.fit.grid

    @property
    def margin_nats(self) -> float:
        """Evidence beyond what the number of tested hypotheses demands, of the weaker family in any case."""
        return min(
            sum(self.evidence_nats) - TESTED_NATS - FALSE_ALARM_NATS,
            2.0 * (min(self.evidence_nats) - 0.5 * TESTED_NATS),
        )


@dataclass(frozen=True)
class PlaneCombs:
    """One ground hypothesis with the joints found on it."""

    camera: Camera
    R: Float[np.ndarray, "3 3"]
    x: tuple[Comb, ...]
    y: tuple[Comb, ...]

    @property
    def score(self) -> float:
        """How much better the two best combs explain the plane than chance does."""
        return sum((combs[0].score for combs in (self.x, self.y) if combs), 0.0)


def comb_planes(
    picture: np.ndarray,
    segments: Segments,
    hypotheses: list[tuple[Camera, Float[np.ndarray, "3 3"]]],
    *,
    free_focal: bool,
) -> list[PlaneCombs]:
    """The joints of both families on each hypothesised ground, the planes with the clearest joints first.

    Each is looked at as it came and sharpened, finely and coarsely: directions of rough joints, and lenses
    that bend them, leave lines some pixels askew, which blurs a fine profile more than a coarse one.
    """
    coarse, _ = pyramid(picture, COARSE_PIXELS)
    planes: list[PlaneCombs] = []
    for camera, R in hypotheses:
        looks: list[PlaneCombs] = []
        for seen_by, turned in ((camera, R), sharpen(segments, camera, R, free_focal=free_focal)):
            small = seen_by.scaled(picture.shape[1], picture.shape[0])
            for view, size in ((coarse, COARSE_LINES), (picture, FINE_LINES)):
                rectified = rectify(view, small.scaled(view.shape[1], view.shape[0]), turned, size=size)
                if rectified is not None:
                    looks.append(PlaneCombs(small, turned, best_combs(rectified.x), best_combs(rectified.y)))
        if looks:
            planes.append(max(looks, key=lambda plane: plane.score))
    return sorted(planes, key=lambda plane: -plane.score)


def lay_lattice(picture: Float[np.ndarray, "h w"], plane: PlaneCombs, free: Free) -> tuple[Paving, ...]:
    """The lattices that several starts on a plane lead to, the one that explains the picture best first.

    Where both families repeat as whole lines, they are the start. A running bond seen from afar, or one with
    an unusual shift, shows its cross joints only course by course.
    """
    found: list[Paving] = []
    if plane.x and plane.y:
        found += _laid(picture, plane, _comb_start(plane.R, plane.x[0], plane.y[0]), free)
        if found and found[0].margin_nats > CERTAIN_NATS:
            return tuple(found)
    if plane.score < HOPELESS_NATS:
        return tuple(found)
    starts: list[tuple[Rigid, Grid]] = []
    coarse, _ = pyramid(picture.astype(np.uint8), COARSE_PIXELS)
    for view, size in ((coarse, COARSE_LINES), (picture, FINE_LINES)):
        camera = plane.camera.scaled(view.shape[1], view.shape[0])
        near = rectify(view, camera, plane.R, reach=near_reach(camera, plane.R), size=size)
        if near is None:
            continue
        starts += [_bond_start(plane.R, bond) for bond in bond_hypotheses(near, keep=2)]
        pairs = [(b, a) for b in best_combs(near.x, count=2) for a in best_combs(near.y, count=2)]
        pairs.sort(key=lambda p: -p[0].score - p[1].score)
        starts += [_comb_start(plane.R, b, a) for b, a in pairs[:2]]
    for start in starts[:MOST_STARTS]:
        found += _laid(picture, plane, start, free)
        if found and found[-1].margin_nats > CERTAIN_NATS:
            break
    return tuple(sorted(found, key=lambda paving: -paving.margin_nats))


def rival(pavings: tuple[Paving, ...]) -> Paving | None:
    """The first of the pavings whose lattice differs from the best one's and explains the picture as well."""
    best = pavings[0]
    mine = sorted((best.grid.spacing_x or 0.0, best.grid.spacing_y))
    for other in pavings[1:]:
        if other.margin_nats < max(0.0, best.margin_nats - RIVAL_NATS):
            break
        theirs = sorted((other.grid.spacing_x or 0.0, other.grid.spacing_y))
        turn = abs(other.grid.shift - best.grid.shift)
        if not np.allclose(mine, theirs, rtol=0.05) or 0.05 < turn < 0.95:
            return other
    return None


def suited(
    picture: Float[np.ndarray, "h w"], pavings: tuple[Paving, ...], slab: tuple[float, float]
) -> tuple[Paving, ...]:
    """The lattices, or coarser ones within them, whose sides are in the ratio of a known slab, best first.

    A few slabs can look like many halves; who knows the slab need not guess.
    """
    found = list(pavings)
    for paving in pavings[:3]:
        for family in (ALONG_X, ALONG_Y):
            coarser = [p for p in best_pattern(paving.presence, family) if p.period in (2, 3)][:4]
            whole = Pattern(1, 0, 0, 0.0)
            for pattern in coarser:
                pair = (pattern, whole) if family == ALONG_X else (whole, pattern)
                fit = with_pattern(paving.fit, *pair)
                other = None if fit is None or not has_ratio(fit.grid, slab) else presented(picture, fit)
                if other is not None:
                    found.append(other)
    return tuple(sorted((p for p in found if has_ratio(p.grid, slab)), key=lambda p: -p.margin_nats))


def has_ratio(grid: Grid, slab: tuple[float, float]) -> bool:
    """Whether a lattice's sides may be in the ratio of a slab's, in either order."""
    if grid.spacing_x is None:
        return True
    seen = np.log(max(grid.spacing_x, grid.spacing_y) / min(grid.spacing_x, grid.spacing_y))
    return bool(abs(seen - np.log(max(slab) / min(slab))) < RATIO_TOLERANCE)


def _comb_start(R: np.ndarray, b: Comb, a: Comb) -> tuple[Rigid, Grid]:
    return Rigid(R, R @ np.array([a.phase, b.phase, -1.0])), Grid(a.spacing, b.spacing)


def _bond_start(R: np.ndarray, bond: BondHypothesis) -> tuple[Rigid, Grid]:
    pose = Rigid(R, R @ np.array([bond.origin[0], bond.origin[1], -1.0]))
    return (Rigid(pose.R @ QUARTER_TURN, pose.t) if bond.turned else pose), bond.grid


def _laid(picture: np.ndarray, plane: PlaneCombs, start: tuple[Rigid, Grid], free: Free) -> list[Paving]:
    """The lattice that a start leads to, if any: refined from the camera outwards, then in its own field."""
    fit = refine(picture, plane.camera, *start, free=free, search=0.2, reaches=(2.5, 4.0, 7.0))
    if fit is None:
        return []
    presence = side_presence(picture, fit.camera, fit.cam_from_ground, fit.grid, fit.strip)
    if len(presence.p) < 6:
        return []
    within = refine(
        picture,
        fit.camera,
        fit.cam_from_ground,
        fit.grid,
        free=free,
        search=0.05,
        reaches=(9.0, 9.0),
        strip=fit.strip,
        field=field_polygon(presence),
    )
    settled = settle_bond(picture, within or fit)
    return [] if settled is None else [settled]


def settle_bond(picture: Float[np.ndarray, "h w"], fit: Fit) -> Paving | None:
    """The bond that the presence of the single sides shows, with the lattice's axes turned to suit it.

    The lattice is coarsened where whole classes of its sides are absent, and refined where sides are found
    between its joints.
    """
    best = presented(picture, fit)
    for _ in range(6):
        if best is None:
            return None
        fit, presence = best.fit, best.presence
        along_x, along_y = best_pattern(presence, ALONG_X)[0], best_pattern(presence, ALONG_Y)[0]
        changed = with_pattern(fit, along_x, along_y)
        if changed is None:
            changed = _subdivided(picture, fit)
        other = None if changed is None else presented(picture, changed)
        if other is None:
            break
        # What a staggered pattern promised must hold when the new lattice is measured by itself. A coarser
        # one has fewer lines to count, and is judged by the lines that the finer one predicts in vain.
        coarser = along_x.advance == along_y.advance == 0 and max(along_x.period, along_y.period) in (2, 3)
        if not coarser and sum(other.evidence_nats) < sum(best.evidence_nats) - 1.0:
            break
        best = other
    return best


def presented(picture: Float[np.ndarray, "h w"], fit: Fit) -> Paving | None:
    """A fit with the presence of its sides; None if they are too few, or break off as those of no bond do."""
    presence = side_presence(picture, fit.camera, fit.cam_from_ground, fit.grid, fit.strip)
    if len(presence.p) < 6 or broken(presence, ALONG_X) or broken(presence, ALONG_Y):
        return None
    return Paving(fit, presence, line_evidence(presence, fit.grid))


def _subdivided(picture: Float[np.ndarray, "h w"], fit: Fit) -> Fit | None:
    """The fit with a finer lattice, if sides are there between the joints of the one it has."""
    grid = fit.grid
    if grid.spacing_x is None:
        return None
    for factor in (2, 3):
        for family in (ALONG_X, ALONG_Y):
            if grid.shift and family == ALONG_X:
                continue
            a = grid.spacing_x / (factor if family == ALONG_Y else 1)
            b = grid.spacing_y / (factor if family == ALONG_X else 1)
            fine = replace(fit, grid=Grid(a, b, (grid.shift * factor) % 1.0 if grid.shift else 0.0))
            presence = side_presence(picture, fine.camera, fine.cam_from_ground, fine.grid, fine.strip)
            best = best_pattern(presence, family)
            same = (factor, _carry(grid, factor), 0)
            known = next(p for p in best if (p.period, p.advance, p.phase) == same)
            if best[0].score - known.score > SUBDIVIDE_NATS:
                other = Pattern(1, 0, 0, 0.0)
                x, y = (best[0], other) if family == ALONG_X else (other, best[0])
                return with_pattern(fine, x, y) or fine
    return None


def _carry(grid: Grid, factor: int) -> int:
    """How the columns of a lattice advance from row to row in the same lattice with finer columns."""
    return -int(np.floor(grid.shift * factor)) % factor if grid.shift else 0


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
        cam_from_ground=Rigid(moved.R @ QUARTER_TURN, moved.t),
        strip=replace(fit.strip, width=fit.strip.width[::-1], polarity=fit.strip.polarity[::-1]),
    )


def line_evidence(presence: Presence, grid: Grid) -> tuple[float, float]:
    """Log likelihood ratio of the lattice, per family, over the part of the picture that suits best."""
    options = [_evidence_of(presence.nearest(share), grid) for share in FIELD_SHARES]
    x, y = max(options, key=lambda pair: min(sum(pair), 2 * min(pair) + 20.0))
    return x - 0.5 * FIELD_COST, y - 0.5 * FIELD_COST


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
