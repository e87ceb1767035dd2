"""One photo in, one aligned pose out: the pipeline on one page."""

from __future__ import annotations

from typing import Literal

import numpy as np

from autoreg.alignment import Alignment, CameraReport, JointFit, Pose, Residual
from autoreg.camera import Camera
from autoreg.conclude import (
    canonical_frame,
    describe_lattice,
    fitted_joints,
    measure_residual,
    metric_scale,
    with_slab_ratio,
)
from autoreg.errors import Refusal
from autoreg.geometry import Rigid
from autoreg.ground_planes import ground_planes, ground_planes_unknown_focal
from autoreg.image import as_gray, pyramid
from autoreg.paving import Paving, comb_planes, lay_lattice, settle_bond
from autoreg.presence import field_polygon
from autoreg.refine import Fit, Free, refine_until_still
from autoreg.segments import detect_segments
from autoreg.uncertainty import check_camera, pose_covariance

__all__ = ["Alignment", "CameraReport", "JointFit", "Pose", "Residual", "align"]

# Joints are found at this size, and measured at the photo's own.
DETECTION_PIXELS = 600_000
# Slab sides in the ratio of the photo may differ from the given ones by this much, plus the scatter.
RATIO_TOLERANCE = 0.03
# What is known of an uncalibrated camera: logarithm of its focal length with and without EXIF (the latter
# about one picture width), and the principal point as a share of the long side.
EXIF_FOCAL_SIGMA, PHOTO_FOCAL_SIGMA, CENTRE_SIGMA = 0.05, 0.5, 0.012
# ... and the first radial distortion coefficient, which curved joints tell.
RADIAL_SIGMA = 0.1


def align(
    photo: np.ndarray,
    camera: Camera | None,
    *,
    slab: tuple[float, float] | None = None,
    camera_height: float | None = None,
    exif_focal_px: float | None = None,
) -> Alignment:
    """The pose of the camera over the paving in a photo.

    Args:
        photo: grey or BGR picture.
        camera: its calibrated camera, or None to take the focal length from `exif_focal_px`, else from the
            photo's own joints.
        slab: sides of a slab in metres, in either order.
        camera_height: height of the camera above the paving in metres, instead of `slab`.
        exif_focal_px: focal length in pixels that the photo's EXIF data claim.

    Raises:
        Refusal: the photo does not carry the answer; the reason is in its code and message.
        ValueError: an argument is out of range.
    """
    gray = as_gray(photo)
    height, width = gray.shape
    source: Literal["file", "exif", "photo"] = "file" if camera is not None else "photo"
    if camera is None and exif_focal_px is not None:
        camera, source = Camera.from_focal(width, height, exif_focal_px), "exif"
    paving = find_paving(gray, camera)
    fit = measure(gray, paving, slab, _freedom(camera, source, slab, width, height))
    settled = settle_bond(gray.astype(np.float32), fit)
    if settled is None or settled.margin_nats < 0:
        raise _no_lattice(settled)
    scale, scale_source = metric_scale(fit, slab, camera_height)
    frame = canonical_frame(fit, settled.presence)
    check = check_camera(fit)
    pose = frame.pose(fit.cam_from_ground)
    covariance = pose_covariance(fit)
    units = np.diag([1.0, 1.0, 1.0, scale, scale, scale])
    return Alignment(
        width=width,
        height=height,
        camera=CameraReport(
            fit.camera,
            source,
            check.consistent if source != "photo" else None,
            check.focal_px,
            check.focal_sigma_px,
        ),
        pose=Pose(Rigid(pose.R, scale * pose.t), units @ covariance @ units),
        scale_source=scale_source,
        lattice=describe_lattice(fit, settled.presence, frame, scale),
        residual=measure_residual(fit),
        joints=fitted_joints(fit, frame),
    )


def find_paving(gray: np.ndarray, camera: Camera | None) -> Paving:
    """The lattice that explains the photo best, at detection scale."""
    height, width = gray.shape
    small, _ = pyramid(gray, DETECTION_PIXELS)
    picture = small.astype(np.float32)
    segments = detect_segments(gray)
    if camera is not None:
        hypotheses = [(h.R, camera) for h in ground_planes(segments, camera, max_hypotheses=8)]
    else:
        hypotheses = [
            (h.R, Camera.from_focal(width, height, focal))
            for h, focal in ground_planes_unknown_focal(segments, width, height, max_hypotheses=12)
        ]
    ranked = comb_planes(small, segments, [(c, R) for R, c in hypotheses], free_focal=camera is None)
    free = Free(ratio=True) if camera is not None else Free(True, focal=True, radial=True, radial_sigma=RADIAL_SIGMA)
    found = [lay_lattice(picture, plane, free) for plane in ranked[:3]]
    pavings = sorted((p for p in found if p is not None), key=lambda p: -p.margin_nats)
    if not pavings:
        raise _no_lattice(None)
    return pavings[0]


def measure(gray: np.ndarray, paving: Paving, slab: tuple[float, float] | None, free: Free) -> Fit:
    """The fit of a lattice found at detection scale, repeated at the photo's own resolution."""
    coarse = paving.fit
    height, width = gray.shape
    start = coarse if slab is None else with_slab_ratio(coarse, slab)
    fit = refine_until_still(
        gray.astype(np.float32),
        coarse.camera.scaled(width, height),
        start.cam_from_ground,
        start.grid,
        free=free,
        search=0.04,
        reach=12.0,
        field=field_polygon(paving.presence),
    )
    if fit is None:
        raise _no_lattice(None)
    return fit


def _freedom(
    camera: Camera | None,
    source: Literal["file", "exif", "photo"],
    slab: tuple[float, float] | None,
    width: int,
    height: int,
) -> Free:
    """What is solved for: with a camera file the pose alone, else the camera too, within what is known.

    The joints of slabs of known shape tell two numbers of the camera: the focal length and one coordinate
    of the principal point. The other stays at the picture's centre, and its uncertainty goes into the pose.
    """
    if source == "file":
        return Free(ratio=slab is None)
    nominal = camera or Camera.from_focal(width, height, float(max(width, height)))
    return Free(
        ratio=slab is None,
        focal=True,
        centre=True,
        radial=True,
        nominal=nominal,
        focal_sigma=EXIF_FOCAL_SIGMA if source == "exif" else PHOTO_FOCAL_SIGMA,
        centre_sigma_px=CENTRE_SIGMA * max(width, height),
        radial_sigma=RADIAL_SIGMA,
    )


def _no_lattice(paving: Paving | None) -> Refusal:
    measured = None if paving is None else paving.margin_nats
    return Refusal(
        "no_lattice",
        "no lattice of slabs explains this picture better than chance; "
        "take a photo in which two or more rows of slabs and their cross joints are clearly seen",
        measured=measured,
        limit=0.0,
    )
