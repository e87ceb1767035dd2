"""The scene's camera, proven by POV-Ray's own pictures."""

import subprocess

import cv2
import numpy as np
import pytest
from handmade import CAMERA, POSE, RUNNING, STACK, alignment, distorted, looking, photo_for

from autoreg import povray
from autoreg.camera import Camera
from autoreg.check import check_render
from autoreg.errors import RenderError
from autoreg.povray import PovrayEngine, find_engine, find_povray
from autoreg.preview import PreviewEngine
from autoreg.render import choose_engine, staged_window
from autoreg.scene import scene_text
from autoreg.staging import demo_staging
from autoreg.view import View

needs_povray = pytest.mark.skipif(find_povray() is None, reason="POV-Ray is not installed")


def random_view(rng):
    """A camera with unequal focal lengths, off-centre, tilted; every second one bends."""
    fx = rng.uniform(350, 700)
    centre = 0.5 * np.array([399, 299]) + rng.uniform(-35, 35, 2)
    number = rng.integers(2)
    dist = (rng.uniform(-0.2, 0.05), rng.uniform(0.0, 0.03), *rng.uniform(-1e-3, 1e-3, 2)) if number else ()
    camera = Camera(400, 300, fx, fx * rng.uniform(0.9, 1.1), *centre, dist)
    eye = [*rng.uniform(-2, 2, 2), rng.uniform(1.0, 2.5)]
    return View(camera, looking(eye, [*rng.uniform(-0.4, 0.4, 2), 0.0], rng.uniform(-0.4, 0.4)))


@needs_povray
@pytest.mark.parametrize("seed", range(10))
def test_joints_lie_where_the_fitted_camera_puts_them(seed, tmp_path):
    view = random_view(np.random.default_rng(seed))
    check = check_render(find_engine("", tmp_path), view, STACK)
    assert check.samples >= 10
    assert check.rms_px < 0.05
    assert check.max_px < 0.15


@needs_povray
@pytest.mark.parametrize("camera", [CAMERA, distorted()], ids=["pinhole", "lens"])
def test_povray_and_the_preview_draw_the_same_layer(camera, tmp_path):
    found = alignment(RUNNING, camera)
    view = View(camera, POSE)
    staging = demo_staging(view, RUNNING)
    window = staged_window(view, found, staging)
    engine = find_engine(scene_text(found, staging, "scene-photo.png"), tmp_path)
    ours = PreviewEngine().draw(view, RUNNING, staging, window)
    theirs = engine.draw(view, RUNNING, staging, window)
    assert (1 - ours.transmission).sum() > 1000
    # Inside faces and shadows they agree; single pixels of the outlines may differ.
    assert np.abs(ours.transmission - theirs.transmission).mean() < 0.003
    assert np.abs(ours.light - theirs.light).mean() < 0.003
    assert np.mean(np.abs(ours.transmission - theirs.transmission) > 0.15) < 0.01


@needs_povray
@pytest.mark.parametrize("camera", [CAMERA, distorted()], ids=["pinhole", "lens"])
def test_the_scene_that_the_user_gets_shows_the_backdrop_unchanged(camera, tmp_path):
    found = alignment(STACK, camera)
    photo = photo_for(camera)
    cv2.imwrite(str(tmp_path / "scene-photo.png"), photo)
    text = scene_text(found, demo_staging(View(camera, POSE), STACK), "scene-photo.png")
    text = text.replace("object { Staged }", "")
    (tmp_path / "scene.pov").write_text(text)
    command = [
        "povray",
        "+Iscene.pov",
        "+Oout.png",
        "+W640",
        "+H480",
        "-D",
        "+FN",
        "-A",
        "Declare=Show_Joints=0",
    ]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    rendered = cv2.imread(str(tmp_path / "out.png"), cv2.IMREAD_COLOR)
    assert np.abs(rendered.astype(int) - photo).max() <= 1


@needs_povray
def test_a_scene_that_does_not_parse_fails_with_povrays_words(tmp_path):
    view = View(CAMERA, POSE)
    staging = demo_staging(view, STACK)
    window = staged_window(view, alignment(), staging)
    with pytest.raises(RenderError, match=r"code 1.*rror"):
        PovrayEngine(find_povray(), "camera { nonsense }", tmp_path).draw(view, STACK, staging, window)
    assert list(tmp_path.iterdir()) == []


def test_a_program_that_cannot_be_started_is_a_render_error(tmp_path):
    with pytest.raises(RenderError, match="could not be started"):
        PovrayEngine(str(tmp_path / "missing"), "", tmp_path).draw_marks(
            View(CAMERA, POSE), np.zeros((1, 4, 2))
        )


def test_a_render_that_takes_too_long_is_stopped(tmp_path, monkeypatch):
    slow = tmp_path / "slow"
    slow.write_text("#!/bin/sh\nexec sleep 30\n")
    slow.chmod(0o755)
    monkeypatch.setattr(povray, "_TIMEOUT_S", 0.2)
    with pytest.raises(RenderError, match="stopped"):
        PovrayEngine(str(slow), "", tmp_path).draw_marks(View(CAMERA, POSE), np.zeros((1, 4, 2)))


def test_without_povray_auto_takes_the_preview_and_insisting_fails(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert choose_engine("auto", "", tmp_path).name == "preview"
    with pytest.raises(RenderError, match="not installed"):
        choose_engine("povray", "", tmp_path)
