"""The pixels in which the joints of a lattice are seen, each with its ray and its place in the lattice."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import cast

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.stations import ALONG_X, Grid, Sides, project_ground

# Pixels are taken from this many blurs on either side of a joint, ...
SHOULDER_BLURS = 2.5
# ... where a slab's side measures so many blurs clear of its joint: below, neighbouring joints run together.
CLEAR_BLURS = 4.5
# Tones are local to blocks, pieces of joint of this length: those of the slabs beyond both joints, before the
# one along Y, before the one along X, and before both; and that of the joint.
PIECE_PX = 24.0
TONES, JOINT = 5, 4
# Joints are straight over this length, whatever the lens.
STRAIGHT_PX = 32.0
# The picture's outermost pixels know nothing of what is blurred into them from outside.
BORDER_PX = 3
# Rows of a picture that are looked through at a time.
ROWS = 256
# A plane's most even sequence (Roberts' R2): every part of it covers the picture evenly.
R2 = (0.7548776662466927, 0.5698402909980532)


@dataclass(frozen=True)
class View:
    """Where pixels meet the ground: x_k = rows[:, k] / depth - offset[k] for ground axes k.

    `rows` are the rays' components along the ground's axes; `depth` is one over the distance in units of the
    ray. Both are linear in a pixel's ideal place, so that a ground line x_k = c is where a linear function
    vanishes: its distance in pixels is exact.
    """

    pose: Rigid
    rows: Float[np.ndarray, "n 3"]
    depth: Float[np.ndarray, " n"]
    offset: Float[np.ndarray, "3"]

    @classmethod
    def of(cls, rays: Float[np.ndarray, "n 3"], pose: Rigid) -> View:
        """The pixels of these rays, seen from a pose."""
        rows = rays @ pose.R
        return cls(pose, rows, rows[:, 2] / float(pose.R[:, 2] @ pose.t), pose.R.T @ pose.t)

    @cached_property
    def ground(self) -> Float[np.ndarray, "n 2"]:
        """Ground points under the pixels."""
        return self.rows[:, :2] / self.depth[:, None] - self.offset[:2]

    def across(
        self, axis: int, at: Float[np.ndarray, " n"], per_px: Float[np.ndarray, "m 2 2"]
    ) -> tuple[Float[np.ndarray, "2 n"], Float[np.ndarray, " n"]]:
        """Unit normals in the picture of ground lines x_axis = at, and the function's slope along them.

        `per_px` is the derivative of ideal normalised coordinates by the pixel's.
        """
        R, foot = self.pose.R, float(self.pose.R[:, 2] @ self.pose.t)
        lean = (self.offset[axis] + at) / foot
        x, y = (R[k, axis] - lean * R[k, 2] for k in (0, 1))
        slope = np.stack([x * per_px[:, 0, k] + y * per_px[:, 1, k] for k in (0, 1)])
        size = np.sqrt(slope[0] ** 2 + slope[1] ** 2)
        return slope / size, size


@dataclass(frozen=True)
class JointPixels:
    """Pixels at crossings, then those along X joints, then those along Y joints; `counts` says how many.

    `line` is the nearest joint along X; `column` is the nearest joint along Y of the row beyond it, `before`
    of the row before it, and `own` of the row that the pixel is in. `block` numbers pieces of joint, `cell`
    crossings with all that is nearest to them; `places` is where those are, in slabs along X and Y.
    """

    grey: Float[np.ndarray, " n"]
    rays: Float[np.ndarray, "n 3"]
    per_px: Float[np.ndarray, "m 2 2"]
    line: Int[np.ndarray, " n"]
    column: Int[np.ndarray, " n"]
    before: Int[np.ndarray, " n"]
    own: Int[np.ndarray, " n"]
    beyond: Bool[np.ndarray, "n 2"]
    block: Int[np.ndarray, " n"]
    cell: Int[np.ndarray, " n"]
    counts: tuple[int, int, int]
    blocks: int
    places: Float[np.ndarray, "c 2"]

    @property
    def cells(self) -> int:
        """Number of cells."""
        return len(self.places)

    def __len__(self) -> int:
        """Number of pixels."""
        return len(self.grey)

    def thinned(self, every: int) -> JointPixels:
        """One pixel of so many of each kind; blocks and cells keep their numbers."""
        ends = np.cumsum((0, *self.counts))
        rows = [np.arange(start, end, every) for start, end in pairwise(ends.tolist())]
        return self._take(np.concatenate(rows), (len(rows[0]), len(rows[1]), len(rows[2])))

    def parts(self, most: int) -> list[JointPixels]:
        """All pixels in parts of about so many at most; blocks and cells keep their numbers."""
        kinds = np.cumsum((0, *self.counts))
        ends = np.linspace(0, len(self), 1 + max(1, round(len(self) / most))).astype(int).tolist()
        parts: list[JointPixels] = []
        for start, end in pairwise(ends):
            crossing, along_x, along_y = np.diff(np.clip(kinds, start, end)).tolist()
            parts.append(self._take(slice(start, end), (crossing, along_x, along_y)))
        return parts

    def _take(self, index: np.ndarray | slice, counts: tuple[int, int, int]) -> JointPixels:
        return JointPixels(
            self.grey[index],
            self.rays[index],
            self.per_px[index] if len(self.per_px) > 1 else self.per_px,
            self.line[index],
            self.column[index],
            self.before[index],
            self.own[index],
            self.beyond[index],
            self.block[index],
            self.cell[index],
            counts,
            self.blocks,
            self.places,
        )


def joint_pixels(
    picture: Float[np.ndarray, "h w"],
    camera: Camera,
    pose: Rigid,
    grid: Grid,
    sides: Sides,
    width: tuple[float, float],
    blur_px: float,
    most: int,
) -> JointPixels:
    """The pixels near the joints of some sides, evenly thinned to at most about so many.

    `width` is that of joints along X and along Y on the ground. The lattice must have both.
    """
    at = _near_joints(picture.shape, camera, pose, sides, width, blur_px, most)
    rays = camera.unproject(at.astype(float))
    seen = np.isfinite(rays).all(1)
    at, rays = at[seen], rays[seen]
    seen = View.of(rays, pose).depth > 0
    at, rays = at[seen], rays[seen]
    return _placed(picture, at, rays, _ideal_per_px(camera, rays), pose, grid, width, blur_px)


def _near_joints(
    shape: tuple[int, ...],
    camera: Camera,
    pose: Rigid,
    sides: Sides,
    width: tuple[float, float],
    blur_px: float,
    most: int,
) -> Int[np.ndarray, "n 2"]:
    """At most about so many pixels (u, v) in reach of the sides, evenly spread, and few others.

    The sides are bands in a mask, drawn piece by piece since a lens bends them. Where a few of many pixels
    are wanted the mask is so much coarser, and one pixel is taken somewhere in each of its squares.
    """
    px, normal, half = _bands(camera, pose, sides, width)
    half += SHOULDER_BLURS * blur_px
    length = np.linalg.norm(px[:, 1] - px[:, 0], axis=1)
    area = 2.0 * float(length @ half)
    coarse = max(1, int(np.sqrt(area / most)))
    # Squares in part of a band are looked through as well.
    margin = 0.5 * (coarse - 1)
    wanted = most * (1.0 + 2.0 * margin * float(length.sum()) / max(area, 1.0))
    reach = (half + margin)[:, None, None] * normal[:, None]
    corners = (np.concatenate([px + reach, (px - reach)[:, ::-1]], 1) - margin) / coarse
    mask = np.zeros((shape[0] // coarse, shape[1] // coarse), np.uint8)
    for band in np.rint(16 * corners).astype(np.int32):
        cv2.fillConvexPoly(mask, band, 1, cv2.LINE_8, 4)
    square = thinned(mask, round(wanted))
    at = coarse * square + (coarse * np.mod(square[:, ::-1] * np.array(R2), 1.0)).astype(np.int64)
    return at[((at >= BORDER_PX) & (at < np.array(shape[::-1]) - BORDER_PX)).all(1)]


def _bands(
    camera: Camera, pose: Rigid, sides: Sides, width: tuple[float, float]
) -> tuple[Float[np.ndarray, "n 2 2"], Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Pieces of the sides' joints in the picture: their ends, unit normals, and half their widths."""
    ends_px = project_ground(camera, pose, sides.ends)
    count = np.ceil(np.linalg.norm(ends_px[:, 1] - ends_px[:, 0], axis=1) / STRAIGHT_PX).astype(int)
    side = np.repeat(np.arange(len(sides)), count)
    nth = np.arange(len(side)) - np.repeat(np.cumsum(count) - count, count)
    fraction = (nth[:, None] + [0.0, 1.0]) / count[side, None]
    start, along = sides.ends[side, 0], sides.ends[side, 1] - sides.ends[side, 0]
    ground = start[:, None] + fraction[..., None] * along[:, None]
    across = np.where(sides.family[side, None] == ALONG_X, [[0.0, width[0]]], [[width[1], 0.0]])
    px = project_ground(camera, pose, ground)
    beside = project_ground(camera, pose, ground.mean(1) + across)
    tangent = px[:, 1] - px[:, 0]
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], 1)
    half = 0.5 * np.abs(((beside - px.mean(1)) * normal).sum(1))
    seen = np.isfinite(px).all((1, 2)) & np.isfinite(half)
    return px[seen], normal[seen], half[seen]


