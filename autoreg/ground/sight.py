"""What is seen of a photo before anything is known of its ground: its segments, and looks at its gradient."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, UInt8

from autoreg.ground.rectify import Gradient, picture_gradient, unshaded
from autoreg.image import pyramid
from autoreg.segments import Detection, SegmentOptions, Segments, begin_detection

# Joints are found at this size, and measured at the photo's own.
DETECTION_PIXELS = 600_000
# JPEG keeps colours in blocks of 8 x 8, mostly at half the resolution. In a tone their edges show where
# little else does, and would be joints across boards.
COLOUR_BLOCK_PX = 16.0
# Size of the first look, and its and the second look's numbers of rows on the ground.
COARSE_PIXELS, COARSE_LINES, FINE_LINES = 110_000, 320, 800


@dataclass(frozen=True)
class Look:
    """A picture's gradient, and the number of rows and columns that sample the ground from it.

    `strong` is whether lines are told from others by the strength of their gradients, else by how much these
    agree.
    """

    gradient: Gradient
    lines: int
    strong: bool = False


@dataclass(frozen=True)
class Looks:
    """A photo at detection scale: its grey levels, and a coarse and a fine look at it.

    Directions of rough joints, and lenses that bend them, leave lines some pixels askew, which blurs a fine
    profile of the ground more than a coarse one.
    """

    picture: Float32[np.ndarray, "h w"]
    coarse: Look
    fine: Look

    @property
    def size(self) -> tuple[int, int]:
        """Width and height at detection scale."""
        return self.fine.gradient.size

    @cached_property
    def unshaded(self) -> Look:
        """The fine look without shading, in which the faint joints of a glossy floor drown."""
        return Look(picture_gradient(unshaded(self.picture)), self.fine.lines, self.fine.strong)

    @cached_property
    def by_strength(self) -> Looks:
        """The same looks, for strong lines: joints among a grain that runs along them."""
        coarse, fine = (replace(look, strong=True) for look in (self.coarse, self.fine))
        return Looks(self.picture, coarse, fine)


@dataclass(frozen=True)
class Sight:
    """A photo's grey levels, its looks at detection scale, and its segments in its own pixels.

    `toned` is whether the grey levels are not luminance but a tone in which the joints differ from all slabs.
    """

    gray: UInt8[np.ndarray, "h w"]
    looks: Looks
    detection: Detection
    toned: bool = False

    @property
    def size(self) -> tuple[int, int]:
        """The photo's width and height."""
        return self.gray.shape[1], self.gray.shape[0]

    @property
    def segments(self) -> Segments:
        """The segments of all levels, as soon as they are there."""
        return self.detection.all


class Box(NamedTuple):
    """A part of a photo, in whole pixels, in the order in which `Camera.cropped` takes it."""

    left: int
    top: int
    width: int
    height: int

    def of(self, gray: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "hb wb"]:
        """The photo's grey levels in it."""
        part = gray[self.top : self.top + self.height, self.left : self.left + self.width]
        return np.ascontiguousarray(part)


def see(gray: UInt8[np.ndarray, "h w"], *, toned: bool = False) -> Sight:
    """What is to be seen in a photo, or in a tone of it."""
    detection = begin_detection(gray, options=SegmentOptions(blocks_px=COLOUR_BLOCK_PX if toned else 0.0))
    return Sight(gray, looks_at(pyramid(gray, DETECTION_PIXELS)[0]), detection, toned)


def looks_at(small: UInt8[np.ndarray, "h w"]) -> Looks:
    """Both looks at a picture at detection scale."""
    coarse = picture_gradient(pyramid(small, COARSE_PIXELS)[0])
    return Looks(
        small.astype(np.float32), Look(coarse, COARSE_LINES), Look(picture_gradient(small), FINE_LINES)
    )
