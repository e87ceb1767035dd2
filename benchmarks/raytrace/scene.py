"""What a ray-traced scene consists of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from autoreg.camera import Camera
from autoreg.geometry import Rigid

Layout = Literal[
    "lattice",
    "rows",
    "planks",
    "herringbone",
    "fan",
    "rings",
    "waves",
    "crazy",
    "gravel",
    "asphalt",
    "grass",
    "wall",
]


@dataclass(frozen=True)
class Paving:
    """A paved field: real boxes over a bed, or a pattern without slabs.

    Attributes:
        layout: how the slabs lie.
        slab_m: spacing of the joint centre lines along X and Y.
        shift: part of a slab by which each row of a running bond moves along +X.
        joint_m: width of the joints.
        depth_m: how deep the bed lies under the slabs' tops.
        chamfer_m: how far the slabs' rims are bevelled, at 45 degrees.
        place_jitter_m: standard deviation of each slab's place along X and Y.
        height_jitter_m: standard deviation of each slab's height.
        turn_jitter_deg: standard deviation of each slab's turn about its middle.
        checker: the slabs alternate between two tones.
        albedo: mean colour of the slabs, linear RGB.
        tone_spread: relative standard deviation of the slabs' tone.
        veins: contrast of the stone's texture, relative.
        pattern: POV-Ray's pattern for the texture.
        grain_m: size of the texture's features.
        bed_albedo: colour of the joints.
        moss: part of the joints that is overgrown.
        missing: part of the joints that is filled flush in the slabs' own colour.
        wet: part of the ground under a film of water.
        half_size_m: half the side of the paved field around the camera's view.
    """

    layout: Layout = "lattice"
    slab_m: tuple[float, float] = (0.5, 0.5)
    shift: float = 0.0
    joint_m: float = 0.009
    depth_m: float = 0.006
    chamfer_m: float = 0.0
    place_jitter_m: float = 0.0012
    height_jitter_m: float = 0.0004
    turn_jitter_deg: float = 0.05
    checker: bool = False
    albedo: tuple[float, float, float] = (0.5, 0.48, 0.45)
    tone_spread: float = 0.06
    veins: float = 0.12
    pattern: str = "granite"
    grain_m: float = 0.15
    bed_albedo: tuple[float, float, float] = (0.1, 0.095, 0.085)
    moss: float = 0.0
    missing: float = 0.0
    wet: float = 0.0
    half_size_m: float = 10.0


@dataclass(frozen=True)
class Scene:
    """One picture to be taken.

    `told` is the camera that the camera file will name; it differs from `camera` only in the scenes with a
    wrong calibration. Border: paving or lawn beyond a straight edge at the side of the main field.
    """

    name: str
    kind: str
    seed: int
    camera: Camera
    told: Camera
    cam_from_ground: Rigid
    paving: Paving
    tell_camera: bool = True
    tell_slab: bool = True
    wrong_camera: bool = False
    sun_elevation_deg: float = 45.0
    sun_azimuth_deg: float = 30.0
    clutter: int = 0
    leaves: int = 0
    shadows: tuple[str, ...] = ()
    house: bool = False
    border: Literal["none", "slabs", "lawn"] = "none"
    surround: tuple[float, float, float] = (0.12, 0.11, 0.1)
    noise_grey: float = 1.5
    blur_px: float = 0.3
    jpeg_quality: int = 93
    area_sampled: bool = False

    @property
    def has_lattice(self) -> bool:
        """Whether the paving carries the answer."""
        return self.paving.layout in ("lattice", "rows")
