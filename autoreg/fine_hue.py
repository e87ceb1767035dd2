"""The hue by which a colour photo's fine detail differs most, whatever light falls on it.

For photos whose luminance shows no paving. Light and shade, in which faint joints drown, scale all channels
alike: the channels' ratios show what joints are made of as clearly in a tree's shadow as beside it. Which
mixture of the ratios' logarithms is taken, their principal component tells, after the mean of each pixel's
surroundings is taken away.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from autoreg.image import is_colourless

# Grey levels that are added to the channels, so that the noise of dark ones stays small.
DARK = 8.0
# Standard deviation in pixels of the surroundings whose mean is taken away.
SURROUNDINGS_PX = 6.0
# JPEG stores colours at half the resolution: what is finer, in pixels, is noise.
FINEST_PX = 1.5
# The middle share of the pixels spans so many grey levels.
SHARE, SPAN = 0.99, 220.0
# Every so many rows and columns are looked at.
EVERY = 2


@dataclass(frozen=True)
class Hue:
    """Grey levels of a BGR picture: the sum of its channels' logarithms by `weights`, and `offset`."""

    weights: Float[np.ndarray, "3"]
    offset: float

    def of(self, colour: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w"]:
        """The picture in this hue."""
        tables = np.log(np.arange(256) + DARK)[:, None] * self.weights + self.offset / 3
        grey = np.empty(colour.shape[:2], np.uint8)
        for row, line in enumerate(colour):
            blue, green, red = (tables[line[:, channel], channel] for channel in range(3))
            grey[row] = np.clip(np.round(blue + green + red), 0, 255)
        return np.asarray(cv2.GaussianBlur(grey, (0, 0), FINEST_PX), np.uint8)


def finest_hue(colour: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> Hue | None:
    """The hue by which fine detail differs most; None of a photo that has one colour, or none.

    Args:
        colour: the photo (BGR).
        size: width and height at which it is looked at.
    """
    small = cv2.resize(colour, size, interpolation=cv2.INTER_AREA)
    if is_colourless(small):
        return None
    ratios = np.log(small.astype(np.float32) + np.float32(DARK))
    ratios -= ratios.mean(2, keepdims=True)
    detail = ratios - cv2.GaussianBlur(ratios, (0, 0), SURROUNDINGS_PX)
    some = detail[::EVERY, ::EVERY].reshape(-1, 3).astype(float)
    weights = np.linalg.eigh(some.T @ some)[1][:, -1]
    left_out = 0.5 * (1.0 - SHARE)
    low, high = np.quantile(ratios[::EVERY, ::EVERY].reshape(-1, 3) @ weights, [left_out, 1.0 - left_out])
    if high <= low:
        return None
    # The channels' mean is no part of a ratio: weights that sum up to nothing leave it out by themselves.
    weights = SPAN / (high - low) * (weights - weights.mean())
    return Hue(weights, 127.5 - 0.5 * SPAN * float(low + high) / float(high - low))
