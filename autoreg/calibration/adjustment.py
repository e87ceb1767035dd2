"""Bundle adjustment: one camera, a pose per view and, if asked, a bent sheet, that explain all corners."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from autoreg.calibration.models import COUNT
from autoreg.calibration.normal_equations import POSE, NormalEquations, Problem
from autoreg.calibration.observations import Data
from autoreg.calibration.unknowns import Freedom, State

_MOST_STEPS = 60
# A step that would lower the cost by less than this part has arrived: it is about a hundredth of a sigma.
_CONVERGED = 1e-8
# The scale of Huber's weights is estimated anew where the residuals' own has moved by this part.
_SCALE_MOVES = 0.05

Outcome = Literal["converged", "stalled", "diverged"]


@dataclass(frozen=True)
class Adjustment:
    """Where an adjustment ended.

    Attributes:
        outcome: converged; stalled: the steps were used up; diverged: the start has no finite cost.
        state: the unknowns.
        residuals_px: measured minus projected, 0 where a view has no such corner.
        present: which of them are corners.
        standpoint: a number for each view; views that repeat one another share it.
        weights: by which robust fitting counted each corner, at most 1.
        information: each view's matrix for the free common unknowns, poses eliminated, in pixels^-2.
        gradients: each view's part of the gradient there, likewise.
        prior: what was known beforehand of each free common unknown, likewise.
        free: which common unknowns were free: first the intrinsics, then the sheet's.
        freedom: what was free.
    """

    outcome: Outcome
    state: State
    residuals_px: Float[np.ndarray, "v n 2"]
    present: Bool[np.ndarray, "v n"]
    standpoint: Int[np.ndarray, " v"]
    weights: Float[np.ndarray, "v n"]
    information: Float[np.ndarray, "v f f"]
    gradients: Float[np.ndarray, "v f"]
    prior: Float[np.ndarray, " f"]
    free: Bool[np.ndarray, " c"]
    freedom: Freedom

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.present)

    @cached_property
    def total(self) -> Float[np.ndarray, "f f"]:
        """The information of all views, and what was known beforehand, on the free common unknowns."""
        return self.information.sum(0) + np.diag(self.prior)

    @cached_property
    def spare(self) -> int:
        """Measured coordinates beyond the number of unknowns."""
        return int(2 * self.present.sum() - POSE * self.views - self.free.sum())

    @cached_property
    def sigma_px(self) -> float:
        """Standard deviation of a corner's coordinate, estimated from what is left over."""
        left = float((self.weights[..., None] * self.residuals_px**2).sum())
        return float(np.sqrt(left / max(self.spare, 1)))

    @cached_property
    def view_rms_px(self) -> Float[np.ndarray, " v"]:
        """Root mean square of the distances between measured and projected corners, per view."""
        squares = (self.residuals_px**2).sum(-1)
        return np.sqrt(squares.sum(1) / self.present.sum(1))

    @cached_property
    def rms_px(self) -> float:
        """OpenCV's RMS: the root mean square distance over all corners of all views."""
        return float(np.sqrt((self.residuals_px**2).sum() / self.present.sum()))

    @cached_property
    def mean_l2_over_n_px(self) -> float:
        """The mean over views of |residuals|_2 / N, which OpenCV's tutorial calls the mean error.

        It shrinks with the number N of corners: it is about RMS / sqrt(N), and no distance in the picture.
        """
        counts = self.present.sum(1)
        return float(np.mean(np.sqrt((self.residuals_px**2).sum((1, 2))) / counts))


def adjust(
    data: Data,
    start: State,
    freedom: Freedom,
    *,
    steps: int = _MOST_STEPS,
    tolerance: float = _CONVERGED,
) -> Adjustment:
    """The adjustment that lays the projected corners on the measured ones, by Levenberg and Marquardt.

    The residuals are counted by Huber's weights, their scale being estimated from the median.

    Args:
        data: the corners.
        start: first values; good to a part of the picture's size.
        freedom: what may move besides the poses.
        steps: at most so many steps.
        tolerance: a step that would lower the cost by less than this part of it is the last.
    """
    problem = Problem(data, freedom)
    state = start
    linear = problem.linearise(state)
    damping, outcome = 1e-4, "stalled"
    if not np.isfinite(linear.cost):
        return _ended("diverged", problem, state, linear)
    for _ in range(steps):
        step, promised = linear.step(damping)
        if promised <= tolerance * linear.cost + 1e-14:
            outcome = "converged"
            break
        tried_state = problem.moved(state, step)
        tried = problem.linearise(tried_state, linear.scale_px)
        if np.isfinite(tried.cost) and tried.cost < linear.cost:
            state, damping = tried_state, max(damping / 10, 1e-12)
            linear = tried
            # The scale follows the residuals down, after which costs are counted anew.
            if abs(tried.own_scale_px / tried.scale_px - 1) > _SCALE_MOVES:
                linear = problem.linearise(state)
        else:
            damping *= 10
            if damping > 1e8:
                outcome = "converged"  # what is left to gain is rounding
                break
    return _ended(outcome, problem, state, linear)


def fit_poses(data: Data, state: State, *, steps: int = 12, tolerance: float = _CONVERGED) -> Adjustment:
    """The adjustment of the poses alone, intrinsics and shape as they are."""
    return adjust(data, state, Freedom(np.zeros(COUNT, bool)), steps=steps, tolerance=tolerance)


def without_views(fit: Adjustment, group: Bool[np.ndarray, " v"]) -> State:
    """The state to first order that the fit would have had without some views; their poses stay as they are.

    Their gradients g are what the others' no longer balance: the step is (S - S_group)^-1 g.
    """
    information, gradient = fit.total - fit.information[group].sum(0), fit.gradients[group].sum(0)
    size = information.diagonal()
    unit = 1 / np.sqrt(np.where(size > 0, size, 1.0))
    common = np.zeros(len(fit.free))
    common[fit.free] = (
        unit * np.linalg.lstsq(information * unit[:, None] * unit, unit * gradient, rcond=1e-12)[0]
    )
    shape = fit.state.shape
    if len(common) > COUNT:
        shape = shape + common[COUNT:]
    return State(fit.state.intrinsics + common[:COUNT], fit.state.poses, shape)


def _ended(outcome: Outcome, problem: Problem, state: State, linear: NormalEquations) -> Adjustment:
    """The adjustment that ends at a state."""
    information, gradients, _ = linear.reduced()
    return Adjustment(
        outcome=outcome,
        state=state,
        residuals_px=-linear.residuals,
        present=problem.data.present,
        standpoint=problem.data.standpoint,
        weights=linear.weights,
        information=information,
        gradients=gradients,
        prior=linear.prior,
        free=problem.free,
        freedom=problem.freedom,
    )
