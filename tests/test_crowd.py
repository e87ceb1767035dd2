from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from paved import CAMERA, CHECKER, gray_of

from autoreg.align import align
from autoreg.ground.crowd import crowded_window
from autoreg.ground.points import on_ground
from autoreg.ground.rectify import Window
from autoreg.ground.sides import ALONG_X
from autoreg.ground.sight import see
from autoreg.paving import lattice_choice
from autoreg.paving.lattice_choice import settle_bond
from autoreg.paving.lattice_evidence import Paving
from autoreg.paving.multiples import divided
from autoreg.search.find import find_paving
from autoreg.search.glance import other_camera
from autoreg.segments import Segments
from autoreg.synthetic import render_paving
from benchmarks.suites.robust import angle_up_to_quarter_turns, square_seen

POSE = CHECKER.cam_from_ground
HEIGHT = float(POSE.origin_in_a[2])
# Squares of 10 cm, and the part of the picture that they fill.
TILES = replace(CHECKER, spacing_m=(0.1, 0.1))
SHARE = 0.06


def segments_of(ends_px: list[np.ndarray]) -> Segments:
    ends = np.array(ends_px).reshape(-1, 2, 2)
    order = np.argsort(-np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1))
    return Segments(ends[order], np.full(len(ends), 0.3), np.zeros(len(ends), int))


def seen(ground_m: list[list[float]]) -> np.ndarray:
    points = np.column_stack([ground_m, np.zeros(len(ground_m))])
    return CAMERA.project(POSE.apply(points))


def board(low: np.ndarray, side: float, count: int) -> list[np.ndarray]:
    """The joints of a square of so many slabs."""
    steps = side * np.arange(count + 1)
    end = side * count
    along_x = [seen([[low[0], low[1] + s], [low[0] + end, low[1] + s]]) for s in steps]
    along_y = [seen([[low[0] + s, low[1]], [low[0] + s, low[1] + end]]) for s in steps]
    return [*along_x, *along_y]


def strays(count: int, seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    start = rng.uniform([0, 0], [CAMERA.width, CAMERA.height], (count, 2))
    way = rng.uniform(0, np.pi, count)
    step = 40.0 * np.stack([np.cos(way), np.sin(way)], 1)
    return list(np.stack([start, start + step], 1))


def box_m(window: Window) -> np.ndarray:
    """The box in metres from the ground frame's origin; windows are in heights from the camera's foot."""
    return np.array([window.low, window.high]) * HEIGHT + POSE.origin_in_a[:2]


def test_the_box_is_that_of_the_board_whatever_else_lies_about():
    middle = on_ground(np.array([380.0, 300.0]), CAMERA, POSE)
    low, size = middle - 0.3, 0.6
    for seed in range(4):
        found = crowded_window(segments_of(board(low, 0.1, 6) + strays(120, seed)), CAMERA, POSE.R)
        assert found is not None
        assert box_m(found) == pytest.approx(np.array([low, low + size]), abs=0.12)


def test_of_two_boards_the_one_with_more_joints_is_taken():
    small, large = (on_ground(np.array(px), CAMERA, POSE) for px in ([150.0, 380.0], [430.0, 240.0]))
    found = crowded_window(segments_of(board(small, 0.08, 3) + board(large, 0.1, 7)), CAMERA, POSE.R)
    assert found is not None
    assert box_m(found) == pytest.approx(np.array([large, large + 0.7]), abs=0.1)


def test_no_crowd_without_joints_of_both_directions():
    middle = on_ground(np.array([320.0, 300.0]), CAMERA, POSE)
    one_way = board(middle, 0.1, 6)[:7]
    assert crowded_window(segments_of([]), CAMERA, POSE.R) is None
    assert crowded_window(segments_of(one_way), CAMERA, POSE.R) is None


def small_board(share: float = SHARE) -> np.ndarray:
    """A checker board of tiles on a smooth floor, in a part of the picture."""
    rng = np.random.default_rng(3)
    tiles = gray_of(render_paving(TILES))
    middle = 0.1 * np.round(on_ground(np.array([420.0, 260.0]), CAMERA, POSE) / 0.1)
    floor = 140.0 + 2.0 * rng.standard_normal(tiles.shape)
    return np.clip(np.where(square_seen(CAMERA, POSE, middle, share), tiles, floor), 0, 255).astype(np.uint8)


def test_a_board_that_fills_a_small_part_of_the_picture_is_found_by_its_crowd():
    gray = small_board()
    found = align(gray, CAMERA, slab=TILES.spacing_m).pose.cam_from_ground
    assert angle_up_to_quarter_turns(found, POSE) < 0.1
    assert found.origin_in_a[2] == pytest.approx(HEIGHT, rel=2e-3)


def test_the_right_camera_is_not_blamed_for_a_small_field_that_hardly_tells_the_focal_length(
    monkeypatch: pytest.MonkeyPatch,
):
    # With LSD's segments alone the focal length is told badly.
    monkeypatch.setattr("autoreg.segments.FEW", 0)
    sight = see(small_board())
    found = find_paving(sight, CAMERA)
    assert isinstance(found, Paving)
    # The joints' own camera is another one, but explains them no better.
    assert other_camera(sight, CAMERA) is not None
    assert other_camera(sight, CAMERA, found) is None


@pytest.mark.slow
def test_a_small_field_stays_as_it_is_where_a_finer_lattice_that_was_tried_is_less_clear(
    monkeypatch: pytest.MonkeyPatch,
):
    sight = see(small_board(0.03))
    found = find_paving(sight, CAMERA)
    assert isinstance(found, Paving)
    assert found.closer is not None
    monkeypatch.setattr(lattice_choice, "_subdivided", lambda _, fit: divided(fit, ALONG_X, 2))
    again = settle_bond(sight.looks.picture, found.fit)
    assert again is not None
    assert again.grid == found.grid
