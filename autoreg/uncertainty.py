"""How sure the pose is, which pose is likeliest, and whether the photo contradicts its camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from autoreg import joint_data as terms
from autoreg.freedom import Free, moved_camera, moved_pose, stretched
from autoreg.geometry import Rigid
from autoreg.refine import Fit, refine, refine_until_still
from autoreg.slab_model import BOW, Estimate, Scatter, estimate_motion

# What a calibration may be off by, as a standard deviation, before a photo is said to contradict it: share of
# the focal length, and of the picture's width for the principal point.
FOCAL_TOLERANCE, CENTRE_TOLERANCE = 0.01, 0.005
# The contradiction must be beyond this chi-square (of at most three degrees of freedom).
CONTRADICTION = 12.0
# Above this chi-square, or where slabs seem to lie this share of a side off, the joints are measured again.
DOUBT, UNEVEN = 1.0, 0.01
# What a free camera must lower the slabs' scatter to, to be believed.
EVENER = 0.8


@dataclass(frozen=True)
class Settled:
    """A fit at the pose that the mixed model makes likeliest.

    `covariance` is of (rotation vector, translation) of a small motion on the camera's side.
    """

    fit: Fit
    covariance: Float[np.ndarray, "6 6"]
    scatter: Scatter


def settle(fit: Fit) -> Settled:
    """The fit moved to the likeliest pose under irregular slabs, and how sure that pose is."""
    estimate = estimate_motion(fit, fit.free.mask, fit.free.prior(fit.camera))
    moved = moved_fit(fit, estimate.parameters)
    return Settled(moved, on_camera_side(estimate.covariance, moved.cam_from_ground), estimate.scatter)


def moved_fit(fit: Fit, parameters: Float[np.ndarray, " p"]) -> Fit:
    """The fit after a small motion of pose, camera and lattice; its joints are not measured anew."""
    step = replace(fit.solution, parameters=parameters)
    return replace(
        fit,
        camera=moved_camera(fit.camera, step),
        cam_from_ground=moved_pose(fit.cam_from_ground, step),
        grid=stretched(fit.grid, step),
        distances_px=fit.distances_px + fit.solution.jacobian @ parameters,
    )


def on_camera_side(covariance: Float[np.ndarray, "p p"], pose: Rigid) -> Float[np.ndarray, "6 6"]:
    """The pose's part, where the solve's rotation turns the translation as well: t = exp(w) t0 + dt."""
    A = np.eye(6)
    A[3:, :3] = -_cross(pose.t)
    C = A @ covariance[:6, :6] @ A.T
    return 0.5 * (C + C.T)


def _cross(v: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@dataclass(frozen=True)
class CameraCheck:
    """What the joints say about the camera; the shifts are of the joints' own camera from the given one."""

    consistent: bool
    focal_px: float
    focal_sigma_px: float
    focal_shift: float
    centre_shift_px: Float[np.ndarray, "2"]
    chi_square: float


def check_camera(
    fit: Fit,
    picture: Float[np.ndarray, "h w"] | None = None,
    field: Float[np.ndarray, "k 2"] | None = None,
    scatter: Scatter | None = None,
) -> CameraCheck:
    """Whether the joints of this photo contradict the camera they were fitted with.

    The joints' own focal length and principal point are estimated, with the covariance of irregular slabs.
    Their distance from the given camera is judged against that covariance plus what a good calibration may
    be off by: a direction that the joints do not tell has a wide covariance, and so no say.

    Ground that is bent imitates another camera, and so the covariance allows for a bow.

    A wrong camera makes even slabs look irregular, and hides joints from the search. With the picture, a fit
    that gives cause for doubt is therefore repeated with a free camera first.

    Args:
        fit: the fit with the given camera.
        picture: grey levels, to measure the joints again where the camera is in doubt.
        field: where on the ground the paving is, as for `refine`.
        scatter: of the slabs, as the fit's pose alone has it.
    """
    free = _free_camera(fit)
    # Joints that lie off since the camera is wrong lie off with both edges: widths would be misread.
    both = estimate_motion(fit, free.mask, free.prior(fit.camera), scatter, bow=BOW, widths=False)
    chi_square, shift = _contradiction(fit, fit, both)
    uneven = both.scatter.place > UNEVEN * min(fit.grid.spacing_x or np.inf, fit.grid.spacing_y)
    if picture is not None and (uneven or chi_square > DOUBT):
        given, before = fit, both.scatter.place
        for freed in _fits_with_free_camera(given, picture, field):
            motion = estimate_motion(
                freed, free.mask, free.prior(freed.camera), both.scatter, bow=BOW, widths=False
            )
            # A free camera that does not make the slabs evener has found nothing better.
            if motion.scatter.place < EVENER * both.scatter.place:
                chi_square, shift = _contradiction(given, freed, motion)
                fit, both = freed, motion
            if both.scatter.place < 0.5 * before:
                break
    log_focal, sigma = _focal_alone(both, fit.free.centre_sigma_px if fit.free.centre else 0.0)
    focal = fit.camera.fx * float(np.exp(log_focal))
    consistent = chi_square < CONTRADICTION
    return CameraCheck(consistent, focal, focal * sigma, float(shift[0]), shift[1:], chi_square)


