"""Where the sun stands: as it is given, by a shadow in the photo, or where it flatters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from autoreg.errors import InputError
from autoreg.rendering.objects import LOWEST_SUN_DEG, CastShadow, Light
from autoreg.view import View

# How well a person points at a pixel.
_POINTING_PX = 1.0
# What leans more than this is not upright, and an estimate less certain than this is none.
_MOST_LEAN_DEG, _MOST_SIGMA_DEG = 3.0, 5.0


@dataclass(frozen=True)
class Sun:
    """A direction to the sun: azimuth from X towards Y, and elevation.

    Attributes:
        azimuth_deg: from the ground's X towards its Y.
        elevation_deg: above the ground.
        source: "given", "shadow" (an estimate, with `sigma_deg`), or "default" (nothing is known).
        sigma_deg: standard deviations of azimuth and elevation if each pixel is good to a pixel. The
            pose's own uncertainty is not in them.
    """

    azimuth_deg: float
    elevation_deg: float
    source: Literal["given", "shadow", "default"]
    sigma_deg: tuple[float, float] | None = None

    @property
    def direction(self) -> Float[np.ndarray, "3"]:
        """The unit vector towards the sun, in the ground frame."""
        azimuth, elevation = np.deg2rad([self.azimuth_deg, self.elevation_deg])
        level = np.cos(elevation)
        return np.array([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])


def sun_for(light: Light, view: View) -> Sun:
    """The sun of a light.

    Raises:
        InputError: the shadow that is to show where it stands does not.
    """
    if light.shadow is not None:
        return sun_by_shadow(light.shadow, view)
    if light.sun_deg is not None:
        return Sun(*light.sun_deg, "given")
    # The camera looks along its z axis; the sun stands 125 degrees to the left of that, 42 degrees high.
    # A camera that looks straight down has the top of its picture ahead.
    ahead = view.cam_from_ground.R[2] - view.cam_from_ground.R[1]
    return Sun(float(np.rad2deg(np.arctan2(ahead[1], ahead[0]))) + 125.0, 42.0, "default")


def sun_by_shadow(shadow: CastShadow, view: View) -> Sun:
    """The sun by the shadow of something upright that stands on the ground in the photo.

    The sun lies from the shadow's tip towards the top that casts it. The top's height is where its ray
    passes nearest to the vertical through the foot. No scale is needed.

    Raises:
        InputError: a pixel shows no ground, the thing is not upright, or the estimate would be too rough.
    """
    px = np.array([shadow.foot_px, shadow.top_px, shadow.tip_px], float)
    azimuth, elevation, lean = _measured(px, view)
    if not np.isfinite([azimuth, elevation, lean]).all():
        raise InputError(
            "shadow in [light]: its foot and its tip must lie on ground that the photo shows, below the "
            "horizon, and its top above its foot"
        )
    if lean > _MOST_LEAN_DEG:
        raise InputError(
            f"shadow in [light]: from foot to top it leans by {lean:.1f}°, more than {_MOST_LEAN_DEG:g}°; "
            "only something upright shows where the sun stands"
        )
    step = np.eye(6).reshape(6, 3, 2) * _POINTING_PX
    changes = np.array([np.subtract(_measured(px + d, view), _measured(px - d, view))[:2] / 2 for d in step])
    changes[:, 0] = (changes[:, 0] + 90.0) % 180.0 - 90.0
    spread = np.sqrt((changes**2).sum(0))
    if not spread.max() <= _MOST_SIGMA_DEG:
        raise InputError(
            f"shadow in [light]: a pixel more or less turns the sun by {spread.max():.0f}°, more than "
            f"{_MOST_SIGMA_DEG:g}°; take something taller or nearer, or give sun"
        )
    if not elevation >= LOWEST_SUN_DEG:
        raise InputError(
            f"shadow in [light]: the sun would stand {elevation:.1f}° high, less than {LOWEST_SUN_DEG:g}°, "
            "so low that shadows leave the picture; check that tip is the tip of the shadow of top"
        )
    return Sun(azimuth, elevation, "shadow", (float(spread[0]), float(spread[1])))


def _measured(px: Float[np.ndarray, "3 2"], view: View) -> tuple[float, float, float]:
    """Azimuth, elevation and lean in degrees, by the pixels of foot, top and tip; NaN where there is none."""
    foot, tip = (view.ground_under(px[[k]])[0] for k in (0, 2))
    ray = view.directions(px[[1]])[0]
    level = ray[:2] @ ray[:2]
    if not np.isfinite([*foot, *tip, level]).all() or not level > 0:
        return np.nan, np.nan, np.nan
    # Where the top's ray passes nearest to the vertical: in plan, the foot's nearest point on the ray.
    away = foot - view.eye[:2]
    reach = float(away @ ray[:2] / level)
    height = float(view.eye[2] + reach * ray[2])
    beside = float(np.linalg.norm(reach * ray[:2] - away))
    along = foot - tip
    if not (reach > 0 and height > 0):
        return np.nan, np.nan, np.nan
    azimuth = float(np.rad2deg(np.arctan2(along[1], along[0])))
    elevation = float(np.rad2deg(np.arctan2(height, np.linalg.norm(along))))
    return azimuth, elevation, float(np.rad2deg(np.arctan2(beside, height)))
