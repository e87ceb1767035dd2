"""One photo in, one aligned pose out: the pipeline on one page."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from autoreg.alignment import Alignment, CameraReport, JointFit, Pose, Residual
from autoreg.blas_threads import one_blas_thread
from autoreg.camera import Camera
from autoreg.conclude import (
    canonical_frame,
    describe_lattice,
    fitted_joints,
    measure_residual,
    metric_scale,
    slab_mismatch,
    with_slab_ratio,
)
from autoreg.corrections import with_measured_shift
from autoreg.cross_joints import common_lean
from autoreg.errors import Refusal
from autoreg.freedom import Free
from autoreg.geometry import Rigid
from autoreg.image import as_gray
from autoreg.last_step import rested
from autoreg.lattice_choice import Paving, presented
from autoreg.presence import field_polygon, presence_of
from autoreg.refine import Fit, refine_until_still
from autoreg.refusals import focal_untold, leaning, maybe_wall, no_lattice
from autoreg.right_angles import Squared, square_up
from autoreg.rows import STEP_SIGMA, Rows
from autoreg.search import RADIAL_SIGMA, find_paving, other_camera
from autoreg.segments import Segments
from autoreg.sight import Sight, see
from autoreg.solver import warm_up
from autoreg.stations import Grid
from autoreg.uncertainty import check_camera

__all__ = ["Alignment", "CameraReport", "JointFit", "Pose", "Residual", "align", "warm_up"]

Source = Literal["file", "exif", "photo"]

# What else is known of an uncalibrated camera: logarithm of its focal length with and without EXIF (the
# latter about one picture width), and the principal point as a share of the long side.
EXIF_FOCAL_SIGMA, PHOTO_FOCAL_SIGMA, CENTRE_SIGMA = 0.05, 0.5, 0.012
# Rows must tell a focal length as well as EXIF does. It enters the tilt by sin(pitch) cos(pitch) at most, so
# that the tilt is within 3 degrees of the truth in 95 of 100 photos at the least.
MOST_FOCAL_SIGMA = 0.05
# Slabs tell the tilt in any case. Their camera's height goes with the focal length: where it may be wrong by
# half, the photo has not told it.
MOST_SLABS_FOCAL_SIGMA = 0.25
REACH = 12.0
# Half width of the first search at full resolution, in slab sides; and how often a shift may be corrected.
FIRST_SEARCH, MOST_SHIFTS = 0.04, 3


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
    return align_seen(
        see(as_gray(photo)), camera, slab=slab, camera_height=camera_height, exif_focal_px=exif_focal_px
    )


@one_blas_thread()
def align_seen(
    sight: Sight,
    camera: Camera | None,
    *,
    slab: tuple[float, float] | None = None,
    camera_height: float | None = None,
    exif_focal_px: float | None = None,
) -> Alignment:
    """Like `align`, of a photo that is looked at already.

    Raises:
        Refusal: the photo does not carry the answer.
        ValueError: an argument is out of range.
    """
    gray, looks, segments = sight.gray, sight.looks, sight.segments
    height, width = gray.shape
    _check_arguments(camera, width, height, slab, camera_height)
    source: Source = "file" if camera is not None else "photo"
    if camera is None and exif_focal_px is not None:
        camera, source = Camera.from_focal(width, height, exif_focal_px), "exif"
    size = width, height
    given = camera if source == "file" else None
    try:
        found = find_paving(looks, segments, size, camera, slab)
    except Refusal as refusal:
        raise (given and other_camera(looks, segments, size, given)) or refusal from None
    # A wrong camera may leave rows of what is a lattice.
    if isinstance(found, Rows) and given is not None:
        blamed = other_camera(looks, segments, size, given)
        if blamed is not None:
            raise blamed
    wall = maybe_wall((found.paving if isinstance(found, Rows) else found).fit)
    if wall is not None:
        raise wall
    picture, small = gray.astype(np.float32), looks.picture
    free, squared = _freedom(camera, source, slab, width, height), None
    if isinstance(found, Rows):
        fit, crossing = measure(picture, found.paving, Free(step_sigma=STEP_SIGMA)), found.crossing
        if source == "photo":
            squared = _square(picture, fit, segments, found, free)
            fit, crossing = squared.settled.fit, squared.crossing
        settled = _rows_settled(small, at_detection_scale(fit, small, found.paving), found)
    else:
        if slab is not None and (mismatch := slab_mismatch(found.fit, slab)) is not None:
            raise mismatch
        start = found if slab is None else replace(found, fit=with_slab_ratio(found.fit, slab))
        fit = measure(picture, start, free)
        settled, crossing = presented(small, at_detection_scale(fit, small, start)), None
        if settled is None or settled.margin_nats < 0:
            raise no_lattice(settled, None)
    off = leaning(common_lean(segments, fit, field_polygon(settled.presence)), fit.camera, source)
    if off is not None:
        raise (given and other_camera(looks, segments, size, given)) or off
    return _concluded(picture, fit, settled, crossing, squared, source, slab, camera_height)


def _square(picture: np.ndarray, fit: Fit, segments: Segments, found: Rows, known: Free) -> Squared:
    """Rows with the focal length at which their cross joints are square.

    Raises:
        Refusal: they tell it too little for a pose.
    """
    squared = square_up(picture, fit, segments, field_polygon(found.paving.presence), known, REACH)
    if squared is None:
        raise focal_untold("rows", None, np.inf, MOST_FOCAL_SIGMA)
    if squared.sigma_log_focal > MOST_FOCAL_SIGMA:
        focal_px = squared.settled.fit.camera.fx
        raise focal_untold("rows", focal_px, squared.sigma_log_focal, MOST_FOCAL_SIGMA)
    return squared


def measure(picture: np.ndarray, paving: Paving, free: Free) -> Fit:
    """The fit of a lattice found at detection scale, repeated at the photo's own resolution.

    Raises:
        Refusal: its joints cannot be measured there.
    """
    coarse = paving.fit
    height, width = picture.shape
    field = field_polygon(paving.presence)

    def measured(grid: Grid, near: Fit) -> Fit:
        fit = refine_until_still(
            picture, near.camera.scaled(width, height), near.cam_from_ground, grid,
            free=free, search=FIRST_SEARCH, reach=REACH, strip=replace(near.strip, polarity_known=True),
            field=field,
        )  # fmt: skip
        if fit is None:
            raise no_lattice(paving, None)
        return fit

    fit = measured(coarse.grid, coarse)
    for _ in range(MOST_SHIFTS):
        shifted = with_measured_shift(fit)
        if shifted is None:
            break
        fit = measured(shifted.grid, fit)
    return fit


def _concluded(
    picture: np.ndarray,
    fit: Fit,
    settled: Paving,
    crossing: np.ndarray | None,
    squared: Squared | None,
    source: Source,
    slab: tuple[float, float] | None,
    camera_height: float | None,
) -> Alignment:
    """The answer in the canonical frame and in metres."""
    field = field_polygon(settled.presence)
    last = rested(picture, fit, REACH, field) if squared is None else squared.settled
    # A camera that comes from the joints themselves is nothing that they could contradict.
    asked = None if source == "photo" else picture
    check = check_camera(fit, asked, field, last.scatter)
    fit, told = last.fit, fit.grid.spacing_x is not None
    if source == "photo" and told and check.focal_sigma_px > MOST_SLABS_FOCAL_SIGMA * check.focal_px:
        sigma = check.focal_sigma_px / check.focal_px
        raise focal_untold("slabs", fit.camera.fx, sigma, MOST_SLABS_FOCAL_SIGMA)
    scale, scale_source = metric_scale(fit, slab, camera_height)
    frame = canonical_frame(fit, settled.presence, crossing)
    pose = frame.pose(fit.cam_from_ground)
    units = np.diag([1.0, 1.0, 1.0, scale, scale, scale])
    covariance = frame.covariance(last.covariance, fit.cam_from_ground)
    focal, focal_sigma = (check.focal_px, check.focal_sigma_px) if told else (None, None)
    if squared is not None:
        focal, focal_sigma = fit.camera.fx, fit.camera.fx * squared.sigma_log_focal
    return Alignment(
        width=fit.camera.width,
        height=fit.camera.height,
        camera=CameraReport(
            fit.camera,
            source,
            # Rows tell too little of a camera to vouch for it.
            None if source == "photo" or (check.consistent and not told) else check.consistent,
            focal,
            focal_sigma,
        ),
        pose=Pose(Rigid(pose.R, scale * pose.t), units @ covariance @ units),
        scale_source=scale_source,
        lattice=describe_lattice(fit, settled.presence, frame, scale),
        residual=measure_residual(fit),
        joints=fitted_joints(fit, frame),
    )


def at_detection_scale(fit: Fit, small: np.ndarray, found: Paving) -> Fit:
    """A fit as the small picture shows it, where the presence of sides is judged."""
    camera = fit.camera.scaled(small.shape[1], small.shape[0])
    strip = replace(fit.strip, blur_px=found.fit.strip.blur_px, polarity=found.fit.strip.polarity)
    return replace(fit, camera=camera, strip=strip)


def _rows_settled(small: np.ndarray, fit: Fit, rows: Rows) -> Paving:
    presence = presence_of(small, fit)
    if len(presence.p) < 6:
        raise no_lattice(None, rows)
    return Paving(fit, presence, rows.paving.evidence_nats)


def _freedom(
    camera: Camera | None, source: Source, slab: tuple[float, float] | None, width: int, height: int
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


def _check_arguments(
    camera: Camera | None,
    width: int,
    height: int,
    slab: tuple[float, float] | None,
    camera_height: float | None,
) -> None:
    if camera is not None and (camera.width, camera.height) != (width, height):
        size = f"{camera.width}x{camera.height}"
        raise ValueError(f"camera: is for {size} pixels, the photo has {width}x{height}")
    if slab is not None and camera_height is not None:
        raise ValueError("slab, camera_height: give one of them, both set the scale")
    if slab is not None and not all(np.isfinite(s) and s > 0 for s in slab):
        raise ValueError(f"slab: sides must be positive lengths in metres, got {slab}")
    if camera_height is not None and not (np.isfinite(camera_height) and camera_height > 0):
        raise ValueError(f"camera_height: must be a positive length in metres, got {camera_height}")
