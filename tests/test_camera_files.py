import contextlib
import json
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autoreg.calibration.models import LENS_MODELS
from autoreg.camera import Camera
from autoreg.camera_files import read_camera, write_camera_json
from autoreg.errors import InputError

settings.register_profile("autoreg", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("autoreg")

SHARED = Path(__file__).parents[2] / "shared"
FIVE = (-0.15, 0.03, 0.0004, -0.0003, 1e-05)
CAMERA = Camera(1600, 1200, 1147.5, 1148.25, 817.75, 598.5, FIVE)
RATIONAL = Camera(1600, 1200, 1147.5, 1148.25, 817.75, 598.5, (*FIVE, 0.25, -0.125, 0.0625))

YAML_HEADERS = ("%YAML:1.0\n---\n", "%YAML 1.2\n---\n", "")

ROS = """\
image_width: 1600
image_height: 1200
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [1147.5, 0.0, 817.75, 0.0, 1148.25, 598.5, 0.0, 0.0, 1.0]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.15, 0.03, 0.0004, -0.0003, 1e-05]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""
OWN = {"width": 1600, "height": 1200, "fx": 1147.5, "fy": 1148.25, "cx": 817.75, "cy": 598.5, "dist": [*FIVE]}


@pytest.fixture
def given_text(tmp_path):
    """Writes a text to a file whose name gives no format away, and returns its path."""

    def write(text):
        path = tmp_path / "camera.dat"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


def file_storage(path, camera=CAMERA, keys="calibration", dist=None, **extra):
    """Write a camera as OpenCV's own programs do."""
    dist = np.array(camera.dist[:5] if dist is None else dist)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    if keys == "calibration":
        storage.write("calibration_time", "Fri 21 Nov 2025")
        storage.write("image_width", camera.width)
        storage.write("image_height", camera.height)
        storage.write("flags", 0)
        names = ("camera_matrix", "distortion_coefficients")
    else:
        storage.startWriteStruct("cameraResolution", cv2.FileNode_SEQ + cv2.FileNode_FLOW)
        storage.write("", camera.width)
        storage.write("", camera.height)
        storage.endWriteStruct()
        storage.write("cameraMatrix_std_dev", np.zeros((4, 1)))
        names = ("cameraMatrix", "dist_coeffs")
    storage.write(names[0], camera.K)
    storage.write(names[1], dist.reshape(-1, 1) if keys == "calibration" else dist.reshape(1, -1))
    for name, value in extra.items():
        storage.write(name, value)
    storage.write("avg_reprojection_error", 0.25)
    storage.release()
    return path


def assert_same_camera(a, b):
    assert (a.width, a.height) == (b.width, b.height)
    np.testing.assert_allclose(a.K, b.K, rtol=1e-14)
    np.testing.assert_allclose(a.dist, b.dist, rtol=1e-14)


# --- every format gives the same camera ----------------------------------------------------------------


@pytest.mark.parametrize("camera", [CAMERA, RATIONAL, replace(CAMERA, dist=())])
def test_the_own_format_comes_back_exactly(tmp_path, camera):
    path = tmp_path / "camera.json"
    write_camera_json(camera, path)
    assert read_camera(path) == camera
    assert list(tmp_path.iterdir()) == [path]


def test_the_own_format_keeps_the_contracts_fields(tmp_path):
    write_camera_json(CAMERA, tmp_path / "camera.json")
    assert json.loads((tmp_path / "camera.json").read_text()) == OWN


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
@pytest.mark.parametrize("keys", ["calibration", "interactive"])
@pytest.mark.parametrize("dist", [CAMERA.dist[:4], CAMERA.dist[:5], RATIONAL.dist])
def test_opencvs_files_are_read_whatever_they_are_called(tmp_path, ending, keys, dist):
    path = file_storage(tmp_path / f"camera.{ending}", keys=keys, dist=dist)
    path = path.rename(tmp_path / "camera.txt")
    expected = Camera(1600, 1200, 1147.5, 1148.25, 817.75, 598.5, tuple(dist))
    assert_same_camera(read_camera(path), expected)


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
def test_a_distortion_vector_of_one_dimension_is_read(tmp_path, given_text, ending):
    storage = cv2.FileStorage(str(tmp_path / f"camera.{ending}"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", CAMERA.width)
    storage.write("image_height", CAMERA.height)
    storage.write("camera_matrix", CAMERA.K)
    storage.write("distortion_coefficients", np.array(FIVE))
    storage.release()
    text = (tmp_path / f"camera.{ending}").read_text()
    # OpenCV before 5.0 knows no such vector: it writes one column.
    if "sizes" in text:
        with pytest.raises(InputError, match=r"says 6 but its data has 5 numbers"):
            read_camera(given_text(text.replace("[ 5 ]", "[ 6 ]").replace("5</sizes>", "6</sizes>")))
    assert_same_camera(read_camera(given_text(text)), CAMERA)


def test_vectors_of_opencv_5_are_read_whatever_opencv_is_installed(given_text):
    vector = "!!opencv-nd-matrix\n  sizes: [ 5 ]\n  dt: d\n"
    text = ROS.replace(
        "distortion_coefficients:\n  rows: 1\n  cols: 5\n", f"distortion_coefficients: {vector}"
    )
    assert "nd-matrix" in text
    assert_same_camera(read_camera(given_text(text)), CAMERA)


def test_a_matrix_and_dist_are_read_as_json(given_text):
    text = json.dumps({"width": 1600, "height": 1200, "K": CAMERA.K.tolist(), "dist": [*FIVE]})
    assert_same_camera(read_camera(given_text(text)), CAMERA)


@pytest.mark.parametrize("header", YAML_HEADERS)
@pytest.mark.parametrize("keys", ["calibration", "interactive"])
def test_opencvs_yaml_is_read_under_the_headers_of_all_its_versions(tmp_path, given_text, header, keys):
    text = file_storage(tmp_path / "camera.yml", keys=keys).read_text()
    body = text.split("---\n", 1)[1]
    assert_same_camera(read_camera(given_text(header + body)), CAMERA)


@pytest.mark.parametrize("header", YAML_HEADERS)
def test_ros_camera_info_is_read(given_text, header):
    assert_same_camera(read_camera(given_text(header + ROS)), CAMERA)


def test_a_dumped_camera_info_message_is_read(given_text):
    text = (
        "header:\n  stamp: {secs: 0, nsecs: 0}\nheight: 1200\nwidth: 1600\ndistortion_model: plumb_bob\n"
        f"D: {[*FIVE]}\nK: [1147.5, 0.0, 817.75, 0.0, 1148.25, 598.5, 0.0, 0.0, 1.0]\n---\n"
    )
    assert_same_camera(read_camera(given_text(text)), CAMERA)


def test_a_region_of_ros_is_refused_where_it_is_a_part_and_the_crop_is_named(given_text):
    region = "roi: {x_offset: 160, y_offset: 120, height: %d, width: %d, do_rectify: false}\n"
    for height, width in ((0, 0), (1200, 1600)):
        assert_same_camera(read_camera(given_text(ROS + region % (height, width))), CAMERA)
    with pytest.raises(InputError, match="--crop 160,120,800,600"):
        read_camera(given_text(ROS + region % (600, 800)))


def test_ros_rational_polynomial_is_read(given_text):
    text = ROS.replace("plumb_bob", "rational_polynomial").replace("cols: 5", "cols: 8")
    text = text.replace("1e-05]", "1e-05, 0.25, -0.125, 0.0625]")
    assert_same_camera(read_camera(given_text(text)), RATIONAL)


@pytest.mark.parametrize(
    ("line", "focal", "dist"),
    [
        ("SIMPLE_PINHOLE 640 480 500 320 240", (500, 500), ()),
        ("PINHOLE 640 480 500 510 320 240", (500, 510), ()),
        ("SIMPLE_RADIAL 640 480 500 320 240 0.1", (500, 500), (0.1,)),
        ("RADIAL 640 480 500 320 240 0.1 -0.2", (500, 500), (0.1, -0.2)),
        ("OPENCV 640 480 500 510 320 240 0.1 -0.2 0.3 0.4", (500, 510), (0.1, -0.2, 0.3, 0.4)),
        (
            "FULL_OPENCV 640 480 500 510 320 240 0.1 -0.2 0.3 0.4 0.5 0.6 0.7 0.8",
            (500, 510),
            (0.1, -0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8),
        ),
    ],
)
def test_colmaps_models_are_read_with_its_half_pixel(given_text, line, focal, dist):
    header = (
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    )
    for text in (header + "1 " + line + "\n", "7 " + line):
        camera = read_camera(given_text(text))
        assert (camera.width, camera.height) == (640, 480)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (*focal, 319.5, 239.5)
        assert camera.dist == dist + (0.0,) * (8 - len(dist))


def test_cameras_of_colmap_that_are_alike_are_one(given_text):
    line = "SIMPLE_PINHOLE 640 480 500 320 240\n"
    assert read_camera(given_text("1 " + line + "2 " + line)).fx == 500


def test_a_byte_order_mark_and_windows_line_ends_do_not_matter(given_text):
    assert_same_camera(read_camera(given_text(b"\xef\xbb\xbf" + json.dumps(OWN).encode())), CAMERA)
    assert_same_camera(read_camera(given_text(ROS.replace("\n", "\r\n"))), CAMERA)


@pytest.mark.parametrize("n", [12, 14])
def test_unused_prism_and_tilt_coefficients_are_dropped_and_used_ones_refused(tmp_path, n):
    path = file_storage(tmp_path / "camera.yml", dist=[*RATIONAL.dist, *[0.0] * (n - 8)])
    assert_same_camera(read_camera(path), RATIONAL)
    path = file_storage(tmp_path / "camera.yml", dist=[*RATIONAL.dist, *[0.0] * (n - 9), 1e-3])
    with pytest.raises(InputError, match=r"distortion_coefficients.*thin prism or tilted"):
        read_camera(path)


@pytest.mark.skipif(not SHARED.is_dir(), reason="the folder shared/ is not beside the repository")
def test_the_calibration_that_ships_with_opencvs_samples_is_read():
    camera = read_camera(SHARED / "chessboards" / "opencv_left" / "left_intrinsics.yml")
    assert (camera.width, camera.height) == (640, 480)
    assert camera.fx == pytest.approx(535.916, abs=1e-3)
    assert camera.dist[4] == pytest.approx(0.23839, abs=1e-5)


# --- what is not supported is refused by name ----------------------------------------------------------


@pytest.mark.parametrize("model", ["equidistant", "fisheye", "thin_prism"])
def test_other_distortion_models_are_refused_by_name(given_text, model):
    with pytest.raises(InputError, match=rf"distortion_model is '{model}'.*plumb_bob"):
        read_camera(given_text(ROS.replace("plumb_bob", model)))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("model", "fisheye"),
        ("distortion_model", "equidistant"),
        ("camera_model", "omni"),
        ("fisheye", True),
        ("skew", 4),
    ],
)
def test_the_own_format_is_refused_where_another_key_contradicts_it(given_text, key, value):
    with pytest.raises(InputError, match=rf"{key}.*not supported"):
        read_camera(given_text(json.dumps({**OWN, key: value})))


@pytest.mark.parametrize(
    ("key", "value"),
    [("model", model.name) for model in LENS_MODELS]
    + [
        ("model", None),
        ("model", "Canon EOS 5D"),
        ("distortion_model", "plumb_bob"),
        ("fisheye", False),
        ("skew", 0.0),
    ],
)
def test_the_own_format_may_say_what_is_so(given_text, key, value):
    assert_same_camera(read_camera(given_text(json.dumps({**OWN, key: value}))), CAMERA)


def test_a_fisheye_calibration_of_opencv_is_refused(tmp_path):
    path = file_storage(tmp_path / "camera.yml", dist=[0.1, 0.2, 0.3, 0.4], fisheye_model=1)
    with pytest.raises(InputError, match="fisheye"):
        read_camera(path)
    path = file_storage(tmp_path / "camera.yml", dist=[0.1, 0.2, 0.3, 0.4], fisheye_model=0)
    assert read_camera(path).dist[:4] == (0.1, 0.2, 0.3, 0.4)


def test_another_model_of_colmap_is_refused_by_name(given_text):
    with pytest.raises(InputError, match=r"'OPENCV_FISHEYE'.*SIMPLE_PINHOLE"):
        read_camera(given_text("1 OPENCV_FISHEYE 640 480 500 500 320 240 0 0 0 0"))


def test_several_different_cameras_are_refused(given_text):
    text = "1 SIMPLE_PINHOLE 640 480 500 320 240\n2 SIMPLE_PINHOLE 640 480 501 320 240\n"
    with pytest.raises(InputError, match=r"2 different cameras \(ids 1, 2\).*keep only"):
        read_camera(given_text(text))


def test_skew_is_refused(given_text):
    with pytest.raises(InputError, match=r"camera_matrix.*skew"):
        read_camera(given_text(ROS.replace("[1147.5, 0.0,", "[1147.5, 2.0,")))


# --- broken files name the key -------------------------------------------------------------------------


@pytest.mark.parametrize("key", list(OWN))
def test_a_missing_key_of_the_own_format_is_named(given_text, key):
    content = {name: value for name, value in OWN.items() if name != key}
    with pytest.raises(InputError, match=rf"key '{key}' is missing; add it"):
        read_camera(given_text(json.dumps(content)))


@pytest.mark.parametrize("key", list(OWN))
@pytest.mark.parametrize("value", ["abc", None, True, float("nan"), float("inf"), [[1], "x"], {}, 10**400])
def test_a_key_of_the_own_format_that_holds_no_number_is_named(given_text, key, value):
    with pytest.raises(InputError, match=key):
        read_camera(given_text(json.dumps({**OWN, key: value})))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("width", 0),
        ("height", 12.5),
        ("fx", -3),
        ("fy", 0),
        ("dist", [1, 2, 3]),
        ("fx", 1e300),
        ("fy", 1e-300),
        ("fy", 1e9),
    ],
)
def test_a_number_that_makes_no_sense_is_named(given_text, key, value):
    with pytest.raises(InputError, match=key):
        read_camera(given_text(json.dumps({**OWN, key: value})))


