"""Whether the joints of a photo contradict the camera that they were fitted with."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from autoreg.fitting.fit import Fit
from autoreg.fitting.refine import FROM_THE_FEET, WIDE_SEARCH, refine, refine_until_still
from autoreg.ground.stations import joints_of
from autoreg.numbering import numbered
from autoreg.paving.bond import customary_shift
from autoreg.slabs.slab_model import BOW, Estimate, Scatter, estimate_motion
from autoreg.solve import joint_data as terms
from autoreg.solve.freedom import Free

# What a calibration may be off by, as a standard deviation, before a photo is said to contradict it: share of
# the focal length, and of the picture's width for the principal point and for what the lens does to a corner.
FOCAL_TOLERANCE, CENTRE_TOLERANCE, LENS_TOLERANCE = 0.0065, 0.005, 0.0025
# The contradiction must be beyond this chi-square (of at most four degrees of freedom).
CONTRADICTION = 14.0
# So wide that it only keeps untold lenses finite.
ANY_RADIAL = 0.5
# Above this chi-square, or where slabs seem to lie this share of a side off, or more than this share of a
# family's joints is missed, the joints are measured again.
DOUBT, UNEVEN, MISSED = 1.0, 0.01, 0.15
# Below this chi-square by the scatter that the pose alone has, and with even slabs by it, nothing is to be
# doubted, and no better scatter is searched: 39 right cameras and 70 wrong ones were judged alike either way.
CALM = 0.25
# To be believed, a free camera must lower the share of missed joints to this, if it gave doubt, and may leave
# them so much farther from their lines; or it must lower the slabs' scatter and the joints' distances to
# these. Right cameras miss up to a tenth of the joints for other reasons.
FEWER, ROUGHER, EVENER, SMOOTHER = 0.5, 1.1, 0.8, 0.95
# ... by so many standard deviations of such a scatter, too, as few slabs or courses tell it.
CLEARLY_SIGMAS = 2.0
# Its lines must tell so many more numbers, two each, than a free camera has parameters, lest it suit any.
SPARE_NUMBERS = 6
# A photo whose middle lies this many focal lengths off the axis (60 degrees) is none that a lens draws: those
# cropped from very wide ones come to 50 degrees. A free camera that bent joints drive there tells nothing.
MOST_OFF_AXIS = 1.73
# Paving falls to its gutters, and so is bent: by a few millimetres in a metre off the plane it draws lines as
# a bent lens does whose axis is far off, at 0.5 to 1.7 focal lengths. One whose axis lies nearer is believed.
MOST_OFF_BENT_AXIS = 0.4
# Cameras are like each other whose focal length (its logarithm) and principal point (as a share of the
# picture's width) differ by less.
LIKE_FOCAL, LIKE_CENTRE = 0.2, 0.15
# The most steps of a solve with a free camera. Those beyond follow a valley of cameras that the joints hardly
# tell apart, hundreds of pixels far, for less than what the cost is uncertain by.
FREE_STEPS = 12
# Slabs that scatter by less, in pixels, are even.
EVEN_PX = 0.02


@dataclass(frozen=True)
class CameraCheck:
    """What the joints say about the camera.

    `consistent` is None where the joints do not contradict the camera, but do not vouch for it either. The
    shifts are of the joints' own camera from the given one: logarithm of the focal length, pixels, and the
    first radial coefficient.
    """

    consistent: bool | None
    focal_px: float
    focal_sigma_px: float
    focal_shift: float
    centre_shift_px: Float[np.ndarray, "2"]
    radial_shift: float
    chi_square: float


def check_camera(
    fit: Fit,
    picture: Float[np.ndarray, "h w"] | None = None,
    field: Float[np.ndarray, "k 2"] | None = None,
    scatter: Scatter | None = None,
) -> CameraCheck:
    """Whether the joints of this photo contradict the camera they were fitted with.

    The joints' own focal length, principal point and lens are estimated, with the covariance of irregular
    slabs. Their distance from the given camera is judged against that covariance plus what a good calibration
    may be off by: a direction that the joints do not tell has a wide covariance, and so no say.

    Ground that is bent imitates another camera, and so the covariance allows for a bow.

    A wrong camera makes even slabs look irregular, hides joints from the search, and moves the courses of a
    running bond by as much as its shift may be misread. With the picture, a fit that gives cause for doubt is
    therefore repeated with a free camera first.

    Args:
        fit: the fit with the given camera.
        picture: grey levels, to measure the joints again where the camera is in doubt.
        field: where on the ground the paving is, as for `refine`.
        scatter: of the slabs, as the fit's pose alone has it.
    """
    given, free = fit, _free_camera(fit)
    side = min(fit.grid.spacing_x or np.inf, fit.grid.spacing_y)
    customary = customary_shift(fit.grid.shift)

    def asked(*, search: bool) -> tuple[Estimate, float, Float[np.ndarray, "4"], bool]:
        # Joints that lie off since the camera is wrong lie off with both edges: widths would be misread.
        told = estimate_motion(
            fit, free.mask, free.prior(fit.camera, fit.grid), scatter, bow=BOW, widths=False, search=search
        )
        chi_square, shift = _contradiction(fit, fit, told)
        odd = told.scatter.aside > UNEVEN * side or fit.missed > MISSED or customary != fit.grid.shift
        return told, chi_square, shift, odd

    both, chi_square, shift, odd = asked(search=scatter is None or picture is None)
    if picture is not None and scatter is not None and (odd or chi_square > CALM):
        both, chi_square, shift, odd = asked(search=True)
    doubted, unsure = odd or chi_square > DOUBT, False
    if picture is not None and doubted and _enough_lines(fit, free):
        before, tried = both.scatter.aside, list[_Told]()
        usual = replace(fit, grid=replace(fit.grid, shift=customary))
        for freed in _fits_with_free_camera(usual, picture, field):
            if _off_axis(freed) > (MOST_OFF_BENT_AXIS if freed.free.radial else MOST_OFF_AXIS):
                continue
            motion = estimate_motion(
                freed, free.mask, free.prior(freed.camera, freed.grid), both.scatter, bow=BOW, widths=False
            )
            tried.append(_Told(freed, motion, *_contradiction(given, freed, motion)))
            # A free camera that neither makes the slabs evener nor meets more joints is no better one.
            px = float(np.median(fit.profiles.px_per_unit[fit.usable]))
            evener = (
                motion.scatter.aside < _clearly_evener(fit, both.scatter)
                and both.scatter.aside * px > EVEN_PX
            )
            met = fit.missed > MISSED and freed.missed < FEWER * fit.missed
            limit = max(ROUGHER * met, SMOOTHER * evener)
            # The fewer joints it meets the smoother they must lie: few suit any camera.
            fewer = min(1.0, freed.met / max(1, fit.met))
            if freed.roughness_px < limit * fewer * fit.roughness_px:
                fit, both, chi_square, shift = tried[-1]
            elif freed.roughness_px < limit * fit.roughness_px:
                unsure |= tried[-1].chi_square >= CONTRADICTION
            # A camera that is wrong is worth the time to find the right one.
            if both.scatter.aside < 0.5 * before and chi_square < CONTRADICTION:
                break
        if chi_square >= CONTRADICTION:
            # What a camera like the given one does as well by joints that are measured anew is not its fault.
            alike = [t for t in tried if _alike(t, given) and _as_good(t, fit, both)]
            fit, both, chi_square, shift = min(
                alike, key=lambda told: told.chi_square, default=_Told(fit, both, chi_square, shift)
            )
    centre = np.array([given.camera.cx - fit.camera.cx, given.camera.cy - fit.camera.cy])
    log_focal, sigma = _focal_alone(both, given.free, centre)
    focal = fit.camera.fx * float(np.exp(log_focal))
    consistent = None if unsure and fit is given else True
    if chi_square >= CONTRADICTION:
        consistent = False
    return CameraCheck(
        consistent, focal, focal * sigma, float(shift[0]), shift[1:3], float(shift[3]), chi_square
    )


def _off_axis(fit: Fit) -> float:
    """How far the middle of the picture lies from a camera's principal point, in focal lengths."""
    camera = fit.camera
    off = np.array([camera.cx - 0.5 * (camera.width - 1), camera.cy - 0.5 * (camera.height - 1)])
    return float(np.hypot(*(off / [camera.fx, camera.fy])))


