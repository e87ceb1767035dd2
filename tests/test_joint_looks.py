from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from paved import CHECKER, STACK, gray_of, misses, nudged, true_grid

from autoreg.fitting.fit import Fit
from autoreg.fitting.refine import refine
from autoreg.ground.stations import Stations
from autoreg.joints.edges import Offsets, fit_offsets
from autoreg.joints.joint_looks import NO_JOINT, Strip, bloom_px
from autoreg.joints.look_estimates import estimate_strip
from autoreg.joints.profiles import sample_profiles
from autoreg.slabs.uncertainty import settle
from autoreg.solve.freedom import Free
from autoreg.synthetic import SyntheticPhoto, render_paving

BARE = Strip((0.001, 0.001), 0.9, (0, 0), True)


def stations_of(family: np.ndarray) -> Stations:
    n, zero = len(family), np.zeros(len(family), int)
    return Stations(np.zeros((n, 2)), np.ones(n), family, zero, zero, np.arange(n))


def offsets_of(offset: np.ndarray, step: np.ndarray) -> Offsets:
    one = np.ones(len(offset))
    return Offsets(offset, 0.05 * one, 0.0 * one, step, one)


@pytest.fixture(scope="module")
def overexposed() -> SyntheticPhoto:
    """A checker floor whose bright tiles are blown out: blurred in the lens, then clipped."""
    photo = render_paving(replace(CHECKER, noise_grey=0.5, texture=0.0, tone_spread=0.0, colour=False))
    light = cv2.GaussianBlur(photo.pixels.astype(np.float32), (0, 0), 1.2)
    return replace(photo, pixels=np.clip(2.0 * light - 30.0, 0, 255).astype(np.uint8))


def fit_to(photo: SyntheticPhoto) -> Fit:
    start = nudged(photo.cam_from_ground, turn_deg=0.2, move_m=0.005)
    fit = refine(
        gray_of(photo), photo.camera, start, true_grid(photo),
        free=Free(), search=0.1, reaches=(3.0, 6.0, 9.0, 9.0),
    )  # fmt: skip
    assert fit is not None
    return fit


def test_the_bloom_is_half_of_what_edges_up_and_down_differ_by():
    rng = np.random.default_rng(3)
    family, step = np.repeat([0, 1], 40), np.tile([30.0, -50.0], 40)
    # Whatever pushes a family as a whole is the pose's business.
    common = np.where(family == 0, 0.4, -0.7)
    offset = common + np.sign(step) * np.where(family == 0, 0.25, 0.1) + rng.normal(0, 0.001, 80)
    bloom = bloom_px(offsets_of(offset, step), stations_of(family), BARE, np.ones(80, bool))
    np.testing.assert_allclose(bloom, np.sign(step) * np.where(family == 0, 0.25, 0.1), atol=1e-3)


def test_joints_that_are_dark_or_light_do_not_bloom():
    family, step = np.repeat([0, 1], 40), np.tile([30.0, -50.0], 40)
    offsets = offsets_of(0.3 * np.sign(step), step)
    lined = replace(BARE, polarity=(-1, 0))
    bloom = bloom_px(offsets, stations_of(family), lined, np.ones(80, bool))
    np.testing.assert_allclose(bloom, np.where(family == 0, 0.0, 0.3 * np.sign(step)))


def test_edges_of_one_kind_alone_tell_no_bloom():
    family, step = np.zeros(80, int), np.where(np.arange(80) < 70, 40.0, -40.0)
    offsets = offsets_of(0.3 * np.sign(step), step)
    assert not bloom_px(offsets, stations_of(family), BARE, np.ones(80, bool)).any()
    # Nor do those that could not be measured.
    even = np.tile([40.0, -40.0], 40)
    usable = (np.arange(80) % 2 == 0) | (np.arange(80) < 4)
    assert not bloom_px(offsets_of(0.3 * np.sign(even), even), stations_of(family), BARE, usable).any()


