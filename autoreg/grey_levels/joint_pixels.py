"""Pixels in which the joints of a lattice are seen, each with its ray and its place in the lattice."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int

from autoreg.geometry import Rigid

# Tones are local to blocks, pieces of joint: those of the slabs beyond both joints, before the one along Y,
# before the one along X, and before both; and that of the joint.
TONES, JOINT = 5, 4
# Kinds of pixels, and how far apart the tones on both sides of a joint are.
CROSSING, ON_X, ON_Y = 0, 1, 2
BESIDE = {ON_X: 2, ON_Y: 1}
# Pixels that are drawn at a time: what a processor's cache holds.
AT_ONCE = 8192
# A line's most even sequence.
GOLDEN = 0.6180339887498949


@dataclass(frozen=True)
class View:
    """Where pixels meet the ground: x_k = rows[k] / depth - offset[k] for ground axes k.

    `rows` are the rays' components along the ground's axes; `depth` is one over the distance in units of the
    ray. Both are linear in a pixel's ideal place, so that a ground line x_k = c is where a linear function
    vanishes: its distance in pixels is exact.
    """

    pose: Rigid
    rows: Float[np.ndarray, "3 n"]
    depth: Float[np.ndarray, " n"]
    offset: Float[np.ndarray, "3"]

    @classmethod
    def of(cls, rays: Float[np.ndarray, "3 n"], pose: Rigid) -> View:
        """The pixels of these rays, seen from a pose."""
        rows = pose.R.T @ rays
        return cls(pose, rows, rows[2] / float(pose.R[:, 2] @ pose.t), pose.R.T @ pose.t)

    @cached_property
    def ground(self) -> Float[np.ndarray, "2 n"]:
        """Ground points under the pixels."""
        return self.rows[:2] / self.depth - self.offset[:2, None]

    def across(
        self, axis: int, at: Float[np.ndarray, " n"], per_px: Float[np.ndarray, "2 2 m"]
    ) -> tuple[Float[np.ndarray, "2 n"], Float[np.ndarray, " n"]]:
        """Slopes in the picture of functions that vanish on ground lines x_axis = at, and their sizes.

        `per_px` is the derivative of ideal normalised coordinates by the pixel's.
        """
        R, foot = self.pose.R, float(self.pose.R[:, 2] @ self.pose.t)
        lean = (self.offset[axis] + at) / foot
        x, y = (R[k, axis] - lean * R[k, 2] for k in (0, 1))
        slope = np.stack([x * per_px[0, k] + y * per_px[1, k] for k in (0, 1)])
        return slope, np.sqrt(slope[0] * slope[0] + slope[1] * slope[1])


@dataclass(frozen=True)
class JointPixels:
    """Pixels at crossings, then those along X joints, then those along Y joints; `counts` says how many.

    Each kind is in the order of its blocks, which number pieces of joint, crossing by crossing: a `cell` is a
    crossing with all that is nearest to it, and `places` is where those are, in slabs along X and Y. `line`
    is the number of the nearest joint along X; `column` is where that along Y lies, in slabs, in the row
    beyond the line or, for pixels along Y joints, in their own, and `before` in the row before the line.
    `beside` is the first of the two tones of its block that a pixel between two slabs has a share in.
    """

    grey: Float[np.ndarray, " n"]
    rays: Float[np.ndarray, "3 n"]
    per_px: Float[np.ndarray, "2 2 m"]
    line: Float[np.ndarray, " n"]
    column: Float[np.ndarray, " n"]
    before: Float[np.ndarray, " n"]
    beside: Int[np.ndarray, " n"]
    block: Int[np.ndarray, " n"]
    cell: Int[np.ndarray, " n"]
    counts: tuple[int, int, int]
    blocks: int
    places: Float[np.ndarray, "c 2"]

    @property
    def cells(self) -> int:
        """Number of cells."""
        return len(self.places)

    @property
    def kind(self) -> int:
        """Kind of the first pixel, and of all of a part: at a crossing, along X, along Y."""
        return int(np.flatnonzero(self.counts)[0])

    @cached_property
    def tone(self) -> Int[np.ndarray, "s n"]:
        """Which of all blocks' tones each pixel has a share in, the joint's last; of a part."""
        if self.kind == CROSSING:
            own = np.repeat(np.arange(TONES)[:, None], len(self), axis=1)
        else:
            own = np.stack([self.beside, self.beside + BESIDE[self.kind], np.full(len(self), JOINT)])
        return (self.block * TONES + own).astype(np.int32)

    def __len__(self) -> int:
        """Number of pixels."""
        return len(self.grey)

    def thinned(self, every: int) -> JointPixels:
        """About one pixel of so many of each block; blocks and cells keep their numbers."""
        if every == 1:
            return self
        # Steps of one length would meet the same pixels of every row of a joint.
        chosen = np.mod(np.arange(len(self)) * GOLDEN, 1.0) < 1.0 / every
        ends = np.cumsum((0, *self.counts))
        crossing, along_x, along_y = (int(chosen[a:b].sum()) for a, b in pairwise(ends.tolist()))
        return self._take(np.flatnonzero(chosen), (crossing, along_x, along_y))

    @cached_property
    def parts(self) -> list[JointPixels]:
        """All pixels in parts of one kind, of a few each; blocks and cells keep their numbers."""
        parts: list[JointPixels] = []
        start = 0
        for kind, count in enumerate(self.counts):
            ends = np.linspace(start, start + count, 1 + -(-count // AT_ONCE)).astype(int).tolist()
            for a, b in pairwise(ends):
                counts = [0, 0, 0]
                counts[kind] = b - a
                parts.append(self._take(slice(a, b), (counts[0], counts[1], counts[2])))
            start += count
        return parts

    def of_parts(self, values: Float[np.ndarray, " n"]) -> list[np.ndarray]:
        """Those of some values, one for every pixel, that belong to each part."""
        return np.split(values, np.cumsum([len(part) for part in self.parts])[:-1])

    def _take(self, index: np.ndarray | slice, counts: tuple[int, int, int]) -> JointPixels:
        return JointPixels(
            self.grey[index],
            self.rays[:, index],
            self.per_px[..., index] if self.per_px.shape[-1] > 1 else self.per_px,
            self.line[index],
            self.column[index],
            self.before[index],
            self.beside[index],
            self.block[index],
            self.cell[index],
            counts,
            self.blocks,
            self.places,
        )
