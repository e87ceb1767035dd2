"""Which of a picture's pixels see the joints of a lattice, and which joints each of them sees."""

from __future__ import annotations

from typing import cast

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.grey_levels.joint_pixels import CROSSING, ON_X, ON_Y, JointPixels, View
from autoreg.ground.points import lengths, project_ground
from autoreg.ground.sides import ALONG_X, Grid, Sides
from autoreg.numbering import numbered

# Pixels are taken from this many blurs on either side of a joint: farther off they tell little of its place,
# and of a large picture's pixels so many fewer near it would be looked at, ...
SHOULDER_BLURS = 2.0
# ... where a slab's side measures so many blurs clear of its joint: below, neighbouring joints run together.
CLEAR_BLURS = 4.5
# Blocks, to which tones are local, are pieces of joint of this length.
PIECE_PX = 24.0
# Joints are straight over this length, whatever the lens.
STRAIGHT_PX = 32.0
# The picture's outermost pixels know nothing of what is blurred into them from outside.
BORDER_PX = 3
# Rows of a picture that are looked through at a time.
ROWS = 256
# A plane's most even sequence (Roberts' R2): every part of it covers the picture evenly.
R2 = (0.7548776662466927, 0.5698402909980532)


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
    finite = np.flatnonzero(np.isfinite(rays).all(1))
    seen = finite[View.of(rays[finite].T, pose).depth > 0]
    at, rays = at[seen], np.ascontiguousarray(rays[seen].T)
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
    length = lengths(px[:, 1] - px[:, 0])
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
    within = (coarse * np.mod(square[:, ::-1] * np.array(R2), 1.0)).astype(np.int64) if coarse > 1 else 0
    at = coarse * square + within
    return at[((at >= BORDER_PX) & (at < np.array(shape[::-1]) - BORDER_PX)).all(1)]


def _bands(
    camera: Camera, pose: Rigid, sides: Sides, width: tuple[float, float]
) -> tuple[Float[np.ndarray, "n 2 2"], Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Pieces of the sides' joints in the picture: their ends, unit normals, and half their widths."""
    ends_px = project_ground(camera, pose, sides.ends)
    count = np.ceil(lengths(ends_px[:, 1] - ends_px[:, 0]) / STRAIGHT_PX).astype(int)
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
    found = [np.zeros((0, 2), dtype=np.int32)]
    for top in range(0, len(mask), ROWS):
        # None where all are zero.
        seen = cast("np.ndarray | None", cv2.findNonZero(mask[top : top + ROWS]))
        if seen is not None:
            at = seen.reshape(-1, 2) + np.array([0, top], dtype=np.int32)
            found.append(at if share >= 1 else at[np.mod(at[:, 0] * R2[0] + at[:, 1] * R2[1], 1.0) < share])
    return np.concatenate(found)


def _ideal_per_px(camera: Camera, rays: Float[np.ndarray, "3 n"]) -> Float[np.ndarray, "2 2 m"]:
    """Derivative of ideal normalised coordinates by the pixel's: one for all where the lens does not bend."""
    focal = np.array([camera.fx, camera.fy])
    if not camera.has_distortion:
        return np.diag(1.0 / focal)[..., None]
    xy, step = rays[:2].T, np.array([1e-4, 0.0])
    columns = [(camera.distort(xy + s) - camera.distort(xy - s)) * focal / 2e-4 for s in (step, step[::-1])]
    return np.ascontiguousarray(np.moveaxis(np.linalg.inv(np.stack(columns, -1)), 0, -1))


def _placed(
    picture: np.ndarray,
    at: Int[np.ndarray, "n 2"],
    rays: Float[np.ndarray, "3 n"],
    per_px: Float[np.ndarray, "2 2 m"],
    pose: Rigid,
    grid: Grid,
    width: tuple[float, float],
    blur_px: float,
) -> JointPixels:
    """The pixels sorted by what joints they see, and numbered."""
    assert grid.spacing_x is not None
    a, b, shift = grid.spacing_x, grid.spacing_y, grid.shift
    view = View.of(rays, pose)
    x, y = view.ground[0] / a, view.ground[1] / b
    line, row = np.rint(y), np.floor(y)
    # Of a joint along Y in the row beyond the nearest line, in that before it, and in the pixel's own.
    numbers = [np.rint(x - r * shift) for r in (line, line - 1, row)]
    places = [n + r * shift for n, r in zip(numbers, (line, line - 1, row), strict=True)]
    off, off_y = [x - place for place in places], y - line
    q_x, q_y = (
        size * view.depth / view.across(axis, view.ground[axis], per_px)[1] for axis, size in ((0, a), (1, b))
    )
    joint_x, joint_y = width[1] / a, width[0] / b
    reach_x, reach_y = (
        SHOULDER_BLURS * blur_px + 0.5 * joint * q for joint, q in ((joint_x, q_x), (joint_y, q_y))
    )
    near_x = [np.abs(o) * q_x < reach_x for o in off]
    near_y = np.abs(off_y) * q_y < reach_y
    crossing = near_y & (near_x[0] | near_x[1])
    clear = (q_x * (1.0 - joint_x) > CLEAR_BLURS * blur_px) & (q_y * (1.0 - joint_y) > CLEAR_BLURS * blur_px)
    kind = np.where(crossing, CROSSING, np.where(near_y, ON_X, ON_Y)).astype(np.int8)
    kept = np.flatnonzero((near_y | near_x[2]) & clear)
    kind, line, off_y = kind[kept], line[kept], off_y[kept]
    # In a running bond the joints along Y end at either side of one along X in places of their own.
    lower = np.where(kind == ON_Y, off_y < 0, np.abs(off[1][kept]) < np.abs(off[0][kept])) & (shift != 0)
    number, off_x = (np.where(lower, before[kept], beyond[kept]) for beyond, before in (numbers[:2], off[:2]))
    along = np.select([kind == ON_X, kind == ON_Y], [off_x * q_x[kept], off_y * q_y[kept]])
    piece = np.trunc(along / PIECE_PX)
    cell, first = numbered(number, line, lower)
    # The pieces nearest to a crossing belong to it, whatever joint they are of.
    block, pieces = numbered(cell, np.where(piece == 0, 0, kind), piece)
    own = np.where(kind == ON_Y, places[2][kept], places[0][kept])
    beside = np.where(kind == ON_X, off_x <= 0, np.where(kind == ON_Y, 2 * (off_y <= 0), 0))
    order = _by_kind_and_block(kind, block, len(pieces))
    kept = kept[order]
    counts = np.bincount(kind, minlength=3).tolist()
    return JointPixels(
        grey=picture[at[kept, 1], at[kept, 0]].astype(float),
        rays=rays[:, kept],
        per_px=per_px[..., kept] if per_px.shape[-1] > 1 else per_px,
        line=line[order],
        column=own[order],
        before=places[1][kept],
        beside=beside[order],
        block=block[order],
        cell=cell[order],
        counts=(counts[0], counts[1], counts[2]),
        blocks=len(pieces),
        places=np.stack([number + (line - lower) * shift, line], 1)[first],
    )


def _by_kind_and_block(kind: np.ndarray, block: np.ndarray, blocks: int) -> Int[np.ndarray, " n"]:
    """The order of pixels by kind, and of each kind by block."""
    key = kind.astype(np.int64) * blocks + block
    # Short integers are sorted by radix.
    return np.argsort(key.astype(np.min_scalar_type(3 * blocks)), kind="stable")
