from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from paved import CAMERA, CHECKER, HALF_BOND, STACK, fit_of, gray_of, misses, nudged, true_grid

from autoreg.fitting.fit import Fit
from autoreg.fitting.refine import refine, refine_until_still
from autoreg.geometry import angle_between_rotations
from autoreg.ground.points import project_ground
from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid
from autoreg.solve.freedom import Free
from autoreg.solve.joint_data import PARAMETERS
from autoreg.solve.solver import Solution
from autoreg.synthetic import SyntheticPhoto, look_at_ground, render_paving

NOTHING = Solution("converged", np.zeros(PARAMETERS), 0.0, np.zeros(3), np.zeros((3, PARAMETERS)), 1)


def miss_of(fit: Fit, photo: SyntheticPhoto) -> tuple[float, float]:
    spacing = (fit.grid.spacing_x or 1.0, fit.grid.spacing_y)
    return misses(fit.cam_from_ground, spacing, replace(photo, camera=fit.camera))


def test_the_pose_of_a_stack_comes_back(stack_fit: Fit, stack_photo: SyntheticPhoto):
    angle_deg, crossing_px = miss_of(stack_fit, stack_photo)
    assert angle_deg < 0.01
    assert crossing_px < 0.05
    assert stack_fit.solution.outcome == "converged"


def test_the_pose_of_a_running_bond_comes_back(half_fit: Fit, half_photo: SyntheticPhoto):
    angle_deg, crossing_px = miss_of(half_fit, half_photo)
    assert angle_deg < 0.01
    assert crossing_px < 0.05


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_start_does_not_matter_within_the_search(stack_photo: SyntheticPhoto, stack_fit: Fit, seed: int):
    start = nudged(stack_photo.cam_from_ground, 0.4, 0.01, seed)
    fit = refine(
        gray_of(stack_photo),
        stack_photo.camera,
        start,
        true_grid(stack_photo),
        free=Free(),
        search=0.15,
        reaches=(3.0, 6.0, 9.0),
    )
    assert fit is not None
    turned = angle_between_rotations(fit.cam_from_ground.R, stack_fit.cam_from_ground.R)
    assert np.rad2deg(turned) < 0.005


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_what_a_narrow_search_finds_moves_little_when_it_is_measured_again(
    stack_photo: SyntheticPhoto, stack_fit: Fit, seed: int
):
    picture, start = gray_of(stack_photo), nudged(stack_photo.cam_from_ground, 0.05, 0.002, seed)
    # Looks that the picture at detection scale may have told.
    width = (0.8 * stack_fit.strip.width[0], 1.2 * stack_fit.strip.width[1])
    strip, grid = replace(stack_fit.strip, width=width), stack_fit.grid
    found = refine(picture, CAMERA, start, grid, free=Free(), search=0.04, reaches=(9.0,), strip=strip)
    assert found is not None
    again = refine(
        picture, CAMERA, found.cam_from_ground, grid,
        free=Free(), search=0.0, reaches=(9.0,), strip=found.strip,
    )  # fmt: skip
    assert again is not None
    before, after = (
        project_ground(CAMERA, fit.cam_from_ground, again.stations.ground) for fit in (found, again)
    )
    across = ((after - before) * again.profiles.normal).sum(1)
    assert np.sqrt(np.mean(across**2)) < 0.0015


def test_dark_joints_are_told_from_light_ones_and_from_none(
    stack_fit: Fit, half_fit: Fit, checker_photo: SyntheticPhoto
):
    assert stack_fit.strip.polarity == half_fit.strip.polarity == (-1, -1)
    light = render_paving(replace(STACK, joint_tone=220.0, slab_tone=110.0, colour=False))
    assert fit_of(light).strip.polarity == (1, 1)
    checker = fit_of(checker_photo)
    assert checker.strip.polarity == (0, 0)
    # Tiles that meet without a joint leave half a joint width of doubt if they are given one.
    assert max(checker.strip.width) < 0.1 * CHECKER.spacing_m[0] * 0.1
    angle_deg, crossing_px = miss_of(checker, checker_photo)
    assert angle_deg < 0.02
    assert crossing_px < 0.1


def test_wide_joints_are_measured_by_both_of_their_edges():
    photo = render_paving(replace(STACK, joint_width_m=0.035))
    fit = fit_of(photo)
    assert (fit.strip.width[0] * fit.profiles.px_per_unit).max() > 11.0
    assert fit.strip.width == pytest.approx((0.035, 0.035), rel=0.05)
    angle_deg, crossing_px = miss_of(fit, photo)
    assert angle_deg < 0.01
    assert crossing_px < 0.05


def test_the_joints_width_is_measured(stack_fit: Fit, half_fit: Fit):
    for fit, scene in ((stack_fit, STACK), (half_fit, HALF_BOND)):
        assert fit.strip.width == pytest.approx([scene.joint_width_m] * 2, rel=0.35)


def test_residuals_scatter_as_their_stated_sigma_says(stack_fit: Fit):
    normalised = (stack_fit.distances_px / stack_fit.sigma_px)[stack_fit.usable]
    # The median of |N(0, 1)| is 0.674.
    assert 0.6 < np.median(np.abs(normalised)) / 0.674 < 1.5


