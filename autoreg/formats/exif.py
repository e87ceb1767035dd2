"""What a picture file says of itself: whether it is whole, its EXIF orientation and focal length."""

from __future__ import annotations

import io
import math
import struct
import warnings
import zlib
from dataclasses import dataclass

from autoreg.formats.heic import heic_exif, is_heic, is_turned

_ORIENTATION, _FOCAL_MM, _FOCAL_35MM = 0x0112, 0x920A, 0xA405
_F_NUMBER = 0x829D
_MAKER, _MODEL = 0x010F, 0x0110
_PIXEL_WIDTH, _PIXEL_HEIGHT = 0xA002, 0xA003
_PLANE_X_RESOLUTION, _PLANE_UNIT, _DIGITAL_ZOOM = 0xA20E, 0xA210, 0xA404
_EXIF_IFD = 0x8769
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_DIAGONAL_35MM = math.hypot(36.0, 24.0)
# EXIF's orientation as (exchange left and right first, then quarter turns clockwise).
_TURNS = {
    1: (False, 0),
    2: (True, 0),
    3: (False, 2),
    4: (True, 2),
    5: (True, 3),
    6: (False, 1),
    7: (True, 1),
    8: (False, 3),
}
# A focal length in diagonals: a rectilinear lens below 0.2 would see 136° across, none is above 20.
_FOCAL_IN_DIAGONALS = (0.2, 20.0)
# Sensors of cameras that take photos, in mm along the long side.
_SENSOR_WIDTH_MM = (1.0, 70.0)
# EXIF's focal lengths are good to a few percent: an aspect ratio within one percent is the same picture.
_ASPECT_TOLERANCE = 0.01


@dataclass(frozen=True)
class Exif:
    """The entries of a photo's EXIF that matter to its geometry; None for those that are absent or broken."""

    mirrored: bool = False
    turned: int = 0
    focal_mm: float | None = None
    focal_35mm: float | None = None
    pixel_width: float | None = None
    pixel_height: float | None = None
    plane_pixels_per_mm: float | None = None
    digital_zoom: float | None = None
    f_number: float | None = None
    maker: str | None = None
    model: str | None = None

    @property
    def holds_focal(self) -> bool:
        """Whether any focal length is recorded, be it of use or not."""
        return self.focal_35mm is not None or self.focal_mm is not None


def read_exif(data: bytes) -> Exif:
    """The EXIF of a picture file's bytes; empty where there is none or it is broken."""
    block = _exif_block(data)
    if block is None and (data.startswith((b"\xff\xd8", b"\x89PNG")) or is_heic(data)):
        return Exif()
    # Where there is no EXIF, nothing need be imported to read it.
    from PIL import Image

    exif = Image.Exif()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if block is not None:
                exif.load(block)
            else:
                exif = Image.open(io.BytesIO(data)).getexif()
            # Some programs that rewrite a file put entries of the camera's directory into the main one.
            details = {**exif, **exif.get_ifd(_EXIF_IFD)}
            orientation = exif.get(_ORIENTATION)
            maker, model = (_words(exif.get(tag)) for tag in (_MAKER, _MODEL))
    except Exception:
        # Pillow fails on broken EXIF in ways it does not list; a photo without EXIF is a photo all the same.
        return Exif()
    mirrored, turned = _TURNS.get(orientation, (False, 0)) if isinstance(orientation, int) else (False, 0)
    if is_heic(data) and not is_turned(data):
        mirrored, turned = False, 0
    resolution = _positive(details.get(_PLANE_X_RESOLUTION))
    unit = _MM_PER_UNIT.get(int(_positive(details.get(_PLANE_UNIT, 2)) or 0))
    return Exif(
        mirrored=mirrored,
        turned=turned,
        focal_mm=_positive(details.get(_FOCAL_MM)),
        focal_35mm=_positive(details.get(_FOCAL_35MM)),
        pixel_width=_positive(details.get(_PIXEL_WIDTH)),
        pixel_height=_positive(details.get(_PIXEL_HEIGHT)),
        plane_pixels_per_mm=resolution / unit if resolution and unit else None,
        digital_zoom=_positive(details.get(_DIGITAL_ZOOM)),
        f_number=_positive(details.get(_F_NUMBER)),
        maker=maker,
        model=model,
    )


def _words(value: object) -> str | None:
    text = " ".join(str(value).replace("\0", " ").split()) if isinstance(value, str) else ""
    return text or None


