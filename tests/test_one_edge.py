"""Joints as wide as an eighth of their slabs are met at both of their edges, or the photo is refused."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from paved import gray_of, misses

import autoreg
from autoreg.answer.pattern_refusals import one_edged
from autoreg.camera import Camera
from autoreg.fitting.fit import Fit
from autoreg.fitting.one_edge import (
    MOST,
    _as_seen,
    met_at_one_edge,
    one_edge,
    one_edge_of_most,
    with_both_edges,
)
from autoreg.fitting.refine import refine
from autoreg.ground.sides import ALONG_X, Grid
from autoreg.joints.joint_looks import Strip
from autoreg.slabs.slab_effects import RIM_BELOW
from autoreg.solve.freedom import Free
from autoreg.synthetic import SyntheticPhoto, SyntheticScene, look_at_ground, render_paving

SIDE, JOINT = 0.4, 0.05
SCENE = SyntheticScene(
    camera=Camera(800, 600, 700.0, 700.0, 399.5, 299.5),
    cam_from_ground=look_at_ground(pitch_deg=38.0, height_m=1.6, heading_deg=20.0, foot_m=(0.13, 0.21)),
    spacing_m=(SIDE, SIDE),
    joint_width_m=JOINT,
    seed=4,
)


@pytest.fixture(scope="module")
def photo() -> SyntheticPhoto:
    return render_paving(SCENE)


@pytest.fixture(scope="module")
def along_edges(photo: SyntheticPhoto) -> Fit:
    """A fit whose narrow strips lie on the far edge of the joints along X."""
    pose = SCENE.cam_from_ground
    away = replace(pose, t=pose.t + pose.R @ np.array([0.0, 0.5 * JOINT, 0.0]))
    fit = refine(
        gray_of(photo), photo.camera, away, Grid(SIDE, SIDE),
        free=Free(), search=0.0, reaches=(6.0, 6.0), strip=Strip((0.002, JOINT), 0.8, (0, -1), True),
    )  # fmt: skip
    assert fit is not None
    return fit


def test_joints_met_at_one_edge_differ_from_side_to_side_and_others_do_not(along_edges: Fit, stack_fit: Fit):
    at_one, at_both = one_edge(along_edges)
    assert at_one > 2 * MOST
    assert one_edge_of_most(along_edges)[0] > 2 * MOST
    assert at_both < 0.1
    assert max(one_edge(stack_fit)) < 0.1
    refusal = one_edged(at_one)
    assert refusal is not None
    assert "only one edge" in refusal.message
    assert one_edged(MOST) is None


def test_joints_that_are_measured_anew_are_met_at_both_edges(along_edges: Fit, photo: SyntheticPhoto):
    fit = with_both_edges(gray_of(photo), along_edges, reach=6.0)
    assert max(one_edge(fit)) < 0.1
    assert fit.strip.width == pytest.approx((JOINT, JOINT), rel=0.03)
    angle_deg, crossing_px = misses(fit.cam_from_ground, (SIDE, SIDE), photo)
    assert angle_deg < 0.01
    assert crossing_px < 0.1


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_joints_of_which_more_are_missed_when_measured_anew_stay_as_they_were(
    along_edges: Fit, photo: SyntheticPhoto, monkeypatch: pytest.MonkeyPatch, missing: float
):
    # A rim in the light differs from the other side as well, and beside it a wide strip meets nothing.
    anew = with_both_edges(gray_of(photo), along_edges, reach=6.0)
    kept = np.random.default_rng(3).uniform(size=len(anew.usable)) >= missing
    thinner = replace(anew, usable=anew.usable & kept)
    assert max(one_edge(thinner)) < 0.1
    monkeypatch.setattr("autoreg.fitting.one_edge.refine_until_still", lambda *_, **__: thinner)
    assert (with_both_edges(gray_of(photo), along_edges, reach=6.0) is along_edges) == (missing > 0)


def test_joints_that_are_mere_steps_when_measured_anew_stay_as_they_were(
    along_edges: Fit, photo: SyntheticPhoto, monkeypatch: pytest.MonkeyPatch
):
    toned, anew = (
        replace(fit, strip=replace(fit.strip, polarity=polarity))
        for fit, polarity in (
            (along_edges, (-1, -1)),
            (with_both_edges(gray_of(photo), along_edges, reach=6.0), (0, -1)),
        )
    )
    monkeypatch.setattr("autoreg.fitting.one_edge.refine_until_still", lambda *_, **__: anew)
    assert with_both_edges(gray_of(photo), toned, reach=6.0) is toned


def test_what_lies_beside_a_field_does_not_count(stack_fit: Fit):
    # Faint joints, between slabs that differ by little, and the step of tone where the slabs end.
    stations, depth = stack_fit.stations, 0.2 * stack_fit.offsets.depth
    usable = stack_fit.usable & (stations.family == ALONG_X)
    lines, counts = np.unique(stations.line[usable], return_counts=True)
    step = np.where(stations.line == lines[counts.argmax()], -120.0, -0.1 * np.abs(depth))
    bordered = replace(stack_fit, offsets=replace(stack_fit.offsets, step=step, depth=depth))
    assert one_edge(bordered)[0] > MOST
    assert one_edge_of_most(bordered)[0] < 0.5 * MOST


def test_a_fit_that_met_both_edges_stays(stack_fit: Fit, stack_photo: SyntheticPhoto):
    assert with_both_edges(gray_of(stack_photo), stack_fit, reach=6.0) is stack_fit


@pytest.mark.parametrize(
    ("joint", "seed"),
    [
        (0.045, 1),
        pytest.param(0.055, 2, marks=pytest.mark.slow),
        pytest.param(0.075, 4, marks=pytest.mark.slow),
        (0.09, 6),
    ],
)
def test_wide_joints_are_as_good_as_narrow_ones(joint: float, seed: int):
    """From a tenth of the slab's side to nearly a quarter, as joints with grass or gravel in them are."""
    pitch, heading = 30.0 + 5.0 * seed, 17.0 * seed
    pose = look_at_ground(pitch_deg=pitch, height_m=1.6, heading_deg=heading, foot_m=(0.13, 0.21))
    wide = render_paving(replace(SCENE, cam_from_ground=pose, joint_width_m=joint, seed=seed))
    found = autoreg.align(wide.pixels, wide.camera, slab=(SIDE, SIDE))
    a, b = found.lattice.spacing_x, found.lattice.spacing_y
    assert a is not None
    assert found.lattice.joint_width == pytest.approx(joint, rel=0.05)
    angle_deg, crossing_px = misses(found.pose.cam_from_ground, (a, b), wide)
    assert angle_deg < 0.02
    assert crossing_px < 0.2


