"""What is odd about a camera, without its boards: each claim against the others, and against a photo."""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from autoreg.calibration.claims import Claims
from autoreg.calibration.exif_support import FOCAL_AGREES, FOCAL_CONTRADICTS, Support, exif_support
from autoreg.calibration.focal import FocalLength, angle_deg, focal_from_angle
from autoreg.camera import fit_to_photo, same_aspect
from autoreg.errors import InputError
from autoreg.formats.exif import Exif, focal_from_exif, read_exif
from autoreg.image import load_photo

Weight = Literal["wrong", "odd", "note"]

# Parts of the picture's side by which a principal point may be off its middle: lenses are centred to a few
# percent of it; stabilisation moves them by one or two.
_OFF_CENTRE = (0.06, 0.2)
# Pixels are square to well below a percent.
_ASPECT = (0.005, 0.02)
# One figure translated into another should agree to rounding.
_SAME = 0.01
# Radial terms that move a corner of the picture by more than this part of its distance are no lens's.
_MOST_RADIAL = (0.6, 2.0)


@dataclass(frozen=True)
class Oddity:
    """Something about a camera that a reader should know."""

    weight: Weight
    text: str


@dataclass(frozen=True)
class Inspection:
    """All that can be said of a camera file.

    Attributes:
        claims: what it claims.
        focal: its focal length in every unit, as far as it can be translated; None if it has none.
        exif_focal_px: what the photo's EXIF makes of it, or None.
        exif_words: how that was found, or why not; None without a photo.
        supports: which of the claimed focal lengths the photo's EXIF supports.
        oddities: what is odd, worst first.
    """

    claims: Claims
    focal: FocalLength | None
    exif_focal_px: float | None
    exif_words: str | None
    supports: tuple[Support, ...]
    oddities: tuple[Oddity, ...]

    @property
    def contradictory(self) -> bool:
        """Whether something cannot be right."""
        return any(oddity.weight == "wrong" for oddity in self.oddities)


def inspect_camera(claims: Claims, photo: Path | None = None) -> Inspection:
    """What is odd about a camera's claims, by themselves and, if given, against a photo.

    Raises:
        InputError: the photo cannot be read.
    """
    found = [*_shape(claims), *_lens(claims), *_focal_claims(claims), *_quality(claims)]
    exif_focal = exif_words = None
    supports: tuple[Support, ...] = ()
    width, height, exif = claims.width, claims.height, Exif()
    if photo is not None:
        picture, exif = load_photo(photo), read_exif(photo.read_bytes())
        width, height = float(picture.width), float(picture.height)
        exif_focal, exif_words = focal_from_exif(exif, picture.width, picture.height)
        found += _against_photo(claims, picture.width, picture.height, exif, exif_focal)
        supports = tuple(exif_support(claims, width, height, exif, exif_focal))
    focal_mm = exif.focal_mm or claims.exif_focal_mm
    focal = None
    if claims.focal is not None and claims.width and claims.height:
        if not width or not height or not _same_frame(claims.width, claims.height, width, height):
            width, height = claims.width, claims.height
        scale = math.hypot(width, height) / math.hypot(claims.width, claims.height)
        focal = FocalLength(claims.focal * scale, width, height, focal_mm)
    order = ("wrong", "odd", "note")
    found.sort(key=lambda oddity: order.index(oddity.weight))
    return Inspection(claims, focal, exif_focal, exif_words, supports, tuple(found))


def _same_frame(width: float, height: float, other_width: float, other_height: float) -> bool:
    """Whether a picture can be a frame made larger or smaller, upright or on its side."""
    sizes = sorted((round(width), round(height))), sorted((round(other_width), round(other_height)))
    return same_aspect(*sizes[0], *sizes[1])


def _weight(value: float, limits: tuple[float, float]) -> Weight | None:
    return "wrong" if value > limits[1] else "odd" if value > limits[0] else None


