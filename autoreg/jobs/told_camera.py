"""The camera that a file tells, made to fit the photo, and what a person should know about it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from autoreg.camera import Camera, fit_to_photo
from autoreg.camera_files import distrust, read_camera
from autoreg.image import Photo

# Lenses that draw outwards move a corner of the photo by a tenth of its distance from the principal point at
# most. Those that draw inwards, as a fisheye does, may move it by any part.
_MOST_OUTWARDS = 0.25


def told_camera(
    path: Path, crop: tuple[int, int, int, int] | None, photo: Photo, note: Callable[[str], None]
) -> Camera:
    """The camera of a file as it is for the photo; `note` gets what is odd about it.

    Args:
        path: the camera's file.
        crop: x, y, w, h of the part of the calibrated frame that the photo shows, or None for all of it.
        photo: the photo.
        note: gets sentences that a person has to read.

    Raises:
        InputError: the file is no camera's, or its camera did not take this photo.
    """
    camera, how = fit_to_photo(
        read_camera(path),
        photo.width,
        photo.height,
        crop=crop,
        photo_turned=photo.turned,
        photo_mirrored=photo.mirrored,
    )
    for said in (how, distrust(path), _far_aside(camera), _no_lens(camera)):
        if said:
            note(said)
    return camera


def _far_aside(camera: Camera) -> str | None:
    """What to say of a camera whose axis passes beside the photo, as that of a cut one's may."""
    if -1 < camera.cx < camera.width and -1 < camera.cy < camera.height:
        return None
    return (
        f"the camera's principal point, ({camera.cx:.6g}, {camera.cy:.6g}), lies outside the photo: unless "
        "that was cut off-centre, the camera file is wrong"
    )


def _no_lens(camera: Camera) -> str | None:
    """What to say of a distortion that reaches no corner of the photo, or moves one as no lens does."""
    right, bottom = camera.width - 1.0, camera.height - 1.0
    corners = np.array([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])
    rays = camera.normalise(corners)
    if not np.isfinite(rays).all():
        return (
            "the camera's distortion folds back within the photo, so that a corner of it has no ray: what "
            "lies there is left out; see `autoreg inspect`"
        )
    seen = np.hypot(*((corners - [camera.cx, camera.cy]) / [camera.fx, camera.fy]).T)
    outwards = float((seen - np.hypot(*rays.T)).max() / seen.max())
    if outwards < _MOST_OUTWARDS:
        return None
    return (
        f"the camera's distortion moves a corner of the photo outwards by {100 * outwards:.0f} % of its "
        "distance from the principal point, which no lens does: check the camera file with `autoreg inspect`"
    )
