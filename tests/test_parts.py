"""Small slabs in a large photo, seen from a window: a part of it shows them where all of it is too small."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

import autoreg
from autoreg import laying_in_tone
from autoreg.answer.refusals import not_measured
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.ground.sight import Sight, see
from autoreg.image import as_gray
from autoreg.laying import lay_where
from autoreg.parts import SeenCloser, lattice_by_part, paving_by_part
from autoreg.rows.rows import Rows
from autoreg.synthetic import SyntheticScene, look_at_ground, render_paving
from autoreg.task import Task
from benchmarks.suites.robust import angle_up_to_quarter_turns

CAMERA = Camera.from_focal(1600, 1200, 1280.0)
BRICKS = SyntheticScene(
    camera=CAMERA,
    cam_from_ground=look_at_ground(pitch_deg=25.0, height_m=6.0, heading_deg=25.0, roll_deg=1.0),
    spacing_m=(0.2, 0.1),
    shift=0.5,
    joint_width_m=0.006,
    jitter_m=0.0008,
    noise_grey=3.0,
    colour=False,
    seed=3,
)
SETTS = replace(BRICKS, spacing_m=(0.1, 0.1), shift=0.0)
ROWS = replace(BRICKS, kind="rows", shift=0.0, jitter_m=0.0)


def sight_of(scene: SyntheticScene) -> Sight:
    return see(as_gray(render_paving(scene).pixels))


@pytest.fixture(scope="module")
def bricks_by_part() -> SeenCloser:
    return seen_in_part(BRICKS)


@pytest.fixture(scope="module")
def rows_by_part() -> SeenCloser:
    return seen_in_part(ROWS)


def seen_in_part(scene: SyntheticScene) -> SeenCloser:
    seen = paving_by_part(sight_of(scene), CAMERA)
    assert seen is not None
    return seen


def test_small_slabs_are_aligned_by_a_part_of_the_photo(monkeypatch: pytest.MonkeyPatch):
    by_part = Mock(wraps=paving_by_part)
    monkeypatch.setattr(laying_in_tone, "paving_by_part", by_part)
    found = autoreg.align(render_paving(BRICKS).pixels, CAMERA, slab=BRICKS.spacing_m)
    # Where all of it is looked at, there is nothing to be found.
    by_part.assert_called_once()
    assert angle_up_to_quarter_turns(found.pose.cam_from_ground, BRICKS.cam_from_ground) < 0.02
    assert found.lattice.kind == "running"
    assert found.pose.cam_from_ground.origin_in_a[2] == pytest.approx(6.0, rel=5e-4)
    # The joints of the whole photo carry the fit, not those of the part alone.
    ends = np.concatenate([joint.ends_px for joint in found.joints])
    assert np.ptp(ends[:, 0]) > 0.8 * CAMERA.width


def test_rows_that_a_part_shows_are_aligned(rows_by_part: SeenCloser, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(laying_in_tone, "lay", Mock(side_effect=Refusal("no_lattice", "nothing")))
    by_part = Mock(return_value=rows_by_part)
    monkeypatch.setattr(laying_in_tone, "paving_by_part", by_part)
    found = autoreg.align(render_paving(ROWS).pixels, CAMERA)
    by_part.assert_called_once()
    assert found.lattice.kind == "rows"
    assert angle_up_to_quarter_turns(found.pose.cam_from_ground, ROWS.cam_from_ground) < 0.02


def test_without_a_camera_no_part_is_believed():
    with pytest.raises(Refusal):
        autoreg.align(render_paving(SETTS).pixels, None, slab=SETTS.spacing_m)


def test_rows_count_where_half_a_photo_shows_them(rows_by_part: SeenCloser):
    assert isinstance(rows_by_part.found, Rows)
    # At the scale of half the photo, which is four times as many pixels as all of it is looked at with.
    assert rows_by_part.sight.looks.picture.size == CAMERA.width * CAMERA.height
    assert rows_by_part.found.fit.camera.width == CAMERA.width


def test_a_photo_that_is_hardly_made_smaller_has_no_parts():
    small = CAMERA.scaled(1340, 1005)
    assert paving_by_part(sight_of(replace(BRICKS, camera=small)), small) is None


def test_ground_without_slabs_has_none_in_any_part():
    assert paving_by_part(sight_of(replace(BRICKS, kind="gravel", shift=0.0, jitter_m=0.0)), CAMERA) is None


def test_cross_joints_that_a_part_shows_make_a_lattice_of_rows(
    rows_by_part: SeenCloser, monkeypatch: pytest.MonkeyPatch
):
    rows, bricks = sight_of(ROWS), sight_of(BRICKS)
    laid = lay_where(Task(rows_by_part.sight, CAMERA, "file"), rows_by_part.found)
    assert laid.fit.grid.spacing_x is None

    # Bricks whose rows alone are found in the whole photo.
    monkeypatch.setattr(laying_in_tone, "lay", lambda task: laid)
    _, found = laying_in_tone.lay_in_clearest_tone(Task(bricks, CAMERA, "file"))
    assert found.fit.grid.shift == pytest.approx(0.5)
    assert found.fit.grid.spacing_x == pytest.approx(2.0 * found.fit.grid.spacing_y, rel=1e-3)

    # Ashlar has rows in its parts, too.
    assert lattice_by_part(rows, CAMERA, laid.fit.cam_from_ground.R) is None
    _, found = laying_in_tone.lay_in_clearest_tone(Task(rows, CAMERA, "file"))
    assert found is laid


@pytest.mark.parametrize(
    ("there", "told"),
    [
        (not_measured(12), "one_direction"),
        (Refusal("camera_contradicted", "these joints are not square"), "camera_contradicted"),
    ],
    ids=["vanishes", "is refused"],
)
def test_what_a_part_shows_may_be_refused_in_the_whole(
    there: Refusal, told: str, bricks_by_part: SeenCloser, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(laying_in_tone, "lay", Mock(side_effect=Refusal("one_direction", "lines")))
    monkeypatch.setattr(laying_in_tone, "paving_by_part", lambda *_: bricks_by_part)
    monkeypatch.setattr(laying_in_tone, "lay_where", Mock(side_effect=there))
    with pytest.raises(Refusal) as refusal:
        autoreg.align(render_paving(BRICKS).pixels, CAMERA)
    assert refusal.value.code == told
