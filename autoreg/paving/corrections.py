"""Corrections of a converged fit that its own solve cannot make: the bond's shift, and the place alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autoreg.fitting.fit import Fit
from autoreg.geometry import Rigid
from autoreg.ground.sides import ALONG_Y
from autoreg.ground.stations import moved_by_shift
from autoreg.solve import joint_data as terms
from autoreg.solve.joint_data import SHIFT

# Changes of the bond's shift below this share of a slab are left alone, and those of a customary one below
# the second. Pavers keep to it better than relief and slabs that are turned let the cross joints tell: those
# of exact bonds were seen to say up to 0.0006, and five times what their scatter allows.
SHIFT_STEP, CUSTOMARY_STEP = 0.0003, 0.002


def with_measured_shift(fit: Fit) -> Fit | None:
    """The fit moved to the bond's shift that the cross joints show; None if it is the one it has.

    A wrong shift shears the cross joints, which the pose partly hides by a turn; a linear step of the pose
    and the shift together tells them apart. The customary shifts are kept unless the joints contradict them.
    """
    grid = fit.grid
    if not grid.shift or grid.spacing_x is None:
        return None
    rows = np.flatnonzero(fit.usable)
    stations = fit.stations.take(rows)
    crossing = stations.family == ALONG_Y
    if len(np.unique(stations.cell[crossing])) < 3:
        return None
    by_shift = moved_by_shift(stations, grid) * fit.profiles.px_per_unit[rows]
    free = np.flatnonzero(fit.free.mask)
    J = np.column_stack([fit.solution.jacobian[np.ix_(rows, free)], by_shift])
    weight = np.sqrt(fit.weight[rows]) / fit.sigma_px[rows]
    A, b = J * weight[:, None], -fit.distances_px[rows] * weight
    unit = np.linalg.norm(A, axis=0)
    step = np.linalg.lstsq(A / unit, b, rcond=None)[0] / unit
    scatter = float(np.mean((A @ step - b) ** 2)) * len(rows) / len(np.unique(stations.side))
    sigma = float(np.sqrt(scatter * np.linalg.pinv((A / unit).T @ (A / unit))[-1, -1]) / unit[-1])
    change = float(step[-1])
    least = SHIFT_STEP if grid.odd_bond else CUSTOMARY_STEP
    if abs(change) < max(5.0 * sigma, least):
        return None
    motion = np.zeros(SHIFT + 1)
    motion[np.r_[free, SHIFT]] = step
    moved = fit.moved(motion)
    return replace(moved, grid=replace(moved.grid, shift=moved.grid.shift % 1.0))


def recentred(fit: Fit) -> Fit:
    """The fit moved without a turn to where its joints lie best: robustly weighted least squares."""
    J = fit.solution.jacobian[:, terms.TRANSLATION]
    step = fit.motion_along(J)
    pose = Rigid(fit.cam_from_ground.R, fit.cam_from_ground.t + step)
    return replace(fit, cam_from_ground=pose, distances_px=fit.distances_px + J @ step)
