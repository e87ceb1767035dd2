"""Bundle adjustment: one camera, one pose per view and, if asked, one bent sheet, that explain all corners.

The unknowns common to all views are the intrinsics and the sheet's shape; each view has a pose of its own,
which is eliminated (the Schur complement), so a view counts through a small matrix and vector of its own.
Sums of these give the covariance, the fit without a view, and the fit to a part of the views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from autoreg.calibration.board import Board, BoardView
from autoreg.calibration.models import COUNT, Intrinsics

# Corners further off than this many standard deviations pull with a constant force only (Huber).
_HUBER_SIGMAS = 3.5
_MOST_STEPS = 60
# A step that would lower the cost by less than this part has arrived: it is about a hundredth of a sigma.
_CONVERGED = 1e-8
# The scale of Huber's weights is estimated anew where the residuals' own has moved by this part.
_SCALE_MOVES = 0.05
_POSE = 6

Outcome = Literal["converged", "stalled", "diverged"]


@dataclass(frozen=True)
class Data:
    """The corners of all views, padded to the same number per view; padding has weight 0.

    Attributes:
        names: the views' names.
        places: the corners' places on the flat sheet.
        basis: heights of the corners per unit of each way in which the sheet may be bent.
        px: where the corners were measured.
        present: which entries are corners.
        ids: which of the board's corners they are.
    """

    names: tuple[str, ...]
    places: Float[np.ndarray, "v n 3"]
    basis: Float[np.ndarray, "v n s"]
    px: Float[np.ndarray, "v n 2"]
    present: Bool[np.ndarray, "v n"]
    ids: Int[np.ndarray, "v n"]

    def __len__(self) -> int:
        return len(self.names)

    def part(self, which: Sequence[int] | np.ndarray) -> Data:
        """The data of some views."""
        which = np.asarray(which, int)
        names = tuple(self.names[i] for i in which)
        arrays = (self.places, self.basis, self.px, self.present, self.ids)
        return Data(names, *(array[which] for array in arrays))


@dataclass(frozen=True)
class State:
    """Values of the unknowns: intrinsics, poses as (rotation vector, translation), the sheet's bend."""

    intrinsics: Intrinsics
    poses: Float[np.ndarray, "v 6"]
    shape: Float[np.ndarray, " s"]

    @property
    def normals(self) -> Float[np.ndarray, "v 3"]:
        """Normal of each view's board, in the camera's axes."""
        return np.array([np.asarray(cv2.Rodrigues(pose[:3])[0])[:, 2] for pose in self.poses])

    def part(self, which: Sequence[int] | np.ndarray) -> State:
        """The state of some views."""
        return replace(self, poses=self.poses[np.asarray(which, int)])


@dataclass(frozen=True)
class Freedom:
    """Which of the common unknowns may move.

    Attributes:
        intrinsics: which of the intrinsics.
        shape: whether the sheet may be bent, the same in every view.
    """

    intrinsics: Bool[np.ndarray, "12"]
    shape: bool = False


@dataclass(frozen=True)
class Adjustment:
    """Where an adjustment ended.

    Attributes:
        outcome: converged; stalled: the steps were used up; diverged: the start has no finite cost.
        state: the unknowns.
        residuals_px: measured minus projected, 0 where a view has no such corner.
        present: which of them are corners.
        weights: by which robust fitting counted each corner, at most 1.
        information: each view's matrix for the free common unknowns, poses eliminated, in pixels^-2.
        gradients: each view's part of the gradient there, likewise.
        free: which common unknowns were free: first the intrinsics, then the sheet's.
    """

    outcome: Outcome
    state: State
    residuals_px: Float[np.ndarray, "v n 2"]
    present: Bool[np.ndarray, "v n"]
    weights: Float[np.ndarray, "v n"]
    information: Float[np.ndarray, "v f f"]
    gradients: Float[np.ndarray, "v f"]
    free: Bool[np.ndarray, " c"]

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.present)

    @cached_property
    def spare(self) -> int:
        """Measured coordinates beyond the number of unknowns."""
        return int(2 * self.present.sum() - _POSE * self.views - self.free.sum())

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


