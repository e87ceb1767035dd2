import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from boards import BOARD, SMALL, poses
from typer.testing import CliRunner

from autoreg.calibration.board import Board
from autoreg.calibration.printing import black_rectangles, print_board, sheet_for
from autoreg.calibration.synthetic import BoardScene, render_board
from autoreg.camera_files import read_camera
from autoreg.command.cli import app
from autoreg.errors import InputError

FIXTURES = Path(__file__).parents[1] / "fixtures"
POINTS_PER_MM = 72 / 25.4


def run(*arguments):
    done = CliRunner().invoke(app, [str(a) for a in arguments])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("boards")
    for k, pose in enumerate(poses(SMALL, 6, seed=1)):
        cv2.imwrite(str(folder / f"{k}.png"), render_board(BoardScene(SMALL, BOARD, pose, seed=k)))
    return folder


def test_calibrate_writes_three_camera_files_and_a_report(photos, tmp_path):
    camera = tmp_path / "new" / "camera.json"
    done = run("calibrate", f"{photos}/*.png", "--pattern", "9x6", "--square", "0.025", "-o", camera,
               "--report", tmp_path / "report")  # fmt: skip
    assert done.exit_code == 0, done.stderr
    names = {path.name for path in camera.parent.iterdir()}
    assert names == {"camera.json", "camera.opencv.yaml", "camera.ros.yaml"}
    assert (tmp_path / "report" / "calibration.html").is_file()
    assert read_camera(camera).width == 640
    assert "verdict:" in done.stderr
    assert "OpenCV's RMS" in done.stderr
    assert "|residuals|/N" in done.stderr
    assert done.stdout == ""


def test_calibrate_does_not_write_over_a_photo_that_a_slip_gave_to_o(photos, tmp_path):
    first = tmp_path / "0.png"
    first.write_bytes((photos / "0.png").read_bytes())
    done = run("calibrate", "-o", first, *(photos / f"{k}.png" for k in range(1, 6)))
    assert done.exit_code == 2
    assert "no camera file" in done.stderr
    assert first.read_bytes() == (photos / "0.png").read_bytes()


def test_calibrate_json_prints_the_camera_file_and_nothing_else(photos, tmp_path):
    done = run("calibrate", photos, "--pattern", "9x6", "-o", tmp_path / "c.json", "--json")
    assert done.stdout == (tmp_path / "c.json").read_text()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nowhere/*.jpg"], "no photo matches"),
        (["--pattern", "9", "."], "pattern"),
        (["--square", "-1", "--pattern", "9x6", "."], "positive"),
        (["--charuco", "."], "auto cannot count"),
        (["--charuco", "--pattern", "9x6", "--dictionary", "nope", "."], "dictionary"),
    ],
)
def test_bad_usage_exits_2_and_writes_nothing(arguments, said, photos, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = [str(photos) if argument == "." else argument for argument in arguments]
    done = run("calibrate", *arguments)
    assert done.exit_code == 2
    assert said in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_views_that_determine_nothing_exit_3_without_a_camera(tmp_path):
    from boards import views

    facing = views(SMALL, 5, most_tilt_deg=0.1)
    for k, _ in enumerate(facing):
        pose = poses(SMALL, 5, most_tilt_deg=0.1)[k]
        cv2.imwrite(str(tmp_path / f"{k}.png"), render_board(BoardScene(SMALL, BOARD, pose, seed=k)))
    done = run("calibrate", tmp_path, "--pattern", "9x6", "-o", tmp_path / "camera.json")
    assert done.exit_code == 3
    assert not (tmp_path / "camera.json").exists()


def test_inspect_names_the_published_contradictions():
    done = run("inspect", FIXTURES / "thesis.claims.json")
    assert done.exit_code == 0
    assert done.stdout.count("wrong:") >= 4
    content = json.loads(run("inspect", FIXTURES / "thesis.claims.json", "--json").stdout)
    assert content["contradictory"] is True
    assert content["focal"]["px"] == 2875.9


def test_inspect_refuses_what_is_no_camera(tmp_path):
    assert run("inspect", tmp_path / "none.json").exit_code == 2


@pytest.mark.parametrize("kind", ["pdf", "svg"])
def test_a_printed_board_has_its_true_size(kind, tmp_path):
    path = tmp_path / f"board.{kind}"
    assert run("board", "--pattern", "9x6", "--square", "0.025", "-o", path).exit_code == 0
    content = path.read_bytes()
    # A4 on its side.
    if kind == "pdf":
        box = content.split(b"/MediaBox [")[1].split(b"]")[0].split()
        assert [float(value) / POINTS_PER_MM for value in box[2:]] == pytest.approx([297.0, 210.0], abs=0.01)
    else:
        width = float(content.split(b'width="')[1].split(b'pt"')[0])
        assert width / POINTS_PER_MM == pytest.approx(297.0, abs=0.01)


def test_the_svgs_squares_are_as_large_as_asked():
    text = print_board(Board(4, 3, 0.02, True), "svg").decode()
    squares = re.findall(r"M ([-\d.]+) ([-\d.]+)\s+L ([-\d.]+) ([-\d.]+)", text.split("PatchCollection")[1])
    sides = [float(np.hypot(float(c) - float(a), float(d) - float(b))) for a, b, c, d in squares[:10]]
    assert sides == pytest.approx([20 * POINTS_PER_MM] * 10, abs=0.01)


def test_a_charuco_board_as_printed_is_found():
    board = Board(7, 5, 0.03, True, "charuco")
    px = 60
    picture = np.full(((board.rows + 3) * px, (board.columns + 3) * px), 255, np.uint8)
    for x, y, w, h in black_rectangles(board):
        rows = slice(round((y + 1) * px), round((y + 1 + h) * px))
        picture[rows, round((x + 1) * px) : round((x + 1 + w) * px)] = 0
    from autoreg.calibration.detection import find_board

    found = find_board(picture, board)
    assert len(found.ids) == board.corners
    expected = (board.points[found.ids, :2] / board.square + 2) * px - 0.5
    assert np.abs(found.corners_px - expected).max() < 0.1


def test_a_board_too_large_for_any_paper_is_refused_and_a_large_one_gets_its_own():
    with pytest.raises(InputError, match="in metres"):
        sheet_for(Board(9, 6, 25.0))
    assert sheet_for(Board(9, 6, 0.2)).paper == "custom"


def test_board_writes_pdf_or_svg_only(tmp_path):
    done = run("board", "-o", tmp_path / "board.png")
    assert done.exit_code == 2
    assert "pdf or .svg" in done.stderr
    assert run("board", "--pattern", "auto").exit_code == 2
