"""Which lens model? The one with all the terms that views it was not fitted to do not speak against."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from autoreg.calibration.adjustment import Adjustment, adjust, fit_poses, without_views
from autoreg.calibration.models import INTRINSICS, LENS_MODELS, LensModel, camera_of
from autoreg.calibration.observations import Data
from autoreg.calibration.precision import Precision, precision_of
from autoreg.calibration.unknowns import Freedom, State

_FOLDS = 10
# A model is refuted if it foretells held-out views worse by so many standard errors.
_REFUTED = 2.0
# Fits without a fold of the views end where a step would gain less than this part of the cost.
_GOOD_ENOUGH = 1e-5
# The part of the errors shared by a view's corners that the rational model may leave unexplained.
_SHARED = 0.5
# Less than this is rounding.
_LEAST_PX = 1e-6
# The power of the radius that multiplies each radial coefficient.
_RADIAL_POWERS = {"k1": 2, "k2": 4, "k3": 6, "k4": 2, "k5": 4, "k6": 6}


@dataclass(frozen=True)
class Trial:
    """A lens model fitted to all views, and how well it foretells views that it was not fitted to.

    Attributes:
        model: the model.
        fit: its fit to all views.
        held_out_px: per view, the RMS of its corners under the intrinsics fitted without it.
        rayless: the part of the picture that has no ray, because the distortion folds back before it.
    """

    model: LensModel
    fit: Adjustment
    held_out_px: Float[np.ndarray, " v"]
    rayless: float

    @cached_property
    def precision(self) -> Precision:
        """How well the views determine it."""
        return precision_of(self.fit)

    @property
    def folds_inside(self) -> bool:
        """Whether the distortion folds back within the picture."""
        return self.rayless > 0

    @property
    def score_px(self) -> float:
        """Root of the mean over views of the held-out mean square, counted as robustly as the fit."""
        return float(np.sqrt(np.mean(self.held_out_px**2)))


def try_models(
    data: Data, start: State, width: int, height: int, *, shape: bool = False
) -> tuple[Trial, ...]:
    """Every lens model's trial, simplest first."""
    groups = folds(data.standpoint)
    trials: list[Trial] = []
    for model in LENS_MODELS:
        state = replace(start, intrinsics=model.restricted(start.intrinsics))
        freedom = freedom_of(model, start, width, height, shape=shape)
        fit = adjust(data, state, freedom)
        if fit.spare < 2 * fit.free.sum() or fit.outcome == "diverged":
            continue
        held_out = np.zeros(len(data))
        for group in groups:
            held_out[group] = _foretold(data, fit, freedom, group)
        trials.append(Trial(model, fit, held_out, rayless(fit.state, width, height)))
    return tuple(trials)


def freedom_of(model: LensModel, near: State, width: int, height: int, *, shape: bool = False) -> Freedom:
    """What a lens model leaves free, each radial term moving the picture's corner by less than its radius.

    That is known beforehand of any lens, as a standard deviation. It decides between the rational model's
    numerators and denominators, which nearly cancel, and it holds terms that the corners do not determine.
    """
    fx, fy, cx, cy = near.intrinsics[:4]
    corner = np.hypot(max(cx, width - cx) / fx, max(cy, height - cy) / fy)
    powers = np.array([_RADIAL_POWERS.get(name, 0) for name in INTRINSICS])
    prior = np.where(powers > 0, float(corner) ** -powers.astype(float), np.inf)
    return Freedom(model.free, shape, prior)


def folds(standpoint: Int[np.ndarray, " v"]) -> tuple[Bool[np.ndarray, " v"], ...]:
    """Views held out together: each of a few, or every tenth of many, along with those that repeat them."""
    _, number = np.unique(standpoint, return_inverse=True)
    count = min(int(number.max()) + 1, _FOLDS)
    return tuple(number % count == k for k in range(count))


def rayless(state: State, width: int, height: int) -> float:
    """The part of the picture, edges included, whose pixels have no ray because the distortion folds back."""
    camera = camera_of(state.intrinsics, width, height)
    grid = np.stack(np.meshgrid(np.linspace(0, width - 1, 41), np.linspace(0, height - 1, 41)), -1)
    return float(np.isnan(camera.normalise(grid)).any(-1).mean())


