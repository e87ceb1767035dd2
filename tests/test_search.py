from __future__ import annotations

from concurrent.futures import Future

import numpy as np
import pytest

from autoreg.ground.sight import Sight, see
from autoreg.paving.lattice_evidence import Paving
from autoreg.search.find import find_paving
from autoreg.segments import Detection, Segments
from autoreg.synthetic import SyntheticPhoto
from benchmarks.suites import robust

NONE = Segments(np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0, int))


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
    monkeypatch.setattr("autoreg.search.find.lay_lattice", lambda *_: ())
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