def thinned(mask: UInt8[np.ndarray, "h w"], most: int) -> Int[np.ndarray, "n 2"]:
    """Pixels (u, v) of a mask, evenly thinned; some rows at a time, since large pictures have many."""
    share = most / max(cv2.countNonZero(mask), 1)
    found = [np.zeros((0, 2), dtype=np.int64)]
    for top in range(0, len(mask), ROWS):
        # None where all are zero.
        seen = cast("np.ndarray | None", cv2.findNonZero(mask[top : top + ROWS]))
        if seen is not None:
            at = seen.reshape(-1, 2).astype(np.int64)
            at[:, 1] += top
            found.append(at if share >= 1 else at[np.mod(at @ np.array(R2), 1.0) < share])
    return np.concatenate(found)


def _ideal_per_px(camera: Camera, rays: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 2 2"]:
    """Derivative of ideal normalised coordinates by the pixel's: one for all where the lens does not bend."""
    focal = np.array([camera.fx, camera.fy])
    if not camera.has_distortion:
        return np.diag(1.0 / focal)[None]
    xy, step = rays[:, :2], np.array([1e-4, 0.0])
    columns = [(camera.distort(xy + s) - camera.distort(xy - s)) * focal / 2e-4 for s in (step, step[::-1])]
    return np.linalg.inv(np.stack(columns, -1))


def _placed(
    picture: np.ndarray,
    at: Int[np.ndarray, "n 2"],
    rays: Float[np.ndarray, "n 3"],
    per_px: Float[np.ndarray, "m 2 2"],
    pose: Rigid,
    grid: Grid,
    width: tuple[float, float],
    blur_px: float,
) -> JointPixels:
    """The pixels sorted by what joints they see, and numbered."""
    assert grid.spacing_x is not None
    a, b, shift = grid.spacing_x, grid.spacing_y, grid.shift
    view = View.of(rays, pose)
    x, y = view.ground.T
    line, row = np.rint(y / b).astype(int), np.floor(y / b).astype(int)
    column, before, own = (np.rint(x / a - r * shift).astype(int) for r in (line, line - 1, row))
    off = [x - (i + r * shift) * a for i, r in ((column, line), (before, line - 1), (own, row))]
    off_y = y - line * b
    q_x, q_y = (view.depth / view.across(k, c, per_px)[1] for k, c in ((0, x), (1, y)))
    reach_x, reach_y = (SHOULDER_BLURS * blur_px + 0.5 * w * q for w, q in ((width[1], q_x), (width[0], q_y)))
    near_x = [np.abs(o) * q_x < reach_x for o in off]
    near_y = np.abs(off_y) * q_y < reach_y
    crossing = near_y & (near_x[0] | near_x[1])
    kind = np.where(crossing, 0, np.where(near_y, 1, 2))
    clear = (a * q_x > CLEAR_BLURS * blur_px + width[1] * q_x) & (
        b * q_y > CLEAR_BLURS * blur_px + width[0] * q_y
    )
    kept = np.flatnonzero((near_y | near_x[2]) & clear)
    kept = kept[np.argsort(kind[kept], kind="stable")]
    kind = kind[kept]
    # In a running bond the joints along Y end at either side of one along X in places of their own.
    lower = np.where(kind == 2, off_y[kept] < 0, np.abs(off[1][kept]) < np.abs(off[0][kept])) & (shift != 0)
    middle = np.where(lower, before[kept], column[kept])
    off_x = np.where(lower, off[1][kept], off[0][kept])
    piece_x = np.where(kind == 1, np.trunc(off_x * q_x[kept] / PIECE_PX), 0).astype(int)
    piece_y = np.where(kind == 2, np.trunc(off_y[kept] * q_y[kept] / PIECE_PX), 0).astype(int)
    block, pieces = _numbered(middle, line[kept], lower, piece_x, piece_y)
    cell, first = _numbered(middle, line[kept], lower)
    row = line[kept] - lower
    places = np.stack([middle + row * shift, line[kept]], 1)[first]
    return JointPixels(
        grey=picture[at[kept, 1], at[kept, 0]].astype(float),
        rays=rays[kept],
        per_px=per_px[kept] if len(per_px) > 1 else per_px,
        line=line[kept],
        column=column[kept],
        before=before[kept],
        own=own[kept],
        beyond=np.stack([off_x > 0, off_y[kept] > 0], 1),
        block=block,
        cell=cell,
        counts=(int((kind == 0).sum()), int((kind == 1).sum()), int((kind == 2).sum())),
        blocks=len(pieces),
        places=places.astype(float),
    )


def _numbered(*keys: np.ndarray) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " m"]]:
    """Numbers from zero for equal keys, and where each first occurs."""
    number = np.zeros(len(keys[0]), dtype=np.int64)
    for key in keys:
        low, high = (int(key.min()), int(key.max())) if len(key) else (0, 0)
        number = number * (high - low + 1) + (key.astype(np.int64) - low)
    _, first, inverse = np.unique(number, return_index=True, return_inverse=True)
    return inverse.ravel(), first
