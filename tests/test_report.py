import json
from pathlib import Path

import numpy as np
import pytest
from handmade import CAMERA, ROWS, STACK, alignment

from autoreg.errors import Refusal
from autoreg.jobs.report import RenderReport, aligned_report, refused_report, report_text
from autoreg.rendering.check import RenderCheck

PHOTO = Path("my photo.jpg")
RENDER = RenderReport("preview", ("render.png", "composite.png"), RenderCheck(0.01, 0.03, 40))
FIELDS = {
    "schema_version": None,
    "status": None,
    "reason": None,
    "image": {"path", "width", "height"},
    "camera": {"K", "dist", "source", "consistent", "focal_from_photo_px", "focal_from_photo_sigma_px"},
    "pose": {"R", "t", "covariance"},
    "scale": {"source"},
    "lattice": {"kind", "spacing", "shift", "joint_width", "extent"},
    "residual": {"rms_px", "median_px", "p95_px", "joints", "samples", "inlier_fraction"},
    "joints": None,
    "render": {"engine", "files", "check"},
    "versions": None,
}


def written(report):
    """The report as another program reads it."""
    return json.loads(report_text(report), parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))


def test_an_aligned_report_has_every_field_of_the_contract():
    report = written(aligned_report(PHOTO, alignment(), RENDER))
    for field, parts in FIELDS.items():
        assert field in report
        if parts is not None:
            assert parts <= set(report[field]), field
    assert report["schema_version"] == 1
    assert report["status"] == "aligned"
    assert report["reason"] is None
    assert {"family", "index", "ends_px", "rms_px"} <= set(report["joints"][0])
    assert set(report["render"]["check"]) >= {"rms_px", "max_px", "samples"}
    assert {"autoreg", "opencv", "jax"} <= set(report["versions"])


def test_values_go_through_the_file_unchanged():
    found = alignment()
    report = written(aligned_report(PHOTO, found, RENDER, sha256="0a1b"))
    assert report["image"] == {"path": "my photo.jpg", "width": 640, "height": 480, "sha256": "0a1b"}
    assert np.array_equal(report["camera"]["K"], CAMERA.K)
    assert len(report["camera"]["dist"]) == 8
    assert np.array_equal(report["pose"]["R"], found.pose.cam_from_ground.R)
    assert np.array_equal(report["pose"]["t"], found.pose.cam_from_ground.t)
    assert np.array_equal(report["pose"]["covariance"], found.pose.covariance)
    assert report["lattice"]["spacing"] == [0.6, 0.4]
    assert report["lattice"]["shift"] == 0
    assert np.array_equal(report["lattice"]["extent"], STACK.extent)
    assert np.shape(report["joints"][1]["ends_px"]) == (2, 2)
    assert report["render"]["files"] == ["render.png", "composite.png"]


def test_rows_have_no_spacing_along_x_and_no_shift():
    lattice = written(aligned_report(PHOTO, alignment(ROWS), None))["lattice"]
    assert lattice["spacing"] == [None, 0.4]
    assert lattice["shift"] is None


def test_without_a_render_its_field_is_null():
    assert written(aligned_report(PHOTO, alignment(), None))["render"] is None


@pytest.mark.parametrize("camera", [CAMERA, None], ids=["camera", "no camera"])
def test_a_refused_report_has_every_field_and_the_reason(camera):
    refusal = Refusal("one_direction", "only one family of joints is seen", measured=1.8, limit=5.0)
    report = written(refused_report(PHOTO, 640, 480, refusal, camera))
    assert set(FIELDS) <= set(report)
    assert report["status"] == "refused"
    assert report["reason"] == {
        "code": "one_direction",
        "message": "only one family of joints is seen",
        "measured": 1.8,
        "limit": 5.0,
    }
    assert report["image"]["width"] == 640
    assert (report["camera"] is None) == (camera is None)
    if camera is not None:
        assert FIELDS["camera"] <= set(report["camera"])
    assert report["pose"] is report["lattice"] is report["residual"] is None


def test_what_is_not_finite_is_null_and_names_survive_any_encoding():
    refusal = Refusal("no_lattice", "nichts gefunden: ü", measured=float("nan"), limit=float("inf"))
    text = report_text(refused_report(Path("Straße \udcff.jpg"), 1, 1, refusal, None))
    assert text.isascii()
    assert json.loads(text)["reason"]["measured"] is None
    assert json.loads(text)["image"]["path"] == "Straße \udcff.jpg"