@pytest.mark.parametrize("key", ["image_width", "image_height", "camera_matrix", "distortion_coefficients"])
def test_a_missing_key_of_ros_and_opencv_is_named(tmp_path, given_text, key):
    with pytest.raises(InputError, match=f"key '{key}' is missing"):
        read_camera(given_text(ROS.replace(key, "other")))
    text = file_storage(tmp_path / "camera.yml").read_text()
    with pytest.raises(InputError, match=f"key '{key}' is missing"):
        read_camera(given_text(text.replace(key, "other")))


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("1147.5, 0.0,", "many, 0.0,", "camera_matrix"),
        ("1147.5, 0.0,", ".nan, 0.0,", "camera_matrix"),
        ("1147.5, 0.0,", "", "camera_matrix"),
        ("rows: 3", "rows: x", "camera_matrix.rows"),
        ("-0.15, ", "", "distortion_coefficients"),
        ("-0.15, ", "null, ", "distortion_coefficients"),
        ("image_width: 1600", "image_width: wide", "image_width"),
        ("image_width: 1600", "image_width: -1", "image_width"),
        ("image_height: 1200", "image_height:", "image_height"),
        ("1147.5, 0.0,", "-1147.5, 0.0,", "fx"),
    ],
)
def test_a_broken_value_of_ros_is_named(given_text, old, new, key):
    assert old in ROS
    with pytest.raises(InputError, match=key):
        read_camera(given_text(ROS.replace(old, new, 1)))


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("1147.5, 0.", ".Nan, 0.", "camera_matrix"),
        ("1147.5, 0.", "1147.5", "camera_matrix"),
        ("rows: 3", "rows: 2", "camera_matrix"),
        ("image_width: 1600", "image_width: wide", "image_width"),
        ("image_width: 1600", "image_width: 0", "image_width"),
        ("data: [ 1147.5", "data: [ [", "no known format"),
    ],
)
def test_a_broken_value_of_opencv_is_named(tmp_path, given_text, old, new, key):
    text = file_storage(tmp_path / "camera.yml").read_text()
    assert old in text
    with pytest.raises(InputError, match=key):
        read_camera(given_text(text.replace(old, new, 1)))


