"""The sides of a lattice's slabs, and those of them that a picture shows."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float, Int

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.ground.bond_shift import is_customary
from autoreg.ground.points import inside_convex, lengths, project_ground, visible_ground

ALONG_X, ALONG_Y = 0, 1


@dataclass(frozen=True)
class Grid:
    """Bare lattice numbers: the joints that a `Lattice` will describe, in the unit of the pose.

    `spacing_x` None means that only the unbroken joints are known (rows).
    """

    spacing_x: float | None
    spacing_y: float
    shift: float = 0.0

    @property
    def slab_size(self) -> tuple[float, float]:
        """A slab's sides along X and along Y; those of rows are taken for squares."""
        return self.spacing_x or self.spacing_y, self.spacing_y

    @property
    def slab_side(self) -> float:
        """Geometric mean of a slab's sides."""
        a, b = self.slab_size
        return float(np.sqrt(a * b))

    @property
    def ratio(self) -> float:
        """Longer side of a slab over its shorter one."""
        return max(self.slab_size) / min(self.slab_size)

    @property
    def odd_bond(self) -> bool:
        """Whether it is a running bond whose shift no paver would choose: only the joints tell it."""
        return self.spacing_x is not None and not is_customary(self.shift)

    def stretch_from(self, other: Grid) -> Float[np.ndarray, "2"]:
        """Factors by which this lattice's spacings exceed another's; one where a spacing is not known."""
        along_x = (self.spacing_x or 1.0) / (other.spacing_x or 1.0)
        return np.array([along_x, self.spacing_y / other.spacing_y])


@dataclass(frozen=True)
class Sides:
    """Slab sides on the ground. `family` 0 runs along X at y = line * spacing_y, 1 along Y.

    `line` of a side along Y is its column i, `row` the course j it bounds; along X, `row` equals `line`
    and `cell` counts the pieces along it.
    """

    ends: Float[np.ndarray, "n 2 2"]
    family: Int[np.ndarray, " n"]
    line: Int[np.ndarray, " n"]
    cell: Int[np.ndarray, " n"]

    def __len__(self) -> int:
        """Number of sides."""
        return len(self.family)

    @property
    def middle(self) -> Float[np.ndarray, "n 2"]:
        """Ground points in the middle of the sides."""
        return 0.5 * (self.ends[:, 0] + self.ends[:, 1])

    def take(self, index: np.ndarray) -> Sides:
        """The chosen sides."""
        return Sides(*(getattr(self, f.name)[index] for f in fields(self)))


def slab_sides(grid: Grid, low: np.ndarray, high: np.ndarray) -> Sides:
    """Every slab side whose start lies in the box from `low` to `high` on the ground."""
    a = grid.spacing_x if grid.spacing_x is not None else grid.spacing_y
    b, s = grid.spacing_y, grid.shift
    j = np.arange(np.floor(low[1] / b), np.ceil(high[1] / b) + 1)
    i = np.arange(np.floor(low[0] / a) - 1, np.ceil(high[0] / a) + 2)
    # In a running bond row j - 1's cross joints cut an unbroken joint as well as row j's do.
    part = (-s) % 1.0
    cuts = [(0.0, part), (part, 1.0)] if part > 1e-6 else [(0.0, 1.0)]
    x_sides, x_line, x_cell = [], [], []
    jj, ii = (v.ravel() for v in np.meshgrid(j, i, indexing="ij"))
    row_start = ii + (jj * s) % 1.0
    for n, (c0, c1) in enumerate(cuts):
        x0, x1, y = (row_start + c0) * a, (row_start + c1) * a, jj * b
        x_sides.append(np.stack([np.stack([x0, y], -1), np.stack([x1, y], -1)], 1))
        x_line.append(jj)
        x_cell.append(ii * len(cuts) + n)
    ends, line, cell = np.concatenate(x_sides), np.concatenate(x_line), np.concatenate(x_cell)
    family = np.full(len(line), ALONG_X)
    if grid.spacing_x is not None:
        column = ii - np.floor(jj * s)
        x, y0 = (column + jj * s) * a, jj * b
        ends = np.concatenate([ends, np.stack([np.stack([x, y0], -1), np.stack([x, y0 + b], -1)], 1)])
        line, cell = np.concatenate([line, column]), np.concatenate([cell, jj])
        family = np.concatenate([family, np.full(len(x), ALONG_Y)])
    return Sides(ends, family, line.astype(np.int64), cell.astype(np.int64))


