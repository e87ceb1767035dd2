import json
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from autoreg.calibration.claims import read_claims
from autoreg.calibration.focal import FocalLength, angle_deg, focal_from_angle
from autoreg.calibration.inspection import inspect_camera
from autoreg.camera import Camera
from autoreg.camera_files import write_camera_json
from autoreg.errors import InputError

FIXTURE = Path(__file__).parents[1] / "fixtures" / "thesis.claims.json"
GOOD = Camera(1600, 1200, 1200.0, 1200.5, 805.0, 596.0, (-0.1, 0.02, 0.0, 0.0, 0.0))


def said(camera, tmp_path, photo=None):
    path = tmp_path / "camera.json"
    write_camera_json(camera, path)
    return inspect_camera(read_claims(path), photo)


def texts(found, weight):
    return " | ".join(oddity.text for oddity in found.oddities if oddity.weight == weight)


@pytest.fixture
def photo(tmp_path):
    """A photo of 1600 x 1200 whose EXIF says 4.1 mm and 26 mm in 35 mm equivalent: 1202 px."""
    exif = Image.Exif()
    details = exif.get_ifd(0x8769)
    details[0x920A], details[0xA405] = 4.1, 26
    details[0xA002], details[0xA003] = 1600, 1200
    path = tmp_path / "photo.jpg"
    Image.new("L", (1600, 1200), 128).save(path, exif=exif)
    return path


def test_the_published_figures_contradict_themselves_by_name():
    found = inspect_camera(read_claims(FIXTURE))
    wrong = texts(found, "wrong")
    assert found.contradictory
    for part in ("(537, 1208)", "fx and fy differ by 3.0 %", "k3 = 16", "76.68°", "2875.9 px", "4.1 mm"):
        assert part in wrong, part
    assert "+7.6 %" in wrong
    assert "RMS of about 1.66 px" in texts(found, "odd")
    assert "orientations mixed" in wrong


def test_every_figure_of_the_fixture_is_the_published_one():
    facts = json.loads(FIXTURE.read_text())
    assert (facts["width"], facts["height"], facts["cx"], facts["cy"]) == (4896, 2752, 537, 1208)
    assert (facts["k3"], facts["mean_error_px"], facts["focal_px"]) == (16, 0.2254, 2875.9)
    assert (facts["exif_focal_mm"], facts["angle_of_view_deg"]) == (4.1, 76.68)
    assert "fx" not in facts
    assert "k1" not in facts


def test_nothing_is_odd_about_a_good_camera(tmp_path, photo):
    found = said(GOOD, tmp_path, photo)
    assert {oddity.weight for oddity in found.oddities} <= {"note"}
    assert found.exif_focal_px == pytest.approx(1201.8, abs=0.5)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"cx": 300.0}, "principal point"),
        ({"fy": 1260.0}, "fx and fy differ"),
        ({"dist": (-0.9, 0.0, 0.0, 0.0, 0.0)}, "folds back"),
        ({"fx": 1700.0, "fy": 1700.0}, "EXIF supports"),
        ({"width": 1600, "height": 900}, "aspect ratios"),
        ({"width": 1200, "height": 1600, "cx": 600.0, "cy": 800.0}, "on its side"),
    ],
)
def test_each_oddity_is_named(change, expected, tmp_path, photo):
    from dataclasses import replace

    assert expected in texts(said(replace(GOOD, **change), tmp_path, photo), "wrong")


def test_a_camera_of_another_size_is_translated_to_the_photo(tmp_path, photo):
    found = said(GOOD.scaled(3200, 2400), tmp_path, photo)
    assert found.focal.px == pytest.approx(1200.0)
    assert "scaled" in texts(found, "note")


@pytest.mark.parametrize(
    ("focal", "word"), [(1202.0, "supported"), (1300.0, "doubtful"), (1500.0, "contradicted")]
)
def test_exif_says_which_claimed_focal_lengths_it_supports(focal, word, tmp_path, photo):
    path = tmp_path / "claims.json"
    claimed = {"width": 3200, "height": 2400, "focal_px": 2 * 1202, "exif_focal_mm": 4.1}
    path.write_text(json.dumps(claimed | {"angle_of_view_deg": angle_deg(2 * focal, 3200.0)}))
    found = inspect_camera(read_claims(path), photo)
    assert [support.word for support in found.supports] == ["supported", word, "supported"]
    assert f"{focal / 1202 - 1:+.1%}".replace("%", " %") in found.supports[1].sentence


def test_a_photo_of_another_shape_is_wrong_and_gives_no_units(tmp_path):
    other = tmp_path / "other.png"
    Image.new("L", (800, 602), 128).save(other)
    found = inspect_camera(read_claims(FIXTURE), other)
    assert "aspect ratios differ" in texts(found, "wrong")
    assert (found.focal.width, found.focal.px) == (4896, 2875.9)


def test_one_focal_length_in_four_units():
    focal = FocalLength(4896 / 7.0 * 4.1, 4896.0, 2752.0, 4.1)
    assert focal.sensor_mm[0] == pytest.approx(7.0)
    assert focal.pixel_um == pytest.approx(7000 / 4896)
    full_frame = FocalLength(6000 * 50 / 36, 6000.0, 4000.0, 50.0)
    assert full_frame.equivalent_mm == pytest.approx(50.0)
    assert full_frame.angles_deg[0] == pytest.approx(39.5978, abs=1e-3)
    assert full_frame.angles_deg[1] == pytest.approx(26.9915, abs=1e-3)
    assert FocalLength(1000.0, 100.0, 100.0).sensor_mm is None


@given(st.floats(50.0, 20000.0), st.floats(100.0, 10000.0))
def test_angle_and_focal_length_are_each_others_inverse(focal_px, side_px):
    assert focal_from_angle(angle_deg(focal_px, side_px), side_px) == pytest.approx(focal_px, rel=1e-9)


def test_parts_of_a_camera_are_enough(tmp_path):
    path = tmp_path / "part.json"
    path.write_text(json.dumps({"fx": 1000, "width": 1000, "height": 800}))
    found = inspect_camera(read_claims(path))
    assert found.focal.angles_deg[0] == pytest.approx(math.degrees(2 * math.atan(0.5)))
    assert "not stated: fy, cx, cy" in texts(found, "note")
    path.write_text(json.dumps({"cx": 12}))
    assert inspect_camera(read_claims(path)).focal is None


@pytest.mark.parametrize(
    "text", ["{}", '{"fx": "wide"}', '{"fx": -3}', "no camera", '{"width": 100, "fx": null}']
)
def test_a_file_that_claims_nothing_is_refused(text, tmp_path):
    path = tmp_path / "camera.json"
    path.write_text(text)
    if text == '{"width": 100, "fx": null}':
        assert inspect_camera(read_claims(path)).focal is None
        return
    with pytest.raises(InputError):
        inspect_camera(read_claims(path))
