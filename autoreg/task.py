"""A photo to be aligned, and all that is known of it beforehand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32, UInt8

from autoreg.alignment import CameraSource
from autoreg.camera import Camera
from autoreg.ground.sight import Sight
from autoreg.search.hypotheses import RADIAL_SIGMA
from autoreg.solve.freedom import Free

# What is known of an uncalibrated camera: logarithm of its focal length with and without EXIF (the latter
# about one picture width), the principal point as a share of the long side, and the logarithm of what fy is
# longer than fx by. The last two are as in calibrations of consumer cameras.
EXIF_FOCAL_SIGMA, PHOTO_FOCAL_SIGMA, CENTRE_SIGMA, ASPECT_SIGMA = 0.05, 0.5, 0.02, 0.004
# ... and its second radial and its tangential distortion coefficients.
SECOND_RADIAL_SIGMA, TANGENTIAL_SIGMA = 0.1, 0.001
# By how much of its length a slab's side is measured wrong, as a standard deviation, and how wide a joint is,
# in metres, that sides leave out as nominal ones do: bricks of 200 x 100 mm lie 205 x 105 mm apart.
SIDE_SIGMA, LEFT_OUT_M = 0.002, 0.005
# Logarithm of a ratio that joints change by less is that of sides as good as equal.
ALIKE_SIDES = 0.001
# Slabs and camera heights that are told lie within, in metres.
LENGTHS_M = (1e-6, 1e6)


@dataclass(frozen=True)
class Task:
    """A photo with its camera, if that is known, and what tells the scale.

    Attributes:
        sight: the photo.
        camera: its camera; None where its own joints must tell the focal length.
        source: where the camera is from.
        slab: sides of a slab in metres, in either order.
        camera_height: height of the camera above the paving in metres.
        colour: gives the photo in colour (BGR), if it has colours.
        ground: whether somebody vouches for it that no wall is seen, where the photo itself does not tell.
    """

    sight: Sight
    camera: Camera | None
    source: CameraSource
    slab: tuple[float, float] | None = None
    camera_height: float | None = None
    colour: Callable[[], UInt8[np.ndarray, "h w 3"]] | None = None
    ground: bool = False

    def __post_init__(self) -> None:
        """Refuse what is out of range (ValueError)."""
        height, width = self.sight.gray.shape
        _check_camera(self.camera, width, height)
        if self.slab is not None and self.camera_height is not None:
            raise ValueError("slab, camera_height: give one of them, both set the scale")
        if self.slab is not None and not _lengths(self.slab, (2,)):
            raise ValueError(
                f"slab: two lengths in metres are wanted, such as (0.6, 0.4), each {_within()}, "
                f"got {self.slab!r}"
            )
        if self.camera_height is not None and not _lengths(self.camera_height, ()):
            raise ValueError(
                f"camera_height: must be a length in metres, {_within()}, got {self.camera_height!r}"
            )
        if self.slab is not None:
            object.__setattr__(self, "slab", tuple(float(side) for side in self.slab))

    @cached_property
    def picture(self) -> Float32[np.ndarray, "h w"]:
        """Grey levels."""
        return self.sight.gray.astype(np.float32)

    @property
    def calibrated(self) -> Camera | None:
        """The camera, if somebody vouches for it."""
        return self.camera if self.source == "file" else None

    @property
    def free(self) -> Free:
        """What is solved for: with a camera file the pose alone, else the camera too, within what is known.

        The joints of slabs of known shape tell two numbers of the camera: the focal length and one coordinate
        of the principal point. The other stays at the picture's centre, and its uncertainty goes into the
        pose.
        """
        if self.source == "file":
            return _free_sides(self.slab)
        height, width = self.sight.gray.shape
        longer = max(width, height)
        return Free(
            ratio=self.slab is None,
            focal=True,
            centre=True,
            radial=True,
            aspect=True,
            bent=True,
            nominal=self.camera or Camera.from_focal(width, height, float(longer)),
            focal_sigma=EXIF_FOCAL_SIGMA if self.source == "exif" else PHOTO_FOCAL_SIGMA,
            centre_sigma_px=CENTRE_SIGMA * longer,
            radial_sigma=RADIAL_SIGMA,
            aspect_sigma=ASPECT_SIGMA,
            second_radial_sigma=SECOND_RADIAL_SIGMA,
            tangential_sigma=TANGENTIAL_SIGMA,
        )


def _free_sides(slab: tuple[float, float] | None) -> Free:
    """The pose, and the ratio of the slabs' sides as far as it is not known."""
    if slab is None:
        return Free(ratio=True)
    short, long = sorted(slab)
    # By how much less the ratio is with a usual joint at each side than without.
    left_out = float(np.log(long / short * (short + LEFT_OUT_M) / (long + LEFT_OUT_M)))
    if left_out > ALIKE_SIDES:
        return Free(ratio=True, slab=slab, ratio_sigma=float(np.hypot(2**0.5 * SIDE_SIGMA, left_out)))
    # Joints or none, the sides are as good as equal, which ground that is not quite even must not undo.
    return Free()


def _check_camera(camera: object, width: int, height: int) -> None:
    if camera is None:
        return
    if not isinstance(camera, Camera):
        raise ValueError(f"camera: a Camera or None is wanted, got {type(camera).__name__}; see read_camera")
    if (camera.width, camera.height) != (width, height):
        size = f"{camera.width}x{camera.height}"
        raise ValueError(
            f"camera: is for {size} pixels, the photo has {width}x{height}; see Camera.scaled and cropped"
        )


def _lengths(value: object, shape: tuple[int, ...]) -> bool:
    """Whether a caller's lengths are what their type says, and such as something on earth may have."""
    try:
        metres = np.asarray(value, float)
    except (TypeError, ValueError):
        return False
    # Texts and truth values would be taken for numbers.
    if np.asarray(value).dtype.kind in "bSU":
        return False
    return metres.shape == shape and bool(((metres >= LENGTHS_M[0]) & (metres <= LENGTHS_M[1])).all())


def _within() -> str:
    return f"from {LENGTHS_M[0]:g} to {LENGTHS_M[1]:g}"