def _enough_lines(fit: Fit, free: Free) -> bool:
    """Whether a fit's joints are lines enough to try them with a camera that is free."""
    lines = len(joints_of(fit.stations.take(np.flatnonzero(fit.usable)), fit.grid)[1])
    return 2 * lines >= int(free.mask.sum()) + SPARE_NUMBERS


class _Told(NamedTuple):
    """What joints that were measured anew tell of a free camera, and how far that is from the given one."""

    fit: Fit
    motion: Estimate
    chi_square: float
    shift: Float[np.ndarray, "4"]


def _alike(told: _Told, given: Fit) -> bool:
    """Whether the joints that another camera was fitted to do not contradict the given one, which is like it.

    What a camera far off tells of its covariance there says nothing of the given one.
    """
    focal, centre_x, centre_y, _ = told.shift
    near = abs(focal) < LIKE_FOCAL and np.hypot(centre_x, centre_y) < LIKE_CENTRE * given.camera.width
    return bool(near) and told.chi_square < CONTRADICTION


def _as_good(told: _Told, fit: Fit, motion: Estimate) -> bool:
    """Whether a camera misses hardly more joints than another one's fit, which lie as near to their lines."""
    return (
        told.fit.missed < fit.missed + MISSED / 3.0
        and told.fit.roughness_px < ROUGHER * fit.roughness_px
        and told.motion.scatter.aside < ROUGHER * motion.scatter.aside
    )


