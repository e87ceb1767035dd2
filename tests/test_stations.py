from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paved import CAMERA, STACK, true_grid

from autoreg.camera import Camera
from autoreg.ground.points import inside_convex, project_ground, visible_ground
from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid, slab_sides, visible_sides
from autoreg.ground.stations import place_stations
from autoreg.synthetic import SyntheticPhoto, look_at_ground

POSE = STACK.cam_from_ground
SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
SHIFTS = st.sampled_from([0.0, 1 / 2, 1 / 3, 2 / 3, 0.27])


@given(SHIFTS, st.floats(0.2, 1.0), st.floats(0.2, 1.0))
@settings(deadline=None, derandomize=True, max_examples=40)
def test_every_side_lies_on_the_joint_that_its_numbers_name(shift: float, a: float, b: float):
    sides = slab_sides(Grid(a, b, shift), np.array([-2.0, -1.5]), np.array([1.7, 2.1]))
    x, y = sides.ends[..., 0], sides.ends[..., 1]
    along_x, along_y = sides.family == ALONG_X, sides.family == ALONG_Y
    assert np.allclose(y[along_x], b * sides.line[along_x, None])
    column = sides.line + sides.cell * shift
    assert np.allclose(x[along_y], a * column[along_y, None])
    assert np.allclose(y[along_y], b * (sides.cell[along_y, None] + [0, 1]))


@given(SHIFTS)
@settings(deadline=None, derandomize=True, max_examples=10)
def test_no_side_is_there_twice_and_the_pieces_of_a_joint_follow_on_one_another(shift: float):
    sides = slab_sides(Grid(0.6, 0.4, shift), np.array([-2.0, -1.5]), np.array([1.7, 2.1]))
    names = np.stack([sides.family, sides.line, sides.cell], 1)
    assert len(np.unique(names, axis=0)) == len(sides)
    for line in np.unique(sides.line[sides.family == ALONG_X]):
        pieces = sides.take(np.flatnonzero((sides.family == ALONG_X) & (sides.line == line)))
        pieces = pieces.take(np.argsort(pieces.ends[:, 0, 0]))
        assert np.allclose(pieces.ends[1:, 0], pieces.ends[:-1, 1])


def test_cross_joints_of_both_courses_cut_an_unbroken_joint():
    sides = slab_sides(Grid(0.6, 0.4, 1 / 3), np.zeros(2), np.full(2, 1.5))
    cuts = sides.ends[(sides.family == ALONG_X) & (sides.line == 2), 0, 0]
    # Course 2 starts at a shift of 2/3, course 1 at 1/3.
    phases = np.unique(np.round(np.mod(cuts / 0.6, 1.0), 9))
    assert phases == pytest.approx([1 / 3, 2 / 3])


def test_rows_have_sides_along_x_alone():
    sides = slab_sides(Grid(None, 0.4), np.zeros(2), np.full(2, 1.5))
    assert (sides.family == ALONG_X).all()


@pytest.mark.parametrize("dist", [(), (-0.2, 0.06, 6e-4, -4e-4)], ids=["pinhole", "lens"])
def test_visible_sides_lie_in_the_picture_and_are_not_small(dist: tuple[float, ...]):
    camera = replace(CAMERA, dist=dist)
    sides = visible_sides(camera, POSE, Grid(0.6, 0.4), min_px=12.0, border_px=3.0)
    assert {ALONG_X, ALONG_Y} == set(sides.family)
    px = project_ground(camera, POSE, sides.ends)
    assert (px > 3.0).all()
    assert (px < np.array([camera.width, camera.height]) - 4.0).all()
    assert (np.linalg.norm(px[:, 1] - px[:, 0], axis=1) >= 12.0).all()


def test_the_limit_keeps_the_largest_sides():
    everything = visible_sides(CAMERA, POSE, Grid(0.3, 0.3))
    some = visible_sides(CAMERA, POSE, Grid(0.3, 0.3), limit=40)
    assert len(some) == 40
    eye = POSE.origin_in_a[:2]
    away = np.linalg.norm(everything.ends.mean(1) - eye, axis=1)
    assert np.linalg.norm(some.ends.mean(1) - eye, axis=1).mean() < 0.7 * away.mean()


def test_the_sides_of_one_family_are_those_among_all():
    everything = visible_sides(CAMERA, POSE, Grid(0.4, 0.3))
    for family in (ALONG_X, ALONG_Y):
        own = visible_sides(CAMERA, POSE, Grid(0.4, 0.3), only=family)
        assert np.array_equal(own.ends, everything.ends[everything.family == family])
        assert (own.family == family).all()


