"""The normal equations of a bundle adjustment at one state, each view's pose eliminated.

The unknowns common to all views are the intrinsics and the sheet's shape; each view has a pose of its own,
which is eliminated (the Schur complement), so a view counts through a small matrix and vector of its own.
Sums of these give the covariance, the fit without a view, and the fit to a part of the views.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from autoreg.calibration.models import COUNT
from autoreg.calibration.observations import Data
from autoreg.calibration.unknowns import Freedom, State

# Unknowns of a view's pose.
POSE = 6
# Corners further off than this many standard deviations pull with a constant force only (Huber).
_HUBER_SIGMAS = 3.5


@dataclass(frozen=True)
class NormalEquations:
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
    prior: np.ndarray
    prior_gradient: np.ndarray

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
        total = information.sum(0) + np.diag(self.prior)
        gradient = gradients.sum(0) + self.prior_gradient
        size = self.Hcc.sum(0).diagonal() + self.prior
        unit = 1 / np.sqrt(np.where(size > 0, size, 1.0))
        scaled = total * unit[:, None] * unit + damping * np.eye(len(unit)) + 1e-15 * np.eye(len(unit))
        common = -unit * np.linalg.lstsq(scaled, unit * gradient, rcond=1e-14)[0]
        own = -(eliminate[..., :-1] @ common) - eliminate[..., -1]
        promised = -0.5 * (
            float(gradient @ common) - float(np.einsum("vi,vi->", self.gp, eliminate[..., -1]))
        )
        return (common, own), promised


class Problem:
    """The corners and what may move; evaluates the cost and its derivatives at a state."""

    def __init__(self, data: Data, freedom: Freedom) -> None:
        self.data = data
        bent = np.full(data.basis.shape[-1] if freedom.shape else 0, True)
        self._shaped = freedom.shape
        self.freedom = freedom
        self.free = np.concatenate([freedom.intrinsics, bent])
        self._prior = np.concatenate([freedom.prior**-2.0, np.zeros(len(bent))])[self.free]

    def linearise(self, state: State, scale_px: float | None = None) -> NormalEquations:
        """The problem at a state; the scale of Huber's weights is estimated there if it is not given."""
        data = self.data
        projected, J = _projected(data, state, shaped=self._shaped)
        residuals = np.where(data.present[..., None], projected - data.px, 0.0)
        distance = np.sqrt((residuals**2).sum(-1))
        own_scale_px = _scale(distance[data.present])
        scale_px = own_scale_px if scale_px is None else scale_px
        limit = _HUBER_SIGMAS * scale_px
        weights = np.where(distance > limit, limit / np.maximum(distance, 1e-300), 1.0) * data.present
        cost = float(np.where(distance > limit, limit * (distance - limit / 2), distance**2 / 2).sum())
        # What is known beforehand counts like measurements, in units of the corners' scatter.
        prior = scale_px**2 * self._prior
        common = np.concatenate([state.intrinsics, np.zeros(len(self.free) - COUNT)])[self.free]
        cost += 0.5 * float(prior @ common**2)
        flat = (len(data), 2 * data.present.shape[1])
        A, B = J[..., POSE:][..., self.free].reshape(*flat, -1), J[..., :POSE].reshape(*flat, -1)
        r, w = residuals.reshape(*flat, 1), np.repeat(weights, 2, axis=1)[..., None]
        Aw, Bw = (A * w).transpose(0, 2, 1), (B * w).transpose(0, 2, 1)
        return NormalEquations(
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
            prior=prior,
            prior_gradient=prior * common,
        )

    def moved(self, state: State, step: tuple[np.ndarray, np.ndarray]) -> State:
        """The state after a step."""
        common = np.zeros(len(self.free))
        common[self.free] = step[0]
        shape = state.shape + common[COUNT:] if self._shaped else state.shape
        return State(state.intrinsics + common[:COUNT], state.poses + step[1], shape)


def _projected(
    data: Data, state: State, *, shaped: bool
) -> tuple[Float[np.ndarray, "v n 2"], Float[np.ndarray, "v n 2 p"]]:
    """Pixels of all corners, and their derivatives by pose, intrinsics and, if `shaped`, the sheet's bend."""
    views, most = data.present.shape
    px = np.empty((views, most, 2))
    J = np.empty((views, most, 2, POSE + COUNT + (data.basis.shape[-1] if shaped else 0)))
    fx, fy, cx, cy = state.intrinsics[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    for k, pose in enumerate(state.poses):
        points = data.places[k]
        if state.shape.any():
            points = points.copy()
            points[:, 2] += data.basis[k] @ state.shape
        image, by = cv2.projectPoints(points, pose[:3], pose[3:], K, state.intrinsics[4:])[:2]
        px[k] = np.asarray(image).reshape(-1, 2)
        J[k, ..., : POSE + COUNT] = np.asarray(by).reshape(most, 2, -1)[..., : POSE + COUNT]
    if shaped:
        # A corner that leaves the sheet moves as the whole sheet would along its normal.
        along = np.einsum("vnij,vj->vni", J[..., 3:POSE], state.normals)
        J[..., POSE + COUNT :] = along[..., None] * data.basis[:, :, None, :]
    return px, J


def _scale(distance: np.ndarray) -> float:
    """Standard deviation of a coordinate by the median distance, which is 1.1774 of it in two dimensions."""
    return max(float(np.median(distance)) / 1.1774, 1e-9) if len(distance) else 1.0
