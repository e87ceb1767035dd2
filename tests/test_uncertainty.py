"""The stated uncertainty holds, follows a moved frame, and a wrong camera is called out."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from autoreg.align import align
from autoreg.answer.conclude import Frame, scaled_covariance
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.fitting.fit import Fit
from autoreg.fitting.refine import refine_until_still
from autoreg.geometry import Rigid, rotation_from_vector, vector_from_rotation
from autoreg.ground.ground_frame import quarter_turns
from autoreg.ground.points import project_ground
from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid
from autoreg.image import as_gray
from autoreg.slabs import camera_check
from autoreg.slabs.camera_check import check_camera
from autoreg.slabs.slab_model import Estimate, Scatter, estimate_motion
from autoreg.slabs.uncertainty import Settled, _with_told_ratio, relinearised, settle
from autoreg.solve.freedom import Free
from autoreg.solve.joint_data import FOCAL, MOTION, PARAMETERS, RATIO
from autoreg.solve.solver import Prior
from autoreg.synthetic import SyntheticScene, look_at_ground, render_paving

SCENE = SyntheticScene(
    camera=Camera.from_focal(800, 600, 700.0),
    cam_from_ground=look_at_ground(pitch_deg=40.0, height_m=1.6, heading_deg=33.0, foot_m=(0.13, 0.21)),
    spacing_m=(0.4, 0.4),
    joint_width_m=0.012,
    colour=False,
)


BOND = replace(SCENE, spacing_m=(0.6, 0.3), shift=0.5)


@cache
def picture(
    jitter_m: float, seed: int, course_jitter_m: float = 0.0, course_drift_m: float = 0.0
) -> np.ndarray:
    photo = render_paving(
        replace(
            SCENE,
            jitter_m=jitter_m,
            course_jitter_m=course_jitter_m,
            course_drift_m=course_drift_m,
            seed=seed,
        )
    )
    return as_gray(photo.pixels).astype(np.float32)


@cache
def bonded(shift: float) -> np.ndarray:
    return as_gray(render_paving(replace(BOND, shift=shift)).pixels).astype(np.float32)


def fit_to(gray: np.ndarray, grid: Grid, focal: float) -> Fit:
    camera = replace(SCENE.camera, fx=focal * SCENE.camera.fx, fy=focal * SCENE.camera.fy)
    fit = refine_until_still(
        gray, camera, SCENE.cam_from_ground, grid, free=Free(), search=0.08, reach=12.0
    )  # fmt: skip
    assert fit is not None
    return fit


@cache
def fitted(
    jitter_m: float,
    seed: int,
    focal: float = 1.0,
    course_jitter_m: float = 0.0,
    course_drift_m: float = 0.0,
) -> Fit:
    return fit_to(picture(jitter_m, seed, course_jitter_m, course_drift_m), Grid(0.4, 0.4), focal)


@cache
def bond_fitted(shift: float, focal: float) -> Fit:
    return fit_to(bonded(shift), Grid(0.6, 0.3, shift), focal)


def turned_off(fit: Fit) -> np.ndarray:
    """Rotation vector of a fit's pose from the true one."""
    return vector_from_rotation(fit.cam_from_ground.R @ SCENE.cam_from_ground.R.T)


def rotation_errors(jitter_m: float, seeds: range) -> np.ndarray:
    """Normalised squared rotation errors of settled fits."""
    found = []
    for seed in seeds:
        settled = settle(fitted(jitter_m, seed))
        error = turned_off(settled.fit)
        found.append(error @ np.linalg.solve(settled.covariance[:3, :3], error))
    return np.array(found)


@pytest.mark.slow
def test_the_truth_lies_within_the_stated_uncertainty_of_irregular_paving() -> None:
    errors = rotation_errors(0.002, range(6))
    # Chi-square of 3 degrees of freedom: 99.9 % lie below 16.3; a tenfold overstatement shows below 0.05.
    assert errors.max() < 16.3
    assert np.median(errors) > 0.05


def test_irregular_slabs_make_the_pose_less_sure_by_about_as_much_as_they_scatter() -> None:
    even = np.sqrt(np.trace(settle(fitted(0.0, 0)).covariance[:3, :3]))
    irregular = np.sqrt(np.trace(settle(fitted(0.002, 0)).covariance[:3, :3]))
    assert irregular > 2.0 * even


def test_the_jitter_of_the_slabs_is_found_from_the_residuals() -> None:
    assert settle(fitted(0.002, 1)).scatter.place == pytest.approx(0.002, rel=0.5)


