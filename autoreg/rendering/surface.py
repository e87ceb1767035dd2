"""Triangles of the shapes: what the preview draws, and what POV-Ray gets where it has no shape of its own."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

# Pieces of a full circle: a ball that is 1000 pixels wide then differs from its outline by 0.04 pixels. Few
# do where only its place and its bounds are asked for, which are exact since quarters have whole pieces.
SEGMENTS, FEW_SEGMENTS = 256, 32
# Rounding of uv in files: so far beyond the picture's edge is still on it.
_ON_EDGE = 1e-4


@dataclass(frozen=True)
class Surface:
    """Triangles, counter-clockwise seen from outside; `uv` has u to the right and v up, 0 to 1."""

    corners: Float[np.ndarray, "n 3 3"]
    normals: Float[np.ndarray, "n 3 3"]
    uv: Float[np.ndarray, "n 3 2"] | None = None

    def moved(self, turn_rad: float, by: Float[np.ndarray, "3"]) -> Surface:
        """The triangles turned about Z and then moved."""
        R = about_z(turn_rad)
        return Surface(self.corners @ R.T + by, self.normals @ R.T, self.uv)

    def inset(self, width: int, height: int) -> Surface:
        """The same with uv half a pixel inside the edges of a picture of so many pixels.

        At its very edge a picture that goes on for ever shows as much of its opposite edge. Triangles across
        which it is repeated want that, and stay.
        """
        if self.uv is None:
            return self
        half = 0.5 / np.array([width, height])
        repeated = ((self.uv < -_ON_EDGE) | (self.uv > 1 + _ON_EDGE)).any((1, 2), keepdims=True)
        return replace(self, uv=np.where(repeated, self.uv, np.clip(self.uv, half, 1 - half)))


def about_z(turn_rad: float) -> Float[np.ndarray, "3 3"]:
    """The rotation about Z by that angle."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def flat_normals(corners: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Each triangle's own normal at its three corners; zero for one without area."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.divide(normal, length, out=np.zeros_like(normal), where=length > 0)
    return np.repeat(normal[:, None], 3, axis=1)


def stand_up(surface: Surface, *, height_m: float | None = None, scale: float = 1.0) -> Surface:
    """The surface scaled, its lowest point on Z = 0 and the middle of its bounds over the origin.

    Args:
        surface: triangles with Z up.
        height_m: height that it gets; else it is scaled by `scale`.
        scale: factor on its lengths.

    Raises:
        ValueError: it has no height to scale.
    """
    low, high = surface.corners.min((0, 1)), surface.corners.max((0, 1))
    if height_m is not None:
        if high[2] <= low[2]:
            raise ValueError("height cannot scale a flat mesh; give scale")
        scale = height_m / float(high[2] - low[2])
    foot = np.array([*(0.5 * (low + high)[:2]), low[2]])
    return Surface(scale * (surface.corners - foot), surface.normals, surface.uv)


def box_surface(size: tuple[float, float, float]) -> Surface:
    """A box on Z = 0 around the origin; each face shows a whole picture, upright on the sides."""
    x, y, z = 0.5 * size[0], 0.5 * size[1], size[2]
    # Each face from its lower left corner, counter-clockwise, as one sees it from outside.
    faces = np.array(
        [
            [[-x, -y, 0], [x, -y, 0], [x, -y, z], [-x, -y, z]],
            [[x, -y, 0], [x, y, 0], [x, y, z], [x, -y, z]],
            [[x, y, 0], [-x, y, 0], [-x, y, z], [x, y, z]],
            [[-x, y, 0], [-x, -y, 0], [-x, -y, z], [-x, y, z]],
            [[-x, -y, z], [x, -y, z], [x, y, z], [-x, y, z]],
            [[-x, y, 0], [x, y, 0], [x, -y, 0], [-x, -y, 0]],
        ],
        float,
    )
    corners = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    uv = np.concatenate([np.tile(unit[[0, 1, 2]], (6, 1, 1)), np.tile(unit[[0, 2, 3]], (6, 1, 1))])
    return Surface(corners, flat_normals(corners), uv)


def sphere_surface(radius: float, segments: int = SEGMENTS) -> Surface:
    """A ball on Z = 0."""
    t = np.linspace(-np.pi / 2, np.pi / 2, segments // 2 + 1)
    normals = np.stack([np.cos(t), np.sin(t)], -1)
    return _revolved(radius * normals + [0.0, radius], normals, segments)


def frustum_surface(radius: float, top: float, height: float, segments: int = SEGMENTS) -> Surface:
    """An upright cone, frustum or cylinder on Z = 0, with its flat ends."""
    slope = np.array([height, radius - top]) / np.hypot(height, radius - top)
    down, up = np.array([0.0, -1.0]), np.array([0.0, 1.0])
    parts = [
        _revolved(np.array([[0.0, 0.0], [radius, 0.0]]), np.stack([down, down]), segments),
        _revolved(np.array([[radius, 0.0], [top, height]]), np.stack([slope, slope]), segments),
    ]
    if top > 0:
        parts.append(_revolved(np.array([[top, height], [0.0, height]]), np.stack([up, up]), segments))
    return joined(parts)


def torus_surface(radius: float, tube: float, segments: int = SEGMENTS) -> Surface:
    """A ring that lies on Z = 0."""
    t = np.linspace(-np.pi, np.pi, segments // 2 + 1)
    normals = np.stack([np.cos(t), np.sin(t)], -1)
    return _revolved(tube * normals + [radius, tube], normals, segments)


def joined(parts: list[Surface]) -> Surface:
    """All triangles of several surfaces, with uv if all have it."""
    uvs = [part.uv for part in parts if part.uv is not None]
    return Surface(
        np.concatenate([np.empty((0, 3, 3)), *(part.corners for part in parts)]),
        np.concatenate([np.empty((0, 3, 3)), *(part.normals for part in parts)]),
        np.concatenate(uvs) if len(uvs) == len(parts) and uvs else None,
    )


def _revolved(profile: Float[np.ndarray, "m 2"], normals: Float[np.ndarray, "m 2"], segments: int) -> Surface:
    """A profile (radius, height), walked upwards outside, turned about Z; u goes round, v along it."""
    a = np.linspace(0.0, 2 * np.pi, segments + 1)
    around = np.stack([np.cos(a), np.sin(a)], -1)

    def turned(rz: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "k m 3"]:
        height = np.broadcast_to(rz[:, 1:], (len(a), len(rz), 1))
        return np.concatenate([around[:, None] * rz[:, :1], height], -1)

    v = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    uv = np.stack(np.broadcast_arrays(a[:, None] / (2 * np.pi), v / v[-1]), -1)
    quads = [
        np.stack([g[:-1, :-1], g[1:, :-1], g[1:, 1:], g[:-1, 1:]], 2).reshape(-1, 4, g.shape[-1])
        for g in (turned(profile), turned(normals), uv)
    ]
    # At the axis one of the two triangles of each quad has no area.
    off_axis = profile[:, 0] > 1e-9 * profile[:, 0].max()
    lower, upper = (np.tile(ends, segments) for ends in (off_axis[:-1], off_axis[1:]))
    return Surface(*(np.concatenate([q[lower][:, [0, 1, 2]], q[upper][:, [0, 2, 3]]]) for q in quads))
