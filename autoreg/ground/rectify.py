"""Joint evidence on the rectified ground: a Hough transform restricted to two directions.

Seen from a hypothesised ground plane, a joint along X is a line of constant y and a joint along Y one of
constant x. The picture's gradient is sampled on a ground grid whose rows and columns are spaced so that
neighbours are at most one pixel apart anywhere in the picture: each axis is stretched on its own, so that
lines of both families stay straight and axis-parallel, near and far.

Ground coordinates in this file are in camera heights, with the origin below the camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from autoreg.camera import Camera

# Gradients far below the picture's own noise floor are not amplified, in grey levels per pixel.
FLAT_GRADIENT = 0.15
# Joints are narrow: what changes more slowly than this is not of them.
SHADING_PX = 6.0
# Where strength counts, gradients have half of the most that they may at so many times their neighbourhood's
# mean; else at the mean.
STRONG = 3.0
# Rows of the ground that are sampled at a time.
ROWS = 64


@dataclass(frozen=True)
class Family:
    """Evidence for the lines of one family: row i of `evidence` is the line at `offset[i]`.

    `evidence` is the gradient across the line beside its neighbourhood's mean: it lies in [-1, 1], so
    that neither a bright object nor a hard shadow outvotes the joints. `along` are the ground coordinates
    of its columns. `strong` is whether a line is told from others by how strong its gradients are, else by
    how much they agree.
    """

    evidence: Float[np.ndarray, "lines columns"]
    visible: Bool[np.ndarray, "lines columns"]
    offset: Float[np.ndarray, " lines"]
    along: Float[np.ndarray, " columns"]
    strong: bool = False

    def part(self, columns: slice) -> Family:
        """The family between some columns."""
        evidence, visible = self.evidence[:, columns], self.visible[:, columns]
        return replace(self, evidence=evidence, visible=visible, along=self.along[columns])


@dataclass(frozen=True)
class Rectified:
    """The two families of one ground hypothesis: `x` runs along X, `y` along Y."""

    x: Family
    y: Family


@dataclass(frozen=True)
class Gradient:
    """Gradient of a picture, in grey levels per pixel."""

    x: Float32[np.ndarray, "h w"]
    y: Float32[np.ndarray, "h w"]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture."""
        return self.x.shape[1], self.x.shape[0]


def picture_gradient(gray: np.ndarray) -> Gradient:
    """Gradient of a slightly smoothed grey picture."""
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 0.7)
    return Gradient(
        cv2.Scharr(smooth, cv2.CV_32F, 1, 0, scale=1 / 32), cv2.Scharr(smooth, cv2.CV_32F, 0, 1, scale=1 / 32)
    )


