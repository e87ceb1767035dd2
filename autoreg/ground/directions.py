"""Directions of parallel lines in the camera frame, and how well segments agree with them.

A segment with ends e1, e2 and middle m (ideal normalised points, third coordinate 1) agrees with a direction
d when the line from m to d's vanishing point passes through e1. Its signed distance from that line,
r(d) = d . (e1 x m) / |d_xy - d_z m_xy|, is in units of the picture, finite for vanishing points at infinity,
and has the noise of the segment's own ends.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float32, Int

from autoreg.camera import Camera
from autoreg.segments import Segments

# A segment supports a direction within this many standard deviations, with a weight that falls to zero there.
CUTOFF_SIGMAS = 3.0
# Joints are laid and walls are built with errors of direction of this size, whatever the picture's own noise.
LAYING_SPREAD_RAD = 0.006
# Joints this close to the horizon are too short to be seen as joints.
MIN_DEPRESSION = 0.02
# So many directions are voted on at a time: what a processor's cache holds.
VOTED = 256


@dataclass(frozen=True)
class SegmentRays:
    """Segments as ideal normalised points.

    `moment` is e1 x m; `sigma` is the expected spread of r for a segment that agrees; `weight` is its length
    in photo pixels.
    """

    ends: Float[np.ndarray, "n 2 3"]
    middle: Float[np.ndarray, "n 3"]
    moment: Float[np.ndarray, "n 3"]
    half_length: Float[np.ndarray, " n"]
    sigma: Float[np.ndarray, " n"]
    weight: Float[np.ndarray, " n"]

    def __len__(self) -> int:
        return len(self.weight)

    def take(self, index: np.ndarray) -> SegmentRays:
        """The rays that an index array or a mask selects."""
        return SegmentRays(
            self.ends[index],
            self.middle[index],
            self.moment[index],
            self.half_length[index],
            self.sigma[index],
            self.weight[index],
        )

    @property
    def normal(self) -> Float[np.ndarray, "n 3"]:
        """Unit normal of the plane through the camera centre and each segment."""
        return self.moment / np.linalg.norm(self.moment, axis=1, keepdims=True)

    @cached_property
    def moment_in_cutoffs(self) -> Float[np.ndarray, "n 3"]:
        """The moments in units of how far off a segment may be."""
        return self.moment / (CUTOFF_SIGMAS * self.sigma)[:, None]

    @cached_property
    def squares(self) -> Float[np.ndarray, "4 n"]:
        """1, x, y and x² + y² of the middles: of these and a direction the denominator of r is made."""
        x, y = self.middle[:, 0], self.middle[:, 1]
        return np.stack([np.ones_like(x), x, y, x * x + y * y])

    @cached_property
    def blind_reach(self) -> Float[np.ndarray, " n"]:
        """Square of how near to its middle a vanishing point lies on a segment, or nearly."""
        return np.square(1.1 * self.half_length)


def segment_rays(segments: Segments, ideal_xy: Float[np.ndarray, "n 2 2"], focal_px: float) -> SegmentRays:
    """Rays, longest first, of segments whose ends have been undistorted to ideal normalised points.

    Segments without length, or outside the field where the lens model has an inverse (NaN), are left out.
    """
    length = segments.length_px
    usable = np.isfinite(ideal_xy).all((1, 2)) & (length > 0)
    order = np.argsort(-length, kind="stable")
    order = order[usable[order]]
    ideal_xy = ideal_xy[order]
    ends = np.concatenate([ideal_xy, np.ones((len(ideal_xy), 2, 1))], -1)
    middle = ends.mean(1)
    half = 0.5 * np.hypot(*(ideal_xy[:, 1] - ideal_xy[:, 0]).T)
    sigma = np.hypot(segments.sigma_px[order] / focal_px, LAYING_SPREAD_RAD * half)
    return SegmentRays(ends, middle, np.cross(ends[:, 0], middle), half, sigma, length[order])


def camera_rays(segments: Segments, camera: Camera) -> SegmentRays:
    """Rays of segments of a calibrated photo."""
    ideal_xy = camera.normalise(segments.ends_px) if len(segments) else segments.ends_px
    return segment_rays(segments, ideal_xy, float(np.sqrt(camera.fx * camera.fy)))


def agreement(
    rays: SegmentRays, dirs: Float[np.ndarray, "*k 3"], dtype: type = np.float64
) -> Float[np.ndarray, "*k n"]:
    """How well each segment agrees with each direction: 1 exactly, 0 from the cut-off on.

    A segment that a vanishing point lies on (or nearly) agrees with none: a real line never reaches its own.
    """
    dirs = dirs.astype(dtype)
    numerator = dirs @ rays.moment_in_cutoffs.astype(dtype).T
    return agreement_of(rays, dirs, numerator, squared_denominator(rays, dirs))


def agreement_of(
    rays: SegmentRays,
    dirs: Float[np.ndarray, "*k 3"],
    numerator: Float[np.ndarray, "*k n"],
    denominator: Float[np.ndarray, "*k n"],
) -> Float[np.ndarray, "*k n"]:
    """The `agreement` with directions of any length, by r's numerator in cut-offs and squared denominator."""
    kernel = np.square(numerator)
    kernel /= denominator
    np.subtract(1.0, kernel, out=kernel)
    np.maximum(kernel, 0.0, out=kernel)
    blind = denominator < rays.blind_reach.astype(kernel.dtype) * np.square(dirs[..., 2:])
    np.copyto(kernel, 0.0, where=blind)
    return kernel