def visible_sides(
    camera: Camera,
    cam_from_ground: Rigid,
    grid: Grid,
    *,
    reach: float = 12.0,
    min_px: float = 7.0,
    border_px: float = 2.0,
    limit: int = 6000,
    field: Float[np.ndarray, "k 2"] | None = None,
    only: int | None = None,
) -> Sides:
    """Sides in the picture, cut to it, whose slab measures at least `min_px` both ways, at most `limit`.

    With a `field`, a convex counter-clockwise polygon of the ground, only sides whose middle lies in it; with
    a family, `only` its own.
    """
    ground = visible_ground(camera, cam_from_ground, reach)
    ground = ground[_slab_px(camera, cam_from_ground, grid, ground) > 0.5 * min_px]
    if len(ground) < 8:
        return slab_sides(grid, np.zeros(2), np.full(2, -1.0)).take(np.zeros(0, dtype=int))
    eye = cam_from_ground.origin_in_a
    low, high = ground.min(0), ground.max(0)
    a = grid.spacing_x if grid.spacing_x is not None else grid.spacing_y
    # A box of more slabs than this is cut down around the camera's foot: far slabs are too small anyway.
    cells = np.prod((high - low) / [a, grid.spacing_y])
    if cells > 40_000:
        centre = np.clip(eye[:2], low, high)
        shrink = np.sqrt(40_000 / cells)
        half = shrink * (high - low)
        low, high = np.maximum(low, centre - half), np.minimum(high, centre + half)
    sides = slab_sides(grid, low, high)
    middle = sides.middle
    near = lengths(middle - eye[:2]) < reach * eye[2]
    if only is not None:
        near &= sides.family == only
    if field is not None:
        near &= inside_convex(middle, field, 0.3 * grid.spacing_y)
    sides = sides.take(np.flatnonzero(near))
    px = project_ground(camera, cam_from_ground, sides.ends)
    seen = _perhaps_seen(px, camera, min_px)
    if len(seen) > 3 * limit:
        size_px = _slab_px(camera, cam_from_ground, grid, sides.middle[seen])
        seen = seen[np.sort(np.argsort(-size_px, kind="stable")[: 3 * limit])]
    sides, px = _clipped(sides.take(seen), px[seen], camera, cam_from_ground, border_px)
    # The slab across the side, seen from the side's middle.
    across = np.where(sides.family[:, None] == ALONG_X, [[0.0, grid.spacing_y]], [[a, 0.0]])
    beside = project_ground(camera, cam_from_ground, sides.middle + across)
    with np.errstate(invalid="ignore"):
        along = px[:, 1] - px[:, 0]
        length = lengths(along)
        off = beside - 0.5 * (px[:, 0] + px[:, 1])
        width = np.abs(along[:, 0] * off[:, 1] - along[:, 1] * off[:, 0]) / np.maximum(length, 1e-9)
        good = np.flatnonzero((length >= min_px) & (width >= min_px))
    if len(good) > limit:
        good = np.sort(good[np.argsort(-np.minimum(length, width)[good], kind="stable")[:limit]])
    return sides.take(good)


def _perhaps_seen(px: Float[np.ndarray, "n 2 2"], camera: Camera, min_px: float) -> np.ndarray:
    """Index of the sides that may be seen: all but those too short, or clearly beside the picture."""
    with np.errstate(invalid="ignore"):
        length = lengths(px[:, 1] - px[:, 0])
        # A lens bends a side by little of its length.
        margin = 0.1 * length + 1.0
        away = length < min_px
        for size, one, other in zip((camera.width, camera.height), px[:, 0].T, px[:, 1].T, strict=True):
            away |= (np.maximum(one, other) < -margin) | (np.minimum(one, other) > size + margin)
    return np.flatnonzero(~away)


def _slab_px(
    camera: Camera, cam_from_ground: Rigid, grid: Grid, points: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, " n"]:
    """The shorter side of a slab at each ground point, in pixels."""
    here = project_ground(camera, cam_from_ground, points)
    steps = np.diag(grid.slab_size)
    sides = [lengths(project_ground(camera, cam_from_ground, points + step) - here) for step in steps]
    # Where a slab's end is behind the camera the slab is near, and so large.
    return np.nan_to_num(np.minimum(*sides), nan=np.inf)


def _clipped(
    sides: Sides,
    px: Float[np.ndarray, "n 2 2"],
    camera: Camera,
    cam_from_ground: Rigid,
    border_px: float,
    pieces: int = 8,
    least: float = 0.45,
) -> tuple[Sides, Float[np.ndarray, "m 2 2"]]:
    """The sides, whose ends are seen at `px`, cut to the picture, and their ends there.

    Sides seen for less than `least` of their length are left out.
    """
    far = np.array([camera.width, camera.height]) - 1 - border_px

    def inside(px: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            within = (px > border_px) & (px < far)
            return within[..., 0] & within[..., 1]

    ends, px = sides.ends.copy(), px.copy()
    kept = np.asarray(inside(px).all(1))
    # The others are followed piece by piece.
    cut = np.flatnonzero(~kept)
    fraction = np.linspace(0.0, 1.0, pieces + 1)
    start, along = sides.ends[cut, :1], sides.ends[cut, 1:] - sides.ends[cut, :1]
    points = start + fraction[:, None] * along
    points_px = project_ground(camera, cam_from_ground, points)
    seen = inside(points_px)
    first, last = seen.argmax(1), pieces - seen[:, ::-1].argmax(1)
    # A side that leaves the picture and comes back is none of a pinhole's; a lens may do that at its rim.
    whole = seen.sum(1) == last - first + 1
    kept[cut] = seen.any(1) & whole & (last - first >= least * pieces)
    rows = np.arange(len(cut))
    for end, place in enumerate((first, last)):
        ends[cut, end], px[cut, end] = points[rows, place], points_px[rows, place]
    index = np.flatnonzero(kept)
    return replace(sides.take(index), ends=ends[index]), px[index]
