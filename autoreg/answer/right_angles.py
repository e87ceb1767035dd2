"""The focal length that right angles tell where only rows are seen, and how sure it and the pose are.

Unbroken joints at an even spacing tell the horizon and their own vanishing point, but no focal length: with
another one f' the ground that they lie on is sheared along them. Their cross joints are at right angles to
them at the true one f alone. At another one all of them are off square alike, by

    cos(pitch)^2 sin(2 heading) log(f' / f),    heading: that of the view, from the direction of the rows,

so that rows which run away from the camera or across the view, and a camera that looks steeply down, tell
nothing of it. The principal point acts likewise. Pose, lens and camera are estimated together, linearly and
again until all is still: the unbroken joints tell the pose and the lens at a given camera, and the cross
joints' angles are measurements that are added to it (a Kalman filter's update).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from autoreg.fitting.fit import Fit
from autoreg.fitting.refine import refine_until_still
from autoreg.ground.directions import LAYING_SPREAD_RAD
from autoreg.ground.points import on_ground, project_ground
from autoreg.rows.cross_joints import FEWEST_JOINTS, OffSquare, off_angle, off_square
from autoreg.segments import Segments
from autoreg.slabs.slab_model import Scatter, estimate_motion
from autoreg.slabs.uncertainty import Settled, on_camera_side
from autoreg.solve import joint_data as terms
from autoreg.solve.freedom import Free, moved_camera, moved_pose
from autoreg.solve.solver import CAUCHY_SIGMAS, Prior

# Cross joints are off square by less than this before the focal length is known.
WITHIN_RAD = np.radians(6.0)
# What the cross joints share, as a standard deviation: slabs of one make may all be off square, and EN 1339
# allows diagonals that differ by 3 mm, which is 4 mrad in slabs of half a metre.
SHARED_RAD = 0.003
# The scatter of the cross joints, in variance, against what segments and slabs usually have, is no less.
LEAST_SCATTER = 0.01
# Median of the square of a standard normal variable.
MEDIAN_SQUARE = 0.455
# The answer is found when measuring again changes it by less than this part of its standard deviation. A
# step that changes the focal length's logarithm by more is cut short: it is none of a linear problem.
STILL, MOST_STEP, MOST_ROUNDS, REWEIGHTINGS = 0.5, 0.15, 8, 12
# Half width of the search for joints after a step, in widths of a row.
SEARCH = 0.04

# What the unbroken joints tell, and what they do not, in the order of the estimate.
_TOLD = (0, 1, 2, 3, 4, 5, terms.RADIAL)
_CAMERA = (
    terms.FOCAL,
    terms.CENTRE_X,
    terms.CENTRE_Y,
    terms.ASPECT,
    terms.SECOND_RADIAL,
    terms.TANGENTIAL_X,
    terms.TANGENTIAL_Y,
)
_ALL = (*_TOLD, *_CAMERA)
_K = len(_TOLD)


@dataclass(frozen=True)
class Squared:
    """A fit of rows whose cross joints are square.

    `sigma_log_focal` is the standard deviation of the logarithm of its focal length; `crossing` is where the
    cross joint nearest to the middle of all meets an unbroken one.
    """

    settled: Settled
    sigma_log_focal: float
    crossing: Float[np.ndarray, "2"]


@dataclass(frozen=True)
class _Step:
    """The likeliest small motion of all parameters, with its covariance."""

    parameters: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    scatter: Scatter
    crossing: Float[np.ndarray, "2"]


@dataclass(frozen=True)
class _Angles:
    """How far each cross joint is off square, the variance of that, and its derivatives.

    `crossing` is the place of the one that the frame starts from, `along` the derivatives of its x.
    """

    angle: Float[np.ndarray, " n"]
    variance: Float[np.ndarray, " n"]
    slopes: Float[np.ndarray, "n b"]
    crossing: Float[np.ndarray, "2"]
    along: Float[np.ndarray, " b"]


def square_up(
    picture: Float[np.ndarray, "h w"],
    fit: Fit,
    segments: Segments,
    field: Float[np.ndarray, "k 2"],
    known: Free,
    reach: float,
) -> Squared | None:
    """The fit moved, camera and all, to where its cross joints are square; None where they do not lead there.

    Args:
        picture: grey levels.
        fit: rows, measured with a camera that is about right.
        segments: those of the photo.
        field: where on the fit's ground the paving is, a convex polygon that the photo shows.
        known: what is known of the camera beforehand.
        reach: how far joints are measured, in camera heights.
    """
    field_px = project_ground(fit.camera, fit.cam_from_ground, field)
    before = np.inf
    for _ in range(MOST_ROUNDS):
        field = on_ground(field_px, fit.camera, fit.cam_from_ground)
        step = _step(fit, segments, field, known)
        if step is None:
            return None
        sigma = float(np.sqrt(step.covariance[terms.FOCAL, terms.FOCAL]))
        change = float(step.parameters[terms.FOCAL])
        answer = float(np.log(fit.camera.fx)) + change
        if abs(answer - before) < STILL * sigma:
            moved = fit.moved(step.parameters)
            covariance = on_camera_side(step.covariance, moved.cam_from_ground)
            return Squared(Settled(moved, covariance, step.scatter), sigma, step.crossing)
        cut = min(1.0, MOST_STEP / max(abs(change), MOST_STEP))
        before = answer if cut == 1.0 else np.inf
        moved = fit.moved(cut * step.parameters)
        again = refine_until_still(
            picture, moved.camera, moved.cam_from_ground, fit.grid,
            free=fit.free, search=SEARCH, reach=reach, strip=replace(fit.strip, polarity_known=True),
            field=on_ground(field_px, moved.camera, moved.cam_from_ground),
        )  # fmt: skip
        if again is None:
            return None
        fit = again
    return None


def _step(fit: Fit, segments: Segments, field: Float[np.ndarray, "k 2"], known: Free) -> _Step | None:
    """The step to the likeliest pose, lens and camera; None where there are too few cross joints."""
    seen = off_square(segments, fit, field, WITHIN_RAD)
    if len(np.unique(seen.joint)) < FEWEST_JOINTS:
        return None
    angles = _angles(seen, fit)
    mean, spread, scatter = _by_rows(fit, known, angles.along)
    # The crossing is where it is seen, to half a joint's width.
    H = np.vstack([angles.slopes, angles.along])
    at_crossing = (0.5 * fit.strip.width[0]) ** 2
    offset = np.r_[angles.angle, -angles.along @ mean]
    shared = np.zeros((len(H), len(H)))
    shared[:-1, :-1] = SHARED_RAD**2
    x, covariance = mean, spread
    weight, size = np.ones(len(angles.angle)), 1.0
    for _ in range(REWEIGHTINGS):
        R = np.diag(np.r_[size * angles.variance / weight, at_crossing]) + shared
        gain = np.linalg.solve(H @ spread @ H.T + R, H @ spread).T
        x = mean - gain @ (offset + H @ mean)
        kept = np.eye(len(spread)) - gain @ H
        covariance = kept @ spread @ kept.T + gain @ R @ gain.T
        left = angles.angle + angles.slopes @ x
        left -= np.average(left, weights=weight / angles.variance)
        squares = left**2 / angles.variance
        size = max(float(np.median(squares)) / MEDIAN_SQUARE, LEAST_SCATTER)
        weight = 1.0 / (1.0 + squares / (CAUCHY_SIGMAS**2 * size))
    parameters, whole = np.zeros(terms.MOTION), np.zeros((terms.MOTION, terms.MOTION))
    parameters[list(_ALL)] = x
    whole[np.ix_(_ALL, _ALL)] = covariance
    return _Step(parameters, whole, scatter, angles.crossing)


def _by_rows(
    fit: Fit, known: Free, along: Float[np.ndarray, " b"]
) -> tuple[Float[np.ndarray, " b"], Float[np.ndarray, "b b"], Scatter]:
    """What the unbroken joints and the camera's prior tell: mean, covariance, and the slabs' scatter.

    The normal equations of all of it at once would be singular but for the prior. So pose and lens are
    solved for with the camera as it is, and follow its changes such that the joints stay in the picture.
    """
    prior = known.prior(fit.camera)
    mask, sigma = np.zeros(terms.PARAMETERS), prior.sigma.copy()
    mask[list(_TOLD)] = 1.0
    # Along the joints nothing holds the pose: within about a camera's height it may be anywhere.
    sigma[terms.ROTATION], sigma[terms.TRANSLATION] = 1.0, float(fit.cam_from_ground.origin_in_a[2])
    rows = estimate_motion(fit, mask, Prior(prior.mean, sigma))
    own, own_spread = rows.parameters[list(_TOLD)], rows.covariance[np.ix_(_TOLD, _TOLD)]
    J = fit.solution.jacobian * (np.sqrt(fit.weight) / fit.sigma_px)[:, None]
    unit = 1.0 / np.linalg.norm(J[:, _TOLD], axis=0)
    follows = -unit[:, None] * np.linalg.lstsq(J[:, _TOLD] * unit, J[:, _CAMERA], rcond=1e-5)[0]
    # ... and the crossing as well: where nothing is told of its x, this must not tell of the camera.
    sideways = np.zeros(_K)
    sideways[terms.TRANSLATION] = fit.cam_from_ground.R[:, 0]
    follows -= np.outer(sideways, along[:_K] @ follows + along[_K:]) / (along[:_K] @ sideways)
    camera, free = prior.mean[list(_CAMERA)], known.mask[list(_CAMERA)] > 0
    camera_spread = np.diag(np.where(free, prior.sigma[list(_CAMERA)], 0.0) ** 2)
    both = follows @ camera_spread
    spread = np.block([[own_spread + both @ follows.T, both], [both.T, camera_spread]])
    return np.r_[own + follows @ camera, camera], spread, rows.scatter


def _angles(seen: OffSquare, fit: Fit) -> _Angles:
    """The mean angle of each joint's segments: a joint's edges share how it is laid, but not their noise."""
    share = np.zeros((int(seen.joint.max()) + 1, len(seen)))
    share[seen.joint, np.arange(len(seen))] = 1.0 / seen.noise**2
    told = share.sum(1)
    share /= told[:, None]
    middle = share @ seen.middle
    chosen = int(np.linalg.norm(middle - np.median(middle, axis=0), axis=1).argmin())
    across = fit.grid.spacing_y
    crossing = np.array([middle[chosen, 0], round(middle[chosen, 1] / across) * across])
    by_angle, by_place = _slopes(seen, fit)
    return _Angles(
        angle=share @ seen.angle,
        variance=1.0 / told + LAYING_SPREAD_RAD**2,
        slopes=share @ by_angle,
        crossing=crossing,
        along=share[chosen] @ by_place,
    )


def _slopes(seen: OffSquare, fit: Fit) -> tuple[Float[np.ndarray, "n b"], Float[np.ndarray, "n b"]]:
    """Derivatives of the segments' angles, and of the x of their middles, by pose, lens and camera.

    They are those of square segments at the same places. With the ones that are seen, their scatter would
    look like evidence for whatever narrows the ground.
    """
    square = on_ground(seen.ends_px, fit.camera, fit.cam_from_ground)
    square[..., 0] = seen.middle[:, :1]
    ends_px = project_ground(fit.camera, fit.cam_from_ground, square)
    angles, places = np.zeros((2, len(seen), len(_ALL)))
    step_sizes = 1e-4 * terms.parameter_scale(1.0, fit.camera.fx)
    for column, k in enumerate(_ALL):
        little = step_sizes[k]
        for sign in (1.0, -1.0):
            parameters = np.zeros(terms.PARAMETERS)
            parameters[k] = sign * little
            step = replace(fit.solution, parameters=parameters)
            ground = on_ground(ends_px, moved_camera(fit.camera, step), moved_pose(fit.cam_from_ground, step))
            angles[:, column] += sign * off_angle(ground) / (2 * little)
            places[:, column] += sign * ground.mean(1)[:, 0] / (2 * little)
    return angles, places