def squared_denominator(rays: SegmentRays, dirs: Float[np.ndarray, "*k 3"]) -> Float[np.ndarray, "*k n"]:
    """Square of r's denominator, by one matrix product; never zero."""
    quadric = np.empty((*dirs.shape[:-1], 4), dirs.dtype)
    z = dirs[..., 2]
    np.einsum("...k,...k->...", dirs[..., :2], dirs[..., :2], out=quadric[..., 0])
    np.multiply(dirs[..., :2], -2 * z[..., None], out=quadric[..., 1:3])
    np.square(z, out=quadric[..., 3])
    denominator = quadric @ rays.squares.astype(dirs.dtype)
    return np.maximum(denominator, np.finfo(dirs.dtype).tiny, out=denominator)


def single_directions(
    rays: SegmentRays, seeds: np.ndarray, *, count: int, apart_rad: float, steps: int = 3
) -> Float[np.ndarray, "k 3"]:
    """Up to `count` directions with the most support, best first, at least `apart_rad` from each other.

    Every pair of the seed segments proposes the direction that both share; all rays vote on each. The best
    are refined in so many `steps`.
    """
    normal = rays.normal[seeds]
    i, j = np.triu_indices(len(seeds), 1)
    dirs = np.cross(normal[i], normal[j])
    norm = np.linalg.norm(dirs, axis=1)
    dirs = dirs[norm > 1e-4] / norm[norm > 1e-4, None]
    if not len(dirs):
        return np.zeros((0, 3))
    support = _votes(rays, dirs)
    peaks = refine_directions(rays, dirs[_peaks(dirs, support, 4 * count, apart_rad)], steps)
    return peaks[_varied(agreement(rays, peaks) * rays.weight, count)]


def strongest_share(rays: SegmentRays, seeds: int = 80) -> float:
    """Share of the segments' length that the best supported direction explains, of the first as seeds."""
    found = single_directions(rays, np.arange(min(len(rays), seeds)), count=1, apart_rad=np.radians(2.0))
    return float(agreement(rays, found[0]) @ rays.weight / rays.weight.sum()) if len(found) else 0.0


def _votes(rays: SegmentRays, dirs: Float[np.ndarray, "n 3"]) -> Float32[np.ndarray, " n"]:
    """Length of the rays that agree with each direction, by their `agreement`, in single precision."""
    votes = np.empty(len(dirs), np.float32)
    weight = rays.weight.astype(np.float32)
    for some in range(0, len(dirs), VOTED):
        votes[some : some + VOTED] = agreement(rays, dirs[some : some + VOTED], np.float32) @ weight
    return votes


def _peaks(
    dirs: Float[np.ndarray, "n 3"], support: np.ndarray, count: int, apart_rad: float
) -> Int[np.ndarray, " k"]:
    """Index of the best supported directions that lie apart from all better ones."""
    order = np.argsort(-support, kind="stable")
    order = order[support[order] > 0]
    best = dirs[order].astype(np.float32)
    columns, limit = np.ascontiguousarray(best.T), np.float32(np.cos(apart_rad))
    left = np.ones(len(best), dtype=bool)
    kept: list[int] = []
    while len(kept) < count and left.any():
        kept.append(int(left.argmax()))
        cosine = best[kept[-1]] @ columns
        left &= np.abs(cosine, out=cosine) <= limit
        left[kept[-1]] = False
    return order[kept]


def _varied(support: Float[np.ndarray, "k n"], count: int) -> Int[np.ndarray, " c"]:
    """Index of rows chosen one by one for their sum, a segment counting less each time it has been used.

    Otherwise the directions near to a strong one, which live on its segments, would crowd out weak ones.
    """
    kept: list[int] = []
    worth = np.ones(support.shape[1])
    for _ in range(min(count, len(support))):
        total = support @ worth
        total[kept] = -1.0
        best = int(np.argmax(total))
        kept.append(best)
        worth[support[best] > 0] *= 0.5
    return np.array(kept, int)


def refine_directions(
    rays: SegmentRays, dirs: Float[np.ndarray, "k 3"], steps: int
) -> Float[np.ndarray, "k 3"]:
    """Each direction moved to the weighted least-squares direction of the segments that agree with it."""
    outer = (rays.moment[:, :, None] * rays.moment[:, None, :]).reshape(len(rays), 9)
    for _ in range(steps):
        denominator = squared_denominator(rays, dirs)
        w = agreement(rays, dirs) * rays.weight / (denominator * rays.sigma**2)
        dirs = np.linalg.eigh((w @ outer).reshape(-1, 3, 3))[1][:, :, 0]
    return dirs
