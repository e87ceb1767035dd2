"""Of several fields of paving in a photo, the largest.

What is plainest to see in a photo, mostly what is nearest, is found first. Where many edges beside it run
square to each other as well, the field is painted over and the rest of the photo looked at as a photo of its
own. What is found there by the same camera on the same ground is another field, and the answer if it is
larger in the picture, or if its slabs are those that were asked for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from autoreg.camera import Camera
from autoreg.fitting.fit import Fit
from autoreg.geometry import Rigid, rotation_from_vector
from autoreg.ground.points import inside_convex, lengths, on_ground, project_ground
from autoreg.ground.sight import Box, Sight, see
from autoreg.paving.lattice_evidence import Paving, alike, has_ratio, presented
from autoreg.paving.lay import refine_in_field
from autoreg.paving.presence import Presence
from autoreg.paving.side_support import Effort, presence_of
from autoreg.search.find import find_on
from autoreg.segments import Segments

# Edges up to so many camera heights away are looked at. Those that are square to each other within an angle
# tell of another field.
REACH, SQUARE_RAD = 12.0, np.radians(3.0)
# They are so many times as long as those in the field that is known; where its slabs are not those that are
# looked for, less is enough.
BESIDE, BESIDE_UNSUITED = 0.35, 0.1
# No direction has less than this share of them: those of houses have next to nothing that is square to them
# on the ground.
BOTH = 0.05
# Bins of the angles of edges, up to quarter turns.
ANGLES = 45
# The rest of a photo is the box that holds all but this share of the edges beside the field at each end.
STRAY = 0.03
# A smaller part shows too little.
LEAST_PX = 150
# Fields that lie on planes further apart are not on the same ground.
SAME_GROUND_RAD = np.radians(2.0)
# Two lattices whose spacings are nearer to each other than this share, and whose shifts are about the same,
# may be one: by a camera that is off by a fifth they change by as much from one part of it to another.
ALIKE = 0.2
# All the sides of a field, so that its extent is told.
WHOLE = Effort(sides=6000)
# Of a field that is painted over, so much of a slab's shorter side is left at the rim: its outermost joint
# may be that of slabs beside it.
RIM = 0.75
# Steps along each side of a field's outline, which a lens bends, and what paint is mixed from: a picture of
# this share of the size, over this share of its longer side.
OUTLINE_STEPS, PAINT_SCALE, PAINT_REACH = 40, 0.125, 0.08


def largest_field(
    sight: Sight, found: Paving, camera: Camera, slab: tuple[float, float] | None = None
) -> Paving:
    """The larger one of the field that was found and another beside it, if there is any.

    Of two fields, one of which has slabs of the known shape, that one.

    Args:
        sight: what is seen of the photo.
        found: the paving that was found in it first, at detection scale.
        camera: the photo's camera.
        slab: sides of a slab in either order, if known.
    """
    suits = _suits(found, slab)
    pose = found.fit.cam_from_ground
    covered, part = _Covered(pose, found.presence.field), None
    least = BESIDE if suits else BESIDE_UNSUITED
    if _part_beside(sight.segments, camera, covered, least) is not None:
        # There may be edges beside what was looked at of the field, and none beside all of it.
        covered = _Covered(pose, presence_of(sight.looks.picture, found.fit, WHOLE).field)
        part = _part_beside(sight.segments, camera, covered, least)
    if part is None:
        return found
    other = _found_in(sight, camera, covered.less(RIM * min(found.grid.slab_size)), part)
    if other is None or alike(found, other, ALIKE):
        return found
    whole = in_whole(sight, camera, other)
    if whole is None or not same_ground(found.fit, whole.fit):
        return found
    # It is plain to see, in its part or in the whole, unless it is what was asked for.
    if not (other.plain or whole.plain) and (suits or not _suits(whole, slab)):
        return found
    if _suits(whole, slab) != suits:
        return found if suits else whole
    assert whole.within is not None
    return whole if _area_px(whole.fit, whole.within) > _area_px(found.fit, covered.field) else found


def _suits(paving: Paving, slab: tuple[float, float] | None) -> bool:
    """Whether a lattice may be one of the slabs that are known, or of any where none are."""
    return slab is None or has_ratio(paving.grid, slab)


@dataclass(frozen=True)
class _Covered:
    """A part of the ground that is known to be paved, a convex polygon in the frame of a pose."""

    cam_from_ground: Rigid
    field: Float[np.ndarray, "k 2"]

    def less(self, rim: float) -> _Covered:
        """The same without a rim of such a width along the axes."""
        middle = 0.5 * (self.field.min(0) + self.field.max(0))
        left = np.maximum(0.0, 1.0 - 2.0 * rim / np.ptp(self.field, axis=0))
        return replace(self, field=middle + left * (self.field - middle))

    def holds(self, px: Float[np.ndarray, "n 2"], camera: Camera) -> Bool[np.ndarray, " n"]:
        """Which pixels show a place in it, or beside it by little."""
        ground = on_ground(px, camera, self.cam_from_ground)
        margin = 0.02 * float(np.ptp(self.field, axis=0).max())
        return inside_convex(ground, self.field, margin)

    def outline_px(self, camera: Camera) -> Int[np.ndarray, "n 2"]:
        """Its outline in the picture."""
        steps = np.arange(OUTLINE_STEPS)[:, None, None] / OUTLINE_STEPS
        corners = self.field + steps * (np.roll(self.field, -1, axis=0) - self.field)
        px = project_ground(camera, self.cam_from_ground, corners.swapaxes(0, 1).reshape(-1, 2))
        far = 4 * max(camera.width, camera.height)
        return np.round(np.clip(px[np.isfinite(px).all(1)], -far, far)).astype(int)

    def shown(self, camera: Camera) -> UInt8[np.ndarray, "h w"]:
        """Ones where the picture shows it."""
        ones = np.zeros((camera.height, camera.width), np.uint8)
        cv2.fillPoly(ones, [self.outline_px(camera)], 1)
        return ones


@dataclass(frozen=True)
class _Part:
    """A part of a photo; X and Y of the cam_from_ground rotation `R` run along its joints."""

    box: Box
    R: Float[np.ndarray, "3 3"]


def _part_beside(segments: Segments, camera: Camera, covered: _Covered, least: float) -> _Part | None:
    """Where edges beside a known field, square to each other on its ground, fill a part of the photo.

    None if they are less than a share of those in the field, or hardly any are square to the others.
    """
    ends, size_px = segments.ends_px, segments.length_px
    inside = covered.holds(ends.mean(1), camera)
    pose = covered.cam_from_ground
    ground = on_ground(ends, camera, pose)
    foot = pose.origin_in_a
    near = lengths(ground.mean(1) - foot[:2]) < REACH * foot[2]
    others = np.flatnonzero(near & ~inside)
    turn, along, across = _square(ground[others], size_px[others])
    length = [float(size_px[others[rows]].sum()) for rows in (along, across)]
    if min(length) < BOTH * sum(length) or sum(length) <= least * size_px[inside].sum():
        return None
    beside = others[along | across]
    weight = np.repeat(size_px[beside], 2)
    left, right = _span(ends[beside, :, 0].ravel(), weight, camera.width)
    top, bottom = _span(ends[beside, :, 1].ravel(), weight, camera.height)
    R = pose.R @ rotation_from_vector(np.array([0.0, 0.0, turn]))
    box = Box(left, top, right - left, bottom - top)
    return None if min(box.width, box.height) < LEAST_PX else _Part(box, R)


def _square(
    ground: Float[np.ndarray, "n 2 2"], weight: Float[np.ndarray, " n"]
) -> tuple[float, Bool[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """The angle that most segments on the ground run at, which of them do, and which are square to it."""
    x, y = (ground[:, 1] - ground[:, 0]).T
    angle = np.mod(np.arctan2(y, x), np.pi)
    counts = np.bincount((angle * (2 * ANGLES / np.pi)).astype(int) % (2 * ANGLES), weight, 2 * ANGLES)
    # Up to quarter turns, and over the border of two bins.
    counts = counts.reshape(2, ANGLES).sum(0)
    common = float(np.argmax(counts + np.roll(counts, 1)) * (0.5 * np.pi / ANGLES))
    off = np.mod(angle - common + np.pi / 4.0, np.pi) - np.pi / 4.0
    along, across = np.abs(off) < SQUARE_RAD, np.abs(off - np.pi / 2.0) < SQUARE_RAD
    lean, weight = np.where(along, off, off - np.pi / 2.0), weight * (along | across)
    return common + float(lean @ weight / max(weight.sum(), 1e-9)), along, across


def _span(at: Float[np.ndarray, " n"], weight: Float[np.ndarray, " n"], limit: int) -> tuple[int, int]:
    """Between which whole numbers, up to a limit, almost all places lie."""
    order = np.argsort(at)
    total = np.cumsum(weight[order])
    first, last = np.searchsorted(total, np.array([STRAY, 1.0 - STRAY]) * total[-1])
    low, high = at[order[first]], at[order[last]]
    return max(0, int(low)), min(limit, int(high) + 1)


def _painted(gray: UInt8[np.ndarray, "h w"], camera: Camera, covered: _Covered) -> UInt8[np.ndarray, "h w"]:
    """The photo with its known field in a tone like that of what lies around it."""
    left = 1.0 - covered.shown(camera).astype(np.float32)
    small, share = (
        cv2.resize(each, None, fx=PAINT_SCALE, fy=PAINT_SCALE, interpolation=cv2.INTER_AREA)
        for each in (gray * left, left)
    )
    reach = PAINT_REACH * max(small.shape)
    paint, amount = (cv2.GaussianBlur(each, (0, 0), reach) for each in (small, share))
    tone = cv2.resize(paint / np.maximum(amount, 1e-3), (camera.width, camera.height))
    return np.where(left > 0.0, gray, tone).astype(np.uint8)


def _found_in(sight: Sight, camera: Camera, covered: _Covered, part: _Part) -> Paving | None:
    """The lattice in a part of the photo whose known field is painted over, if there is any."""
    gray = part.box.of(_painted(sight.gray, camera, covered))
    return find_on(see(gray), camera.cropped(*part.box), part.R)


def same_ground(one: Fit, other: Fit) -> bool:
    """Whether two fields may lie on the same ground, as the camera sees it."""
    up = float(one.cam_from_ground.R[:, 2] @ other.cam_from_ground.R[:, 2])
    return bool(up > np.cos(SAME_GROUND_RAD))


def in_whole(sight: Sight, camera: Camera, other: Paving) -> Paving | None:
    """A lattice that was found in a part of the photo, as the whole photo shows it."""
    fit, presence = seen_again(sight, camera, other)
    # A part may be seen many times as finely as the whole, which shows nothing of its slabs then.
    whole = presented(sight.looks.picture, fit, within=presence.field) if len(presence.p) else None
    return None if whole is None or whole.margin_nats <= 0 else whole


def seen_again(sight: Sight, camera: Camera, other: Paving) -> tuple[Fit, Presence]:
    """The fit to the whole photo of what was found in a part of it, and the presence of all its sides."""
    picture = sight.looks.picture
    own = camera.scaled(picture.shape[1], picture.shape[0])
    # In the part, a pixel may stand for less.
    strip = other.fit.strip.resized(own.fx / other.fit.camera.fx)
    fit = refine_in_field(picture, replace(other.fit, camera=own, strip=strip), other.presence.field)
    return fit, presence_of(picture, fit, WHOLE)


def _area_px(fit: Fit, field: Float[np.ndarray, "k 2"]) -> int:
    """How much of the picture a field fills: of two, a person takes that for the larger which does more."""
    return cv2.countNonZero(_Covered(fit.cam_from_ground, field).shown(fit.camera))
