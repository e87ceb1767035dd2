"""Vanishing directions: Manhattan frames and ground candidates, on exact scenes, noisy ones and real ones."""

import json
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.geometry import angle_between_rotations
from autoreg.ground.directions import LAYING_SPREAD_RAD
from autoreg.ground.ground_planes import (
    ground_planes,
    ground_planes_unknown_focal,
    grounds_along,
    shares_at_right_angles,
)
from autoreg.segments import Segments, detect_segments
from autoreg.synthetic import look_at_ground
from autoreg.vanishing import manhattan_frame

CAMERA = Camera(1600, 1200, 1500.0, 1510.0, 790.0, 610.0)
SCENES = Path(__file__).parents[2] / "shared" / "scenes"


def looking(pitch_deg, turn_deg=20.0, roll_deg=0.0):
    """cam_from_ground rotation of a camera that looks down by `pitch_deg`."""
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    tilt = Rotation.from_euler("x", pitch_deg, degrees=True).as_matrix()
    roll = Rotation.from_euler("z", roll_deg, degrees=True).as_matrix()
    turn = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
    return roll @ tilt @ level @ turn


def quarter_turn_error_deg(R, R_true):
    turns = [Rotation.from_euler("z", 90 * q, degrees=True).as_matrix() for q in range(4)]
    return min(np.degrees(angle_between_rotations(R @ turn, R_true)) for turn in turns)


def axis_error_deg(dirs, dirs_true):
    """Angle of each true direction to the nearest found one, signs and order free."""
    cross = np.linalg.norm(np.cross(dirs.T[:, None], dirs_true.T[None]), axis=-1)
    return np.degrees(np.arcsin(np.clip(cross.min(0), 0, 1)))


def seen(camera, ends_cam, *, pieces=1):
    """Segments of 3-D lines (n, 2, 3) that lie wholly in the picture."""
    cuts = np.linspace(0, 1, pieces + 1)
    a, b = ends_cam[:, None, 0], ends_cam[:, None, 1]
    points = np.stack([a + (b - a) * cuts[:-1, None], a + (b - a) * cuts[1:, None]], 2).reshape(-1, 2, 3)
    px = camera.project(points)
    inside = (px > 0).all((1, 2)) & (px < [camera.width, camera.height]).all((1, 2))
    inside[inside] &= np.hypot(*(px[inside, 1] - px[inside, 0]).T) > 15
    return px[inside]


def as_segments(ends_px, sigma_px=0.15):
    return Segments(ends_px, np.full(len(ends_px), sigma_px), np.zeros(len(ends_px), int))


def floor_lines(camera, R, *, height=1.6, slab=0.5, pieces=1, reach=12):
    """The joints of a square floor, each in lengths of one slab."""
    rng = np.arange(-reach, reach + 1)
    i, j = (g.ravel() * slab for g in np.meshgrid(rng, rng))
    zero = np.zeros_like(i)
    along_x = np.stack([np.stack([i, j, zero], 1), np.stack([i + slab, j, zero], 1)], 1)
    along_y = np.stack([np.stack([i, j, zero], 1), np.stack([i, j + slab, zero], 1)], 1)
    # The floor's middle lies where the camera looks.
    ahead = R.T @ np.array([0.0, 0.0, 1.0])
    centre = height * ahead / max(-ahead[2], 0.2)
    ground = np.concatenate([along_x, along_y]) + centre * [1.0, 1.0, 0.0]
    t = R @ np.array([0.0, 0.0, -height])
    return seen(camera, ground @ R.T + t, pieces=pieces)


def clutter(camera, count, seed):
    rng = np.random.default_rng(seed)
    start = rng.uniform(0, [camera.width, camera.height], (count, 2))
    angle = rng.uniform(0, 2 * np.pi, count)
    length = rng.uniform(20, 120, count)[:, None]
    return np.stack([start, start + length * np.stack([np.cos(angle), np.sin(angle)], 1)], 1)


def building_lines(R, count, seed, camera=CAMERA):
    """Lines along all three axes of a frame, anywhere in front of the camera."""
    rng = np.random.default_rng(seed)
    px = rng.uniform(0, [camera.width, camera.height], (40 * count, 2))
    start = camera.unproject(px) * rng.uniform(4, 12, (len(px), 1))
    step = R.T[rng.integers(0, 3, len(px))] * rng.uniform(0.3, 1.0, (len(px), 1))
    lines = seen(camera, np.stack([start, start + step], 1))
    return lines[:count]


