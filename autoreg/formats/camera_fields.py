"""Values of camera files, checked key by key: every error names the key, what it holds and what to do."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from autoreg.errors import InputError


def find(fields: Mapping[str, object], names: tuple[str, ...]) -> str | None:
    """The key of the file that stands for one of the names, whatever its case."""
    return next((key for key in fields if key.lower() in names), None)


def _required(fields: Mapping[str, object], names: tuple[str, ...]) -> tuple[str, object]:
    key = find(fields, names)
    if key is None:
        present = f"; found only {', '.join(list(fields)[:8])}" if fields else ""
        raise InputError(f"key {names[0]!r} is missing; add it{present}")
    return key, fields[key]


def scalar(fields: Mapping[str, object], names: tuple[str, ...]) -> tuple[str, float]:
    """A key and its finite number."""
    key, value = _required(fields, names)
    return key, number(f"key {key!r}", value)


def array(fields: Mapping[str, object], names: tuple[str, ...]) -> tuple[str, np.ndarray]:
    """A key and its numbers: a shape and data (OpenCV's and ROS's matrices), or a plain list."""
    key, value = _required(fields, names)
    if not isinstance(value, Mapping):
        return key, np.array(numbers(key, value))
    entries: Mapping[str, object] = value
    shape = _shape(key, entries)
    data = np.array(numbers(f"{key}.data", _part(key, entries, "data")))
    if data.size != math.prod(shape):
        said = " x ".join(map(str, shape))
        raise InputError(f"key {key!r} says {said} but its data has {data.size} numbers; correct it")
    return key, data.reshape(shape)


def _shape(key: str, entries: Mapping[str, object]) -> tuple[int, ...]:
    """The shape that a matrix says of itself: rows and cols, or sizes where it has not two dimensions."""
    if "sizes" in entries:
        sizes = numbers(f"{key}.sizes", entries["sizes"])
        return tuple(whole(f"{key}.sizes", size, 0) for size in sizes)
    rows, cols = (
        whole(f"{key}.{side}", number(f"{key}.{side}", _part(key, entries, side)), 0)
        for side in ("rows", "cols")
    )
    return rows, cols


def _part(key: str, entries: Mapping[str, object], part: str) -> object:
    if part not in entries:
        raise InputError(f"key {key!r} has no {part!r}; add it")
    return entries[part]


def distortion(key: str, coefficients: np.ndarray) -> tuple[float, ...]:
    """Distortion coefficients as far as Camera holds them."""
    values = [float(value) for value in coefficients]
    if len(values) in (12, 14):
        if any(values[8:]):
            raise InputError(
                f"key {key!r} uses the thin prism or tilted model ({len(values)} coefficients), which is not "
                "supported; calibrate without CALIB_THIN_PRISM_MODEL and CALIB_TILTED_MODEL"
            )
        values = values[:8]
    if len(values) not in (0, 4, 5, 8):
        raise InputError(f"key {key!r} must hold 4, 5 or 8 coefficients (OpenCV's order), got {len(values)}")
    return tuple(values)


def numbers(key: str, value: object) -> list[float]:
    """A list of numbers, or of lists of numbers, flattened."""
    if not isinstance(value, list):
        raise InputError(f"key {key!r} must be a list of numbers, got {shown(value)}; correct it")
    flat: list[float] = []
    for i, entry in enumerate(value):
        flat += numbers(f"{key}[{i}]", entry) if isinstance(entry, list) else [number(f"{key}[{i}]", entry)]
    return flat


def number(key: str, value: object) -> float:
    """A finite number; a string is read too, because YAML 1.1 takes 1e-05 for one and XML has no other."""
    try:
        result = math.nan if isinstance(value, bool) else float(value)  # pyright: ignore[reportArgumentType]
    except (TypeError, ValueError, OverflowError):
        result = math.nan
    if not math.isfinite(result):
        raise InputError(f"{key} must be a finite number, got {shown(value)}; correct it")
    return result


def whole(key: str, value: float, least: int = 1) -> int:
    """A number as a whole one of at least `least`."""
    if not math.isfinite(value) or value != int(value) or value < least:
        raise InputError(f"{key} must be a whole number of at least {least}, got {value:g}; correct it")
    return int(value)


def shown(value: object, longest: int = 40) -> str:
    """A value as a message quotes it, cut to a readable length."""
    text = repr(value)
    return text if len(text) <= longest else text[: longest - 3] + "..."
