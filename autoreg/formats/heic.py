"""Photos in HEIC, as phones take them; pillow-heif decodes them where it is installed."""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import UInt8, UInt16

_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
# Boxes that turn the stored picture, and exchange its left and right.
_TURNING = (b"irot", b"imir")


def is_heic(data: bytes) -> bool:
    """Whether a file's bytes are those of a picture in HEIC, by their first ones."""
    return data[4:8] == b"ftyp" and data[8:12] in _BRANDS


def can_decode_heic() -> bool:
    """Whether what decodes such pictures is installed."""
    return importlib.util.find_spec("pillow_heif") is not None


def is_turned(data: bytes) -> bool:
    """Whether the picture is turned as it is decoded. EXIF's orientation tells how, but does not turn it."""
    return any(box in data for box in _TURNING)


def heic_colour(data: bytes) -> UInt8[np.ndarray, "h w 3"] | UInt16[np.ndarray, "h w 3"] | None:
    """The picture, upright, in BGR of 8 or 16 bits; None where it cannot be decoded."""
    picture = _of_file(data, np.asarray)
    if picture is None:
        return None
    channels = picture.reshape(*picture.shape[:2], -1)
    grey = channels.shape[2] < 3
    return np.ascontiguousarray(channels[:, :, [0, 0, 0] if grey else [0, 1, 2]])


def heic_exif(data: bytes) -> bytes | None:
    """The EXIF block, or None where there is none that can be read."""
    block = _of_file(data, lambda opened: opened.info.get("exif"))
    return block.removeprefix(b"Exif\0\0") if isinstance(block, bytes) else None


def _of_file(data: bytes, read: Callable[[Any], Any]) -> Any:
    """What is read of an opened file; None where that fails."""
    if not can_decode_heic():
        return None
    from pillow_heif import open_heif

    try:
        return read(open_heif(io.BytesIO(data), bgr_mode=True))
    except Exception:
        # libheif fails on broken files in many ways, as they are opened or only as they are decoded.
        return None
