"""Why a photo's joints say that its camera is another one, or do not tell it, in words."""

from __future__ import annotations

from typing import Literal

import numpy as np

from autoreg.alignment import CameraSource
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.fitting.fit import Fit
from autoreg.rows.cross_joints import Lean

# Cross joints that lean together by more than this, and by so many standard deviations, are none of slabs
# seen with this camera. What slabs and their laying are off square is a tenth of it.
MOST_LEAN_DEG, LEAN_SIGMAS = 3.0, 5.0
# A camera's focal length must differ by this much before it is blamed for a refusal.
FOCAL_BLAME = 0.05
# ... and its principal point lie so far off the middle, as a share of the width.
CENTRE_BLAME = 0.03
# A focal length that is off, and a principal point with it, changes the ratio of the slabs' sides by no more
# than so many times as much (logarithms): by 0.6 to 1.4 times in four ray-traced photos.
RATIO_BY_FOCAL = 2.0
_OTHER_CAMERA = (
    "the camera file belongs to another camera, zoom or picture size: check it with its calibration, "
    "or leave --camera out"
)


def camera_contradicted(given: Camera, from_photo_px: float) -> Refusal | None:
    """The refusal of a photo whose joints fit a camera of this focal length; None if that is about the same.

    The other camera has its principal point in the middle of the picture.
    """
    share = from_photo_px / given.fx - 1.0
    size = np.array([given.width, given.height])
    off = float(np.linalg.norm(np.array([given.cx, given.cy]) - 0.5 * (size - 1))) / given.width
    if abs(share) >= FOCAL_BLAME:
        return Refusal(
            "camera_contradicted",
            f"no lattice fits this camera's focal length of {given.fx:.0f} px, but one fits "
            f"{from_photo_px:.0f} px ({100 * share:+.0f} %); {_OTHER_CAMERA}",
            measured=round(from_photo_px, 1),
            limit=round(given.fx, 1),
        )
    if off >= CENTRE_BLAME:
        return Refusal(
            "camera_contradicted",
            f"no lattice fits this camera, whose principal point ({given.cx:.0f}, {given.cy:.0f}) px lies "
            f"{100 * off:.0f} % of the width off the picture's middle, but one fits if it lies there; "
            f"if the photo was cut from a larger one say so with --crop; {_OTHER_CAMERA}",
            measured=round(off, 3),
            limit=CENTRE_BLAME,
        )
    return None


def contradicted_with_slab(fit: Fit, slab: tuple[float, float], from_photo_px: float) -> Refusal | None:
    """The refusal of a camera that its joints contradict, and by which the slabs have other sides than told.

    None where the focal length that the joints tell by themselves cannot be the reason for the sides: then
    they may be those of something else.
    """
    camera, told = fit.camera, max(slab) / min(slab)
    off, by_focal = np.log([fit.grid.ratio / told, from_photo_px / camera.fx])
    if abs(off) > RATIO_BY_FOCAL * abs(by_focal):
        return None
    return Refusal(
        "camera_contradicted",
        f"by this camera, of {camera.fx:.0f} px, the slabs have sides in the ratio {fit.grid.ratio:.3f}, "
        f"those given with --slab {told:.3f}, and the joints contradict it: by themselves they tell "
        f"{from_photo_px:.0f} px; {_OTHER_CAMERA}",
        measured=round(from_photo_px, 1),
        limit=round(camera.fx, 1),
    )


def leaning(lean: Lean | None, camera: Camera, source: CameraSource) -> Refusal | None:
    """The refusal of joints that are not at right angles to each other; None if they may be."""
    degrees = None if lean is None else lean.clear_deg(MOST_LEAN_DEG, LEAN_SIGMAS)
    if degrees is None:
        return None
    measured, limit = round(degrees, 2), MOST_LEAN_DEG
    if source == "photo":
        return Refusal(
            "no_lattice",
            f"the joints across the unbroken ones are {degrees:.1f} degrees off square at every focal length "
            "that suits them, which those of rectangular slabs are not; photograph slabs with right angles",
            measured=measured,
            limit=limit,
        )
    whose = {"file": "with this camera", "exif": "at the focal length of the photo's EXIF data"}[source]
    return Refusal(
        "camera_contradicted",
        f"{whose} ({camera.fx:.0f} px) the joints across the unbroken ones are {degrees:.1f} degrees off "
        f"square, which those of rectangular slabs are not; if these are such slabs, {_OTHER_CAMERA}",
        measured=measured,
        limit=limit,
    )


def focal_untold(
    kind: Literal["rows", "slabs"],
    focal_px: float | None,
    sigma_log_focal: float,
    limit: float,
    *,
    slab_helps: bool = False,
) -> Refusal:
    """The refusal of paving that leaves the focal length open, and with it the camera's tilt or its height.

    Args:
        kind: rows, or slabs with both of their spacings.
        focal_px: the likeliest focal length, if there is any.
        sigma_log_focal: standard deviation of its logarithm.
        limit: the largest one that will do.
        slab_helps: whether the ratio of a slab's sides, which nobody has told, may tell it.
    """
    what, depends, instead = {
        "rows": (
            "rows of slabs and the cross joints between them",
            "the tilt of the ground",
            "the rows aslant, at about 45 degrees, and not",
        ),
        "slabs": ("joints that hardly run together", "the height of the camera", "the ground less"),
    }[kind]
    told = "do not tell its focal length"
    if focal_px is not None:
        percent = 100 * sigma_log_focal
        told = f"tell its focal length only as {focal_px:.0f} px with a standard deviation of {percent:.0f} %"
    by_slab = "or the sides of a slab with --slab, whose ratio may tell it, " if slab_helps else ""
    return Refusal(
        "ambiguous",
        f"the photo names no camera, and {what} {told}, on which {depends} depends; give the camera with "
        f"--camera, {by_slab}or photograph {instead} steeply from above",
        measured=None if focal_px is None else round(sigma_log_focal, 3),
        limit=limit,
    )


def focal_implausible(camera: Camera) -> Refusal:
    """The refusal of joints that tell a focal length as hardly any camera has."""
    long_side = max(camera.width, camera.height)
    times = camera.fx / long_side
    return Refusal(
        "ambiguous",
        f"the photo names no camera, and its joints ask for a focal length of {camera.fx:.0f} px, "
        f"{times:.2g} times its long side, as hardly any camera has; the photo may have been cut from a "
        "larger one, or its joints be bent; give the camera with --camera",
        measured=round(times, 3),
    )