def test_the_profiles_of_a_fit_along_the_edges_show_how_wide_the_joints_are_and_where(
    along_edges: Fit, photo: SyntheticPhoto
):
    seen = _as_seen(gray_of(photo), along_edges)
    assert seen is not None
    width, pose = seen
    assert width == pytest.approx((JOINT, JOINT), rel=0.1)
    _, crossing_px = misses(along_edges.cam_from_ground, (SIDE, SIDE), photo)
    assert crossing_px > 3.0
    _, crossing_px = misses(pose, (SIDE, SIDE), photo)
    assert crossing_px < 1.0


def test_the_profiles_of_large_slabs_show_it_too(along_edges: Fit, photo: SyntheticPhoto):
    size = (4 * SCENE.camera.width, 4 * SCENE.camera.height)
    large = cv2.resize(gray_of(photo), size, interpolation=cv2.INTER_CUBIC)
    seen = _as_seen(large, replace(along_edges, camera=SCENE.camera.scaled(*size)))
    assert seen is not None
    assert seen[0] == pytest.approx((JOINT, JOINT), rel=0.1)
    _, crossing_px = misses(seen[1], (SIDE, SIDE), photo)
    assert crossing_px < 1.0


def in_raking_light() -> np.ndarray:
    """Slabs with narrow dark joints whose rims on one side are bright, and fade into the slab."""
    px, across = 120, np.arange(120)
    rim = 60.0 * np.exp(-across / 11.0) - 60.0 * ((across < 3) | (across >= px - 3))
    joint = -60.0 * ((across < 3) | (across >= px - 3))
    tile = 120.0 + rim[:, None] + joint[None, :]
    rng = np.random.default_rng(3)
    ground = np.clip(np.tile(tile, (40, 40)) + rng.normal(0.0, 6.0, (40 * px, 40 * px)), 0, 255)
    pose, scale, middle = SCENE.cam_from_ground, SIDE / px, 20 * px
    on_ground = np.array([[scale, 0.0, -scale * middle], [0.0, scale, -scale * middle], [0.0, 0.0, 1.0]])
    H = SCENE.camera.K @ np.column_stack([pose.R[:, 0], pose.R[:, 1], pose.t]) @ on_ground
    size = (SCENE.camera.width, SCENE.camera.height)
    twice = cv2.warpPerspective(
        cv2.GaussianBlur(ground.astype(np.float32), (0, 0), 1.0),
        np.diag([2.0, 2.0, 1.0]) @ H, (2 * size[0], 2 * size[1]), flags=cv2.INTER_LINEAR, borderValue=120.0,
    )  # fmt: skip
    return cv2.resize(twice, size, interpolation=cv2.INTER_AREA).astype(np.uint8)


def test_rims_that_the_sun_lights_on_one_side_are_no_wide_joints(monkeypatch: pytest.MonkeyPatch):
    gray = in_raking_light().astype(np.float32)
    fit = refine(
        gray, SCENE.camera, SCENE.cam_from_ground, Grid(SIDE, SIDE),
        free=Free(), search=0.02, reaches=(6.0, 6.0),
    )  # fmt: skip
    assert fit is not None
    assert max(one_edge(fit)) > 0.3
    monkeypatch.setattr("autoreg.fitting.one_edge.MOST", 0.3)
    assert met_at_one_edge(gray, fit) == 0.0
    # Nor are they where one family's are twice as wide as the other's.
    assert met_at_one_edge(gray, replace(fit, strip=replace(fit.strip, width=(0.02, 0.005)))) == 0.0


def test_joints_met_at_one_edge_that_are_wider_than_thought_are_told(along_edges: Fit, photo: SyntheticPhoto):
    assert met_at_one_edge(gray_of(photo), along_edges) == max(one_edge(along_edges))


@pytest.mark.slow
def test_what_crosses_wide_joints_does_not_bias_uneven_slabs():
    """Stations keep off the crossings by more, the wider these are."""
    pose = look_at_ground(pitch_deg=53.0, height_m=1.0, heading_deg=8.0, roll_deg=1.3, foot_m=(0.13, 0.21))
    wide = render_paving(
        replace(
            SCENE, camera=Camera.from_focal(1024, 768, 896.0), cam_from_ground=pose,
            spacing_m=(0.2, 0.1), joint_width_m=0.02, jitter_m=0.0005, seed=21,
        )
    )  # fmt: skip
    found = autoreg.align(wide.pixels, wide.camera, slab=(0.2, 0.1))
    height = found.pose.cam_from_ground.origin_in_a[2] / pose.origin_in_a[2]
    assert height == pytest.approx(1.0, abs=0.0007)
    # Rims that may be bevelled leave more unknown of joints so wide than these slabs do.
    assert found.pose.sigma_height < np.hypot(0.001, RIM_BELOW * 0.02)
