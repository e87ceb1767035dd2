"""Sunk joints of drawn pavings, against the straight rays of view and of the sun that make them."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from drawn_joints import EVEN, PLAIN, joint_middles, joint_offsets_px, traced
from hypothesis import given, settings
from hypothesis import strategies as st

from autoreg.camera import Camera
from autoreg.synthetic import (
    SyntheticPhoto,
    SyntheticScene,
    ground_points,
    look_at_ground,
    render_paving,
)
from autoreg.synthetic.relief import Side, seen_parts

WIDTH, DEPTH, HEIGHT = 0.016, 0.006, 1.2
# It looks along +Y over joints along X, which roll keeps off the pixels' rows.
AHEAD = replace(
    PLAIN,
    cam_from_ground=look_at_ground(pitch_deg=50.0, height_m=HEIGHT, roll_deg=8.0, foot_m=(0.2, 0.0)),
    joint_width_m=WIDTH,
    blur_px=0.0,
    samples=3,
)
# In the sun alone at 45° a wall that faces it is as light as level stone; what it does not reach is black.
FROM_BEHIND = {"sun_azimuth_rad": -np.pi / 2, "sun_elevation_rad": np.pi / 4, "sky_light": 0.0}
FROM_AHEAD = {**FROM_BEHIND, "sun_azimuth_rad": np.pi / 2}


def middles() -> np.ndarray:
    """Ground points on the joints along X, between those along Y."""
    return np.array([[x, y] for y in (0.8, 1.2) for x in (-0.2, 0.2, 0.6)])


def moved_px(photo: SyntheticPhoto, moves_m: np.ndarray) -> np.ndarray:
    """Pixels across their line by which the joints' middles move when they lie nearer by so much."""
    at = middles()
    along = photo.project(at + np.array([0.01, 0.0])) - photo.project(at)
    moved = photo.project(at - np.column_stack([0 * moves_m, moves_m])) - photo.project(at)
    return (along[:, 0] * moved[:, 1] - along[:, 1] * moved[:, 0]) / np.linalg.norm(along, axis=1)


def slopes() -> np.ndarray:
    return middles()[:, 1] / HEIGHT


def side(edge: float, height: float = 0.0, tone: float = 150.0) -> Side:
    return Side(np.array([edge]), np.array([height]), np.array([tone]))


@given(
    slope=st.floats(-6, 6),
    heights=st.tuples(st.floats(-0.002, 0.002), st.floats(-0.002, 0.002)),
    azimuth=st.floats(-4, 4),
    elevation=st.floats(0.1, 1.57),
    axis=st.integers(0, 1),
    chamfer=st.sampled_from([0.0, 0.003]),
)
@settings(deadline=None, derandomize=True)
def test_the_parts_of_a_joint_add_up_to_what_lies_between_its_edges_as_seen(
    slope: float, heights: tuple[float, float], azimuth: float, elevation: float, axis: int, chamfer: float
):
    scene = replace(
        PLAIN,
        joint_depth_m=0.006,
        chamfer_m=chamfer,
        sun_azimuth_rad=azimuth,
        sun_elevation_rad=elevation,
    )
    sides = side(-0.005, heights[0]), side(0.005, heights[1])
    parts = seen_parts(scene, *sides, np.array([slope]), axis)
    low, high = -0.005 - chamfer + slope * heights[0], 0.005 + chamfer + slope * heights[1]
    assert all(part.width_m[0] >= 0 for part in parts)
    assert sum(part.width_m[0] for part in parts) == pytest.approx(max(high - low, 0.0), abs=1e-12)
    if high > low:
        ends = sorted((p.middle_m[0] + s * p.width_m[0] / 2, s) for p in parts for s in (-1, 1))
        assert (ends[0][0], ends[-1][0]) == (pytest.approx(low, abs=1e-9), pytest.approx(high, abs=1e-9))


def test_flat_joints_are_drawn_as_ever_whatever_the_sun():
    scene = replace(PLAIN, jitter_m=0.001, texture=0.05, tone_spread=0.04, shift=0.5)
    shone_on = replace(scene, sun_azimuth_rad=2.0, sun_elevation_rad=0.4, sky_light=0.7)
    assert render_paving(shone_on).pixels.tobytes() == render_paving(scene).pixels.tobytes()


