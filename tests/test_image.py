import hashlib
import io
import math
import os
import struct
import time
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageOps, TiffImagePlugin

from autoreg.errors import InputError
from autoreg.formats.exif import Exif, focal_from_exif, read_exif
from autoreg.image import as_gray, load_photo, pyramid

settings.register_profile("autoreg", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("autoreg")

ORIENTATION, FOCAL, FOCAL_35, PIXELS_X, PIXELS_Y = 0x0112, 0x920A, 0xA405, 0xA002, 0xA003
PLANE_X, PLANE_UNIT, ZOOM = 0xA20E, 0xA210, 0xA404


def colour_picture(width=120, height=80):
    """A smooth picture without any symmetry, in RGB."""
    v, u = np.mgrid[:height, :width] / [[[height]], [[width]]]
    red, green, blue = 40 + 200 * u, 30 + 150 * v, 220 - 100 * u * v
    return Image.fromarray(np.stack([red, green, blue], -1).astype(np.uint8))


def encoded(picture, form="JPEG", **options):
    file = io.BytesIO()
    if form == "JPEG":
        options.setdefault("quality", 98)
        options.setdefault("subsampling", 0)
    picture.save(file, form, **options)
    return file.getvalue()


def exif_with(orientation=None, **tags):
    exif = Image.Exif()
    if orientation is not None:
        exif[ORIENTATION] = orientation
    if tags:
        exif.get_ifd(0x8769).update({globals()[name]: value for name, value in tags.items()})
    return exif


@pytest.fixture
def photo_of(tmp_path):
    def load(data, name="photo"):
        path = tmp_path / name
        path.write_bytes(data)
        return load_photo(path)

    return load


def luma(picture):
    return cv2.cvtColor(np.asarray(picture.convert("RGB")), cv2.COLOR_RGB2GRAY).astype(float)


# --- decoding ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["JPEG", "PNG", "WEBP", "TIFF"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_every_exif_orientation_is_applied_in_every_format(photo_of, form, orientation):
    data = encoded(colour_picture(), form, exif=exif_with(orientation))
    upright = ImageOps.exif_transpose(Image.open(io.BytesIO(data))).convert("RGB")
    photo = photo_of(data)
    assert photo.gray.shape == (photo.height, photo.width) == upright.size[::-1]
    assert np.abs(photo.gray - luma(upright)).mean() < 2
    assert np.abs(photo.colour()[..., ::-1] - np.asarray(upright, float)).mean() < 2


@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_turn_and_the_mirror_that_were_applied_are_told(photo_of, orientation):
    stored = colour_picture()
    photo = photo_of(encoded(stored, "PNG", exif=exif_with(orientation)))
    again = np.asarray(stored)[:, ::-1] if photo.mirrored else np.asarray(stored)
    np.testing.assert_array_equal(photo.colour()[..., ::-1], np.rot90(again, -photo.turned))
    assert photo.mirrored == (orientation in (2, 4, 5, 7))


@pytest.mark.parametrize("mode", ["L", "P", "1", "LA", "RGBA", "RGB"])
def test_png_of_every_kind_is_decoded(photo_of, mode):
    picture = colour_picture().convert(mode)
    photo = photo_of(encoded(picture, "PNG"))
    assert photo.gray.dtype == np.uint8
    assert np.abs(photo.gray - luma(picture)).mean() < 1.5
    assert photo.colour().shape == (80, 120, 3)


@pytest.mark.parametrize("mode", ["L", "CMYK", "RGB"])
@pytest.mark.parametrize("progressive", [False, True])
def test_jpeg_of_every_kind_is_decoded(photo_of, mode, progressive):
    picture = colour_picture().convert(mode)
    photo = photo_of(encoded(picture, progressive=progressive))
    assert np.abs(photo.gray - luma(picture)).mean() < 2.5
    assert photo.colour().shape == (80, 120, 3)


@pytest.mark.parametrize("ending", [".png", ".tiff"])
@pytest.mark.parametrize("shape", [(80, 120), (80, 120, 3)])
def test_pictures_of_sixteen_bits_are_reduced_to_eight(photo_of, ending, shape):
    deep = np.linspace(0, 65535, math.prod(shape)).reshape(shape).astype(np.uint16)
    photo = photo_of(cv2.imencode(ending, deep)[1].tobytes())
    assert photo.gray.dtype == np.uint8
    expected = deep if deep.ndim == 2 else deep @ [0.114, 0.587, 0.299]
    assert np.abs(photo.gray - expected / 257.0).max() < 1.5


@pytest.mark.parametrize("ending", [".png", ".tif", ".bmp", ".webp", ".ppm"])
def test_the_same_pixels_are_the_same_gray_in_every_format(photo_of, ending):
    pixels = np.random.default_rng(2).integers(0, 256, (80, 120, 3)).astype(np.uint8)
    lossless = [cv2.IMWRITE_WEBP_QUALITY, 101] if ending == ".webp" else []
    photo = photo_of(cv2.imencode(ending, pixels, lossless)[1].tobytes(), f"photo{ending}")
    np.testing.assert_array_equal(photo.gray, as_gray(pixels))


@pytest.mark.parametrize("order", ["big", "little"])
def test_a_tiff_of_either_byte_order_obeys_its_orientation_once(photo_of, order):
    mark = ">" if order == "big" else "<"
    pixels = np.asarray(colour_picture().convert("L"))
    entries = [(256, 120), (257, 80), (258, 8), (259, 1), (262, 1), (273, 8), (274, 6), (277, 1), (278, 80)]
    head = (b"MM\0*" if order == "big" else b"II*\0") + struct.pack(mark + "I", 8 + pixels.size)
    directory = struct.pack(mark + "H", len(entries) + 1)
    for tag, value in entries:
        directory += struct.pack(mark + "HHIHH", tag, 3, 1, value, 0)
    directory += struct.pack(mark + "HHII", 279, 4, 1, pixels.size) + bytes(4)
    content = head + pixels.tobytes() + directory
    photo = photo_of(content)
    np.testing.assert_array_equal(photo.gray, np.rot90(pixels, -1))
    np.testing.assert_array_equal(photo.colour()[..., 0], np.rot90(pixels, -1))
    assert photo.turned == 1
    # By what is on the disk the photo is known again.
    assert photo.sha256 == hashlib.sha256(content).hexdigest()


@pytest.mark.parametrize("name", ["pflaster größe 石.jpg", "with space.jpg", "-rf.jpg", "no_ending"])
def test_the_name_of_the_file_does_not_matter(photo_of, name):
    assert photo_of(encoded(colour_picture()), name).gray.shape == (80, 120)


def test_a_leading_dash_is_a_name_and_no_option(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "-1.png").write_bytes(encoded(colour_picture(), "PNG"))
    assert load_photo("-1.png").width == 120


def test_the_file_is_read_once(tmp_path):
    path = tmp_path / "photo.jpg"
    path.write_bytes(encoded(colour_picture()))
    photo = load_photo(path)
    path.unlink()
    assert photo.colour().shape == (80, 120, 3)


def test_a_picture_behind_the_photo_in_the_same_file_does_no_harm(photo_of):
    assert photo_of(encoded(colour_picture()) + b"MotionPhoto_Data" + bytes(1000)).width == 120


def test_a_photo_of_twelve_megapixels_takes_little_more_than_its_decoding(photo_of):
    data = encoded(colour_picture(4000, 3000), quality=90)
    buffer = np.frombuffer(data, np.uint8)
    start = time.process_time()
    cv2.imdecode(buffer, cv2.IMREAD_GRAYSCALE)
    decoding = time.process_time() - start
    start = time.process_time()
    photo_of(data)
    assert time.process_time() - start < 2 * decoding + 0.2


# --- files that are no photo ---------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["JPEG", "PNG", "WEBP", "TIFF"])
@pytest.mark.parametrize("part", [0.05, 0.5, 0.97])
def test_a_truncated_file_is_an_error(photo_of, form, part):
    noise = np.random.default_rng(0).integers(0, 255, (90, 130, 3), dtype=np.uint8)
    data = encoded(Image.fromarray(noise), form)
    with pytest.raises(InputError, match=r"truncated|broken"):
        photo_of(data[: int(part * len(data))])


def test_a_jpeg_cut_inside_its_scan_is_called_truncated_though_its_thumbnail_is_whole(photo_of):
    exif = exif_with(1)
    exif.get_ifd(0x8769)[0x9286] = encoded(colour_picture(64, 64))  # a whole JPEG inside the EXIF block
    data = encoded(colour_picture(), exif=exif)
    photo_of(data)
    with pytest.raises(InputError, match="truncated"):
        photo_of(data[:-100])


def test_a_png_with_a_wrong_check_sum_is_an_error(photo_of):
    data = bytearray(encoded(colour_picture(), "PNG"))
    data[len(data) // 2] ^= 0x55
    with pytest.raises(InputError, match="corrupt"):
        photo_of(bytes(data))


@pytest.mark.parametrize(
    ("data", "cause"),
    [
        (b"", "is empty"),
        (b"\xff\xd8", "truncated"),
        (b"\x89PNG", "truncated"),
        (b"hello, this is no picture", "no picture"),
        (b"%PDF-1.7 " * 40, "no picture"),
        (b"II*\0\xff\xff\xff\xff", "no picture"),
        (b"RIFF\x10\0\0\0WEBP", "no picture"),
        (bytes(1000), "no picture"),
        (b"\0\0\0\x18ftypheic" + bytes(100), "no picture"),
    ],
)
def test_what_is_no_picture_is_said_to_be_none(photo_of, data, cause, capfd):
    with pytest.raises(InputError, match=cause):
        photo_of(data)
    assert "WARN" not in capfd.readouterr().err


@pytest.mark.parametrize("size", [(63, 400), (400, 63), (1, 1)])
def test_a_picture_that_is_too_small_is_an_error_with_its_size(photo_of, size):
    with pytest.raises(InputError, match=f"{size[0]} x {size[1]}.*at least 64"):
        photo_of(encoded(colour_picture(*size), "PNG"))


def test_the_smallest_picture_is_accepted(photo_of):
    assert photo_of(encoded(colour_picture(64, 64), "PNG")).gray.shape == (64, 64)


@pytest.mark.parametrize("size", [(40_000, 40_000), (2_000_000, 64)])
def test_a_picture_larger_than_opencv_decodes_is_an_error(photo_of, size):
    def chunk(kind, content):
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", *size, 8, 0, 0, 0, 0))
    data = b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(bytes(99))) + chunk(b"IEND", b"")
    with pytest.raises(InputError, match=r"cannot be decoded|no picture that can be decoded"):
        photo_of(data)


def test_a_missing_file_a_folder_and_a_pipe_are_errors(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        load_photo(tmp_path / "none.jpg")
    with pytest.raises(InputError, match="is not a file"):
        load_photo(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="is not a file"):
        load_photo(tmp_path / "pipe")


# --- EXIF ----------------------------------------------------------------------------------------------


def test_the_focal_length_for_35_mm_film_goes_by_the_diagonal(photo_of):
    photo = photo_of(encoded(colour_picture(160, 120), exif=exif_with(FOCAL_35=28)))
    assert photo.exif_focal_px == pytest.approx(28 / 43.2666 * 200, rel=1e-5)
    assert "28 mm on 35 mm film" in photo.exif_focal_note


def test_the_focal_length_is_found_as_well_in_the_files_main_directory(photo_of):
    exif = Image.Exif()
    exif[FOCAL_35] = 28
    photo = photo_of(encoded(colour_picture(160, 120), exif=exif))
    assert photo.exif_focal_px == pytest.approx(28 / 43.2666 * 200, rel=1e-5)


def test_a_full_frame_picture_of_36_mm_focal_length_has_it_equal_to_its_width():
    focal, _ = focal_from_exif(Exif(focal_35mm=36.0), 3600, 2400)
    assert focal == pytest.approx(3600, rel=1e-12)


@pytest.mark.parametrize(("unit", "resolution"), [(2, 25400.0), (3, 10000.0), (4, 1000.0), (5, 1.0)])
@pytest.mark.parametrize("size", [(160, 120), (120, 160)])
def test_the_pixel_pitch_of_the_sensor_gives_the_focal_length_of_a_resized_photo(
    photo_of, unit, resolution, size
):
    # 1000 pixels per mm and 4000 pixels: a sensor 4 mm wide, whose 8 mm lens sees twice its width.
    tags = {"FOCAL": 8.0, "PLANE_X": resolution, "PLANE_UNIT": unit, "PIXELS_X": 4000, "PIXELS_Y": 3000}
    photo = photo_of(encoded(colour_picture(*size), exif=exif_with(**tags)))
    assert photo.exif_focal_px == pytest.approx(2 * 160, rel=1e-6)


def test_the_focal_length_holds_for_a_photo_that_exif_turns(photo_of):
    tags = {"FOCAL_35": 28, "PIXELS_X": 4000, "PIXELS_Y": 3000}
    upright = photo_of(encoded(colour_picture(160, 120), exif=exif_with(6, **tags)))
    assert upright.gray.shape == (160, 120)
    assert upright.exif_focal_px == pytest.approx(28 / 43.2666 * 200, rel=1e-5)


def test_a_cropped_photo_loses_its_exif_focal_length_and_says_why(photo_of):
    tags = {"FOCAL_35": 28, "PIXELS_X": 4000, "PIXELS_Y": 3000}
    photo = photo_of(encoded(colour_picture(160, 90), exif=exif_with(**tags)))
    assert photo.exif_focal_px is None
    assert "4000 x 3000 but the file is 160 x 90: it was cropped" in photo.exif_focal_note


def test_a_focal_length_without_a_recorded_size_is_used_with_a_warning(photo_of):
    note = photo_of(encoded(colour_picture(), exif=exif_with(FOCAL_35=28))).exif_focal_note
    assert "a crop cannot be told" in note


@pytest.mark.parametrize(
    ("tags", "why"),
    [
        ({"FOCAL_35": 0}, None),
        ({"FOCAL_35": 1}, "1 mm on 35 mm film is not plausible"),
        ({"FOCAL_35": 65535}, "65535 mm on 35 mm film is not plausible"),
        ({"FOCAL": TiffImagePlugin.IFDRational(0, 1)}, None),
        ({"FOCAL": TiffImagePlugin.IFDRational(8, 0)}, None),
        ({"FOCAL": TiffImagePlugin.IFDRational(0, 0)}, None),
        ({"FOCAL": 8.0, "PLANE_X": TiffImagePlugin.IFDRational(1, 0)}, "without a usable sensor size"),
        ({"FOCAL": 8.0, "PLANE_UNIT": 0}, "without a usable sensor size"),
        ({"FOCAL": 8.0, "PLANE_UNIT": 77}, "without a usable sensor size"),
        ({"FOCAL": 8.0, "PIXELS_X": 0}, "without a usable sensor size"),
    ],
)
def test_a_focal_length_that_cannot_be_is_ignored(photo_of, tags, why):
    sensor = {"PLANE_X": 1000.0, "PLANE_UNIT": 4, "PIXELS_X": 4000, "PIXELS_Y": 3000}
    photo = photo_of(encoded(colour_picture(160, 120), exif=exif_with(**(sensor | tags))))
    assert photo.exif_focal_px is None
    assert (photo.exif_focal_note is None) if why is None else (why in photo.exif_focal_note)


@pytest.mark.parametrize(
    "changed",
    [
        {"plane_pixels_per_mm": None},
        {"pixel_width": None},
        {"plane_pixels_per_mm": 1.0},
        {"plane_pixels_per_mm": 1e6},
        {"digital_zoom": 2.0},
        {"focal_mm": 4000.0},
        {"focal_mm": 0.1},
    ],
)
def test_a_sensor_that_is_unknown_or_cannot_be_gives_no_focal_length(changed):
    whole = {"focal_mm": 8.0, "plane_pixels_per_mm": 1000.0, "pixel_width": 4000.0, "pixel_height": 3000.0}
    assert focal_from_exif(Exif(**whole), 1600, 1200)[0] == pytest.approx(3200)
    focal, note = focal_from_exif(Exif(**(whole | changed)), 1600, 1200)
    assert focal is None
    assert "focal length" in note


@given(
    st.dictionaries(
        st.sampled_from([ORIENTATION, 0x0110, 0x0100]),
        st.one_of(st.integers(0, 2**32 - 1), st.text("abc", max_size=5)),
    ),
    st.dictionaries(
        st.sampled_from([FOCAL, FOCAL_35, PIXELS_X, PIXELS_Y, PLANE_X, PLANE_UNIT, ZOOM]),
        st.one_of(st.integers(0, 70000), st.just("text"), st.just((1, 2, 3)), st.just(b"\0\1")),
    ),
    st.integers(0, 200),
    st.binary(max_size=6),
)
def test_no_exif_block_however_broken_stops_a_photo_or_gives_it_a_mad_focal_length(tags, details, at, damage):
    exif = Image.Exif()
    exif.update(tags)
    exif.get_ifd(0x8769).update(details)
    try:
        block = bytearray(exif.tobytes())
    except Exception:
        block = bytearray(b"Exif\0\0II*\0\x08\0\0\0\x05\0")  # what Pillow cannot write
    block[at : at + len(damage)] = damage
    data = encoded(colour_picture(), exif=bytes(block))
    focal, note = focal_from_exif(read_exif(data), 120, 80)
    assert note
    assert focal is None or 0.2 <= focal / math.hypot(120, 80) <= 20


def test_a_photo_without_exif_has_none():
    assert read_exif(encoded(colour_picture())) == Exif()


# --- reducing and converting ---------------------------------------------------------------------------


def blob(centre_px, width=640, height=480):
    v, u = np.mgrid[:height, :width]
    return 230 * np.exp(-((u - centre_px[0]) ** 2 + (v - centre_px[1]) ** 2) / (2 * 9.0**2))


@pytest.mark.parametrize("max_pixels", [300_000, 100_000, 76_800, 30_001])
@pytest.mark.parametrize("centre", [(201.3, 152.8), (500.0, 333.25)])
def test_a_reduced_picture_keeps_its_pixel_centres(max_pixels, centre):
    gray = np.round(blob(centre)).astype(np.uint8)
    small, scale = pyramid(gray, max_pixels)
    assert 0.97 * max_pixels < small.size <= max_pixels
    assert (scale.factor_x, scale.factor_y) == (640 / small.shape[1], 480 / small.shape[0])
    v, u = np.mgrid[: small.shape[0], : small.shape[1]]
    weight = small.astype(float)
    found = np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()
    np.testing.assert_allclose(scale.to_photo(found), centre, atol=0.02)
    np.testing.assert_allclose(scale.to_small(scale.to_photo(found)), found, atol=1e-12)


def test_the_corners_of_the_reduced_picture_are_those_of_the_photo():
    small, scale = pyramid(np.zeros((480, 641), np.uint8), 50_000)
    corners = np.array([[-0.5, -0.5], [small.shape[1] - 0.5, small.shape[0] - 0.5]])
    np.testing.assert_allclose(scale.to_photo(corners), [[-0.5, -0.5], [640.5, 479.5]], atol=1e-12)


def test_a_picture_that_is_small_enough_stays_as_it_is():
    gray = np.zeros((48, 64), np.uint8)
    small, scale = pyramid(gray, 48 * 64)
    assert small is gray
    assert (scale.factor_x, scale.factor_y) == (1.0, 1.0)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
@pytest.mark.parametrize("channels", [0, 1, 3, 4])
def test_arrays_of_every_allowed_kind_become_the_same_gray(dtype, channels):
    white = np.iinfo(dtype).max if np.issubdtype(dtype, np.integer) else 1.0
    gray = np.arange(256, dtype=np.uint8).reshape(16, 16)
    array = gray if channels == 0 else np.repeat(gray[..., None], channels, 2)
    np.testing.assert_array_equal(as_gray((array / 255.0 * white).astype(dtype)), gray)


def test_colours_are_taken_as_bgr():
    pure = np.zeros((2, 3, 3), np.uint8)
    pure[:, [0, 1, 2], [0, 1, 2]] = 255
    np.testing.assert_array_equal(as_gray(pure)[0], [29, 150, 76])


def test_views_with_strange_strides_are_accepted():
    array = np.arange(64 * 64 * 3, dtype=np.uint8).reshape(64, 64, 3)
    np.testing.assert_array_equal(as_gray(array[::-1, ::2, ::-1]), as_gray(array[::-1, ::2, ::-1].copy()))


def test_a_picture_of_floating_point_numbers_is_an_error_that_says_so(tmp_path):
    path = tmp_path / "photo.tiff"
    cv2.imwrite(str(path), np.full((20, 30), 0.5, np.float32))
    with pytest.raises(InputError, match="pixels of float32; save it with 8 or 16 bits"):
        load_photo(path)


def test_the_name_of_a_file_is_an_error_that_says_how_to_load_it():
    with pytest.raises(ValueError, match=r"load_photo\(path\)\.gray"):
        as_gray(np.array("photo.jpg"))


@pytest.mark.parametrize(
    "array",
    [
        np.zeros(5, np.uint8),
        np.zeros((5, 5, 2), np.uint8),
        np.zeros((0, 5), np.uint8),
        np.zeros((1, 5, 5, 3), np.uint8),
        np.zeros((5, 5), np.int32),
        np.zeros((5, 5), bool),
        np.full((5, 5), 255.0),
        np.full((5, 5), np.nan),
        np.full((5, 5), -0.1),
    ],
)
def test_any_other_array_is_an_error_that_names_the_photo(array):
    with pytest.raises(ValueError, match=r"photo .*must"):
        as_gray(array)


def test_a_limit_of_no_pixels_is_an_error():
    with pytest.raises(ValueError, match="max_pixels"):
        pyramid(np.zeros((10, 10), np.uint8), 0)
