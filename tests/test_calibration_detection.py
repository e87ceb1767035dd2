import cv2
import numpy as np
import pytest
from boards import BOARD, SMALL, poses
from PIL import Image

from autoreg.calibration.board import Board, parse_pattern
from autoreg.calibration.detection import find_board
from autoreg.calibration.photos import find_pattern, photo_files, search_photos
from autoreg.calibration.synthetic import BoardScene, bent_points, random_pose, render_board, true_corners
from autoreg.camera import Camera
from autoreg.errors import InputError
from autoreg.geometry import Rigid


def facing(camera, board=BOARD, distance=0.4):
    middle = board.points.mean(0)
    return Rigid(np.eye(3), np.array([0.0, 0.0, distance]) - middle)


@pytest.mark.parametrize("k", range(4))
def test_corners_are_found_to_a_twentieth_of_a_pixel_in_the_boards_own_order(k):
    scene = BoardScene(SMALL, BOARD, poses(SMALL, 4, seed=5)[k], seed=k)
    found = find_board(render_board(scene), BOARD)
    assert found.reason is None
    # 9x6 corners tell the board's two ends apart by colour, so the order itself must be right.
    error = np.linalg.norm(found.corners_px - true_corners(scene), axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.12
    assert np.abs((found.corners_px - true_corners(scene)).mean(0)).max() < 0.05


def test_more_noise_scatters_the_corners_more_but_moves_them_nowhere():
    scatter = []
    clean = render_board(BoardScene(SMALL, BOARD, facing(SMALL), noise_grey=0.0))
    truth = true_corners(BoardScene(SMALL, BOARD, facing(SMALL)))
    for noise in (2.0, 8.0):
        errors = []
        for seed in range(6):
            grain = noise * np.random.default_rng(seed).standard_normal(clean.shape)
            picture = np.clip(np.round(clean + grain), 0, 255).astype(np.uint8)
            errors.append(find_board(picture, BOARD).corners_px - truth)
        scatter.append(np.mean(np.std(errors, axis=0)))
        assert np.abs(np.mean(errors, axis=(0, 1))).max() < 0.03
    assert scatter[1] / scatter[0] == pytest.approx(4.0, rel=0.3)


def test_a_photo_of_12_megapixels_gives_corners_at_full_resolution():
    camera = SMALL.scaled(4000, 3000)
    scene = BoardScene(camera, BOARD, facing(camera, distance=0.5), blur_px=2.0, samples=1, noise_grey=3.0)
    found = find_board(render_board(scene), BOARD)
    error = np.linalg.norm(found.corners_px - true_corners(scene), axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.1


def test_a_turned_photo_keeps_the_boards_order():
    scene = BoardScene(SMALL, BOARD, facing(SMALL))
    picture, truth = render_board(scene), true_corners(scene)
    turned = np.ascontiguousarray(np.rot90(picture, -1))
    found = find_board(turned, BOARD)
    expected = np.column_stack([SMALL.height - 1 - truth[:, 1], truth[:, 0]])
    assert np.abs(found.corners_px - expected).max() < 0.5


def test_a_photo_without_a_board_says_so():
    noise = np.random.default_rng(0).integers(0, 255, (480, 640), dtype=np.uint8)
    found = find_board(cv2.GaussianBlur(noise, (0, 0), 2), BOARD)
    assert not found.found
    assert "9x6" in found.reason


def test_the_search_that_never_ends_in_speckles_is_left_out_and_boards_in_them_are_found(monkeypatch):
    searched = []
    quick = cv2.findChessboardCorners
    monkeypatch.setattr(
        cv2, "findChessboardCorners", lambda *given, **flags: searched.append(1) or quick(*given, **flags)
    )
    scene = BoardScene(SMALL, BOARD, poses(SMALL, 4, seed=5)[0])
    board = render_board(scene)
    dithered = 255 * np.array(Image.fromarray(board).convert("1"), np.uint8)
    found = find_board(dithered, BOARD)
    # Found at its place, if not to sub-pixel.
    assert np.abs(found.corners_px - true_corners(scene)).max() < 4
    slope = np.tile(np.linspace(40, 220, 1200).astype(np.uint8), (800, 1))
    grain = np.random.default_rng(0).integers(0, 256, (800, 1200)).astype(np.uint8)
    for speckled in (255 * np.array(Image.fromarray(slope).convert("1"), np.uint8), grain):
        assert not find_board(speckled, BOARD).found
    assert not searched
    assert find_board(board, BOARD).found
    assert searched


def test_a_larger_board_is_seen_to_go_on_and_the_right_one_is_not():
    picture = render_board(BoardScene(SMALL, BOARD, facing(SMALL)))
    assert find_board(picture, BOARD).goes_on == (False, False, False, False)
    part = find_board(picture, Board(7, 5))
    if part.found:
        assert any(part.goes_on)


def test_the_pattern_is_counted():
    scenes = [BoardScene(SMALL, BOARD, pose, seed=k) for k, pose in enumerate(poses(SMALL, 4, seed=2))]
    assert find_pattern([render_board(scene) for scene in scenes]) == (9, 6)
    assert find_pattern([np.zeros((200, 300), np.uint8)]) is None


def test_charuco_corners_are_found_though_half_the_board_is_hidden():
    board = Board(7, 5, 0.03, True, "charuco")
    scene = BoardScene(SMALL, board, facing(SMALL, board, 0.4), blur_px=0.6, samples=3)
    picture, truth = render_board(scene), true_corners(scene)
    whole = find_board(picture, board)
    assert len(whole.ids) == board.corners
    assert np.linalg.norm(whole.corners_px - truth[whole.ids], axis=1).max() < 0.3
    picture[:, : int(truth[:, 0].mean())] = 128
    half = find_board(picture, board)
    assert 8 <= len(half.ids) < board.corners
    assert np.linalg.norm(half.corners_px - truth[half.ids], axis=1).max() < 0.3


def test_a_charuco_board_that_is_not_there_is_missed_by_name():
    found = find_board(np.full((300, 400), 128, np.uint8), Board(7, 5, kind="charuco"))
    assert "ChArUco" in found.reason


def test_a_charuco_board_in_a_mirror_or_of_another_size_is_named():
    board = Board(7, 5, 0.03, True, "charuco")
    picture = render_board(BoardScene(SMALL, board, facing(SMALL, board, 0.4), blur_px=0.6, samples=3))
    assert "mirrored" in find_board(np.ascontiguousarray(picture[:, ::-1]), board).reason
    assert "check --pattern" in find_board(picture, Board(8, 5, 0.03, True, "charuco")).reason


def test_blotches_are_no_pattern():
    blots = [
        np.clip(cv2.GaussianBlur(rng.normal(128, 200, (960, 1280)), (0, 0), 6), 0, 255).astype(np.uint8)
        for rng in map(np.random.default_rng, range(3))
    ]
    assert find_pattern(blots) is None


def test_a_bent_sheet_is_drawn_where_its_corners_are():
    bend = (0.08, 0.0, 0.03)
    pose = poses(SMALL, 1, seed=3)[0]
    scene = BoardScene(SMALL, BOARD, pose, bend=bend)
    found = find_board(render_board(scene), BOARD)
    assert np.linalg.norm(found.corners_px - true_corners(scene), axis=1).max() < 0.5
    flat = SMALL.project(pose.apply(BOARD.points))
    assert np.linalg.norm(flat - true_corners(scene), axis=1).max() > 1.0
    assert np.ptp(bent_points(BOARD, bend)[:, 2]) > 0.005


def test_files_folders_and_patterns_are_listed_once_in_natural_order(tmp_path):
    for name in ("b10.jpg", "b2.jpg", "notes.txt"):
        (tmp_path / name).write_bytes(b"x")
    names = [path.name for path in photo_files([tmp_path, tmp_path / "b2.jpg", f"{tmp_path}/*.jpg"])]
    assert names == ["b2.jpg", "b10.jpg"]
    with pytest.raises(InputError, match="no photo matches"):
        photo_files([f"{tmp_path}/*.png"])


def test_a_corrupt_file_is_named_and_stops_nothing(tmp_path):
    good, bad = tmp_path / "good.png", tmp_path / "bad.jpg"
    cv2.imwrite(str(good), render_board(BoardScene(SMALL, BOARD, facing(SMALL))))
    bad.write_bytes(b"\xff\xd8\xff\xe0 no picture")
    told = []
    found = search_photos([good, bad], BOARD, lambda done, total: told.append((done, total)))
    assert [photo.detection.found for photo in found] == [True, False]
    assert "bad.jpg" in found[1].detection.reason
    assert told == [(1, 2), (2, 2)]


@pytest.mark.parametrize("text", ["9", "9x", "nine by six", "9x6x2", "2x2", "90x60"])
def test_a_pattern_that_is_none_is_refused(text):
    with pytest.raises(InputError):
        parse_pattern(text)


def test_a_pattern_is_read():
    assert parse_pattern("9x6") == (9, 6)
    assert parse_pattern("AUTO") is None
    assert parse_pattern((9, 6)) == (9, 6)
    with pytest.raises(InputError, match="2x6 is out of range"):
        parse_pattern((2, 6))


def test_a_board_that_fits_no_picture_has_no_pose():
    with pytest.raises(ValueError, match="no pose"):
        random_pose(Camera(8, 8, 5.0, 5.0, 3.5, 3.5), BOARD, np.random.default_rng(0))
