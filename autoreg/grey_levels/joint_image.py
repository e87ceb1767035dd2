"""How a lattice's joints look in the pixels: the share of every slab in each, and how it changes.

The lens's blur and the pixel's own square together are taken as a Gaussian of the picture. A slab then has
in a pixel the share that a Gaussian has in a quadrant between two lines: the normal distribution of the
pixel's distance from a joint's edge, and at crossings that of two variables whose correlation is the cosine
between the edges' normals (Drezner and Wesolowsky 1990, On the computation of the bivariate normal
integral).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

from autoreg.geometry import Rigid
from autoreg.grey_levels.joint_pixels import CROSSING, ON_X, ON_Y, JointPixels, View
from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid

# Correlations nearer to one are edges that run along each other.
MOST_CORRELATED = 0.999
# Chamfers are looked for in strips of this width beside the joints.
STRIP_BLURS = 1.5
# Slope of the view, ground distance over height, at which what depends on it is as large as it gets.
SOON = 1.6
# Height of the normal distribution.
BELL = 1.0 / np.sqrt(2.0 * np.pi)
NODES, WEIGHTS = np.polynomial.legendre.leggauss(6)


@dataclass(frozen=True)
class Shape:
    """What decides the shares: pose, lattice, width of joints along X and along Y, blur with the pixel's."""

    pose: Rigid
    grid: Grid
    width: tuple[float, float]
    blur_px: float


@dataclass(frozen=True)
class Slopes:
    """Derivatives of the pixels' grey levels: by a motion over the ground, and by logarithms of the looks."""

    by_ground: Float[np.ndarray, "2 n"]
    by_looks: Float[np.ndarray, "3 n"]


@dataclass(frozen=True)
class _Edge:
    """What lies beyond one edge of a joint: distance z in blurs, share, derivatives by place, width and blur.

    `normal` is the edge's normal in the picture, of length `size`.
    """

    z: np.ndarray
    share: np.ndarray
    by_place: np.ndarray
    by_width: np.ndarray
    by_blur: np.ndarray
    normal: np.ndarray
    size: np.ndarray


# The edges of a joint: the one beyond which the far slab lies, and the near one.
_Edges = tuple[_Edge, _Edge]


