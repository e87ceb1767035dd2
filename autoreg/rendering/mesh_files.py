"""Mesh files (OBJ, PLY, and what else trimesh reads) as triangles."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from autoreg.rendering.surface import Surface, flat_normals, joined

_MOST_TRIANGLES = 2_000_000


def read_mesh(path: Path, up: Literal["y", "z"] = "z") -> Surface:
    """The triangles of a mesh file, Z up.

    Normals come from the file where it has them, so that what was modelled round looks round; else each
    triangle is flat.

    Args:
        path: the file.
        up: its vertical axis; modelling programs differ.

    Raises:
        ValueError: it cannot be read, or holds no triangles.
    """
    if not path.is_file():
        raise ValueError(f"mesh {path} does not exist")
    import trimesh  # Slow to import, and few scenes have a mesh.

    try:
        # Unprocessed, because merging corners would drop the file's normals.
        loaded = trimesh.load(path, process=False)
        parts = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
        surface = joined([_surface_of(part) for part in parts])
    except Exception as error:
        # Each of trimesh's readers fails in its own way.
        raise ValueError(f"mesh {path} cannot be read ({error}); save it as OBJ or PLY") from error
    corners, normals, uv = surface.corners, surface.normals, surface.uv
    if not len(corners) or not np.isfinite(corners).all():
        raise ValueError(f"mesh {path} holds no triangles with finite corners")
    if len(corners) > _MOST_TRIANGLES:
        raise ValueError(f"mesh {path} has {len(corners)} triangles, more than {_MOST_TRIANGLES}; reduce it")
    if up == "y":
        corners, normals = (np.stack([p[..., 0], -p[..., 2], p[..., 1]], -1) for p in (corners, normals))
    return Surface(corners, normals, uv)


def _surface_of(mesh: Any) -> Surface:
    """Triangles of one of trimesh's meshes."""
    corners = np.asarray(mesh.vertices[mesh.faces], float)
    # Normals that the file does not hold trimesh would make up, smooth over every edge.
    given = "vertex_normals" in mesh._cache
    normals = np.asarray(mesh.vertex_normals[mesh.faces], float) if given else flat_normals(corners)
    uv = getattr(mesh.visual, "uv", None)
    uv = np.asarray(uv, float)[mesh.faces] if uv is not None and len(uv) == len(mesh.vertices) else None
    return Surface(corners, normals, uv)
