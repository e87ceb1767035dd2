"""Photos in HEIC, as phones take them; pillow-heif decodes them where it is installed."""

from __future__ import annotations

import importlib.util
import io
from typing import Any

import numpy as np
from jaxtyping import UInt8

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


def heic_colour(data: bytes) -> UInt8[np.ndarray, "h w 3"] | None:
    """The picture, upright, in BGR; None where it cannot be decoded."""
    opened = _opened(data)
    try:
        picture = None if opened is None else np.asarray(opened)
    except Exception:
        # The file is looked at as it is opened, and decoded here: libheif fails on broken ones in many ways.
        return None
    if picture is None:
        return None
    if picture.dtype == np.uint16:
        # Colours of more bits come reduced to eight, grey does not.
        picture = np.round(picture / 257.0).astype(np.uint8)
    channels = picture.reshape(*picture.shape[:2], -1)
    grey = channels.shape[2] < 3
    return np.ascontiguousarray(channels[:, :, [0, 0, 0] if grey else [0, 1, 2]])


def heic_exif(data: bytes) -> bytes | None:
    """The EXIF block, or None where there is none that can be read."""
    opened = _opened(data)
    block = None if opened is None else opened.info.get("exif")
    return block.removeprefix(b"Exif\0\0") if isinstance(block, bytes) else None


def _opened(data: bytes) -> Any:
    if not can_decode_heic():
        return None
    from pillow_heif import open_heif

    try:
        return open_heif(io.BytesIO(data), bgr_mode=True)
    except Exception:
        return None
