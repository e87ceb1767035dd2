from __future__ import annotations

from concurrent.futures import Future
from dataclasses import replace

import boarded
import numpy as np
import pytest
from boarded import boards, photographed
from paved import STACK

from autoreg.errors import Refusal
from autoreg.geometry import angle_between_rotations, rotation_from_vector
from autoreg.ground.points import on_ground
from autoreg.ground.sight import Sight, see
from autoreg.image import as_gray
from autoreg.paving.lattice_evidence import Paving
from autoreg.paving.plane_combs import Hypothesis
from autoreg.search.find import find_paving, find_rows
from autoreg.search.glance import upright_by
from autoreg.search.hypotheses import THOROUGHLY, hypothesised, hypothesised_thoroughly
from autoreg.segments import Detection, Segments
from autoreg.synthetic import SyntheticPhoto, look_at_ground, render_paving
from benchmarks.suites import robust

NONE = Segments(np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0, int))


def agreed(segments: Segments, photo: SyntheticPhoto, direction: np.ndarray) -> np.ndarray:
    """Which segments run along a direction of the camera's frame."""
    ground = on_ground(segments.ends_px, photo.camera, photo.cam_from_ground)
    run = ground[:, 1] - ground[:, 0]
    lean = np.abs(run @ (photo.cam_from_ground.R.T @ direction)[:2]) / np.linalg.norm(run, axis=1)
    return np.flatnonzero(lean > np.cos(np.radians(2.0)))


class Waited(Exception):
    """Somebody has waited for the finest segments."""


def sight_of(photo: SyntheticPhoto) -> Sight:
    return see(photo.pixels.mean(-1).astype(np.uint8))


def with_detection(sight: Sight, coarse: Segments, finest: Segments | Waited) -> Sight:
    first: Future[Segments] = Future()
    first.set_result(coarse)
    begun: Future[Segments] = Future()
    if isinstance(finest, Waited):
        begun.set_exception(finest)
    else:
        begun.set_result(finest)
    return Sight(sight.gray, sight.looks, Detection(first, begun))


def sides_in_heights(paving: Paving) -> list[float]:
    height = paving.fit.cam_from_ground.origin_in_a[2]
    return sorted(side / height for side in (paving.grid.spacing_x or 0.0, paving.grid.spacing_y))


def test_what_is_plain_to_see_by_a_known_camera_does_not_wait_for_the_finest_segments(
    stack_photo: SyntheticPhoto,
):
    sight = sight_of(stack_photo)
    hasty = with_detection(sight, sight.detection.coarse, Waited())
    # All segments, in the place of the coarse ones, are the way without haste.
    slow = with_detection(sight, sight.segments, Waited())
    found, expected = (find_paving(seen, stack_photo.camera) for seen in (hasty, slow))
    assert isinstance(found, Paving)
    assert isinstance(expected, Paving)
    assert sides_in_heights(found) == pytest.approx(sides_in_heights(expected), rel=1e-3)
    assert found.grid.shift == expected.grid.shift


def test_what_coarse_segments_do_not_show_is_looked_for_in_all(stack_photo: SyntheticPhoto):
    sight = sight_of(stack_photo)
    found = find_paving(with_detection(sight, NONE, sight.segments), stack_photo.camera)
    assert isinstance(found, Paving)
    assert found.margin_nats > 0


def test_an_unknown_focal_length_is_told_by_all_segments(stack_photo: SyntheticPhoto):
    sight = sight_of(stack_photo)
    with pytest.raises(Waited):
        find_paving(with_detection(sight, sight.detection.coarse, Waited()), None)


def test_a_running_bond_that_only_its_cross_joints_tell_is_found_by_them(
    half_photo: SyntheticPhoto, monkeypatch: pytest.MonkeyPatch
):
    # As if no lattice of whole lines, nor one of courses, had been seen.
    monkeypatch.setattr("autoreg.search.glance.lay_combs", lambda *_: None)
    monkeypatch.setattr("autoreg.search.find.lay_lattice", lambda *_, **__: ())
    found = find_paving(sight_of(half_photo), half_photo.camera)
    assert isinstance(found, Paving)
    assert found.grid.shift == 0.5
    assert found.margin_nats > 0


def test_a_small_part_that_a_bad_fit_has_met_does_not_end_the_search():
    """The first start on this plain stack has three times the rows, and leads to a lattice 1 degree off."""
    (tilt,) = (axis for axis in robust.AXES if axis.name == "tilt")
    photo = robust.take(tilt, 20.0, 2, (1024, 768))
    found = find_paving(see(photo.gray), photo.told)
    assert isinstance(found, Paving)
    up, true = (pose.R[:, 2] for pose in (found.fit.cam_from_ground, photo.scene.cam_from_ground))
    assert np.rad2deg(np.arccos(up @ true)) < 0.05