def chosen(trials: tuple[Trial, ...]) -> Trial:
    """The trial with all the terms that held-out views do not speak against.

    That is the richest polynomial which does not foretell them worse than the best trial by two standard
    errors; the rational model only if every polynomial does. Of these, one that does not fold, if there is.

    Not the simplest, nor the best: both leave out terms that are too weak to show but strong enough to move
    the principal point or the focal length by more than their standard deviations, and no interval that is
    shorter than the full model's can hold its promise for every lens (Leeb and Poetscher 2005; Kabaila
    2009). A term too many costs only what the stated standard deviations say.
    """
    usable = _credible(trials) or list(trials)
    best = min(usable, key=lambda trial: trial.score_px)
    unrefuted = [trial for trial in usable if not _worse(trial, best)]
    unrefuted = [trial for trial in unrefuted if not trial.folds_inside] or unrefuted
    polynomials = [trial for trial in unrefuted if trial.model.polynomial]
    return (polynomials or unrefuted)[-1]


def choice_covariance(
    trials: tuple[Trial, ...], picked: Trial, dispersion: float
) -> Float[np.ndarray, "12 12"]:
    """What choosing a model adds to the covariance: the weighted spread of richer ones' intrinsics around it.

    Buckland, Burnham and Augustin (1997), with Akaike's weights exp(-(chi² / D² + 2 p) / 2), where chi² is by
    the scatter of the richest model. What simpler models say, the covariance of the chosen one includes.
    """
    credible = _credible(trials)
    richer = [t for t in trials if t is picked or (t in credible and _count(t) > _count(picked))]
    variance = (richer[-1].fit.sigma_px * dispersion) ** 2
    criteria = np.array(
        [
            float((t.fit.weights[..., None] * t.fit.residuals_px**2).sum()) / variance + 2 * _count(t)
            for t in richer
        ]
    )
    weights = np.exp(-(criteria - criteria.min()) / 2)
    apart = np.array([t.fit.state.intrinsics - picked.fit.state.intrinsics for t in richer])
    return np.einsum("m,mi,mj->ij", weights / weights.sum(), apart, apart)


def _count(trial: Trial) -> int:
    """Number of common unknowns of a trial."""
    return int(trial.fit.free.sum())


def _worse(trial: Trial, best: Trial) -> bool:
    """Whether a trial foretells views worse than the best, by more than two standard errors over the views.

    Views are compared by the logarithms of their mean squares, so that no single one decides.
    """
    if trial is best:
        return False
    loss = 2 * np.log(np.maximum(trial.held_out_px, _LEAST_PX) / np.maximum(best.held_out_px, _LEAST_PX))
    return bool(loss.mean() > _REFUTED * np.std(loss, ddof=1) / np.sqrt(len(loss)))


def _credible(trials: tuple[Trial, ...]) -> list[Trial]:
    """The trials that arrived at a minimum which the views determine, and whose gain can be the lens's.

    A bent sheet is the same in all views, so a flexible lens model that takes it up foretells better too.
    Where views share errors, the rational model must explain at least half of what they share.
    """
    sound = [trial for trial in trials if trial.fit.outcome == "converged" and trial.precision.determined]
    shared = [trial.precision.dispersion**2 - 1 for trial in sound if trial.model.polynomial]
    return [
        trial
        for trial in sound
        if trial.model.polynomial or not shared or trial.precision.dispersion**2 - 1 <= _SHARED * shared[-1]
    ]


def _foretold(data: Data, fit: Adjustment, freedom: Freedom, group: Bool[np.ndarray, " v"]) -> np.ndarray:
    """RMS of each view of a group when only its pose is fitted, the rest being fitted to the other views."""
    others, these = np.flatnonzero(~group), np.flatnonzero(group)
    start = without_views(fit, group)
    without = adjust(data.part(others), start.part(others), freedom, steps=8, tolerance=_GOOD_ENOUGH)
    state = State(without.state.intrinsics, fit.state.poses[these], without.state.shape)
    posed = fit_poses(data.part(these), state, steps=8, tolerance=_GOOD_ENOUGH)
    squares = (posed.weights[..., None] * posed.residuals_px**2).sum((1, 2))
    return np.sqrt(squares / posed.present.sum(1))
