"""Frames of directions at right angles: proposed by votes on a circle, fitted by least squares on SO(3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from autoreg.ground.directions import CUTOFF_SIGMAS, SegmentRays, agreement, agreement_of, squared_denominator

CIRCLE_BINS = 180
# Focal length relative to that of the rays, beyond which no lens of a camera lies.
LOG_FOCAL_LIMITS = (float(np.log(0.3)), float(np.log(4.0)))


@dataclass(frozen=True)
class FrameFit:
    """Frames (columns = directions) fitted to segments.

    `log_focal` is the logarithm of the focal length relative to that of the rays. `information` is the
    inverse covariance of (rotation vector on the camera's side, log focal length).
    """

    R: Float[np.ndarray, "k 3 3"]
    log_focal: Float[np.ndarray, " k"]
    information: Float[np.ndarray, "k 4 4"]

    def __len__(self) -> int:
        return len(self.log_focal)

    def joined(self, other: FrameFit) -> FrameFit:
        """These frames followed by others."""
        return FrameFit(
            np.concatenate([self.R, other.R]),
            np.concatenate([self.log_focal, other.log_focal]),
            np.concatenate([self.information, other.information]),
        )

    def take(self, index: np.ndarray) -> FrameFit:
        """The frames that an index array selects."""
        return FrameFit(self.R[index], self.log_focal[index], self.information[index])


def image_dirs(
    R: Float[np.ndarray, "k 3 3"], log_focal: Float[np.ndarray, " k"], families: int
) -> Float[np.ndarray, "k f 3"]:
    """First columns of each frame as unit directions of the rays' own focal length."""
    dirs = np.swapaxes(R, 1, 2)[:, :families].copy()
    dirs[..., :2] *= np.exp(log_focal)[:, None, None]
    return dirs / np.linalg.norm(dirs, axis=-1, keepdims=True)


def memberships(
    rays: SegmentRays, dirs: Float[np.ndarray, "k f 3"], allowed: Bool[np.ndarray, "k n"] | None
) -> Float[np.ndarray, "k f n"]:
    """Agreement of each segment with the one direction of its frame that it agrees with best."""
    return _best_alone(agreement(rays, dirs), allowed)


def _best_alone(
    kernel: Float[np.ndarray, "k f n"], allowed: Bool[np.ndarray, "k n"] | None
) -> Float[np.ndarray, "k f n"]:
    """Agreements without those of a segment with all but its best direction, and of segments not allowed."""
    kernel *= kernel == kernel.max(1, keepdims=True)
    if allowed is not None:
        kernel *= allowed[:, None, :]
    return kernel


def fit_step(
    rays: SegmentRays,
    fit: FrameFit,
    families: int,
    allowed: Bool[np.ndarray, "k n"] | None,
    *,
    log_focal_prior: tuple[float, float] | None,
) -> FrameFit:
    """One reweighted Gauss-Newton step of all frames at once, on SO(3) and, with a prior, the focal length.

    The weights are those of a biweight-like loss (the kernel of `agreement`); each segment serves one
    direction. The derivative of the denominator of r is left out: it is multiplied by r, which is small.
    """
    dirs_cam = np.swapaxes(fit.R, 1, 2)[:, :families]
    # The focal length scales the depth, not the picture: then a direction at infinity has no derivative by
    # it, as it should, and the omitted derivative of the denominator cannot pose as one.
    shrink = np.exp(-fit.log_focal)[:, None, None]
    scale = np.array([1.0, 1.0, 0.0]) + shrink * np.array([0.0, 0.0, 1.0])
    dirs = dirs_cam * scale
    denominator = squared_denominator(rays, dirs)
    numerator = dirs @ rays.moment_in_cutoffs.T
    weight = _best_alone(agreement_of(rays, dirs, numerator, denominator), allowed)
    inverse = 1.0 / np.sqrt(denominator)
    x, y, z = dirs_cam[..., None, :].transpose(3, 0, 1, 2)
    a, b, depth = rays.moment_in_cutoffs.T
    c = shrink * depth
    rows = [y * c - z * b, z * a - x * c, x * b - y * a]
    if log_focal_prior is not None:
        rows.append(-z * c)
    frames, observations, p = len(dirs), families * len(rays), len(rows)
    J = np.stack([row * inverse for row in rows], 1).reshape(frames, p, observations)
    weighted = J * weight.reshape(frames, 1, observations)
    information, gradient = np.zeros((frames, 4, 4)), np.zeros((frames, 4))
    information[:, :p, :p] = weighted @ J.swapaxes(1, 2)
    gradient[:, :p] = (weighted @ (numerator * inverse).reshape(frames, observations, 1))[..., 0]
    # So far distances were in cut-offs, not in standard deviations.
    information *= CUTOFF_SIGMAS**2
    gradient *= CUTOFF_SIGMAS**2
    if log_focal_prior is None:
        information[:, 3, 3] = 1.0
    else:
        mean, spread = log_focal_prior
        information[:, 3, 3] += 1.0 / spread**2
        gradient[:, 3] += (fit.log_focal - mean) / spread**2
    damping = 1e-9 * np.trace(information, axis1=1, axis2=2)[:, None, None] * np.eye(4)
    step = -np.linalg.solve(information + damping, gradient[..., None])[..., 0]
    step *= np.minimum(1.0, 0.2 / np.maximum(np.abs(step).max(1, keepdims=True), 1e-12))
    log_focal = fit.log_focal + step[:, 3]
    if log_focal_prior is not None:
        log_focal = np.clip(log_focal, *LOG_FOCAL_LIMITS)
    return FrameFit(rotations(step[:, :3]) @ fit.R, log_focal, information)


def rotations(vectors: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "k 3 3"]:
    """Rotation matrices of many rotation vectors in radians."""
    angle = np.linalg.norm(vectors, axis=1)
    x, y, z = vectors.T
    skew = np.zeros((len(vectors), 3, 3))
    skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0] = x, y, z
    skew[:, 1, 2], skew[:, 2, 0], skew[:, 0, 1] = -x, -y, -z
    # Of half the angle, a: sin(a) / a, which numpy has exactly at zero.
    sinc = np.sinc(angle / (2 * np.pi))[:, None, None]
    return np.eye(3) + sinc * np.cos(0.5 * angle)[:, None, None] * skew + 0.5 * sinc**2 * skew @ skew