def _focal_alone(both: Estimate, centre_sigma_px: float) -> tuple[float, float]:
    """Logarithm of the focal length's change and its sigma, with the principal point where it is.

    Where that is known to `centre_sigma_px` only, what it would change is uncertainty of the focal length.
    """
    C, x = both.covariance, both.parameters
    pull = np.linalg.solve(C[terms.CENTRE, terms.CENTRE], C[terms.CENTRE, terms.FOCAL])
    variance = C[terms.FOCAL, terms.FOCAL] - pull @ C[terms.CENTRE, terms.FOCAL]
    sigma = float(np.hypot(np.sqrt(max(variance, 0.0)), centre_sigma_px * np.linalg.norm(pull)))
    return float(x[terms.FOCAL] - pull @ x[terms.CENTRE]), sigma


def _free_camera(fit: Fit) -> Free:
    # Priors so wide that they only keep untold directions finite.
    width = float(fit.camera.width)
    return replace(fit.free, focal=True, centre=True, nominal=None, focal_sigma=1.0, centre_sigma_px=width)


def _fits_with_free_camera(
    fit: Fit, picture: Float[np.ndarray, "h w"], field: Float[np.ndarray, "k 2"] | None
) -> Iterator[Fit]:
    """Fits with the focal length free, then with the principal point as well.

    They grow from the camera's feet outwards: however wrong the camera, near joints lie where they are looked
    for, and what they tell of the camera brings the farther ones within reach.
    """
    for centre in (False, True):
        grown = refine(
            picture,
            fit.camera,
            fit.cam_from_ground,
            fit.grid,
            free=replace(_free_camera(fit), centre=centre),
            search=0.15,
            reaches=(2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 9.0, 12.0),
            strip=fit.strip,
            field=field,
        )
        # Nothing can be measured near the feet of a camera that looks far ahead.
        start = grown or fit
        still = refine_until_still(
            picture,
            start.camera,
            start.cam_from_ground,
            start.grid,
            free=_free_camera(fit),
            search=0.0 if grown else 0.08,
            reach=12.0,
            strip=start.strip,
            field=field,
        )
        if still is not None:
            yield still


def _contradiction(asked: Fit, told: Fit, motion: Estimate) -> tuple[float, Float[np.ndarray, "3"]]:
    """Chi-square of the distance between the camera that was given for one fit and that of another's joints.

    The distance itself comes along: logarithm of the focal length, and the principal point in pixels.
    """
    given, own = asked.free.nominal or asked.camera, told.camera
    moved = np.array([np.log(own.fx / given.fx), own.cx - given.cx, own.cy - given.cy])
    asked_of = [terms.FOCAL, 8, 9]
    shift = motion.parameters[asked_of] + moved
    tolerance = np.array([FOCAL_TOLERANCE, CENTRE_TOLERANCE * given.width, CENTRE_TOLERANCE * given.width])
    known = np.array([asked.free.focal_sigma, asked.free.centre_sigma_px, asked.free.centre_sigma_px])
    tolerance = np.maximum(tolerance, np.where(np.isfinite(known), known, 0.0))
    C = motion.covariance[np.ix_(asked_of, asked_of)] + np.diag(tolerance**2)
    return float(shift @ np.linalg.solve(C, shift)), shift
