"""The command line's values as numbers."""

from __future__ import annotations

import math
import re

from autoreg.errors import InputError

# What --dof without a number stands for.
EXIF = "exif"
# Sides of slabs and heights of cameras that somebody may mean, in metres: beyond them is another unit.
SIDES_M, HEIGHTS_M = (0.001, 100.0), (0.01, 10_000.0)


def parse_slab(text: str) -> tuple[float, float]:
    """The two sides in metres of "0.6x0.4", or of one number for a square.

    Raises:
        InputError: it is neither, or no slab has such sides.
    """
    parts = re.split(r"[xX×*]", text.strip())
    sides = [_number(part) for part in parts]
    good = [side for side in sides if side is not None and side > 0]
    if len(good) != len(sides) or len(sides) not in (1, 2):
        raise InputError(
            "--slab wants metres, such as 0.6x0.4 for 60 cm by 40 cm, or 0.5 for a square slab of 50 cm; "
            f"got {text!r}"
        )
    for side in good:
        if not SIDES_M[0] <= side <= SIDES_M[1]:
            raise InputError(
                f"--slab wants metres, {SIDES_M[0]:g} to {SIDES_M[1]:g} for each side, such as 0.6x0.4; "
                f"got {side:g} metres"
            )
    return good[0], good[-1]


def parse_crop(text: str) -> tuple[int, int, int, int]:
    """The x, y, w, h in pixels of "100,50,1600,1200".

    Raises:
        InputError: it is not four whole numbers, or the size is not positive.
    """
    parts = text.split(",")
    if len(parts) != 4 or not all(re.fullmatch(r"\s*-?\d{1,9}\s*", part, re.ASCII) for part in parts):
        raise InputError(f"--crop wants four whole numbers x,y,w,h, such as 100,50,1600,1200; got {text!r}")
    x, y, width, height = (int(part) for part in parts)
    if min(x, y) < 0 or min(width, height) < 1:
        raise InputError(f"--crop x,y,w,h wants x, y of at least 0 and w, h of at least 1; got {text!r}")
    return x, y, width, height


def parse_sun(text: str) -> tuple[float, float]:
    """Azimuth and elevation in degrees of "135,40".

    Raises:
        InputError: it is not two numbers, or the sun is not well above the horizon.
    """
    parts = [_number(part) for part in text.split(",")]
    if len(parts) != 2 or parts[0] is None or parts[1] is None or not 5 <= parts[1] <= 90:
        raise InputError(
            "--sun wants azimuth,elevation in degrees, the azimuth from the ground's X towards its Y and an "
            f"elevation of 5 to 90, such as 135,40; got {text!r}"
        )
    return parts[0], parts[1]


def parse_lens(text: str) -> tuple[float | None, float | None]:
    """F-number and focal length in mm of "2.8", "f/2.8" or "2.8,24"; None for what EXIF has to say.

    Raises:
        InputError: it is neither.
    """
    if text == EXIF:
        return None, None
    parts = [_number(part) for part in re.sub(r"^\s*[fF]/", "", text).split(",")]
    good = [part for part in parts if part is not None and part > 0]
    if len(good) != len(parts) or len(parts) not in (1, 2):
        raise InputError(
            "--dof wants an f-number, such as 2.8, or with it the focal length in mm, such as 2.8,24; "
            f"got {text!r}"
        )
    return good[0], good[1] if len(good) == 2 else None


def parse_timeout(value: float) -> float:
    """Seconds that POV-Ray may take for each pass.

    Raises:
        InputError: it is not a positive number.
    """
    if not (math.isfinite(value) and value > 0):
        raise InputError(f"--timeout wants seconds, such as 600; got {value}")
    return value


def parse_height(text: str) -> float:
    """The camera's height in metres of "1.55".

    Raises:
        InputError: it is no number, or no camera stands so high.
    """
    value = _number(text)
    if value is None:
        raise InputError(
            f"--camera-height wants metres above the ground, such as 1.55 for 155 cm; got {text!r}"
        )
    if not HEIGHTS_M[0] <= value <= HEIGHTS_M[1]:
        raise InputError(
            f"--camera-height wants metres above the ground, {HEIGHTS_M[0]:g} to {HEIGHTS_M[1]:g}, such as "
            f"1.55; got {value:g} metres"
        )
    return value


def _number(text: str) -> float | None:
    """The finite number that a text is, or None."""
    try:
        # Python would take 0_5 for 5.
        value = float(text.replace("_", "?"))
    except ValueError:
        return None
    return value if math.isfinite(value) else None
