from __future__ import annotations

import shutil
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from drawn_joints import EVEN, PLAIN, joint_middles, joint_offsets_px, traced
from hypothesis import given, settings
from hypothesis import strategies as st

from autoreg.camera import Camera
from autoreg.lattice import Lattice
from autoreg.synthetic import SyntheticPhoto, SyntheticScene, ground_points, look_at_ground, render_paving

SMALL = replace(PLAIN, camera=Camera(240, 180, 215.0, 215.0, 118.0, 92.0))
LENS = replace(PLAIN.camera, dist=(-0.2, 0.06, 6e-4, -4e-4, 0.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("camera", [PLAIN.camera, LENS], ids=["pinhole", "lens"])
@pytest.mark.parametrize("shift", [0.0, 0.5, 1 / 3])
@pytest.mark.parametrize("along_x", [True, False])
def test_drawn_joints_lie_where_the_camera_projects_them(camera: Camera, shift: float, along_x: bool):
    photo = render_paving(replace(PLAIN, camera=camera, shift=shift, spacing_m=(0.6, 0.4), blur_px=0.0))
    offsets = joint_offsets_px(photo, joint_middles(photo, along_x), along_x)
    assert len(offsets) >= 8
    # The joint's centroid lies off its centre line by perspective within its width, below 0.01 px here.
    assert abs(np.mean(offsets)) < 0.01
    # A thin joint that runs along the pixel columns shows their grid in its own centroid.
    assert np.max(np.abs(offsets)) < 0.1


def test_a_joint_has_the_width_that_the_scene_names():
    scene = replace(
        PLAIN, blur_px=0.0, cam_from_ground=look_at_ground(pitch_deg=90.0, height_m=1.0), samples=1
    )
    photo = render_paving(scene)
    # Straight down from one metre, the joints' part of the area is known without any perspective.
    part = 1 - (1 - 0.01 / 0.4) ** 2
    window = photo.pixels[5 : 5 + 344, 5 : 5 + 344].astype(float)  # two slabs of 172 px, by fx = 430
    row = window[60]
    area = np.sum(scene.slab_tone - row) / (scene.slab_tone - scene.joint_tone)
    assert area == pytest.approx(2 * 0.01 * 430, rel=0.02)
    assert 1 - (window.mean() - scene.joint_tone) / (scene.slab_tone - scene.joint_tone) == pytest.approx(
        part, rel=0.05
    )


def test_far_joints_keep_their_mean_tone_instead_of_aliasing():
    scene = replace(
        PLAIN, cam_from_ground=look_at_ground(pitch_deg=8.0, height_m=1.6), samples=1, blur_px=0.0
    )
    photo = render_paving(scene)
    # A hundred metres away a pixel holds whole slabs.
    row = round(float(photo.project(np.array([[0.0, 120.0]]))[0, 1]))
    expected = scene.slab_tone - (1 - (1 - 0.01 / 0.4) ** 2) * (scene.slab_tone - scene.joint_tone)
    assert photo.pixels[row].astype(float) == pytest.approx(expected, abs=4)


@pytest.mark.parametrize("kind", ["lattice", "rows", "planks", "crazy", "gravel"])
def test_the_same_seed_gives_the_same_bytes_and_another_seed_another_photo(kind):
    scene = replace(
        SyntheticScene(), camera=SMALL.camera, kind=kind, clutter=2, shadows=1, jitter_m=0.001, seed=3
    )
    photo = render_paving(scene)
    assert photo.pixels.shape == (180, 240, 3)
    assert photo.pixels.tobytes() == render_paving(scene).pixels.tobytes()
    assert photo.pixels.tobytes() != render_paving(replace(scene, seed=4)).pixels.tobytes()


def test_only_grounds_with_a_lattice_carry_one():
    lattices = {
        kind: render_paving(replace(SMALL, kind=kind)).lattice
        for kind in ("lattice", "rows", "planks", "crazy", "gravel")
    }
    assert {kind for kind, lattice in lattices.items() if lattice is not None} == {"lattice", "rows"}
    rows = lattices["rows"]
    assert rows is not None
    assert (rows.kind, rows.spacing_x, rows.shift) == ("rows", None, None)


def test_the_noise_that_was_asked_for_is_in_the_photo():
    clean = render_paving(SMALL).pixels.astype(float)
    noisy = render_paving(replace(SMALL, noise_grey=4.0)).pixels.astype(float)
    # Rounding to whole grey levels adds a twelfth of a grey level squared, twice.
    assert np.std(noisy - clean) == pytest.approx(np.hypot(4.0, np.sqrt(1 / 6)), rel=0.02)


def joint_offsets_m(photo: SyntheticPhoto, middles: np.ndarray, along_x: bool) -> np.ndarray:
    """How far on the ground joints lie off their lines."""
    across = np.array([0.0, 0.001] if along_x else [0.001, 0.0])
    scale_px = np.linalg.norm(photo.project(middles + across) - photo.project(middles), axis=1) / 0.001
    return joint_offsets_px(photo, middles, along_x) / scale_px


def test_jitter_moves_single_joints_but_not_their_mean():
    jitter_m = 0.002
    scene = replace(PLAIN, jitter_m=jitter_m, seed=1, blur_px=0.0, samples=3)
    photo = render_paving(scene)
    middles = joint_middles(photo, along_x=False)
    offsets_m = joint_offsets_m(photo, middles, along_x=False)
    # A joint lies between two slabs, so that its centroid moves by the mean of two jitters.
    assert np.std(offsets_m) == pytest.approx(jitter_m / np.sqrt(2), rel=0.4)
    assert abs(np.mean(offsets_m)) < 3 * jitter_m / np.sqrt(2 * len(middles))


def test_a_shadow_darkens_and_clutter_covers():
    plain = render_paving(SMALL).pixels.astype(float)
    shaded = render_paving(replace(SMALL, shadows=1, shade=0.5)).pixels.astype(float)
    part = np.mean(np.abs(shaded - 0.5 * plain) < 1.5)
    assert 0.01 < part < 0.99
    covered = render_paving(replace(SMALL, clutter=3)).pixels.astype(float)
    assert 0.001 < np.mean(np.abs(covered - plain) > 3) < 0.5


angles = st.floats(-180, 180)


@given(pitch=st.floats(5, 90), heading=angles, roll=angles, height=st.floats(0.3, 5))
@settings(deadline=None, derandomize=True)
def test_a_pose_has_the_pitch_heading_and_height_it_was_made_of(
    pitch: float, heading: float, roll: float, height: float
):
    pose = look_at_ground(
        pitch_deg=pitch, height_m=height, heading_deg=heading, roll_deg=roll, foot_m=(0.3, -0.2)
    )
    assert np.allclose(pose.R @ pose.R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose.R) == pytest.approx(1)
    assert pose.origin_in_a == pytest.approx([0.3, -0.2, height])
    forward = pose.R[2]
    assert np.rad2deg(np.arcsin(-forward[2])) == pytest.approx(pitch, abs=1e-5)
    ahead = np.deg2rad(heading)
    assert forward[:2] == pytest.approx(
        np.cos(np.deg2rad(pitch)) * np.array([-np.sin(ahead), np.cos(ahead)]), abs=1e-9
    )
    # With a level camera the horizon is level too: the right vector has no height.
    assert pose.R[0, 2] == pytest.approx(-np.sin(np.deg2rad(roll)) * np.cos(np.deg2rad(pitch)), abs=1e-9)


@given(u=st.floats(0, 479), v=st.floats(0, 359), heading=angles)
@settings(deadline=None, derandomize=True)
def test_ground_points_are_those_that_project_back(u: float, v: float, heading: float):
    pose = look_at_ground(pitch_deg=35.0, height_m=1.6, heading_deg=heading)
    point = ground_points(np.array([[u, v]]), PLAIN.camera.K, pose)
    back = PLAIN.camera.project(pose.apply(np.array([[*point[0], 0.0]])))
    assert back[0] == pytest.approx([u, v], abs=1e-6)


def test_pixels_above_the_horizon_have_no_ground_point():
    pose = look_at_ground(pitch_deg=5.0, height_m=1.6)
    assert np.isnan(ground_points(np.array([[240.0, 0.0]]), PLAIN.camera.K, pose)).all()


def test_crossings_of_a_third_bond_follow_the_written_order():
    photo = render_paving(replace(PLAIN, shift=1 / 3, spacing_m=(0.6, 0.3)))
    ground, px = photo.crossings(margin_px=5.0)
    j = np.round(ground[:, 1] / 0.3)
    assert ground[:, 0] / 0.6 - j / 3 == pytest.approx(np.round(ground[:, 0] / 0.6 - j / 3), abs=1e-9)
    assert np.all((px >= 5) & (px <= [474, 354]))


def test_the_cross_joints_of_rows_lean_as_asked_about_their_middles():
    above = look_at_ground(pitch_deg=90.0, height_m=2.0)
    scene = replace(PLAIN, kind="rows", cam_from_ground=above, spacing_m=(0.6, 0.4))
    straight, leaning = (render_paving(replace(scene, lean_rad=np.arctan(lean))) for lean in (0.0, 0.2))
    steps = np.arange(-12, 13)
    for away in (-0.1, 0.0, 0.1):
        # Between two unbroken joints the cross joints are all that is dark.
        v = round(float(straight.project(np.array([[0.0, 0.2 + away]]))[0, 1]))
        before, after = straight.pixels[v].astype(float), leaning.pixels[v].astype(float)
        alike = [np.corrcoef(np.roll(before, k)[20:-20], after[20:-20])[0, 1] for k in steps]
        assert steps[int(np.argmax(alike))] == pytest.approx(0.2 * away * scene.camera.fx / 2.0, abs=1.0)


def test_courses_drift_together_with_their_neighbours():
    drift_m = 0.002
    scene = replace(PLAIN, course_drift_m=drift_m, seed=1, blur_px=0.0, samples=3)
    photo = render_paving(scene)
    middles = joint_middles(photo, along_x=True)
    offsets_m = joint_offsets_m(photo, middles, along_x=True)
    line = np.round(middles[:, 1] / scene.spacing_m[1]).astype(int)
    of_line = {k: offsets_m[line == k] for k in np.unique(line)}
    # All of a course goes with it.
    assert max(np.std(own) for own in of_line.values()) < 0.3 * drift_m
    places = np.array([own.mean() for own in of_line.values()])
    steps = np.std(np.diff(places))
    assert 0.2 * drift_m < steps < 1.5 * drift_m
    # It adds up to more than a step.
    assert np.sqrt(np.mean(places**2)) > 1.5 * steps


def test_rows_have_no_crossings_to_ask_for():
    with pytest.raises(ValueError, match="period along X and Y"):
        render_paving(replace(PLAIN, kind="rows")).crossings()


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"jitter_m": 0.003}, "jitter_m"),
        ({"joint_width_m": 0.5}, "joint_width_m"),
        ({"samples": 0}, "samples"),
        ({"course_drift_m": 0.003}, "course_drift_m"),
        ({"course_drift_m": 0.001, "kind": "rows"}, "course_drift_m"),
    ],
)
def test_a_scene_that_cannot_be_drawn_is_rejected_by_name(change: dict[str, Any], word: str):
    with pytest.raises(ValueError, match=word):
        replace(SyntheticScene(), **change)  # type: ignore[arg-type]