def focal_from_exif(exif: Exif, width: int, height: int) -> tuple[float | None, str]:
    """Focal length in pixels of a file of this size, and a sentence that says how it was found or why not.

    FocalLengthIn35mmFilm is taken by its definition over the diagonal: f = f35 * diagonal / 43.27 mm.
    Without it, FocalLength and the sensor's pixel pitch give it for the recorded size, scaled to the file's.
    """
    if not exif.holds_focal:
        return None, "the photo's EXIF holds no focal length"
    recorded = (exif.pixel_width, exif.pixel_height)
    crop = _crop_note(recorded, width, height)
    if crop is not None:
        return None, crop
    unsure = "" if None not in recorded else "; EXIF holds no picture size, so a crop cannot be told"
    diagonal = math.hypot(width, height)
    if exif.focal_35mm is not None:
        focal = exif.focal_35mm * diagonal / _DIAGONAL_35MM
        if _plausible(focal, diagonal):
            return focal, f"EXIF: {exif.focal_35mm:g} mm on 35 mm film is {focal:.0f} px{unsure}"
    focal = _focal_from_pitch(exif, width, height)
    if focal is not None and _plausible(focal, diagonal):
        return focal, f"EXIF: {exif.focal_mm:g} mm at the sensor's pixel pitch is {focal:.0f} px"
    if exif.focal_mm is None:
        return None, f"EXIF's {exif.focal_35mm:g} mm on 35 mm film is not plausible"
    return None, f"EXIF's focal length of {exif.focal_mm:g} mm comes without a usable sensor size"


def truncated(data: bytes) -> bool:
    """Whether a JPEG or PNG file ends before its picture does (or a PNG's check sum fails).

    Decoders fill the missing part with grey, some without a word. Other formats are left to the decoder.
    """
    if data.startswith(b"\xff\xd8"):
        scan = _jpeg_segments(data)[1]
        # Inside a scan every 0xFF is stuffed or a restart marker, so FFD9 can only be the end.
        return scan is None or data.find(b"\xff\xd9", scan) < 0
    if data.startswith(b"\x89PNG"):
        return _png_chunks(data)[1]
    return False


def _crop_note(recorded: tuple[float | None, float | None], width: int, height: int) -> str | None:
    """Why the file cannot be the recorded picture as a whole, or None."""
    wide, high = recorded
    if wide is None or high is None:
        return None
    was, now = sorted((wide, high)), sorted((width, height))
    if abs(now[1] / now[0] * was[0] / was[1] - 1) <= _ASPECT_TOLERANCE:
        return None
    return (
        f"EXIF records {wide:g} x {high:g} but the file is {width} x {height}: it was cropped, "
        "so EXIF's focal length is not used"
    )


def _focal_from_pitch(exif: Exif, width: int, height: int) -> float | None:
    """Focal length in pixels by the pixel pitch of the recorded picture, or None where that is unknown."""
    if exif.focal_mm is None or exif.plane_pixels_per_mm is None:
        return None
    if exif.pixel_width is None or exif.pixel_height is None:
        return None
    if exif.digital_zoom is not None and exif.digital_zoom > 1.0:
        return None  # cameras differ in whether the recorded pitch is that before or after the zoom
    recorded_long = max(exif.pixel_width, exif.pixel_height)
    low, high = _SENSOR_WIDTH_MM
    if not low <= recorded_long / exif.plane_pixels_per_mm <= high:
        return None
    return exif.focal_mm * exif.plane_pixels_per_mm * max(width, height) / recorded_long


def _plausible(focal: float, diagonal: float) -> bool:
    low, high = _FOCAL_IN_DIAGONALS
    return low <= focal / diagonal <= high


def _positive(value: object) -> float | None:
    """A value as a positive finite number, or None."""
    try:
        number = float(value)  # pyright: ignore[reportArgumentType]  # rationals, ints, or anything at all
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def _exif_block(data: bytes) -> bytes | None:
    """The EXIF block of a JPEG, PNG, WebP or HEIC file.

    Pillow would decode a whole PNG to look for one, and refuses very large pictures.
    """
    if data.startswith(b"\xff\xd8"):
        return next((s[6:] for s in _jpeg_segments(data)[0] if s.startswith(b"Exif\0\0")), None)
    if data.startswith(b"\x89PNG"):
        return _png_chunks(data)[0]
    if is_heic(data):
        return heic_exif(data)
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        at = 12
        while at + 8 <= len(data):
            (length,) = struct.unpack_from("<I", data, at + 4)
            if data[at : at + 4] == b"EXIF":
                return data[at + 8 : at + 8 + length].removeprefix(b"Exif\0\0")
            at += 8 + length + length % 2
    return None


def _jpeg_segments(data: bytes) -> tuple[list[bytes], int | None]:
    """The APP1 segments before the first scan, and where that scan starts (None: there is none)."""
    segments: list[bytes] = []
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            return segments, None
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        (length,) = struct.unpack_from(">H", data, at + 2)
        if marker == 0xDA:
            return segments, at + 2 + length
        if marker == 0xE1:
            segments.append(data[at + 4 : at + 2 + length])
        at += 2 + length
    return segments, None


def _png_chunks(data: bytes) -> tuple[bytes | None, bool]:
    """The EXIF chunk of a PNG, and whether the file ends early or is corrupt."""
    exif: bytes | None = None
    at = 8
    while at + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, at)
        kind, end = data[at + 4 : at + 8], at + 8 + length
        if end + 4 > len(data) or zlib.crc32(data[at + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            return exif, True
        if kind == b"eXIf":
            exif = data[at + 8 : end].removeprefix(b"Exif\0\0")
        if kind == b"IEND":
            return exif, False
        at = end + 4
    return exif, True
