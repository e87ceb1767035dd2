"""What the joints of a photo look like: how wide they are, whether dark or light, and how blurred."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.ground.points import lengths, project_ground
from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.ground.stations import Stations
from autoreg.joints.edges import Offsets
from autoreg.joints.profiles import Profiles

# Blurs in pixels that are tried where nothing is known of them.
BLURS = np.array([0.5, 0.65, 0.8, 1.0, 1.3, 1.7, 2.2, 2.9, 3.8, 5.0, 6.5])
# Looks that change by less have settled.
SETTLED = 0.03
# Joint width, in slab sides, where tiles meet without a joint.
NO_JOINT = 0.001
# Edges up and down that tell how far bright tiles bloom: so many of either, and such a share of a family's.
LEAST_KIND, KIND_SHARE = 8, 0.2
# Grey levels that even the deepest shadow has.
DARK = 8.0
# Stations of either family that tell the looks.
SAMPLE = 90


@dataclass(frozen=True)
class Strip:
    """What a joint looks like: its width on the ground for either family, and the picture's blur.

    `polarity` is -1 where a family's joints are darker than their slabs, +1 where they are lighter, and 0
    where they are neither (tiles of two tones that meet without a joint); once known, it is not asked again.
    Where the camera moved while the shutter was open, no joint of a family looks narrower than `smear_px`. In
    soft shadows and reflections the profiles are `shaded`: light falls off over them.
    """

    width: tuple[float, float]
    blur_px: float
    polarity: tuple[int, int] = (0, 0)
    polarity_known: bool = False
    smear_px: tuple[float, float] = (0.0, 0.0)
    shaded: bool = False

    def like(self, other: Strip) -> bool:
        """Whether widths and blur are the same but for a few percent."""
        mine, theirs = ((*strip.width, strip.blur_px, *strip.smear_px) for strip in (self, other))
        return bool(np.allclose(mine, theirs, rtol=SETTLED))

    def resized(self, scale: float) -> Strip:
        """The looks, but for the blur, in a picture so many times as large."""
        x, y = self.smear_px
        return replace(self, smear_px=(scale * x, scale * y))

    @property
    def smeared(self) -> bool:
        """Whether the joints of either family are."""
        return any(self.smear_px)

    def least_px(self, stations: Stations) -> Float[np.ndarray, " n"]:
        """Width in pixels that no station's joint looks narrower than."""
        return np.where(stations.family == ALONG_X, *self.smear_px)


def width_px_of(strip: Strip, stations: Stations, profiles: Profiles) -> Float[np.ndarray, " n"]:
    """Width of each station's joint in pixels."""
    own = np.where(stations.family == ALONG_X, *strip.width) * profiles.px_per_unit
    return np.maximum(own, strip.least_px(stations))


def projected_width_px(
    camera: Camera, pose: Rigid, stations: Stations, width: tuple[float, float]
) -> Float[np.ndarray, " n"]:
    """What a width on the ground, across the joints of either family, is in the picture."""
    far, near = _edges_px(camera, pose, stations, width)
    return np.nan_to_num(lengths(far - near))


def _edges_px(
    camera: Camera, pose: Rigid, stations: Stations, width: tuple[float, float]
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Where half a width on the ground beyond each station, and half a width before it, are seen."""
    half = 0.5 * np.where(stations.family == ALONG_X, width[0], width[1])
    across = half[:, None] * stations.direction[:, ::-1]
    far, near = (project_ground(camera, pose, stations.ground + way * across) for way in (1.0, -1.0))
    return far, near


def middle_px(
    camera: Camera, pose: Rigid, stations: Stations, normal: Float[np.ndarray, "n 2"], strip: Strip
) -> Float[np.ndarray, " n"]:
    """How far the middle of a joint's two edges lies off its centre line in the picture, along the normal.

    The nearer half of a joint looks wider than the farther one.
    """
    centre = project_ground(camera, pose, stations.ground)
    far, near = _edges_px(camera, pose, stations, strip.width)
    return ((0.5 * (far + near) - centre) * normal).sum(1)


def sample(mask: Bool[np.ndarray, " n"], most: int = SAMPLE) -> Int[np.ndarray, " k"]:
    """Index of at most so many of the stations that a mask selects, spread evenly over them."""
    rows = np.flatnonzero(mask)
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(int)] if len(rows) else rows


def bloom_px(
    offsets: Offsets, stations: Stations, strip: Strip, usable: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """How far each station's offset is pushed towards the darker slab, where tiles meet without a joint.

    A blurred edge whose brighter side is overexposed, or that was blurred before the light was encoded by a
    curve, looks displaced: all bright tiles look larger. The two kinds of edge, up and down, tell it by the
    difference of their offsets, each family by itself; where a family has one kind alone it cannot be told.
    """
    up = np.sign(offsets.step)
    bloom = np.zeros(len(up))
    for family in (ALONG_X, ALONG_Y):
        if strip.polarity[family] != 0:
            continue
        members = usable & (stations.family == family)
        kinds = [offsets.offset_px[members & (up == way)] for way in (1.0, -1.0)]
        if min(len(kind) for kind in kinds) >= max(LEAST_KIND, KIND_SHARE * members.sum()):
            half = 0.5 * float(np.median(kinds[0]) - np.median(kinds[1]))
            bloom += half * up * (stations.family == family)
    return bloom
