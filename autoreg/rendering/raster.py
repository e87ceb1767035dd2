"""A z-buffer in NumPy: which triangle each sample of a picture shows."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from autoreg.view import View

# Samples worked on at a time: bounds the memory, whatever the picture's size.
_BATCH = 1 << 21


def clipped(
    corners: Float[np.ndarray, "n 3 3"], plane: Float[np.ndarray, "4"]
) -> tuple[Float[np.ndarray, "m 3 3"], Int[np.ndarray, " m"], Float[np.ndarray, "m 3 3"]]:
    """The parts of triangles on the positive side of a plane (a, b, c, d): ax + by + cz + d > 0.

    Returns the new triangles, the old one of each, and its corners as weights of the old one's corners.
    """
    side = corners @ plane[:3] + plane[3]
    inside = (side > 0).sum(1)
    whole = np.flatnonzero(inside == 3)
    index, weights = [whole], [np.tile(np.eye(3), (len(whole), 1, 1))]
    for count in (1, 2):
        cut = np.flatnonzero(inside == count)
        if not len(cut):
            continue
        # Turned so that the corner that is alone on its side comes first.
        alone = np.argmax((side[cut] > 0) == (count == 1), axis=1)
        order = (alone[:, None] + np.arange(3)) % 3
        s = np.take_along_axis(side[cut], order, 1)
        unit = np.eye(3)[order]
        first = (s[:, 0] / (s[:, 0] - s[:, 1]))[:, None]
        second = (s[:, 0] / (s[:, 0] - s[:, 2]))[:, None]
        p = unit[:, 0] + first * (unit[:, 1] - unit[:, 0])
        q = unit[:, 0] + second * (unit[:, 2] - unit[:, 0])
        if count == 1:
            index.append(cut)
            weights.append(np.stack([unit[:, 0], p, q], 1))
        else:
            index += [cut, cut]
            weights += [np.stack([p, unit[:, 1], unit[:, 2]], 1), np.stack([p, unit[:, 2], q], 1)]
    old, weight = np.concatenate(index), np.concatenate(weights)
    return weight @ corners[old], old, weight


class ZBuffer:
    """The nearest triangle at each sample of a straight picture, `samples` x `samples` to the pixel.

    Attributes:
        nearest: the number of the triangle that each sample shows, in the order they came; -1 for none.
    """

    def __init__(self, view: View, top: int, rows: int, samples: int) -> None:
        c = view.camera
        self._view, self._samples = view, samples
        self._top, self._shape = top * samples, (rows * samples, c.width * samples)
        self.nearest = np.full(self._shape, -1, np.int32)
        self._closeness = np.zeros(self._shape)
        self._count = 0

    def draw(self, corners: Float[np.ndarray, "n 3 3"]) -> None:
        """Draw triangles of the ground frame."""
        first, self._count = self._count, self._count + len(corners)
        for x, y, closeness, source in self._samples_of(corners):
            better = closeness > self._closeness[y, x]
            x, y, closeness, source = x[better], y[better], closeness[better], source[better]
            # Where several triangles of a batch meet one sample, the last that is written stays: the nearest.
            order = np.argsort(closeness, kind="stable")
            x, y = x[order], y[order]
            self._closeness[y, x] = closeness[order]
            self.nearest[y, x] = first + source[order]

    def mask(self, corners: Float[np.ndarray, "n 3 3"]) -> Bool[np.ndarray, "a b"]:
        """The samples that triangles of the ground frame cover, hidden or not."""
        covered = np.zeros(self._shape, bool)
        for x, y, _, _ in self._samples_of(corners):
            covered[y, x] = True
        return covered

    def rays(self, y: Int[np.ndarray, " n"], x: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """Rays through samples in the ground frame, of length 1 along the optical axis."""
        s = self._samples
        px = np.stack([(x + 0.5) / s - 0.5, (y + self._top + 0.5) / s - 0.5], -1)
        return self._view.directions(px)

    def _samples_of(self, corners: Float[np.ndarray, "n 3 3"]):  # a generator of plain arrays
        """Batches of samples inside triangles: x, y, 1/depth, and the triangle's number."""
        c, s = self._view.camera, self._samples
        points_cam = self._view.cam_from_ground.apply(corners)
        near = 1e-6 * max(1.0, float(np.abs(points_cam).max(initial=0.0)))
        cut, source, _ = clipped(points_cam, np.array([0.0, 0.0, 1.0, -near]))
        closeness = 1.0 / cut[..., 2]
        px = cut[..., :2] * closeness[..., None] * [c.fx, c.fy] + [c.cx, c.cy]
        # Samples lie at whole numbers of this finer grid.
        grid = (px + 0.5) * s - 0.5 - [0.0, self._top]
        height, width = self._shape
        # Steps of 1/depth, which is linear in the picture, along x and y.
        e1, e2 = grid[:, 1] - grid[:, 0], grid[:, 2] - grid[:, 0]
        d1, d2 = closeness[:, 1] - closeness[:, 0], closeness[:, 2] - closeness[:, 0]
        area = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
        y0 = np.clip(np.ceil(grid[..., 1].min(1)), 0, height).astype(np.int64)
        y1 = np.clip(np.floor(grid[..., 1].max(1)) + 1, 0, height).astype(np.int64)
        outside = (grid[..., 0].max(1) < 0) | (grid[..., 0].min(1) > width - 1) | (np.abs(area) < 1e-12)
        y1 = np.where(outside, y0, np.maximum(y1, y0))
        kept = np.flatnonzero(y1 > y0)
        with np.errstate(divide="ignore", invalid="ignore"):
            slope_x = (d1 * e2[:, 1] - d2 * e1[:, 1]) / area
            slope_y = (d2 * e1[:, 0] - d1 * e2[:, 0]) / area
        # Rows first, then the samples of each row between the triangle's two sides.
        for part in _batches(kept, (y1 - y0)[kept], _BATCH // 8):
            owner, row = _expanded(part, y0[part], y1[part])
            x0, x1 = _span(grid[owner], row.astype(float))
            left = np.clip(np.ceil(x0), 0, width).astype(np.int64)
            right = np.clip(np.floor(x1) + 1, 0, width).astype(np.int64)
            full = np.flatnonzero(right > left)
            for some in _batches(full, (right - left)[full], _BATCH):
                line, x = _expanded(some, left[some], right[some])
                t, y = owner[line], row[line]
                value = closeness[t, 0] + slope_x[t] * (x - grid[t, 0, 0]) + slope_y[t] * (y - grid[t, 0, 1])
                yield x, y, value, source[t]


def _batches(items: Int[np.ndarray, " n"], sizes: Int[np.ndarray, " n"], most: int) -> list[np.ndarray]:
    """The items in pieces whose sizes add up to about `most` at the most."""
    if not len(items):
        return []
    total = np.cumsum(sizes)
    cuts = np.searchsorted(total, np.arange(most, int(total[-1]), most))
    return [part for part in np.split(items, np.unique(cuts)) if len(part)]


def _expanded(
    items: Int[np.ndarray, " n"], low: Int[np.ndarray, " n"], high: Int[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Each item once for every whole number from its low up to below its high, and those numbers."""
    count = high - low
    start = np.repeat(np.cumsum(count) - count, count)
    return np.repeat(items, count), np.repeat(low, count) + np.arange(int(count.sum())) - start


def _span(
    triangle: Float[np.ndarray, "n 3 2"], y: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Least and greatest x of triangles on horizontal lines that meet them."""
    low, high = np.full(len(y), np.inf), np.full(len(y), -np.inf)
    for k in range(3):
        a, b = triangle[:, k], triangle[:, (k + 1) % 3]
        rise = b[:, 1] - a[:, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (y - a[:, 1]) / rise
            x = a[:, 0] + t * (b[:, 0] - a[:, 0])
        meets = (t >= 0) & (t <= 1) & (rise != 0)
        low, high = np.where(meets, np.minimum(low, x), low), np.where(meets, np.maximum(high, x), high)
    # A line that meets no side has an empty span.
    return np.where(np.isfinite(low), low, 1.0), np.where(np.isfinite(high), high, 0.0)