def noisy(ends_px, sigma_px, spread_rad, seed):
    """Segments turned about their middles by the noise that the fit assumes."""
    rng = np.random.default_rng(seed)
    step = ends_px[:, 1] - ends_px[:, 0]
    length = np.hypot(*step.T)
    across = np.stack([-step[:, 1], step[:, 0]], 1) / length[:, None]
    move = rng.normal(0, np.hypot(sigma_px, spread_rad * length / 2))[:, None] * across
    return np.stack([ends_px[:, 0] - move, ends_px[:, 1] + move], 1)


@settings(deadline=None, derandomize=True, max_examples=20)
@given(pitch=st.floats(-25, 40), turn=st.floats(-45, 45), roll=st.floats(-10, 10))
def test_a_manhattan_frame_survives_four_outliers_in_five(pitch, turn, roll):
    R = looking(pitch, turn, roll)
    ends = np.concatenate([building_lines(R, 100, 1), clutter(CAMERA, 400, 2)])
    frame = manhattan_frame(as_segments(ends), CAMERA)
    assert axis_error_deg(frame.dirs_cam, R).max() < 0.5
    assert np.allclose(frame.dirs_cam.T @ frame.dirs_cam, np.eye(3), atol=1e-9)
    assert np.linalg.det(frame.dirs_cam) > 0
    assert frame.dirs_cam[1, 2] < 0


def test_a_manhattan_frame_with_directions_at_infinity_is_exact():
    frame = manhattan_frame(as_segments(building_lines(np.eye(3), 120, 4)), CAMERA)
    assert axis_error_deg(frame.dirs_cam, np.eye(3)).max() < 0.01


def test_the_stated_uncertainty_of_a_frame_matches_its_errors():
    R = looking(10.0, 30.0)
    pulls = []
    for seed in range(30):
        ends = noisy(building_lines(R, 150, seed), 0.3, LAYING_SPREAD_RAD, 100 + seed)
        frame = manhattan_frame(as_segments(ends, 0.3), CAMERA)
        found = frame.dirs_cam
        match = np.abs(found.T @ R).argmax(0)
        aligned = found[:, match] * np.sign((found[:, match] * R).sum(0))
        pulls.append(Rotation.from_matrix(aligned @ R.T).as_rotvec() / frame.sigma_rad)
    assert 0.5 < np.sqrt(np.mean(np.square(pulls))) < 1.3


def test_one_direction_alone_is_refused_by_name():
    ends = np.array([[[100.0 + 40 * k, 100.0], [100.0 + 40 * k, 900.0]] for k in range(20)])
    with pytest.raises(Refusal) as refusal:
        manhattan_frame(as_segments(ends), CAMERA)
    assert refusal.value.code == "one_direction"


@settings(deadline=None, derandomize=True, max_examples=20)
@given(pitch=st.floats(12, 85), turn=st.floats(-45, 45), roll=st.floats(-15, 15))
def test_a_floor_among_clutter_comes_first(pitch, turn, roll):
    R = looking(pitch, turn, roll)
    floor = floor_lines(CAMERA, R)
    ends = np.concatenate([floor, clutter(CAMERA, len(floor), 5)])
    found = ground_planes(as_segments(ends), CAMERA)
    assert quarter_turn_error_deg(found[0].R, R) < 0.3
    assert np.linalg.det(found[0].R) > 0


def test_a_floor_turned_against_the_building_is_among_the_candidates():
    building = looking(20.0, 0.0)
    R = looking(20.0, 33.0)
    ends = np.concatenate([floor_lines(CAMERA, R), building_lines(building, 200, 6)])
    found = ground_planes(as_segments(ends), CAMERA)
    assert min(quarter_turn_error_deg(h.R, R) for h in found[:8]) < 0.3


