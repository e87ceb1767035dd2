"""One photo in, one aligned pose out: the pipeline on one page."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autoreg.alignment import Alignment, CameraReport, CameraSource, JointFit, Pose, Residual
from autoreg.answer.conclude import (
    canonical_frame,
    describe_lattice,
    exif_not_followed,
    fitted_joints,
    measure_residual,
    metric_scale,
    scaled_covariance,
    unlike_slab,
    unsure,
)
from autoreg.answer.full_resolution import REACH, Laid, measured_rows, measured_slabs
from autoreg.answer.last_step import rested
from autoreg.answer.refusals import focal_implausible, focal_untold, leaning, maybe_wall, on_its_side
from autoreg.answer.slab_shape import plausible_focal, strain
from autoreg.blas_threads import one_blas_thread
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.fields import largest_field
from autoreg.fitting.fit import Fit
from autoreg.geometry import Rigid
from autoreg.ground.sight import Sight, see
from autoreg.image import as_gray
from autoreg.paving.lattice_choice import Paving
from autoreg.rows.cross_joints import common_lean
from autoreg.rows.rows import Rows
from autoreg.search import RADIAL_SIGMA, find_paving, find_rows, other_camera, upright_by
from autoreg.slabs.camera_check import check_camera
from autoreg.solve.freedom import Free
from autoreg.solve.solver import warm_up

__all__ = ["Alignment", "CameraReport", "JointFit", "Pose", "Residual", "align", "warm_up"]

# What else is known of an uncalibrated camera: logarithm of its focal length with and without EXIF (the
# latter about one picture width), the principal point as a share of the long side, and the logarithm of what
# fy is longer than fx by. The last two are as in calibrations of consumer cameras.
EXIF_FOCAL_SIGMA, PHOTO_FOCAL_SIGMA, CENTRE_SIGMA, ASPECT_SIGMA = 0.05, 0.5, 0.02, 0.004
# ... and its second radial and its tangential distortion coefficients.
SECOND_RADIAL_SIGMA, TANGENTIAL_SIGMA = 0.1, 0.001
# Slabs tell the tilt in any case. Their camera's height goes with the focal length: where it may be wrong by
# half, the photo has not told it.
MOST_SLABS_FOCAL_SIGMA = 0.25
# By how much of its length a slab's side is measured wrong, as a standard deviation, and how wide a joint is,
# in metres, that sides leave out as nominal ones do: bricks of 200 x 100 mm lie 205 x 105 mm apart.
SIDE_SIGMA, LEFT_OUT_M = 0.002, 0.005
# Logarithm of a ratio that joints change by less is that of sides as good as equal.
ALIKE_SIDES = 0.001
# Slabs and camera heights that are told lie within, in metres.
LENGTHS_M = (1e-6, 1e6)
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
    picture = sight.gray.astype(np.float32)
    height, width = picture.shape
    _check_arguments(camera, width, height, slab, camera_height)
    source: CameraSource = "photo" if camera is None else "file"
    try:
        if camera is None and exif_focal_px is not None:
            return _by_exif(sight, picture, exif_focal_px, slab, camera_height)
        laid = _laid(sight, picture, camera, source, slab)
    except Refusal as refusal:
        raise _other_reason(sight, camera, refusal) or refusal from None
    return _concluded(picture, laid, source, slab, camera_height)


def _other_reason(sight: Sight, camera: Camera | None, refusal: Refusal) -> Refusal | None:
    """What else may be the reason of a refusal: the wrong camera, or a photo that does not stand upright."""
    # What a wrong camera hides may look like anything.
    if refusal.code not in OWN_REASONS:
        blamed = _other_camera(sight, camera)
        if blamed is not None:
            return blamed
    if refusal.code != "no_lattice":
        return None
    quarters = upright_by(sight, camera)
    return None if quarters is None else on_its_side(quarters)


def _by_exif(
    sight: Sight,
    picture: np.ndarray,
    focal_px: float,
    slab: tuple[float, float] | None,
    camera_height: float | None,
) -> Alignment:
    """The answer by the focal length of EXIF, or by the joints' own where they contradict it.

    Raises:
        Refusal: neither shows any paving; what EXIF's refuses is told.
    """
    height, width = picture.shape

    def by(camera: Camera | None, source: CameraSource) -> Alignment:
        laid = _laid(sight, picture, camera, source, slab)
        return _concluded(picture, laid, source, slab, camera_height)

    found: Alignment | Refusal
    try:
        found = by(Camera.from_focal(width, height, focal_px), "exif")
        if found.camera.consistent is not False:
            return found
    except Refusal as refusal:
        if refusal.code in OWN_REASONS:
            raise
        found = refusal
    try:
        own = by(None, "photo")
    except Refusal:
        if isinstance(found, Refusal):
            raise found from None
        return found
    return replace(own, warnings=(exif_not_followed(focal_px, own.camera.camera), *own.warnings))


def _laid(
    sight: Sight,
    picture: np.ndarray,
    camera: Camera | None,
    source: CameraSource,
    slab: tuple[float, float] | None,
) -> Laid:
    """The paving, measured at the photo's own resolution: of two fields, the larger one that can be measured.

    Raises:
        Refusal: there is none, or it cannot be one of slabs on the ground.
    """
    found = _found(sight, camera, slab)
    if camera is not None and isinstance(found, Paving):
        larger = largest_field(sight, found, camera, slab)
        if larger is not found:
            try:
                return _laid_where(sight, picture, larger, camera, source, slab)
            except Refusal as refusal:
                if refusal.code == "camera_contradicted":
                    raise
    return _laid_where(sight, picture, found, camera, source, slab)


def _laid_where(
    sight: Sight,
    picture: np.ndarray,
    found: Paving | Rows,
    camera: Camera | None,
    source: CameraSource,
    slab: tuple[float, float] | None,
) -> Laid:
    """What was found at detection scale, measured at the photo's own resolution.

    Raises:
        Refusal: it vanishes there, or cannot be one of slabs on the ground.
    """
    height, width = picture.shape
    given = camera if source == "file" else None
    free = _freedom(camera, source, slab, width, height)
    try:
        laid = _measured(sight, picture, found, free, given, source, slab)
    except Refusal as refusal:
        if isinstance(found, Rows) or refusal.code != "no_lattice":
            raise
        # What is no lattice at the photo's own resolution, rows may have looked like.
        rows = find_rows(sight, camera)
        if rows is None or maybe_wall(rows.paving.fit) is not None:
            raise
        laid = _measured(sight, picture, rows, free, given, source, slab)
    wall = maybe_wall(laid.likeliest.fit, laid.likeliest.covariance)
    if wall is not None:
        raise wall
    lean = common_lean(sight.segments, laid.fit, laid.settled.presence.field)
    off = leaning(lean, laid.fit.camera, source)
    if off is not None:
        raise _other_camera(sight, given) or off
    return laid


def _found(sight: Sight, camera: Camera | None, slab: tuple[float, float] | None) -> Paving | Rows:
    """The paving at detection scale; if that may be a wall, the one on the ground before it.

    Raises:
        Refusal: there is none, or none that may not be a wall.
    """
    found = find_paving(sight, camera, slab)
    wall = maybe_wall(_fit_of(found))
    if wall is None:
        return found
    try:
        before = find_paving(sight, camera, slab, walls=False)
    except Refusal:
        raise wall from None
    if maybe_wall(_fit_of(before)) is not None:
        raise wall
    return before


def _fit_of(found: Paving | Rows) -> Fit:
    return (found.paving if isinstance(found, Rows) else found).fit


def _measured(
    sight: Sight,
    picture: np.ndarray,
    found: Paving | Rows,
    free: Free,
    given: Camera | None,
    source: CameraSource,
    slab: tuple[float, float] | None,
) -> Laid:
    """What was found, measured at the photo's own resolution, if it may be what it looks like.

    Raises:
        Refusal: it is not, or vanishes there.
    """
    # A wrong camera may leave rows of what is a lattice, or a small field of it.
    rows = isinstance(found, Rows)
    little = rows or found.closer is not None
    blamed = _other_camera(sight, given, None if rows else found) if little else None
    if blamed is not None:
        raise blamed
    if rows:
        return measured_rows(sight, picture, found, free, square=source == "photo")
    return measured_slabs(sight, picture, found, free, slab)


def _other_camera(sight: Sight, given: Camera | None, found: Paving | None = None) -> Refusal | None:
    """The refusal of a given camera, if the joints clearly fit another one better than what was found."""
    return None if given is None else other_camera(sight, given, found)


def _concluded(
    picture: np.ndarray,
    laid: Laid,
    source: CameraSource,
    slab: tuple[float, float] | None,
    camera_height: float | None,
) -> Alignment:
    """The answer in the canonical frame and in metres."""
    fit, settled, squared = laid.fit, laid.settled, laid.squared
    field = settled.presence.field
    # A camera that comes from the joints themselves is nothing that they could contradict.
    told_by, asked = (laid.likeliest.fit, None) if source == "photo" else (fit, picture)
    check = check_camera(told_by, asked, field, laid.likeliest.scatter)
    last = rested(picture, laid.likeliest, REACH, field)
    strained = strain(last.fit.camera, laid.fit.free)
    fit, told = last.fit, fit.grid.spacing_x is not None
    if source == "photo" and told and check.focal_sigma_px > MOST_SLABS_FOCAL_SIGMA * check.focal_px:
        sigma = check.focal_sigma_px / check.focal_px
        raise focal_untold("slabs", fit.camera.fx, sigma, MOST_SLABS_FOCAL_SIGMA)
    if source == "photo" and not plausible_focal(fit.camera, laid.fit.free):
        raise focal_implausible(fit.camera)
    scale, scale_source = metric_scale(fit, slab, camera_height, laid.longer)
    frame = canonical_frame(fit, settled.presence, laid.crossing)
    pose = frame.pose(fit.cam_from_ground)
    covariance = frame.covariance(strained * last.covariance, fit.cam_from_ground)
    covariance = scaled_covariance(covariance, pose, scale, height_held=scale_source == "camera_height")
    focal, focal_sigma = (check.focal_px, strained**0.5 * check.focal_sigma_px) if told else (None, None)
    if squared is not None:
        focal, focal_sigma = fit.camera.fx, fit.camera.fx * squared.sigma_log_focal
    unlike = unlike_slab(fit, slab, last.ratio_sigma, scale) if source == "file" and slab else None
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
            *unsure(answer, source, slab_told=slab is not None),
            *(() if unlike is None else (unlike.warning,)),
        ),
    )


def _freedom(
    camera: Camera | None, source: CameraSource, slab: tuple[float, float] | None, width: int, height: int
) -> Free:
    """What is solved for: with a camera file the pose alone, else the camera too, within what is known.

    The joints of slabs of known shape tell two numbers of the camera: the focal length and one coordinate
    of the principal point. The other stays at the picture's centre, and its uncertainty goes into the pose.
    """
    if source == "file":
        left_out = None if slab is None else _left_out(slab)
        if left_out is None or left_out > ALIKE_SIDES:
            sigma = np.inf if left_out is None else float(np.hypot(2**0.5 * SIDE_SIGMA, left_out))
            return Free(ratio=True, slab=slab, ratio_sigma=sigma)
        # Joints or none, the sides are as good as equal, which ground that is not quite even must not undo.
        return Free()
    nominal = camera or Camera.from_focal(width, height, float(max(width, height)))
    return Free(
        ratio=slab is None,
        focal=True,
        centre=True,
        radial=True,
        aspect=True,
        bent=True,
        nominal=nominal,
        focal_sigma=EXIF_FOCAL_SIGMA if source == "exif" else PHOTO_FOCAL_SIGMA,
        centre_sigma_px=CENTRE_SIGMA * max(width, height),
        radial_sigma=RADIAL_SIGMA,
        aspect_sigma=ASPECT_SIGMA,
        second_radial_sigma=SECOND_RADIAL_SIGMA,
        tangential_sigma=TANGENTIAL_SIGMA,
    )


def _left_out(slab: tuple[float, float]) -> float:
    """Logarithm by which a slab's ratio of sides is less with a usual joint at each than without."""
    short, long = sorted(slab)
    return float(np.log(long / short * (short + LEFT_OUT_M) / (long + LEFT_OUT_M)))


