import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from handmade_joints import CAMERA, POSE, SIGMA_PX, TRUTH, Start, problem
from plain_residuals import joint_distances
from scipy.optimize import least_squares

from autoreg.geometry import Rigid, angle_between_rotations, rotation_from_vector
from autoreg.solve.freedom import Free
from autoreg.solve.joint_data import (
    CENTRE,
    FOCAL,
    PARAMETERS,
    RADIAL,
    RATIO,
    ROTATION,
    TRANSLATION,
    JointData,
)
from autoreg.solve.residuals import robust
from autoreg.solve.solver import CAPACITY, CAUCHY_SIGMAS, Prior, solve_joints

EVERYTHING = np.ones(PARAMETERS)


def solved_pose(data: JointData, parameters: np.ndarray) -> Rigid:
    turn = rotation_from_vector(parameters[ROTATION])
    return Rigid(turn @ np.asarray(data.R), turn @ np.asarray(data.t) + parameters[TRANSLATION])


@jax.jit
def robust_joints(p: jax.Array, data: JointData) -> jax.Array:
    return robust(joint_distances(p, data) * data.weight)[0]


robust_slopes = jax.jit(jax.jacfwd(robust_joints))


def by_scipy(data: JointData, free: np.ndarray, prior: Prior | None = None) -> tuple[np.ndarray, float]:
    """Parameters and cost at scipy's minimum of the same residuals."""
    scale = np.asarray(data.scale)
    index = np.flatnonzero(free)
    known = prior or Prior(np.zeros(PARAMETERS), np.full(PARAMETERS, np.inf))
    weight = 1 / (CAUCHY_SIGMAS * known.sigma)

    def spread(x: np.ndarray) -> np.ndarray:
        p = np.zeros(PARAMETERS)
        p[index] = x
        return p

    def residual(x: np.ndarray) -> np.ndarray:
        p = spread(x)
        return np.r_[np.asarray(robust_joints(p, data)), weight * (p * scale - known.mean)]

    def slopes(x: np.ndarray) -> np.ndarray:
        joints = np.asarray(robust_slopes(spread(x), data))
        return np.vstack([joints, np.diag(weight * scale)])[:, index]

    with jax.enable_x64(True):
        result = least_squares(
            residual, np.zeros(len(index)), jac=slopes, x_scale="jac",
            method="trf", xtol=1e-15, ftol=1e-15, gtol=1e-14, max_nfev=2000,
        )  # fmt: skip
    return spread(result.x) * scale, float(result.cost)


def sigmas_apart(data: JointData, jacobian: np.ndarray, difference: np.ndarray) -> float:
    """Length of a difference of parameters, in standard deviations of what the joints say."""
    return float(np.linalg.norm(CAUCHY_SIGMAS * np.asarray(data.weight)[:, None] * jacobian @ difference))


@pytest.mark.parametrize("free", [POSE, EVERYTHING], ids=["pose", "everything"])
def test_exact_joints_give_back_the_pose(free):
    data = problem()
    solution = solve_joints(data, free)
    assert solution.outcome == "converged"
    pose = solved_pose(data, solution.parameters)
    assert np.rad2deg(angle_between_rotations(pose.R, TRUTH.R)) < 1e-6
    np.testing.assert_allclose(pose.t, TRUTH.t, atol=1e-6)
    np.testing.assert_allclose(solution.distances_px, 0.0, atol=1e-6)


def test_a_camera_and_a_lattice_that_are_off_are_found():
    data = problem()
    off = np.array([1.02, 1.02, 1.0, 1.0])
    intrinsics = np.r_[data.intrinsics[:4] * off + [0, 0, 6.0, -4.0], data.intrinsics[4:]]
    intrinsics[4] += 0.02
    data = data._replace(intrinsics=intrinsics, ground=data.ground * [1.01, 1 / 1.01])
    p = solve_joints(data, EVERYTHING).parameters
    assert p[RATIO] == pytest.approx(-2 * np.log(1.01), abs=1e-6)
    assert p[FOCAL] == pytest.approx(-np.log(1.02), abs=1e-6)
    np.testing.assert_allclose(p[CENTRE], [-6.0, 4.0], atol=1e-3)
    assert p[RADIAL] == pytest.approx(-0.02, abs=1e-6)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("outliers", [0.0, 0.15])
def test_the_minimum_is_scipys(seed, outliers):
    # Starts within a few pixels, so that both descend into the same of a robust cost's several minima.
    data = problem(seed, noise_px=SIGMA_PX, outliers=outliers, start=Start(0.0003, 0.001))
    free = Free(ratio=True, focal=True).mask
    solution = solve_joints(data, free)
    parameters, cost = by_scipy(data, free)
    assert solution.outcome == "converged"
    assert solution.cost == pytest.approx(cost, rel=1e-8)
    assert sigmas_apart(data, solution.jacobian, solution.parameters - parameters) < 1e-3


