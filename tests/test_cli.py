import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from handmade import CAMERA, POSE, RUNNING, alignment, distorted, photo_for
from PIL import Image
from test_image import exif_with
from typer.testing import CliRunner

import autoreg.align
from autoreg.command.cli import app
from autoreg.command.cli_messages import hand_over
from autoreg.errors import InputError, Refusal
from autoreg.jobs import job, render_job
from autoreg.jobs.outputs import write_whole
from autoreg.rendering import render as rendering
from autoreg.solve import solver

ALWAYS = {"alignment.json", "overlay.png", "scene.pov", "scene-photo.png"}


@pytest.fixture
def photo(tmp_path, monkeypatch):
    """A photo in the working folder, and no compiling in the background."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(job, "_warm_up", lambda ended: None)
    cv2.imwrite("photo.png", photo_for(CAMERA))
    return Path("photo.png")


@pytest.fixture
def aligned(monkeypatch):
    """The pipeline answers with a running bond; what it was asked for is kept."""
    asked = {}

    def align(sight, camera, **options):
        asked.update(options, shape=sight.gray.shape, camera=camera)
        return alignment(RUNNING)

    monkeypatch.setattr(autoreg.align, "align_seen", align)
    return asked


def refusing(error):
    def align(*_, **__):
        raise error

    return align


def run(*arguments):
    done = CliRunner().invoke(app, [str(a) for a in arguments])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done


def files(folder):
    return {path.name for path in Path(folder).iterdir()}


def test_an_aligned_photo_exits_0_and_writes_beside_the_working_folder(photo, aligned):
    done = run("align", photo, "--slab", "0.3x0.6")
    assert done.exit_code == 0, done.stderr
    assert files("photo.png.autoreg") == ALWAYS
    assert json.loads(Path("photo.png.autoreg/alignment.json").read_text())["status"] == "aligned"
    assert aligned["slab"] == (0.3, 0.6)
    assert aligned["camera_height"] is None
    assert aligned["ground"] is False
    assert aligned["shape"] == (480, 640)
    assert done.stdout == ""
    assert "0.6 x 0.3 m" in done.stderr


def test_who_vouches_for_the_ground_is_heard(photo, aligned):
    assert run("align", photo, "--ground", "-o", "out").exit_code == 0
    assert aligned["ground"] is True


def test_json_prints_the_report_and_nothing_else(photo, aligned):
    done = run("align", photo, "--json", "-o", "out")
    assert done.stdout == Path("out/alignment.json").read_text()
    assert "wrote" in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no disk is always full here")
def test_a_stdout_that_takes_nothing_is_said_with_the_place_of_the_results(tmp_path):
    code = (
        "from pathlib import Path\nimport autoreg.__main__ as program, autoreg.command.cli as cli\n"
        "def main():\n  with cli._exit_codes(): cli.hand_over('{}', Path('out'))\n"
        "import typer\n"
        "try: main()\n"
        "except typer.Exit as end: program._leave(end.exit_code)\n"
    )
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-c", code],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            env=os.environ | {"PYTHONPATH": str(Path(job.__file__).parents[2])},
        )
    assert done.returncode == 2
    assert done.stderr == (
        "error: stdout cannot be written: No space left on device; the results are in out\n"
    )


@pytest.mark.parametrize("name", ["alignment.json", "overlay.png", "scene.pov", "scene-photo.png"])
def test_a_folder_in_the_way_of_a_result_is_named_and_nothing_is_written(photo, aligned, name):
    Path("out", name).mkdir(parents=True)
    done = run("align", photo, "-o", "out")
    assert done.exit_code == 2
    assert f"the folder out/{name} is in the way" in done.stderr
    assert files("out") == {name}


@pytest.mark.parametrize("option", ["-o", "--camera", "--scene"])
def test_an_empty_path_is_not_taken_for_the_working_folder(photo, aligned, option):
    before = files(".")
    for given in ("", " "):
        done = run("align", photo, option, given)
        assert done.exit_code == 2
        assert f"{option} is empty" in done.stderr
    assert files(".") == before
    assert "PHOTO is empty" in run("align", "").stderr
    assert "--photo is empty" in run("render", "alignment.json", "--photo", "").stderr
    assert "-o is empty" in run("calibrate", "boards", "-o", "").stderr


@pytest.mark.parametrize(("larger", "said"), [(1.0, False), (100.0, True), (0.01, True)])
def test_a_height_at_which_no_photo_is_taken_casts_doubt_on_the_slab(photo, monkeypatch, larger, said):
    lattice = replace(
        RUNNING,
        spacing_x=0.6 * larger,
        spacing_y=0.3 * larger,
        joint_width=0.006 * larger,
        extent=larger * RUNNING.extent,
    )
    found = alignment(lattice, pose=replace(POSE, t=larger * POSE.t))
    monkeypatch.setattr(autoreg.align, "align_seen", lambda *_, **__: found)
    done = run("align", photo, "-o", "out", "--slab", "0.6x0.3")
    assert done.exit_code == 0, done.stderr
    assert ("metres above the ground; --slab is in metres" in done.stderr) == said


def test_json_for_a_closed_stdout_goes_nowhere(monkeypatch):
    monkeypatch.setattr("sys.stdout", None)
    hand_over("{}")


@pytest.mark.parametrize("name", ["it's a;b $(c).png", '[red]say "x" Straße Ω.png'])
def test_any_file_name_is_taken_as_it_is(photo, aligned, name):
    photo.rename(name)
    done = run("align", name, "--render", "--engine", "preview")
    assert done.exit_code == 0, done.stderr
    assert json.loads(Path(f"{name}.autoreg/alignment.json").read_text())["image"]["path"] == name


def test_a_name_that_begins_with_a_dash_goes_after_two_dashes(photo, aligned):
    photo.rename("-photo.png")
    assert run("align", "--", "-photo.png").exit_code == 0
    assert files("-photo.png.autoreg") == ALWAYS


def test_a_refusal_exits_3_with_the_reason_and_leaves_no_other_file(photo, aligned, monkeypatch):
    assert run("align", photo, "-o", "out", "--render", "--engine", "preview").exit_code == 0
    refusal = Refusal("too_few_joints", "only 2 joints are seen; step back", measured=2.0, limit=4.0)
    monkeypatch.setattr(autoreg.align, "align_seen", refusing(refusal))
    done = run("align", photo, "-o", "out", "--json")
    assert done.exit_code == 3
    assert files("out") == {"alignment.json"}
    report = json.loads(done.stdout)
    assert (report["status"], report["reason"]["code"]) == ("refused", "too_few_joints")
    assert "only 2 joints are seen; step back" in done.stderr
    assert "measured 2, limit 4" in done.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["missing.png"],
        ["photo.png", "--slab", "0.6xx"],
        ["photo.png", "--slab", "0.6", "--camera-height", "1.5"],
        ["photo.png", "--camera-height", "-1"],
        ["photo.png", "--camera-height", "high"],
        ["photo.png", "--crop", "0,0,10,10"],
        ["photo.png", "--camera", "missing.json"],
        ["photo.png", "--camera", "broken.json"],
        ["photo.png", "--camera", "small.json"],
        ["photo.png", "--engine", "preview"],
        ["photo.png", "--render", "--engine", "blender"],
        ["photo.png", "-o", "photo.png"],
        ["photo.png", "-o", "photo.png/below"],
        ["photo.png", "--unknown"],
        ["empty.png"],
        ["notes.txt"],
        ["."],
    ],
)
def test_bad_input_exits_2_in_words_and_writes_nothing(photo, aligned, arguments):
    Path("empty.png").touch()
    Path("notes.txt").write_text("not a picture")
    Path("broken.json").write_text('{"width": 640')
    Path("small.json").write_text(
        json.dumps({"width": 100, "height": 99, "fx": 90, "fy": 90, "cx": 50, "cy": 50, "dist": []})
    )
    before = files(".")
    done = run("align", *arguments)
    assert done.exit_code == 2
    assert files(".") == before
    assert len(done.stderr) > 20
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


def test_a_camera_reaches_the_pipeline_fitted_to_the_photo(photo, aligned):
    twice = {"width": 1280, "height": 960, "fx": 1200, "fy": 1202, "cx": 639.5, "cy": 479.5, "dist": [0.1]}
    Path("camera.json").write_text(json.dumps(twice | {"dist": [0.1, 0, 0, 0, 0]}))
    done = run("align", photo, "--camera", "camera.json")
    assert done.exit_code == 0, done.stderr
    assert (aligned["camera"].width, aligned["camera"].fx) == (640, 600)
    assert "scaled" in done.stderr


@pytest.mark.parametrize(
    ("recorded", "said"),
    [
        ({"FOCAL_35": 28}, "note: EXIF: 28 mm on 35 mm film is 518 px"),
        (
            {"FOCAL_35": 28, "PIXELS_X": 4000, "PIXELS_Y": 2000},
            "4000 x 2000 but the file is 640 x 480: it was cropped",
        ),
        ({"FOCAL": 4.2}, "EXIF's focal length of 4.2 mm comes without a usable sensor size"),
        ({}, None),
    ],
)
@pytest.mark.parametrize("told", [False, True])
def test_what_exif_says_of_the_focal_length_is_told_unless_a_camera_is_given(
    photo, aligned, recorded, said, told
):
    Image.open(photo).save(photo, exif=exif_with(1, **recorded))
    Path("camera.json").write_text(
        json.dumps({"width": 640, "height": 480, "fx": 600, "fy": 600, "cx": 320, "cy": 240, "dist": []})
    )
    done = run("align", photo, *(("--camera", "camera.json") if told else ()))
    assert done.exit_code == 0, done.stderr
    if said is None or told:
        assert "EXIF" not in done.stderr
    else:
        assert said in done.stderr


def test_a_contradicted_camera_is_said_loudly(photo, monkeypatch):
    monkeypatch.setattr(autoreg.align, "align_seen", lambda *_, **__: alignment(consistent=False))
    done = run("align", photo, "-o", "out")
    assert done.exit_code == 0
    assert "WARNING: the photo's own joints contradict the given camera" in done.stderr
    assert "650 px (± 12); the camera says 610 px" in done.stderr
    assert json.loads(Path("out/alignment.json").read_text())["camera"]["consistent"] is False


def test_render_adds_two_pictures_and_its_check(photo, aligned):
    done = run("align", photo, "-o", "out", "--render", "--engine", "preview")
    assert done.exit_code == 0, done.stderr
    assert files("out") == ALWAYS | {"render.png", "composite.png"}
    made = json.loads(Path("out/alignment.json").read_text())["render"]
    assert made["engine"] == "preview"
    assert made["files"] == ["render.png", "composite.png"]
    assert made["check"]["rms_px"] < 0.05
    layer = cv2.imread("out/render.png", cv2.IMREAD_UNCHANGED)
    composite = cv2.imread("out/composite.png")
    original = cv2.imread("photo.png")
    clear = layer[..., 3] == 0
    assert layer.shape == (480, 640, 4)
    assert 500 < (~clear).sum() < 640 * 480 / 2
    assert (composite[clear] == original[clear]).all()
    assert (composite[~clear] != original[~clear]).mean() > 0.5


def test_insisting_on_a_missing_engine_exits_4_and_writes_all_else(photo, aligned, monkeypatch):
    monkeypatch.setattr(rendering, "find_povray", lambda: None)
    done = run("align", photo, "-o", "out", "--render", "--engine", "povray")
    assert done.exit_code == 4
    assert files("out") == ALWAYS
    assert json.loads(Path("out/alignment.json").read_text())["render"] is None
    assert "not installed" in done.stderr


def test_without_povray_auto_says_that_it_renders_a_preview(photo, aligned, monkeypatch):
    monkeypatch.setattr(rendering, "find_povray", lambda: None)
    done = run("align", photo, "-o", "out", "--render")
    assert done.exit_code == 0
    assert "POV-Ray is not installed" in done.stderr
    assert json.loads(Path("out/alignment.json").read_text())["render"]["engine"] == "preview"


def test_a_distorted_lens_gets_an_undistorted_backdrop(photo, monkeypatch):
    monkeypatch.setattr(autoreg.align, "align_seen", lambda *_, **__: alignment(camera=distorted()))
    assert run("align", photo, "-o", "out").exit_code == 0
    assert files("out") == {"alignment.json", "overlay.png", "scene.pov", "scene-undistorted.png"}
    assert '"scene-undistorted.png"' in Path("out/scene.pov").read_text()


def test_the_scene_without_distortion_names_the_untouched_photo(photo, aligned):
    assert run("align", photo, "-o", "out").exit_code == 0
    assert (cv2.imread("out/scene-photo.png") == cv2.imread("photo.png")).all()


def test_ctrl_c_exits_130_with_nothing_half_written(photo, aligned, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(job, "overlay_picture", interrupt)
    done = run("align", photo, "-o", "out")
    assert done.exit_code == 130
    assert not Path("out").exists()


def test_a_full_disk_is_said_in_one_line(photo, aligned, monkeypatch):
    def full(path, content):
        if path.name == "scene.pov":
            raise OSError(28, "No space left on device")
        return write_whole(path, content)

    monkeypatch.setattr(render_job, "write_whole", full)
    done = run("align", photo, "-o", "out")
    assert done.exit_code == 2
    assert "No space left on device" in done.stderr
    assert not Path("out").exists()


def test_until_all_of_a_run_is_written_an_earlier_ones_results_stay(photo, aligned, monkeypatch):
    assert run("align", photo, "-o", "out", "--render", "--engine", "preview").exit_code == 0
    before = {path.name: path.read_bytes() for path in Path("out").iterdir()}

    def full(path, content):
        raise OSError(28, "No space left on device", str(path))

    with monkeypatch.context() as patched:
        patched.setattr(render_job, "write_whole", full)
        done = run("align", photo, "-o", "out")
        assert done.exit_code == 2
        assert "No space left on device: 'out/" in done.stderr
        assert {path.name: path.read_bytes() for path in Path("out").iterdir()} == before
        assert run("align", photo, "-o", "fresh").exit_code == 2
        assert not Path("fresh").exists()
    assert run("align", photo, "-o", "out").exit_code == 0
    assert files("out") == ALWAYS


def test_an_edited_scene_is_kept_under_another_name(photo, aligned):
    def edit(text):
        # At once, and as old as the report: when a file was written tells nothing once it was copied.
        scene, report = Path("out/scene.pov"), Path("out/alignment.json")
        scene.write_text(text)
        os.utime(scene, (report.stat().st_mtime, report.stat().st_mtime))

    assert run("align", photo, "-o", "out").exit_code == 0
    edit("mine")
    done = run("align", photo, "-o", "out")
    assert "scene.pov was changed after it had been written; it is kept as scene-edited-1.pov" in done.stderr
    assert Path("out/scene-edited-1.pov").read_text() == "mine"
    assert files("out") == ALWAYS | {"scene-edited-1.pov"}
    edit("mine again")
    assert run("render", "out/alignment.json", "--engine", "preview").exit_code == 0
    assert Path("out/scene-edited-2.pov").read_text() == "mine again"
    assert "kept" not in run("align", photo, "-o", "out").stderr


@pytest.mark.parametrize(("cx", "said"), [(-5000.0, True), (0.1 * CAMERA.width, False)])
def test_a_camera_whose_axis_passes_beside_the_photo_is_wondered_at(photo, aligned, cx, said):
    fields = {name: getattr(CAMERA, name) for name in ("width", "height", "fx", "fy", "cy")}
    Path("camera.json").write_text(json.dumps(fields | {"cx": cx, "dist": []}))
    done = run("align", photo, "--camera", "camera.json", "-o", "out")
    assert ("principal point, (-5000, " in done.stderr) == said


@pytest.mark.parametrize(
    ("k1", "said"),
    [
        (5.0, "moves a corner of the photo outwards by "),
        (-1.0, "folds back within the photo"),
        (-0.25, None),
        (0.1, None),
    ],
)
def test_a_distortion_that_is_no_lens_is_wondered_at(photo, aligned, k1, said):
    fields = {name: getattr(CAMERA, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    Path("camera.json").write_text(json.dumps(fields | {"dist": [k1, 0.0, 0.0, 0.0]}))
    done = run("align", photo, "--camera", "camera.json", "-o", "out")
    assert ("distortion" in done.stderr) == (said is not None)
    assert said is None or said in done.stderr


def test_a_camera_height_in_centimetres_is_wondered_at(photo, monkeypatch):
    found = replace(alignment(pose=replace(POSE, t=100.0 * POSE.t)), scale_source="camera_height")
    monkeypatch.setattr(autoreg.align, "align_seen", lambda *_, **__: found)
    done = run("align", photo, "--camera-height", "165", "-o", "out")
    assert "--camera-height is in metres, so check it" in done.stderr


def test_an_input_error_from_the_pipeline_exits_2(photo, monkeypatch):
    monkeypatch.setattr(
        autoreg.align, "align_seen", refusing(InputError("the slab and the camera do not fit"))
    )
    done = run("align", photo, "-o", "out")
    assert done.exit_code == 2
    assert "do not fit" in done.stderr
    assert not Path("out").exists()


def test_the_command_shows_its_version():
    done = run("--version")
    assert done.exit_code == 0
    assert done.stdout.startswith("autoreg ")


def test_the_module_runs_as_the_command_and_a_users_mistake_shows_no_traceback(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "autoreg", "align", "no such photo.jpg"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHONPATH": str(Path(job.__file__).parents[2])},
    )
    assert done.returncode == 2
    assert "no such photo.jpg" in done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_process_that_ends_early_waits_for_what_it_began_to_compile(tmp_path):
    cv2.imwrite(str(tmp_path / "photo.png"), np.full((300, 400), 90, np.uint8))
    code = (
        "import sys, threading, time, autoreg.jobs.job, autoreg.solve.solver\n"
        "begun, see = threading.Event(), autoreg.jobs.job.see\n"
        "solver = autoreg.solve.solver\n"
        "solver.warm_up = lambda folder: (begun.set(), time.sleep(1.5), print('compiled', flush=True))\n"
        # The photo is refused while the other thread compiles, however fast it is looked at.
        "autoreg.jobs.job.see = lambda picture: (begun.wait(30), see(picture))[1]\n"
        "from autoreg.command.cli import main\n"
        "sys.argv = ['autoreg', 'align', 'photo.png']\n"
        "main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        env=os.environ | {"PYTHONPATH": str(Path(job.__file__).parents[2])},
    )
    assert done.returncode == 3
    assert done.stdout.splitlines()[-1] == "compiled"


def test_nothing_is_compiled_for_a_run_that_has_ended(monkeypatch):
    compiled, ended = [], threading.Event()
    monkeypatch.setattr(solver, "warm_up", lambda folder: compiled.append(True))
    job._warm_up(ended)
    assert compiled == [True]
    ended.set()
    job._warm_up(ended)
    assert compiled == [True]


@pytest.mark.skipif(not hasattr(signal, "SIGINT") or os.name == "nt", reason="needs POSIX signals")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
@pytest.mark.parametrize("stuck", [False, True], ids=["", "stuck"])
def test_a_real_interrupt_ends_the_process_with_130(tmp_path, name, stuck):
    rng = np.random.default_rng(0)
    cv2.imwrite(str(tmp_path / "photo.png"), rng.integers(0, 255, (900, 1200)).astype(np.uint8))
    code = (
        "import signal, sys, time, autoreg.jobs.job\n"
        # A shell's background jobs ignore the first from the start, those of nohup the second.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"
        "autoreg.jobs.job._warm_up = lambda ended: None\n"
        "autoreg.jobs.job.load_photo = lambda path: (print('begun', flush=True), time.sleep(60))\n"
        "import autoreg.command.cli, threading\n"
        "from autoreg.command.cli import main\n"
        # An import that was broken off may leave another thread waiting for it for ever.
        f"autoreg.command.cli.PATIENCE_S, stuck = 0.2, {stuck}\n"
        "if stuck: threading.Thread(target=threading.Event().wait).start()\n"
        "sys.argv = ['autoreg', 'align', 'photo.png']\n"
        "main()\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(Path(job.__file__).parents[2])},
    ) as process:
        try:
            assert process.stdout.readline() == "begun\n"
            time.sleep(0.1)
            process.send_signal(getattr(signal, name))
            _, said = process.communicate(timeout=30)
        finally:
            process.kill()
    assert process.returncode == 130
    assert "Traceback" not in said
    assert [p.name for p in tmp_path.iterdir()] == ["photo.png"]


def test_an_interrupt_before_the_command_has_begun_leaves_no_traceback(tmp_path):
    (tmp_path / "typer.py").write_text("raise KeyboardInterrupt\n")
    done = subprocess.run(
        [sys.executable, "-m", "autoreg", "--version"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(Path(job.__file__).parents[2])])},
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")