@pytest.mark.parametrize("shift", [0.0, 0.5, 1 / 3])
def test_joints_without_noticeable_depth_look_flat(shift: float):
    scene = replace(PLAIN, tone_spread=0.04, shift=shift)
    flat, sunk = (render_paving(replace(scene, joint_depth_m=d)).pixels.astype(int) for d in (0.0, 1e-7))
    assert np.max(np.abs(sunk - flat)) <= 1
    scene = replace(scene, jitter_m=0.001)
    flat, sunk = (render_paving(replace(scene, joint_depth_m=d)).pixels.astype(int) for d in (0.0, 1e-7))
    # A footprint over the middle of a joint now knows the slabs on both sides.
    assert np.mean(np.abs(sunk - flat) > 4) < 0.001


def test_a_deep_joint_seen_from_straight_above_in_flat_light_looks_flat():
    above = look_at_ground(pitch_deg=90.0, height_m=60.0, foot_m=(0.1, 0.1))
    scene = replace(PLAIN, camera=Camera(200, 160, 20000.0, 20000.0, 99.5, 79.5), cam_from_ground=above)
    flat = render_paving(scene).pixels.astype(int)
    deep = render_paving(replace(scene, joint_depth_m=0.008, sky_light=1.0)).pixels.astype(int)
    assert flat.min() < 70
    assert np.max(np.abs(deep - flat)) <= 1


def test_a_far_wall_that_is_lit_like_the_slab_moves_the_far_edge_by_depth_times_slope():
    scene = replace(AHEAD, joint_tone=0.0, joint_depth_m=DEPTH, **FROM_BEHIND)
    photo = render_paving(scene)
    offsets = joint_offsets_px(photo, middles(), along_x=True)
    # One edge moves, and so the middle by half as much.
    assert offsets == pytest.approx(moved_px(photo, 0.5 * DEPTH * slopes()), abs=0.1)
    assert np.all(offsets > 0.3)


def test_the_sun_behind_the_camera_shades_the_near_part_of_the_bed_and_the_sun_ahead_the_far_one():
    # A bed as light as the slabs shows nothing but its shadow, here as wide as the joint is deep.
    scene = replace(AHEAD, joint_tone=PLAIN.slab_tone, joint_depth_m=0.005)
    behind, ahead = (render_paving(replace(scene, **sun)) for sun in (FROM_BEHIND, FROM_AHEAD))
    # What of the near shadow the near slab does not hide begins at the near edge.
    nearer = 0.5 * WIDTH - 0.5 * 0.005 * np.maximum(1 - slopes(), 0)
    seen = slopes() < 0.9
    found = joint_offsets_px(behind, middles()[seen], along_x=True)
    assert found == pytest.approx(moved_px(behind, nearer)[seen], abs=0.15)
    # The far one ends where the wall begins, which is black itself up to the far edge.
    farther = -0.5 * WIDTH + 0.5 * 0.005 * (1 + slopes())
    found = joint_offsets_px(ahead, middles(), along_x=True)
    assert found == pytest.approx(moved_px(ahead, farther), abs=0.15)


def test_a_slab_that_lies_higher_is_seen_farther_away_by_its_height_times_the_slope():
    scene = replace(PLAIN, joint_depth_m=0.006)
    for slope in (0.5, -2.0):
        level, raised = (
            seen_parts(scene, side(-0.005, h), side(0.005, h), np.array([slope]), 0) for h in (0.0, 0.001)
        )
        ends = [
            sorted(p.middle_m[0] + s * p.width_m[0] / 2 for p in parts for s in (-1, 1))
            for parts in (level, raised)
        ]
        assert ends[1][0] - ends[0][0] == pytest.approx(0.001 * slope, abs=1e-12)
        assert ends[1][-1] - ends[0][-1] == pytest.approx(0.001 * slope, abs=1e-12)