def test_overexposed_tiles_look_larger_and_their_joints_still_lie_on_their_lines(overexposed: SyntheticPhoto):
    fit = fit_to(overexposed)
    taken_off = bloom_px(
        replace(fit.offsets, offset_px=-fit.distances_px), fit.stations, fit.strip, fit.usable
    )
    assert np.abs(taken_off).max() < 0.02
    assert np.median(np.abs(fit.distances_px[fit.usable])) < 0.06


def test_overexposed_tiles_are_not_taken_for_crooked_ones(overexposed: SyntheticPhoto):
    settled = settle(fit_to(overexposed))
    angle_deg, crossing_px = misses(settled.fit.cam_from_ground, CHECKER.spacing_m, overexposed)
    assert angle_deg < 0.02
    assert crossing_px < 0.1
    assert settled.scatter.place < 0.0005 * settled.fit.grid.spacing_y


@pytest.mark.parametrize("width_m", [0.01, 0.02, 0.04])
def test_joints_of_any_width_are_measured_by_both_edges_from_the_first_look_on(width_m: float):
    scene = replace(STACK, spacing_m=(0.4, 0.4), joint_width_m=width_m, colour=False)
    photo = render_paving(scene)
    start = nudged(photo.cam_from_ground, turn_deg=0.5, move_m=0.02)
    fit = refine(
        gray_of(photo), photo.camera, start, true_grid(photo), free=Free(), search=0.1, reaches=(6.0,)
    )
    assert fit is not None
    assert fit.strip.polarity == (-1, -1)
    assert np.allclose(fit.strip.width, width_m, rtol=0.2)


def test_a_picture_out_of_focus_is_not_taken_for_one_of_wide_joints():
    scene = replace(STACK, spacing_m=(0.4, 0.4), joint_width_m=0.01, blur_px=5.0, colour=False)
    photo = render_paving(scene)
    start = nudged(photo.cam_from_ground, turn_deg=0.2, move_m=0.01)
    fit = refine(
        gray_of(photo), photo.camera, start, true_grid(photo), free=Free(), search=0.1, reaches=(6.0,) * 4
    )
    assert fit is not None
    assert fit.strip.polarity == (-1, -1)
    # Blur and width share the spread of light between them; by width alone it would be 2.2.
    assert 4.0 < fit.strip.blur_px < 6.0
    angle_deg, crossing_px = misses(settle(fit).fit.cam_from_ground, scene.spacing_m, photo)
    assert angle_deg < 0.06
    assert crossing_px < 0.1 * scene.blur_px


@pytest.fixture(scope="module")
def large_checker() -> SyntheticPhoto:
    camera = CHECKER.camera.scaled(2 * CHECKER.camera.width, 2 * CHECKER.camera.height)
    return render_paving(replace(CHECKER, camera=camera))


@pytest.mark.parametrize("way", [-0.5, 0.5])
def test_a_wide_strip_laid_beside_the_steps_of_a_checker_floor_is_given_up(
    large_checker: SyntheticPhoto, checker_photo: SyntheticPhoto, way: float
):
    """It fits a step as well as can be, half its width aside: farther than the fit of a bare step gets."""
    width_m, pose = 0.0387 * CHECKER.spacing_m[0], large_checker.cam_from_ground
    beside = replace(pose, t=pose.t + way * width_m * (pose.R @ np.array([1.0, 1.0, 0.0])))
    stations = fit_to(checker_photo).stations
    profiles = sample_profiles(gray_of(large_checker), large_checker.camera, beside, stations, 16.0)
    near = np.flatnonzero(width_m * profiles.px_per_unit > 6.5)
    profiles, stations = profiles.take(near), stations.take(near)
    assert np.bincount(stations.family).min() > 10
    strip, side = Strip((width_m, width_m), 1.0), np.array(CHECKER.spacing_m)
    offsets = fit_offsets(profiles, np.zeros(len(near)), width_m * profiles.px_per_unit, strip.blur_px)
    seen = offsets.strength > 0.5
    assert seen.mean() > 0.8
    told = estimate_strip(profiles, offsets, stations, strip, seen, side, thorough=True)
    assert told.width == pytest.approx((NO_JOINT * side[1], NO_JOINT * side[0]))
