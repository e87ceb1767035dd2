"""Which lens model? The one that foretells views best that it was not fitted to."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from autoreg.calibration.adjustment import Adjustment, adjust, fit_poses, without_views
from autoreg.calibration.models import COUNT, LENS_MODELS, LensModel, camera_of
from autoreg.calibration.observations import Data
from autoreg.calibration.precision import precision_of
from autoreg.calibration.unknowns import Freedom, State

_FOLDS = 10
_RATIONAL_ERRORS = 2.0


@dataclass(frozen=True)
class Trial:
    """A lens model fitted to all views, and how well it foretells views that it was not fitted to.

    Attributes:
        model: the model.
        fit: its fit to all views.
        held_out_px: per view, the RMS of its corners under the intrinsics fitted without it.
        folds_inside: whether its distortion folds back within the picture, so that it cannot be used.
    """

    model: LensModel
    fit: Adjustment
    held_out_px: Float[np.ndarray, " v"]
    folds_inside: bool

    @property
    def score_px(self) -> float:
        """Root of the mean over views of the held-out mean square, counted as robustly as the fit."""
        return float(np.sqrt(np.mean(self.held_out_px**2)))


def try_models(
    data: Data, start: State, width: int, height: int, *, shape: bool = False
) -> tuple[Trial, ...]:
    """Every lens model's trial, simplest first."""
    groups = folds(len(data))
    trials: list[Trial] = []
    for model in LENS_MODELS:
        state = replace(start, intrinsics=model.restricted(start.intrinsics))
        freedom = Freedom(model.free, shape=shape)
        fit = adjust(data, state, freedom)
        if fit.spare < 2 * fit.free.sum() or fit.outcome == "diverged":
            continue
        held_out = np.zeros(len(data))
        for group in groups:
            held_out[group] = _foretold(data, fit, freedom, group)
        trials.append(Trial(model, fit, held_out, folds_inside(fit.state, width, height)))
    return tuple(trials)


def folds(count: int) -> tuple[Bool[np.ndarray, " v"], ...]:
    """Views held out together: each of a few, or every tenth of many."""
    which = np.arange(count) % min(count, _FOLDS)
    return tuple(which == k for k in range(min(count, _FOLDS)))


def folds_inside(state: State, width: int, height: int) -> bool:
    """Whether a pixel of the picture has no ray, because the distortion folds back before it."""
    camera = camera_of(state.intrinsics, width, height)
    u, v = np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 33)
    outline = np.concatenate(
        [np.column_stack([u, 0 * u + e]) for e in (0, height - 1)]
        + [np.column_stack([0 * v + e, v]) for e in (0, width - 1)]
    )
    return bool(np.isnan(camera.normalise(outline)).any())


def chosen(trials: tuple[Trial, ...]) -> Trial:
    """The trial whose model foretells held-out views best.

    Not the simplest within a standard error of it, as is often done: a term left out moves the principal
    point and the focal length by more than it adds to their standard deviations. Only the rational model,
    whose numerator and denominator nearly cancel in most lenses, must gain two standard errors.
    """
    usable = [trial for trial in trials if not trial.folds_inside and _determined(trial)] or list(trials)
    simpler = [trial for trial in usable if "k4" not in trial.model.coefficients] or usable
    best = min(simpler, key=lambda trial: trial.score_px)
    rational = [trial for trial in usable if "k4" in trial.model.coefficients and trial is not best]
    return next((trial for trial in rational if _worse(best, trial, _RATIONAL_ERRORS)), best)


def choice_covariance(
    trials: tuple[Trial, ...], picked: Trial, dispersion: float
) -> Float[np.ndarray, "12 12"]:
    """What choosing a model adds to the covariance: the weighted spread of the others' intrinsics around it.

    Buckland, Burnham and Augustin (1997), with Akaike's weights exp(-(chi² / D² + 2 p) / 2), where chi² is by
    the scatter of the richest model. An interval that knows nothing of the choice is too small.
    """
    usable = [trial for trial in trials if not trial.folds_inside and _determined(trial)]
    usable = [trial for trial in usable if "k4" not in trial.model.coefficients or trial is picked]
    if picked not in usable:
        return np.zeros((COUNT, COUNT))
    variance = (usable[-1].fit.sigma_px * dispersion) ** 2
    fits = [trial.fit for trial in usable]
    criteria = np.array(
        [
            float((fit.weights[..., None] * fit.residuals_px**2).sum()) / variance + 2 * int(fit.free.sum())
            for fit in fits
        ]
    )
    weights = np.exp(-(criteria - criteria.min()) / 2)
    apart = np.array([fit.state.intrinsics - picked.fit.state.intrinsics for fit in fits])
    return np.einsum("m,mi,mj->ij", weights / weights.sum(), apart, apart)


def _worse(trial: Trial, other: Trial, errors: float) -> bool:
    """Whether a trial foretells views worse than another, by more than so many standard errors."""
    loss = trial.held_out_px**2 - other.held_out_px**2
    return bool(loss.mean() > errors * np.std(loss, ddof=1) / np.sqrt(len(loss)))


def _determined(trial: Trial) -> bool:
    """Whether the fit arrived at a minimum that the views determine."""
    return trial.fit.outcome == "converged" and precision_of(trial.fit).determined


def _foretold(data: Data, fit: Adjustment, freedom: Freedom, group: Bool[np.ndarray, " v"]) -> np.ndarray:
    """RMS of each view of a group when only its pose is fitted, the rest being fitted to the other views."""
    others, these = np.flatnonzero(~group), np.flatnonzero(group)
    start = without_views(fit, group)
    without = adjust(data.part(others), start.part(others), freedom, steps=8)
    state = State(without.state.intrinsics, fit.state.poses[these], without.state.shape)
    posed = fit_poses(data.part(these), state, steps=8)
    squares = (posed.weights[..., None] * posed.residuals_px**2).sum((1, 2))
    return np.sqrt(squares / posed.present.sum(1))
