import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from boards import BOARD, CAMERA, SMALL, exact, poses, views
from PIL import Image

import autoreg
from autoreg.calibration.board import Board, BoardView
from autoreg.calibration.detection import Detection, nothing
from autoreg.calibration.grouping import one_camera
from autoreg.calibration.html_report import REPORT_NAME, write_report
from autoreg.calibration.photos import BoardPhoto
from autoreg.calibration.pipeline import calibrate, calibrate_views
from autoreg.calibration.plots import plots_of
from autoreg.calibration.record import camera_record, opencv_yaml, ros_yaml, write_camera_files
from autoreg.calibration.synthetic import BoardScene, bent_points, render_board
from autoreg.camera_files import distrust, read_camera, read_camera_record
from autoreg.errors import InputError, Refusal
from autoreg.formats.exif import Exif

W, H = CAMERA.width, CAMERA.height
SHARED = Path(__file__).parents[2] / "shared" / "chessboards"


@pytest.fixture(scope="module")
def made():
    return calibrate_views(views(CAMERA, 16), BOARD, W, H)


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    """Eight photos of 640 x 480 in a folder."""
    folder = tmp_path_factory.mktemp("boards")
    for k, pose in enumerate(poses(SMALL, 8, seed=1)):
        picture = render_board(BoardScene(SMALL, BOARD, pose, seed=k))
        cv2.imwrite(str(folder / f"{k}.png"), picture)
    return folder


def photo(size=(640, 480), *, turned=0, model=None, focal_mm=None, corners=None, name="p.jpg"):
    exif = Exif(turned=turned, model=model, focal_mm=focal_mm)
    px = np.zeros((54, 2)) if corners is None else corners
    return BoardPhoto(name, size, exif, Detection(np.arange(54), px))


def test_photos_in_a_folder_become_a_camera(photos):
    found = calibrate(photos, "9x6", square=0.025)
    error = np.abs(found.fit.state.intrinsics[:4] - [SMALL.fx, SMALL.fy, SMALL.cx, SMALL.cy])
    assert (error < 4 * found.precision.std_devs[:4]).all()
    assert found.rms_px < 0.15
    assert found.verdict.grade in ("good", "usable")


def test_arrays_are_photos_too_and_the_pattern_is_counted(photos):
    pictures = [cv2.imread(str(file), cv2.IMREAD_GRAYSCALE) for file in sorted(photos.iterdir())]
    found = autoreg.calibrate(pictures)
    assert sorted((found.board.columns, found.board.rows)) == [6, 9]
    assert found.data.names[0] == "photo 1"


def test_a_photo_without_a_board_is_named_and_stops_nothing(photos, tmp_path):
    cv2.imwrite(str(tmp_path / "empty.png"), np.full((480, 640), 120, np.uint8))
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8\xff\xe0")
    found = calibrate([photos, tmp_path], "9x6")
    assert {out.name for out in found.left_out} == {"empty.png", "broken.jpg"}
    assert len(found.data) == 8


def test_a_smaller_pattern_than_the_boards_is_refused_with_the_hint(photos):
    with pytest.raises(InputError, match=r"larger than the pattern|9x6"):
        calibrate(photos, "7x5")


def test_a_larger_pattern_than_the_boards_names_the_right_one(photos):
    with pytest.raises(InputError, match="9x6"):
        calibrate(photos, "11x8")


def test_one_photo_and_no_photo_are_refused(photos, tmp_path):
    with pytest.raises(InputError, match="at least 3"):
        calibrate(photos / "0.png", "9x6")
    with pytest.raises(InputError, match="no pictures"):
        calibrate(tmp_path, "9x6")
    with pytest.raises(InputError, match="no photos"):
        calibrate([], "9x6")
    with pytest.raises(InputError, match="at least 3"):
        calibrate_views(views(CAMERA, 2), BOARD, W, H)