def data_of(views: Sequence[BoardView], board: Board) -> Data:
    """The adjustment's data of views of a board."""
    most = max(len(view.ids) for view in views)
    count = len(views)
    ids = np.zeros((count, most), int)
    px = np.zeros((count, most, 2))
    present = np.zeros((count, most), bool)
    for k, view in enumerate(views):
        n = len(view.ids)
        ids[k, :n], px[k, :n], present[k, :n] = view.ids, view.corners_px, True
        ids[k, n:] = view.ids[0]
    basis = bending(board, np.unique(ids))
    names = tuple(view.name for view in views)
    return Data(names, board.points[ids], basis[ids], px, present, ids)


def bending(board: Board, seen: Int[np.ndarray, " n"]) -> Float[np.ndarray, "corners s"]:
    """Heights of the board's corners in every independent way of being off one plane, of unit length each.

    A height at each corner, less what moving and tilting the sheet does. Corners that no view shows stay.
    """
    plane = np.column_stack([np.ones(len(seen)), board.centred[seen]])
    complement = np.linalg.qr(plane, mode="complete")[0][:, plane.shape[1] :]
    basis = np.zeros((board.corners, complement.shape[1]))
    basis[seen] = board.square * complement
    return basis


def adjust(data: Data, start: State, freedom: Freedom, *, steps: int = _MOST_STEPS) -> Adjustment:
    """The adjustment that lays the projected corners on the measured ones, by Levenberg and Marquardt.

    The residuals are counted by Huber's weights, their scale being estimated from the median.

    Args:
        data: the corners.
        start: first values; good to a part of the picture's size.
        freedom: what may move besides the poses.
        steps: at most so many steps.
    """
    problem = _Problem(data, freedom)
    state = start
    linear = problem.linearise(state)
    damping, outcome = 1e-4, "stalled"
    if not np.isfinite(linear.cost):
        return problem.answer("diverged", state, linear)
    for _ in range(steps):
        step, promised = linear.step(damping)
        if promised <= _CONVERGED * linear.cost + 1e-14:
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
    return problem.answer(outcome, state, linear)


def fit_poses(data: Data, state: State, *, steps: int = 12) -> Adjustment:
    """The adjustment of the poses alone, intrinsics and shape as they are."""
    return adjust(data, state, Freedom(np.zeros(COUNT, bool)), steps=steps)


def without_views(fit: Adjustment, group: Bool[np.ndarray, " v"]) -> State:
    """The state to first order that the fit would have had without some views; their poses stay as they are.

    Their gradients g are what the others' no longer balance: the step is (S - S_group)^-1 g.
    """
    information, gradient = fit.information[~group].sum(0), fit.gradients[group].sum(0)
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