@pytest.mark.parametrize(
    ("line", "key"),
    [
        ("1 PINHOLE 640 480 500 510 320", "PINHOLE takes 4 parameters"),
        ("1 PINHOLE 640 480 500 510 320 x", "camera 1 cy"),
        ("1 PINHOLE 640 480 500 nan 320 240", "camera 1 fy"),
        ("1 PINHOLE 640.5 480 500 500 320 240", "camera 1 width"),
        ("1 PINHOLE 640 480 0 500 320 240", "fx must be positive"),
        ("# Camera list with one line of data per camera:", "without any camera"),
        ("# Camera list\n1 PINHOLE", "ID MODEL WIDTH"),
    ],
)
def test_a_broken_line_of_colmap_is_named(given_text, line, key):
    with pytest.raises(InputError, match=key):
        read_camera(given_text(line))


@pytest.mark.parametrize(
    ("content", "cause"),
    [
        (b"", "empty"),
        (b" \n\t", "empty"),
        (b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR", "not UTF-8 text"),
        (b"\xff\xd8\xff\xe0" * 50, "not UTF-8 text"),
        (b"a\0b", "not UTF-8 text"),
        (b"{", "JSON"),
        (b"[1, 2]", "holds no keys"),
        (b"{" * 100_000, "camera file"),
        (b"[" * 100_000, "camera file"),
        (b"hello world", "holds no keys"),
        (b"a: [1, 2", "no known format"),
        (b"a: 2020-13-45", "no known format"),
        (b"<html></html>", "<html>"),
        (b'<?xml version="1.0"?><opencv_storage><image_width>3</image_width>', "broken XML"),
        (b"%YAML:1.0\n---\n", "holds no keys"),
        (b"x" * 4_000_001, "larger than"),
    ],
)
def test_what_is_no_camera_file_is_said_to_be_none(given_text, content, cause):
    with pytest.raises(InputError, match=cause):
        read_camera(given_text(content))


def test_a_missing_file_a_folder_and_a_pipe_are_errors(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_camera(tmp_path / "none.json")
    with pytest.raises(InputError, match="does not exist"):
        read_camera(tmp_path / ("n" * 5000))
    with pytest.raises(InputError, match="is not a file"):
        read_camera(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="is not a file"):
        read_camera(tmp_path / "pipe")


def test_a_place_that_cannot_be_written_is_an_error_and_leaves_nothing(tmp_path):
    with pytest.raises(InputError, match="cannot write camera file"):
        write_camera_json(CAMERA, tmp_path / "missing" / "camera.json")
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match="cannot write camera file"):
        write_camera_json(CAMERA, tmp_path / "folder")
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


@given(data=st.data())
def test_no_damage_to_a_camera_file_ends_in_a_traceback(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("damaged")
    texts = [file_storage(folder / f"camera.{ending}").read_bytes() for ending in ("yml", "xml", "json")]
    texts += [ROS.encode(), json.dumps(OWN).encode(), b"1 OPENCV 640 480 500 510 320 240 0.1 -0.2 0.3 0.4\n"]
    text = bytearray(data.draw(st.sampled_from(texts)))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(text) - 1))
        if data.draw(st.booleans()):
            text[at] = data.draw(st.integers(0, 255))
        else:
            del text[at : at + data.draw(st.integers(1, 30))]
    path = folder / "damaged"
    path.write_bytes(text)
    with contextlib.suppress(InputError):
        assert read_camera(path).fx > 0