def _shape(claims: Claims) -> Generator[Oddity]:
    """Principal point and the two focal lengths."""
    c = claims
    if c.width and c.height and c.cx is not None and c.cy is not None:
        off_x, off_y = (c.cx - (c.width - 1) / 2) / c.width, (c.cy - (c.height - 1) / 2) / c.height
        weight = _weight(max(abs(off_x), abs(off_y)), _OFF_CENTRE)
        if weight:
            w, h = 2 * c.cx + 1, 2 * c.cy + 1
            hint = ""
            if (w - h) * (c.width - c.height) < 0:
                hint = (
                    f"; it would be the middle of a picture of {w:.0f} x {h:.0f}, on its side against this "
                    "one: "
                    "were photos of both orientations mixed?"
                )
            yield Oddity(
                weight,
                f"the principal point ({c.cx:g}, {c.cy:g}) lies {100 * off_x:+.0f} % of the width and "
                f"{100 * off_y:+.0f} % of the height from the middle of {c.width:.0f} x {c.height:.0f}; "
                "lenses are "
                f"centred to a few percent{hint}",
            )
    difference = c.fx_fy_difference
    if c.fx is not None and c.fy is not None:
        difference = abs(c.fx / c.fy - 1)
    if difference is not None and (weight := _weight(difference, _ASPECT)):
        yield Oddity(
            weight,
            f"fx and fy differ by {100 * difference:.1f} %: pixels are square, so the squares of the board "
            "were not, or its views do not determine the camera",
        )


def _lens(claims: Claims) -> Generator[Oddity]:
    """Distortion that folds, or that is larger than lenses'."""
    c = claims
    if c.camera is not None and c.camera.has_distortion:
        outline = _outline(c.camera.width, c.camera.height)
        lost = np.isnan(c.camera.normalise(outline)).any(1).mean()
        if lost > 0:
            yield Oddity(
                "wrong",
                f"the distortion folds back within the picture: {100 * lost:.0f} % of its edge has no ray "
                f"(the model is valid up to {math.degrees(math.atan(c.camera.valid_radius)):.0f}° off the "
                "axis)",
            )
    if not (c.focal and c.width and c.height) or (c.camera is not None and any(c.camera.dist[5:])):
        return  # of a rational model, single terms mean nothing
    cx = (c.width - 1) / 2 if c.cx is None else c.cx
    cy = (c.height - 1) / 2 if c.cy is None else c.cy
    radius = math.hypot(max(cx, c.width - 1 - cx), max(cy, c.height - 1 - cy)) / c.focal
    for name, power in (("k1", 2), ("k2", 4), ("k3", 6)):
        value = c.coefficients.get(name, 0.0)
        if weight := _weight(abs(value) * radius**power, _MOST_RADIAL):
            yield Oddity(
                weight,
                f"{name} = {value:g} alone would move the furthest corner of the picture by "
                f"{100 * abs(value) * radius**power:.0f} % of its distance from the principal point: no "
                "lens does "
                "that, so the other terms must undo it, and beyond the boards' reach nothing holds",
            )


def _focal_claims(claims: Claims) -> Generator[Oddity]:
    """Focal lengths in several units that should be one."""
    c = claims
    if not (c.focal and c.width and c.height):
        return
    across, down, diagonal = (
        angle_deg(c.focal, s) for s in (c.width, c.height, math.hypot(c.width, c.height))
    )
    if c.angle_of_view_deg is not None:
        needed = focal_from_angle(c.angle_of_view_deg, c.width)
        if abs(needed / c.focal - 1) > _SAME:
            yield Oddity(
                "wrong",
                f"an angle of view of {c.angle_of_view_deg:g}° across {c.width:.0f} px is a focal length of "
                f"{needed:.0f} px, {100 * (needed / c.focal - 1):+.1f} % against the claimed {c.focal:g} "
                "px, whose "
                f"angles are {across:.2f}° across, {down:.2f}° down and {diagonal:.2f}° along the diagonal",
            )
    if c.exif_focal_mm is not None:
        width_mm = c.exif_focal_mm * c.width / c.focal
        text = (
            f"{c.focal:g} px and {c.exif_focal_mm:g} mm agree only if the sensor is {width_mm:.2f} mm wide "
            "(pixels "
            f"of {1000 * width_mm / c.width:.2f} µm); EXIF's mm say nothing about pixels without the "
            "sensor's size"
        )
        if c.angle_of_view_deg is not None:
            other = 2 * c.exif_focal_mm * math.tan(math.radians(c.angle_of_view_deg) / 2)
            if abs(other / width_mm - 1) > _SAME:
                yield Oddity(
                    "wrong",
                    f"{text}; {c.exif_focal_mm:g} mm at {c.angle_of_view_deg:g}° needs one of {other:.2f} "
                    "mm: the "
                    "three figures are not of one camera at one setting",
                )
                return
        yield Oddity("note", text)