def test_the_minimum_with_a_prior_is_scipys():
    data = problem(7, noise_px=SIGMA_PX, start=Start(0.0003, 0.001))
    free = Free(focal=True, centre=True).mask
    sigma = np.full(PARAMETERS, np.inf)
    sigma[FOCAL], sigma[CENTRE] = 0.001, 2.0
    mean = np.zeros(PARAMETERS)
    mean[FOCAL] = 0.002
    prior = Prior(mean, sigma)
    solution = solve_joints(data, free, prior)
    parameters, cost = by_scipy(data, free, prior)
    assert solution.cost == pytest.approx(cost, rel=1e-8)
    assert sigmas_apart(data, solution.jacobian, solution.parameters - parameters) < 1e-3


def test_frozen_parameters_stay_exactly_where_they_are():
    data = problem(1, noise_px=0.3)
    for frozen in range(PARAMETERS):
        free = EVERYTHING.copy()
        free[frozen] = 0.0
        p = solve_joints(data, free).parameters
        assert p[frozen] == 0.0
        assert (p[free > 0] != 0.0).all()


def test_a_tight_prior_holds_and_a_loose_one_lets_go():
    data = problem(2, noise_px=SIGMA_PX)
    free = Free(focal=True).mask
    mean = np.zeros(PARAMETERS)
    mean[FOCAL] = 0.01

    def focal(sigma: float) -> float:
        return solve_joints(data, free, Prior(mean, np.where(mean, sigma, np.inf))).parameters[FOCAL]

    alone = solve_joints(data, free).parameters[FOCAL]
    assert focal(1e-7) == pytest.approx(0.01, abs=1e-5)
    assert focal(1e3) == pytest.approx(alone, abs=1e-7)
    pulled = [focal(s) for s in (1e-5, 1e-4, 1e-3, 1e-2)]
    assert pulled == sorted(pulled, reverse=True)


def test_a_prior_weighs_as_much_as_the_joints_that_are_as_sure():
    """Where the joints say sigma s, a prior of sigma s a small way off pulls half of that way."""
    data = problem(3)
    free = Free(focal=True).mask
    solution = solve_joints(data, free)
    J = solution.jacobian[:, free > 0] / SIGMA_PX
    sigma = float(np.sqrt(np.linalg.inv(J.T @ J)[-1, -1]))
    mean = np.zeros(PARAMETERS)
    way = 0.05 * sigma
    mean[FOCAL] = solution.parameters[FOCAL] + way
    pulled = solve_joints(data, free, Prior(mean, np.where(np.arange(PARAMETERS) == FOCAL, sigma, np.inf)))
    assert (pulled.parameters[FOCAL] - solution.parameters[FOCAL]) / way == pytest.approx(0.5, abs=0.01)


def test_distances_and_jacobian_are_the_joints_own_at_the_solution():
    data = problem(4, n=50, noise_px=SIGMA_PX)
    solution = solve_joints(data, EVERYTHING)
    at = solution.parameters / data.scale
    with jax.enable_x64(True):
        distances = np.asarray(joint_distances(jnp.asarray(at), data))
        jacobian = np.asarray(jax.jit(jax.jacfwd(joint_distances))(jnp.asarray(at), data)) / data.scale
    np.testing.assert_allclose(solution.distances_px, distances, atol=1e-9)
    np.testing.assert_allclose(solution.jacobian, jacobian, rtol=1e-9, atol=1e-7 * np.abs(jacobian).max())
    assert solution.cost == pytest.approx(0.5 * np.log1p((distances * data.weight) ** 2).sum(), rel=1e-12)


def test_the_spread_of_the_solutions_is_that_of_the_noise():
    noise_px, n, runs = 0.2, 240, 60
    errors, rms, J = [], [], None
    for seed in range(runs):
        data = problem(11, n=n, start=Start(0.001, 0.003), sigma_px=100 * noise_px)
        rng = np.random.default_rng(seed)
        noise = noise_px * rng.normal(size=(n, 1)) * data.normal
        data = data._replace(measured_px=data.measured_px + noise)
        solution = solve_joints(data, POSE)
        exact = solve_joints(problem(11, n=n, start=Start(0.001, 0.003)), POSE)
        errors.append((solution.parameters - exact.parameters)[:6])
        rms.append(solution.distances_px.std())
        J = exact.jacobian[:, :6] / noise_px
    assert J is not None
    # Normalised squared errors have a mean of 6 and a variance of 12 per run.
    normalised = np.sum((J @ np.array(errors).T) ** 2, axis=0)
    assert normalised.mean() == pytest.approx(6, abs=4 * np.sqrt(12 / runs))
    assert np.mean(rms) == pytest.approx(noise_px * np.sqrt(1 - 6 / n), rel=0.02)


