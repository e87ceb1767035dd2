"""The lattice, or the rows, that explain a photo best: several ways of looking, the quickest first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from autoreg.answer.refusals import ambiguous, no_lattice, without_contrast
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.ground.directions import camera_rays, strongest_share
from autoreg.ground.ground_planes import shares_at_right_angles
from autoreg.ground.sight import Looks, Sight
from autoreg.ground.upright import LED_RAD, possible_up
from autoreg.paving.lattice_choice import suited
from autoreg.paving.lattice_evidence import Paving, rival
from autoreg.paving.lay import MOST_STARTS, lay_lattice
from autoreg.paving.plane_combs import Hypothesis, PlaneCombs, comb_planes, planes_as_they_came
from autoreg.rows.rows import Rows
from autoreg.search.glance import at_a_glance
from autoreg.search.hypotheses import hypothesised, hypothesised_along_grain, hypothesised_thoroughly
from autoreg.search.planes import (
    MOST_PLANES,
    better,
    by_other_focals,
    is_plain,
    is_there,
    lay_planes,
    lay_promising,
)
from autoreg.search.rows_on_planes import (
    by_cross_joints,
    clearest_alone,
    clearest_first,
    crossed,
    fields_of_rows,
    plain_alone,
    rows_alone,
)
from autoreg.segments import Segments
from autoreg.solve.freedom import Free

# Strong lines lead to a lattice by the first start on a ground or these after it, if they do at all.
FEW_STARTS = 2
# A lattice with less than this is hardly better than chance: what more grounds show may be far better.
HARDLY_NATS = 10.0
# Fewer segments than this do not tell in what directions most run.
FEWEST_SEGMENTS = 20


def find_paving(
    sight: Sight,
    camera: Camera | None,
    slab: tuple[float, float] | None = None,
    *,
    walls: bool = True,
    thorough: bool = True,
) -> Paving | Rows:
    """The lattice that explains the photo best, at detection scale; of those that suit the slab, if any do.

    What is plain to see by a known camera is found by the coarser segments alone, while the others are being
    looked for. They would tell a focal length too roughly.

    Args:
        sight: what is seen of the photo.
        camera: its camera, or None to look for a focal length as well.
        slab: sides of a slab in either order, if known.
        walls: whether grounds that look like a wall seen from the front are looked into as well.
        thorough: whether more is looked at than the clearest grounds, which takes several times as long.

    Raises:
        Refusal: none explains it better than chance.
    """
    if camera is not None:
        early = _Search.by(sight, sight.detection.coarse, camera, slab, walls=walls)
        seen = early.fitting(early.glanced())
        if is_plain(seen):
            return _unrivalled(seen)
    search = _Search.by(sight, sight.segments, camera, slab, walls=walls)
    glance = search.glanced()
    best = search.fitting(glance)
    if is_plain(best):
        return _unrivalled(best)
    best, planes = search.clearest(best)
    # By another focal length what is plain to see may have the slab's shape.
    if camera is None and not is_plain(best) and is_plain(glance):
        best = glance
    if is_there(best):
        return _unrivalled(search.clearer(best, camera) if thorough and camera is not None else best)
    fields = fields_of_rows(sight.looks, search.segments, sight.size, planes)
    if thorough and (camera is None or not plain_alone(fields)):
        # By grounds that are at hand: to find others takes longer.
        others, stronger = search.strongest()
        if _is_ground(others):
            return _unrivalled(others)
        others = search.by_other_focals(planes) if camera is None else ()
        if is_there(others):
            return _unrivalled(others)
        more = fields_of_rows(sight.looks, search.segments, sight.size, stronger)
        fields = clearest_first([*fields, *more])
        others = () if camera is None else search.further(camera, along_grain=not crossed(fields))
        if is_there(others):
            return _unrivalled(others)
    others = search.suitable(by_cross_joints(sight.looks, fields, search.free))
    if is_there(others):
        return _unrivalled(others)
    rows = rows_alone(fields)
    if rows is None:
        raise _no_paving(sight, camera, best, fields)
    return rows


@dataclass(frozen=True)
class _Search:
    """The grounds that a photo's segments suggest, and what is solved for while they are looked into."""

    looks: Looks
    segments: Segments
    slab: tuple[float, float] | None
    walls: bool
    free: Free
    hypotheses: list[Hypothesis]

    @classmethod
    def by(
        cls,
        sight: Sight,
        segments: Segments,
        camera: Camera | None,
        slab: tuple[float, float] | None,
        *,
        walls: bool,
    ) -> _Search:
        """The search by some segments of a photo; the rest is as for `find_paving`."""
        free, hypotheses = hypothesised(segments, sight.size, camera, walls=walls)
        return cls(sight.looks, segments, slab, walls, free, hypotheses)

    def fitting(self, pavings: tuple[Paving, ...], *, halves: bool = False) -> tuple[Paving, ...]:
        """Those of some lattices that suit the slab; with `halves`, as halves or doubles of themselves."""
        return pavings if self.slab is None else suited(self.looks.picture, pavings, self.slab, halves=halves)

    def suitable(self, pavings: tuple[Paving, ...]) -> tuple[Paving, ...]:
        """Those of some lattices that suit the slab, else all of them."""
        return self.fitting(pavings, halves=not self.free.focal) or pavings

    def glanced(self) -> tuple[Paving, ...]:
        """What the first glance shows."""
        first = at_a_glance(self.looks, self.segments, self.hypotheses, self.free)
        return () if first is None else (first,)

    def clearest(self, best: tuple[Paving, ...]) -> tuple[tuple[Paving, ...], list[PlaneCombs]]:
        """The best of these lattices and of those on the clearest grounds, and these grounds."""
        lay = self._lay_by(self.looks, MOST_STARTS)
        return lay_planes(self.looks, self.segments, self.hypotheses, best, lay, free_focal=self.free.focal)

    def strongest(self) -> tuple[tuple[Paving, ...], list[PlaneCombs]]:
        """The best lattices on the grounds whose lines are strongest, and these grounds."""
        return self._promising(self.looks.by_strength, self.hypotheses, FEW_STARTS)

    def by_other_focals(self, planes: list[PlaneCombs]) -> tuple[Paving, ...]:
        """What is plain to see on the clearest ground by another focal length."""
        return self.suitable(by_other_focals(self.looks, planes, self.free))

    def further(self, camera: Camera, *, along_grain: bool) -> tuple[Paving, ...]:
        """The best lattices on grounds that only a closer look at the segments suggests.

        Those that are turned about a grain are many, and are for joints without any edge across them.
        """
        closer = [lambda: hypothesised_thoroughly(self.segments, camera, self.hypotheses, walls=self.walls)]
        if along_grain:
            closer.append(lambda: hypothesised_along_grain(self.segments, camera, walls=self.walls))
        tried = (self._promising(self.looks, hypotheses(), MOST_STARTS)[0] for hypotheses in closer)
        return next((laid for laid in tried if _is_ground(laid)), ())

    def clearer(self, best: tuple[Paving, ...], camera: Camera) -> tuple[Paving, ...]:
        """What a closer look at the segments shows, if clearer than a lattice hardly better than chance."""
        if best[0].margin_nats > HARDLY_NATS:
            return best
        return better(best, self.further(camera, along_grain=False))

    def _promising(
        self, looks: Looks, hypotheses: list[Hypothesis], most_starts: int
    ) -> tuple[tuple[Paving, ...], list[PlaneCombs]]:
        lay = self._lay_by(looks, most_starts)
        planes = planes_as_they_came(looks, hypotheses)
        return lay_promising(looks, self.segments, planes, lay, free_focal=self.free.focal)

    def _lay_by(self, looks: Looks, most_starts: int) -> Callable[[PlaneCombs], tuple[Paving, ...]]:
        return lambda plane: self.suitable(lay_lattice(looks, plane, self.free, most_starts=most_starts))