def barred(photo: SyntheticPhoto) -> np.ndarray:
    """A photo with the shadows of a railing's bars across all of it, at 40 degrees to the joints."""
    gray = as_gray(photo.pixels).astype(float)
    height, width = gray.shape
    v, u = np.mgrid[:height, :width]
    px = np.stack([u.ravel(), v.ravel()], 1).astype(float)
    turn = rotation_from_vector(np.array([0.0, 0.0, np.radians(-40.0)]))[:2, :2]
    across, along = turn @ on_ground(px, photo.camera, photo.cam_from_ground).T
    bars = (np.mod(across / 0.12, 1) < 0.45) & (np.abs(np.mod(along / 1.3, 1) - 0.5) < 0.45)
    return np.where(bars.reshape(gray.shape), 0.6 * gray, gray).astype(np.uint8)


def test_joints_among_the_shadows_of_bars_are_found_on_further_grounds(monkeypatch: pytest.MonkeyPatch):
    scene = replace(
        STACK, spacing_m=(0.4, 0.4), joint_width_m=0.006, joint_tone=STACK.slab_tone - 40.0, seed=7
    )
    photo = render_paving(scene)
    sight = see(barred(photo))

    def off_deg(hypotheses: list[Hypothesis]) -> float:
        up = photo.cam_from_ground.R[:, 2]
        return min(float(np.degrees(np.arccos(min(1.0, R[:, 2] @ up)))) for _, R in hypotheses)

    _, first = hypothesised(sight.segments, sight.size, photo.camera)
    further = hypothesised_thoroughly(sight.segments, photo.camera, first)
    assert off_deg(first) > 3.0
    assert off_deg(further) < 0.5
    assert len(first) + len(further) <= THOROUGHLY
    assert all(angle_between_rotations(R, old) > np.radians(1.0) for _, R in further for _, old in first)
    # What is looked at before takes long, and shows nothing.
    monkeypatch.setattr("autoreg.search.find._Search.clearest", lambda _, best: (best, []))
    monkeypatch.setattr("autoreg.search.find._Search.strongest", lambda _: ((), []))
    found = find_paving(sight, photo.camera)
    assert isinstance(found, Paving)
    assert sides_in_heights(found) == pytest.approx([0.25, 0.25], rel=0.02)


def test_joints_without_any_edge_across_them_are_found_on_grounds_turned_about_them(
    half_photo: SyntheticPhoto, monkeypatch: pytest.MonkeyPatch
):
    sight = sight_of(half_photo)
    along = half_photo.cam_from_ground.R[:, 0]
    # The segments of the unbroken joints alone, as a grain would leave them.
    ends_px = sight.segments.ends_px[agreed(sight.segments, half_photo, along)]
    assert len(sight.segments) > len(ends_px) > 20
    grain = Segments(ends_px, np.full(len(ends_px), 0.2), np.zeros(len(ends_px), int))
    blind = with_detection(sight, NONE, grain)
    found = find_paving(blind, half_photo.camera)
    assert isinstance(found, Paving)
    assert found.grid.shift == 0.5
    monkeypatch.setattr("autoreg.search.find.hypothesised_along_grain", lambda *_, **__: [])
    with pytest.raises(Refusal):
        find_paving(blind, half_photo.camera)


@pytest.mark.parametrize("heading_deg", [20.0, 36.0, 60.0])
def test_boards_are_told_from_their_grain_by_the_strength_of_their_joints(heading_deg: float):
    pose = look_at_ground(pitch_deg=34.0, height_m=1.6, heading_deg=heading_deg)
    found = find_paving(see(photographed(boards(6.0), pose)), boarded.CAMERA)
    assert isinstance(found, Paving)
    assert found.grid.shift == pytest.approx(0.5, abs=0.01)
    assert sides_in_heights(found) == pytest.approx([boarded.WIDTH_M / 1.6, boarded.LENGTH_M / 1.6], rel=0.01)
    up = found.fit.cam_from_ground.R[:, 2]
    assert np.rad2deg(np.arccos(min(1.0, up @ pose.R[:, 2]))) < 0.3


def test_the_ends_of_boards_are_no_rows():
    pose = look_at_ground(pitch_deg=34.0, height_m=1.6, heading_deg=20.0)
    assert find_rows(see(photographed(boards(9.0, seed=9), pose)), boarded.CAMERA) is None


@pytest.mark.parametrize(("turned", "told"), [(0, None), (1, 3), (2, 2), (3, 1)])
def test_a_photo_taken_steeply_is_told_the_one_turn_that_makes_it_stand_upright(
    turned: int, told: int | None
):
    steep = look_at_ground(pitch_deg=55.0, height_m=1.5, heading_deg=20.0)
    photo = render_paving(replace(STACK, cam_from_ground=steep))
    sight = see(as_gray(np.ascontiguousarray(np.rot90(photo.pixels, -turned))))
    assert upright_by(sight, photo.camera.turned(turned)) == told


def test_a_lattice_that_is_hardly_better_than_chance_gives_way_to_a_clear_one():
    # A third of a slab from course to course suits 0.31 on few courses, and is met on a worse ground first.
    odd = next(axis for axis in robust.AXES if axis.name == "odd bond")
    photo = robust.take(odd, 0.31, 5, (1024, 768))
    found = find_paving(see(photo.gray), photo.told, photo.scene.spacing_m)
    assert isinstance(found, Paving)
    assert found.grid.shift == pytest.approx(0.31, abs=0.002)
    assert found.plain