def _quality(claims: Claims) -> Generator[Oddity]:
    c = claims
    if c.mean_error_px is not None and c.corners:
        yield Oddity(
            "odd" if c.mean_error_px * math.sqrt(c.corners) > 1 else "note",
            f"a mean error of {c.mean_error_px:g} as |residuals| / N over {c.corners} corners is no "
            "distance: it is "
            f"an RMS of about {c.mean_error_px * math.sqrt(c.corners):.2f} px per corner",
        )
    if c.verdict is not None and c.verdict[0] != "good":
        weight = "wrong" if c.verdict[0] == "do not use" else "note"
        yield Oddity(weight, f"the file says of itself: {c.verdict[0]}: {'; '.join(c.verdict[1])}")
    if c.camera is not None and not c.std_devs:
        yield Oddity(
            "note", "the file gives no standard deviations, so nothing says how good the figures are"
        )
    if c.camera is None:
        names = {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "width": c.width, "height": c.height}
        missing = [name for name, value in names.items() if value is None]
        missing += [] if {"k1", "k2"} <= c.coefficients.keys() else ["distortion"]
        yield Oddity("note", f"not stated: {', '.join(missing)}; it cannot be used to align")


def _against_photo(
    claims: Claims, width: int, height: int, exif: Exif, exif_focal: float | None
) -> Generator[Oddity]:
    """Size and field of view against the photo's."""
    if claims.camera is not None:
        try:
            _, note = fit_to_photo(
                claims.camera, width, height, photo_turned=exif.turned, photo_mirrored=exif.mirrored
            )
        except InputError as error:
            yield Oddity("wrong", str(error))
        else:
            if note:
                yield Oddity("note", note)
    elif claims.width and claims.height and (claims.width, claims.height) != (width, height):
        same = _same_frame(claims.width, claims.height, float(width), float(height))
        yield Oddity(
            "odd" if same else "wrong",
            f"the camera is of {claims.width:.0f} x {claims.height:.0f}, the photo {width} x {height}"
            + ("" if same else ": their aspect ratios differ, so it is no plain resize"),
        )
    if exif_focal is None or not (claims.focal and claims.width and claims.height):
        return
    scaled = claims.focal * math.hypot(width, height) / math.hypot(claims.width, claims.height)
    apart = scaled / exif_focal - 1
    if abs(apart) > FOCAL_CONTRADICTS:
        yield Oddity(
            "wrong",
            f"the focal length is {scaled:.0f} px for this photo but its EXIF supports {exif_focal:.0f} px, "
            f"{100 * apart:+.0f} %: another lens, zoom or crop",
        )
    elif abs(apart) > FOCAL_AGREES:
        yield Oddity(
            "odd",
            f"the focal length is {100 * apart:+.1f} % off what the photo's EXIF gives ({exif_focal:.0f} "
            "px), which "
            "is rounded and taken at another distance, but rarely by so much",
        )


def _outline(width: int, height: int) -> np.ndarray:
    u, v = np.linspace(0, width - 1, 101), np.linspace(0, height - 1, 101)
    return np.concatenate(
        [np.column_stack([u, 0 * u + e]) for e in (0, height - 1)]
        + [np.column_stack([0 * v + e, v]) for e in (0, width - 1)]
    )
