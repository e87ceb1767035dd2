"""Text as triangles, by the outlines of a font's letters."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import mapbox_earcut
import numpy as np
from fontTools.pens.recordingPen import DecomposingRecordingPen
from fontTools.ttLib import TTFont
from jaxtyping import Float
from PIL import ImageFont

from autoreg.rendering.surface import Surface, flat_normals

# Straight pieces of one curve of an outline.
_PIECES = 8


def text_surface(text: str, height: float, depth: float, font: Path | None) -> Surface:
    """Upright letters centred on the origin, standing on Z = 0 and facing -Y.

    Args:
        text: one line.
        height: of a capital letter.
        depth: from the front of the letters to their back.
        font: a TrueType or OpenType file; None is the font that Pillow brings along.

    Raises:
        ValueError: the font cannot be read, or lacks a letter.
    """
    letters = _read_letters(text, font)
    size = letters.capital_height
    along, parts = 0.0, [np.empty((0, 3, 3))]
    for letter in text:
        for outline in _outlines(letters.rings[letter]):
            parts.append(_solid([ring + np.array([along, 0.0]) for ring in outline], depth * size / height))
        along += letters.widths[letter]
    corners = np.concatenate(parts) * height / size
    if not len(corners):
        raise ValueError(f"text {text!r} has no letter that can be seen")
    corners -= [0.5 * (corners[..., 0].min() + corners[..., 0].max()), 0.0, corners[..., 2].min()]
    low, high = corners.min((0, 1)), corners.max((0, 1))
    uv = (corners[..., [0, 2]] - low[[0, 2]]) / (high - low)[[0, 2]]
    return Surface(corners, flat_normals(corners), uv)


@dataclass(frozen=True)
class _Letters:
    """Outlines and widths of letters, in the font's own unit."""

    rings: dict[str, list[Float[np.ndarray, "_ 2"]]]
    widths: dict[str, float]
    capital_height: float


def _read_letters(text: str, path: Path | None) -> _Letters:
    """What a font says of the letters of a text.

    Raises:
        ValueError: the font cannot be read, or lacks a letter.
    """
    try:
        font = _open_font(path)
        names: dict[int, str] = font.getBestCmap() or {}
        glyphs = font.getGlyphSet()
        there = {letter: names[ord(letter)] for letter in text if ord(letter) in names}
        rings = {letter: _rings(glyphs, name) for letter, name in there.items()}
        widths = {letter: float(glyphs[name].width) for letter, name in there.items()}
        capital = np.concatenate([np.zeros((1, 2)), *_rings(glyphs, names.get(ord("H"), ".notdef"))])
        height = float(capital[:, 1].max()) if ord("H") in names else 0.7 * _units_per_em(font)
    except Exception as error:
        # A damaged font fails in many ways, each table in its own.
        raise ValueError(f"font {path} cannot be read ({error or type(error).__name__})") from error
    if missing := sorted(set(text) - set(there)):
        raise ValueError(f"the font has no letter {' '.join(map(repr, missing))}; give another with font")
    if not height > 0:
        raise ValueError(f"font {path} has capital letters without a height; take another")
    return _Letters(rings, widths, height)


def _open_font(path: Path | None) -> TTFont:
    if path is not None:
        return TTFont(path, fontNumber=0)
    built_in = ImageFont.load_default(size=10)
    assert isinstance(built_in, ImageFont.FreeTypeFont), "Pillow was built without FreeType"
    return TTFont(io.BytesIO(built_in.font_bytes))


def _units_per_em(font: TTFont) -> float:
    return float(font["head"].unitsPerEm)  # pyright: ignore[reportAttributeAccessIssue]  # made at run time


