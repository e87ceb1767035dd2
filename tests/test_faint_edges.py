"""Edges that noise hides from LSD, as the eye still sees them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from paved import misses

import autoreg
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.faint_edges import faint_edges
from autoreg.segments import detect_segments
from autoreg.synthetic import SyntheticScene, look_at_ground, render_paving

SIZE, HALF = 300, 3.0
SCENE = SyntheticScene(
    camera=Camera(1000, 750, 900.0, 900.0, 499.5, 374.5),
    cam_from_ground=look_at_ground(pitch_deg=40.0, height_m=1.6, heading_deg=25.0, foot_m=(0.13, 0.21)),
    spacing_m=(0.4, 0.4),
    joint_width_m=0.006,
    slab_tone=150.0,
    joint_tone=125.0,
    noise_grey=60.0,
    seed=3,
)


def noisy_line(angle: float, *, contrast: float, noise: float = 30.0, seed: int = 1):
    """A dark line through the picture's middle, and its normal."""
    y, x = np.mgrid[:SIZE, :SIZE].astype(float) - 0.5 * (SIZE - 1)
    normal = np.array([np.cos(angle), np.sin(angle)])
    dark = np.clip(HALF + 0.5 - np.abs(normal[0] * x + normal[1] * y), 0.0, 1.0)
    picture = cv2.GaussianBlur(140.0 - contrast * dark, (0, 0), 0.7)
    picture += np.random.default_rng(seed).normal(0.0, noise, picture.shape)
    return np.clip(np.round(picture), 0, 255).astype(np.uint8), normal


@pytest.mark.parametrize("angle", np.linspace(0.1, 6.2, 9))
def test_both_edges_of_a_line_are_found_in_noise_nearly_as_strong_as_it(angle: float):
    picture, normal = noisy_line(angle, contrast=40.0)
    found = faint_edges(picture)
    way = found[:, 1] - found[:, 0]
    length = np.linalg.norm(way, axis=1)
    off = (found.mean(1) - 0.5 * (SIZE - 1)) @ normal
    on_line = np.abs(np.abs(off) - HALF) < 1.5
    assert length[on_line].sum() > 0.6 * 2 * SIZE
    assert length[~on_line].sum() < 0.2 * length[on_line].sum()
    # The dark is to the right: between the two edges.
    right = np.stack([-way[:, 1], way[:, 0]], 1)
    assert ((right @ normal) * off < 0)[on_line].all()
    lean = np.abs(way @ normal) / length
    assert np.average(lean[on_line], weights=length[on_line]) < 0.03


def test_the_mean_place_of_the_edges_is_right():
    off = []
    for seed in range(8):
        picture, normal = noisy_line(0.7, contrast=40.0, seed=seed)
        found = faint_edges(picture)
        across = (found.mean(1) - 0.5 * (SIZE - 1)) @ normal
        length = np.linalg.norm(found[:, 1] - found[:, 0], axis=1)
        for side in (-1.0, 1.0):
            near = np.abs(across - side * HALF) < 1.5
            off.append(side * np.average(across[near], weights=length[near]) - HALF)
    assert abs(np.mean(off)) < 0.25


@pytest.mark.parametrize("noise", [0.0, 30.0])
def test_noise_alone_has_hardly_any_edges(noise: float):
    pictures = (noisy_line(0.0, contrast=0.0, noise=noise, seed=seed)[0] for seed in range(6))
    assert sum(len(faint_edges(picture)) for picture in pictures) <= 3


def test_paving_that_the_eye_sees_in_the_noise_is_aligned_though_lsd_sees_none(
    monkeypatch: pytest.MonkeyPatch,
):
    photo = render_paving(SCENE)
    found = autoreg.align(photo.pixels, photo.camera, slab=(0.4, 0.4))
    angle_deg, crossing_px = misses(found.pose.cam_from_ground, (0.4, 0.4), photo)
    assert angle_deg < 0.1
    assert crossing_px < 1.0
    monkeypatch.setattr("autoreg.segments.FEW", 0)
    with pytest.raises(Refusal):
        autoreg.align(photo.pixels, photo.camera, slab=(0.4, 0.4))


def test_clear_pictures_are_left_to_lsd(monkeypatch: pytest.MonkeyPatch):
    gray = cv2.cvtColor(render_paving(replace(SCENE, noise_grey=2.0)).pixels, cv2.COLOR_BGR2GRAY)
    found = detect_segments(gray)
    monkeypatch.setattr("autoreg.segments.faint_edges", None)
    np.testing.assert_array_equal(detect_segments(gray).ends_px, found.ends_px)
