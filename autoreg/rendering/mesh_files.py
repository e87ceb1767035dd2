"""Mesh files as triangles: OBJ read here, PLY and others by trimesh."""

from __future__ import annotations

import codecs
from dataclasses import dataclass, field
from itertools import pairwise, zip_longest
from pathlib import Path
from textwrap import shorten
from typing import Any, Literal

import numpy as np

from autoreg.rendering.surface import Surface, flat_normals, joined

_MOST_TRIANGLES = 2_000_000
# Beyond any scene, and small enough that no square of it overflows.
_LARGEST = 1e9
# How many numbers the lines of an OBJ file have that are needed here.
_NUMBERS = {"v": 3, "vt": 2, "vn": 3}


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
    if not path.suffix:
        raise ValueError(f"mesh {path} has no ending that says its format; name it .obj, .ply or .stl")
    surface = _read_obj(path) if path.suffix.lower() == ".obj" else _read_other(path)
    corners, normals, uv = surface.corners, surface.normals, surface.uv
    if not len(corners):
        raise ValueError(f"mesh {path} holds no triangles; export its faces")
    if not (np.isfinite(corners).all() and np.abs(corners).max() <= _LARGEST):
        raise ValueError(
            f"mesh {path} has corners that are not finite or beyond {_LARGEST:g}; export it anew"
        )
    if len(corners) > _MOST_TRIANGLES:
        raise ValueError(f"mesh {path} has {len(corners)} triangles, more than {_MOST_TRIANGLES}; reduce it")
    if up == "y":
        corners, normals = (np.stack([p[..., 0], -p[..., 2], p[..., 1]], -1) for p in (corners, normals))
    return Surface(corners, normals, uv)


def _read_other(path: Path) -> Surface:
    import trimesh  # Slow to import, and few scenes have a mesh.

    try:
        # Unprocessed, because merging corners would drop the file's normals.
        loaded = trimesh.load(path, process=False)
        parts = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
        return joined([_surface_of(part) for part in parts])
    except Exception as error:
        # Each of trimesh's readers fails in its own way.
        raise ValueError(f"mesh {path} cannot be read ({error}); export it anew as OBJ or PLY") from error


def _surface_of(mesh: Any) -> Surface:
    """Triangles of one of trimesh's meshes."""
    corners = np.asarray(mesh.vertices[mesh.faces], float)
    # Normals that the file does not hold trimesh would make up, smooth over every edge.
    given = "vertex_normals" in mesh._cache
    normals = np.asarray(mesh.vertex_normals[mesh.faces], float) if given else flat_normals(corners)
    uv = getattr(mesh.visual, "uv", None)
    uv = np.asarray(uv, float)[mesh.faces] if uv is not None and len(uv) == len(mesh.vertices) else None
    return Surface(corners, normals, uv)


@dataclass
class _Obj:
    """What an OBJ file holds so far: places, texture places and normals, and faces as numbers of these.

    A corner that has no texture place or normal has the number -1 for it.
    """

    v: list[list[float]] = field(default_factory=list)
    vt: list[list[float]] = field(default_factory=list)
    vn: list[list[float]] = field(default_factory=list)
    triangles: list[list[tuple[int, int, int]]] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)
    _known: dict[str, tuple[int, int, int]] = field(default_factory=dict)

    def add(self, words: list[str], line: int) -> None:
        """Take in one line, if it holds what is needed here.

        Raises:
            ValueError: it holds something else than its first word says.
        """
        kind, values = words[0], words[1:]
        if kind == "f":
            # Most corners are those of several faces.
            corners = [self._known.get(word) or self._corner(word) for word in values]
            if len(corners) < 3:
                raise ValueError("a face needs at least three corners")
            fan = [[corners[0], *pair] for pair in pairwise(corners[1:])]
            self.triangles += fan
            self.lines += [line] * len(fan)
        elif kind in _NUMBERS:
            numbers = [float(value) for value in values[: _NUMBERS[kind]]]
            numbers += [0.0] * (_NUMBERS[kind] - len(numbers)) if kind == "vt" else []
            if len(numbers) < _NUMBERS[kind] or not all(abs(number) <= _LARGEST for number in numbers):
                raise ValueError(f"{kind} wants {_NUMBERS[kind]} numbers within {_LARGEST:g}")
            getattr(self, kind).append(numbers)

    def _corner(self, word: str) -> tuple[int, int, int]:
        """Numbers from 0 of a corner's place, texture place and normal; negative ones count back."""
        numbers: list[int] = []
        for text, there in zip_longest(word.split("/")[:3], (self.v, self.vt, self.vn), fillvalue=""):
            number = int(text) if text else None
            if number == 0:
                raise ValueError("corners are counted from 1, and it has number 0")
            if number is not None and number < -len(there):
                raise ValueError(f"it counts {-number} back, and only {len(there)} are there")
            numbers.append(-1 if number is None else number - 1 if number > 0 else len(there) + number)
        place, texture, normal = numbers
        if place < 0:
            raise ValueError("a corner has no number")
        if "-" not in word:
            self._known[word] = place, texture, normal
        return place, texture, normal


def _read_obj(path: Path) -> Surface:
    """The triangles of an OBJ file. Its materials are left out: the scene says what things look like.

    Raises:
        ValueError: it is damaged, or holds no faces.
    """
    data = path.read_bytes()
    # Names and comments are in whatever the writer's language had; what counts is ASCII.
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = data.decode("utf-16" if wide else "utf-8-sig", errors="replace")
    if "\0" in text:
        raise ValueError(f"mesh {path} holds binary data and no OBJ text; export it anew")
    obj, held = _Obj(), ""
    for number, line in enumerate(text.splitlines(), start=1):
        held += line.partition("#")[0]
        if held.endswith("\\"):
            held = held[:-1] + " "
            continue
        words, held = held.split(), ""
        try:
            if words:
                obj.add(words, number)
        except ValueError as error:
            said = f"mesh {path} line {number}: {shorten(line, 60)!r} is damaged ({error})"
            raise ValueError(said) from error
    if not obj.triangles:
        raise ValueError(f"mesh {path} holds {len(obj.v)} vertices and no faces; export its faces")
    return _surface_of_obj(path, obj)


def _surface_of_obj(path: Path, obj: _Obj) -> Surface:
    numbers = np.array(obj.triangles)
    for k, (name, there) in enumerate((("v", obj.v), ("vt", obj.vt), ("vn", obj.vn))):
        beyond = np.flatnonzero((numbers[..., k] >= len(there)).any(1))
        if len(beyond):
            raise ValueError(
                f"mesh {path} line {obj.lines[beyond[0]]}: the face has {name} number "
                f"{numbers[beyond[0], :, k].max() + 1}, and the file holds {len(there)}; export it anew"
            )
    place, texture, normal = np.moveaxis(numbers, -1, 0)
    corners = np.array(obj.v)[place]
    normals = flat_normals(corners)
    given = np.array([*obj.vn, [0.0, 0.0, 0.0]])[normal]
    length = np.linalg.norm(given, axis=-1, keepdims=True)
    smooth = (length > 0).all((1, 2))
    normals[smooth] = given[smooth] / length[smooth]
    return Surface(corners, normals, np.array(obj.vt)[texture] if (texture >= 0).all() else None)
