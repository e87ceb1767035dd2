"""The suite of real boards and floors, on boards that are drawn with exact truth."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from autoreg.calibration.board import Board
from autoreg.calibration.synthetic import BoardScene, random_pose, render_board, true_corners
from autoreg.camera import Camera
from autoreg.geometry import Rigid
from benchmarks.options import Options
from benchmarks.suites import boards
from benchmarks.suites.robust import angle_up_to_quarter_turns

CAMERA = Camera(640, 480, 560.0, 560.0, 322.0, 238.0, (-0.1, 0.02, 0.0, 0.0))
BOARD = Board(boards.COLUMNS, boards.ROWS, 1.0, False)


def views(count: int) -> list[BoardScene]:
    rng = np.random.default_rng(5)
    poses = [random_pose(CAMERA, BOARD, rng, fill=(0.5, 0.8)) for _ in range(count)]
    return [BoardScene(CAMERA, BOARD, pose, seed=k) for k, pose in enumerate(poses)]


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("boards")
    (folder / "drawn").mkdir()
    for k, scene in enumerate(views(8)):
        cv2.imwrite(str(folder / "drawn" / f"{k}.jpg"), render_board(scene), [cv2.IMWRITE_JPEG_QUALITY, 95])
    return folder


def test_corners_are_found_where_they_are():
    scene = views(1)[0]
    corners = boards.corners_of(render_board(scene))
    assert corners is not None
    true = true_corners(scene)
    assert min(np.abs(corners - t).max() for t in (true, true[::-1])) < 0.15


def test_a_sets_camera_and_poses_come_from_its_corners(drawn: Path):
    found = boards.board_views(drawn)
    assert [view.name for view in found] == [f"{k}.jpg" for k in range(8)]
    for view, scene in zip(found, views(8), strict=True):
        assert view.camera.fx == pytest.approx(CAMERA.fx, rel=0.01)
        pose = scene.cam_from_board
        true = boards.towards_camera(pose.R, pose.t)
        # A board says not which of its corners is the first.
        assert angle_up_to_quarter_turns(view.true, true) < 0.3


def test_too_few_boards_make_no_set(tmp_path: Path, drawn: Path):
    (tmp_path / "few").mkdir()
    for k in range(boards.FEWEST - 1):
        (tmp_path / "few" / f"{k}.jpg").write_bytes((drawn / "drawn" / f"{k}.jpg").read_bytes())
    (tmp_path / "none").mkdir()
    assert boards.board_views(tmp_path) == []


def test_a_frame_that_lies_upside_down_is_turned_over():
    below = Rigid(np.eye(3), np.array([0.1, 0.2, 1.5]))
    over = boards.towards_camera(below.R, below.t)
    assert over.origin_in_a[2] == pytest.approx(1.5)
    assert np.linalg.det(over.R) == pytest.approx(1.0)
    assert pytest.approx(over.R) == boards.towards_camera(over.R, over.t).R


@pytest.mark.parametrize(
    ("turn_deg", "height_off", "contradicted", "right", "wrong"),
    [
        (0.2, 0.01, False, True, False),
        (0.5, 0.01, False, False, False),
        (1.5, 0.01, False, False, True),
        (0.2, 0.25, False, False, True),
        (1.5, 0.25, True, False, False),
        (float("nan"), float("nan"), False, False, False),
    ],
)
def test_a_pose_is_right_by_its_rotation_and_its_height(
    turn_deg: float, height_off: float, contradicted: bool, right: bool, wrong: bool
):
    pose = Rigid(np.eye(3), np.array([0.0, 0.0, -1.0]))
    view = boards.View("set", "0.jpg", np.zeros((4, 4), np.uint8), CAMERA, (1.0, 1.0), pose)
    outcome = boards.Outcome(view, turn_deg, height_off, contradicted=contradicted)
    assert (outcome.right, outcome.wrong) == (right, wrong)


@pytest.mark.slow
def test_the_suite_judges_what_align_makes_of_them(drawn: Path, tmp_path: Path):
    found = boards.run(Options(tmp_path, quick=True, chessboards=drawn, groundgrid=tmp_path))
    figures = {figure.key: figure.value for figure in found.figures}
    assert figures["boards.wrong"] == figures["boards.alarms"] == 0
    assert figures["boards.right"] == pytest.approx(100.0)
    assert figures["boards.turn"] < 0.1
    assert figures["boards.height"] < 0.5


def test_a_floor_is_read_from_its_publishers_file_and_judged_by_its_normal(tmp_path: Path):
    R = np.diag([1.0, -1.0, -1.0])
    view = {
        "image": "floor.png", "size": [64, 48], "K": [[50.0, 0, 31], [0, 50.0, 23], [0, 0, 1]],
        "dist": [0, 0, 0, 0, 0], "R": R.tolist(), "t_cm": [0, 0, 150.0],
    }  # fmt: skip
    cv2.imwrite(str(tmp_path / "floor.png"), np.full((48, 64), 128, np.uint8))
    (tmp_path / "gt.json").write_text(json.dumps({"views": {"front": view}}))
    (floor,) = boards.floor_views(tmp_path)
    assert floor.true.origin_in_a == pytest.approx([0.0, 0.0, 1.5])
    assert not floor.turn_known
    # Nothing is to be seen in it.
    assert boards.examine(floor).reason != ""


def test_without_any_the_suite_is_skipped_with_a_word(tmp_path: Path):
    options = Options(tmp_path, chessboards=tmp_path / "none", groundgrid=tmp_path / "none")
    assert "--chessboards" in (boards.run(options).skipped or "")
