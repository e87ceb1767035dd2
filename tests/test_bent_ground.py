"""Paving falls to its gutters: ground bent by millimetres in a metre is paving, seen by a right camera."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from jaxtyping import UInt8

from autoreg.align import align
from autoreg.camera import Camera
from autoreg.fitting.fit import Fit
from autoreg.ground.points import on_ground, project_ground
from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.image import as_gray
from autoreg.numbering import numbered
from autoreg.slabs.bent_ground import bend_of, motions_to
from autoreg.synthetic import SyntheticScene, look_at_ground, render_paving

SLAB = (0.63, 0.475)
CAMERA = Camera.from_focal(800, 600, 640.0)
# The ground lies so far below the plane at its top at a distance of one metre, and grows with its square.
DROP_M = 0.004


def scene(pitch_deg: float, heading_deg: float, seed: int) -> SyntheticScene:
    """Slabs in a half bond that do not lie aside."""
    pose = look_at_ground(
        pitch_deg=pitch_deg, height_m=1.6, heading_deg=heading_deg, roll_deg=1.0, foot_m=(0.1, 0.2)
    )
    return SyntheticScene(
        camera=CAMERA, cam_from_ground=pose, spacing_m=SLAB, shift=0.5, colour=False, seed=seed
    )


def domed(flat: SyntheticScene) -> UInt8[np.ndarray, "h w"]:
    """The photo of a scene as it looks where its ground falls off to all sides from beside the camera."""
    camera, pose = flat.camera, flat.cam_from_ground
    u, v = np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height)))
    plane = on_ground(np.stack([u, v], -1).reshape(-1, 2), camera, pose)
    x, y, height = pose.origin_in_a
    eye, ground = np.array([x, y]), plane
    for _ in range(30):
        below = np.minimum(DROP_M * (ground**2).sum(1), 0.5 * height)
        ground = eye + (plane - eye) * (1.0 + below / height)[:, None]
    seen = project_ground(camera, pose, ground).reshape(*u.shape, 2)
    at = np.nan_to_num(seen, nan=-10.0).astype(np.float32)
    gray = as_gray(render_paving(flat).pixels)
    bent = cv2.remap(gray, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.clip(bent, 0, 255).astype(np.uint8)


def test_joints_that_bow_over_bent_ground_are_no_arcs():
    found = align(domed(scene(28.0, 1.81, 3)), CAMERA, slab=SLAB)
    assert found.lattice.kind == "running"
    assert found.camera.consistent is not False


def test_a_right_camera_is_not_called_wrong_over_bent_ground():
    # Courses that lie across the view and bow: by a bent lens far off its axis they would be straight.
    found = align(domed(scene(36.44, 88.85, 8)), CAMERA, slab=SLAB)
    assert found.camera.consistent is not False
    assert found.camera.focal_from_photo_px == pytest.approx(CAMERA.fx, rel=0.03)


def test_a_wrong_camera_is_called_wrong_over_bent_ground():
    wrong = replace(CAMERA, fx=1.15 * CAMERA.fx, fy=1.15 * CAMERA.fy)
    found = align(domed(scene(36.44, 35.0, 8)), wrong, slab=SLAB)
    assert found.camera.consistent is False
    assert not any("ground is bent" in warning for warning in found.warnings)
    assert found.camera.focal_from_photo_px == pytest.approx(CAMERA.fx, rel=0.01)


def test_a_fit_over_bent_ground_tells_how_far_it_lies_off_its_plane_and_leans(stack_fit: Fit):
    assert bend_of(stack_fit) is None
    ground, up = stack_fit.stations.ground, stack_fit.cam_from_ground.R[:, 2]
    away = ground - ground[stack_fit.usable].mean(0)
    bend = np.array([[0.01, 0.002], [0.002, -0.004]])
    height = np.einsum("ni,ij,nj->n", away, bend, away)
    moved = stack_fit.solution.jacobian[:, 3:6] @ up * height
    found = bend_of(replace(stack_fit, distances_px=stack_fit.distances_px - moved))
    assert found is not None
    slope = (2.0 * away @ bend)[stack_fit.usable]
    assert found.lean == pytest.approx(np.sqrt((slope**2).sum(1).mean()), rel=0.02)
    assert found.off == pytest.approx(np.quantile(np.abs(height[stack_fit.usable]), 0.95), rel=0.02)
    # Turns that lay the plane on the ground are about its own axes: none of them is about up.
    assert up @ found.spread[:3, :3] @ up == pytest.approx(0.0, abs=1e-12)
    assert np.trace(found.spread[:3, :3]) == pytest.approx(found.lean**2)


@pytest.mark.parametrize("families", [(ALONG_X,), (ALONG_X, ALONG_Y)])
def test_lines_that_lie_aside_and_askew_by_chance_are_hardly_ever_a_bend(
    stack_fit: Fit, families: tuple[int]
):
    # By 3 mm, and by as much from end to end: they were taken for a bend in one of forty photos.
    stations = stack_fit.stations
    usable = stack_fit.usable & np.isin(stations.family, families)
    line, names = numbered(stations.family, stations.line)
    along = np.where(stations.family == ALONG_X, stations.ground[:, 0], stations.ground[:, 1])
    bends = 0
    for seed in range(300):
        aside, askew = np.random.default_rng(seed).normal(0.0, 0.003, (2, len(names)))
        off = aside[line] + askew[line] * along / np.abs(along).max()
        off_px = off * stack_fit.profiles.px_per_unit
        bends += bend_of(replace(stack_fit, usable=usable, distances_px=off_px)) is not None
    assert bends <= 1


def test_motions_to_the_ground_of_a_place_lay_the_plane_on_it(stack_fit: Fit):
    pose, place = stack_fit.cam_from_ground, np.array([[0.7, -1.2]])
    height, slope = np.array([0.01]), np.array([[0.003, -0.002]])
    turn, move = np.split((motions_to(place, height, slope) @ np.kron(np.eye(2), pose.R.T))[0], 2)
    for beside in np.array([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]]):
        on_plane = pose.R @ np.r_[place[0] + beside, 0.0] + pose.t
        laid = on_plane + np.cross(turn, on_plane - pose.t) + move
        rise = pose.R.T @ (laid - on_plane)
        assert rise[2] == pytest.approx(height[0] + slope[0] @ beside, abs=1e-9)


def test_a_pose_over_bent_ground_is_no_surer_than_the_ground_is_even():
    flat = scene(40.0, 30.0, 5)
    photos = domed(flat), as_gray(render_paving(flat).pixels)
    found, even = (align(photo, CAMERA, slab=SLAB) for photo in photos)
    assert not any("bent" in warning for warning in even.warnings)
    assert np.degrees(even.pose.sigma_turn) < 0.05
    (warning,) = (warning for warning in found.warnings if "bent" in warning)
    assert "mm" in warning
    # From its middle to its rim the ground leans by twice the drop times the distance.
    assert 0.1 < np.degrees(found.pose.sigma_turn) < 1.5


def test_a_camera_that_is_solved_for_lays_bent_ground_into_a_plane(stack_fit: Fit):
    away = stack_fit.stations.ground - stack_fit.stations.ground.mean(0)
    height = 0.01 * (away**2).sum(1)
    moved = stack_fit.solution.jacobian[:, 3:6] @ stack_fit.cam_from_ground.R[:, 2] * height
    fit = replace(stack_fit, distances_px=stack_fit.distances_px - moved)
    assert bend_of(fit) is not None
    assert bend_of(replace(fit, free=replace(fit.free, focal=True))) is None


@pytest.mark.parametrize("family", [ALONG_X, ALONG_Y])
def test_joints_of_one_direction_that_tell_no_bend_along_them_are_no_trouble(stack_fit: Fit, family: int):
    one_way = replace(stack_fit, usable=stack_fit.usable & (stack_fit.stations.family == family))
    assert bend_of(one_way) is None
    few = one_way.usable & (stack_fit.stations.line == stack_fit.stations.line[one_way.usable][0])
    assert bend_of(replace(stack_fit, usable=few)) is None
