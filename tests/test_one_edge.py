"""Joints as wide as an eighth of their slabs are met at both of their edges, or the photo is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from paved import gray_of, misses

import autoreg
from autoreg.answer.pattern_refusals import one_edged
from autoreg.camera import Camera
from autoreg.fitting.fit import Fit
from autoreg.fitting.one_edge import MOST, one_edge, with_both_edges
from autoreg.fitting.refine import refine
from autoreg.ground.sides import Grid
from autoreg.joints.joint_looks import Strip
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


def test_a_fit_that_met_both_edges_stays(stack_fit: Fit, stack_photo: SyntheticPhoto):
    assert with_both_edges(gray_of(stack_photo), stack_fit, reach=6.0) is stack_fit


@pytest.mark.parametrize(("joint", "seed"), [(0.045, 1), (0.055, 2), (0.055, 3)])
def test_wide_joints_never_leave_a_pose_half_a_joint_off(joint: float, seed: int):
    pitch, heading = 30.0 + 5.0 * seed, 17.0 * seed
    pose = look_at_ground(pitch_deg=pitch, height_m=1.6, heading_deg=heading, foot_m=(0.13, 0.21))
    wide = render_paving(replace(SCENE, cam_from_ground=pose, joint_width_m=joint, seed=seed))
    try:
        found = autoreg.align(wide.pixels, wide.camera, slab=(SIDE, SIDE))
    except autoreg.Refusal:
        return
    a, b = found.lattice.spacing_x, found.lattice.spacing_y
    assert a is not None
    angle_deg, crossing_px = misses(found.pose.cam_from_ground, (a, b), wide)
    assert angle_deg < 0.05
    assert crossing_px < 0.5