@pytest.mark.parametrize("ran_away_by", [30.0, np.nan])
def test_sides_that_nothing_holds_to_those_of_slabs_are_refused(
    ran_away_by: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = fitted(0.002, 1)
    known = estimate_motion(fit, fit.free.mask, fit.free.prior(fit.camera, fit.grid))
    parameters = known.parameters.copy()
    parameters[RATIO] = ran_away_by
    ran_away = replace(known, parameters=parameters)
    monkeypatch.setattr("autoreg.slabs.uncertainty.estimate_motion", lambda *_, **__: ran_away)
    with pytest.raises(Refusal, match="hold the sides of slabs"):
        settle(fit)


def test_how_much_slabs_scatter_does_not_hang_on_where_the_search_for_it_starts() -> None:
    fit = fitted(0.002, 1)
    known, mask = fit.free.prior(fit.camera, fit.grid), fit.free.mask
    first = estimate_motion(fit, mask, known).scatter
    places = []
    for factor in (0.85, 1.0, 1.18):
        near = replace(first, place=factor * first.place)
        places.append(estimate_motion(fit, mask, known, near).scatter.place)
    assert max(places) < 1.1 * min(places)


def test_courses_that_lie_aside_are_told_from_slabs_that_do() -> None:
    whole = settle(fitted(0.0003, 1, course_jitter_m=0.002)).scatter
    single = settle(fitted(0.002, 1)).scatter
    assert whole.course == pytest.approx(0.002, rel=0.5)
    assert whole.course > 1.5 * whole.place
    assert single.course < 0.7 * single.place
    assert single.place == pytest.approx(0.002, rel=0.5)


def test_courses_that_drift_are_told_from_those_that_lie_aside_by_themselves() -> None:
    drifting = settle(fitted(0.0003, 1, course_drift_m=0.002)).scatter
    single = settle(fitted(0.0003, 1, course_jitter_m=0.002)).scatter
    assert 0.0005 < drifting.drift < 0.004
    assert drifting.aside >= drifting.drift
    assert settle(fitted(0.0, 0)).scatter.drift < 0.0002
    assert single.drift < drifting.drift


def pose_error(settled: Settled) -> float:
    """Normalised squared error of a settled pose."""
    error = np.r_[turned_off(settled.fit), settled.fit.cam_from_ground.t - SCENE.cam_from_ground.t]
    return float(error @ np.linalg.solve(settled.covariance, error))


@pytest.mark.slow
def test_the_truth_lies_within_the_stated_uncertainty_of_uneven_courses() -> None:
    found = [pose_error(settle(fitted(0.0005, seed, course_jitter_m=0.002))) for seed in range(8)]
    # Chi-square of 6 degrees of freedom: 99.9 % lie below 22.5, half of them below 5.3.
    assert max(found) < 22.5
    assert 1.0 < np.median(found) < 10.0


@pytest.mark.slow
def test_the_truth_lies_within_the_stated_uncertainty_of_courses_that_drift() -> None:
    found = [pose_error(settle(fitted(0.0005, seed, course_drift_m=0.0015))) for seed in range(8)]
    assert max(found) < 22.5
    assert 1.0 < np.median(found) < 10.0


def set_out_askew(fit: Fit, rng: np.random.Generator, size_m: float) -> Fit:
    """The fit as if either family were askew, and fanned out, by about so much at the field's ends."""
    for family in (ALONG_X, ALONG_Y):
        own = np.flatnonzero(fit.stations.family == family)
        ground = fit.stations.ground[own]
        along, across = (2.0 * (ground - ground.min(0)) / np.ptp(ground, axis=0) - 1.0).T
        askew, fanned = size_m * rng.standard_normal(2)
        off_px = (askew * along + fanned * along * across) * fit.profiles.px_per_unit[own]
        fit = fit.measured_at(own, fit.offsets.offset_px[own] + off_px, fit.offsets.sigma_px[own])
    return fit


@pytest.mark.slow
def test_the_truth_lies_within_the_stated_uncertainty_of_courses_that_are_set_out_askew() -> None:
    rng, found = np.random.default_rng(3), []
    for seed in range(8):
        # A joint lies aside by the mean of its two courses.
        fit = set_out_askew(fitted(0.0005, seed, course_jitter_m=0.002), rng, 0.0014)
        # The widths are those of the picture, where nothing is askew.
        found.append(pose_error(settle(fit, widths=False)))
    assert max(found) < 22.5
    assert 1.0 < np.median(found) < 10.0


def test_settling_lands_nearer_to_the_truth_than_the_fit_with_independent_stations() -> None:
    def miss(fit: Fit) -> float:
        return float(np.linalg.norm(turned_off(fit)))

    fits = [fitted(0.002, seed) for seed in range(6)]
    assert np.mean([miss(settle(f).fit) ** 2 for f in fits]) < np.mean([miss(f) ** 2 for f in fits])


def with_unknown_camera(fit: Fit) -> Fit:
    """The fit as one whose camera and ratio of sides are solved for as well."""
    size = float(fit.camera.width)
    free = Free(
        ratio=True, focal=True, centre=True, radial=True, nominal=fit.camera, focal_sigma=0.5,
        centre_sigma_px=0.02 * size, radial_sigma=0.1,
    )  # fmt: skip
    return replace(fit, free=free)


def moved_far(fit: Fit) -> Fit:
    """The fit where a camera of another focal length, turned by three degrees, sees its joints."""
    motion = np.zeros(MOTION)
    motion[:3], motion[RATIO], motion[FOCAL] = (0.05, -0.02, 0.01), 0.02, 0.08
    motion[3:6] = fit.cam_from_ground.t - rotation_from_vector(motion[:3]) @ fit.cam_from_ground.t
    return relinearised(fit, fit.moved(motion))


def test_a_fit_that_is_moved_knows_the_distances_and_the_slopes_where_it_is() -> None:
    far = moved_far(with_unknown_camera(fitted(0.002, 1)))
    px = project_ground(far.camera, far.cam_from_ground, far.stations.ground)
    measured = far.profiles.centre_px + far.offsets.offset_px[:, None] * far.profiles.normal
    assert far.distances_px == pytest.approx(((px - measured) * far.profiles.normal).sum(1), abs=1e-9)
    # The stations are stretched with the lattice, whose joints lie at whole multiples of its spacing.
    along = far.stations.family == ALONG_X
    assert far.stations.ground[along, 1] / far.grid.spacing_y == pytest.approx(far.stations.line[along])
    for parameter in (0, 4, RATIO, FOCAL):
        step = np.zeros(MOTION)
        step[parameter] = 1e-5
        moved = far.moved(step)
        assert relinearised(far, moved).distances_px == pytest.approx(moved.distances_px, abs=1e-4)


def test_the_likeliest_pose_of_an_unknown_camera_is_the_same_from_wherever_it_is_looked_for() -> None:
    near = with_unknown_camera(fitted(0.002, 1))
    one, other = settle(near, widths=False), settle(moved_far(near), widths=False)
    turn = vector_from_rotation(other.fit.cam_from_ground.R @ one.fit.cam_from_ground.R.T)
    assert np.linalg.norm(turn) < 0.1 * np.sqrt(np.trace(one.covariance[:3, :3]))
    assert other.fit.camera.fx == pytest.approx(one.fit.camera.fx, rel=2e-3)


def test_knowledge_of_a_parameter_is_kept_where_it_is_tighter_than_the_photo() -> None:
    fit = fitted(0.002, 0)
    free = Free(focal=True)
    prior = Prior(np.zeros(PARAMETERS), np.where(np.arange(PARAMETERS) == FOCAL, 1e-6, np.inf))
    estimate = estimate_motion(fit, free.mask, prior)
    assert abs(estimate.parameters[FOCAL]) < 1e-5
    # The factor for what the model misses acts on everything.
    assert np.sqrt(estimate.covariance[FOCAL, FOCAL]) == pytest.approx(1e-6, rel=0.5)


@given(
    st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    st.tuples(st.integers(-12, 12), st.integers(-12, 12)),
    st.integers(0, 3),
    st.sampled_from(["slab", "camera_height", "none"]),
    st.integers(0, 1000),
)
@settings(deadline=None, derandomize=True, max_examples=40)
def test_the_answers_frame_and_scale_carry_the_covariance_as_finite_motions_do(
    vector: list[float],
    slabs: tuple[int, int],
    turns: int,
    source: Literal["slab", "camera_height", "none"],
    seed: int,
) -> None:
    pose = Rigid(rotation_from_vector(np.array(vector)), np.array([0.3, -0.2, 4.0]))
    grid, (i, j) = Grid(0.7, 0.45, 0.37), slabs

    def answer(motion: np.ndarray) -> tuple[Frame, Rigid, float]:
        """The frame, the pose in it, and the scale, so many slabs away from the crossing of the fit."""
        a, b, shift = 0.7 * np.exp(0.5 * motion[6]), 0.45 * np.exp(-0.5 * motion[6]), 0.37 + motion[7]
        now = Rigid(rotation_from_vector(motion[:3]) @ pose.R, pose.t + motion[3:6])
        frame = Frame(turns, np.array([(i + j * shift) * a, j * b]), j * a)
        moved = frame.pose(now)
        height = float(moved.origin_in_a[2])
        return frame, moved, {"slab": 1.3, "camera_height": 1.6 / height, "none": 2.0 / (a + b)}[source]

    frame, moved, scale = answer(np.zeros(8))
    L = np.random.default_rng(seed).normal(size=(8, 8))
    small, columns = 1e-6, []
    for motion in small * np.eye(8):
        (_, one, more), (_, other, less) = answer(motion), answer(-motion)
        turn, step = vector_from_rotation(one.R @ other.R.T), more * one.t - less * other.t
        columns.append(np.r_[turn, step] / (2.0 * small))
    A = np.stack(columns, 1)
    told = scaled_covariance(frame.covariance(L @ L.T, pose), moved, grid, scale, source)
    expected = A @ L @ L.T @ A.T
    np.testing.assert_allclose(told, expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max())


def test_a_pose_without_camera_and_slab_is_within_what_it_states() -> None:
    # All that is told is a height: the sides' ratio is open, and the crossing that is reported slabs away.
    camera = Camera(1200, 900, 960.0, 957.0, 585.0, 470.0, (0.02, 0.0, 0.0, 0.0, 0.0))
    true = look_at_ground(pitch_deg=30.0, height_m=1.6, heading_deg=32.0, roll_deg=1.0, foot_m=(0.13, 0.21))
    scene = SyntheticScene(camera, true, spacing_m=(0.6, 0.4), joint_width_m=0.012, jitter_m=0.0015, seed=3)
    found = align(render_paving(scene).pixels, None, camera_height=1.6).pose
    pose = found.cam_from_ground
    turns = [vector_from_rotation(pose.R @ (true.R @ quarter_turns(k)).T) for k in range(4)]
    turn = min(turns, key=lambda each: float(np.linalg.norm(each)))
    slabs = true.R[:, :2] * scene.spacing_m
    whole = np.round(np.linalg.lstsq(slabs, pose.t - true.t, rcond=None)[0])
    error = np.r_[turn, pose.t - true.t - slabs @ whole]
    # But for the height, which is known.
    size, axes = np.linalg.eigh(found.covariance)
    assert size[0] < 1e-6 * size[1]
    assert np.sum((axes.T @ error)[1:] ** 2 / size[1:]) < chi2.ppf(0.999, 5)


@pytest.mark.parametrize("jitter_m", [0.0, 0.002])
def test_a_right_camera_is_consistent(jitter_m: float) -> None:
    check = check_camera(fitted(jitter_m, 0), picture(jitter_m, 0))
    assert check.consistent
    assert abs(check.focal_px - SCENE.camera.fx) < 4 * check.focal_sigma_px


def test_a_calibration_half_a_percent_off_is_no_contradiction() -> None:
    assert check_camera(fitted(0.002, 0, 1.005), picture(0.002, 0)).consistent


@pytest.mark.parametrize("focal", [pytest.param(0.92, marks=pytest.mark.slow), 1.1])
def test_a_wrong_focal_length_is_called_out_and_the_right_one_named(focal: float) -> None:
    check = check_camera(fitted(0.0, 0, focal), picture(0.0, 0))
    assert not check.consistent
    assert check.focal_px == pytest.approx(SCENE.camera.fx, rel=0.01)


def test_joints_that_are_missed_betray_a_camera_that_the_others_fit() -> None:
    # Unbroken joints fit any focal length: the cross joints alone are off, and soon have no weight.
    fit = bond_fitted(0.5, 0.95)
    assert np.mean(fit.weight[fit.stations.family == ALONG_Y] < 0.1) > 0.2
    check = check_camera(fit, bonded(0.5))
    assert not check.consistent
    assert check.focal_px == pytest.approx(BOND.camera.fx, rel=0.002)
    assert check.focal_sigma_px < 0.002 * check.focal_px


@pytest.mark.parametrize("moved", [0.485, 0.515])
def test_a_shift_that_a_wrong_camera_explains_is_no_refuge_for_it(moved: float) -> None:
    fit = bond_fitted(0.5, 0.95)
    fit = replace(fit, grid=replace(fit.grid, shift=moved))
    assert not check_camera(fit, bonded(0.5)).consistent


def test_a_camera_that_misses_a_handful_of_joints_fewer_is_no_word_against_the_given_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    gray = picture(0.002, 0)
    right, other = fitted(0.002, 0), fitted(0.002, 0, 1.08)

    def missing(fit: Fit, count: int) -> Fit:
        """As the right fit lies, but for some joints that are seen far off their lines."""
        distances = np.clip(right.distances_px, -1.0, 1.0)
        distances[:count] = 100.0
        rows = {"stations": right.stations, "profiles": right.profiles, "offsets": right.offsets}
        rows |= {"usable": np.ones(len(distances), bool), "sigma_px": right.sigma_px}
        rows |= {"solution": right.solution, "rimmed": right.rimmed, "bevel": right.bevel}
        return replace(fit, distances_px=distances, **rows)

    monkeypatch.setattr(camera_check, "_fits_with_free_camera", lambda *asked: [missing(other, 2)])
    assert check_camera(missing(right, 6), gray).consistent
    assert not check_camera(missing(right, len(right.distances_px) // 4), gray).consistent


def of_stations(fit: Fit, rows: np.ndarray) -> Fit:
    """A fit as if it had been made with some of its stations alone."""
    offsets = replace(fit.offsets, **{k: v[rows] for k, v in vars(fit.offsets).items()})
    told = fit.solution
    solution = replace(told, distances_px=told.distances_px[rows], jacobian=told.jacobian[rows])
    own = {
        name: getattr(fit, name)[rows] for name in ("distances_px", "sigma_px", "usable", "rimmed", "bevel")
    }
    return replace(
        fit,
        stations=fit.stations.take(rows),
        profiles=fit.profiles.take(rows),
        offsets=offsets,
        solution=solution,
        **own,
    )


@pytest.mark.parametrize(("kept", "off", "consistent"), [(4, 0.0, None), (1, 0.0, False), (1, 2.0, True)])
def test_a_camera_by_which_few_joints_lie_smoother_takes_no_more_than_the_vouching_for_the_given_one(
    monkeypatch: pytest.MonkeyPatch, kept: int, off: float, consistent: bool | None
) -> None:
    # A quarter of the joints is missed; a free camera misses none, of all of them or of every fourth. It has
    # no say at all where its axis is some focal lengths off the picture.
    right, other = fitted(0.002, 0), fitted(0.002, 0, 1.08).camera
    numbers = np.arange(len(right.distances_px))
    given = replace(right, distances_px=np.where(numbers % 4 == 0, 100.0, right.distances_px))
    camera = replace(other, cx=other.cx + off * other.fx)
    smoother = replace(right, camera=camera, distances_px=0.9 * right.distances_px)
    freed = of_stations(smoother, np.flatnonzero(numbers % kept == 0))
    monkeypatch.setattr(camera_check, "_fits_with_free_camera", lambda *asked: [freed])
    assert check_camera(given, picture(0.002, 0)).consistent is consistent


def test_a_shift_that_slabs_are_really_laid_by_is_no_contradiction() -> None:
    check = check_camera(bond_fitted(0.485, 1.0), bonded(0.485))
    assert check.consistent
    assert check.focal_px == pytest.approx(BOND.camera.fx, rel=0.003)


@cache
def bent(k1: float) -> tuple[np.ndarray, Fit]:
    """A photo through a bent lens, and its fit with a camera that knows nothing of the bend."""
    lens = replace(SCENE, camera=replace(SCENE.camera, dist=(k1, k1 * k1, *SCENE.camera.dist[2:])))
    gray = as_gray(render_paving(lens).pixels).astype(np.float32)
    return gray, fit_to(gray, Grid(0.4, 0.4), 1.0)


def test_a_lens_that_the_camera_leaves_out_is_called_out_and_its_bend_told() -> None:
    gray, fit = bent(-0.08)
    check = check_camera(fit, gray)
    assert not check.consistent
    assert check.radial_shift == pytest.approx(-0.08, rel=0.1)
    assert check.focal_px == pytest.approx(SCENE.camera.fx, rel=0.005)


def test_a_lens_that_is_hardly_bent_is_no_contradiction() -> None:
    gray, fit = bent(-0.004)
    check = check_camera(fit, gray)
    assert check.consistent
    assert check.radial_shift == pytest.approx(-0.004, abs=0.003)


def other_camera(fit: Fit, longer: float, rougher: float) -> Fit:
    """The fit as if it had been made with a longer focal length, its joints so much farther off."""
    camera = replace(fit.camera, fx=longer * fit.camera.fx, fy=longer * fit.camera.fy)
    return replace(fit, camera=camera, distances_px=rougher * fit.distances_px)


@pytest.mark.parametrize(("found", "consistent"), [((1.0, 1.25), True), ((1.25,), False)])
def test_a_camera_is_not_to_blame_for_joints_that_one_like_it_finds_as_well(
    stack_fit: Fit, monkeypatch: pytest.MonkeyPatch, found: tuple[float, ...], consistent: bool
):
    # Half of the joints are missed, and found when they are measured anew: too roughly for a better camera by
    # the given one, just well enough by one that is wrong.
    usable = stack_fit.usable & (np.arange(len(stack_fit.usable)) % 2 == 0)
    rough = {1.0: 1.12, 1.25: 1.05}
    fits = [other_camera(stack_fit, longer, rough[longer]) for longer in found]
    monkeypatch.setattr("autoreg.slabs.camera_check._fits_with_free_camera", lambda *_: iter(fits))
    picture = np.zeros((stack_fit.camera.height, stack_fit.camera.width), np.float32)
    check = check_camera(replace(stack_fit, usable=usable), picture)
    assert check.consistent == consistent


def test_so_few_lines_that_any_camera_suits_them_contradict_none(
    stack_fit: Fit, monkeypatch: pytest.MonkeyPatch
):
    stations = stack_fit.stations
    middle = [np.sort(np.unique(stations.line[stations.family == f]))[2:5] for f in (0, 1)]
    three = np.isin(stations.line, middle[0]) & (stations.family == 0)
    three |= np.isin(stations.line, middle[1]) & (stations.family == 1)
    few = replace(stack_fit, usable=stack_fit.usable & three)
    monkeypatch.setattr(
        "autoreg.slabs.camera_check._fits_with_free_camera", lambda *_: pytest.fail("asked for nothing")
    )
    picture = np.zeros((stack_fit.camera.height, stack_fit.camera.width), np.float32)
    assert check_camera(few, picture).consistent


@pytest.mark.parametrize(
    ("off", "sigma", "held"), [(1e-3, 1e-3, True), (3e-3, 1e-3, False), (1e-3, 5e-3, False)],
    ids=["told exactly", "nominal sizes", "joints that hardly tell it"],
)  # fmt: skip
def test_a_ratio_that_was_told_is_held_where_the_joints_confirm_it(
    stack_fit: Fit, off: float, sigma: float, held: bool
) -> None:
    ratio = 1.5 * np.exp(-off)
    free = Free(ratio=True, slab=(ratio, 1.0), ratio_sigma=0.01)
    covariance = np.diag(np.full(MOTION, 1e-8))
    covariance[RATIO, RATIO] = sigma**2
    covariance[0, RATIO] = covariance[RATIO, 0] = 5e-5 * sigma
    nothing = np.zeros(MOTION)
    estimate = Estimate(nothing, nothing, covariance, Scatter(1e-3, 1e-3, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0))
    told = _with_told_ratio(replace(stack_fit, free=free), estimate)
    assert (told is not None) == held
    if told is not None:
        assert told.parameters[RATIO] == pytest.approx(-off)
        assert told.parameters[0] == pytest.approx(-off * 5e-5 / sigma)
        assert told.covariance[RATIO] == pytest.approx(0.0, abs=1e-15)
        assert told.covariance[0, 0] == pytest.approx(1e-8 - 5e-5**2)


@pytest.mark.parametrize(
    ("shift", "chi_square", "alike"),
    [
        ((0.03, 4.0, -9.0, 0.0), 5.0, True),
        ((0.03, 4.0, -9.0, 0.0), 50.0, False),
        ((0.43, 4.0, -9.0, 0.0), 5.0, False),
        ((0.03, 9.7, -436.0, 0.0), 5.0, False),
    ],
)
def test_a_camera_far_from_the_given_one_does_not_clear_it(
    stack_fit: Fit, shift: tuple[float, ...], chi_square: float, alike: bool
) -> None:
    nothing = np.zeros(MOTION)
    motion = Estimate(nothing, nothing, np.eye(MOTION), Scatter(1e-3, 1e-3, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0))
    told = camera_check._Told(stack_fit, motion, chi_square, np.array(shift))
    assert camera_check._alike(told, stack_fit) is alike