def test_a_lens_that_folds_the_picture_is_rejected():
    folding = replace(PLAIN.camera, dist=(-1.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="distortion"):
        render_paving(replace(PLAIN, camera=folding))


@pytest.mark.skipif(shutil.which("povray") is None, reason="POV-Ray is not installed")
@pytest.mark.parametrize(
    "dist", [pytest.param((0.0,) * 8, marks=pytest.mark.slow), LENS.dist], ids=["pinhole", "lens"]
)
def test_the_truth_of_a_ray_traced_scene_is_where_povray_drew_its_joints(dist: tuple[float, ...]):
    camera = replace(PLAIN.camera, dist=dist)
    pose = look_at_ground(pitch_deg=50.0, height_m=1.5, heading_deg=20.0)
    grey = traced(camera, pose, replace(EVEN, slab_m=(0.6, 0.3), shift=0.5, depth_m=0.0001))
    lattice = Lattice(
        kind="running", spacing_x=0.6, spacing_y=0.3, shift=0.5, joint_width=0.009, extent=np.zeros((0, 2))
    )
    photo = SyntheticPhoto(grey, camera, pose, lattice)
    for along_x in (True, False):
        offsets = joint_offsets_px(photo, joint_middles(photo, along_x), along_x)
        assert len(offsets) >= 8
        assert abs(np.mean(offsets)) < 0.05
        assert np.max(np.abs(offsets)) < 0.25
