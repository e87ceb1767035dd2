"""The computer-generated layer, and how it lies over a photo."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from autoreg.view import Window

# Pixels that are worked on at a time: bounds the memory, whatever the photo's size.
_BAND_PIXELS = 1 << 18


@dataclass(frozen=True)
class Layer:
    """What is seen through each pixel of a window: photo * `transmission` + `light`, all linear.

    `light` is the solids' own colour (RGB, multiplied by their coverage); `transmission` is the part of
    the photo's light that remains: 0 where a solid hides it, less than 1 in shadow, else 1.
    """

    window: Window
    light: Float[np.ndarray, "h w 3"]
    transmission: Float[np.ndarray, "h w"]


def assert_colour(photo: object) -> None:
    """Raise unless a picture is in colour.

    Raises:
        ValueError: it is not.
    """
    array = np.asarray(photo)
    if array.ndim != 3 or array.shape[2] != 3 or array.dtype != np.uint8:
        raise ValueError(
            f"photo must be in colour, h x w x 3 (BGR) of uint8, got {array.shape} of {array.dtype}; "
            "autoreg.load_photo(path).colour() is that of a file"
        )


def linear_from_srgb(values: UInt8[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Linear light, 0 to 1, of 8-bit sRGB values (IEC 61966-2-1)."""
    s = np.arange(256) / 255.0
    table = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    return table[values]


def srgb_from_linear(light: Float[np.ndarray, "*n"]) -> UInt8[np.ndarray, "*n"]:
    """8-bit sRGB values of linear light, which is cut to 0 to 1."""
    x = np.clip(light, 0.0, 1.0)
    s = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    return np.round(255.0 * s).astype(np.uint8)


def layer_picture(layer: Layer, width: int, height: int) -> UInt8[np.ndarray, "height width 4"]:
    """The layer as a picture of the photo's size: BGRA, straight alpha, sRGB colours.

    A shadow is black with the alpha of the light that it takes. Laid over the photo in linear light,
    the picture gives the composite.
    """
    picture = np.zeros((height, width, 4), np.uint8)
    w = layer.window
    whole = picture[w.y : w.y + w.height, w.x : w.x + w.width]
    for rows in bands(w.width, w.height):
        part = whole[rows]
        coverage = np.clip(1.0 - layer.transmission[rows], 0.0, 1.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            straight = np.where(coverage[..., None] > 0, layer.light[rows] / coverage[..., None], 0.0)
        part[..., :3] = srgb_from_linear(straight)[..., ::-1]
        part[..., 3] = np.round(255.0 * coverage)
        part[part[..., 3] == 0] = 0
    return picture


def lay_over(
    picture: UInt8[np.ndarray, "h w 4"], photo: UInt8[np.ndarray, "h w 3"], window: Window
) -> UInt8[np.ndarray, "h w 3"]:
    """The photo (BGR) under the layer's picture; where alpha is 0 its bytes are the photo's own.

    Only the window is worked on, and the layer is the 8-bit one that is written, so that the two files
    cannot disagree.
    """
    composite, columns = photo.copy(), slice(window.x, window.x + window.width)
    for band in bands(window.width, window.height):
        rows = slice(window.y + band.start, window.y + band.stop)
        over, under = picture[rows, columns], photo[rows, columns]
        alpha = over[..., 3:] / 255.0
        mixed = linear_from_srgb(over[..., :3]) * alpha + linear_from_srgb(under) * (1.0 - alpha)
        composite[rows, columns] = np.where(over[..., 3:] > 0, srgb_from_linear(mixed), under)
    return composite


def bands(width: int, height: int) -> Iterator[slice]:
    """The rows of a picture, so many at a time that what is done with them takes little memory."""
    rows = max(1, _BAND_PIXELS // max(width, 1))
    for top in range(0, height, rows):
        yield slice(top, min(top + rows, height))