@pytest.mark.slow
@pytest.mark.parametrize("noise_px", [0.0, 0.1, 0.5])
def test_views_parallel_to_the_sensor_give_no_number(noise_px):
    seen = views(CAMERA, 10, noise_px=noise_px, most_tilt_deg=0.2)
    with pytest.raises(Refusal, match=r"parallel|only to|ran away|not at all"):
        calibrate_views(seen, BOARD, W, H)


def test_the_same_view_again_and_again_gives_no_number():
    one = views(CAMERA, 1, noise_px=0.0)[0]
    seen = [
        BoardView(str(k), one.ids, one.corners_px + 0.1 * np.sin(k + np.arange(108)).reshape(54, 2))
        for k in range(6)
    ]
    with pytest.raises(Refusal, match="the board in one place"):
        calibrate_views(seen, BOARD, W, H)


def test_the_frames_of_a_video_count_by_the_places_that_they_show():
    rng = np.random.default_rng(0)
    ids = np.arange(54)
    frames = [
        BoardView(f"{k}-{frame}", ids, exact(CAMERA, pose) + rng.normal(0, 0.1, (54, 2)))
        for k, pose in enumerate(poses(CAMERA, 4))
        for frame in range(5)
    ]
    found = calibrate_views(frames, BOARD, W, H)
    assert found.data.standpoints == 4
    assert any("20 views show the board in only 4 different places" in r for r in found.verdict.reasons)


def test_a_good_set_is_good_and_a_poor_one_says_why():
    good = calibrate_views(views(CAMERA, 30, fill=(0.5, 0.8)), BOARD, W, H)
    assert good.verdict.grade == "good", good.verdict.reasons
    middle = [
        view
        for view in views(CAMERA, 80, seed=3, fill=(0.2, 0.3))
        if np.abs(view.corners_px.mean(0) - [W / 2, H / 2]).max() < 160
    ]
    poor = calibrate_views(middle[:7], BOARD, W, H)
    assert poor.verdict.grade != "good"
    assert any("covered only" in reason for reason in poor.verdict.reasons)
    assert poor.verdict.advice


@pytest.mark.slow
def test_a_bent_sheet_is_a_reason_and_its_shape_can_be_estimated():
    places = bent_points(BOARD, (0.03, 0.01, -0.02))
    rng = np.random.default_rng(0)
    seen = [
        BoardView(str(k), np.arange(54), CAMERA.project(pose.apply(places)) + rng.normal(0, 0.1, (54, 2)))
        for k, pose in enumerate(poses(CAMERA, 14))
    ]
    flat = calibrate_views(seen, BOARD, W, H)
    assert flat.verdict.grade != "good"
    assert any("sheet is bent" in reason for reason in flat.verdict.reasons)
    bent = calibrate_views(seen, BOARD, W, H, sheet="bent")
    assert bent.sheet == "bent"
    assert abs(bent.camera.fx - CAMERA.fx) < abs(flat.camera.fx - CAMERA.fx)
    assert abs(bent.camera.fx - CAMERA.fx) < 4 * bent.precision.std_devs[0]


def other_cameras_views(count, focal=1100.0):
    other = type(CAMERA)(W, H, focal, focal, 620.0, 490.0)
    return [BoardView(f"other{view.name}", view.ids, view.corners_px) for view in views(other, count, seed=3)]


def test_half_the_views_of_another_camera_are_refused_with_both_groups():
    seen = [*views(CAMERA, 8), *other_cameras_views(8)]
    with pytest.raises(
        InputError, match=r"(?s)two cameras.*8 with .* 1[01]00 px.*8 with .* 1[01]00 px"
    ) as told:
        calibrate_views(seen, BOARD, W, H)
    for line in str(told.value).splitlines()[1:]:
        assert ("1100 px" in line) == ("otherview" in line)
        assert line.count("view") == 4


def test_a_few_views_of_another_camera_are_left_out_and_named():
    seen = [*views(CAMERA, 15), *other_cameras_views(5)]
    found = calibrate_views(seen, BOARD, W, H)
    assert {out.name for out in found.left_out} == {view.name for view in seen[15:]}
    assert all("another camera" in out.reason for out in found.left_out)
    assert abs(found.camera.fx - CAMERA.fx) < 4 * found.precision.std_devs[0]


