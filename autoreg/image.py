"""The photo: its pixels as EXIF orients them, and what its EXIF says of the lens."""

from __future__ import annotations

import hashlib
import math
import os
import struct
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from autoreg.errors import InputError
from autoreg.formats.exif import focal_from_exif, read_exif, truncated
from autoreg.formats.heic import can_decode_heic, heic_colour, is_heic

MIN_SIDE_PX = 64
# Pictures whose channels differ by less than this nearly everywhere are grey; every so many rows and columns
# are looked at.
COLOURLESS, COLOUR_EVERY = 4.0, 4
_FORMATS = "JPEG, PNG, TIFF or WebP"
_TIFF_ORIENTATION = 274


@dataclass(frozen=True)
class Photo:
    """A photo turned as its EXIF orientation asks.

    Attributes:
        gray: the picture in grey.
        turned: quarter turns clockwise that EXIF asked for, done in `gray` and `colour()`.
        mirrored: whether left and right were exchanged before turning, likewise.
        exif_focal_px: focal length in pixels by EXIF, or None.
        exif_focal_note: how that was found or why it is of no use; None if EXIF records no focal length.
    """

    gray: UInt8[np.ndarray, "h w"]
    turned: int
    exif_focal_px: float | None
    exif_focal_note: str | None
    mirrored: bool = False
    _data: bytes = field(default=b"", repr=False, compare=False)

    @property
    def width(self) -> int:
        """Width in pixels."""
        return self.gray.shape[1]

    @property
    def height(self) -> int:
        """Height in pixels."""
        return self.gray.shape[0]

    @cached_property
    def sha256(self) -> str:
        """Digest of the file's bytes, by which the photo is known again."""
        return hashlib.sha256(self._data).hexdigest()

    def colour(self) -> UInt8[np.ndarray, "h w 3"]:
        """The picture in colour (BGR), decoded anew from the bytes of the file that were read."""
        picture = _decoded(_tiff_unturned(self._data), cv2.IMREAD_COLOR)
        if picture is None:
            raise InputError(f"the photo's colours cannot be decoded; save it as {_FORMATS}")
        return _oriented(picture, self._data, self.mirrored, self.turned)