def _check_arguments(
    camera: Camera | None,
    width: int,
    height: int,
    slab: tuple[float, float] | None,
    camera_height: float | None,
) -> None:
    if _no_camera(camera):
        raise ValueError(f"camera: a Camera or None is wanted, got {type(camera).__name__}; see read_camera")
    if camera is not None and (camera.width, camera.height) != (width, height):
        size = f"{camera.width}x{camera.height}"
        raise ValueError(f"camera: is for {size} pixels, the photo has {width}x{height}")
    if slab is not None and camera_height is not None:
        raise ValueError("slab, camera_height: give one of them, both set the scale")
    if slab is not None and not _lengths(slab, (2,)):
        raise ValueError(
            f"slab: two lengths in metres are wanted, such as (0.6, 0.4), {_within()}, got {slab!r}"
        )
    if camera_height is not None and not _lengths(camera_height, ()):
        raise ValueError(f"camera_height: must be a length in metres, {_within()}, got {camera_height!r}")


def _no_camera(camera: object) -> bool:
    return not (camera is None or isinstance(camera, Camera))


def _lengths(value: object, shape: tuple[int, ...]) -> bool:
    """Whether a caller's lengths are what their type says, and such as something on earth may have."""
    try:
        metres = np.asarray(value, float)
    except (TypeError, ValueError):
        return False
    return metres.shape == shape and bool(((metres >= LENGTHS_M[0]) & (metres <= LENGTHS_M[1])).all())


def _within() -> str:
    return f"each from {LENGTHS_M[0]:g} to {LENGTHS_M[1]:g}"
