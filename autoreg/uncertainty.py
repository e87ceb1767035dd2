"""How sure the pose is, from the data's own scatter; and whether the photo contradicts its camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from autoreg import residuals as terms
from autoreg.refine import Fit, Free, joint_data
from autoreg.residuals import PARAMETERS
from autoreg.solver import CAUCHY_SIGMAS, Prior, Solution, solve_joints

# What a calibration may be off by before a photo is said to contradict it: share of the focal length, and
# of the picture's width for the principal point.
FOCAL_TOLERANCE, CENTRE_TOLERANCE = 0.02, 0.02
# The contradiction must be this significant (a chi-square), so that irregular slabs never cause it.
SIGNIFICANT = 30.0
# ... and this many tolerances wide.
BEYOND = 2.0


@dataclass(frozen=True)
class CameraCheck:
    """What the joints say about the camera."""

    consistent: bool
    focal_px: float
    focal_sigma_px: float
    focal_shift: float
    centre_shift_px: Float[np.ndarray, "2"]


def parameter_covariance(
    fit: Fit, mask: Float[np.ndarray, " p"], prior: Prior
) -> Float[np.ndarray, "p p"]:
    """Covariance of the solve's parameters by the sandwich estimator, clustered by slab; zero where frozen.

    Joints that share a slab share its displacement. The scores of all stations are therefore summed per
    side, and sides that touch the same slab may correlate (Conley's estimator with the slab's own reach).
    """
    free = np.flatnonzero(mask)
    rows = np.flatnonzero(fit.usable)
    J = fit.solution.jacobian[np.ix_(rows, free)] / fit.sigma_px[rows, None]
    r = fit.distances_px[rows] / fit.sigma_px[rows]
    weight = 1.0 / (1.0 + (r / CAUCHY_SIGMAS) ** 2)
    scale = 1.0 / np.maximum(np.linalg.norm(J, axis=0), 1e-300)
    Js = J * scale
    # Expected curvature of Cauchy's loss: its own weight times its slope.
    curvature = weight**2 * (1.0 - (r / CAUCHY_SIGMAS) ** 2)
    known = np.diag((scale / prior.sigma[free]) ** 2)
    bread = Js.T @ (Js * np.maximum(curvature, 0.1 * weight)[:, None]) + known
    scores = Js * (weight * r)[:, None]
    _, side = np.unique(fit.stations.side[rows], return_inverse=True)
    per_side = np.zeros((side.max() + 1, len(free)))
    np.add.at(per_side, side, scores)
    first = np.unique(side, return_index=True)[1]
    neighbours = _neighbour_weights(fit, rows[first])
    meat = per_side.T @ neighbours @ per_side
    # A small sample of slabs: the usual correction for the parameters that were fitted.
    sides = len(first)
    meat = meat * sides / max(sides - len(free), 1) + known
    inverse = np.linalg.pinv(bread)
    naive = inverse @ (Js.T @ (Js * (weight * r)[:, None] ** 2) + known) @ inverse
    inner = inverse @ meat @ inverse
    # The clustered estimate is noisy when clusters are few; the truth is not below the unclustered one.
    widen = max(1.0, float(np.sqrt(np.trace(naive) / max(np.trace(inner), 1e-300))))
    covariance = np.zeros((PARAMETERS, PARAMETERS))
    covariance[np.ix_(free, free)] = inner * widen**2 * np.outer(scale, scale)
    return covariance


def _neighbour_weights(fit: Fit, representative: np.ndarray) -> Float[np.ndarray, "s s"]:
    """Correlation allowed between sides: one for itself, falling to zero beyond one slab.

    The product of two triangle (Bartlett) kernels is positive semi-definite, and so is the estimate.
    """
    ground = fit.stations.ground[representative]
    a = fit.grid.spacing_x or fit.grid.spacing_y
    b = fit.grid.spacing_y
    family = fit.stations.family[representative]
    dx = np.abs(ground[:, None, 0] - ground[None, :, 0]) / (1.5 * a)
    dy = np.abs(ground[:, None, 1] - ground[None, :, 1]) / (1.5 * b)
    return np.clip(1 - dx, 0, 1) * np.clip(1 - dy, 0, 1) * (family[:, None] == family[None, :])


def pose_covariance(fit: Fit) -> Float[np.ndarray, "6 6"]:
    """Covariance of (rotation vector, translation) of a small motion on the camera's side."""
    solved = parameter_covariance(fit, fit.free.mask, fit.free.prior(fit.camera))[:6, :6]
    # The solve turns the translation as well: t = exp(w) t0 + dt.
    x, y, z = fit.cam_from_ground.t
    A = np.eye(6)
    A[3:, :3] = -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    C = A @ solved @ A.T
    return 0.5 * (C + C.T)


def check_camera(fit: Fit) -> CameraCheck:
    """Whether the joints of this photo contradict the camera they were fitted with.

    The joints are fitted again with a free focal length, then with a free principal point as well, both
    held by priors as wide as a good calibration may be off. A camera is contradicted when the joints pull
    it far beyond these against the priors' resistance.
    """
    data = joint_data(
        fit.camera, fit.cam_from_ground, fit.stations, fit.profiles, fit.offsets, fit.sigma_px, fit.usable
    )
    mask = Free(ratio=fit.free.ratio, focal=True).mask
    alone = solve_joints(data, mask)
    focal = float(np.exp(alone.parameters[terms.FOCAL]))
    C = parameter_covariance(_with(fit, alone), mask, Free().prior(fit.camera))
    sigma = float(np.sqrt(max(C[terms.FOCAL, terms.FOCAL], 0.0)))
    both = Free(ratio=fit.free.ratio, focal=True, centre=True).mask
    prior = np.full(PARAMETERS, np.inf)
    prior[terms.FOCAL] = FOCAL_TOLERANCE
    prior[terms.CENTRE] = CENTRE_TOLERANCE * fit.camera.width
    held = solve_joints(data, both, Prior(np.zeros(PARAMETERS), prior))
    shift = held.parameters[[terms.FOCAL, 8, 9]] / prior[[terms.FOCAL, 8, 9]]
    kept = solve_joints(data, Free(ratio=fit.free.ratio).mask)
    design = _design_effect(fit)
    gain = 2 * CAUCHY_SIGMAS**2 * (kept.cost - held.cost) / design
    width = float(np.linalg.norm(shift))
    return CameraCheck(
        consistent=not (gain > SIGNIFICANT and width > BEYOND),
        focal_px=fit.camera.fx * focal,
        focal_sigma_px=fit.camera.fx * focal * sigma,
        focal_shift=float(held.parameters[terms.FOCAL]),
        centre_shift_px=held.parameters[terms.CENTRE],
    )


def _with(fit: Fit, solution: Solution) -> Fit:
    return replace(fit, solution=solution, distances_px=solution.distances_px)


def _design_effect(fit: Fit) -> float:
    """How much the scatter of neighbouring joints adds up: clustered variance over that of lone stations."""
    rows = np.flatnonzero(fit.usable)
    r = fit.distances_px[rows] / fit.sigma_px[rows]
    r = r / (1.0 + (r / CAUCHY_SIGMAS) ** 2)
    _, side = np.unique(fit.stations.side[rows], return_inverse=True)
    total = np.zeros(side.max() + 1)
    np.add.at(total, side, r)
    first = np.unique(side, return_index=True)[1]
    return max(1.0, float(total @ _neighbour_weights(fit, rows[first]) @ total / max((r * r).sum(), 1e-12)))