def unshaded(gray: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """A picture without what changes more slowly than joints do: shading, reflections, soft shadows."""
    return gray - cv2.GaussianBlur(gray, (0, 0), SHADING_PX)


@dataclass(frozen=True)
class Window:
    """A box of the ground, from `low` to `high`."""

    low: tuple[float, float]
    high: tuple[float, float]

    def holds(self, x: Float[np.ndarray, "#m #n"], y: Float[np.ndarray, "#m #n"]) -> Bool[np.ndarray, "m n"]:
        """Which points lie in it; rows of x and columns of y are broadcast."""
        return (x >= self.low[0]) & (x <= self.high[0]) & (y >= self.low[1]) & (y <= self.high[1])


EVERYWHERE = Window((-np.inf, -np.inf), (np.inf, np.inf))


def rectify(
    gradient: Gradient,
    camera: Camera,
    R: Float[np.ndarray, "3 3"],
    *,
    reach: float = 12.0,
    size: int = 800,
    window: Window = EVERYWHERE,
    strong: bool = False,
) -> Rectified | None:
    """Evidence for joints along X and along Y on the ground plane of a rotation, or None if none is seen.

    Args:
        gradient: of the picture at detection scale, that `camera` belongs to.
        camera: its camera.
        R: cam_from_ground rotation; its third column is the ground's upward normal in camera axes.
        reach: how far from the point below the camera to look, in camera heights.
        size: limit to the number of rows and of columns.
        window: the part of the ground to look at.
        strong: whether lines are told from others by the strength of their gradients.
    """
    axes = grid_axes(camera, R, reach, size, window)
    if axes is None:
        return None
    xs, ys = axes
    shape = len(ys), len(xs)
    across_x, across_y = (np.empty(shape, np.float32) for _ in range(2))
    visible = np.empty(shape, bool)
    # Some rows at a time, so that all that is computed of them stays in the processor's cache.
    for top in range(0, len(ys), ROWS):
        part = slice(top, top + ROWS)
        across_x[part], across_y[part], visible[part] = _across(
            gradient, camera, R, xs, ys[part], reach, window
        )
    means = STRONG if strong else 1.0
    along_y = _contrast(across_y, visible, means)
    return Rectified(
        x=Family(_contrast(across_x, visible, means), visible, ys, xs, strong),
        y=Family(np.ascontiguousarray(along_y.T), np.ascontiguousarray(visible.T), xs, ys, strong),
    )


def _across(
    gradient: Gradient,
    camera: Camera,
    R: Float[np.ndarray, "3 3"],
    xs: Float[np.ndarray, " n"],
    ys: Float[np.ndarray, " m"],
    reach: float,
    window: Window,
) -> tuple[Float32[np.ndarray, "m n"], Float32[np.ndarray, "m n"], Bool[np.ndarray, "m n"]]:
    """The gradient across joints along X, and along Y, at points of the ground, and where it is seen."""
    Rf = R.astype(np.float32)
    xf, yf = xs.astype(np.float32)[None, :], ys.astype(np.float32)[:, None]
    X, Y, Z = (Rf[i, 0] * xf + (Rf[i, 1] * yf - Rf[i, 2]) for i in range(3))
    ahead = Z > 1e-3
    inverse = 1.0 / np.where(ahead, Z, 1.0)
    xn, yn = X * inverse, Y * inverse
    fx, fy = np.float32(camera.fx), np.float32(camera.fy)
    if camera.has_distortion:
        uv = camera.distort(np.stack([xn, yn], -1)).astype(np.float32)
        u, v = uv[..., 0] * fx + np.float32(camera.cx), uv[..., 1] * fy + np.float32(camera.cy)
    else:
        u, v = xn * fx + np.float32(camera.cx), yn * fy + np.float32(camera.cy)
    visible = (
        ahead & (u > 1) & (u < camera.width - 2) & (v > 1) & (v < camera.height - 2)
        & (xf * xf + yf * yf < reach * reach) & window.holds(xf, yf)
    )  # fmt: skip
    gu = cv2.remap(gradient.x, u, v, cv2.INTER_LINEAR)
    gv = cv2.remap(gradient.y, u, v, cv2.INTER_LINEAR)
    # Picture directions of X and of Y (distortion turns them by little, which the evidence tolerates).
    xu, xv = (Rf[0, 0] - xn * Rf[2, 0]) * fx, (Rf[1, 0] - yn * Rf[2, 0]) * fy
    yu, yv = (Rf[0, 1] - xn * Rf[2, 1]) * fx, (Rf[1, 1] - yn * Rf[2, 1]) * fy
    across_x = (gv * xu - gu * xv) / np.sqrt(xu * xu + xv * xv + 1e-12)
    across_y = (gu * yv - gv * yu) / np.sqrt(yu * yu + yv * yv + 1e-12)
    return across_x, across_y, visible


def _contrast(gradient: np.ndarray, visible: np.ndarray, means: float) -> np.ndarray:
    """Gradient against so many times its neighbourhood's mean strength, bounded to [-1, 1]."""
    strength = np.where(visible, np.abs(gradient), 0.0).astype(np.float32)
    window = (41, 41)
    seen = cv2.blur(visible.astype(np.float32), window)
    mean = np.maximum(cv2.blur(strength, window) / np.maximum(seen, 1e-2), FLAT_GRADIENT)
    return np.where(visible, gradient / (strength + np.float32(means) * mean), 0.0).astype(np.float32)


def grid_axes(
    camera: Camera, R: np.ndarray, reach: float, size: int, window: Window = EVERYWHERE
) -> tuple[np.ndarray, np.ndarray] | None:
    """Ground coordinates of the grid's columns and rows, one pixel apart where the picture is densest."""
    u, v = np.linspace(0, camera.width - 1, 61), np.linspace(0, camera.height - 1, 61)
    px = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2)
    xy = camera.normalise(px)
    rays = np.c_[xy, np.ones(len(xy))] @ R
    down = np.isfinite(rays).all(1) & (rays[:, 2] < -1e-3)
    ground = rays[down, :2] / -rays[down, 2:]
    near = (np.linalg.norm(ground, axis=1) < reach) & window.holds(*ground.T[:, None])[0]
    if near.sum() < 50:
        return None
    ground = ground[near]
    cam = ground @ R[:, :2].T - R[:, 2]
    z, xn = cam[:, 2:], cam[:, :2] / cam[:, 2:]
    f = np.array([camera.fx, camera.fy])
    to_x = (R[:2, 0] - xn * R[2, 0]) / z * f
    to_y = (R[:2, 1] - xn * R[2, 1]) / z * f
    area = np.abs(to_x[:, 0] * to_y[:, 1] - to_x[:, 1] * to_y[:, 0])
    return (
        _axis(ground[:, 0], area / np.linalg.norm(to_y, axis=1), size),
        _axis(ground[:, 1], area / np.linalg.norm(to_x, axis=1), size),
    )