def test_turned_photos_are_brought_into_the_sensors_frame():
    truth = exact(SMALL, poses(SMALL, 1)[0])
    upright = [
        photo(corners=truth),
        photo(turned=1, corners=np.column_stack([479 - truth[:, 1], truth[:, 0]])),
        photo(turned=2, corners=[639, 479] - truth),
        photo(turned=3, corners=np.column_stack([truth[:, 1], 639 - truth[:, 0]])),
    ]
    group, left_out = one_camera(upright)
    assert left_out == ()
    assert (group.width, group.height) == (640, 480)
    for view in group.views:
        np.testing.assert_allclose(view.corners_px, truth, atol=1e-9)
    assert "turned back" in group.notes[0]


def test_a_few_photos_on_their_side_without_exif_are_left_out_and_half_of_them_refused():
    landscape = [photo(name=f"l{k}") for k in range(9)]
    portrait = photo((480, 640), name="side.jpg")
    group, left_out = one_camera([*landscape, portrait])
    assert len(group.views) == 9
    assert left_out[0][0] == "side.jpg"
    assert "on its side" in left_out[0][1]
    with pytest.raises(InputError, match=r"9 of 640 x 480.*\n.*8 of 480 x 640"):
        one_camera([*landscape, *[portrait] * 8])


@pytest.mark.parametrize(
    ("other", "together"),
    [
        (photo((641, 481)), True),
        (photo((1280, 960)), False),
        (photo((1280, 960), model="A", focal_mm=4.0), True),
        (photo(model="B"), False),
        (photo(model="A", focal_mm=8.0), False),
        (photo(), True),
    ],
)
def test_what_may_be_one_camera(other, together):
    base = [photo(model="A", focal_mm=4.0)] * 9
    group, left_out = one_camera([*base, other])
    assert (len(left_out) == 0) == together
    assert len(group.views) == 9 + together


def test_a_photo_without_corners_is_in_no_group():
    empty = BoardPhoto("e.jpg", (100, 100), Exif(), nothing("no board"))
    group, left_out = one_camera([photo(), empty])
    assert len(group.views) == 1
    assert left_out == ()


def test_exif_turns_a_portrait_photo_back(photos, tmp_path):
    """A phone held upright stores the sensor's rows and says by EXIF how to turn them."""
    for k, file in enumerate(sorted(photos.iterdir())):
        stored = Image.open(file)
        exif = Image.Exif()
        exif[0x0112] = 6 if k % 2 else 1
        stored.save(tmp_path / f"{k}.jpg", quality=97, exif=exif)
    found = calibrate(tmp_path, "9x6")
    assert (found.camera.width, found.camera.height) == (640, 480)
    assert len(found.data) == 8
    assert abs(found.camera.cx - SMALL.cx) < 5
    assert any("turned back" in note for note in found.notes)


def test_the_three_files_are_read_back_exactly(made, tmp_path):
    own, opencv, ros = write_camera_files(made, tmp_path / "camera.json", "1.0")
    for file in (own, opencv, ros):
        assert read_camera(file) == made.camera
    storage = cv2.FileStorage(str(opencv), cv2.FILE_STORAGE_READ)
    np.testing.assert_array_equal(storage.getNode("camera_matrix").mat(), made.camera.K)
    dist = storage.getNode("distortion_coefficients").mat().ravel()
    np.testing.assert_array_equal(dist, made.camera.dist[:5])
    content = yaml.safe_load(ros.read_text())
    assert content["distortion_model"] == "plumb_bob"
    assert content["projection_matrix"]["cols"] == 4


