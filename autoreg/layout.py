"""Where a lattice's joints, crossings and slabs lie on the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from autoreg.lattice import Lattice


@dataclass(frozen=True)
class GroundJoints:
    """Joint centre lines on the ground, each cut to where the paving was seen.

    `along_x` lie at y = row * spacing_y. `along_y` are whole lines in a stack bond and single cross
    joints, one slab long, in a running bond; a "rows" lattice has none.
    """

    along_x: Float[np.ndarray, "n 2 2"]
    row: Int[np.ndarray, " n"]
    along_y: Float[np.ndarray, "m 2 2"]


def slab_side_x(lattice: Lattice) -> float:
    """Side of a slab along X; for "rows", which have none, that of a square slab."""
    return lattice.spacing_y if lattice.spacing_x is None else lattice.spacing_x


def slab_centre(lattice: Lattice, i: int, j: int) -> Float[np.ndarray, "2"]:
    """Centre of slab (i, j): the i-th along X in row j, counted from the slab at the origin's +X +Y side."""
    shift = lattice.shift or 0.0
    return np.array([(i + j * shift + 0.5) * slab_side_x(lattice), (j + 0.5) * lattice.spacing_y])


def slab_at(lattice: Lattice, point: Float[np.ndarray, "2"]) -> tuple[int, int]:
    """The slab (i, j) that a point of the ground lies on."""
    j = int(np.floor(point[1] / lattice.spacing_y))
    return int(np.floor(point[0] / slab_side_x(lattice) - j * (lattice.shift or 0.0))), j


def was_seen(lattice: Lattice, point: Float[np.ndarray, "2"]) -> bool:
    """Whether a point of the ground lies in the lattice's extent."""
    _, low, high = _spans(lattice.extent, np.array([point[1]]))
    (least, greatest) = lattice.extent[:, 1].min(), lattice.extent[:, 1].max()
    return bool(least < point[1] < greatest and ((low < point[0]) & (point[0] < high)).any())


def lay_joints(lattice: Lattice, within: Float[np.ndarray, "p 2"] | None = None) -> GroundJoints:
    """The lattice's joints inside a polygon of the ground (its own extent if none is given)."""
    polygon = lattice.extent if within is None else within
    a, b = lattice.spacing_x, lattice.spacing_y
    rows = _multiples(polygon[:, 1], b)
    line, low, high = _spans(polygon, rows * b)
    along_x = _segments(low, high, rows[line] * b)
    if a is None:
        return GroundJoints(along_x, rows[line], np.empty((0, 2, 2)))

    turned = polygon[:, ::-1]
    if not lattice.shift:
        columns = _multiples(polygon[:, 0], a)
        at, low, high = _spans(turned, columns * a)
        return GroundJoints(along_x, rows[line], _segments(low, high, columns[at] * a)[..., ::-1])

    cross = [np.empty((0, 2, 2))]
    for j in range(int(np.floor(polygon[:, 1].min() / b)), int(np.ceil(polygon[:, 1].max() / b))):
        moved = j * lattice.shift * a
        x = _multiples(polygon[:, 0] - moved, a) * a + moved
        at, low, high = _spans(turned, x)
        low, high = np.maximum(low, j * b), np.minimum(high, (j + 1) * b)
        seen = high > low
        cross.append(_segments(low[seen], high[seen], x[at[seen]])[..., ::-1])
    return GroundJoints(along_x, rows[line], np.concatenate(cross))


def crossings(lattice: Lattice, within: Float[np.ndarray, "p 2"] | None = None) -> Float[np.ndarray, "n 2"]:
    """Points where joints meet inside a polygon: crossings of a stack bond, T-joints of a running bond."""
    return np.concatenate([np.empty((0, 2)), *(ends for ends in _row_crossings(lattice, within))])