def _rings(glyphs: object, name: str) -> list[Float[np.ndarray, "_ 2"]]:
    """Closed outlines of one glyph, curves cut into straight pieces."""
    pen = DecomposingRecordingPen(glyphs)
    glyphs[name].draw(pen)  # pyright: ignore[reportIndexIssue]  # a mapping without types
    rings: list[list[np.ndarray]] = []
    t = np.linspace(0.0, 1.0, _PIECES + 1)[1:, None]
    for step, given in pen.value:
        points = [np.array(p, float) for p in given if p is not None]
        if step == "moveTo":
            rings.append([points[0]])
        elif step == "lineTo":
            rings[-1].append(points[0])
        elif step == "curveTo":
            a, (b, c, d) = rings[-1][-1], points
            rings[-1] += list((1 - t) ** 3 * a + 3 * t * (1 - t) ** 2 * b + 3 * t**2 * (1 - t) * c + t**3 * d)
        elif step == "qCurveTo":
            # TrueType leaves out the points half-way between two control points. A ring of control points
            # alone has no first point either.
            if given[-1] is None:
                first = 0.5 * (points[0] + points[-1])
                rings.append([first])
                points.append(first)
            for k, b in enumerate(points[:-1]):
                a = rings[-1][-1]
                c = points[-1] if k == len(points) - 2 else 0.5 * (b + points[k + 1])
                rings[-1] += list((1 - t) ** 2 * a + 2 * t * (1 - t) * b + t**2 * c)
    return [cleaned for ring in rings if len(cleaned := _without_repeats(np.array(ring))) > 2]


def _without_repeats(ring: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "m 2"]:
    return ring[np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1) > 1e-6]


def _outlines(rings: list[Float[np.ndarray, "_ 2"]]) -> list[list[Float[np.ndarray, "_ 2"]]]:
    """Each outer ring (counter-clockwise) with the holes (clockwise) that lie directly in it."""
    around = [[k for k, other in enumerate(rings) if k != n and _inside(ring[0], other)]
              for n, ring in enumerate(rings)]  # fmt: skip
    found: dict[int, list[np.ndarray]] = {}
    for n, ring in enumerate(rings):
        if len(around[n]) % 2 == 0:
            found[n] = [_oriented(ring, 1.0)]
    for n, ring in enumerate(rings):
        if len(around[n]) % 2 == 1:
            owner = max((k for k in around[n] if k in found), key=lambda k: len(around[k]))
            found[owner].append(_oriented(ring, -1.0))
    return list(found.values())


def _inside(point: Float[np.ndarray, "2"], ring: Float[np.ndarray, "n 2"]) -> bool:
    a, b = ring, np.roll(ring, -1, axis=0)
    crosses = (a[:, 1] > point[1]) != (b[:, 1] > point[1])
    a, b = a[crosses], b[crosses]
    x = a[:, 0] + (point[1] - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    return bool((x > point[0]).sum() % 2)


def _oriented(ring: Float[np.ndarray, "n 2"], sign: float) -> Float[np.ndarray, "n 2"]:
    other = np.roll(ring, -1, axis=0)
    area = float((ring[:, 0] * other[:, 1] - ring[:, 1] * other[:, 0]).sum())
    return ring if area * sign > 0 else ring[::-1]


def _solid(rings: list[Float[np.ndarray, "_ 2"]], depth: float) -> Float[np.ndarray, "m 3 3"]:
    """Front, back and rim of an outline with holes, as triangles; x to the right, z up, front at -y."""
    points = np.concatenate(rings)
    ends = np.cumsum([len(ring) for ring in rings]).astype(np.uint32)
    index = mapbox_earcut.triangulate_float64(points, ends).reshape(-1, 3)
    flat = points[index.astype(np.int64)]
    e1, e2 = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    turn = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
    flat = np.where(turn[:, None, None] > 0, flat, flat[:, ::-1])

    def at(xz: np.ndarray, y: float) -> np.ndarray:
        return np.stack([xz[..., 0], np.full(xz.shape[:-1], y), xz[..., 1]], -1)

    half = 0.5 * depth
    parts = [at(flat, -half), at(flat[:, ::-1], half)]
    for ring in rings:
        a, b = ring, np.roll(ring, -1, axis=0)
        # The outline runs with the letter on its left, so its outer side is on the right.
        quad = np.stack([at(a, half), at(b, half), at(b, -half), at(a, -half)], 1)
        parts += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
    return np.concatenate(parts)
