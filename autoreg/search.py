"""The search for the paving: from a photo's segments to the lattice, or the rows, that explain it best.

All of it is done at detection scale; what it finds is measured at the photo's own resolution afterwards.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from autoreg.answer.camera_refusals import camera_contradicted
from autoreg.answer.refusals import ambiguous, no_lattice
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.ground.directions import camera_rays, strongest_share
from autoreg.ground.ground_frame import with_origin
from autoreg.ground.ground_planes import ground_planes, ground_planes_unknown_focal, like_wall
from autoreg.ground.sight import Looks, Sight, see
from autoreg.paving.bond import bond_of_places
from autoreg.paving.lattice_choice import suited
from autoreg.paving.lattice_evidence import PLAIN_NATS, Paving, rival
from autoreg.paving.lay import lay_bond, lay_combs, lay_first, lay_lattice
from autoreg.paving.plane_combs import (
    PROMISING_NATS,
    SHARPENED,
    Hypothesis,
    PlaneCombs,
    comb_planes,
    planes_as_they_came,
    promising_plane,
    sharpened,
    with_other_focals,
)
from autoreg.rows.rows import Rows, lay_rows
from autoreg.segments import Segments
from autoreg.solve.freedom import Free

# Ground hypotheses that are taken from the segments, with a camera and without, and how many of them are
# looked into, those with the clearest joints first.
HYPOTHESES, HYPOTHESES_NO_FOCAL, MOST_PLANES = 8, 12, 3
# Beyond this margin the clearest ground's lattice is clear enough to leave grounds whose joints carry less
# than this share of its own, as they came.
CLEAR_NATS, LESS_CLEAR = 20.0, 0.5
# Where none of them has a lattice, so many other focal lengths of the clearest one are looked into.
MOST_FOCALS = 5
# Fewer segments than this do not tell that all run in one direction.
FEWEST_SEGMENTS = 20
# Logarithm by which the joints' own focal length differs from a given one, at least, that is to blame.
SAME_FOCAL = 0.03
# What is known of an uncalibrated camera's first radial distortion coefficient, which curved joints tell.
RADIAL_SIGMA = 0.1


def find_paving(
    sight: Sight,
    camera: Camera | None,
    slab: tuple[float, float] | None = None,
    *,
    walls: bool = True,
) -> Paving | Rows:
    """The lattice that explains the photo best, at detection scale; of those that suit the slab, if any do.

    What is plain to see by a known camera is found by the coarser segments alone, while the others are being
    looked for. They would tell a focal length too roughly.

    Args:
        sight: what is seen of the photo.
        camera: its camera, or None to look for a focal length as well.
        slab: sides of a slab in either order, if known.
        walls: whether grounds that look like a wall seen from the front are looked into as well.

    Raises:
        Refusal: none explains it better than chance.
    """
    looks = sight.looks

    def fitting(pavings: tuple[Paving, ...], *, halves: bool = False) -> tuple[Paving, ...]:
        return pavings if slab is None else suited(looks.picture, pavings, slab, halves=halves)

    def suitable(pavings: tuple[Paving, ...]) -> tuple[Paving, ...]:
        return fitting(pavings, halves=camera is not None) or pavings

    def glanced(segments: Segments, free: Free, hypotheses: list[Hypothesis]) -> tuple[Paving, ...]:
        first = _at_a_glance(looks, segments, hypotheses, free)
        return () if first is None else (first,)

    if camera is not None:
        coarse = sight.detection.coarse
        plain = fitting(glanced(coarse, *_hypotheses(coarse, sight.size, camera, walls=walls)))
        if _plain(plain):
            return _unrivalled(plain)
    segments = sight.segments
    free, hypotheses = _hypotheses(segments, sight.size, camera, walls=walls)
    glance = glanced(segments, free, hypotheses)
    best = fitting(glance)
    if not _plain(best):
        best, ranked = _lay_planes(
            looks, segments, hypotheses, best,
            lambda plane: suitable(lay_lattice(looks, plane, free)), free_focal=camera is None,
        )  # fmt: skip
        # By another focal length what is plain to see may have the slab's shape.
        if camera is None and not _plain(best) and _plain(glance):
            best = glance
        if not best or best[0].margin_nats <= 0:
            plain = suitable(_by_other_focals(looks, ranked, free)) if camera is None else ()
            if not _plain(plain):
                fields = _fields_of_rows(looks, segments, sight.size, ranked)
                plain = suitable(_by_cross_joints(looks, fields, free))
                if not plain or plain[0].margin_nats <= 0:
                    rows = _rows_alone(fields)
                    if rows is not None:
                        return rows
                    raise _no_paving(sight, camera, best, fields)
            best = plain
    return _unrivalled(best)


def _lay_planes(
    looks: Looks,
    segments: Segments,
    hypotheses: list[Hypothesis],
    best: tuple[Paving, ...],
    lay: Callable[[PlaneCombs], tuple[Paving, ...]],
    *,
    free_focal: bool,
) -> tuple[tuple[Paving, ...], list[PlaneCombs]]:
    """The best lattices of these and of those on the hypothesised grounds, and the grounds looked into.

    To sharpen a plane takes a good part of a second, and to lay a lattice on it some: that which is
    clearest as it came goes first, and where it shows a clear lattice those that are far less clear are left.
    """
    planes = planes_as_they_came(looks, hypotheses)
    if not planes:
        return best, []
    (first,) = sharpened(looks, segments, planes[:1], free_focal=free_focal)
    best = _better(best, lay(first))
    if _plain(best):
        return best, [first]
    clear = bool(best) and best[0].margin_nats > CLEAR_NATS
    others = [plane for plane in planes[1:] if not clear or plane.score > LESS_CLEAR * planes[0].score]
    others = sharpened(looks, segments, others, SHARPENED - 1, free_focal=free_focal)
    ranked = sorted([first, *others], key=lambda plane: -plane.score)[:MOST_PLANES]
    for plane in ranked:
        if plane is not first and not _plain(best):
            best = _better(best, lay(plane))
    return best, ranked


def _better(best: tuple[Paving, ...], others: tuple[Paving, ...]) -> tuple[Paving, ...]:
    """Those lattices of the two whose first explains the picture better."""
    return max(best, others, key=lambda pavings: pavings[0].margin_nats if pavings else -np.inf)


def promises(sight: Sight, camera: Camera | None) -> bool:
    """Whether a photo shows enough of two families of joints, at the first glance, to look for a lattice."""
    _, hypotheses = _hypotheses(sight.segments, sight.size, camera)
    return promising_plane(sight.looks, sight.segments, hypotheses) is not None


def find_on(sight: Sight, camera: Camera, R: Float[np.ndarray, "3 3"]) -> Paving | None:
    """The lattice on a known ground that does better than chance, if any does, at detection scale.

    Args:
        sight: what is seen of the photo.
        camera: its camera.
        R: cam_from_ground rotation, along whose X and Y axes the joints run.
    """
    free, looks, segments = Free(ratio=True), sight.looks, sight.segments
    found = _at_a_glance(looks, segments, [(camera, R)], free)
    if found is None or not found.plain:
        planes = comb_planes(looks, segments, [(camera, R)], free_focal=False)
        found = next((paving for plane in planes for paving in lay_lattice(looks, plane, free)), None)
    return found if found is not None and found.margin_nats > 0 else None


def find_rows(sight: Sight, camera: Camera | None) -> Rows | None:
    """The rows that explain the photo best, at detection scale, if any do better than chance.

    For photos whose lattice, as `find_paving` gave it, has turned out to be none.
    """
    looks, segments = sight.looks, sight.segments
    _, hypotheses = _hypotheses(segments, sight.size, camera)
    planes = comb_planes(looks, segments, hypotheses, free_focal=camera is None)[:MOST_PLANES]
    fields = _fields_of_rows(looks, segments, sight.size, planes)
    return _rows_alone(fields)


def _by_other_focals(looks: Looks, planes: list[PlaneCombs], free: Free) -> tuple[Paving, ...]:
    """The lattice that is plain to see on the clearest plane by another focal length, if any is.

    By the right one the first start shows it: others, which take several times as long, never did.
    """
    if not planes or planes[0].score < PROMISING_NATS:
        return ()
    for plane in with_other_focals(looks, planes[0])[:MOST_FOCALS]:
        laid = lay_first(looks, plane, free)
        if laid is not None and laid.plain:
            return (laid,)
    return ()


def _plain(pavings: tuple[Paving, ...]) -> bool:
    return bool(pavings) and pavings[0].plain


def _unrivalled(pavings: tuple[Paving, ...]) -> Paving:
    """The best of some pavings.

    Raises:
        Refusal: another one explains the picture as well.
    """
    other = rival(pavings)
    if other is not None:
        raise ambiguous(pavings[0], other)
    return pavings[0]


def other_camera(sight: Sight, camera: Camera, found: Paving | None = None) -> Refusal | None:
    """Why a camera is to blame for showing no lattice, or only the one found: the joints clearly fit another.

    A small field that is seen by the right camera, the joints' own camera explains hardly better; one that is
    left of a large field by a wrong camera, it explains far better.
    """
    free, hypotheses = _hypotheses(sight.segments, sight.size, None)
    other = _at_a_glance(sight.looks, sight.segments, hypotheses, free)
    explained = 0.0 if found is None else found.margin_nats
    if other is None or other.margin_nats < explained + PLAIN_NATS:
        return None
    focal = other.fit.camera.scaled(camera.width, camera.height).fx
    alike = abs(np.log(focal / camera.fx)) < SAME_FOCAL
    return None if alike else camera_contradicted(camera, focal)


def upright_by(sight: Sight, camera: Camera | None) -> int | None:
    """By how many quarter turns clockwise a photo shows a lattice on the ground that is plain to see, if so.

    For a photo that shows none as it is: it may stand on its side, or be of a wall.
    """
    small = sight.looks.picture
    height, width = small.shape
    for quarters in (1, 2, 3):
        turned = see(np.ascontiguousarray(np.rot90(small.astype(np.uint8), -quarters)))
        own = None if camera is None else camera.scaled(width, height).turned(quarters)
        # What is plain to see by a known camera, the coarser segments tell.
        segments = turned.segments if own is None else turned.detection.coarse
        free, hypotheses = _hypotheses(segments, turned.size, own)
        found = _at_a_glance(turned.looks, segments, hypotheses, free)
        if found is not None and found.plain:
            return quarters
    return None


def _at_a_glance(looks: Looks, segments: Segments, hypotheses: list[Hypothesis], free: Free) -> Paving | None:
    """The lattice on the likeliest ground, where it is plain to see."""
    plane = promising_plane(looks, segments, hypotheses)
    return None if plane is None else lay_combs(looks, plane, free)


def _hypotheses(
    segments: Segments, size: tuple[int, int], camera: Camera | None, *, walls: bool = True
) -> tuple[Free, list[Hypothesis]]:
    """Grounds that the segments suggest, and what else is solved for while they are looked into."""
    if camera is not None:
        free = Free(ratio=True)
        found = [(camera, h.R) for h in ground_planes(segments, camera, max_hypotheses=HYPOTHESES)]
    else:
        free = Free(ratio=True, focal=True, radial=True, radial_sigma=RADIAL_SIGMA)
        guessed = ground_planes_unknown_focal(segments, *size, max_hypotheses=HYPOTHESES_NO_FOCAL)
        found = [(Camera.from_focal(*size, focal), h.R) for h, focal in guessed]
    return free, [(own, R) for own, R in found if walls or not like_wall(R)]


def _by_cross_joints(looks: Looks, fields: list[tuple[Rows, PlaneCombs]], free: Free) -> tuple[Paving, ...]:
    """The lattice of the clearest rows, if their cross joints follow a law, though most are too faint.

    Seen from afar only some of a running bond's cross joints are found.
    """
    if not fields or fields[0][0].margin_nats <= 0:
        return ()
    rows, plane = fields[0]
    fit, middle = rows.paving.fit, rows.cross.middle
    width = fit.grid.spacing_y
    bond = bond_of_places(middle[:, 0], np.floor(middle[:, 1] / width).astype(int), width)
    if bond is None:
        return ()
    grid, phase = bond
    laid = lay_bond(looks, plane, with_origin(fit.cam_from_ground, phase, 0.0), grid, free)
    return () if laid is None else (laid,)


def _fields_of_rows(
    looks: Looks, segments: Segments, size: tuple[int, int], planes: list[PlaneCombs]
) -> list[tuple[Rows, PlaneCombs]]:
    """The rows on some planes, with their planes, the clearest first."""
    fields = [(lay_rows(looks.picture, plane, segments, size), plane) for plane in planes]
    found = [(rows, plane) for rows, plane in fields if rows is not None]
    return sorted(found, key=lambda field: -field[0].margin_nats)


def _clearest_alone(fields: list[tuple[Rows, PlaneCombs]]) -> Rows | None:
    """The clearest of some rows whose cross joints are of no bond, nor of herringbone."""
    return next((rows for rows, _ in fields if not rows.in_columns), None)


def _rows_alone(fields: list[tuple[Rows, PlaneCombs]]) -> Rows | None:
    """The clearest of these rows, if they do better than chance."""
    rows = _clearest_alone(fields)
    return rows if rows is not None and rows.margin_nats > 0 else None


def _no_paving(
    sight: Sight,
    camera: Camera | None,
    rejected: tuple[Paving, ...],
    fields: list[tuple[Rows, PlaneCombs]],
) -> Refusal:
    """The refusal of a photo in which neither a lattice nor rows do better than chance."""
    one_way = 0.0
    if len(sight.segments) >= FEWEST_SEGMENTS:
        # How many edges run in one direction is about the same by any focal length.
        usual = camera or Camera.from_focal(*sight.size, float(max(sight.size)))
        one_way = strongest_share(camera_rays(sight.segments, usual))
    return no_lattice(rejected[0] if rejected else None, _clearest_alone(fields), one_way)
