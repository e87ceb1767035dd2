"""The picture by which a person sees whether the fit is right: the lattice drawn over the photo."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from autoreg.alignment import Alignment
from autoreg.layout import crossings, lay_joints, slab_side_x
from autoreg.view import View

BGR = tuple[int, int, int]

# Cyan and magenta: no paving has these colours, and people who confuse red and green tell them apart.
_USED: BGR = (255, 255, 0)
_PREDICTED: BGR = (255, 0, 255)
_BEYOND: BGR = (0, 220, 255)
_CROSSING: BGR = (255, 255, 255)
_AXES: tuple[BGR, BGR, BGR] = ((40, 40, 255), (40, 200, 40), (255, 120, 40))

# OpenCV draws at 1/16 pixel with this many fractional bits.
_BITS = 4
# Joints closer together than this (in pixels of a 2-megapixel picture) would hide the ground: not drawn.
_CLOSEST = 5.0
# A slab has to be this large to get circles on its corners.
_CIRCLED = 28.0
_PIECES = 48


@dataclass(frozen=True)
class _Pens:
    """Line widths for a picture's size."""

    unit: float
    thin: int
    bold: int


def overlay_picture(alignment: Alignment, photo: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """The photo (BGR) with the fitted lattice, the ground's axes and a legend, at the photo's own size.

    Lines are drawn half transparent and about as thin as one joint seen from afar, so that the photo's
    own joints can be seen beside and through them.
    """
    view = View(alignment.camera.camera, alignment.pose.cam_from_ground)
    unit = float(np.sqrt(photo.shape[0] * photo.shape[1] / 2e6))
    pens = _Pens(unit, max(1, round(1.3 * unit)), max(2, round(2.6 * unit)))
    drawn = photo.copy()
    _draw_lattice(drawn, view, alignment, pens)
    # Blended once, so that lines that cross do not add up.
    drawn = cv2.addWeighted(drawn, 0.85, photo, 0.15, 0.0)
    _draw_crossings(drawn, view, alignment, pens)
    _draw_axes(drawn, view, alignment, pens)
    _draw_legend(drawn, alignment, unit)
    return drawn


def _draw_lattice(drawn: UInt8[np.ndarray, "h w 3"], view: View, alignment: Alignment, pens: _Pens) -> None:
    lattice = alignment.lattice
    side_x, side_y = slab_side_x(lattice), lattice.spacing_y
    slab = np.array([side_x, side_y])
    low, high = lattice.extent.min(0) - slab, lattice.extent.max(0) + slab
    around = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    steps = (np.array([0.0, side_y]), np.array([side_x, 0.0]))
    for polygon, colour in ((around, _BEYOND), (lattice.extent, _PREDICTED)):
        joints = lay_joints(lattice, polygon)
        for segments, step in zip((joints.along_x, joints.along_y), steps, strict=True):
            px, ground = view.polylines(segments, _PIECES)
            apart = np.minimum(_spacing(view, px, ground, step), _spacing(view, px, ground, -step))
            _draw_lines(
                drawn, px, apart > _CLOSEST * pens.unit, colour, 1 if colour == _BEYOND else pens.thin
            )
    used = _used_segments(view, alignment)
    px, _ = view.polylines(used, _PIECES)
    _draw_lines(drawn, px, np.ones(px.shape[:2], bool), _USED, pens.thin)


def _used_segments(view: View, alignment: Alignment) -> Float[np.ndarray, "n 2 2"]:
    """The fitted joints, on the ground, between the ends at which they were seen.

    They are those of the fit, for the eye to compare with the photo.
    """
    ends_px = np.array([joint.ends_px for joint in alignment.joints]).reshape(-1, 2)
    ends = view.ground_under(ends_px).reshape(-1, 2, 2)
    return ends[np.isfinite(ends).all((1, 2))]


def _spacing(
    view: View,
    px: Float[np.ndarray, "n m 2"],
    ground: Float[np.ndarray, "n m 3"],
    step: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "n m"]:
    """Distance in the picture, across each line, to the same line one slab on; infinite where unseen."""
    moved = view.project(ground[..., :2] + step) - px
    way = np.gradient(px, axis=1)
    length = np.linalg.norm(way, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.abs(way[..., 0] * moved[..., 1] - way[..., 1] * moved[..., 0]) / length
    return np.where(np.isfinite(apart), apart, np.inf)


def _draw_lines(
    drawn: UInt8[np.ndarray, "h w 3"],
    px: Float[np.ndarray, "n m 2"],
    shown: Bool[np.ndarray, "n m"],
    colour: BGR,
    width: int,
) -> None:
    """Polylines, broken where they are not shown."""
    fixed = np.round(px * (1 << _BITS)).astype(np.int32)
    for line, keep in zip(fixed, shown, strict=True):
        cuts = np.flatnonzero(np.diff(keep.astype(np.int8))) + 1
        runs = [run for run in np.split(np.arange(len(line)), cuts) if keep[run[0]] and len(run) > 1]
        cv2.polylines(drawn, [line[run] for run in runs], False, colour, width, cv2.LINE_AA, _BITS)


def _draw_crossings(drawn: UInt8[np.ndarray, "h w 3"], view: View, alignment: Alignment, pens: _Pens) -> None:
    points = crossings(alignment.lattice)
    px = view.project(points)
    side_x, side_y = slab_side_x(alignment.lattice), alignment.lattice.spacing_y
    size = np.full(len(points), np.inf)
    for step in ([side_x, 0.0], [-side_x, 0.0], [0.0, side_y], [0.0, -side_y]):
        # A neighbour out of sight says nothing: fmin passes over its NaN.
        size = np.fmin(size, np.linalg.norm(view.project(points + step) - px, axis=1))
    px, size = px[np.isfinite(px).all(1)], size[np.isfinite(px).all(1)]
    for u, v in px[size > _CIRCLED * pens.unit]:
        centre = (round(u * (1 << _BITS)), round(v * (1 << _BITS)))
        radius = round(5.0 * pens.unit * (1 << _BITS))
        cv2.circle(drawn, centre, radius, _CROSSING, pens.thin, cv2.LINE_AA, _BITS)


def _draw_axes(drawn: UInt8[np.ndarray, "h w 3"], view: View, alignment: Alignment, pens: _Pens) -> None:
    """X, Y and Z at the origin, one short slab side long."""
    length = min(slab_side_x(alignment.lattice), alignment.lattice.spacing_y)
    segments = np.stack([np.zeros((3, 3)), length * np.eye(3)], 1)
    for segment, colour, name in zip(segments, _AXES, "XYZ", strict=True):
        px, _ = view.polylines(segment[None], _PIECES)
        if not len(px):
            continue
        for ink, width in (((0, 0, 0), pens.bold + 2 * pens.thin), (colour, pens.bold)):
            _draw_lines(drawn, px, np.ones(px.shape[:2], bool), ink, width)
        tip = px[0, -1] + 6 * pens.unit
        _write(drawn, name, tip, 0.6 * pens.unit, colour)


def _draw_legend(drawn: UInt8[np.ndarray, "h w 3"], alignment: Alignment, unit: float) -> None:
    """A strip in the top left corner that says what the colours mean and how good the fit is."""
    joints, rms = alignment.residual.joints, alignment.residual.rms_px
    items = [
        ("used in the fit", _USED),
        ("predicted", _PREDICTED),
        ("beyond what was seen", _BEYOND),
        *zip("XYZ", _AXES, strict=True),
        (f"{joints} joints, {rms:.2f} px rms", (255, 255, 255)),
    ]
    # A narrow picture gets smaller letters rather than a cut strip.
    wide = sum(_text_width(text, unit) + 22 * unit for text, _ in items) + 22 * unit
    size = min(0.7 * unit, unit * drawn.shape[1] / wide)
    gap = round(22 * size)
    widths = [_text_width(text, size) + gap for text, _ in items]
    strip = drawn[: round(46 * size), : sum(widths) + gap]
    strip[:] = strip // 4
    left = gap
    for (text, colour), width in zip(items, widths, strict=True):
        _write(drawn, text, np.array([left, 32 * size]), size, colour, rim=False)
        left += width


def _text_width(text: str, size: float) -> int:
    return cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, max(1, round(1.4 * size)))[0][0]


def _write(
    drawn: UInt8[np.ndarray, "h w 3"],
    text: str,
    place: Float[np.ndarray, "2"],
    size: float,
    colour: BGR,
    *,
    rim: bool = True,
) -> None:
    x, y, width = round(float(place[0])), round(float(place[1])), max(1, round(1.4 * size))
    # The dark rim is the same letters moved: OpenCV 5 sets thicker ones wider apart.
    around = ((-width, 0), (width, 0), (0, -width), (0, width)) if rim else ()
    for ink, moves in (((0, 0, 0), around), (colour, ((0, 0),))):
        for dx, dy in moves:
            cv2.putText(
                drawn, text, (x + dx, y + dy), cv2.FONT_HERSHEY_SIMPLEX, size, ink, width, cv2.LINE_AA
            )