class JointImage:
    """The shares of a block's tones in pixels of one kind, and from them the pixels' slopes."""

    def __init__(self, pixels: JointPixels, shape: Shape) -> None:
        self.pixels, self.shape = pixels, shape
        self.view = View.of(pixels.rays, shape.pose)
        # The joints that a pixel sees, by family, and at crossings of running bond the one before the line.
        self.joints: dict[int, _Edges] = {}
        if pixels.kind != ON_Y:
            self.joints[ALONG_X] = self._edges(1, pixels.line * shape.grid.spacing_y, shape.width[0])
        if pixels.kind != ON_X:
            self.joints[ALONG_Y] = self._along_y(pixels.column)
        if pixels.kind == CROSSING:
            before = self._along_y(pixels.before) if shape.grid.shift else self.joints[ALONG_Y]
            self.across = self.joints[ALONG_Y], before
            self.corners = [self._corner(p, r) for r in (0, 1) for p in (0, 1)]

    def _along_y(self, place: np.ndarray) -> _Edges:
        return self._edges(0, place * (self.shape.grid.spacing_x or 1.0), self.shape.width[1])

    def _edges(self, axis: int, at: np.ndarray, width: float) -> _Edges:
        far, near = (self._edge(axis, at, sign, width) for sign in (1.0, -1.0))
        return far, near

    def _edge(self, axis: int, at: np.ndarray, sign: float, width: float) -> _Edge:
        view, depth = self.view, self.view.depth
        edge = at + sign * 0.5 * width
        normal, size = view.across(axis, edge, self.pixels.per_px)
        scale = sign / (self.shape.blur_px * size)
        z = (view.rows[axis] - (view.offset[axis] + edge) * depth) * scale
        bell = np.exp(-0.5 * z * z)
        bell *= BELL
        by_place = scale * bell
        by_place *= depth
        # A wider joint's far edge lies farther on, its near edge nearer: less is left on either side.
        return _Edge(z, ndtr(z), by_place, (-0.5 * width * sign) * by_place, -bell * z, normal, size)

    def _corner(self, p: int, r: int) -> tuple[np.ndarray, ...]:
        """Share of one slab at the crossings, and its derivatives by the share of either half-plane."""
        across, line = self.across[r][p], self.joints[ALONG_X][r]
        h, k = across.z, line.z
        dot = across.normal[0] * line.normal[0] + across.normal[1] * line.normal[1]
        cosine = dot / (across.size * line.size) * (1.0 if p == r else -1.0)
        rho = np.clip(cosine, -MOST_CORRELATED, MOST_CORRELATED)
        share = across.share * line.share + _beyond_product(h, k, rho)
        root = np.sqrt(1.0 - rho * rho)
        return share, ndtr((k - rho * h) / root), ndtr((h - rho * k) / root)

    @cached_property
    def share(self) -> Float[np.ndarray, "s n"]:
        """The shares of the tones that the pixels have a part in, the joint's last; they sum to one."""
        if self.pixels.kind == CROSSING:
            slabs = [corner[0] for corner in self.corners]
        else:
            slabs = [edge.share for edge in next(iter(self.joints.values()))]
        share = np.empty((len(slabs) + 1, len(self.pixels)))
        np.stack(slabs, out=share[:-1])
        np.subtract(1.0, share[:-1].sum(0), out=share[-1])
        return share

    def slopes(self, tones: Float[np.ndarray, "s n"]) -> Slopes:
        """Slopes of the grey levels, for the tones that the pixels have a share in."""
        against = tones[:-1] - tones[-1]
        ground, looks = np.zeros((2, len(self.pixels))), np.zeros((3, len(self.pixels)))
        if self.pixels.kind == CROSSING:
            for quadrant, (_, by_x, by_y) in enumerate(self.corners):
                p, r = quadrant % 2, quadrant // 2
                _add(ground, looks, 0, against[quadrant] * by_x, self.across[r][p])
                _add(ground, looks, 1, against[quadrant] * by_y, self.joints[ALONG_X][r])
        else:
            ((family, edges),) = self.joints.items()
            for step, edge in zip(against, edges, strict=True):
                _add(ground, looks, 1 if family == ALONG_X else 0, step, edge)
        return Slopes(ground, looks)

    def lopsided(self) -> Float[np.ndarray, "4 n"]:
        """Pixels' change by one grey level more beyond a joint's middle than before it.

        In the joint itself (a shadow on its bed), then within so many blurs outside of it (chamfers, one in
        the light); of the joints along X and of those along Y. At crossings as far as the other joint leaves.
        """
        column = np.zeros((4, len(self.pixels)))
        for family, edges in self.joints.items():
            inside, beside = _lopsided(edges)
            if self.pixels.kind == CROSSING:
                far, near = self.joints[ALONG_Y if family == ALONG_X else ALONG_X]
                clear = far.share + near.share
                inside, beside = clear * inside, clear * beside
            column[0 if family == ALONG_X else 1] = inside
            column[2 if family == ALONG_X else 3] = beside
        return column

    def together(self, slopes: Slopes, by: tuple[float, float]) -> Float[np.ndarray, "4 n"]:
        """Pixels' change where all joints of a family lie off by a length on the ground, their own one each.

        Of the joints along X and of those along Y: to one side, and away from the camera, as far as they are
        seen aslant.
        """
        eye = self.shape.pose.origin_in_a
        aslant = np.clip((self.view.ground - eye[:2, None]) / (SOON * eye[2]), -1.0, 1.0)
        # Joints along X lie off along Y.
        along_x, along_y = (slopes.by_ground[axis] * length for axis, length in zip((1, 0), by, strict=True))
        return np.stack([along_x, along_x * aslant[1], along_y, along_y * aslant[0]])

    def by_shift(self, tones: Float[np.ndarray, "s n"]) -> Float[np.ndarray, " n"]:
        """Pixels' change where the bond's shift grows by one, for the tones that they have a share in."""
        column, a = np.zeros(len(self.pixels)), self.shape.grid.spacing_x or 0.0
        against = tones[:-1] - tones[-1]
        if self.pixels.kind == CROSSING:
            for quadrant, (_, by_x, _) in enumerate(self.corners):
                p, r = quadrant % 2, quadrant // 2
                row = self.pixels.line - r
                column -= a * row * against[quadrant] * by_x * self.across[r][p].by_place
        elif self.pixels.kind == ON_Y:
            row = np.floor(self.view.ground[1] / self.shape.grid.spacing_y)
            for step, edge in zip(against, self.joints[ALONG_Y], strict=True):
                column -= a * row * step * edge.by_place
        return column

    def _by_plane(self, slopes: Slopes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives by a shift of the ground on the camera's side, each pixel's own."""
        R, rows, (g, h) = self.shape.pose.R, self.view.rows, slopes.by_ground
        along = (g * rows[0] + h * rows[1]) / rows[2]
        x, y, z = (along * R[k, 2] - g * R[k, 0] - h * R[k, 1] for k in range(3))
        return x, y, z

    def by_lens(self, slopes: Slopes) -> Float[np.ndarray, "3 n"]:
        """Derivatives by the first radial coefficient, and by pixels that the picture is moved.

        The pixel's ray turns, the ground stays.
        """
        (x, y, _), per_px = self.pixels.rays, self.pixels.per_px
        seen_x, seen_y = (along / self.view.depth for along in self._by_plane(slopes)[:2])
        wider = (seen_x * x + seen_y * y) * (x * x + y * y)
        return np.stack([wider, seen_x * per_px[0, 0], seen_y * per_px[1, 1]])

    def by_pose(self, slopes: Slopes) -> Float[np.ndarray, "7 n"]:
        """Derivatives by a turn and a shift on the camera's side, R = exp(w) R0, t = t0 + dt, and the ratio.

        A pixel's ray stays while the ground moves under it: dx_k = e_k . (w x (P - t) + dt), where P is the
        point seen, and e_k = (d_k / d_n) n - r_k with the ray's components d.
        """
        (g, h), (a, b, c) = slopes.by_ground, self._by_plane(slopes)
        x, y, z = self.pixels.rays / self.view.depth - self.shape.pose.t[:, None]
        # Stretching the lattice along X moves pixels back along X in it.
        ratio = 0.5 * (self.view.ground[1] * h - self.view.ground[0] * g)
        return np.stack([y * c - z * b, z * a - x * c, x * b - y * a, a, b, c, ratio])


def _add(
    ground: Float[np.ndarray, "2 n"],
    looks: Float[np.ndarray, "3 n"],
    axis: int,
    step: np.ndarray,
    edge: _Edge,
) -> None:
    """Add the slopes by an edge across an axis of the ground, with so many grey levels more beyond it."""
    ground[axis] += step * edge.by_place
    looks[1 - axis] += step * edge.by_width
    looks[2] += step * edge.by_blur


def _lopsided(edges: _Edges) -> tuple[np.ndarray, np.ndarray]:
    """Share of the joint's far half less that of its near one, and the same of the strips beside it."""
    far, near = edges
    inside = 2.0 * ndtr(0.5 * (far.z - near.z)) - 1.0 - far.share + near.share
    strips = [edge.share - ndtr(edge.z - STRIP_BLURS) for edge in edges]
    return inside, strips[0] - strips[1]


def _beyond_product(
    h: Float[np.ndarray, " n"], k: Float[np.ndarray, " n"], rho: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """What the bivariate normal distribution at (h, k) has beyond the product of the two single ones."""
    half = 0.5 * np.arcsin(rho)
    total = np.zeros_like(h)
    squares, product = h * h + k * k, 2.0 * h * k
    for node, weight in zip(NODES, WEIGHTS, strict=True):
        sine = np.sin(half * (node + 1.0))
        total += weight * np.exp(-0.5 * (squares - product * sine) / (1.0 - sine * sine))
    return total * half / (2 * np.pi)


def with_looks(shape: Shape, log_change: Float[np.ndarray, "3"]) -> Shape:
    """The shape after a change of the logarithms of the widths and the blur."""
    x, y, blur = (float(factor) for factor in np.exp(log_change))
    return replace(shape, width=(shape.width[0] * x, shape.width[1] * y), blur_px=shape.blur_px * blur)
