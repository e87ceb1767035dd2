"""Over the whole picture: how well each pixel's direction is known, and how two calibrations differ."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float

from autoreg.calibration.adjustment import Adjustment, adjust
from autoreg.calibration.models import COUNT, Intrinsics, camera_of
from autoreg.calibration.observations import Data
from autoreg.camera import Camera

_NODES = 33
_SPLITS = 8
_MOST_ANCHORS = 1500
_LEAST_HALF = 3


@dataclass(frozen=True)
class PictureMap:
    """A quantity in pixels over the picture.

    Attributes:
        u: columns of the nodes.
        v: rows of the nodes.
        px: the value at each node; NaN where the lens model has no ray.
    """

    u: Float[np.ndarray, " c"]
    v: Float[np.ndarray, " r"]
    px: Float[np.ndarray, "r c"]

    @property
    def median_px(self) -> float:
        """Median over the picture; infinite if no node has a value."""
        return float(np.nanmedian(self.px)) if np.isfinite(self.px).any() else np.inf

    @property
    def p95_px(self) -> float:
        """What 95 % of the picture does not exceed; nodes without a ray count as infinite."""
        return float(np.quantile(np.where(np.isfinite(self.px), self.px, np.inf), 0.95, method="lower"))


@dataclass(frozen=True)
class HalvesDiffer:
    """How calibrations of two halves of the views differ, over several ways to halve them.

    Attributes:
        difference: root mean square over the splits of the distance between their projections.
        expected: what the stated covariance leads to expect there.
        splits: how many ways to halve were tried.
    """

    difference: PictureMap
    expected: PictureMap
    splits: int

    @property
    def excess(self) -> float:
        """Difference over expectation, in the middle over the picture: about 1 if the errors are honest."""
        return self.difference.median_px / max(self.expected.median_px, 1e-12)


def nodes(width: int, height: int) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " r"]]:
    """Columns and rows of the maps' nodes, from edge to edge."""
    rows = max(3, round(_NODES * height / width)) if width >= height else _NODES
    columns = _NODES if width >= height else max(3, round(_NODES * width / height))
    return np.linspace(0, width - 1, columns), np.linspace(0, height - 1, rows)


def uncertainty_map(
    intrinsics: Intrinsics,
    covariance: Float[np.ndarray, "12 12"],
    anchors_px: Float[np.ndarray, "n 2"],
    width: int,
    height: int,
) -> PictureMap:
    """Standard deviation in its worst direction of where a far point is seen, in pixels.

    A calibration cannot know where its camera looks, so a common rotation is taken out: the one that keeps
    the places where corners were seen (`anchors_px`) where they are, as well as it can.
    """
    u, v = nodes(width, height)
    grid = np.stack(np.meshgrid(u, v), -1)
    by_intrinsics, by_rotation = _derivatives(intrinsics, grid.reshape(-1, 2), width, height)
    moved, turned = _derivatives(intrinsics, _some(anchors_px), width, height)
    good = np.isfinite(moved).all((1, 2))
    A, B = moved[good].reshape(-1, COUNT), turned[good].reshape(-1, 3)
    rotation = -np.linalg.lstsq(B, A, rcond=None)[0] if len(B) else np.zeros((3, COUNT))
    M = by_intrinsics + by_rotation @ rotation
    known = np.isfinite(M).all((1, 2))
    worst = np.full(len(M), np.nan)
    values = np.linalg.eigvalsh(M[known] @ covariance @ M[known].transpose(0, 2, 1))
    worst[known] = np.sqrt(np.maximum(values[:, -1], 0))
    return PictureMap(u, v, worst.reshape(grid.shape[:2]))


def difference_map(
    one: Intrinsics, other: Intrinsics, anchors_px: Float[np.ndarray, "n 2"], width: int, height: int
) -> PictureMap:
    """Distance in pixels between where two cameras see a far point, turned so as to agree best.

    The rotation between them is that which makes them agree best at the anchors.
    """
    u, v = nodes(width, height)
    grid = np.stack(np.meshgrid(u, v), -1)
    camera, other_camera = camera_of(one, width, height), camera_of(other, width, height)
    anchors = _some(anchors_px)
    here, there = _directions(camera, anchors), _directions(other_camera, anchors)
    both = np.isfinite(here).all(1) & np.isfinite(there).all(1)
    if both.sum() < 3:
        return PictureMap(u, v, np.full(grid.shape[:2], np.nan))
    # Kabsch: the rotation that takes one set of directions to the other.
    U, _, Vt = np.linalg.svd(there[both].T @ here[both])
    R = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    seen = other_camera.project(camera.unproject(grid.reshape(-1, 2)) @ R.T)
    return PictureMap(u, v, np.linalg.norm(seen.reshape(grid.shape) - grid, axis=-1))


def halves_differ(
    data: Data,
    fit: Adjustment,
    covariance: Float[np.ndarray, "12 12"],
    anchors_px: Float[np.ndarray, "n 2"],
    width: int,
    height: int,
) -> HalvesDiffer | None:
    """How the projections of two halves of the views, calibrated apart, differ; None for too few views.

    Views that repeat one another are in the same half.
    """
    standpoints = np.unique(data.standpoint)
    count = len(standpoints)
    if count < 2 * _LEAST_HALF:
        return None
    freedom = replace(fit.freedom, shape=False)
    rng = np.random.default_rng(count)
    squares: list[np.ndarray] = []
    for split in range(_SPLITS):
        order = standpoints if split == 0 else rng.permutation(standpoints)
        one, other = (
            adjust(data.part(half), fit.state.part(half), freedom).state.intrinsics
            for half in (np.flatnonzero(np.isin(data.standpoint, order[k::2])) for k in (0, 1))
        )
        squares.append(difference_map(one, other, anchors_px, width, height).px ** 2)
    u, v = nodes(width, height)
    with np.errstate(invalid="ignore"):
        difference = PictureMap(u, v, np.sqrt(np.mean(squares, axis=0)))
    # Each half has half the information, hence twice the variance; their difference has twice that again.
    expected = uncertainty_map(fit.state.intrinsics, 4 * covariance, anchors_px, width, height)
    return HalvesDiffer(difference, expected, _SPLITS)


def _some(px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    """At most some thousand of the points, evenly taken."""
    return px[:: len(px) // _MOST_ANCHORS + 1]


def _directions(camera: Camera, px: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    rays = camera.unproject(px)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _derivatives(
    intrinsics: Intrinsics, px: Float[np.ndarray, "n 2"], width: int, height: int
) -> tuple[Float[np.ndarray, "n 2 12"], Float[np.ndarray, "n 2 3"]]:
    """Derivatives of far points' pixels by the intrinsics and by a camera's rotation; NaN without a ray."""
    rays = camera_of(intrinsics, width, height).unproject(px)
    good = np.isfinite(rays).all(1)
    J = np.full((len(px), 2, 6 + COUNT), np.nan)
    if good.any():
        fx, fy, cx, cy = intrinsics[:4]
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        by = cv2.projectPoints(rays[good], np.zeros(3), np.zeros(3), K, intrinsics[4:])[1]
        J[good] = np.asarray(by).reshape(good.sum(), 2, -1)[..., : 6 + COUNT]
    return J[..., 6:], J[..., :3]