def _is_ground(pavings: tuple[Paving, ...]) -> bool:
    """Whether the first of some lattices does better than chance, on what may be ground.

    From a ground that may, the joints may have led to one that may not.
    """
    return is_there(pavings) and bool(possible_up(pavings[0].fit.cam_from_ground.R[:, 2], LED_RAD))


def find_on(sight: Sight, camera: Camera, R: Float[np.ndarray, "3 3"]) -> Paving | None:
    """The lattice on a known ground that does better than chance, if any does, at detection scale.

    Args:
        sight: what is seen of the photo.
        camera: its camera.
        R: cam_from_ground rotation, along whose X and Y axes the joints run.
    """
    return _found_on(sight, camera, R)[0]


def plain_on(sight: Sight, camera: Camera, R: Float[np.ndarray, "3 3"]) -> Paving | None:
    """The lattice on a known ground, as for `find_on`, if it is plain to see at the first glance."""
    found = at_a_glance(sight.looks, sight.segments, [(camera, R)], Free(ratio=True))
    return found if found is not None and found.plain else None


def find_lattice_or_rows_on(
    sight: Sight, camera: Camera, R: Float[np.ndarray, "3 3"]
) -> Paving | Rows | None:
    """The lattice on a known ground, as for `find_on`, or else the rows there that do better than chance."""
    found, planes = _found_on(sight, camera, R)
    return found or rows_alone(fields_of_rows(sight.looks, sight.segments, sight.size, planes))


