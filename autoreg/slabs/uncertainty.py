"""Which pose is likeliest, and how sure it is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from autoreg.errors import Refusal
from autoreg.fitting.fit import Fit
from autoreg.fitting.refine import joint_data, plausible
from autoreg.geometry import Rigid, cross_matrix
from autoreg.slabs.measured_joints import widths_told
from autoreg.slabs.slab_model import BOW, Estimate, Scatter, estimate_motion
from autoreg.solve.freedom import log_stretch
from autoreg.solve.joint_data import ANSWER, PARAMETERS, RATIO
from autoreg.solve.solver import solve_joints

# Where the camera is solved for, the likeliest pose may be so far from the fit that the Jacobian there is
# another one. What a motion leaves may be wrong by this share (RMS), else it goes on from there, so often.
STRAIGHT, MOST_MOVES = 0.03, 6
# A slab's ratio of sides that the joints' own is no more standard deviations from is the right one: those of
# nominal sizes, without the joints, are tens of them off.
TOLD_RATIO_SIGMAS = 2.0
# ... if they tell theirs this much better than what is said of a slab is known.
CONFIRMED = 0.25


@dataclass(frozen=True)
class Settled:
    """A fit at the pose that the mixed model makes likeliest.

    `spread` is the covariance of (rotation vector, translation) of a small motion on the camera's side, of
    the logarithm of the sides' ratio, and of a running bond's shift. `relieved` is how far on the ground
    joints were moved since they are no flat ones (RMS). `narrowing` is by what share of their width joints
    look narrower at a slope of one than from above, as sunk ones do.
    """

    fit: Fit
    spread: Float[np.ndarray, "8 8"]
    scatter: Scatter
    relieved: float = 0.0
    narrowing: float = 0.0

    @property
    def covariance(self) -> Float[np.ndarray, "6 6"]:
        """Covariance of the pose."""
        return self.spread[:6, :6]

    @property
    def ratio_sigma(self) -> float:
        """Standard deviation of the logarithm of the sides' ratio."""
        return float(np.sqrt(self.spread[RATIO, RATIO]))


def settle(fit: Fit, *, widths: bool = True) -> Settled:
    """The fit moved to the likeliest pose under irregular slabs, and how sure that pose is.

    The joints' `widths` have a say if that is asked for, but no more than half: whether they tell how deep
    the joints lie, or are those of bevels and of what fills the joints, is as likely as not. Where the camera
    is not known, ground that is a little bent would be taken for another one.

    Raises:
        Refusal: nothing holds the sides of the slabs, which run away to what no slab has.
    """
    estimate, moved = _likeliest(fit, widths)
    for _ in range(MOST_MOVES):
        there = relinearised(fit, moved)
        wrong = _rms((there.distances_px - moved.distances_px)[fit.usable])
        if not np.isfinite(wrong) or wrong < STRAIGHT * _rms(moved.distances_px[fit.usable]):
            break
        fit = there
        estimate, moved = _likeliest(fit, widths)
    spread = on_camera_side(estimate.covariance, moved.cam_from_ground)
    by_relief = (fit.moves_px(estimate.by_relief) / fit.profiles.px_per_unit)[fit.usable]
    return Settled(moved, spread, estimate.scatter, _rms(by_relief))


def _likeliest(fit: Fit, widths: bool) -> tuple[Estimate, Fit]:
    """The likeliest motion of what a fit solves for, and the fit moved by it."""
    # A camera that is solved for follows the joints: what drifts would leave it free to go astray.
    bow, drifts = (BOW, False) if fit.free.focal else (0.0, True)
    prior = fit.free.prior(fit.camera, fit.grid)
    estimate = estimate_motion(fit, fit.free.mask, prior, bow=bow, widths=widths, drifts=drifts)
    if widths and widths_told(fit):
        alone = estimate_motion(fit, fit.free.mask, prior, bow=bow, widths=False, drifts=drifts)
        estimate = _either(estimate, alone)
    held = _with_told_ratio(fit, estimate)
    moved = fit.moved((held or estimate).parameters)
    if not plausible(moved.cam_from_ground, moved.grid):
        raise Refusal(
            "no_lattice",
            "the joints that were measured do not hold the sides of slabs to what a slab may have; take a "
            "photo in which two or more rows of slabs and their cross joints are clearly seen",
        )
    return (estimate, moved) if held is None else (held, replace(moved, free=replace(fit.free, ratio=False)))


def _either(told: Estimate, alone: Estimate) -> Estimate:
    """The mean of two estimates that are as likely as each other, and how sure that is: of both, and between.

    Its scatter, and what the relief moves, are those of the first, by the joints' widths.
    """
    apart = 0.5 * (told.parameters - alone.parameters)
    return replace(
        told,
        parameters=0.5 * (told.parameters + alone.parameters),
        covariance=0.5 * (told.covariance + alone.covariance) + np.outer(apart, apart),
    )


def _with_told_ratio(fit: Fit, estimate: Estimate) -> Estimate | None:
    """An estimate with the sides in the ratio that was told, if the joints cannot tell theirs from it."""
    a, b, slab = fit.grid.spacing_x, fit.grid.spacing_y, fit.free.slab
    if a is None or slab is None or not fit.free.ratio:
        return None
    off = log_stretch(a, b, slab) + float(estimate.parameters[RATIO])
    variance = float(estimate.covariance[RATIO, RATIO])
    sigma = float(np.sqrt(variance))
    if abs(off) > TOLD_RATIO_SIGMAS * sigma or sigma > CONFIRMED * fit.free.ratio_sigma:
        return None
    # Of normal values, one of which is known, the others' mean and covariance.
    gain = estimate.covariance[RATIO] / variance
    return replace(
        estimate,
        parameters=estimate.parameters - off * gain,
        by_relief=estimate.by_relief - estimate.by_relief[RATIO] * gain,
        covariance=estimate.covariance - variance * np.outer(gain, gain),
    )


def relinearised(fit: Fit, moved: Fit) -> Fit:
    """A fit where it was moved to, with the distances and the Jacobian there; its joints stay as measured."""
    # The stations are where the lattice was before the fit's own solve stretched it.
    by_solve = np.exp(0.5 * fit.solution.parameters[RATIO] * np.array([1.0, -1.0]))
    ground = moved.stations.ground * by_solve * moved.grid.stretch_from(fit.grid)
    stations = replace(moved.stations, ground=ground)
    data = joint_data(
        moved.camera, moved.cam_from_ground, stations, moved.profiles, moved.offsets, moved.sigma_px,
        moved.usable,
    )  # fmt: skip
    here = solve_joints(data, np.zeros(PARAMETERS))
    return replace(moved, stations=stations, distances_px=here.distances_px, solution=here)


def _rms(values: Float[np.ndarray, " n"]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def on_camera_side(covariance: Float[np.ndarray, "m m"], pose: Rigid) -> Float[np.ndarray, "8 8"]:
    """The part that is asked for, with the pose's translation turned as well: exp(w) t0 + dt."""
    A = np.eye(len(ANSWER))
    A[3:6, :3] = -cross_matrix(pose.t)
    C = A @ covariance[np.ix_(ANSWER, ANSWER)] @ A.T
    return 0.5 * (C + C.T)
