"""Are the views of two cameras? Two groups of views, each of which the other group's camera does not fit."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool

from autoreg.calibration.adjustment import Adjustment, adjust, fit_poses
from autoreg.calibration.bad_views import sane_views
from autoreg.calibration.models import COUNT
from autoreg.calibration.observations import Data
from autoreg.calibration.precision import precision_of, shared_variance
from autoreg.calibration.unknowns import Freedom, State

# A group is at least so many standpoints: fewer fit a camera of their own by chance.
_LEAST_GROUP = 4
_MOST_ROUNDS = 12
# Directions of the common unknowns along which views are divided to begin with.
_DIRECTIONS = 5
_TOLERANCE = 1e-5
# Two cameras differ by so many standard deviations of their intrinsics, the views' scatter counted. The best
# division of one camera's views reaches 10; of one whose lens no polynomial describes, whose sheet is bent,
# or that focuses anew for every photo, up to 23.
_LEAST_APART = 40.0
# And they explain all but this part of the variance that the views share beyond their corners' scatter.
_MOST_LEFT = 0.25
# No other division can explain more than one that leaves less than this part.
_NOTHING_LEFT = 0.02


@dataclass(frozen=True)
class Mixture:
    """The views in two groups, each with a camera of its own.

    Attributes:
        second: which views are in the smaller group.
        cameras: the fits of the larger and of the smaller group.
        apart: by how many standard deviations the two cameras' intrinsics differ (Mahalanobis's distance).
        left: what is left of the variance that views share, as a part of that in the fit to all.
    """

    second: Bool[np.ndarray, " v"]
    cameras: tuple[Adjustment, Adjustment]
    apart: float
    left: float

    @property
    def certain(self) -> bool:
        """Whether one camera cannot have seen all views."""
        return self.apart > _LEAST_APART and self.left < _MOST_LEFT


def two_cameras(data: Data, start: State, freedom: Freedom) -> Mixture | None:
    """The views as two cameras, if one camera cannot have seen them all.

    As k-means does, this fits a camera to each of two groups and gives each view to the camera that fits it
    better, by turns, until no view changes. If the views scatter no more than their corners do, one camera
    has seen them. If they do and no division explains it, the sheet's shape is estimated as well, because a
    bent sheet hides two cameras behind errors of its own. Views of nonsense take no part, and count as of the
    larger group.

    Args:
        data: the corners of all views.
        start: first values.
        freedom: what may move besides the poses.
    """
    sane = sane_views(data, start)
    if len(sane) < 2 * _LEAST_GROUP:
        return None
    data, joint = data.part(sane), adjust(data.part(sane), start.part(sane), freedom)
    if not _contradictory(joint):
        return None
    found = _best(data, joint)
    if found is None or not found.certain:
        joint = adjust(data, joint.state, replace(freedom, shape=True))
        found = _best(data, joint) if _contradictory(joint) else None
    if found is None or not found.certain:
        return None
    second = np.zeros(len(start.poses), bool)
    second[sane] = found.second
    return replace(found, second=second)


def _best(data: Data, joint: Adjustment) -> Mixture | None:
    """The division with the smallest residuals of all that are settled on, or one that leaves nothing."""
    best: tuple[float, Mixture] | None = None
    for start in _starts(joint):
        settled = _settled(data, joint, start)
        if settled is not None and (best is None or settled[0] < best[0]):
            best = settled
            if settled[1].certain and settled[1].left < _NOTHING_LEFT:
                break
    return None if best is None else best[1]


def _starts(joint: Adjustment) -> Generator[Bool[np.ndarray, " v"]]:
    """Divisions to begin with: by the side to which views pull the joint fit, and by how badly they fit."""
    size = joint.total.diagonal()
    values, vectors = np.linalg.eigh(joint.total / np.sqrt(np.outer(size, size)))
    pulls = (joint.gradients / np.sqrt(size)) @ (vectors / np.sqrt(np.maximum(values, 1e-12)))
    along = np.linalg.svd(pulls - pulls.mean(0), full_matrices=False)[0].T[:_DIRECTIONS]
    for score in (*along, joint.view_rms_px):
        for part in (0.25, 0.5, 0.75):
            yield score > np.quantile(score, part)


def _settled(data: Data, joint: Adjustment, second: Bool[np.ndarray, " v"]) -> tuple[float, Mixture] | None:
    """The division at which no view changes its group, with its cost; None if a group becomes too small."""
    near = [joint.state, joint.state]
    for _ in range(_MOST_ROUNDS):
        members = np.flatnonzero(~second), np.flatnonzero(second)
        if any(len(np.unique(data.standpoint[group])) < _LEAST_GROUP for group in members):
            return None
        fits = [
            adjust(data.part(group), state.part(group), joint.freedom, tolerance=_TOLERANCE)
            for group, state in zip(members, near, strict=True)
        ]
        if any(fit.outcome == "diverged" for fit in fits):
            return None
        posed = [
            fit_poses(data, replace(fit.state, poses=joint.state.poses), tolerance=_TOLERANCE) for fit in fits
        ]
        near = [fit.state for fit in posed]
        rms = np.array([fit.view_rms_px for fit in posed])
        if ((rms[1] < rms[0]) == second).all():
            if second.sum() > len(second) / 2:
                second, fits = ~second, fits[::-1]
            cost = float(np.log(np.maximum(rms.min(0), 1e-6)).mean())
            return cost, _mixture(joint, second, fits[0], fits[1])
        second = rms[1] < rms[0]
    return None


def _mixture(
    joint: Adjustment, second: Bool[np.ndarray, " v"], one: Adjustment, other: Adjustment
) -> Mixture:
    precisions = precision_of(one), precision_of(other)
    free = one.free[:COUNT]
    change = (other.state.intrinsics - one.state.intrinsics)[free]
    covariance = sum((p.covariance for p in precisions), np.zeros((COUNT, COUNT)))[np.ix_(free, free)]
    unit = 1 / np.sqrt(covariance.diagonal())
    change, covariance = change * unit, covariance * np.outer(unit, unit)
    apart = float(np.sqrt(change @ np.linalg.lstsq(covariance, change, rcond=1e-12)[0]))
    left = float(np.mean([_shared(one), _shared(other)])) / max(_shared(joint), 1e-300)
    return Mixture(second, (one, other), apart, left)


def _contradictory(fit: Adjustment) -> bool:
    """Whether views contradict one another: they scatter too much, or robust fitting gave some of them up."""
    return precision_of(fit).dispersion > 1 or _discounted(fit) > fit.sigma_px**2


def _shared(fit: Adjustment) -> float:
    """The variance that a view's corners share, beyond their scatter, and what robust fitting discounted."""
    return shared_variance(fit) + _discounted(fit)


def _discounted(fit: Adjustment) -> float:
    """The variance of corners that their weights took away."""
    return float(((1 - fit.weights)[..., None] * fit.residuals_px**2).sum()) / max(fit.spare, 1)
