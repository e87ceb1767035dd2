"""One photo in, one aligned pose out: the pipeline on one page."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import UInt8

from autoreg.alignment import Alignment, CameraReport, CameraSource, JointFit, Pose, Residual
from autoreg.answer.camera_refusals import focal_implausible, focal_untold, leaning
from autoreg.answer.conclude import (
    canonical_frame,
    describe_lattice,
    exif_not_followed,
    fitted_joints,
    measure_residual,
    metric_scale,
    scaled_covariance,
    unsure,
)
from autoreg.answer.full_resolution import REACH, Laid, measured_rows, measured_slabs
from autoreg.answer.last_step import rested
from autoreg.answer.refusals import maybe_wall, on_its_side
from autoreg.answer.slab_shape import plausible_focal, strain, unlike_slab
from autoreg.blas_threads import one_blas_thread
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.fields import largest_field
from autoreg.fitting.fit import Fit
from autoreg.geometry import Rigid
from autoreg.ground.sight import Sight, see
from autoreg.image import as_colour, as_gray
from autoreg.joint_tone import clearest_tone
from autoreg.paving.lattice_evidence import SAME_SPACING, Paving, alike
from autoreg.rows.cross_joints import common_lean
from autoreg.rows.rows import Rows
from autoreg.search import find_on, find_paving, find_rows, other_camera, upright_by
from autoreg.slabs.camera_check import check_camera
from autoreg.solve.solver import warm_up
from autoreg.task import Task

__all__ = ["Alignment", "CameraReport", "JointFit", "Pose", "Residual", "align", "warm_up"]

# Slabs tell the tilt in any case. Their camera's height goes with the focal length: where it may be wrong by
# half, the photo has not told it.
MOST_SLABS_FOCAL_SIGMA = 0.25
# A tone that leaves the joints so many times as far from their lines as luminance does shows them less well.
ROUGHER_IN_TONE = 1.6
# Refusals that have a reason of their own, which no other camera would take away.
OWN_REASONS = {"not_ground", "slab_mismatch", "camera_contradicted"}


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
        slab: sides of a slab in metres, from joint to joint, in either order. The pose follows the joints
            where these have another ratio, and a warning says so.
        camera_height: height of the camera above the paving in metres, instead of `slab`.
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
    exif_focal_px: float | None = None,
    colour: Callable[[], UInt8[np.ndarray, "h w 3"]] | None = None,
) -> Alignment:
    """Like `align`, of a photo that is looked at already; `colour` gives it in colour, if it has any.

    Raises:
        Refusal: the photo does not carry the answer.
        ValueError: an argument is out of range.
    """
    source: CameraSource = "photo" if camera is None else "file"
    task = Task(sight, camera, source, slab, camera_height, colour)
    try:
        if camera is None and exif_focal_px is not None:
            return _by_exif(task, exif_focal_px)
        laid = _laid(task)
    except Refusal as refusal:
        raise _other_reason(task, refusal) or refusal from None
    return _concluded(*_in_clearest_tone(task, laid))


def _other_reason(task: Task, refusal: Refusal) -> Refusal | None:
    """What else may be the reason of a refusal: the wrong camera, or a photo that does not stand upright."""
    # What a wrong camera hides may look like anything.
    if refusal.code not in OWN_REASONS:
        blamed = _other_camera(task)
        if blamed is not None:
            return blamed
    if refusal.code != "no_lattice":
        return None
    quarters = upright_by(task.sight, task.camera)
    return None if quarters is None else on_its_side(quarters)


def _by_exif(task: Task, focal_px: float) -> Alignment:
    """The answer by the focal length of EXIF, or by the joints' own where they contradict it.

    Raises:
        Refusal: neither shows any paving; what EXIF's refuses is told.
    """
    height, width = task.sight.gray.shape
    by_exif = replace(task, camera=Camera.from_focal(width, height, focal_px), source="exif")
    found: Alignment | Refusal
    try:
        found = _concluded(*_in_clearest_tone(by_exif, _laid(by_exif)))
        if found.camera.consistent is not False:
            return found
    except Refusal as refusal:
        if refusal.code in OWN_REASONS:
            raise
        found = refusal
    try:
        own = _concluded(*_in_clearest_tone(task, _laid(task)))
    except Refusal:
        if isinstance(found, Refusal):
            raise found from None
        return found
    return replace(own, warnings=(exif_not_followed(focal_px, own.camera.camera), *own.warnings))


def _laid(task: Task) -> Laid:
    """The paving, measured at the photo's own resolution: of two fields, the larger one that can be measured.

    Raises:
        Refusal: there is none, or it cannot be one of slabs on the ground.
    """
    found = _found(task)
    if task.camera is not None and isinstance(found, Paving):
        larger = largest_field(task.sight, found, task.camera, task.slab)
        if larger is not found:
            try:
                return _laid_where(task, larger)
            except Refusal as refusal:
                if refusal.code == "camera_contradicted":
                    raise
    return _laid_where(task, found)


def _in_clearest_tone(task: Task, laid: Laid) -> tuple[Task, Laid]:
    """What was laid, or what is in the tone in which its joints show best, with the photo in that tone."""
    if task.colour is None:
        return task, laid
    colour = task.colour()
    height, width = task.sight.looks.picture.shape
    tone = clearest_tone(colour, laid.fit, (width, height))
    if tone is None:
        return task, laid
    toned = replace(task, sight=see(tone.of(colour), toned=True))
    try:
        clearer = _laid_anew(toned, laid)
    except Refusal:
        return task, laid
    same = alike(laid.settled, clearer.settled, SAME_SPACING)
    better = same or clearer.settled.margin_nats > laid.settled.margin_nats
    smooth = clearer.fit.roughness_px < ROUGHER_IN_TONE * laid.fit.roughness_px
    return (toned, clearer) if better and smooth else (task, laid)


def _laid_anew(task: Task, before: Laid) -> Laid:
    """The paving in another tone: where it was before, if it is the same there.

    Raises:
        Refusal: there is none, or it cannot be one of slabs on the ground.
    """
    found = find_on(task.sight, before.fit.camera, before.fit.cam_from_ground.R)
    if found is None or not alike(before.settled, found, SAME_SPACING):
        return _laid(task)
    return _laid_where(task, found)


def _laid_where(task: Task, found: Paving | Rows) -> Laid:
    """What was found at detection scale, measured at the photo's own resolution.

    Raises:
        Refusal: it vanishes there, or cannot be one of slabs on the ground.
    """
    try:
        laid = _measured(task, found)
    except Refusal as refusal:
        if isinstance(found, Rows) or refusal.code != "no_lattice":
            raise
        # What is no lattice at the photo's own resolution, rows may have looked like.
        rows = find_rows(task.sight, task.camera)
        if rows is None or maybe_wall(rows.paving.fit) is not None:
            raise
        laid = _measured(task, rows)
    wall = maybe_wall(laid.likeliest.fit, laid.likeliest.covariance)
    if wall is not None:
        raise wall
    lean = common_lean(task.sight.segments, laid.fit, laid.settled.presence.field)
    off = leaning(lean, laid.fit.camera, task.source)
    if off is not None:
        raise _other_camera(task) or off
    return laid


def _found(task: Task) -> Paving | Rows:
    """The paving at detection scale; if that may be a wall, the one on the ground before it.

    Raises:
        Refusal: there is none, or none that may not be a wall.
    """
    found = find_paving(task.sight, task.camera, task.slab)
    wall = maybe_wall(_fit_of(found))
    if wall is None:
        return found
    try:
        before = find_paving(task.sight, task.camera, task.slab, walls=False)
    except Refusal:
        raise wall from None
    if maybe_wall(_fit_of(before)) is not None:
        raise wall
    return before


def _fit_of(found: Paving | Rows) -> Fit:
    return (found.paving if isinstance(found, Rows) else found).fit


def _measured(task: Task, found: Paving | Rows) -> Laid:
    """What was found, measured at the photo's own resolution, if it may be what it looks like.

    Raises:
        Refusal: it is not, or vanishes there.
    """
    # A wrong camera may leave rows of what is a lattice, or a small field of it.
    rows = isinstance(found, Rows)
    little = rows or found.closer is not None
    blamed = _other_camera(task, None if rows else found) if little else None
    if blamed is not None:
        raise blamed
    if rows:
        return measured_rows(task.sight, task.picture, found, task.free, square=task.source == "photo")
    return measured_slabs(task.sight, task.picture, found, task.free, task.slab)


def _other_camera(task: Task, found: Paving | None = None) -> Refusal | None:
    """The refusal of a calibrated camera, if the joints clearly fit another one better than those found."""
    return None if task.calibrated is None else other_camera(task.sight, task.calibrated, found)


def _concluded(task: Task, laid: Laid) -> Alignment:
    """The answer in the canonical frame and in metres."""
    fit, settled, squared, source = laid.fit, laid.settled, laid.squared, task.source
    field = settled.presence.field
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
    scale, scale_source = metric_scale(fit, task.slab, task.camera_height, laid.longer)
    frame = canonical_frame(fit, settled.presence, laid.crossing)
    pose = frame.pose(fit.cam_from_ground)
    covariance = frame.covariance(strained * last.covariance, fit.cam_from_ground)
    covariance = scaled_covariance(covariance, pose, scale, height_held=scale_source == "camera_height")
    focal, focal_sigma = (check.focal_px, strained**0.5 * check.focal_sigma_px) if told else (None, None)
    if squared is not None:
        focal, focal_sigma = fit.camera.fx, fit.camera.fx * squared.sigma_log_focal
    unlike = unlike_slab(fit, task.slab, last.ratio_sigma, scale) if source == "file" and task.slab else None
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
        lattice=describe_lattice(fit, settled.presence, frame, scale),
        residual=measure_residual(fit),
        joints=fitted_joints(fit, frame),
        warnings=(
            *unsure(answer, source, slab_told=task.slab is not None),
            *(() if unlike is None else (unlike.warning,)),
        ),
    )