def test_wild_joints_hardly_pull():
    data = problem(5, n=600, noise_px=SIGMA_PX, outliers=0.2, start=Start(0.0005, 0.002))
    solution = solve_joints(data, POSE)
    pose = solved_pose(data, solution.parameters)
    assert solution.outcome == "converged"
    # The wild joints lie up to eight pixels off; the turn left over moves the picture by less than this (px).
    assert angle_between_rotations(pose.R, TRUTH.R) * CAMERA.fx < 0.3
    J = solution.jacobian[:, :6] / SIGMA_PX
    vector = np.r_[solution.parameters[:6]]
    truth = solve_joints(problem(5, n=600, start=Start(0.0005, 0.002)), POSE).parameters[:6]
    assert np.linalg.norm(J @ (vector - truth)) < 10


def test_joints_without_weight_do_not_count():
    data = problem(6, n=200, noise_px=SIGMA_PX)
    weight = np.where(np.arange(200) < 120, data.weight, 0.0)
    spoiled = data._replace(weight=weight, measured_px=data.measured_px + 50.0 * (weight == 0)[:, None])
    kept = data._replace(**{k: getattr(data, k)[:120] for k in ("ground", "measured_px", "normal", "weight")})
    a, b = solve_joints(spoiled, POSE), solve_joints(kept, POSE)
    assert len(a.distances_px) == 200
    np.testing.assert_allclose(a.parameters, b.parameters, atol=1e-9)


def test_an_answer_does_not_depend_on_the_scales_given():
    data = problem(8, noise_px=SIGMA_PX, start=Start(0.001, 0.003))
    other = data._replace(scale=np.asarray(data.scale) * np.geomspace(1e-3, 1e3, PARAMETERS))
    a, b = solve_joints(data, POSE), solve_joints(other, POSE)
    assert a.outcome == b.outcome == "converged"
    assert sigmas_apart(data, a.jacobian, a.parameters - b.parameters) < 1e-4


@pytest.mark.parametrize("field", ["ground", "measured_px", "t", "intrinsics"])
def test_a_start_that_is_not_finite_diverges(field):
    data = problem(n=20)
    broken = np.array(getattr(data, field), float)
    broken.flat[0] = np.nan
    solution = solve_joints(data._replace(**{field: broken}), POSE)
    assert solution.outcome == "diverged"
    assert not np.isfinite(solution.cost)
    np.testing.assert_array_equal(solution.parameters, 0.0)


def test_a_step_out_of_the_range_of_numbers_is_taken_back():
    """One joint far off its place, which only an astronomic focal length would reach in one step."""
    data = JointData(
        ground=np.array([[1e-3, 0.0]]),
        measured_px=np.array([[50.0, 0.0]]),
        normal=np.array([[1.0, 0.0]]),
        weight=np.ones(1),
        R=np.eye(3),
        t=np.array([0.0, 0.0, 1.0]),
        intrinsics=np.array([1.0, 1.0] + [0.0] * 10),
        scale=np.ones(PARAMETERS),
    )
    free = np.eye(PARAMETERS)[FOCAL]
    solution = solve_joints(data, free)
    assert solution.outcome in ("converged", "stalled")
    assert solution.cost < 0.5 * np.log1p(49.9**2)
    assert np.isfinite(solution.parameters).all()


def test_a_solve_without_enough_steps_says_that_it_stalled():
    solution = solve_joints(problem(9, noise_px=SIGMA_PX, start=Start(0.05, 0.1)), EVERYTHING, most_steps=1)
    assert solution.outcome == "stalled"
    assert solution.steps == 1


def test_a_start_at_the_minimum_takes_no_step():
    data = problem(10, noise_px=SIGMA_PX)
    first = solve_joints(data, POSE)
    pose = solved_pose(data, first.parameters)
    again = solve_joints(data._replace(R=pose.R, t=pose.t), POSE)
    assert again.outcome == "converged"
    assert again.steps <= 1
    assert again.cost == pytest.approx(first.cost, rel=1e-9)


def test_too_few_joints_for_the_parameters_still_converge():
    solution = solve_joints(problem(n=4, noise_px=SIGMA_PX, start=Start(0.001, 0.003)), EVERYTHING)
    assert solution.outcome == "converged"
    np.testing.assert_allclose(solution.distances_px, 0.0, atol=1e-4)


@pytest.mark.parametrize("n", [0, CAPACITY + 1])
def test_a_number_of_joints_that_does_not_fit_is_refused(n):
    with pytest.raises(ValueError, match=f"data: from 1 to {CAPACITY} joints .* got {n}"):
        solve_joints(problem(n=n), POSE)


def test_as_many_joints_as_fit_are_solved():
    solution = solve_joints(problem(n=CAPACITY, noise_px=SIGMA_PX), POSE)
    assert solution.outcome == "converged"
    assert len(solution.distances_px) == CAPACITY


def test_solves_leave_jax_in_single_precision():
    solve_joints(problem(n=10), POSE)
    assert jnp.ones(1).dtype == jnp.float32


def test_threads_that_solve_at_once_agree():
    data, found = problem(12, noise_px=SIGMA_PX), []
    threads = [
        threading.Thread(target=lambda: found.append(solve_joints(data, POSE).parameters)) for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 3
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])
