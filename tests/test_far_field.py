"""How far paving goes on, by the photo's own resolution."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from autoreg.answer.full_resolution import Laid, measured_rows, measured_slabs
from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.ground.points import inside_convex, lengths, project_ground
from autoreg.ground.sides import Grid
from autoreg.ground.sight import see
from autoreg.image import as_gray
from autoreg.joints.joint_looks import Strip
from autoreg.paving.far_field import farther_field
from autoreg.paving.lattice_evidence import Paving
from autoreg.search.find import find_paving, find_rows
from autoreg.solve.freedom import Free
from autoreg.synthetic import SyntheticScene, look_at_ground, render_paving
from benchmarks.suites.robust import angle_up_to_quarter_turns

HEIGHT_M = 4.0
SCENE = SyntheticScene(
    camera=Camera.from_focal(1600, 1200, 1280.0),
    cam_from_ground=look_at_ground(pitch_deg=33.0, height_m=HEIGHT_M, heading_deg=25.0, roll_deg=1.0),
    spacing_m=(0.2, 0.2),
    joint_width_m=0.008,
    jitter_m=0.0005,
    noise_grey=3.0,
    colour=False,
    seed=5,
)


class Lattice(NamedTuple):
    camera: Camera = SCENE.camera
    cam_from_ground: Rigid = SCENE.cam_from_ground
    grid: Grid = Grid(*SCENE.spacing_m)
    strip: Strip = Strip((0.008, 0.008), 0.8, (-1, -1))


@pytest.fixture(scope="module")
def gray() -> np.ndarray:
    return as_gray(render_paving(SCENE).pixels)


def ahead(heights: float, aside_m: float = 0.0) -> np.ndarray:
    """A place on the ground so many camera heights ahead, and so far to the right."""
    R, eye = SCENE.cam_from_ground.R, SCENE.cam_from_ground.origin_in_a
    forward, right = (axis[:2] / np.linalg.norm(axis[:2]) for axis in (R[2], R[0]))
    return eye[:2] + heights * HEIGHT_M * forward + aside_m * right


ALL = np.array([ahead(0.5, 9.0), ahead(4.0, 9.0), ahead(4.0, -9.0), ahead(0.5, -9.0)])
NEAR = np.array([ahead(1.2, 1.0), ahead(1.5, 1.0), ahead(1.5, -1.0), ahead(1.2, -1.0)])


def test_paving_goes_on_as_far_as_its_slabs_are_seen(gray: np.ndarray):
    field = farther_field(gray.astype(np.float32), Lattice(), NEAR, 100)
    assert field is not None
    assert inside_convex(np.array([ahead(0.9), ahead(2.0), ahead(2.8)]), field, 0.0).all()
    assert inside_convex(NEAR, field, 1e-9).all()


def test_what_lies_beyond_paving_is_none_of_it(gray: np.ndarray):
    beyond = np.array([ahead(1.7, 40.0), ahead(60.0, 40.0), ahead(60.0, -40.0), ahead(1.7, -40.0)])
    px = np.round(project_ground(SCENE.camera, SCENE.cam_from_ground, beyond)).astype(int)
    lawn = np.random.default_rng(0).normal(120.0, 12.0, gray.shape).astype(np.uint8)
    outline = np.zeros(gray.shape, np.uint8)
    cv2.fillPoly(outline, [px], 1)
    field = farther_field(np.where(outline > 0, lawn, gray).astype(np.float32), Lattice(), NEAR, 100)
    assert field is not None
    eye = SCENE.cam_from_ground.origin_in_a
    forward = (field - eye[:2]) @ (ahead(1.0) - eye[:2]) / HEIGHT_M**2
    assert 1.5 < forward.max() < 1.8


@pytest.mark.parametrize(("known", "looked_at"), [(NEAR, 100_000), (ALL, 100)])
def test_a_field_that_is_known_whole_is_left(gray: np.ndarray, known: np.ndarray, looked_at: int):
    assert farther_field(gray.astype(np.float32), Lattice(), known, looked_at) is None


def reach_of(laid: Laid) -> float:
    """How far off joints were measured, in camera heights."""
    pose = laid.fit.cam_from_ground
    away = lengths(laid.fit.stations.ground - pose.origin_in_a[:2])
    return float(np.quantile(away, 0.95) / pose.origin_in_a[2])


def doubt_of(laid: Laid) -> float:
    """The volume of what is not known of the turn."""
    return float(np.sqrt(np.linalg.det(laid.likeliest.covariance[:3, :3])))


def check_that_farther_is_surer(laid: Callable[[], Laid], monkeypatch: pytest.MonkeyPatch) -> None:
    whole = laid()
    monkeypatch.setattr("autoreg.answer.full_resolution.farther_field", lambda *_: None)
    near = laid()
    assert reach_of(whole) > 1.2 * reach_of(near)
    assert doubt_of(whole) < 0.6 * doubt_of(near)
    assert np.ptp(whole.field, axis=0).prod() > 1.2 * np.ptp(near.field, axis=0).prod()
    assert angle_up_to_quarter_turns(whole.likeliest.fit.cam_from_ground, SCENE.cam_from_ground) < 0.003


def test_slabs_that_detection_scale_does_not_show_make_the_pose_surer(
    gray: np.ndarray, monkeypatch: pytest.MonkeyPatch
):
    sight, picture = see(gray), gray.astype(np.float32)
    found = find_paving(sight, SCENE.camera)
    assert isinstance(found, Paving)
    check_that_farther_is_surer(
        lambda: measured_slabs(sight, picture, found, Free(ratio=True), None), monkeypatch
    )


def test_rows_that_detection_scale_does_not_show_make_the_pose_surer(monkeypatch: pytest.MonkeyPatch):
    gray = as_gray(render_paving(replace(SCENE, kind="rows", spacing_m=(0.4, 0.2), jitter_m=0.0)).pixels)
    sight, picture = see(gray), gray.astype(np.float32)
    found = find_rows(sight, SCENE.camera)
    assert found is not None
    check_that_farther_is_surer(
        lambda: measured_rows(sight, picture, found, Free(), square=False, ground=False), monkeypatch
    )
