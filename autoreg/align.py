"""One photo in, one aligned pose out: the pipeline on one page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import UInt8

from autoreg.alignment import Alignment, CameraReport, CameraSource, JointFit, Pose, Residual
from autoreg.answer.camera_refusals import focal_implausible, focal_untold
from autoreg.answer.conclude import (
    bent,
    canonical_frame,
    describe_lattice,
    exif_not_followed,
    fitted_joints,
    measure_residual,
    metric_scale,
    scaled_covariance,
    unsure,
)
from autoreg.answer.full_resolution import REACH, Laid
from autoreg.answer.last_step import rested
from autoreg.answer.refusals import grooved, maybe_grooves, on_its_side, upright
from autoreg.answer.slab_shape import plausible_focal, strain, unlike_slab
from autoreg.blas_threads import one_blas_thread
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.fitting.heavier_lines import heavier_lines
from autoreg.geometry import Rigid
from autoreg.ground.sight import Sight, see
from autoreg.image import as_colour, as_gray
from autoreg.laying_in_tone import OWN_REASONS, lay_in_clearest_tone
from autoreg.search.glance import upright_by
from autoreg.slabs.bent_ground import bend_of
from autoreg.slabs.camera_check import check_camera
from autoreg.solve.solver import warm_up
from autoreg.task import Task

__all__ = ["Alignment", "CameraReport", "JointFit", "Pose", "Residual", "align", "warm_up"]

# Slabs tell the tilt in any case. Their camera's height goes with the focal length: where it may be wrong by
# half, the photo has not told it.
MOST_SLABS_FOCAL_SIGMA = 0.25


def align(
    photo: np.ndarray,
    camera: Camera | None,
    *,
    slab: tuple[float, float] | None = None,
    camera_height: float | None = None,
    ground: bool = False,
    exif_focal_px: float | None = None,
) -> Alignment:
    """The pose of the camera over the paving in a photo.

    Args:
        photo: grey or BGR picture.
        camera: its calibrated camera, or None to take the focal length from `exif_focal_px`, else from the
            photo's own joints.
        slab: sides of a slab in metres, from joint to joint, in either order. The pose follows the joints
            where these have another ratio, and a warning says so.
        camera_height: height of the camera above the paving in metres, instead of `slab`.
        ground: vouches for it that the joints lie on the ground: none is refused for looking like a wall.
        exif_focal_px: focal length in pixels that the photo's EXIF data claim. Where the photo's own joints
            contradict it, theirs is taken.

    Raises:
        Refusal: the photo does not carry the answer; the reason is in its code and message.
        ValueError: an argument is out of range.
    """
    colour = as_colour(photo)
    return align_seen(
        see(as_gray(photo if colour is None else colour)),
        camera,
        slab=slab,
        camera_height=camera_height,
        ground=ground,
        exif_focal_px=exif_focal_px,
        colour=None if colour is None else lambda: colour,
    )


@one_blas_thread()
def align_seen(
    sight: Sight,
    camera: Camera | None,
    *,
    slab: tuple[float, float] | None = None,
    camera_height: float | None = None,
    ground: bool = False,
    exif_focal_px: float | None = None,
    colour: Callable[[], UInt8[np.ndarray, "h w 3"]] | None = None,
) -> Alignment:
    """Like `align`, of a photo that is looked at already; `colour` gives it in colour, if it has any.

    Raises:
        Refusal: the photo does not carry the answer.
        ValueError: an argument is out of range.
    """
    source: CameraSource = "photo" if camera is None else "file"
    task = Task(sight, camera, source, slab, camera_height, colour, ground)
    try:
        if camera is None and exif_focal_px is not None:
            return _by_exif(task, exif_focal_px)
        return _concluded(*lay_in_clearest_tone(task))
    except Refusal as refusal:
        quarters = upright_by(task.sight, task.camera) if refusal.code == "no_lattice" else None
        if quarters is None:
            raise
        raise on_its_side(quarters) from None


def _by_exif(task: Task, focal_px: float) -> Alignment:
    """The answer by the focal length of EXIF, or by the joints' own where they contradict it.

    Raises:
        Refusal: neither shows any paving; what EXIF's refuses is told.
    """
    height, width = task.sight.gray.shape
    by_exif = replace(task, camera=Camera.from_focal(width, height, focal_px), source="exif")
    found: Alignment | Refusal
    try:
        found = _concluded(*lay_in_clearest_tone(by_exif))
        if found.camera.consistent is not False:
            return found
    except Refusal as refusal:
        if refusal.code in OWN_REASONS:
            raise
        found = refusal
    try:
        own = _concluded(*lay_in_clearest_tone(task))
    except Refusal:
        if isinstance(found, Refusal):
            raise found from None
        return found
    return replace(own, warnings=(exif_not_followed(focal_px, own.camera.camera), *own.warnings))


def _concluded(task: Task, laid: Laid) -> Alignment:
    """The answer in the canonical frame and in metres."""
    fit, settled, squared, source = laid.fit, laid.settled, laid.squared, task.source
    field = laid.field
    # A camera that comes from the joints themselves is nothing that they could contradict.
    told_by, asked = (laid.likeliest.fit, None) if source == "photo" else (fit, task.picture)
    check = check_camera(told_by, asked, field, laid.likeliest.scatter)
    last = rested(task.picture, laid.likeliest, REACH, field)
    strained = strain(last.fit.camera, laid.fit.free)
    fit, told = last.fit, fit.grid.spacing_x is not None
    if source == "photo" and told and check.focal_sigma_px > MOST_SLABS_FOCAL_SIGMA * check.focal_px:
        sigma = check.focal_sigma_px / check.focal_px
        helps = task.slab is None
        raise focal_untold("slabs", fit.camera.fx, sigma, MOST_SLABS_FOCAL_SIGMA, slab_helps=helps)
    if source == "photo" and not plausible_focal(fit.camera, laid.fit.free):
        raise focal_implausible(fit.camera)
    heavier = heavier_lines(fit)
    doubted = None if task.slab is None else grooved(heavier)
    if doubted is not None:
        raise doubted
    scale, scale_source = metric_scale(fit, task.slab, task.camera_height, laid.longer)
    frame = canonical_frame(fit, settled.presence, laid.crossing)
    pose = frame.pose(fit.cam_from_ground)
    bend, spread = bend_of(fit), strained * last.spread
    if bend is not None:
        spread[:6, :6] += bend.spread
    covariance = frame.covariance(spread, fit.cam_from_ground)
    covariance = scaled_covariance(covariance, pose, fit.grid, scale, scale_source)
    focal, focal_sigma = (check.focal_px, strained**0.5 * check.focal_sigma_px) if told else (None, None)
    if squared is not None:
        focal, focal_sigma = fit.camera.fx, fit.camera.fx * squared.sigma_log_focal
    told_slab = task.slab if source == "file" else None
    unlike = None if told_slab is None else unlike_slab(fit, told_slab, last.ratio_sigma, scale)
    consistent = check.consistent and not (unlike is not None and unlike.contradicts)
    answer = Pose(Rigid(pose.R, scale * pose.t), covariance)
    return Alignment(
        width=fit.camera.width,
        height=fit.camera.height,
        camera=CameraReport(
            fit.camera,
            source,
            # Rows tell too little of a camera to vouch for it.
            None if source == "photo" or (consistent and not told) else consistent,
            focal,
            focal_sigma,
        ),
        pose=answer,
        scale_source=scale_source,
        lattice=describe_lattice(fit, field, frame, scale),
        residual=measure_residual(fit),
        joints=fitted_joints(fit, frame),
        warnings=(
            *unsure(answer, source, slab_told=task.slab is not None),
            *(() if unlike is None else (unlike.warning,)),
            # By a wrong camera any ground looks bent.
            *(() if bend is None or consistent is False else (bent(bend, fit, scale, scale_source),)),
            *maybe_grooves(heavier),
            *(() if task.ground else upright(fit)),
        ),
    )
