"""Of two fields of paving in a photo the larger one is the answer, or the one whose slabs are asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autoreg.align import align
from autoreg.camera import Camera
from autoreg.fields import largest_field
from autoreg.ground.points import on_ground
from autoreg.ground.sight import Sight, see
from autoreg.paving.lattice_choice import Paving
from autoreg.search import find_paving
from autoreg.synthetic import SyntheticScene, look_at_ground, render_paving
from tests.paved import gray_of

CAMERA = Camera(900, 700, 800.0, 800.0, 449.5, 349.5)
NEAR = SyntheticScene(
    camera=CAMERA,
    cam_from_ground=look_at_ground(pitch_deg=32.0, height_m=1.7, heading_deg=12.0),
    spacing_m=(0.2, 0.1),
    shift=0.5,
    joint_width_m=0.006,
    seed=11,
)
FAR = replace(NEAR, spacing_m=(0.6, 0.3), shift=1 / 3, slab_tone=185.0, seed=12)


def beside(near: SyntheticScene, far: SyntheticScene, border_m: float) -> np.ndarray:
    """Grey levels of one field up to so far from the camera's foot along the paving, and another beyond."""
    px = np.stack(np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height)), -1).astype(float)
    ground = on_ground(px.reshape(-1, 2), CAMERA, near.cam_from_ground).reshape(*px.shape)
    foot = near.cam_from_ground.origin_in_a
    ahead = near.cam_from_ground.R[2, :2]
    along = (ground - foot[:2]) @ (ahead / np.linalg.norm(ahead))
    first, second = (gray_of(render_paving(scene)) for scene in (near, far))
    return np.where(along < border_m, first, second).astype(np.uint8)


@pytest.fixture(scope="module")
def two_fields() -> np.ndarray:
    return beside(NEAR, FAR, 2.4)


def found_in(gray: np.ndarray) -> tuple[Sight, Paving]:
    sight = see(gray)
    found = find_paving(sight, CAMERA)
    assert isinstance(found, Paving)
    return sight, found


def sides_in_heights(paving: Paving) -> list[float]:
    height = float(paving.fit.cam_from_ground.origin_in_a[2])
    return [(paving.grid.spacing_x or np.nan) / height, paving.grid.spacing_y / height]


def test_the_plainest_field_is_the_near_one(two_fields: np.ndarray) -> None:
    _, found = found_in(two_fields)
    assert sides_in_heights(found) == pytest.approx([0.2 / 1.7, 0.1 / 1.7], rel=0.02)


def test_the_larger_field_beyond_it_is_taken(two_fields: np.ndarray) -> None:
    sight, found = found_in(two_fields)
    largest = largest_field(sight, found, CAMERA)
    assert sides_in_heights(largest) == pytest.approx([0.6 / 1.7, 0.3 / 1.7], rel=0.02)
    assert largest.grid.shift == pytest.approx(1 / 3, abs=0.01)


def test_of_two_fields_that_with_the_known_slabs_is_taken() -> None:
    sight, found = found_in(beside(replace(NEAR, spacing_m=(0.15, 0.1)), FAR, 2.4))
    assert largest_field(sight, found, CAMERA, (0.15, 0.1)) is found
    other = largest_field(sight, found, CAMERA, (0.6, 0.3))
    assert other is not found
    assert sides_in_heights(other) == pytest.approx([0.6 / 1.7, 0.3 / 1.7], rel=0.02)


def test_a_field_too_fine_for_the_whole_photo_is_no_other_one(
    two_fields: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    sight, found = found_in(two_fields)
    grid = found.grid
    assert grid.spacing_x is not None
    fine = replace(
        found.fit, grid=replace(grid, spacing_x=grid.spacing_x / 40, spacing_y=grid.spacing_y / 40)
    )
    looked = []

    def tiny(*asked: object) -> Paving:
        looked.append(asked)
        return replace(found, fit=fine)

    monkeypatch.setattr("autoreg.fields._found_in", tiny)
    assert largest_field(sight, found, CAMERA) is found
    assert looked


def test_a_field_of_one_lattice_stays_as_it_is() -> None:
    sight, found = found_in(beside(NEAR, NEAR, 2.4))
    assert largest_field(sight, found, CAMERA) is found


def test_a_part_of_the_same_lattice_is_no_other_field() -> None:
    # A strip without joints parts it.
    gray = beside(NEAR, NEAR, 2.4)
    gray[300:360] = 150
    sight, found = found_in(gray)
    assert largest_field(sight, found, CAMERA) is found


def test_the_answer_is_the_larger_field(two_fields: np.ndarray) -> None:
    answer = align(two_fields, CAMERA, slab=(0.6, 0.3))
    assert answer.lattice.kind == "running"
    assert answer.lattice.shift == pytest.approx(1 / 3, abs=0.01)
    height = float(answer.pose.cam_from_ground.origin_in_a[2])
    assert height == pytest.approx(1.7, rel=0.005)
    up = answer.pose.cam_from_ground.R[:, 2] @ NEAR.cam_from_ground.R[:, 2]
    assert np.rad2deg(np.arccos(min(up, 1.0))) < 0.1
