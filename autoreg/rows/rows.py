"""Rows: unbroken joints at an even spacing, with cross joints at right angles that follow no period.

Random ashlar is the most common real paving. Its unbroken joints tell the pose at a known focal length; its
cross joints show that the ground is paved with slabs, not with boards, and give the frame a crossing to start
from. What their right angles tell of an unknown focal length is another stage's matter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from autoreg.fitting.fit import Fit
from autoreg.fitting.one_edge import with_both_edges
from autoreg.geometry import Rigid
from autoreg.ground.ground_frame import turned, with_origin
from autoreg.ground.sides import ALONG_X, Grid
from autoreg.paving.bond import FALSE_ALARM_NATS
from autoreg.paving.lattice_evidence import TESTED_NATS, Paving, line_evidence
from autoreg.paving.lay import FIELD_REACH, fit_outwards, refine_in_field
from autoreg.paving.patterns import true_sides
from autoreg.paving.plane_combs import PlaneCombs
from autoreg.paving.presence import Presence
from autoreg.paving.side_support import presence_of
from autoreg.rows.along_rows import along_rows
from autoreg.rows.cross_joints import CrossJoints, find_cross_joints, in_columns
from autoreg.segments import Segments, contrast_across
from autoreg.solve.freedom import Free

# One family of lines holds fewer motions than two: single solves may not wander further than this.
STEP_SIGMA = 0.004
# Combs with less are not looked into.
WORTH_NATS = 6.0
FEWEST_LINES = 6
# Mean p-value of joints that are absent, beyond that of the others, and how many lines may be missing.
ABSENT_P, MOST_MISSING = 0.3, 0.1
# Share of an unbroken joint that may be hidden or worn.
MOST_GAPS = 0.3
# A gap's pieces are absent beyond the others by so much, or by so many standard deviations: in rows by 4 at
# most, in herringbone as faint as its noise by 7 and more.
GAP_SIGMAS = 6.0
# Half slabs from one gap of a joint to the next, in herringbone of slabs of two and of three squares.
GAP_PERIODS = (4, 6, 8, 12)


@dataclass(frozen=True)
class Rows:
    """A field of rows, the cross joints in it, and a crossing to start its frame from."""

    paving: Paving
    cross: CrossJoints
    crossing: Float[np.ndarray, "2"]

    @property
    def fit(self) -> Fit:
        """The fit of the unbroken joints."""
        return self.paving.fit

    @property
    def margin_nats(self) -> float:
        """Evidence beyond what the number of tested hypotheses demands, for joints and cross joints alike."""
        x, y = self.paving.evidence_nats
        return min(x - 0.5 * TESTED_NATS - FALSE_ALARM_NATS, y - FALSE_ALARM_NATS)

    @property
    def in_columns(self) -> bool:
        """Whether the cross joints follow a law from row to row, as those of a bond or of herringbone do."""
        return in_columns(self.cross, self.paving.fit.grid.spacing_y)


def lay_rows(
    picture: Float[np.ndarray, "h w"], plane: PlaneCombs, segments: Segments, size: tuple[int, int]
) -> Rows | None:
    """The best field of rows on a plane, or None if it shows none.

    `size` is the photo's width and height, in whose pixels the segments are.
    """
    best: Rows | None = None
    for quarters, combs in ((0, plane.x), (1, plane.y)):
        if not combs or combs[0].score < WORTH_NATS:
            continue
        origin = np.array([combs[0].phase, 0.0, -1.0] if quarters else [0.0, combs[0].phase, -1.0])
        start = turned(Rigid(plane.R, plane.R @ origin), quarters)
        fit = _fit_rows(picture, plane, start, Grid(None, combs[0].spacing))
        found = None if fit is None else _rows_of(picture, fit, segments, size)
        if found is not None and (best is None or found.margin_nats > best.margin_nats):
            best = found
    return best


def _fit_rows(picture: np.ndarray, plane: PlaneCombs, start: Rigid, grid: Grid) -> Fit | None:
    """The fit of unbroken joints, coarsened where only every second or third of them is there."""
    for _ in range(4):
        fit = fit_outwards(picture, plane.camera, start, grid, Free(step_sigma=STEP_SIGMA))
        if fit is None:
            return None
        presence = presence_of(picture, fit)
        if len(presence.p) < 6:
            return None
        pattern = true_sides(presence, ALONG_X)
        if pattern.period == 1 or pattern.advance:
            within = refine_in_field(picture, fit, presence.field)
            return with_both_edges(picture, within, reach=FIELD_REACH, field=presence.field)
        # The lines between the joints have led that fit astray.
        start = with_origin(start, 0.0, pattern.phase * grid.spacing_y)
        grid = Grid(None, grid.spacing_y * pattern.period)
    return None


def _rows_of(picture: np.ndarray, fit: Fit, segments: Segments, size: tuple[int, int]) -> Rows | None:
    """The rows of a fit, if its joints are unbroken and even and cross joints lie between them."""
    presence = presence_of(picture, fit)
    if len(presence.p) < 6:
        return None
    field = presence.field
    cross = find_cross_joints(segments, fit, field, size)
    if len(cross.middle) == 0 or cross.run_through or not _evenly_spaced(presence, field):
        return None
    contrast = contrast_across(picture, segments, size)
    if along_rows(segments, contrast, fit, field, size).contradict or _interrupted(picture, fit, field):
        return None
    x, _ = line_evidence(presence, fit.grid)
    middle = np.median(cross.middle, axis=0)
    crossing = cross.middle[np.linalg.norm(cross.middle - middle, axis=1).argmin()]
    spacing = fit.grid.spacing_y
    on_joint = np.array([crossing[0], round(crossing[1] / spacing) * spacing])
    return Rows(Paving(fit, presence, (x, cross.evidence_nats)), cross, on_joint)


def _interrupted(picture: Float[np.ndarray, "h w"], fit: Fit, field: Float[np.ndarray, "k 2"]) -> bool:
    """Whether the joints break off at regular intervals, as those of herringbone do, or all too often.

    Where along a joint the slabs begin is not known, so that pieces of half a slab are looked at: one of a
    gap's pieces at least is wholly without a joint. The gaps advance evenly from joint to joint.
    """
    across = fit.grid.spacing_y
    halves = presence_of(picture, replace(fit, grid=Grid(across / 2.0, across))).inside(field)
    rows = np.flatnonzero(halves.sides.family == ALONG_X)
    if len(rows) == 0:
        return False
    line, p = halves.sides.line[rows], halves.p[rows]
    piece = np.round(halves.sides.middle[rows, 0] / (across / 2.0) - 0.5).astype(int)
    return bool(np.mean(p > ABSENT_P) > MOST_GAPS) or gaps_in_turn(piece, line, p)


def gaps_in_turn(
    piece: Int[np.ndarray, " n"], line: Int[np.ndarray, " n"], p: Float[np.ndarray, " n"]
) -> bool:
    """Whether the pieces of joints that are absent, by their p-values, advance evenly from line to line."""
    for period in GAP_PERIODS:
        for advance in range(period):
            residue = (piece - line * advance) % period
            count = np.bincount(residue, minlength=period)
            mean = np.bincount(residue, weights=p, minlength=period) / np.maximum(count, 1)
            beyond = np.minimum(ABSENT_P, GAP_SIGMAS * p.std() / np.sqrt(np.maximum(count, 1)))
            if np.any((count >= 6) & (mean > ABSENT_P) & (mean > np.median(mean) + beyond)):
                return True
    return False


def _evenly_spaced(presence: Presence, field: Float[np.ndarray, "k 2"]) -> bool:
    """Whether enough lines are there, and hardly any that the spacing predicts is not.

    Courses of uneven width would leave whole lines of an even spacing in the middle of slabs. Few lines do
    not fix the tilt of the ground by their spacing.
    """
    near = presence.inside(field)
    _, index, count = np.unique(near.sides.line, return_inverse=True, return_counts=True)
    mean = np.bincount(index, weights=near.p) / count
    judged = count >= 3
    missing = judged & (mean > ABSENT_P)
    enough = (judged & ~missing).sum() >= FEWEST_LINES
    return bool(enough and missing.sum() <= MOST_MISSING * judged.sum())
