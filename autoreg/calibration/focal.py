"""A focal length in pixels, millimetres, 35 mm equivalent and angle of view: one number, four units."""

from __future__ import annotations

import math
from dataclasses import dataclass

_DIAGONAL_35MM = math.hypot(36.0, 24.0)


@dataclass(frozen=True)
class FocalLength:
    """A focal length for a picture of some size.

    Attributes:
        px: in pixels.
        width: of the picture.
        height: of the picture.
        mm: in millimetres, if EXIF or the file says so; it sets the size of the sensor.
    """

    px: float
    width: float
    height: float
    mm: float | None = None

    @property
    def equivalent_mm(self) -> float:
        """35 mm equivalent, by the diagonal (CIPA DCG-001): f * 43.27 mm / diagonal."""
        return self.px * _DIAGONAL_35MM / math.hypot(self.width, self.height)

    @property
    def angles_deg(self) -> tuple[float, float, float]:
        """Angles of view across, down and along the diagonal, without distortion."""
        sides = (self.width, self.height, math.hypot(self.width, self.height))
        across, down, diagonal = (angle_deg(self.px, side) for side in sides)
        return across, down, diagonal

    @property
    def pixel_um(self) -> float | None:
        """Size of a pixel that makes the pixels and the millimetres one length, in micrometres."""
        return None if self.mm is None else 1000 * self.mm / self.px

    @property
    def sensor_mm(self) -> tuple[float, float] | None:
        """Size of the sensor that does so."""
        if self.mm is None:
            return None
        return self.width * self.mm / self.px, self.height * self.mm / self.px


def angle_deg(focal_px: float, side_px: float) -> float:
    """Angle of view over a side: 2 atan(side / 2f)."""
    return math.degrees(2 * math.atan(side_px / (2 * focal_px)))


def focal_from_angle(angle: float, side_px: float) -> float:
    """Focal length in pixels of an angle of view in degrees over a side."""
    return side_px / (2 * math.tan(math.radians(angle) / 2))