def _clearly_evener(fit: Fit, scatter: Scatter) -> float:
    """Below what a scatter is clearly less than the given one, which the fit's slabs or courses told."""
    shared = fit.stations.line if scatter.course > scatter.place else fit.stations.side
    told = len(numbered(fit.stations.family[fit.usable], shared[fit.usable])[1])
    # The standard deviation of a standard deviation that n values tell, as a share of it.
    return min(EVENER, 1.0 - CLEARLY_SIGMAS / float(np.sqrt(2.0 * told))) * scatter.aside


def _focal_alone(both: Estimate, known: Free, centre: Float[np.ndarray, "2"]) -> tuple[float, float]:
    """Logarithm of the focal length's change and its sigma, with the principal point moved to `centre`.

    It is held there, or as near to it as it is known to be; a lens that is not known is estimated beside it.
    """
    C, x = both.covariance, both.parameters
    held = [terms.CENTRE_X, terms.CENTRE_Y, *(() if known.radial else (terms.RADIAL,))]
    doubt = np.zeros(len(held))
    doubt[:2] = known.centre_sigma_px**2 if known.centre else 0.0
    pull = np.linalg.solve(C[np.ix_(held, held)] + np.diag(doubt), C[held, terms.FOCAL])
    variance = C[terms.FOCAL, terms.FOCAL] - pull @ C[held, terms.FOCAL]
    held_at = np.r_[centre, np.zeros(len(held) - 2)]
    change = x[terms.FOCAL] + pull @ (held_at - x[held])
    return float(change), float(np.sqrt(max(variance, 0.0)))


def _free_camera(fit: Fit) -> Free:
    # Priors so wide that they only keep untold directions finite.
    width = float(fit.camera.width)
    return replace(
        fit.free,
        focal=True,
        centre=True,
        radial=True,
        nominal=None,
        focal_sigma=1.0,
        centre_sigma_px=width,
        radial_sigma=min(fit.free.radial_sigma, ANY_RADIAL),
    )


def _fits_with_free_camera(
    fit: Fit, picture: Float[np.ndarray, "h w"], field: Float[np.ndarray, "k 2"] | None
) -> Iterator[Fit]:
    """Fits with the focal length free, then with the principal point, then with the lens as well.

    They grow from the camera's feet outwards: however wrong the camera, near joints lie where they are looked
    for, and what they tell of the camera brings the farther ones within reach.
    """
    free = _free_camera(fit)
    pinhole = replace(free, radial=fit.free.radial)
    for growing, settling in (
        (replace(pinhole, centre=False), pinhole),
        (pinhole, pinhole),
        (free, free),
    ):
        grown = refine(
            picture,
            fit.camera,
            fit.cam_from_ground,
            fit.grid,
            free=growing,
            search=WIDE_SEARCH,
            reaches=FROM_THE_FEET,
            strip=fit.strip,
            field=field,
            most_steps=FREE_STEPS,
        )
        # Nothing can be measured near the feet of a camera that looks far ahead.
        start = grown or fit
        still = refine_until_still(
            picture,
            start.camera,
            start.cam_from_ground,
            start.grid,
            free=settling,
            search=0.0 if grown else 0.08,
            reach=12.0,
            strip=start.strip,
            field=field,
            most_steps=FREE_STEPS,
        )
        if still is not None:
            yield still


def _contradiction(asked: Fit, told: Fit, motion: Estimate) -> tuple[float, Float[np.ndarray, "4"]]:
    """Chi-square of the distance between the camera that was given for one fit and that of another's joints.

    The distance itself comes along: logarithm of the focal length, the principal point in pixels, and the
    first radial coefficient.
    """
    given, own, free = asked.free.nominal or asked.camera, told.camera, asked.free
    moved = np.array(
        [np.log(own.fx / given.fx), own.cx - given.cx, own.cy - given.cy, own.dist[0] - given.dist[0]]
    )
    asked_of = [terms.FOCAL, terms.CENTRE_X, terms.CENTRE_Y, terms.RADIAL]
    shift = motion.parameters[asked_of] + moved
    corner = 0.5 * float(np.hypot(given.width, given.height)) / given.fx
    tolerance = np.array(
        [
            FOCAL_TOLERANCE,
            CENTRE_TOLERANCE * given.width,
            CENTRE_TOLERANCE * given.width,
            LENS_TOLERANCE * given.width / (given.fx * corner**3),
        ]
    )
    known = np.array([free.focal_sigma, free.centre_sigma_px, free.centre_sigma_px, free.radial_sigma])
    tolerance = np.maximum(tolerance, np.where(np.isfinite(known), known, 0.0))
    C = motion.covariance[np.ix_(asked_of, asked_of)] + np.diag(tolerance**2)
    return float(shift @ np.linalg.solve(C, shift)), shift