def test_the_record_says_how_well_and_how_it_was_made(made):
    record = json.loads(json.dumps(camera_record(made, "1.0")))
    assert record["std_devs"]["fx"] == made.precision.std_devs[0]
    names, matrix = record["covariance"]["names"], np.array(record["covariance"]["matrix"])
    assert names[:4] == ["fx", "fy", "cx", "cy"]
    np.testing.assert_allclose(np.sqrt(matrix.diagonal())[0], record["std_devs"]["fx"])
    assert len(record["valid_region"]["polygon_px"]) >= 3
    assert record["quality"]["opencv_rms_px"] == pytest.approx(made.rms_px, rel=1e-5)
    assert record["quality"]["mean_over_views_of_l2_over_n_px"] < record["quality"]["opencv_rms_px"] / 5
    assert record["made"]["board"]["pattern"] == "9x6"


def test_a_camera_not_to_be_used_says_so_when_it_is_read(made, tmp_path):
    own = write_camera_files(made, tmp_path / "camera.json", "1.0")[0]
    assert distrust(own) is None
    record = dict(read_camera_record(own))
    record["quality"] = {"verdict": "do not use", "reasons": ["all is blurred"]}
    own.write_text(json.dumps(record))
    assert "all is blurred" in distrust(own)
    assert distrust(write_camera_files(made, tmp_path / "b.json", "1.0")[1]) is None


def test_a_rational_camera_is_written_as_one(made):
    from dataclasses import replace

    from autoreg.calibration.models import LENS_MODELS

    rational = replace(made, model=LENS_MODELS[-1])
    assert yaml.safe_load(ros_yaml(rational, "c"))["distortion_model"] == "rational_polynomial"
    assert "rows: 8" in opencv_yaml(rational)


def test_the_report_is_one_file_with_its_pictures_inside(made, tmp_path):
    written = write_report(made, tmp_path / "report", "1.0")
    assert written[0].name == REPORT_NAME
    page = written[0].read_text()
    assert page.count("data:image/png;base64,") == len(plots_of(made))
    assert "src='http" not in page
    assert "Verdict" in page
    for file in written[1:]:
        assert cv2.imread(str(file)) is not None


def test_names_in_the_report_are_escaped(made, tmp_path):
    from dataclasses import replace

    from autoreg.calibration.result import LeftOut

    odd = replace(made, left_out=(LeftOut("<script>.jpg", "no board"),))
    page = write_report(odd, tmp_path, "1.0")[0].read_text()
    assert "<script>" not in page


@pytest.mark.skipif(not SHARED.is_dir(), reason="the published chessboards are not here")
@pytest.mark.parametrize(
    ("name", "published", "focal", "centre", "rms"),
    [
        ("opencv_left", (535.916, 535.916, 342.283, 235.571), 0.007, 2.0, 0.20),
        pytest.param(
            "carnd_lane",
            (1157.779, 1152.823, 667.111, 386.129),
            0.005,
            10.0,
            2.0,
            marks=pytest.mark.slow,
        ),
    ],
)
def test_published_sets_come_out_near_the_published_values(name, published, focal, centre, rms):
    found = calibrate(SHARED / name, "9x6")
    k = found.fit.state.intrinsics
    assert np.abs(k[:2] / published[:2] - 1).max() < focal
    assert np.abs(k[2:4] - published[2:]).max() < centre
    assert found.rms_px <= rms


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.is_dir(), reason="the published chessboards are not here")
def test_the_sheet_on_the_sofa_is_seen_to_be_bent():
    found = calibrate(SHARED / "phone_iphone3gs", "9x6")
    assert found.verdict.grade != "good"
    assert any("sheet is bent" in reason for reason in found.verdict.reasons)
    assert [out.name for out in found.left_out] == ["IMG_0144.jpg"]


def test_a_charuco_board_that_is_partly_hidden_calibrates():
    board = Board(7, 5, 0.03, True, "charuco")
    rng = np.random.default_rng(2)
    seen = []
    for k, pose in enumerate(poses(CAMERA, 12, seed=4, board=board)):
        ids = np.sort(rng.choice(board.corners, 20, replace=False))
        px = exact(CAMERA, pose, board)[ids] + rng.normal(0, 0.1, (20, 2))
        seen.append(BoardView(str(k), ids, px))
    found = calibrate_views(seen, board, W, H)
    assert abs(found.camera.fx - CAMERA.fx) < 4 * found.precision.std_devs[0]
