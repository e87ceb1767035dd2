"""What courses that drift move, and by how much."""

from __future__ import annotations

import numpy as np
import pytest
from paved import CHECKER, HALF_BOND, STACK, fit_of

from autoreg.fitting.fit import Fit
from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.slabs.course_effects import ENDS, WAVES, drift_effects
from autoreg.slabs.measured_joints import measured_joints
from autoreg.synthetic import render_paving


@pytest.fixture(scope="module")
def bonded() -> Fit:
    return fit_of(render_paving(HALF_BOND))


@pytest.fixture(scope="module")
def stacked() -> Fit:
    return fit_of(render_paving(STACK))


def drifts_of(fit: Fit) -> np.ndarray:
    """Ground distances by which a fit's usable joints move, for each effect of a unit's drift."""
    joints = measured_joints(fit, np.flatnonzero(fit.usable))
    return drift_effects(joints)[: len(joints.rows)] / joints.px_per_unit[:, None]


def test_courses_drift_as_a_random_walk_about_its_mean(bonded: Fit):
    stations = bonded.stations.take(np.flatnonzero(bonded.usable))
    line = stations.line[stations.family == ALONG_X]
    walk = drifts_of(bonded)[stations.family == ALONG_X, :WAVES]
    count = int(np.ptp(line)) + 1
    steps = np.tril(np.ones((count, count)))
    about_mean = steps - steps.mean(0)
    expected = about_mean @ about_mean.T
    at = line - line.min()
    found = walk @ walk.T
    # Waves of more than six halves are left out.
    assert np.abs(found - expected[np.ix_(at, at)]).max() < 0.15 * expected.max()
    # All of a course goes with it.
    assert all(np.ptp(walk[line == k], axis=0).max() < 1e-12 for k in np.unique(line))


def test_the_ends_of_courses_drift_apart_and_cross_joints_go_with_their_course(bonded: Fit):
    stations, moved = bonded.stations.take(np.flatnonzero(bonded.usable)), drifts_of(bonded)
    unbroken = stations.family == ALONG_X
    x = stations.ground[unbroken, 0]
    to_ends = (2.0 * x - x.min() - x.max()) / np.ptp(x)
    # Behind the walk of the middles that of the ends, from their common turn on.
    assert moved[unbroken, WAVES] == pytest.approx(ENDS * to_ends)
    course, across = stations.cell[~unbroken], moved[~unbroken]
    assert np.abs(across).max() > 0.1
    assert all(np.ptp(across[course == k], axis=0).max() < 1e-12 for k in np.unique(course))
    # Nothing moves both: what lies along the courses, and what lies across them, drift by themselves.
    assert not np.any(np.any(across, axis=0) & np.any(moved[unbroken], axis=0))


def test_a_stack_bond_may_have_been_laid_along_either_joints(stacked: Fit):
    stations, moved = stacked.stations.take(np.flatnonzero(stacked.usable)), drifts_of(stacked)
    for family in (ALONG_X, ALONG_Y):
        own = moved[stations.family == family]
        own = own[:, np.any(own, axis=0)]
        line, cell = (values[stations.family == family] for values in (stations.line, stations.cell))
        by_line = np.array([np.ptp(own[line == k], axis=0) for k in np.unique(line)]).max(0) < 1e-12
        by_cell = np.array([np.ptp(own[cell == k], axis=0) for k in np.unique(cell)]).max(0) < 1e-12
        assert by_line.any()
        assert by_cell.any()


def test_tiles_that_meet_without_a_joint_do_not_drift():
    assert drifts_of(fit_of(render_paving(CHECKER))).shape[1] == 0


def test_a_single_course_drifts_nowhere(bonded: Fit):
    stations = bonded.stations
    one = stations.line[bonded.usable & (stations.family == ALONG_X)][0]
    alone = bonded.usable & (stations.family == ALONG_X) & (stations.line == one)
    moved = drift_effects(measured_joints(bonded, np.flatnonzero(alone)))
    # Its ends may turn, but there is no other that it could drift from.
    assert np.isfinite(moved).all()
    assert moved.shape[1] == 1
