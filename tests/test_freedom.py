from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from paved import CAMERA

from autoreg.fitting.fit import Fit
from autoreg.ground.sides import Grid
from autoreg.solve import joint_data as terms
from autoreg.solve.freedom import Free, log_stretch, moved_camera, moved_pose, stretched
from autoreg.solve.joint_data import PARAMETERS
from autoreg.solve.solver import Solution

NOTHING = Solution("converged", np.zeros(PARAMETERS), 0.0, np.zeros(3), np.zeros((3, PARAMETERS)), 1)


def test_a_solve_that_changes_nothing_changes_nothing(stack_fit: Fit):
    assert moved_camera(CAMERA, NOTHING) == CAMERA
    pose = moved_pose(stack_fit.cam_from_ground, NOTHING)
    assert pytest.approx(stack_fit.cam_from_ground.R, abs=1e-12) == pose.R
    assert pose.t == pytest.approx(stack_fit.cam_from_ground.t)
    assert stretched(Grid(0.6, 0.4), NOTHING) == Grid(0.6, 0.4)


def test_a_stretched_lattice_keeps_its_area():
    parameters = np.zeros(PARAMETERS)
    parameters[terms.RATIO] = 0.1
    grid = stretched(Grid(0.6, 0.4, 0.5), replace(NOTHING, parameters=parameters))
    assert grid.spacing_x is not None
    assert grid.spacing_x * grid.spacing_y == pytest.approx(0.24)
    assert grid.spacing_x / grid.spacing_y == pytest.approx(1.5 * np.exp(0.1))
    assert grid.shift == 0.5


def test_priors_mean_the_nominal_camera_wherever_the_solve_starts():
    nominal = replace(CAMERA, fy=1.02 * CAMERA.fy, dist=(-0.1, 0.03, 0.001, -0.002) + (0.0,) * 4)
    free = Free(focal=True, centre=True, radial=True, aspect=True, nominal=nominal, focal_sigma=0.05)
    start = replace(CAMERA, fx=1.1 * CAMERA.fx, fy=1.1 * CAMERA.fy, cx=CAMERA.cx + 7.0)
    mean = free.prior(start).mean
    assert start.fx * np.exp(mean[terms.FOCAL]) == pytest.approx(CAMERA.fx)
    assert start.cx + mean[terms.CENTRE][0] == pytest.approx(CAMERA.cx)
    assert start.dist[0] + mean[terms.RADIAL] == pytest.approx(-0.1)
    assert free.prior(start).sigma[terms.FOCAL] == 0.05
    meant = moved_camera(start, replace(NOTHING, parameters=mean))
    assert meant.fy == pytest.approx(nominal.fy)
    assert meant.dist == pytest.approx(nominal.dist)


@pytest.mark.parametrize("grid", [Grid(0.61, 0.41), Grid(0.41, 0.61, 0.5), Grid(0.3, 0.3)])
@pytest.mark.parametrize("slab", [(0.6, 0.4), (0.4, 0.6)])
def test_priors_mean_the_slab_that_was_told_whichever_side_comes_first(grid: Grid, slab: tuple[float, float]):
    prior = Free(ratio=True, slab=slab, ratio_sigma=0.01).prior(CAMERA, grid)
    meant = stretched(grid, replace(NOTHING, parameters=prior.mean))
    assert meant.spacing_x is not None
    assert max(meant.spacing_x, meant.spacing_y) / min(meant.spacing_x, meant.spacing_y) == pytest.approx(1.5)
    assert log_stretch(meant.spacing_x, meant.spacing_y, slab) == pytest.approx(0.0, abs=1e-12)
    assert prior.sigma[terms.RATIO] == 0.01


def test_rows_and_untold_slabs_have_no_ratio_that_is_known():
    for free, grid in (
        (Free(ratio=True, slab=(0.6, 0.4), ratio_sigma=0.01), Grid(None, 0.4)),
        (Free(), Grid(0.6, 0.4)),
    ):
        assert np.isinf(free.prior(CAMERA, grid).sigma[terms.RATIO])