def boards(R, grain, ends, seed, height=1.5, width=0.15):
    """The grain of a floor of boards, a little wavy, and the short joints at the ends of some."""
    rng = np.random.default_rng(seed)
    ahead = R.T @ np.array([0.0, 0.0, 1.0])
    centre = height * ahead / -ahead[2] * [1.0, 1.0, 0.0]
    middle = np.pad(rng.uniform(-1.5, 1.5, (grain + ends, 2)), ((0, 0), (0, 1))) + centre
    angle = np.r_[rng.normal(0.0, 0.015, grain), np.full(ends, np.pi / 2)]
    half = np.r_[rng.uniform(0.03, 0.12, grain), np.full(ends, width / 2)][:, None]
    along = half * np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], 1)
    lines = np.stack([middle - along, middle + along], 1)
    return seen(CAMERA, lines @ R.T + R @ np.array([0.0, 0.0, -height]))


@pytest.mark.parametrize("seed", [3, 13])
def test_the_grain_of_boards_does_not_outweigh_their_ends(seed):
    R = looking(38.0, 25.0)
    ends = np.concatenate([boards(R, 5000, 60, seed), clutter(CAMERA, 60, 4)])
    found = ground_planes(as_segments(noisy(ends, 0.3, 0.0, 7), 0.3), CAMERA)
    assert quarter_turn_error_deg(found[0].R, R) < 0.5


def test_where_next_to_all_edges_run_one_way_all_grounds_along_it_are_told():
    R = looking(38.0, 25.0)
    grain = as_segments(np.concatenate([boards(R, 800, 0, 3), clutter(CAMERA, 30, 4)]))
    step = np.radians(2.0)
    found = grounds_along(grain, CAMERA, least_share=0.5, step_rad=step)
    assert min(quarter_turn_error_deg(own, R) for own in found) < 1.2
    # Seen from above: the ground's normal points up in the picture, or to the camera.
    assert ((found[:, 1, 2] < 0) | (found[:, 2, 2] < -0.7)).all()
    turns = [np.degrees(angle_between_rotations(one, other)) for one, other in pairwise(found)]
    assert np.median(turns) == pytest.approx(2.0)
    others = as_segments(clutter(CAMERA, 400, 5))
    assert len(grounds_along(others, CAMERA, least_share=0.5, step_rad=step)) == 0
    assert len(grounds_along(as_segments(np.zeros((0, 2, 2))), CAMERA, least_share=0.5, step_rad=step)) == 0


