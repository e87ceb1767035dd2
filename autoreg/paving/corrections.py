"""Corrections of a converged fit that its own solve cannot make: the bond's shift, and the place alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from autoreg.fitting.fit import Fit
from autoreg.geometry import Rigid
from autoreg.ground.bond_shift import nearest_customary
from autoreg.ground.sides import ALONG_Y
from autoreg.solve import joint_data as terms
from autoreg.solve.joint_data import MOTION, SHIFT

# Changes of the bond's shift below this share of a slab are left alone, and those of a customary one below
# the second. Pavers keep to it better than relief and slabs that are turned let the cross joints tell: those
# of exact bonds were seen to say up to 0.0006, and five times what their scatter allows.
SHIFT_STEP, CUSTOMARY_STEP = 0.0003, 0.002
# How often a fit is repeated by the shift that its joints tell: courses that are thought to move on by
# another part of a slab than they do are lost some rows on.
MOST_SHIFTS = 3


def by_measured_shifts(fit: Fit, measured: Callable[[Fit], Fit | None]) -> list[Fit]:
    """A fit and its repetitions, each measured anew by the shift that the joints of the one before tell."""
    fits = [fit]
    for _ in range(MOST_SHIFTS):
        shifted = with_measured_shift(fits[-1])
        again = None if shifted is None else measured(shifted)
        if again is None:
            break
        fits.append(again)
    return fits


def with_measured_shift(fit: Fit) -> Fit | None:
    """The fit moved to the bond's shift that the cross joints show; None if it is the one it has.

    A wrong shift shears the cross joints, which the pose partly hides by a turn; a linear step of all that
    is solved for and the shift together, within what is known of it, tells them apart. The customary shifts
    are kept unless the joints contradict them, and taken again where one is about what they tell.
    """
    grid = fit.grid
    if not grid.shift or grid.spacing_x is None:
        return None
    rows = np.flatnonzero(fit.usable)
    stations = fit.stations.take(rows)
    crossing = stations.family == ALONG_Y
    if len(np.unique(stations.cell[crossing])) < 3:
        return None
    free = np.flatnonzero(fit.free.mask)
    J = np.column_stack([fit.solution.jacobian[np.ix_(rows, free)], fit.by_shift_px[rows]])
    weight, known = np.sqrt(fit.weight[rows]) / fit.sigma_px[rows], fit.free.prior(fit.camera, grid)
    surely = np.r_[1.0 / known.sigma[free], 0.0]
    A = np.concatenate([J * weight[:, None], np.diag(surely)])
    b = np.r_[-fit.distances_px[rows] * weight, surely * np.r_[known.mean[free], 0.0]]
    unit = np.linalg.norm(A, axis=0)
    step = np.linalg.lstsq(A / unit, b, rcond=None)[0] / unit
    left = (A @ step - b)[: len(rows)]
    scatter = float(np.mean(left**2)) * len(rows) / len(np.unique(stations.side))
    sigma = float(np.sqrt(scatter * np.linalg.pinv((A / unit).T @ (A / unit))[-1, -1]) / unit[-1])
    shift = grid.shift + float(step[-1])
    usual = nearest_customary(shift)
    again = grid.odd_bond and abs(usual - shift) < CUSTOMARY_STEP
    least = SHIFT_STEP if grid.odd_bond else CUSTOMARY_STEP
    if not again and abs(shift - grid.shift) < max(5.0 * sigma, least):
        return None
    motion = np.zeros(MOTION)
    motion[free], motion[SHIFT] = step[:-1], (usual if again else shift) - grid.shift
    moved = fit.moved(motion)
    return replace(moved, grid=replace(moved.grid, shift=moved.grid.shift % 1.0))


def recentred(fit: Fit) -> Fit:
    """The fit moved without a turn to where its joints lie best: robustly weighted least squares."""
    J = fit.solution.jacobian[:, terms.TRANSLATION]
    step = fit.motion_along(J)
    pose = Rigid(fit.cam_from_ground.R, fit.cam_from_ground.t + step)
    return replace(fit, cam_from_ground=pose, distances_px=fit.distances_px + J @ step)