def circle_across(
    dirs: Float[np.ndarray, "k 3"],
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]:
    """Two unit directions each that span the circle at right angles to unit directions."""
    first = np.cross(dirs, np.eye(3)[np.abs(dirs).argmin(1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(dirs, first)


MayVote = Callable[[Float[np.ndarray, "k n 3"], Float[np.ndarray, "k n 2 3"]], Bool[np.ndarray, "k n"]]


def frames_through(
    rays: SegmentRays,
    first: Float[np.ndarray, "m 3"],
    log_focals: Float[np.ndarray, " g"],
    *,
    peaks: int,
    may_vote: MayVote | None = None,
) -> FrameFit:
    """Frames (R = [d1 d2 d1 x d2]) of each first direction with the second ones that segments vote for.

    The second direction lies on the circle at right angles to d1, and a segment with interpretation plane n
    names one point of it, d1 x n. Segments that agree with d1 itself do not vote: they would all name the
    same wrong point. `may_vote` gets the normals d1 x d2 and the segments' ends in the camera frame, and says
    which votes count. All this is done for each of the focal lengths.
    """
    log_focal = np.repeat(log_focals, len(first))
    shrink = np.exp(-log_focal)[:, None]
    scale = np.concatenate([shrink, shrink, np.ones_like(shrink)], 1)
    repeated = np.tile(first, (len(log_focals), 1))
    free = agreement(rays, first) == 0.0
    votes = np.where(np.tile(free, (len(log_focals), 1)), rays.weight, 0.0)
    d1 = repeated * scale
    d1 /= np.linalg.norm(d1, axis=1, keepdims=True)
    u, v = circle_across(d1)
    # A plane's normal turns with the inverse of the scale that takes its points to another focal length.
    a, b = (u / scale) @ rays.moment.T, (v / scale) @ rays.moment.T
    angle = np.mod(np.arctan2(a, -b), np.pi)
    if may_vote is not None:
        d2 = np.cos(angle)[..., None] * u[:, None] + np.sin(angle)[..., None] * v[:, None]
        votes *= may_vote(np.cross(d1[:, None], d2), rays.ends[None] * scale[:, None, None, :])
    row, angle = _peaks(angle, votes, peaks)
    d1 = d1[row]
    d2 = np.cos(angle)[:, None] * u[row] + np.sin(angle)[:, None] * v[row]
    return FrameFit(np.stack([d1, d2, np.cross(d1, d2)], 2), log_focal[row], np.zeros((len(row), 4, 4)))


def frames_of_pairs(dirs: Float[np.ndarray, "m 3"], log_focal_range: tuple[float, float]) -> FrameFit:
    """Frames of every two directions that some focal length within the range puts at right angles.

    x1 x2 + y1 y2 + f^2 z1 z2 = 0 for directions (x, y, z) of a camera of unit focal length, f relative to it
    (Caprile and Torre, "Using vanishing points for camera calibration", IJCV 1990).
    """
    i, j = np.triu_indices(len(dirs), 1)
    depth = dirs[i, 2] * dirs[j, 2]
    across = (dirs[i, :2] * dirs[j, :2]).sum(1)
    low, high = np.exp(2 * log_focal_range[0]), np.exp(2 * log_focal_range[1])
    ok = (-across * np.sign(depth) > low * np.abs(depth)) & (-across * np.sign(depth) < high * np.abs(depth))
    i, j = i[ok], j[ok]
    log_focal = 0.5 * np.log(-across[ok] / depth[ok])
    scale = np.ones((len(i), 3))
    scale[:, 2] = np.exp(log_focal)
    d1, d2 = dirs[i] * scale, dirs[j] * scale
    d1 /= np.linalg.norm(d1, axis=1, keepdims=True)
    d2 /= np.linalg.norm(d2, axis=1, keepdims=True)
    return FrameFit(np.stack([d1, d2, np.cross(d1, d2)], 2), log_focal, np.zeros((len(i), 4, 4)))


def _peaks(
    angle: Float[np.ndarray, "k n"], votes: Float[np.ndarray, "k n"], count: int
) -> tuple[np.ndarray, Float[np.ndarray, " p"]]:
    """Row and angle of the highest peaks of each row's histogram on the half circle."""
    bins, rows = CIRCLE_BINS, len(angle)
    cell = np.minimum((angle * (bins / np.pi)).astype(int), bins - 1) + bins * np.arange(rows)[:, None]
    histogram = np.bincount(cell.ravel(), votes.ravel(), bins * rows).reshape(rows, bins)
    left, right = np.roll(histogram, 1, 1), np.roll(histogram, -1, 1)
    smooth = 0.5 * (left + right) + histogram
    is_peak = (smooth > 0) & (smooth >= np.roll(smooth, 1, 1)) & (smooth > np.roll(smooth, -1, 1))
    height = np.where(is_peak, smooth, 0.0)
    column = np.argsort(-height, axis=1, kind="stable")[:, :count].ravel()
    row = np.repeat(np.arange(rows), len(column) // max(rows, 1))
    row, column = row[height[row, column] > 0], column[height[row, column] > 0]
    offset = 0.5 * (right[row, column] - left[row, column]) / smooth[row, column]
    return row, (column + 0.5 + offset) * (np.pi / bins)