def _axis(coordinate: np.ndarray, px_per_unit: np.ndarray, size: int) -> np.ndarray:
    """Coordinates one pixel apart where the picture is densest, at most `size` of them."""
    bins = 64
    edges = np.linspace(coordinate.min(), coordinate.max(), bins + 1)
    which = np.clip(np.searchsorted(edges, coordinate) - 1, 0, bins - 1)
    density = np.full(bins, 1e-6)
    np.maximum.at(density, which, px_per_unit)
    # The sampled pixels may skip bins, as they do where the camera looks along the joints.
    sampled = np.flatnonzero(density > 1e-6)
    density = np.interp(np.arange(bins), sampled, density[sampled])
    length = np.r_[0.0, np.cumsum(density * np.diff(edges))]
    return np.interp(np.linspace(0.0, length[-1], int(np.clip(length[-1], 50, size))), length, edges)


def line_support(family: Family, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Support of each line between successive columns `edges`, and the number of visible samples.

    Coherence is |sum e| / sqrt(sum e^2): about one for texture, the root of the number of samples for a
    joint. The lines of a grain agree as much as joints do, and are weaker: of a `strong` family it is the
    strength, |sum e| over the root of the number of samples. Each piece is judged by itself because in a
    checker floor the gradient's sign alternates along the line.
    """
    e, m = family.evidence, family.visible
    number = np.searchsorted(edges, np.arange(e.shape[1]), side="right") - 1
    piece = (number[:, None] == np.arange(len(edges) - 1)).astype(np.float32)
    total, counts = np.abs(e @ piece), m.astype(np.float32) @ piece
    if family.strong:
        return total / np.sqrt(np.maximum(counts, 1.0)), counts
    return total / np.sqrt((e * e) @ piece + 0.3), counts


def near_reach(camera: Camera, R: Float[np.ndarray, "3 3"], beyond: float = 2.0) -> float:
    """How far the nearest ground of a picture lies from the camera's foot, and `beyond` more, in heights."""
    axes = np.linspace(0, camera.width - 1, 21), np.linspace(0, camera.height - 1, 21)
    rays = camera.unproject(np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)) @ R
    down = np.isfinite(rays).all(1) & (rays[:, 2] < -1e-3)
    if not down.any():
        return beyond
    return float(np.min(np.linalg.norm(rays[down, :2], axis=1) / -rays[down, 2])) + beyond