def slab_sides(
    lattice: Lattice, within: Float[np.ndarray, "p 2"] | None = None
) -> Float[np.ndarray, "n 2 2"]:
    """The single sides of the slabs inside a polygon: pieces of joint from one crossing to the next.

    An unbroken joint of a "rows" lattice has no crossings; it is cut into pieces as long as a row is wide.
    """
    joints = lay_joints(lattice, within)
    a, b = lattice.spacing_x, lattice.spacing_y
    sides = [np.empty((0, 2, 2))]
    if a is None:
        for ends in joints.along_x:
            cuts = np.arange(np.ceil(ends[0, 0] / b), np.floor(ends[1, 0] / b) + 1) * b
            sides.append(_segments(cuts[:-1], cuts[1:], np.full(max(len(cuts) - 1, 0), ends[0, 1])))
        return np.concatenate(sides)
    for points in _row_crossings(lattice, within):
        sides.append(np.stack([points[:-1], points[1:]], 1))
    if lattice.shift:
        sides.append(joints.along_y)
    else:
        for ends in joints.along_y:
            cuts = np.arange(np.ceil(ends[0, 1] / b), np.floor(ends[1, 1] / b) + 1) * b
            sides.append(
                _segments(cuts[:-1], cuts[1:], np.full(max(len(cuts) - 1, 0), ends[0, 0]))[..., ::-1]
            )
    return np.concatenate(sides)


def _row_crossings(
    lattice: Lattice, within: Float[np.ndarray, "p 2"] | None
) -> list[Float[np.ndarray, "k 2"]]:
    """Crossings on each unbroken joint, in the order of x."""
    a = lattice.spacing_x
    if a is None:
        return []
    joints = lay_joints(lattice, within)
    shift = lattice.shift or 0.0
    found: list[Float[np.ndarray, "k 2"]] = []
    for ends, j in zip(joints.along_x, joints.row, strict=True):
        # Row j's cross joints start on this line, row j - 1's end on it; in a stack bond they coincide.
        places = [(_multiples(ends[:, 0] - k * shift * a, a) + k * shift) * a for k in (int(j), int(j) - 1)]
        x = np.sort(np.concatenate(places if shift else places[:1]))
        x = x[np.concatenate([[True], np.diff(x) > 1e-6 * a])] if len(x) else x
        found.append(np.stack([x, np.full(len(x), ends[0, 1])], 1))
    return found


def _multiples(values: Float[np.ndarray, " n"], period: float) -> Int[np.ndarray, " k"]:
    """All integers k with k * period between the least and the greatest value."""
    # A hair of slack keeps the joint that the polygon's own side lies on.
    first = np.ceil(values.min() / period - 1e-9)
    last = np.floor(values.max() / period + 1e-9)
    return np.arange(first, last + 1).astype(np.int64)


def _spans(
    polygon: Float[np.ndarray, "p 2"], y: Float[np.ndarray, " k"]
) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The parts of horizontal lines inside a simple polygon: index of the line, least x, greatest x."""
    start, end = polygon, np.roll(polygon, -1, axis=0)
    # A line through a corner is moved by a hair inwards: the even-odd rule then has no special case.
    middle, half = 0.5 * (polygon[:, 1].max() + polygon[:, 1].min()), 0.5 * np.ptp(polygon[:, 1])
    y = middle + np.clip(y - middle, -half * (1 - 1e-9), half * (1 - 1e-9)) + half * 1e-12
    below = start[:, 1] <= y[:, None]
    crosses = below != (end[:, 1] <= y[:, None])
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (y[:, None] - start[:, 1]) / (end[:, 1] - start[:, 1])
    x = np.sort(np.where(crosses, start[:, 0] + along * (end[:, 0] - start[:, 0]), np.inf), axis=1)
    x = x[:, : 2 * (len(polygon) // 2)]
    line, pair = np.nonzero(np.isfinite(x[:, 1::2]))
    return line, x[line, 2 * pair], x[line, 2 * pair + 1]


def _segments(
    low: Float[np.ndarray, " n"], high: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 2 2"]:
    """Horizontal segments from (low, y) to (high, y)."""
    return np.stack([np.stack([low, y], -1), np.stack([high, y], -1)], 1)
