from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from paved import CAMERA, STACK

from autoreg.camera import Camera
from autoreg.geometry import rotation_from_vector
from autoreg.ground.rectify import (
    Family,
    Rectified,
    grid_axes,
    line_support,
    near_reach,
    picture_gradient,
    rectify,
)
from autoreg.synthetic import SyntheticPhoto, look_at_ground, render_paving

UP = look_at_ground(pitch_deg=-45.0, height_m=1.0).R


def joint_and_slab_support(family: Family, spacing: float, phase: float) -> tuple[np.ndarray, np.ndarray]:
    """Median support of the lines at the joints, and of those half way between them, near the camera."""
    edges = np.arange(0, family.evidence.shape[1], 24)
    support, seen = line_support(family, edges)
    counted = seen > 18
    lines = np.where(counted.sum(1) >= 3, (support * counted).sum(1) / np.maximum(counted.sum(1), 1), np.nan)
    found: list[np.ndarray] = []
    for part in (0.0, 0.5):
        k = np.arange(-40, 40) + part
        row = np.searchsorted(family.offset, phase + k * spacing)
        row = row[(row > 2) & (row < len(lines) - 3)]
        # A joint between two rows of the grid shows in either.
        near = np.nanmax(lines[row[:, None] + np.arange(-2, 2)][np.isfinite(lines[row])], axis=1)
        found.append(near)
    return found[0], found[1]


@pytest.mark.parametrize("axis", [0, 1])
def test_lines_at_the_joints_stand_out_from_those_between_them(stack_rectified: Rectified, axis: int):
    eye = STACK.cam_from_ground.origin_in_a / STACK.cam_from_ground.origin_in_a[2]
    family = (stack_rectified.y, stack_rectified.x)[axis]
    spacing = STACK.spacing_m[axis] / STACK.cam_from_ground.origin_in_a[2]
    at_joints, between = joint_and_slab_support(family, spacing, -float(eye[axis]))
    assert len(at_joints) >= 5
    assert np.median(at_joints) > 2.0 * np.median(between)


def test_a_wrong_orientation_blurs_the_lines(stack_photo: SyntheticPhoto, stack_rectified: Rectified):
    turned = rotation_from_vector(np.deg2rad([0.0, 0.0, 3.0])) @ stack_photo.cam_from_ground.R
    askew = rectify(picture_gradient(stack_photo.pixels.mean(-1)), stack_photo.camera, turned)
    assert askew is not None

    def contrast(family: Family) -> float:
        return float(np.var(np.abs(family.evidence.sum(1)) / np.sqrt(family.visible.sum(1) + 1)))

    assert contrast(stack_rectified.x) > 2.0 * contrast(askew.x)


def test_evidence_is_bounded_and_zero_where_nothing_is_seen(stack_rectified: Rectified):
    for family in (stack_rectified.x, stack_rectified.y):
        assert np.abs(family.evidence).max() <= 1.0
        assert not family.evidence[~family.visible].any()
        assert (np.diff(family.offset) > 0).all()
        assert (np.diff(family.along) > 0).all()
        assert family.evidence.shape == (len(family.offset), len(family.along))


def test_both_families_look_at_the_same_ground(stack_rectified: Rectified):
    assert (stack_rectified.x.visible == stack_rectified.y.visible.T).all()
    assert (stack_rectified.x.offset == stack_rectified.y.along).all()


def test_a_uniform_picture_is_no_evidence():
    flat = np.full((CAMERA.height, CAMERA.width), 120.0)
    rectified = rectify(picture_gradient(flat), CAMERA, STACK.cam_from_ground.R)
    assert rectified is not None
    assert not rectified.x.evidence.any()


def test_the_sky_has_no_rectification():
    assert rectify(picture_gradient(np.zeros((CAMERA.height, CAMERA.width))), CAMERA, UP) is None
    assert grid_axes(CAMERA, UP, 12.0, 800) is None


@given(st.floats(25.0, 80.0), st.integers(0, 3), st.floats(5.0, 85.0))
@settings(deadline=None, derandomize=True, max_examples=15)
def test_neighbours_on_the_ground_grid_are_at_most_about_a_pixel_apart(
    pitch: float, quarter_turns: int, heading: float
):
    camera = Camera.from_focal(320, 240, 300.0)
    R = look_at_ground(pitch_deg=pitch, height_m=1.0, heading_deg=90.0 * quarter_turns + heading).R
    axes = grid_axes(camera, R, 3.0, 100_000)
    assert axes is not None
    xs, ys = axes
    ground = np.stack([*np.meshgrid(xs, ys), -np.ones((len(ys), len(xs)))], -1)
    px = camera.project(ground @ R.T)
    size = np.array([camera.width, camera.height])
    seen = np.isfinite(px).all(-1) & ((px > 0) & (px < size - 1)).all(-1)
    seen &= np.linalg.norm(ground[..., :2], axis=-1) < 3.0
    # Lines of constant x a step apart, seen across themselves: not along Y, but across it.
    for step, along in ((0, 1), (1, 0)):
        move, line = np.gradient(px, axis=1 - step), np.gradient(px, axis=1 - along)
        line /= np.linalg.norm(line, axis=-1, keepdims=True)
        across = np.abs(move[..., 0] * line[..., 1] - move[..., 1] * line[..., 0])
        assert np.nanquantile(across[seen], 0.99) < 1.15


def test_a_lens_is_undone(stack_rectified: Rectified):
    scene = replace(STACK, camera=replace(CAMERA, dist=(-0.2, 0.06, 6e-4, -4e-4)))
    bent = rectify(
        picture_gradient(render_paving(scene).pixels.mean(-1)), scene.camera, scene.cam_from_ground.R
    )
    assert bent is not None
    eye = scene.cam_from_ground.origin_in_a
    spacing, phase = scene.spacing_m[1] / eye[2], -float(eye[1] / eye[2])
    at_joints, between = joint_and_slab_support(bent.x, spacing, phase)
    straight, _ = joint_and_slab_support(stack_rectified.x, spacing, phase)
    assert np.median(at_joints) > 2.0 * np.median(between)
    assert np.median(at_joints) > 0.8 * np.median(straight)


def test_support_is_one_for_noise_and_grows_with_the_root_of_the_samples_for_a_line():
    rng = np.random.default_rng(0)
    evidence = rng.choice([-0.5, 0.5], (400, 64)).astype(np.float32)
    evidence[7] = 0.5
    family = Family(evidence, np.ones((400, 64), bool), np.arange(400.0), np.arange(64.0))
    support, seen = line_support(family, np.array([0, 64]))
    assert (seen == 64).all()
    assert support[7, 0] == pytest.approx(8.0, rel=0.02)
    # The mean of |N(0, 1)|.
    assert np.delete(support, 7).mean() == pytest.approx(0.798, abs=0.1)


@pytest.mark.parametrize("pitch_deg", [25.0, 40.0, 60.0])
def test_the_nearest_ground_is_at_the_lower_edge(pitch_deg: float):
    camera = Camera.from_focal(640, 480, 560.0)
    R = look_at_ground(pitch_deg=pitch_deg, height_m=1.7).R
    down = np.deg2rad(pitch_deg) + np.arctan((camera.height - 1 - camera.cy) / camera.fy)
    nearest = 1 / np.tan(down) if down < np.pi / 2 else 0.0
    assert near_reach(camera, R, beyond=2.0) == pytest.approx(2.0 + nearest, rel=0.02)


def test_without_ground_the_reach_is_only_what_is_added():
    assert near_reach(CAMERA, UP, beyond=2.0) == 2.0