def test_irregular_slabs_scatter_as_much_as_they_were_moved():
    jitter_m = 0.003
    scene = replace(STACK, joint_width_m=0.016, jitter_m=jitter_m, colour=False, seed=8)
    photo = render_paving(scene)
    fit = fit_of(photo)
    angle_deg, crossing_px = miss_of(fit, photo)
    assert angle_deg < 0.15
    assert crossing_px < 1.5
    near = fit.usable & (fit.profiles.px_per_unit > np.median(fit.profiles.px_per_unit))
    on_ground = fit.distances_px[near] / fit.profiles.px_per_unit[near]
    # A joint lies between two slabs that moved, and its centre by the mean of both.
    expected = jitter_m / np.sqrt(2)
    assert 0.5 < np.median(np.abs(on_ground)) / 0.674 / expected < 1.6
    normalised = fit.distances_px[fit.usable] / fit.sigma_px[fit.usable]
    assert np.median(np.abs(normalised)) < 1.5


def test_a_fit_grows_no_farther_once_a_round_moves_nothing(stack_photo: SyntheticPhoto, stack_fit: Fit):
    def reached(steady_px: float) -> float:
        fit = refine(
            gray_of(stack_photo), CAMERA, stack_fit.cam_from_ground, stack_fit.grid,
            free=Free(), search=0.1, reaches=(3.0, 6.0), strip=stack_fit.strip, steady_px=steady_px,
        )  # fmt: skip
        assert fit is not None
        eye = fit.cam_from_ground.origin_in_a
        return float(np.linalg.norm(fit.stations.ground - eye[:2], axis=1).max() / eye[2])

    # The fit that it starts from is the answer already.
    assert reached(steady_px=0.1) < 3.5
    assert reached(steady_px=0.0) > 4.0


def test_a_free_focal_length_comes_back(stack_photo: SyntheticPhoto):
    wrong = replace(CAMERA, fx=1.02 * CAMERA.fx, fy=1.02 * CAMERA.fy)
    fit = fit_of(replace(stack_photo, camera=wrong), Free(focal=True))
    assert fit.camera.fx == pytest.approx(CAMERA.fx, rel=0.003)
    assert fit.camera.fx / fit.camera.fy == pytest.approx(CAMERA.fx / CAMERA.fy)


def test_a_free_ratio_of_the_sides_comes_back(stack_photo: SyntheticPhoto):
    fit = refine(
        gray_of(stack_photo),
        stack_photo.camera,
        stack_photo.cam_from_ground,
        Grid(0.6 * 1.01, 0.4 / 1.01),
        free=Free(ratio=True),
        search=0.1,
        reaches=(2.5, 4.0, 7.0, 9.0),
    )
    assert fit is not None
    assert (fit.grid.spacing_x or 0.0) / fit.grid.spacing_y == pytest.approx(1.5, rel=0.001)


def test_what_is_frozen_stays(stack_fit: Fit):
    assert stack_fit.camera == CAMERA
    assert stack_fit.grid == Grid(0.6, 0.4)


def test_without_sight_of_the_ground_there_is_no_fit(stack_photo: SyntheticPhoto):
    up = look_at_ground(pitch_deg=-40.0, height_m=1.6)
    options = {"free": Free(), "search": 0.1}
    assert refine(gray_of(stack_photo), CAMERA, up, Grid(0.6, 0.4), reaches=(3.0, 6.0), **options) is None
    assert refine_until_still(gray_of(stack_photo), CAMERA, up, Grid(0.6, 0.4), reach=6.0, **options) is None


def test_a_fit_that_is_still_does_not_move_when_repeated(stack_photo: SyntheticPhoto, stack_fit: Fit):
    options = {"free": Free(), "search": 0.0, "reach": 9.0}
    picture = gray_of(stack_photo)
    first = refine_until_still(picture, CAMERA, stack_fit.cam_from_ground, stack_fit.grid, **options)
    assert first is not None
    options["strip"] = first.strip
    again = refine_until_still(picture, CAMERA, first.cam_from_ground, first.grid, **options)
    assert again is not None
    ground, _ = stack_photo.crossings(margin_px=20.0, reach_m=5.0)
    ground = np.column_stack([ground, np.zeros(len(ground))])
    a, b = (CAMERA.project(fit.cam_from_ground.apply(ground)) for fit in (first, again))
    assert np.abs(a - b).max() < 0.01


def test_unusable_joints_weigh_nothing_and_others_at_most_one(stack_fit: Fit):
    assert not stack_fit.weight[~stack_fit.usable].any()
    assert (stack_fit.weight <= 1.0).all()
    assert stack_fit.weight[stack_fit.usable].mean() > 0.5


def test_both_families_carry_the_fit(half_fit: Fit):
    counts = [int((half_fit.usable & (half_fit.stations.family == f)).sum()) for f in (ALONG_X, ALONG_Y)]
    assert min(counts) > 50