@dataclass(frozen=True)
class PixelScale:
    """The map from a reduced picture's pixels to the photo's: px_photo = (px_small + 0.5) * factor - 0.5.

    Pixel *edges* scale by the factor, so pixel centres need the half pixels.
    """

    factor_x: float
    factor_y: float

    def to_photo(self, px_small: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Pixels of the photo from those of the reduced picture."""
        return (px_small + 0.5) * [self.factor_x, self.factor_y] - 0.5

    def to_small(self, px_photo: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Pixels of the reduced picture from those of the photo."""
        return (px_photo + 0.5) / [self.factor_x, self.factor_y] - 0.5


def load_photo(path: str | Path) -> Photo:
    """The photo of a file, read once.

    Raises:
        InputError: the file is missing, empty, truncated, no picture, or of a size that cannot be used.
    """
    path = Path(path)
    data = _bytes_of(path)
    if truncated(data):
        raise InputError(f"photo {path} is truncated or corrupt; copy it again from the camera")
    exif = read_exif(data)
    stored = _decode_gray(path, _tiff_unturned(data))
    height, width = stored.shape
    if min(width, height) < MIN_SIDE_PX:
        raise InputError(
            f"photo {path} is {width} x {height}; each side needs at least {MIN_SIDE_PX} pixels: "
            "give the original, not a thumbnail"
        )
    focal_px, note = focal_from_exif(exif, width, height)
    gray = _oriented(stored, data, exif.mirrored, exif.turned)
    return Photo(gray, exif.turned, focal_px, note if exif.holds_focal else None, exif.mirrored, data)


def pyramid(gray: UInt8[np.ndarray, "h w"], max_pixels: int) -> tuple[UInt8[np.ndarray, "hs ws"], PixelScale]:
    """The picture reduced by area averaging to at most `max_pixels`, and the way back to its pixels.

    Both sides are rounded to whole pixels, so the factors along x and y are exact but may differ a little.
    """
    if max_pixels < 1:
        raise ValueError(f"max_pixels must be positive, got {max_pixels}")
    height, width = gray.shape
    if width * height <= max_pixels:
        return gray, PixelScale(1.0, 1.0)
    shrink = math.sqrt(max_pixels / (width * height))
    small_width = max(1, math.floor(width * shrink))
    small_height = max(1, min(math.floor(height * shrink), max_pixels // small_width))
    small = cv2.resize(gray, (small_width, small_height), interpolation=cv2.INTER_AREA)
    return as_gray(small), PixelScale(width / small_width, height / small_height)


def as_gray(array: np.ndarray) -> UInt8[np.ndarray, "h w"]:
    """A picture in grey, 8 bits deep, from a grey, BGR or BGRA array.

    Integers of 8 or 16 bits span their whole range; floating-point numbers span 0 to 1.

    Raises:
        ValueError: the array has another shape or type, or numbers outside 0 to 1.
    """
    array = _in_eight_bits(array)
    if array.ndim == 2:
        return array
    code = cv2.COLOR_BGR2GRAY if array.shape[2] == 3 else cv2.COLOR_BGRA2GRAY
    return np.asarray(cv2.cvtColor(array, code))


def as_colour(array: np.ndarray) -> UInt8[np.ndarray, "h w 3"] | None:
    """A picture in colour (BGR), 8 bits deep, from an array that `as_gray` takes; None if it has no colours.

    Raises:
        ValueError: the array has another shape or type, or numbers outside 0 to 1.
    """
    array = _in_eight_bits(array)
    return None if array.ndim == 2 else np.ascontiguousarray(array[:, :, :3])


def is_colourless(colour: UInt8[np.ndarray, "h w 3"]) -> bool:
    """Whether a picture's channels are as good as the same nearly everywhere."""
    some = colour[::COLOUR_EVERY, ::COLOUR_EVERY].reshape(-1, 3)
    return bool(np.quantile(np.ptp(some, axis=1), 0.95) < COLOURLESS)


def _in_eight_bits(array: np.ndarray) -> UInt8[np.ndarray, "h w *channels"]:
    given, array = array, np.asarray(array)
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    if array.ndim not in (2, 3) or (array.ndim == 3 and array.shape[2] not in (3, 4)) or array.size == 0:
        got = array.shape or type(given).__name__
        raise ValueError(
            f"photo must be an array of h x w, h x w x 3 (BGR) or x 4 (BGRA), got {got}; "
            "autoreg.load_photo(path).gray is that of a file"
        )
    if array.dtype == np.uint16:
        array = np.round(array / 257.0).astype(np.uint8)
    elif np.issubdtype(array.dtype, np.floating):
        if not (np.isfinite(array).all() and array.min() >= 0 and array.max() <= 1):
            raise ValueError("photo of floating-point numbers must lie within 0 to 1; divide it by its white")
        array = np.round(255.0 * array.astype(np.float64)).astype(np.uint8)
    elif array.dtype != np.uint8:
        raise ValueError(f"photo must be of uint8, uint16 or floating-point numbers, got {array.dtype}")
    return np.ascontiguousarray(array)


def _bytes_of(path: Path) -> bytes:
    # os.path answers "no" where Path raises: names that are too long, folders that may not be searched.
    if not os.path.exists(path):
        raise InputError(f"photo {path} does not exist; check the path")
    if not os.path.isfile(path):
        raise InputError(f"photo {path} is not a file; give one picture ({_FORMATS})")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"photo {path} cannot be read: {error.strerror}; check its permissions") from error
    if not data:
        raise InputError(f"photo {path} is empty; copy it again from the camera")
    return data


def _decode_gray(path: Path, data: bytes) -> UInt8[np.ndarray, "h w"]:
    if is_heic(data) and not can_decode_heic():
        raise InputError(
            f"photo {path} is HEIC, which pillow-heif decodes: pip install it, or save as JPEG or PNG"
        )
    # JPEG stores the luma by itself. Each other decoder weighs colours in a way of its own, as_gray in one.
    mode = cv2.IMREAD_GRAYSCALE if data.startswith(b"\xff\xd8") else cv2.IMREAD_ANYCOLOR
    try:
        picture = _decoded(data, mode)
    except (cv2.error, MemoryError) as error:
        raise InputError(
            f"photo {path} cannot be decoded: OpenCV takes at most 2^30 pixels, as far as memory goes; "
            "give it smaller"
        ) from error
    if picture is not None:
        return as_gray(picture)
    stored = _decoded(data, cv2.IMREAD_UNCHANGED)
    if stored is not None:
        raise InputError(f"photo {path} has pixels of {stored.dtype}; save it with 8 or 16 bits per channel")
    raise InputError(f"photo {path} is broken or no picture that can be decoded; save it as {_FORMATS}")


def _decoded(data: bytes, mode: int) -> np.ndarray | None:
    """The picture as stored (no orientation applied; upright if it is HEIC), or None where that fails."""
    if is_heic(data):
        colour = heic_colour(data)
        return None if colour is None else _in_eight_bits(colour)
    with _quiet_opencv():
        # OpenCV's versions differ in the formats whose orientation they apply, so none may be.
        flags = mode | cv2.IMREAD_IGNORE_ORIENTATION
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)


@contextmanager
def _quiet_opencv() -> Generator[None]:
    """Keeps OpenCV's own lines about broken files off stderr: the caller has a better message."""
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(level)


def _oriented(picture: np.ndarray, data: bytes, mirrored: bool, turned: int) -> np.ndarray:
    """A decoded picture as its EXIF asks. What decodes HEIC has turned it so already."""
    if is_heic(data):
        return picture
    if mirrored:
        picture = picture[:, ::-1]
    return np.ascontiguousarray(np.rot90(picture, -turned))


def _tiff_unturned(data: bytes) -> bytes:
    """A TIFF file's bytes with its orientation set to 1: its decoder obeys it, in part, whatever is asked."""
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(data[:4])
    if order is None:
        return data
    changed = bytearray(data)
    try:
        (directory,) = struct.unpack_from(order + "I", data, 4)
        (count,) = struct.unpack_from(order + "H", data, directory)
        for at in range(directory + 2, directory + 2 + 12 * count, 12):
            tag, kind = struct.unpack_from(order + "HH", data, at)
            if tag == _TIFF_ORIENTATION and kind == 3:
                struct.pack_into(order + "H", changed, at + 8, 1)
    except struct.error:  # the directory lies beyond the end: the decoder will say so
        return data
    return bytes(changed)
