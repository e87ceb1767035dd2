"""Which of a camera's claimed focal lengths, in pixels, degrees or millimetres, a photo's EXIF supports."""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass
from typing import Literal

from autoreg.calibration.claims import Claims
from autoreg.calibration.focal import angle_deg, focal_from_angle
from autoreg.formats.exif import Exif

# EXIF's focal lengths are rounded, and breathe with the distance of focus.
FOCAL_AGREES, FOCAL_CONTRADICTS = 0.05, 0.12

Word = Literal["supported", "doubtful", "contradicted"]


@dataclass(frozen=True)
class Support:
    """One claimed figure against the photo's EXIF.

    Attributes:
        claimed: the figure with its unit.
        exif: what EXIF makes it.
        apart: the claimed focal length over EXIF's, less 1.
    """

    claimed: str
    exif: str
    apart: float

    @property
    def word(self) -> Word:
        """Whether EXIF bears the figure out."""
        if abs(self.apart) <= FOCAL_AGREES:
            return "supported"
        return "doubtful" if abs(self.apart) <= FOCAL_CONTRADICTS else "contradicted"

    @property
    def sentence(self) -> str:
        """All of it, for people."""
        return f"{self.claimed}: {self.word} (EXIF: {self.exif}; {100 * self.apart:+.1f} % in focal length)"


def exif_support(
    claims: Claims, width: float, height: float, exif: Exif, exif_focal_px: float | None
) -> Generator[Support]:
    """Each figure that is claimed, against what a photo's EXIF makes of it.

    Args:
        claims: the claims.
        width: of the photo, in pixels.
        height: likewise.
        exif: the photo's.
        exif_focal_px: its focal length in pixels of the photo, or None.
    """
    if exif_focal_px is not None and claims.width and claims.height:
        # The photo may be the calibrated frame made smaller; claims are in pixels of that frame.
        focal = exif_focal_px * math.hypot(claims.width, claims.height) / math.hypot(width, height)
        if claims.focal is not None:
            yield Support(f"{claims.focal:g} px", f"{focal:.0f} px", claims.focal / focal - 1)
        if claims.angle_of_view_deg is not None:
            apart = focal_from_angle(claims.angle_of_view_deg, claims.width) / focal - 1
            exifs = f"{angle_deg(focal, claims.width):.2f}°"
            yield Support(f"{claims.angle_of_view_deg:g}° across", exifs, apart)
    if claims.exif_focal_mm is not None and exif.focal_mm is not None:
        apart = claims.exif_focal_mm / exif.focal_mm - 1
        yield Support(f"{claims.exif_focal_mm:g} mm", f"{exif.focal_mm:g} mm", apart)
