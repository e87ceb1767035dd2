"""Photos as an iPhone keeps them: in HEIC, turned by a box of their own as EXIF tells."""

import io
import sys

import numpy as np
import pytest
from PIL import ImageOps
from test_image import ORIENTATION, colour_picture, exif_with

from autoreg.calibration.photos import photo_files
from autoreg.errors import InputError
from autoreg.formats.exif import read_exif
from autoreg.image import load_photo

heif = pytest.importorskip("pillow_heif", reason="pillow-heif is not installed")


def heic(stored, exif=None):
    """A file's bytes; its box that turns goes by the orientation in the EXIF."""
    data = io.BytesIO()
    said = {} if exif is None else {"exif": exif.tobytes()}
    heif.from_pillow(stored).save(data, quality=-1, **said)
    return data.getvalue()


@pytest.fixture
def photo_of(tmp_path):
    def load(data):
        (tmp_path / "IMG_0001.HEIC").write_bytes(data)
        return load_photo(tmp_path / "IMG_0001.HEIC")

    return load


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_photo_is_upright_and_how_it_was_turned_is_told(photo_of, orientation):
    exif = exif_with(orientation)
    photo = photo_of(heic(colour_picture(), exif))
    held = colour_picture()
    held.getexif()[ORIENTATION] = orientation
    upright = ImageOps.exif_transpose(held)
    assert photo.gray.shape == (photo.height, photo.width) == upright.size[::-1]
    assert np.abs(photo.colour()[..., ::-1] - np.asarray(upright, float)).mean() < 4
    assert np.abs(photo.gray - np.asarray(upright.convert("L"), float)).mean() < 3
    again = np.asarray(colour_picture())[:, ::-1] if photo.mirrored else np.asarray(colour_picture())
    assert np.abs(photo.colour()[..., ::-1] - np.rot90(again, -photo.turned).astype(float)).mean() < 4


def test_its_focal_length_is_read(photo_of):
    exif = exif_with(6, FOCAL_35=26, PIXELS_X=4032, PIXELS_Y=2688)
    photo = photo_of(heic(colour_picture(), exif))
    assert photo.exif_focal_px == pytest.approx(26 / 43.2666 * np.hypot(120, 80), rel=1e-5)


def test_an_orientation_that_turns_nothing_is_not_followed(photo_of):
    data = heic(colour_picture(), exif_with(6)).replace(b"irot", b"free")
    assert read_exif(data).turned == 0
    assert photo_of(data).gray.shape == (80, 120)


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "LA"])
def test_every_kind_of_picture_has_grey_and_colour(photo_of, mode):
    photo = photo_of(heic(colour_picture().convert(mode)))
    assert photo.gray.shape == (80, 120)
    assert photo.gray.dtype == np.uint8
    assert photo.colour().shape == (80, 120, 3)
    assert np.abs(photo.gray - np.asarray(colour_picture().convert(mode).convert("L"), float)).mean() < 3


def test_ten_bits_are_reduced_to_eight(photo_of):
    deep = np.asarray(colour_picture().convert("L")).astype(np.uint16) * 257
    data = io.BytesIO()
    heif.from_bytes("I;16", (120, 80), deep.tobytes()).save(data, quality=-1)
    photo = photo_of(data.getvalue())
    assert photo.gray.dtype == np.uint8
    assert np.abs(photo.gray - np.asarray(colour_picture().convert("L"), float)).mean() < 3


@pytest.mark.parametrize("kept", [0.02, 0.5, 0.9])
def test_a_file_that_ends_early_is_an_error(photo_of, kept):
    data = heic(colour_picture())
    with pytest.raises(InputError, match="broken or no picture"):
        photo_of(data[: int(kept * len(data))])


def test_without_its_decoder_the_error_names_it(photo_of, monkeypatch):
    data = heic(colour_picture(), exif_with(1))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    monkeypatch.setattr("autoreg.image.can_decode_heic", lambda: False)
    with pytest.raises(InputError, match="HEIC, which pillow-heif decodes: pip install it, or save as JPEG"):
        photo_of(data)


def test_a_folder_of_boards_holds_such_photos_too(tmp_path):
    for name in ("IMG_2.HEIC", "IMG_10.heif", "notes.txt"):
        (tmp_path / name).touch()
    assert [path.name for path in photo_files([tmp_path])] == ["IMG_2.HEIC", "IMG_10.heif"]
