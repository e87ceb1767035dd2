"""The paving that was found, measured at the photo's own resolution."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from autoreg.answer.camera_refusals import focal_untold
from autoreg.answer.last_step import likeliest
from autoreg.answer.pattern_refusals import (
    arcs,
    askew,
    fanned,
    filled,
    in_part,
    off_lattice,
    on_module,
    one_edged,
    turning,
    zigzag,
)
from autoreg.answer.refusals import ambiguous, hardly_met, maybe_wall, no_lattice, not_measured
from autoreg.answer.right_angles import Squared, square_up
from autoreg.answer.slab_shape import of_slab_shape
from autoreg.errors import Refusal
from autoreg.fitting.bare_steps import from_near_rims
from autoreg.fitting.beds import on_slabs_level
from autoreg.fitting.fit import Fit
from autoreg.fitting.lit_sides import beside_lit_sides
from autoreg.fitting.measure import NARROW
from autoreg.fitting.one_edge import met_at_one_edge, with_both_edges
from autoreg.fitting.refine import FROM_THE_FEET, WIDE_SEARCH, refine, refine_until_still
from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.ground.sight import Sight
from autoreg.paving.corrections import by_measured_shifts
from autoreg.paving.far_field import farther_field
from autoreg.paving.inner_joints import inner_share
from autoreg.paving.lattice_choice import of_joints_alone
from autoreg.paving.lattice_evidence import Paving, has_ratio, line_evidence, presented
from autoreg.paving.meetings import meetings
from autoreg.paving.side_support import presence_of
from autoreg.paving.whole_sides import part_that_is_there
from autoreg.rows.arcs import common_arc
from autoreg.rows.cross_joints import change_of_lean
from autoreg.rows.rows import STEP_SIGMA, Rows
from autoreg.rows.slab_lengths import longer_than_wide, slab_lengths
from autoreg.rows.turning_stones import (
    AROUND,
    common_turn,
    directions,
    straight,
    turn_across,
    turn_of_rows,
    turned_alike,
)
from autoreg.segments import Segments
from autoreg.slabs.uncertainty import Settled
from autoreg.solve.freedom import Free

# Rows must tell a focal length as well as EXIF does. It enters the tilt by sin(pitch) cos(pitch) at most, so
# that the tilt is within 3 degrees of the truth in 95 of 100 photos at the least.
MOST_FOCAL_SIGMA = 0.05
# How far joints are measured, in camera heights.
REACH = 12.0
# Where more joints than this are missed they are looked for farther off, from the camera's feet outwards.
MOST_MISSED = 0.3
# Joints that are so many times as wide as was thought at detection scale were met at one edge there.
BOTH_EDGES = 3.0
# Where most joints are wider than this at detection scale, it is no place to look for lines.
WIDEST_LINE_PX = 6.0


@dataclass(frozen=True)
class Laid:
    """Paving, measured at the photo's own resolution, and the presence of its sides at detection scale.

    `likeliest` is the fit at the pose that its joints' places make likeliest, `field` the convex part of the
    ground in which they were measured. Rows have a crossing to start their frame from, without a camera one
    at which they are square, and `longer` says whether their slabs are longer than a row is wide, if these
    tell.
    """

    fit: Fit
    settled: Paving
    likeliest: Settled
    field: np.ndarray
    crossing: np.ndarray | None = None
    squared: Squared | None = None
    longer: bool | None = None


def measured_rows(
    sight: Sight, picture: np.ndarray, found: Rows, free: Free, *, square: bool, ground: bool
) -> Laid:
    """Rows, with the focal length at which their cross joints are `square`, if that is asked for.

    `free` says what is known of the camera beforehand, `ground` that they are no wall's.

    Raises:
        Refusal: they cannot be measured, are arcs, or tell the focal length too little.
    """
    field, crossing = found.paving.presence.field, found.crossing
    fit, farther = _measured_whole(picture, found.paving, Free(step_sigma=STEP_SIGMA))
    change = change_of_lean(sight.segments, fit, field)
    ruled = straight(directions(sight.segments, fit, field)[:1])
    turn = None if ruled else turn_of_rows(sight.segments, fit, field)
    bowed = _bowed(sight.segments, fit, field) or fanned(change) or turning(turn)
    if bowed is not None:
        raise bowed
    squared = None
    if square:
        squared = _square(picture, fit, sight.segments, found, free, ground=ground)
        fit, crossing = squared.settled.fit, squared.crossing
    small = sight.looks.picture
    settled = _settled_rows(small, _at_detection_scale(fit, small, found.paving), found)
    rests = likeliest(picture, fit) if squared is None else squared.settled
    longer = longer_than_wide(slab_lengths(sight.segments, fit, settled.presence.field))
    return Laid(fit, settled, rests, _field(settled, farther), crossing, squared, longer)


def measured_slabs(
    sight: Sight, picture: np.ndarray, found: Paving, free: Free, slab: tuple[float, float] | None
) -> Laid:
    """A lattice, with the slab's ratio of sides if that is given.

    Raises:
        Refusal: it cannot be of such slabs, its joints are arcs, its slabs are full of joints, or it vanishes
            at full resolution.
    """
    small = sight.looks.picture
    start = found if slab is None else of_slab_shape(small, found, slab, free)
    fit, farther = _measured_whole(picture, start, free)
    fit = from_what_shows(fit)
    fit = on_slabs_level(fit) if sight.toned else fit
    field = found.presence.field
    bowed = _bowed(sight.segments, fit, field) or _turned(sight.segments, fit, field)
    if bowed is not None:
        raise bowed
    small = _with_lines(small, fit)
    settled = presented(small, _at_detection_scale(fit, small, start), within=start.within)
    if settled is None or settled.margin_nats < 0:
        raise no_lattice(settled, None)
    doubted = hardly_met(settled, fit.missed)
    if doubted is not None:
        raise doubted
    coarser = of_joints_alone(small, settled)
    # Who tells the slab has told which of the two it is, unless both have its shape.
    if coarser is not None and (slab is None or has_ratio(coarser.grid, slab)):
        raise ambiguous(settled, coarser)
    # By a camera that is known, joints at other angles do not look square to each other.
    part = part_that_is_there(small, settled.fit, settled.presence.field) if free.focal else None
    pattern = in_part(part) or _on_module(settled)
    if pattern is not None:
        raise pattern
    full = filled(inner_share(sight.segments, fit, settled.presence.field))
    if full is not None:
        raise full
    return Laid(fit, settled, likeliest(picture, fit), _field(settled, farther))


def _field(settled: Paving, farther: np.ndarray | None) -> np.ndarray:
    """Where joints were measured: as far as they were followed, or else where detection scale shows them."""
    return settled.presence.field if farther is None else farther


def from_what_shows(fit: Fit) -> Fit:
    """The fit with joints of which near slabs or light walls hide a part measured by what is left of them."""
    return beside_lit_sides(from_near_rims(fit))


def _bowed(segments: Segments, fit: Fit, field: np.ndarray) -> Refusal | None:
    """The refusal of a lattice, or of rows, whose unbroken joints are arcs; None if they may be straight."""
    one_way = fit.grid.shift or fit.grid.spacing_x is None
    for family in (ALONG_X,) if one_way else (ALONG_X, ALONG_Y):
        arc = common_arc(fit, family)
        # What lies across is looked at only where that matters.
        bowed = arcs(arc) and arcs(arc, turn_across(segments, fit, field, family))
        if bowed is not None:
            return bowed
    return None


def _turned(segments: Segments, fit: Fit, field: np.ndarray) -> Refusal | None:
    """The refusal of a lattice whose stones turn, or lie across it; None if they may not.

    They do so within its field, or turn in what lies around it.
    """
    run = directions(segments, fit, field)
    margins = (0.0,) if straight(run) else (0.0, AROUND)
    turns = (common_turn(segments, fit, field, margin=margin) for margin in margins)
    turned = next((refusal for turn in turns if (refusal := turning(turn))), None)
    return turned or zigzag(run) or askew(run) or off_lattice(turned_alike(run))


def _on_module(paving: Paving) -> Refusal | None:
    """The refusal of what looks like a stack bond, but is of stones of several sizes; None if it is one."""
    if paving.grid.spacing_x is None or paving.grid.shift:
        return None
    return on_module(meetings(paving.presence.inside(paving.presence.field)))


def _square(
    picture: np.ndarray, fit: Fit, segments: Segments, found: Rows, known: Free, *, ground: bool
) -> Squared:
    """Rows with the focal length at which their cross joints are square.

    Raises:
        Refusal: they tell it too little for a pose; those of what may be a wall, for that.
    """
    squared = square_up(picture, fit, segments, found.paving.presence.field, known, REACH)
    if squared is None:
        raise focal_untold("rows", None, np.inf, MOST_FOCAL_SIGMA)
    if squared.sigma_log_focal > MOST_FOCAL_SIGMA:
        settled, sigma = squared.settled, squared.sigma_log_focal
        wall = None if ground else maybe_wall(settled.fit, settled.covariance)
        raise wall or focal_untold("rows", settled.fit.camera.fx, sigma, MOST_FOCAL_SIGMA)
    return squared


def _measured_whole(picture: np.ndarray, paving: Paving, free: Free) -> tuple[Fit, np.ndarray | None]:
    """The fit of a lattice at the photo's own resolution, and how far it goes on if that is clearly farther.

    Raises:
        Refusal: its joints cannot be measured there.
    """
    field = paving.presence.field
    fit = _measure(picture, paving, free, field)
    farther = farther_field(picture, fit, field, len(paving.presence.p))
    if farther is None:
        return fit, None
    again = _measure(picture, replace(paving, fit=fit), free, farther)
    return (again, farther) if again.missed < MOST_MISSED else (fit, None)


def _measure(picture: np.ndarray, paving: Paving, free: Free, field: np.ndarray) -> Fit:
    """The fit of a lattice found at detection scale, repeated at the photo's own resolution.

    Raises:
        Refusal: its joints cannot be measured there.
    """
    coarse = paving.fit
    height, width = picture.shape

    def measured(near: Fit) -> Fit:
        # Where one family shows no joints of its own, they may have been too thin at detection scale.
        looks = replace(near.strip, polarity_known=near.strip.polarity.count(0) != 1)
        fit = refine_until_still(
            picture, near.camera.scaled(width, height), near.cam_from_ground, near.grid,
            free=free, search=NARROW, reach=REACH, strip=looks, field=field,
        )  # fmt: skip
        if fit is None:
            raise not_measured(len(paving.presence.p))
        return fit

    fit = measured(coarse)
    if fit.missed > MOST_MISSED:
        # Small slabs are few at detection scale, and their fit does not reach far.
        grown = refine(
            picture, coarse.camera.scaled(width, height), coarse.cam_from_ground, coarse.grid,
            free=free, search=WIDE_SEARCH, reaches=FROM_THE_FEET,
            strip=replace(coarse.strip, polarity_known=True), field=field,
        )  # fmt: skip
        again = None if grown is None else measured(grown)
        fit = again if again is not None and again.missed < fit.missed else fit
    fit = with_both_edges(picture, fit, reach=REACH, field=field)
    halved = one_edged(met_at_one_edge(picture, fit))
    if halved is not None:
        raise halved
    return by_measured_shifts(fit, measured)[-1]


def _with_lines(small: np.ndarray, fit: Fit) -> np.ndarray:
    """The photo at detection scale, or smaller, so that most joints of a fit are lines in it."""
    wide_px = np.array(fit.strip.width)[fit.stations.family] * fit.profiles.px_per_unit
    factor = WIDEST_LINE_PX / float(np.median(wide_px[fit.usable])) * fit.camera.width / small.shape[1]
    return (
        cv2.resize(small, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) if factor < 1 else small
    )


def _at_detection_scale(fit: Fit, small: np.ndarray, found: Paving) -> Fit:
    """A fit as the small picture shows it, where the presence of sides is judged."""
    camera = fit.camera.scaled(small.shape[1], small.shape[0])
    looks, before = fit.strip.resized(small.shape[1] / fit.camera.width), found.fit.strip
    # Thin joints may not show there. Of wide ones that were met at one edge there, both show.
    x, y = (
        looks.polarity[k] if looks.width[k] > BOTH_EDGES * before.width[k] else before.polarity[k]
        for k in (ALONG_X, ALONG_Y)
    )
    return replace(fit, camera=camera, strip=replace(looks, blur_px=before.blur_px, polarity=(x, y)))


def _settled_rows(small: np.ndarray, fit: Fit, rows: Rows) -> Paving:
    """Rows where they were found, by the camera and pose that they have led to.

    Raises:
        Refusal: there they do no better than chance, as arcs that looked like rows by a wrong camera.
    """
    presence = presence_of(small, fit)
    if len(presence.p) < 6:
        raise not_measured(len(presence.p))
    lines, _ = line_evidence(presence, fit.grid)
    settled = replace(rows, paving=Paving(fit, presence, (lines, rows.paving.evidence_nats[1])))
    if settled.margin_nats < 0:
        raise no_lattice(None, settled)
    return settled.paving
