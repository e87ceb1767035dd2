"""How a lattice's joints look in the pixels: the share of every slab in each, and how it changes.

The lens's blur and the pixel's own square together are taken as a Gaussian of the picture. A slab then has
in a pixel the share that a Gaussian has in a quadrant between two lines: the normal distribution of the
pixel's distance from a joint's edge, and at crossings that of two variables whose correlation is the cosine
between the edges' normals (Drezner and Wesolowsky 1990, On the computation of the bivariate normal
integral).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.special import ndtr

from autoreg.geometry import Rigid
from autoreg.joint_pixels import JOINT, TONES, JointPixels, View
from autoreg.stations import Grid

# Correlations nearer to one are edges that run along each other.
MOST_CORRELATED = 0.999
# Chamfers are looked for in strips of this width beside the joints.
STRIP_BLURS = 1.5
# Slope of the view, ground distance over height, at which what depends on it is as large as it gets.
SOON = 1.6
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

    by_ground: Float[np.ndarray, "n 2"]
    by_looks: Float[np.ndarray, "n 3"]


@dataclass(frozen=True)
class _Edges:
    """What lies beyond (0) and before (1) a joint: z, share, normal, derivatives by place, width and blur."""

    z: tuple[np.ndarray, np.ndarray]
    share: tuple[np.ndarray, np.ndarray]
    normal: tuple[np.ndarray, np.ndarray]
    by_place: tuple[np.ndarray, np.ndarray]
    by_width: tuple[np.ndarray, np.ndarray]
    by_blur: tuple[np.ndarray, np.ndarray]


class JointImage:
    """The shares of a block's tones in every pixel, and from them the pixels' slopes."""

    def __init__(self, pixels: JointPixels, shape: Shape) -> None:
        self.pixels, self.shape = pixels, shape
        self.view = View.of(pixels.rays, shape.pose)
        crossing, along_x, _ = pixels.counts
        rows = np.arange(len(pixels))
        self.parts = np.split(rows, [crossing, crossing + along_x])
        at, x, y = self.parts
        self.at_line, self.at_column = self._along_x(at), self._along_y(at, pixels.column, pixels.line)
        self.at_before = self.at_column
        if shape.grid.shift:
            self.at_before = self._along_y(at, pixels.before, pixels.line - 1)
        self.lines = self._along_x(x)
        row = np.floor(self.view.ground[y, 1] / shape.grid.spacing_y)
        self.columns = self._along_y(y, pixels.own, row)
        self.corners = [self._corner(p, r) for r in (0, 1) for p in (0, 1)]

    def _along_x(self, rows: np.ndarray) -> _Edges:
        return self._edges(rows, 1, self.pixels.line[rows] * self.shape.grid.spacing_y, self.shape.width[0])

    def _along_y(self, rows: np.ndarray, column: np.ndarray, row: np.ndarray) -> _Edges:
        grid = self.shape.grid
        row = row if len(row) == len(rows) else row[rows]
        at = (column[rows] + row * grid.shift) * (grid.spacing_x or 1.0)
        return self._edges(rows, 0, at, self.shape.width[1])

    def _edges(self, rows: np.ndarray, axis: int, at: np.ndarray, width: float) -> _Edges:
        view, blur = self.view, self.shape.blur_px
        per_px, depth = self.pixels.per_px, view.depth[rows]
        per_px = per_px[rows] if len(per_px) > 1 else per_px
        parts: list[tuple[np.ndarray, ...]] = []
        for sign in (1.0, -1.0):
            edge = at + sign * 0.5 * width
            normal, size = view.across(axis, edge, per_px)
            z = sign * (view.rows[rows, axis] - (view.offset[axis] + edge) * depth) / (size * blur)
            bell = np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)
            by_place = sign * bell * depth / (size * blur)
            # A wider joint's far edge lies farther on, its near edge nearer: less is left on either side.
            by_width = -0.5 * width * sign * by_place
            parts.append((z, ndtr(z), normal, by_place, by_width, -bell * z))
        return _Edges(*((far, near) for far, near in zip(*parts, strict=True)))  # pyright: ignore[reportArgumentType]

    def _corner(self, p: int, r: int) -> tuple[np.ndarray, ...]:
        """Share of one slab at the crossings, and its derivatives by the share of either half-plane."""
        across, line = self.at_before if r else self.at_column, self.at_line
        h, k = across.z[p], line.z[r]
        cosine = (across.normal[p] * line.normal[r]).sum(0) * (1.0 if p == r else -1.0)
        rho = np.clip(cosine, -MOST_CORRELATED, MOST_CORRELATED)
        share = across.share[p] * line.share[r] + _beyond_product(h, k, rho)
        root = np.sqrt(1.0 - rho * rho)
        return share, ndtr((k - rho * h) / root), ndtr((h - rho * k) / root)

    def shares(self) -> Float[np.ndarray, "n t"]:
        """The share of each of its block's tones in every pixel; they sum to one."""
        at, x, y = self.parts
        share = np.zeros((len(self.pixels), TONES))
        for quadrant, corner in enumerate(self.corners):
            share[at, quadrant] = corner[0]
        for rows, edges, tones in ((x, self.lines, self._tones_x()), (y, self.columns, self._tones_y())):
            for side in (0, 1):
                share[rows, tones[side]] = edges.share[side]
        share[:, JOINT] = 1.0 - share[:, :JOINT] @ np.ones(JOINT)
        return share

    def _tones_x(self) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
        """Quadrants beyond and before the joint, for the pixels along X joints."""
        p = np.where(self.pixels.beyond[self.parts[1], 0], 0, 1)
        return p, p + 2

    def _tones_y(self) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
        r = np.where(self.pixels.beyond[self.parts[2], 1], 0, 2)
        return r, r + 1

    def slopes(self, tones: Float[np.ndarray, "n t"]) -> Slopes:
        """Slopes of the grey levels, for the tones of each pixel's block."""
        at, x, y = self.parts
        against = tones[:, :JOINT] - tones[:, JOINT:]
        ground, looks = np.zeros((len(tones), 2)), np.zeros((len(tones), 3))
        for quadrant, (_, by_x, by_y) in enumerate(self.corners):
            p, r = quadrant % 2, quadrant // 2
            across = self.at_before if r else self.at_column
            px, py = against[at, quadrant] * by_x, against[at, quadrant] * by_y
            ground[at, 0] += px * across.by_place[p]
            ground[at, 1] += py * self.at_line.by_place[r]
            looks[at, 0] += py * self.at_line.by_width[r]
            looks[at, 1] += px * across.by_width[p]
            looks[at, 2] += px * across.by_blur[p] + py * self.at_line.by_blur[r]
        sides = (1, x, self.lines, self._tones_x()), (0, y, self.columns, self._tones_y())
        for axis, rows, edges, own in sides:
            for side in (0, 1):
                step = against[rows, own[side]]
                ground[rows, axis] += step * edges.by_place[side]
                looks[rows, 1 - axis] += step * edges.by_width[side]
                looks[rows, 2] += step * edges.by_blur[side]
        return Slopes(ground, looks)

    def lopsided(self) -> Float[np.ndarray, "n 4"]:
        """Pixels' change by one grey level more beyond a joint's middle than before it.

        In the joint itself (a shadow on its bed), then within so many blurs outside of it (chamfers, one in
        the light); of the joints along X and of those along Y. At crossings as far as the other joint leaves.
        """
        at, x, y = self.parts
        column = np.zeros((len(self.pixels), 4))
        for family, rows, edges in ((0, x, self.lines), (1, y, self.columns)):
            column[rows, family], column[rows, family + 2] = _lopsided(edges)
        for family, own, other in ((0, self.at_line, self.at_column), (1, self.at_column, self.at_line)):
            clear = other.share[0] + other.share[1]
            column[at, family], column[at, family + 2] = (clear * part for part in _lopsided(own))
        return column

    def together(self, slopes: Slopes, by: tuple[float, float]) -> Float[np.ndarray, "n 4"]:
        """Pixels' change where all joints of a family lie off by a length on the ground, their own one each.

        Of the joints along X and of those along Y: to one side, and away from the camera, as far as they are
        seen aslant.
        """
        eye = self.shape.pose.origin_in_a
        aslant = np.clip((self.view.ground - eye[:2]) / (SOON * eye[2]), -1.0, 1.0)
        # Joints along X lie off along Y.
        along_x, along_y = (
            slopes.by_ground[:, axis] * length for axis, length in zip((1, 0), by, strict=True)
        )
        return np.column_stack([along_x, along_x * aslant[:, 1], along_y, along_y * aslant[:, 0]])

    def _by_plane(self, slopes: Slopes) -> Float[np.ndarray, "n 3"]:
        """Derivatives by a shift of the ground on the camera's side, each pixel's own."""
        R, rows, g = self.shape.pose.R, self.view.rows, slopes.by_ground
        along = np.einsum("nk,nk->n", g, rows[:, :2]) / rows[:, 2]
        return along[:, None] * R[:, 2] - g @ R[:, :2].T

    def by_lens(self, slopes: Slopes) -> Float[np.ndarray, "n 3"]:
        """Derivatives by the first radial coefficient, and by pixels that the picture is moved.

        The pixel's ray turns, the ground stays.
        """
        rays, per_px = self.pixels.rays, self.pixels.per_px
        seen = self._by_plane(slopes)[:, :2] / self.view.depth[:, None]
        x, y = rays[:, 0], rays[:, 1]
        wider = (seen[:, 0] * x + seen[:, 1] * y) * (x * x + y * y)
        return np.column_stack([wider, seen * np.stack([per_px[:, 0, 0], per_px[:, 1, 1]], 1)])

    def by_pose(self, slopes: Slopes) -> Float[np.ndarray, "n 7"]:
        """Derivatives by a turn and a shift on the camera's side, R = exp(w) R0, t = t0 + dt, and the ratio.

        A pixel's ray stays while the ground moves under it: dx_k = e_k . (w x (P - t) + dt), where P is the
        point seen, and e_k = (d_k / d_n) n - r_k with the ray's components d.
        """
        g, e = slopes.by_ground, self._by_plane(slopes)
        from_origin = self.pixels.rays / self.view.depth[:, None] - self.shape.pose.t
        # Stretching the lattice along X moves pixels back along X in it.
        ratio = 0.5 * (self.view.ground * g) @ np.array([-1.0, 1.0])
        (x, y, z), (a, b, c) = from_origin.T, e.T
        return np.stack([y * c - z * b, z * a - x * c, x * b - y * a, a, b, c, ratio], 1)


def _lopsided(edges: _Edges) -> tuple[np.ndarray, np.ndarray]:
    """Share of the joint's far half less that of its near one, and the same of the strips beside it."""
    far, near = edges.z
    inside = 2.0 * ndtr(0.5 * (far - near)) - 1.0 - edges.share[0] + edges.share[1]
    strips = [share - ndtr(z - STRIP_BLURS) for share, z in zip(edges.share, edges.z, strict=True)]
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