def test_a_field_leaves_out_what_lies_outside_it():
    field = POSE.origin_in_a[:2] + np.array([0.0, 2.0]) + SQUARE
    sides = visible_sides(CAMERA, POSE, Grid(0.3, 0.3), field=field)
    assert len(sides) > 10
    assert inside_convex(sides.ends.mean(1), field, 0.1).all()


def test_a_camera_that_looks_at_the_sky_sees_no_side():
    up = look_at_ground(pitch_deg=-40.0, height_m=1.6)
    assert len(visible_ground(CAMERA, up, 12.0)) == 0
    assert len(visible_sides(CAMERA, up, Grid(0.4, 0.4))) == 0


def test_a_lattice_too_fine_to_be_seen_has_no_visible_side():
    assert len(visible_sides(CAMERA, POSE, Grid(0.004, 0.004))) == 0


def test_ground_points_project_where_the_photo_shows_them(stack_photo: SyntheticPhoto):
    ground, px = stack_photo.crossings()
    assert project_ground(stack_photo.camera, stack_photo.cam_from_ground, ground) == pytest.approx(px)


def test_visible_ground_is_below_the_horizon_and_within_reach():
    level = look_at_ground(pitch_deg=8.0, height_m=1.5, foot_m=(3.0, -2.0))
    ground = visible_ground(CAMERA, level, 6.0)
    px = project_ground(CAMERA, level, ground)
    assert np.isfinite(px).all()
    assert (np.linalg.norm(ground - [3.0, -2.0], axis=1) < 6.0 * 1.5).all()
    horizon = CAMERA.cy - CAMERA.fy * np.tan(np.deg2rad(8.0))
    assert (px[:, 1] > horizon).all()


def test_stations_lie_on_their_sides_clear_of_the_crossings():
    sides = visible_sides(CAMERA, POSE, Grid(0.6, 0.4))
    stations = place_stations(sides, CAMERA, POSE, margin=0.1, limit=100_000)
    start, end = sides.ends[stations.side, 0], sides.ends[stations.side, 1]
    length = np.linalg.norm(end - start, axis=1)
    at = ((stations.ground - start) * (end - start)).sum(1) / length
    assert np.allclose(start + at[:, None] * (end - start) / length[:, None], stations.ground)
    assert (at - stations.half_length > 0.0999 * length).all()
    assert (at + stations.half_length < 0.9001 * length).all()
    # Together they measure all of each side but its ends.
    covered = np.bincount(stations.side, weights=2 * stations.half_length)
    assert covered == pytest.approx(0.8 * np.linalg.norm(sides.ends[:, 1] - sides.ends[:, 0], axis=1))


def test_too_many_stations_are_thinned_over_all_sides():
    sides = visible_sides(CAMERA, POSE, Grid(0.3, 0.3))
    stations = place_stations(sides, CAMERA, POSE, limit=120)
    assert len(stations) <= 120
    assert np.ptp(stations.side) > 0.95 * (len(sides) - 1)


@given(st.floats(-2, 2), st.floats(-2, 2))
@settings(deadline=None, derandomize=True, max_examples=60)
def test_a_point_is_in_a_square_when_both_coordinates_are(x: float, y: float):
    expected = max(abs(x), abs(y)) < 1.25
    assert inside_convex(np.array([[x, y]]), SQUARE, 0.25)[0] == expected


def test_the_photos_own_lattice_covers_its_crossings(stack_photo: SyntheticPhoto):
    sides = visible_sides(stack_photo.camera, stack_photo.cam_from_ground, true_grid(stack_photo))
    ground, _ = stack_photo.crossings(margin_px=40.0, reach_m=3.0)
    nearest = np.linalg.norm(sides.ends.reshape(-1, 1, 2) - ground, axis=-1).min(0)
    assert nearest.max() < 1e-9


def test_a_distorted_picture_shows_other_ground_than_a_pinholes():
    # The field of view follows the lens: a barrel takes in more of the ground.
    plain = Camera.from_focal(640, 480, 560.0)
    barrel = replace(plain, dist=(-0.25, 0.0, 0.0, 0.0))
    wide, narrow = (np.ptp(visible_ground(c, POSE, 12.0), axis=0) for c in (barrel, plain))
    assert (wide > narrow).all()
