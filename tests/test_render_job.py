import hashlib
import inspect
import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from handmade import CAMERA, ROWS, RUNNING, STACK, alignment, distorted, photo_for, plan_for, shadow_of
from PIL import Image
from typer.testing import CliRunner

from autoreg.command.cli import app
from autoreg.command.cli_render import _completed
from autoreg.errors import InputError, RenderError
from autoreg.jobs import render_job
from autoreg.jobs.alignment_file import read_alignment
from autoreg.jobs.options import parse_lens, parse_sun
from autoreg.jobs.report import aligned_report, report_text
from autoreg.rendering.objects import Scene
from autoreg.rendering.preview import PreviewEngine
from autoreg.rendering.render import plan_render, render
from autoreg.rendering.staging import stage
from autoreg.view import View

WISH = render_job.Wish()
BALL = '[[object]]\nshape = "sphere"\nradius = 0.2\nslab = [0, 0]\n'


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A photo, its alignment in out/, and a scene."""
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("photo.png", photo_for(CAMERA))
    Path("out").mkdir()
    Path("out/alignment.json").write_text(report_text(aligned_report(Path("photo.png"), alignment(), None)))
    Path("scene.toml").write_text(BALL)
    return tmp_path


def run(*arguments):
    done = CliRunner().invoke(
        app, ["render", "out/alignment.json", "--engine", "preview", *map(str, arguments)]
    )
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done


@pytest.mark.parametrize("lattice", [STACK, RUNNING, ROWS], ids=["stack", "running", "rows"])
def test_an_alignment_is_read_back_as_it_was_written(tmp_path, lattice):
    found = alignment(lattice, distorted())
    path = tmp_path / "alignment.json"
    text = report_text(aligned_report(Path("x y.jpg"), found, None))
    path.write_text(text)
    saved = read_alignment(path)
    assert report_text(aligned_report(saved.photo, saved.alignment, None)) == text
    assert saved.alignment.camera.camera == found.camera.camera
    assert np.array_equal(saved.alignment.pose.cam_from_ground.R, found.pose.cam_from_ground.R)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "no JSON"),
        ("[]", "no alignment.json"),
        ('{"schema_version": 9}', "schema_version 9"),
        ('{"schema_version": 1, "status": "refused", "reason": {"message": "gravel"}}', "refused: gravel"),
        ('{"schema_version": 1, "status": "aligned"}', "damaged"),
    ],
)
def test_what_is_no_alignment_is_said(tmp_path, text, words):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(InputError, match=words):
        read_alignment(tmp_path / "a.json")


def test_render_writes_the_scene_and_two_pictures_and_says_so_in_the_report(folder):
    done = run("--scene", "scene.toml", "--sun", "200,40")
    assert done.exit_code == 0, done.stderr
    names = {p.name for p in Path("out").iterdir()}
    assert names == {"alignment.json", "scene.pov", "scene-photo.png", "render.png", "composite.png"}
    report = json.loads(Path("out/alignment.json").read_text())
    assert report["render"]["engine"] == "preview"
    assert report["render"]["check"]["rms_px"] < 0.02
    assert report["pose"]["R"] == alignment().pose.cam_from_ground.R.tolist()
    layer, composite = cv2.imread("out/render.png", cv2.IMREAD_UNCHANGED), cv2.imread("out/composite.png")
    clear = layer[..., 3] == 0
    assert (composite[clear] == photo_for()[clear]).all()
    assert (~clear).sum() > 2000


def test_the_sun_by_a_shadow_is_said_to_be_an_estimate(folder):
    shadow = shadow_of((0.2, 0.1), 0.7, 205.0, 40.0)
    pixels = {"foot": shadow.foot_px, "top": shadow.top_px, "tip": shadow.tip_px}
    inside = ", ".join(f"{key} = [{u}, {v}]" for key, (u, v) in pixels.items())
    Path("sunny.toml").write_text(f"[light]\nshadow = {{ {inside} }}\n{BALL}")
    done = run("--scene", "sunny.toml")
    assert done.exit_code == 0, done.stderr
    assert "the sun is estimated by the shadow: azimuth" in done.stderr
    sun = json.loads(Path("out/alignment.json").read_text())["render"]["sun"]
    assert sun["source"] == "shadow"
    assert sun["elevation_deg"] == pytest.approx(40.0, abs=1e-6)
    assert 0 < min(sun["sigma_deg"]) <= max(sun["sigma_deg"]) < 5
    # What is said on the command line holds.
    assert run("--scene", "sunny.toml", "--sun", "10,50").exit_code == 0
    sun = json.loads(Path("out/alignment.json").read_text())["render"]["sun"]
    assert sun == {"azimuth_deg": 10.0, "elevation_deg": 50.0, "source": "given", "sigma_deg": None}


def test_an_empty_scene_leaves_the_photo_bit_for_bit(folder):
    Path("scene.toml").write_text("")
    assert run("--scene", "scene.toml").exit_code == 0
    assert (cv2.imread("out/composite.png") == photo_for()).all()


def test_lines_alone_and_the_demo_besides_a_scene(folder):
    Path("scene.toml").write_text("")
    for option in ("--lines", "--demo-object"):
        assert run("--scene", "scene.toml", option).exit_code == 0
        assert (cv2.imread("out/composite.png") != photo_for()).any(-1).sum() > 2000


@pytest.mark.parametrize(
    "arguments",
    [
        ["--scene", "missing.toml"],
        ["--scene", "bad.toml"],
        ["--scene", "far.toml"],
        ["--sun", "here"],
        ["--sun", "10,-4"],
        ["--dof", "0"],
        ["--dof"],
        ["--photo", "small.png"],
        ["--photo", "missing.png"],
        ["--timeout", "-1"],
    ],
)
def test_a_mistake_exits_2_in_words_and_changes_nothing(folder, arguments):
    Path("bad.toml").write_text("[[object]]\nshape = 3\n")
    Path("far.toml").write_text(BALL.replace("[0, 0]", "[900, 0]"))
    cv2.imwrite("small.png", photo_for()[:200])
    before = {p.name: p.read_bytes() for p in Path("out").iterdir()}
    done = run(*arguments)
    assert done.exit_code == 2, done.stderr
    assert len(done.stderr) > 20
    assert {p.name: p.read_bytes() for p in Path("out").iterdir()} == before


def test_a_failed_render_exits_4_and_leaves_no_picture_of_an_earlier_scene(folder, monkeypatch):
    assert run("--scene", "scene.toml").exit_code == 0

    def fail(*_, **__):
        raise RenderError("no luck")

    monkeypatch.setattr(render_job, "render", fail)
    done = run("--scene", "scene.toml")
    assert done.exit_code == 4
    assert "no luck" in done.stderr
    assert not Path("out/composite.png").exists()
    assert json.loads(Path("out/alignment.json").read_text())["render"] is None


def test_a_render_that_cannot_be_written_leaves_the_last_one_as_it_was(folder, monkeypatch):
    assert run("--scene", "scene.toml").exit_code == 0
    before = {path.name: path.read_bytes() for path in Path("out").iterdir()}
    written = render_job.write_png

    def full(path, image):
        if path.name == "composite.png":
            raise OSError(28, "No space left on device", str(path))
        return written(path, image)

    monkeypatch.setattr(render_job, "write_png", full)
    done = run("--lines")
    assert done.exit_code == 2
    assert "No space left on device: 'out/composite.png'" in done.stderr
    assert {path.name: path.read_bytes() for path in Path("out").iterdir()} == before


def test_what_an_earlier_scene_named_does_not_stay_beside_another_one(folder):
    assert run("--scene", "scene.toml").exit_code == 0
    Path("out/scene-thing_cup.inc").write_text("a mesh of an earlier scene")
    Path("out/overlay.png").write_bytes(b"the alignment's")
    assert run("--lines").exit_code == 0
    assert not Path("out/scene-thing_cup.inc").exists()
    assert Path("out/overlay.png").read_bytes() == b"the alignment's"


def test_the_photo_is_found_from_elsewhere_and_another_folder_gets_everything(folder, monkeypatch):
    (folder / "deep").mkdir()
    monkeypatch.chdir(folder / "deep")
    done = CliRunner().invoke(
        app, ["render", "../out/alignment.json", "-o", "-new é", "--engine", "preview", "--demo-object"]
    )
    assert done.exit_code == 0, done.stderr
    assert (folder / "deep" / "-new é" / "alignment.json").is_file()
    assert json.loads((folder / "out" / "alignment.json").read_text())["render"] is None


def test_the_photo_is_found_from_within_the_folder_of_results(folder, monkeypatch):
    monkeypatch.chdir(folder / "out")
    done = CliRunner().invoke(app, ["render", "alignment.json", "--engine", "preview"])
    assert done.exit_code == 0, done.stderr


def test_the_lens_comes_from_exif_unless_it_is_given(folder):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x829D: 4.0, 0x920A: 24.0})
    Image.fromarray(photo_for()[..., ::-1]).save("photo.png", "JPEG", exif=exif)
    for options, aperture in ((["--dof"], 0.006), (["--dof", "2"], 0.012), (["--dof", "2,50"], 0.025)):
        done = run("--scene", "scene.toml", *options)
        assert done.exit_code == 0, done.stderr
        assert f"#declare Aperture = {aperture!r};" in Path("out/scene.pov").read_text()
        assert "no depth of field" in done.stderr


def test_option_values_are_read():
    assert parse_sun(" 200, 40") == (200.0, 40.0)
    assert parse_lens("exif") == (None, None)
    assert parse_lens("2.8") == (2.8, None)
    assert parse_lens("2.8,24") == (2.8, 24.0)


def test_another_photo_of_the_same_name_is_not_taken_for_the_aligned_one(folder, monkeypatch):
    digest = hashlib.sha256(Path("photo.png").read_bytes()).hexdigest()
    report = aligned_report(Path("photo.png"), alignment(), None, sha256=digest)
    Path("out/alignment.json").write_text(report_text(report))
    Path("elsewhere").mkdir()
    cv2.imwrite("elsewhere/photo.png", 255 - photo_for(CAMERA))
    monkeypatch.chdir("elsewhere")
    wanted = read_alignment(Path("../out/alignment.json"))
    path, found = render_job._photo_of(render_job.RenderJob(Path("../out/alignment.json"), WISH), wanted)
    assert path.samefile(folder / "photo.png")
    assert (found.colour() == photo_for(CAMERA)).all()
    (folder / "photo.png").unlink()
    with pytest.raises(InputError, match=r"not the photo that was aligned.*--photo"):
        render_job._photo_of(render_job.RenderJob(Path("../out/alignment.json"), WISH), wanted)


def test_the_report_names_the_photo_that_is_shown_and_a_note_says_that_it_is_another(folder):
    digest = hashlib.sha256(Path("photo.png").read_bytes()).hexdigest()
    report = aligned_report(Path("photo.png"), alignment(), None, sha256=digest)
    Path("out/alignment.json").write_text(report_text(report))
    Path("moved.png").write_bytes(Path("photo.png").read_bytes())
    done = run("--photo", "moved.png")
    image = json.loads(Path("out/alignment.json").read_text())["image"]
    assert (image["path"], image["sha256"]) == ("moved.png", digest)
    assert "byte for byte" not in done.stderr
    cv2.imwrite("other.png", 255 - photo_for(CAMERA))
    done = run("--photo", "other.png")
    assert "note: other.png is not, byte for byte, the photo that was aligned" in done.stderr
    image = json.loads(Path("out/alignment.json").read_text())["image"]
    assert image["path"] == "other.png"
    assert image["sha256"] == hashlib.sha256(Path("other.png").read_bytes()).hexdigest()
    assert (image["width"], image["height"]) == (640, 480)


def test_a_folder_in_the_way_of_a_result_is_named_before_anything_is_written(folder):
    Path("out/scene.pov").mkdir()
    before = {p.name for p in Path("out").iterdir()}
    done = run()
    assert done.exit_code == 2
    assert "the folder out/scene.pov is in the way" in done.stderr
    assert {p.name for p in Path("out").iterdir()} == before


@pytest.mark.parametrize("lens", ["1e-9,24", "0.1,1000", "1e-300,24", "1e-320"])
def test_a_lens_that_would_blur_all_is_refused_with_the_width_of_its_discs(folder, lens):
    done = run("--dof", lens if "," in lens else f"{lens},24")
    assert done.exit_code == 2
    assert re.search(r"discs of blur up to (\S+ pixels wide|inf).*more than 160 ", done.stderr)
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x829D: 0.001, 0x920A: 24.0})
    Image.fromarray(photo_for()[..., ::-1]).save("photo.png", "JPEG", exif=exif)
    assert "24 mm at f/0.001" in run("--dof").stderr


@pytest.mark.parametrize(("text", "aperture"), [(".5,24", "0.048"), ("f/2,24", "0.012"), ("F/4,24", "0.006")])
def test_an_f_number_may_be_written_as_on_a_lens(folder, text, aperture):
    for options in (["--dof", text], [f"--dof={text}"]):
        assert run("--scene", "scene.toml", *options).exit_code == 0
        assert f"#declare Aperture = {aperture};" in Path("out/scene.pov").read_text()


def test_what_follows_the_bare_option_is_the_next_argument():
    assert _completed(["--dof", "exif", "x"]) == ["--dof=exif", "exif", "x"]
    assert _completed(["--dof", "f/photo.jpg"]) == ["--dof=exif", "f/photo.jpg"]
    assert _completed(["--dof", "-1", "--", "--dof"]) == ["--dof=-1", "--", "--dof"]
    assert _completed(["--lines", "--dof"]) == ["--lines", "--dof=exif"]


def test_a_negative_f_number_is_answered_and_not_taken_for_an_option(folder):
    done = run("--dof", "-1,24")
    assert done.exit_code == 2
    assert "--dof wants an f-number" in done.stderr


def test_a_photo_among_the_results_is_not_painted_over(folder):
    cv2.imwrite("out/composite.png", photo_for(CAMERA))
    before = Path("out/composite.png").read_bytes()
    done = run("--photo", "out/composite.png")
    assert done.exit_code == 2
    assert "written over" in done.stderr
    assert Path("out/composite.png").read_bytes() == before


@pytest.mark.parametrize(
    ("where", "value"),
    [
        (("lattice", "kind"), "foo"),
        (("lattice", "spacing"), [0.0, 0.5]),
        (("lattice", "spacing"), ["a", "b"]),
        (("lattice", "spacing"), [None, 0.5]),
        (("lattice", "extent"), []),
        (("lattice", "extent"), [[0, 0], [None, 1], [1, 1]]),
        (("lattice", "extent"), [[-1e9, -1e9], [1e9, -1e9], [1e9, 1e9]]),
        (("lattice", "joint_width"), None),
        (("pose", "R"), [[1, 0, 0], [0, 1, 0], [0, 0, -1]]),
        (("pose", "t"), [0.0, None, 1.0]),
        (("image",), "photo.png"),
    ],
)
def test_a_damaged_alignment_is_said_to_be(folder, where, value):
    report = json.loads(Path("out/alignment.json").read_text())
    part = report
    for key in where[:-1]:
        part = part[key]
    part[where[-1]] = value
    Path("out/alignment.json").write_text(json.dumps(report))
    done = run()
    assert done.exit_code == 2
    assert "damaged" in done.stderr


@pytest.mark.parametrize("wrong", [photo_for()[..., 0], photo_for() / 255.0, photo_for()[..., [0, 1, 2, 2]]])
def test_a_picture_that_is_not_in_colour_is_said_to_be_none(wrong):
    plan, view = plan_for(), View(CAMERA, alignment().pose.cam_from_ground)
    calls = (
        lambda: inspect.unwrap(stage)(Scene(), view, STACK, wrong),
        lambda: inspect.unwrap(plan_render)(alignment(), plan.staging, wrong),
        lambda: inspect.unwrap(render)(PreviewEngine(), plan, wrong),
    )
    for call in calls:
        with pytest.raises(ValueError, match=r"photo must be in colour.*load_photo\(path\).colour\(\)"):
            call()


REFUSED = '{"schema_version": 1, "status": "refused", "reason": "gravel"}'


@pytest.mark.parametrize("text", [REFUSED, "[" * 9999])
def test_nor_does_any_other_text_end_in_a_traceback(folder, text):
    Path("out/alignment.json").write_text(text)
    assert run().exit_code == 2