@dataclass(frozen=True)
class _Linear:
    """The problem at one state: cost, normal matrices of each view, and what they came from."""

    cost: float
    scale_px: float
    own_scale_px: float
    residuals: np.ndarray
    weights: np.ndarray
    Hcc: np.ndarray
    Hcp: np.ndarray
    Hpp: np.ndarray
    gc: np.ndarray
    gp: np.ndarray

    def reduced(self, damping: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Each view's information and gradient with its pose eliminated, and the eliminating matrix."""
        diagonal = np.einsum("vii->vi", self.Hpp)
        Hpp = self.Hpp + (damping + 1e-13) * diagonal[:, :, None] * np.eye(self.Hpp.shape[-1])
        eliminate = np.linalg.solve(
            Hpp, np.concatenate([self.Hcp.transpose(0, 2, 1), self.gp[..., None]], -1)
        )
        from_common, from_own = eliminate[..., :-1], eliminate[..., -1:]
        return (
            self.Hcc - self.Hcp @ from_common,
            self.gc - (self.Hcp @ from_own)[..., 0],
            eliminate,
        )

    def step(self, damping: float) -> tuple[tuple[np.ndarray, np.ndarray], float]:
        """The damped step of common and own unknowns, and the decrease of the cost that it promises."""
        information, gradients, eliminate = self.reduced(damping)
        total, gradient = information.sum(0), gradients.sum(0)
        size = self.Hcc.sum(0).diagonal()
        unit = 1 / np.sqrt(np.where(size > 0, size, 1.0))
        scaled = total * unit[:, None] * unit + damping * np.eye(len(unit)) + 1e-15 * np.eye(len(unit))
        common = -unit * np.linalg.lstsq(scaled, unit * gradient, rcond=1e-14)[0]
        own = -(eliminate[..., :-1] @ common) - eliminate[..., -1]
        promised = -0.5 * (
            float(gradient @ common) - float(np.einsum("vi,vi->", self.gp, eliminate[..., -1]))
        )
        return (common, own), promised


class _Problem:
    """The corners and what may move; evaluates the cost and its derivatives at a state."""

    def __init__(self, data: Data, freedom: Freedom) -> None:
        self._data = data
        bent = np.full(data.basis.shape[-1] if freedom.shape else 0, True)
        self._shaped = freedom.shape
        self._free = np.concatenate([freedom.intrinsics, bent])

    def linearise(self, state: State, scale_px: float | None = None) -> _Linear:
        """The problem at a state; the scale of Huber's weights is estimated there if it is not given."""
        data = self._data
        projected, J = _projected(data, state, shaped=self._shaped)
        residuals = np.where(data.present[..., None], projected - data.px, 0.0)
        distance = np.sqrt((residuals**2).sum(-1))
        own_scale_px = _scale(distance[data.present])
        scale_px = own_scale_px if scale_px is None else scale_px
        limit = _HUBER_SIGMAS * scale_px
        weights = np.where(distance > limit, limit / np.maximum(distance, 1e-300), 1.0) * data.present
        cost = float(np.where(distance > limit, limit * (distance - limit / 2), distance**2 / 2).sum())
        flat = (len(data), 2 * data.present.shape[1])
        A, B = J[..., _POSE:][..., self._free].reshape(*flat, -1), J[..., :_POSE].reshape(*flat, -1)
        r, w = residuals.reshape(*flat, 1), np.repeat(weights, 2, axis=1)[..., None]
        Aw, Bw = (A * w).transpose(0, 2, 1), (B * w).transpose(0, 2, 1)
        return _Linear(
            cost=cost,
            scale_px=scale_px,
            own_scale_px=own_scale_px,
            residuals=residuals,
            weights=weights,
            Hcc=Aw @ A,
            Hcp=Aw @ B,
            Hpp=Bw @ B,
            gc=(Aw @ r)[..., 0],
            gp=(Bw @ r)[..., 0],
        )

    def moved(self, state: State, step: tuple[np.ndarray, np.ndarray]) -> State:
        """The state after a step."""
        common = np.zeros(len(self._free))
        common[self._free] = step[0]
        shape = state.shape + common[COUNT:] if self._shaped else state.shape
        return State(state.intrinsics + common[:COUNT], state.poses + step[1], shape)

    def answer(self, outcome: Outcome, state: State, linear: _Linear) -> Adjustment:
        """The adjustment that ends at a state."""
        information, gradients, _ = linear.reduced()
        return Adjustment(
            outcome=outcome,
            state=state,
            residuals_px=-linear.residuals,
            present=self._data.present,
            weights=linear.weights,
            information=information,
            gradients=gradients,
            free=self._free,
        )


def _projected(
    data: Data, state: State, *, shaped: bool
) -> tuple[Float[np.ndarray, "v n 2"], Float[np.ndarray, "v n 2 p"]]:
    """Pixels of all corners, and their derivatives by pose, intrinsics and, if `shaped`, the sheet's bend."""
    views, most = data.present.shape
    px = np.empty((views, most, 2))
    J = np.empty((views, most, 2, _POSE + COUNT + (data.basis.shape[-1] if shaped else 0)))
    fx, fy, cx, cy = state.intrinsics[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    for k, pose in enumerate(state.poses):
        points = data.places[k]
        if state.shape.any():
            points = points.copy()
            points[:, 2] += data.basis[k] @ state.shape
        image, by = cv2.projectPoints(points, pose[:3], pose[3:], K, state.intrinsics[4:])[:2]
        px[k] = np.asarray(image).reshape(-1, 2)
        J[k, ..., : _POSE + COUNT] = np.asarray(by).reshape(most, 2, -1)[..., : _POSE + COUNT]
    if shaped:
        # A corner that leaves the sheet moves as the whole sheet would along its normal.
        along = np.einsum("vnij,vj->vni", J[..., 3:_POSE], state.normals)
        J[..., _POSE + COUNT :] = along[..., None] * data.basis[:, :, None, :]
    return px, J


def _scale(distance: np.ndarray) -> float:
    """Standard deviation of a coordinate by the median distance, which is 1.1774 of it in two dimensions."""
    return max(float(np.median(distance)) / 1.1774, 1e-9) if len(distance) else 1.0
