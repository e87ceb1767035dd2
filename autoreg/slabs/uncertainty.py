"""Which pose is likeliest, and how sure it is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from autoreg.fitting.fit import Fit
from autoreg.fitting.refine import joint_data
from autoreg.geometry import Rigid
from autoreg.slabs.slab_model import BOW, Estimate, Scatter, estimate_motion
from autoreg.solve.freedom import moved_camera, moved_pose, stretched
from autoreg.solve.joint_data import PARAMETERS, RATIO
from autoreg.solve.solver import solve_joints

# Where the camera is solved for, the likeliest pose may be so far from the fit that the Jacobian there is
# another one. What a motion leaves may be wrong by this share (RMS), else it goes on from there, so often.
STRAIGHT, MOST_MOVES = 0.03, 6


@dataclass(frozen=True)
class Settled:
    """A fit at the pose that the mixed model makes likeliest.

    `covariance` is of (rotation vector, translation) of a small motion on the camera's side. `relieved` is
    how far on the ground joints were moved since they are no flat ones (RMS). `narrowing` is by what share of
    their width joints look narrower at a slope of one than from above, as sunk ones do.
    """

    fit: Fit
    covariance: Float[np.ndarray, "6 6"]
    scatter: Scatter
    relieved: float = 0.0
    narrowing: float = 0.0


def settle(fit: Fit, *, widths: bool = True) -> Settled:
    """The fit moved to the likeliest pose under irregular slabs, and how sure that pose is.

    The joints' `widths` have a say if that is asked for. Where the camera is not known, ground that is a
    little bent would be taken for another one.
    """
    estimate, moved = _likeliest(fit, widths)
    for _ in range(MOST_MOVES):
        there = relinearised(fit, moved)
        wrong = _rms((there.distances_px - moved.distances_px)[fit.usable])
        if not np.isfinite(wrong) or wrong < STRAIGHT * _rms(moved.distances_px[fit.usable]):
            break
        fit = there
        estimate, moved = _likeliest(fit, widths)
    covariance = on_camera_side(estimate.covariance, moved.cam_from_ground)
    by_relief = (fit.solution.jacobian @ estimate.by_relief / fit.profiles.px_per_unit)[fit.usable]
    return Settled(moved, covariance, estimate.scatter, _rms(by_relief))


def _likeliest(fit: Fit, widths: bool) -> tuple[Estimate, Fit]:
    """The likeliest motion of what a fit solves for, and the fit moved by it."""
    bow = BOW if fit.free.focal else 0.0
    estimate = estimate_motion(fit, fit.free.mask, fit.free.prior(fit.camera), bow=bow, widths=widths)
    return estimate, moved_fit(fit, estimate.parameters)


def moved_fit(fit: Fit, parameters: Float[np.ndarray, " p"]) -> Fit:
    """The fit after a small motion of pose, camera and lattice; its joints are not measured anew."""
    step = replace(fit.solution, parameters=parameters)
    return replace(
        fit,
        camera=moved_camera(fit.camera, step),
        cam_from_ground=moved_pose(fit.cam_from_ground, step),
        grid=stretched(fit.grid, step),
        distances_px=fit.distances_px + fit.solution.jacobian @ parameters,
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


def on_camera_side(covariance: Float[np.ndarray, "p p"], pose: Rigid) -> Float[np.ndarray, "6 6"]:
    """The pose's part, where the solve's rotation turns the translation as well: t = exp(w) t0 + dt."""
    A = np.eye(6)
    A[3:, :3] = -_cross(pose.t)
    C = A @ covariance[:6, :6] @ A.T
    return 0.5 * (C + C.T)


def _cross(v: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
