from __future__ import annotations

import numpy as np
import pytest
from handmade_joints import SIGMA_PX, Start, problem
from test_solver import sigmas_apart

from autoreg.solve.batch_solver import solve_batch
from autoreg.solve.joint_data import FOCAL, PARAMETERS, RATIO
from autoreg.solve.solver import Prior, solve_joints

# Two problems of 113 to 128 joints with these eight free: what is compiled for one test serves all.
FREE = np.r_[np.ones(8), np.zeros(PARAMETERS - 8)]


def test_a_batch_solves_what_the_single_solver_solves():
    problems = [problem(seed, n=100 + 20 * seed, noise_px=0.1, outliers=0.15) for seed in range(2)]
    for data, one in zip(problems, solve_batch(problems, FREE), strict=True):
        alone = solve_joints(data, FREE)
        assert one.outcome == alone.outcome == "converged"
        assert one.parameters == pytest.approx(alone.parameters, abs=1e-6)
        assert one.cost == pytest.approx(alone.cost, rel=1e-6)
        assert one.distances_px == pytest.approx(alone.distances_px, abs=1e-3)
        assert one.jacobian == pytest.approx(alone.jacobian, rel=1e-4, abs=1e-2)


def test_wild_joints_and_far_starts_end_in_the_same_minimum_in_fewer_steps():
    far = Start(0.03, 0.1)
    problems = [problem(seed, n=120, noise_px=SIGMA_PX, outliers=0.4, start=far) for seed in range(8)]
    batch = [one for k in range(0, 8, 2) for one in solve_batch(problems[k : k + 2], FREE)]
    alone = [solve_joints(data, FREE) for data in problems]
    for data, one, other in zip(problems, batch, alone, strict=True):
        assert one.outcome == other.outcome == "converged"
        assert sigmas_apart(data, one.jacobian, one.parameters - other.parameters) < 0.01
    # A batch waits for its slowest problem.
    assert max(one.steps for one in batch) < max(other.steps for other in alone)
    assert sum(one.steps for one in batch) < 0.75 * sum(other.steps for other in alone)


def test_exact_joints_give_the_exact_pose_where_the_camera_is_known():
    known = Prior(np.zeros(PARAMETERS), np.where(np.arange(PARAMETERS) < RATIO, np.inf, 1e-6))
    for found in solve_batch([problem(3, n=125), problem(4, n=80)], FREE, [known] * 2):
        assert found.outcome == "converged"
        assert np.abs(found.distances_px).max() < 1e-6


def test_frozen_parameters_stay_and_priors_hold_the_free():
    tight = np.full(PARAMETERS, np.inf)
    tight[FOCAL] = 1e-9
    problems = [problem(1, n=120, noise_px=0.1), problem(2, n=120, noise_px=0.1)]
    open_, held = (
        solve_batch(problems, FREE),
        solve_batch(problems, FREE, [Prior(np.zeros(PARAMETERS), tight)] * 2),
    )
    for a, b in zip(open_, held, strict=True):
        assert (a.parameters[8:] == 0).all()
        assert abs(a.parameters[FOCAL]) > 1e-6
        assert abs(b.parameters[FOCAL]) < 1e-8


def test_a_start_without_a_finite_cost_diverges_by_name():
    data = problem(0, n=120)
    broken = data._replace(measured_px=np.full_like(data.measured_px, np.nan))
    good, bad = solve_batch([data, broken], FREE)
    assert good.outcome == "converged"
    assert bad.outcome == "diverged"


def test_no_problem_and_a_problem_without_joints_are_errors():
    with pytest.raises(ValueError, match="at least one"):
        solve_batch([], FREE)