@pytest.mark.slow
def test_a_turn_of_the_slabs_slants_each_piece_of_a_joint_about_its_middle():
    turn, spread = 0.004, []
    for seed in range(4):
        photo = render_paving(replace(AHEAD, slab_turn_rad=turn, seed=seed))
        for y in (0.8, 1.2):
            ends = np.array([[x, y] for x in (0.1, 0.3)])
            offsets = joint_offsets_px(photo, ends, along_x=True)
            per_m = (photo.project(ends + np.array([0.0, 1e-4])) - photo.project(ends))[:, 1] / 1e-4
            spread.append(np.diff(offsets / per_m)[0] / 0.2)
    # A joint lies between two slabs, so that it turns by the mean of two.
    assert np.std(spread) == pytest.approx(turn / np.sqrt(2), rel=0.6)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"joint_depth_m": -0.001}, "joint_depth_m"),
        ({"joint_depth_m": 0.004, "lift_m": 0.002}, "lift_m"),
        ({"lift_m": 0.001}, "lift_m"),
        ({"joint_depth_m": 0.004, "chamfer_m": 0.004}, "chamfer_m"),
        ({"chamfer_m": 0.001}, "chamfer_m"),
        ({"joint_depth_m": 0.004, "kind": "rows"}, "'lattice' only"),
        ({"slab_turn_rad": 0.001, "kind": "crazy"}, "'lattice' only"),
        ({"sun_elevation_rad": 0.0}, "sun_elevation_rad"),
        ({"sky_light": 1.1}, "sky_light"),
    ],
)
def test_a_relief_that_cannot_be_drawn_is_rejected_by_name(change: dict[str, float | str], word: str):
    with pytest.raises(ValueError, match=word):
        replace(SyntheticScene(), **change)  # type: ignore[arg-type]


@pytest.mark.skipif(shutil.which("povray") is None, reason="POV-Ray is not installed")
@pytest.mark.parametrize(
    ("azimuth_deg", "chamfer_m", "dark"),
    [
        (60.0, 0.003, True),
        pytest.param(150.0, 0.003, True, marks=pytest.mark.slow),
        # Where light bevels outweigh the dark beds, a joint's darkness has no middle.
        *(pytest.param(deg, 0.003, False, marks=pytest.mark.slow) for deg in (0.0, 250.0)),
        *(pytest.param(deg, 0.0, True, marks=pytest.mark.slow) for deg in (0.0, 60.0, 150.0)),
    ],
)
def test_sunk_joints_look_as_povray_traces_them(
    azimuth_deg: float, chamfer_m: float, dark: bool, monkeypatch: pytest.MonkeyPatch
):
    # Its ambient light is the same everywhere, also on walls and bevels.
    monkeypatch.setattr("autoreg.synthetic.relief._open", lambda top, bottom, width: np.ones_like(bottom))
    monkeypatch.setattr("autoreg.synthetic.relief.SKY_OVER_BEVEL", 1.0)
    pose = look_at_ground(pitch_deg=45.0, height_m=0.9, heading_deg=25.0, foot_m=(0.1, 0.1))
    camera, elevation = Camera(640, 480, 600.0, 600.0, 319.5, 239.5), np.deg2rad(40.0)
    paving = replace(EVEN, slab_m=(0.3, 0.3), depth_m=DEPTH, joint_m=0.012, chamfer_m=chamfer_m)
    grey = traced(camera, pose, paving, sun_elevation_deg=40.0, sun_azimuth_deg=azimuth_deg)
    photo = render_paving(
        replace(
            PLAIN,
            camera=camera,
            cam_from_ground=pose,
            spacing_m=(0.3, 0.3),
            joint_width_m=0.012,
            joint_depth_m=DEPTH,
            chamfer_m=chamfer_m,
            slab_tone=float(np.median(grey)),
            joint_tone=255 * (paving.bed_albedo[1] * (0.2 + 0.65 * np.sin(elevation))) ** (1 / 2.2),
            sun_azimuth_rad=np.deg2rad(azimuth_deg),
            sun_elevation_rad=elevation,
            sky_light=0.26 / (0.26 + 0.68 * np.sin(elevation)),
            blur_px=0.0,
            samples=4,
        )
    )
    same = SyntheticPhoto(grey, camera, pose, photo.lattice)
    for along_x in (True, False) if dark else ():
        at = joint_middles(photo, along_x)
        drawn, seen = (joint_offsets_px(p, at, along_x) for p in (photo, same))
        assert np.sqrt(np.mean((drawn - seen) ** 2)) < 0.06
    # Where joints cross, the drawn one along X goes on.
    rows, columns = np.indices(grey.shape)
    ground = ground_points(np.stack([columns.ravel(), rows.ravel()], 1).astype(float), camera.K, pose)
    crossing = (np.abs(ground - 0.3 * np.round(ground / 0.3)) < 0.025).all(1).reshape(grey.shape)
    off = (photo.pixels.astype(float) - grey)[~crossing]
    assert np.sqrt(np.mean(off**2)) < 2.0