@pytest.mark.parametrize("camera", [CAMERA, None])
def test_edges_at_right_angles_are_told_from_strewn_ones_whatever_their_spacing(camera: Camera | None):
    joints, size = floor_lines(CAMERA, looking(40.0, 25.0)), (CAMERA.width, CAMERA.height)
    uneven = np.random.default_rng(3).permutation(len(joints))[: len(joints) // 2]
    larger, rarer = shares_at_right_angles(as_segments(joints[uneven]), *size, camera)
    assert larger >= rarer > 0.2
    assert larger + rarer > 0.9
    strewn = as_segments(clutter(CAMERA, 400, 5))
    assert sum(shares_at_right_angles(strewn, *size, camera)) < 0.4
    assert shares_at_right_angles(as_segments(np.zeros((0, 2, 2))), *size, camera) == (0.0, 0.0)


def test_plus_y_points_away_from_the_camera_and_z_up():
    for pitch in (15.0, 50.0, 88.0):
        R = looking(pitch, 12.0)
        found = ground_planes(as_segments(floor_lines(CAMERA, R)), CAMERA)[0].R
        # The rule makes the frame unique: the true frame as `looking` builds it, not a quarter turn of it.
        assert np.degrees(angle_between_rotations(found, R)) < 0.3


def test_lines_above_the_horizon_are_no_ground():
    R = looking(-20.0, 25.0)
    ceiling = floor_lines(CAMERA, looking(20.0, 25.0))
    ceiling[..., 1] = 2 * CAMERA.cy - ceiling[..., 1]
    found = ground_planes(as_segments(ceiling), CAMERA)
    assert all(quarter_turn_error_deg(h.R, R) > 5 for h in found)


def test_a_lens_that_bends_lines_does_no_harm():
    bent = Camera(1600, 1200, 1150.0, 1150.0, 817.0, 598.0, (-0.15, 0.03, 0.0004, -0.0003, 0.0))
    R = looking(50.0, 30.0)
    found = ground_planes(as_segments(floor_lines(bent, R, pieces=2)), bent)
    assert quarter_turn_error_deg(found[0].R, R) < 0.1


def test_the_focal_length_comes_from_two_finite_vanishing_points():
    camera = Camera(1600, 1200, 1500.0, 1500.0, 799.5, 599.5)
    R = looking(35.0, 40.0)
    hypothesis, focal_px = ground_planes_unknown_focal(as_segments(floor_lines(camera, R)), 1600, 1200)[0]
    assert focal_px == pytest.approx(1500.0, rel=0.02)
    assert quarter_turn_error_deg(hypothesis.R, R) < 0.5
    assert hypothesis.sigma_log_focal is not None
    assert hypothesis.sigma_log_focal < 0.05


def test_a_focal_length_that_the_photo_does_not_tell_is_said_to_be_unknown():
    camera = Camera(1600, 1200, 1500.0, 1500.0, 799.5, 599.5)
    ends = floor_lines(camera, looking(35.0, 0.0))
    hypothesis, _ = ground_planes_unknown_focal(as_segments(ends), 1600, 1200)[0]
    assert hypothesis.sigma_log_focal is not None
    assert hypothesis.sigma_log_focal > 0.15


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_too_few_segments_give_candidates_or_none_but_no_error(count):
    segments = as_segments(clutter(CAMERA, count, 8))
    assert len(ground_planes(segments, CAMERA)) <= 12
    assert len(ground_planes_unknown_focal(segments, 1600, 1200)) <= 12


def test_the_same_segments_give_the_same_candidates_in_any_order():
    ends = np.concatenate([floor_lines(CAMERA, looking(40.0, 30.0)), clutter(CAMERA, 50, 9)])
    shuffled = ends[np.random.default_rng(1).permutation(len(ends))]
    here, there = ground_planes(as_segments(ends), CAMERA), ground_planes(as_segments(shuffled), CAMERA)
    assert np.degrees(angle_between_rotations(here[0].R, there[0].R)) < 0.05


@pytest.mark.skipif(not SCENES.exists(), reason="needs the ray-traced scenes in ../shared")
def test_the_true_floor_of_each_ray_traced_scene_is_among_the_first_candidates():
    missed = []
    for path in sorted(SCENES.glob("*.truth.json")):
        truth = json.loads(path.read_text())
        if not truth["lattice"]:
            continue
        gray = cv2.imread(str(SCENES / f"{truth['name']}.jpg"), cv2.IMREAD_GRAYSCALE)
        height, width = gray.shape
        K, R = np.array(truth["K"]), np.array(truth["R"])
        dist = (*truth["dist"], 0.0, 0.0, 0.0)
        camera = Camera(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], dist)
        segments = detect_segments(gray)
        known = [quarter_turn_error_deg(h.R, R) for h in ground_planes(segments, camera)[:8]]
        unknown = [
            quarter_turn_error_deg(h.R, R)
            for h, _ in ground_planes_unknown_focal(segments, width, height)[:8]
        ]
        if min(known) > 0.3 or min(unknown) > 3.0:
            missed.append((truth["name"], min(known), min(unknown)))
    assert not missed


def test_short_cross_joints_have_a_say_beside_many_long_unbroken_ones():
    camera = Camera.from_focal(1600, 1200, 1400.0)
    pose = look_at_ground(pitch_deg=38.0, height_m=3.3, heading_deg=5.0)
    rng, ends = np.random.default_rng(0), []
    for y in np.arange(1.0, 9.0, 0.08):
        # Unbroken joints are found in long pieces, the joints across them one by one.
        for x in np.arange(-4.0, 4.0, 0.8):
            ends.append([[x, y], [x + 0.8, y]])
        ends += [[[x, y], [x, y + 0.07]] for x in rng.uniform(-4.0, 4.0, 12)]
    R = pose.R
    px = camera.project(np.array(ends) @ R[:, :2].T + pose.t)
    px = px[((px > 0) & (px < [1599, 1199])).all((1, 2))] + rng.normal(0, 0.2, (1, 2, 2))
    segments = Segments(px, np.full(len(px), 0.2), np.zeros(len(px), int))
    found = ground_planes(segments, camera, max_hypotheses=3)
    assert found
    assert np.rad2deg(np.arccos(np.clip(found[0].R[:, 2] @ R[:, 2], -1, 1))) < 1.0