def _found_on(
    sight: Sight, camera: Camera, R: Float[np.ndarray, "3 3"]
) -> tuple[Paving | None, list[PlaneCombs]]:
    """The lattice on a known ground, and the ground as it was looked into, unless a glance showed enough."""
    looks, planes = sight.looks, list[PlaneCombs]()
    found = plain_on(sight, camera, R)
    if found is None:
        planes = comb_planes(looks, sight.segments, [(camera, R)], free_focal=False)
        laid = (paving for plane in planes for paving in lay_lattice(looks, plane, Free(ratio=True)))
        found = next(laid, None)
    return found if found is not None and found.margin_nats > 0 else None, planes


def find_promising(sight: Sight, planes: list[PlaneCombs]) -> Paving | Rows | None:
    """The lattice, or else the rows, on those grounds of a known camera whose joints are clear, if any are.

    `planes` are the grounds as they came, the clearest first.
    """
    free, looks, segments = Free(ratio=True), sight.looks, sight.segments
    pavings, clear = lay_promising(
        looks, segments, planes, lambda plane: lay_lattice(looks, plane, free), free_focal=False
    )
    if is_there(pavings):
        return pavings[0]
    return rows_alone(fields_of_rows(looks, segments, sight.size, clear))


def find_rows(sight: Sight, camera: Camera | None) -> Rows | None:
    """The rows that explain the photo best, at detection scale, if any do better than chance.

    For photos whose lattice, as `find_paving` gave it, has turned out to be none.
    """
    looks, segments = sight.looks, sight.segments
    _, hypotheses = hypothesised(segments, sight.size, camera)
    planes = comb_planes(looks, segments, hypotheses, free_focal=camera is None)[:MOST_PLANES]
    fields = fields_of_rows(looks, segments, sight.size, planes)
    return rows_alone(fields)


def _unrivalled(pavings: tuple[Paving, ...]) -> Paving:
    """The best of some pavings.

    Raises:
        Refusal: another one explains the picture as well.
    """
    other = rival(pavings)
    if other is not None:
        raise ambiguous(pavings[0], other)
    return pavings[0]


def _no_paving(
    sight: Sight,
    camera: Camera | None,
    rejected: tuple[Paving, ...],
    fields: list[tuple[Rows, PlaneCombs]],
) -> Refusal:
    """The refusal of a photo in which neither a lattice nor rows do better than chance."""
    plain = without_contrast(float(np.ptp(np.percentile(sight.looks.picture, (1.0, 99.0)))))
    if plain is not None:
        return plain
    one_way, crossing = 0.0, (0.0, 0.0)
    if len(sight.segments) >= FEWEST_SEGMENTS:
        # How many edges run in one direction is about the same by any focal length.
        usual = camera or Camera.from_focal(*sight.size, float(max(sight.size)))
        one_way = strongest_share(camera_rays(sight.segments, usual))
        crossing = shares_at_right_angles(sight.segments, *sight.size, camera)
    return no_lattice(rejected[0] if rejected else None, clearest_alone(fields), one_way, crossing)
