"""What can be put into a photo: shapes, materials, places, and the light, as a user describes them."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np

from autoreg.rendering.layer import linear_from_srgb
from autoreg.rendering.surface import Surface

RGB = tuple[float, float, float]

# Smaller shapes are lost to rounding.
_SMALLEST_M = 1e-6
# Under a lower sun shadows reach beyond any picture.
LOWEST_SUN_DEG = 5.0


class _Sized:
    """A shape whose lengths in metres have to be positive."""

    def __post_init__(self) -> None:
        for item in fields(self):  # pyright: ignore[reportArgumentType]  # every subclass is a dataclass
            value = getattr(self, item.name)
            lengths = value if isinstance(value, tuple) else (value,)
            name = item.name.removesuffix("_m")
            if item.name.endswith("_m") and not all(math.isfinite(v) and v > 0 for v in lengths):
                raise ValueError(f"{name} must be positive, got {value}")
            if item.name.endswith("_m") and min(lengths) < _SMALLEST_M:
                raise ValueError(f"{name} must be at least {_SMALLEST_M:g} to be drawn, got {value}")


@dataclass(frozen=True)
class Box(_Sized):
    """A box; its sides lie along the joints until it is turned."""

    size_m: tuple[float, float, float]


@dataclass(frozen=True)
class Sphere(_Sized):
    """A ball."""

    radius_m: float


@dataclass(frozen=True)
class Cylinder(_Sized):
    """An upright cylinder."""

    radius_m: float
    height_m: float


@dataclass(frozen=True)
class Cone(_Sized):
    """An upright cone, or with a second radius at its top a frustum."""

    radius_m: float
    height_m: float
    top_radius: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (math.isfinite(self.top_radius) and self.top_radius >= 0):
            raise ValueError(f"top_radius must not be negative, got {self.top_radius}")


@dataclass(frozen=True)
class Torus(_Sized):
    """A ring that lies flat: `radius_m` to the middle of a tube of radius `tube_m`."""

    radius_m: float
    tube_m: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.tube_m > self.radius_m:
            raise ValueError(f"tube must not exceed radius {self.radius_m}, got {self.tube_m}")


@dataclass(frozen=True)
class Text(_Sized):
    """Upright letters that face -Y until they are turned; `height_m` is that of a capital letter."""

    text: str
    height_m: float
    depth_m: float
    font: Path | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.text.strip():
            raise ValueError("text must hold at least one letter that can be seen")


@dataclass(frozen=True)
class Mesh:
    """Triangles that stand on Z = 0 around the origin; `surface.stand_up` brings others there."""

    surface: Surface


Shape = Box | Sphere | Cylinder | Cone | Torus | Text | Mesh

# Finishes by the names of POV-Ray's own finish.inc and metals.inc.
FINISHES = (
    *("Dull", "Shiny", "Phong_Dull", "Phong_Shiny", "Glossy", "Phong_Glossy", "Luminous", "Mirror"),
    *(f"F_Metal{letter}" for letter in "ABCDE"),
)


@dataclass(frozen=True)
class Material:
    """How a surface looks.

    Attributes:
        colour: linear RGB, 0 to 1.
        image: a picture laid on the surface instead of the colour.
        finish: one of `FINISHES`; None is matt.
    """

    colour: RGB = (0.6, 0.6, 0.6)
    image: Path | None = None
    finish: str | None = None

    def __post_init__(self) -> None:
        if not all(0 <= part <= 1 for part in self.colour):
            raise ValueError(f"colour must lie within 0 to 1, got {self.colour}")
        if self.finish is not None and self.finish not in FINISHES:
            raise ValueError(f"finish must be one of {', '.join(FINISHES)}; got {self.finish!r}")


@dataclass(frozen=True)
class OnSlab:
    """On slab (i, j), `offset_m` from its centre along X and Y."""

    i: int
    j: int
    offset_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class OnGround:
    """At a ground point."""

    x_m: float
    y_m: float


@dataclass(frozen=True)
class UnderPixel:
    """At the ground point that a pixel of the photo shows."""

    u_px: float
    v_px: float


Place = OnSlab | OnGround | UnderPixel


@dataclass(frozen=True)
class Object:
    """A shape that stands somewhere.

    Attributes:
        name: what messages and scene.pov call it.
        shape: its form; it stands on its own Z = 0, around its own origin.
        place: where it stands.
        material: how it looks.
        turn_deg: turn about its vertical axis, from X towards Y.
        lift_m: how far above the ground it hangs, or on another object stands.
    """

    name: str
    shape: Shape
    place: Place
    material: Material = Material()
    turn_deg: float = 0.0
    lift_m: float = 0.0


@dataclass(frozen=True)
class CastShadow:
    """Pixels of the photo: foot and top of something upright on the ground, and the tip of its shadow."""

    foot_px: tuple[float, float]
    top_px: tuple[float, float]
    tip_px: tuple[float, float]


@dataclass(frozen=True)
class Light:
    """The light of a scene.

    Attributes:
        sun_deg: azimuth from X towards Y and elevation of the sun; None leaves it to `shadow`, or without
            one to a sun behind the camera's left shoulder.
        sky: part of the light on level open ground that comes from the whole sky, 0 to 1.
        exposure: what a white sheet on open ground would show as, linear; None judges it by the photo.
        shadow: a shadow in the photo that shows where the sun stood.
    """

    sun_deg: tuple[float, float] | None = None
    sky: float = 0.28
    exposure: float | None = None
    shadow: CastShadow | None = None

    def __post_init__(self) -> None:
        if self.sun_deg is not None and self.shadow is not None:
            raise ValueError("shadow and sun both say where the sun stands; give one of them")
        if self.sun_deg is not None:
            azimuth, elevation = self.sun_deg
            if not (math.isfinite(azimuth) and LOWEST_SUN_DEG <= elevation <= 90):
                raise ValueError(
                    "sun must be an azimuth and an elevation of 5 to 90 degrees, "
                    f"got {azimuth:g}, {elevation:g}"
                )
        if not 0.02 <= self.sky <= 1:
            raise ValueError(f"sky must lie within 0.02 to 1, got {self.sky:g}")
        if self.exposure is not None and not 0.05 <= self.exposure <= 5:
            raise ValueError(f"exposure must lie within 0.05 to 5, got {self.exposure:g}")


@dataclass(frozen=True)
class Scene:
    """What a user wants to see on the paving.

    Attributes:
        objects: what stands on it.
        light: what lights them.
        joints: whether lines are drawn on the joints.
        joint_colour: colour of these, linear RGB.
        focus_m: the ground point that a lens with an opening is focused on; None is the first object's.
    """

    objects: tuple[Object, ...] = ()
    light: Light = field(default_factory=Light)
    joints: bool = False
    joint_colour: RGB = (1.0, 0.7, 0.0)
    focus_m: tuple[float, float] | None = None


def _parts(text: str) -> tuple[int, ...]:
    """The sRGB numbers of a colour's text; ValueError if it means none."""
    if re.fullmatch("#[0-9a-fA-F]{6}", text):
        return tuple(bytes.fromhex(text[1:]))
    # Pillow knows the other ways to write it, and the names; few scenes need them.
    from PIL import ImageColor

    return ImageColor.getrgb(text)[:3]


def colour(value: str | tuple[float, float, float]) -> RGB:
    """Linear RGB of a colour as picture editors have it: "#c03020", "white", or sRGB numbers 0 to 1.

    Raises:
        ValueError: it is none of these.
    """
    if isinstance(value, str):
        try:
            parts = _parts(value)
            if not all(0 <= part <= 255 for part in parts):
                raise ValueError("beyond what colours can be")
        except ValueError:
            raise ValueError(f'must be a name, "#rrggbb" or three numbers 0 to 1, got {value!r}') from None
        light = linear_from_srgb(np.array(parts, np.uint8))
    else:
        if len(value) != 3 or not all(0 <= part <= 1 for part in value):
            raise ValueError(f"must be three numbers within 0 to 1, got {list(value)}")
        s = np.array(value, float)
        light = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    return float(light[0]), float(light[1]), float(light[2])
