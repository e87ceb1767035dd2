"""The scene's camera, objects and light, proven by POV-Ray's own pictures."""

import os
import re
import subprocess
import threading
import time

import cv2
import numpy as np
import pytest
from handmade import (
    CAMERA,
    POSE,
    RUNNING,
    STACK,
    alignment,
    distorted,
    looking,
    photo_for,
    plan_for,
)

from autoreg.camera import Camera
from autoreg.errors import RenderError
from autoreg.rendering import povray
from autoreg.rendering.check import check_render
from autoreg.rendering.depth_of_field import Focus, blur_px
from autoreg.rendering.layer import Layer, linear_from_srgb
from autoreg.rendering.objects import (
    FINISHES,
    Box,
    Light,
    Material,
    Object,
    OnSlab,
    Scene,
    Sphere,
    UnderPixel,
)
from autoreg.rendering.povray import find_povray, run_povray
from autoreg.rendering.povray_engine import PovrayEngine
from autoreg.rendering.preview import PreviewEngine
from autoreg.rendering.render import choose_engine, plan_render, render, staged_window
from autoreg.rendering.scene_objects import finish_text
from autoreg.rendering.staging import focused
from autoreg.view import View, Window

needs_povray = pytest.mark.skipif(find_povray() is None, reason="POV-Ray is not installed")
LENSES = pytest.mark.parametrize(
    "camera", [pytest.param(CAMERA, marks=pytest.mark.slow), distorted()], ids=["pinhole", "lens"]
)
# POV-Ray's 16-bit colours move by a few units with which of its threads renders a block.
THREADS = 8 / 65535


def engine(folder, **options):
    return PovrayEngine(find_povray(), folder, **options)


def random_view(rng):
    """A camera with unequal focal lengths, off-centre, tilted; every second one bends."""
    fx = rng.uniform(250, 700)
    centre = 0.5 * np.array([399, 299]) + rng.uniform(-0.3, 0.3, 2) * [400, 300]
    number = rng.integers(2)
    dist = (rng.uniform(-0.2, 0.05), rng.uniform(0.0, 0.03), *rng.uniform(-1e-3, 1e-3, 2)) if number else ()
    camera = Camera(400, 300, fx, fx * rng.uniform(0.8, 1.2), *centre, dist)
    eye = [*rng.uniform(-2, 2, 2), rng.uniform(1.0, 2.5)]
    return View(camera, looking(eye, [*rng.uniform(-0.4, 0.4, 2), 0.0], rng.uniform(-0.4, 0.4)))


@needs_povray
def test_a_picture_is_opaque_and_does_not_begin_with_its_other_edge(tmp_path):
    picture = np.full((8, 8, 4), 255, np.uint8)
    picture[:, :4, :3] = 0
    picture[..., 3] = 0
    cv2.imwrite(str(tmp_path / "half.png"), picture)
    box = Object("box", Box((0.6, 0.2, 0.4)), OnSlab(0, 0), Material(image=tmp_path / "half.png"))
    facing = looking([0.3, -3.0, 0.3], [0.3, 0.2, 0.2])
    plan = plan_for(Scene((box,), Light(sky=1.0, exposure=0.8)), alignment(pose=facing))
    layer = engine(tmp_path).draw(plan, Window(0, 0, CAMERA.width, CAMERA.height))
    corners = plan.view.project(np.array([[0.0, 0.1, 0.2], [0.6, 0.1, 0.2]]))
    (left, row), (right, _) = np.round(corners).astype(int)
    across = layer.light[row, left + 3 : right - 3, 1]
    assert (layer.transmission[row, left + 3 : right - 3] < 0.01).all()
    # Dark from its left edge on, and bright to its right one.
    assert across[:10].max() < 0.01
    assert across[-10:].min() > 0.9 * across.max() > 0.1


@needs_povray
@pytest.mark.parametrize("seed", range(8))
def test_joints_lie_where_the_fitted_camera_puts_them(seed, tmp_path):
    view = random_view(np.random.default_rng(seed))
    found = alignment(STACK, view.camera, view.cam_from_ground)
    check = check_render(engine(tmp_path), plan_for(Scene(), found))
    assert check.samples >= 8
    assert check.rms_px < 0.02
    assert check.max_px < 0.1


@needs_povray
@LENSES
def test_povray_and_the_preview_draw_the_same_outlines(camera, tmp_path):
    plan = plan_for(found=alignment(RUNNING, camera))
    window = Window(200, 80, 320, 280)
    ours = PreviewEngine().draw(plan, window)
    theirs = engine(tmp_path).draw(plan, window)
    solid, other = ours.light.sum(-1) > 0, theirs.light.sum(-1) > 0
    assert solid.sum() > 4000
    # Apart from single pixels along the outlines.
    assert (solid ^ other).sum() < 0.02 * solid.sum()
    lit = np.abs(ours.light - theirs.light).max(-1)[solid & other]
    assert np.median(lit) < 0.05
    shaded = (ours.transmission < 0.5) & (ours.transmission > 0)
    assert shaded.sum() > 1000
    assert np.median(np.abs(ours.transmission - theirs.transmission)[shaded]) < 0.12


@needs_povray
@LENSES
def test_a_balls_outline_is_that_of_the_projected_sphere(camera, tmp_path):
    found = alignment(STACK, camera)
    # It shines of itself, so that its light is its coverage.
    ball = Object("ball", Sphere(0.15), OnSlab(0, 0), Material((1.0, 0.0, 0.0), finish="Luminous"))
    made = render(engine(tmp_path), plan_for(Scene((ball,)), found), photo_for(camera))
    coverage = linear_from_srgb(made.layer[..., 2]) * made.layer[..., 3] / 255.0
    inside, outline = ball_outline(View(camera, POSE), np.array([0.3, 0.2, 0.15]), 0.15)
    # The area gives the mean distance of the outlines, the centroid their shift.
    length = np.linalg.norm(np.diff(outline, axis=0), axis=1).sum()
    assert abs(coverage.sum() - inside.sum()) / length < 0.1
    v, u = np.indices(coverage.shape)
    for place in (u, v):
        shift = (coverage * place).sum() / coverage.sum() - (inside * place).sum() / inside.sum()
        assert abs(shift) < 0.05


def ball_outline(view, centre, radius):
    """Coverage of each pixel by a ball, and points of its outline, by the tangent cone from the eye."""
    way = centre - view.eye
    u0, v0 = np.round(view.project(centre)).astype(int) - 80
    step = (np.arange(8) + 0.5) / 8 - 0.5
    fine = (np.arange(160)[:, None] + step).ravel()
    rays = view.directions(np.stack(np.meshgrid(u0 + fine, v0 + fine), -1))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    away = np.sqrt(np.maximum(way @ way - (rays @ way) ** 2, 0.0))
    inside = np.zeros((480, 640))
    inside[v0 : v0 + 160, u0 : u0 + 160] = (away < radius).reshape(160, 8, 160, 8).mean((1, 3))
    axis = way / np.linalg.norm(way)
    side = np.cross(axis, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    sine = radius / np.linalg.norm(way)
    t = np.linspace(0, 2 * np.pi, 200)[:, None]
    tangent = np.sqrt(1 - sine**2) * axis + sine * (np.cos(t) * side + np.sin(t) * np.cross(side, axis))
    return inside, view.project(view.eye + tangent * np.linalg.norm(way))


@needs_povray
def test_a_balls_shadow_lies_where_the_sun_says(tmp_path):
    view = View(CAMERA, POSE)
    ball = Object("ball", Sphere(0.1), OnSlab(0, 0), lift_m=0.3)
    plan = plan_for(Scene((ball,), Light((205.0, 50.0), sky=0.02, exposure=0.7)))
    layer = whole(engine(tmp_path).draw(plan, staged_window(plan)))
    azimuth, elevation = np.deg2rad([205.0, 50.0])
    reach = 0.4 / np.tan(elevation)
    middle = np.array([0.3, 0.2]) - reach * np.array([np.cos(azimuth), np.sin(azimuth)])
    # The ball's shadow is an ellipse about the point where the ray through its centre meets the ground.
    ground = view.ground_under(np.stack(np.meshgrid(np.arange(640.0), np.arange(480.0)), -1))
    along = (ground - middle) @ [np.cos(azimuth), np.sin(azimuth)]
    across = (ground - middle) @ [-np.sin(azimuth), np.cos(azimuth)]
    expected = (along * np.sin(elevation)) ** 2 + across**2 < 0.1**2
    taken = np.where(layer.light.sum(-1) > 0, 0.0, 1.0 - layer.transmission)
    assert expected.sum() > 400
    v, u = np.indices(taken.shape)
    dark = np.where(taken > 0.05, taken, 0.0)
    for place in (u, v):
        assert abs((dark * place).sum() / dark.sum() - (expected * place).sum() / expected.sum()) < 0.3
    assert dark.sum() == pytest.approx(0.98 * expected.sum(), rel=0.03)


def whole(layer):
    """The layer in a picture of the photo's size."""
    light, transmission = np.zeros((480, 640, 3)), np.ones((480, 640))
    w = layer.window
    part = np.s_[w.y : w.y + w.height, w.x : w.x + w.width]
    light[part], transmission[part] = layer.light, layer.transmission
    return Layer(Window(0, 0, 640, 480), light, transmission)


@needs_povray
def test_an_object_under_a_pixel_stands_on_that_pixel(tmp_path):
    for camera in (CAMERA, distorted()):
        post = Object("post", Sphere(0.004), UnderPixel(402.0, 333.0), Material((1.0, 0.0, 0.0)))
        made = render(engine(tmp_path), plan_for(Scene((post,)), alignment(STACK, camera)), photo_for(camera))
        v, u = np.nonzero(made.layer[..., 2].astype(int) - made.layer[..., 0] > 60)
        assert abs(u.mean() - 402.0) < 0.5
        # Its middle is 4 mm above the ground.
        assert -1.6 < v.mean() - 333.0 < 0.3


@needs_povray
@LENSES
def test_without_objects_the_composite_is_the_photo_bit_for_bit(camera, tmp_path):
    photo = photo_for(camera)
    made = render(engine(tmp_path), plan_for(Scene(), alignment(STACK, camera)), photo)
    assert (made.composite == photo).all()
    assert not made.layer.any()


@needs_povray
@LENSES
def test_the_scene_that_the_user_gets_shows_the_photo_to_the_grey_level(camera, tmp_path):
    plan = plan_for(Scene(light=Light(exposure=0.63)), alignment(STACK, camera))
    rendered = run_scene(plan, tmp_path)
    assert np.abs(rendered.astype(int) - plan.backdrop).max() == 0


@needs_povray
def test_the_scene_that_the_user_gets_shows_objects_and_their_shadows(tmp_path):
    camera = CAMERA.scaled(320, 240)
    plan = plan_for(found=alignment(camera=camera))
    rendered = run_scene(plan, tmp_path)
    made = render(engine(tmp_path), plan, photo_for(camera))
    inside = cv2.erode((made.layer[..., 3] > 0).astype(np.uint8), np.ones((5, 5))) > 0
    # One sample per pixel there, many here.
    differs = np.abs(rendered.astype(int) - made.composite).max(-1)
    assert np.median(differs[inside]) <= 3
    assert np.percentile(differs[inside], 90) < 25


def run_scene(plan, folder, *options):
    cv2.imwrite(str(folder / plan.files.backdrop), plan.backdrop)
    (folder / "scene.pov").write_text(plan.files.text)
    height, width = plan.backdrop.shape[:2]
    size = [f"+W{width}", f"+H{height}"]
    command = ["povray", "+Iscene.pov", "+Oout.png", *size, "-D", "+FN", "-A", *options]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    return cv2.imread(str(folder / "out.png"), cv2.IMREAD_COLOR)


@needs_povray
def test_a_users_own_scene_includes_the_camera_and_stands_something_on_a_slab(tmp_path):
    plan = plan_for()
    (tmp_path / "scene.pov").write_text(plan.files.text)
    (tmp_path / "mine.pov").write_text(
        '#declare Pass = 9;\n#include "scene.pov"\n'
        "Stand_On_Slab(sphere { 0, 0.02 pigment { rgb 1 } finish { emission 1 } }, 1, -1)\n"
    )
    command = ["povray", "+Imine.pov", "+Oout.png", "+W640", "+H480", "-D", "+FN", "-A"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    v, u = np.nonzero(cv2.imread(str(tmp_path / "out.png"), cv2.IMREAD_GRAYSCALE) > 128)
    expected = View(CAMERA, POSE).project(np.array([0.9, -0.2, 0.0]))
    assert [u.mean(), v.mean()] == pytest.approx(expected, abs=0.5)


@needs_povray
def test_every_finish_is_drawn_where_povray_has_no_include_files(tmp_path):
    balls = tuple(
        Object(name, Sphere(0.01), OnSlab(-1, -2, (0.03 * k, 0.0)), Material((0.8, 0.2, 0.1), finish=name))
        for k, name in enumerate(FINISHES)
    )
    plan = plan_for(Scene(balls))
    assert not re.findall(r'#include "(?!scene)', plan.files.text)
    layer = engine(tmp_path).draw(plan, staged_window(plan))
    assert (layer.transmission < 0.5).any()


@needs_povray
def test_the_finishes_are_those_of_povrays_own_include_files(tmp_path):
    balls = [
        f"sphere {{ <{1.2 * k}, 0, 0>, 0.5 pigment {{ rgb <0.8, 0.4, 0.2> }} finish {{ {name} }} }}"
        for k, name in enumerate(FINISHES)
    ]
    setting = "camera { orthographic location <7, 0, -9> right 16*x up 4*y direction z }\n"
    setting += "background { rgb 0.5 } light_source { <5, 9, -9> rgb 1 }\n"
    pictures = []
    for name, head in (
        ("theirs", '#include "finish.inc"\n#include "metals.inc"\n'),
        ("ours", "\n".join(finish_text(name) for name in FINISHES)),
    ):
        text = "#version 3.7;\nglobal_settings { assumed_gamma 1 }\n" + head + setting
        (tmp_path / f"{name}.pov").write_text(text + "\n".join(balls))
        command = ["povray", f"+I{name}.pov", f"+O{name}.png", "+W320", "+H80", "-D", "-A", "-J"]
        done = subprocess.run(command, cwd=tmp_path, check=False, capture_output=True, text=True)
        if name == "theirs" and "Cannot find file" in done.stderr:
            pytest.skip("POV-Ray's include files are not installed")
        assert done.returncode == 0, done.stderr
        pictures.append(cv2.imread(str(tmp_path / f"{name}.png")))
    assert np.array_equal(*pictures)


@needs_povray
def test_depth_of_field_blurs_what_is_near_and_moves_no_joint(tmp_path):
    plan = plan_for(Scene())
    sharp = check_render(engine(tmp_path), plan)
    lens = Focus(0.012, np.array([0.0, 0.0, 0.0]))
    blurred_plan = plan_for_focus(plan, lens)
    blurred = check_render(engine(tmp_path), blurred_plan)
    assert blurred.samples > 10
    assert blurred.rms_px < 0.02
    assert sharp.rms_px < 0.02


@needs_povray
@pytest.mark.parametrize(
    "window", [Window(0, 0, 640, 480), Window(330, 190, 300, 280)], ids=["whole", "part"]
)
def test_povrays_lens_blurs_as_wide_as_a_real_one(window, tmp_path):
    # A point of focus far from the middle of what is rendered, so that depth and distance differ.
    lens = Focus(0.1, np.array([1.6, 1.9, 0.0]))
    spot = np.array([0.5, -0.5, 0.0])
    mark = (spot + 0.06 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]))[None, :, :2]
    spread = []
    for plan in (plan_for(Scene()), plan_for_focus(plan_for(Scene()), lens)):
        found = engine(tmp_path).draw_marks(plan, mark, window, window.width, window.height)
        spread.append([(found * (x - (found * x).sum() / found.sum()) ** 2).sum() / found.sum()
                       for x in np.indices(found.shape)])  # fmt: skip
    expected = blur_px(View(CAMERA, POSE), lens, spot[None])[0]
    assert expected > 8
    # An even disc's variance is its width squared over 16. POV-Ray's samples leave its rim out.
    width = 4 * np.sqrt(np.diff(spread, axis=0)[0])
    assert width[::-1] == pytest.approx([expected, expected * CAMERA.fy / CAMERA.fx], rel=0.08)


@pytest.mark.slow
@needs_povray
def test_a_shadow_out_of_focus_is_as_soft_as_povray_traces_it(tmp_path):
    ball = Object("ball", Sphere(0.15), OnSlab(0, -2))
    sharp = plan_for(Scene((ball,), Light((205.0, 50.0), exposure=0.7)))
    plan = plan_for_focus(sharp, Focus(0.08, np.array([0.5, 1.8, 0.0])))
    window = Window(360, 270, 120, 70)
    ours, hard = (engine(tmp_path).draw(p, window) for p in (plan, sharp))
    places = zip("XYWH", (window.x, window.y, window.width, window.height), strict=True)
    options = ["+FN16", "+UA", "File_Gamma=1.0", "-J", *(f"Declare=Win_{k}={n}" for k, n in places)]
    size = [f"+W{window.width}", f"+H{window.height}"]
    run_scene(plan, tmp_path, *options, *size, "Declare=Pass=2", "Declare=Depth_Of_Field=1")
    traced = cv2.imread(str(tmp_path / "out.png"), cv2.IMREAD_UNCHANGED)[..., :3].mean(-1) / 65535
    bare = traced.max()
    # Where the ball is not before it.
    seen = (hard.light.sum(-1) == 0) & (ours.light.sum(-1) == 0)
    assert (hard.transmission[seen] < 0.5).sum() > 400
    away = (ours.transmission - traced / bare)[seen]
    assert np.sqrt(np.mean(away**2)) < 0.01
    assert np.sqrt(np.mean((hard.transmission - traced / bare)[seen] ** 2)) > 0.04


@needs_povray
def test_the_photo_is_not_blurred_again(tmp_path):
    plan = plan_for_focus(plan_for(Scene(light=Light(exposure=0.63))), Focus(0.05, np.zeros(3)))
    assert np.abs(run_scene(plan, tmp_path).astype(int) - plan.backdrop).max() == 0


def plan_for_focus(plan, lens):
    return plan_render(alignment(), focused(plan.staging, lens), photo_for())


@needs_povray
def test_a_scene_that_does_not_parse_fails_with_povrays_words_and_the_scenes_line(tmp_path):
    (tmp_path / "scene.pov").write_text("#version 3.7;\ncamera { nonsense }\n")
    with pytest.raises(RenderError, match=r"code 1.*scene\.pov line 2.*rror.*\n  2 \| camera \{ nonsense \}"):
        run_povray(find_povray(), ["+Iscene.pov", "-D"], tmp_path, timeout_s=60.0)


@needs_povray
def test_progress_rises_to_the_end_and_the_working_folder_is_taken_away(tmp_path):
    told = []
    engine(tmp_path, progress=told.append).draw(plan_for(), Window(200, 100, 300, 200))
    assert len(told) > 3
    assert 0 <= min(told) <= max(told) <= 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@needs_povray
def test_two_renders_in_one_folder_do_not_collide(tmp_path):
    plan, window, answers = plan_for(), Window(200, 150, 200, 150), []
    ball = Object("ball", Sphere(0.2), OnSlab(0, 0))
    other = plan_for(Scene((ball,), Light(exposure=0.7)))

    def draw(which):
        answers.append((which, engine(tmp_path).draw(which, window).light))

    threads = [threading.Thread(target=draw, args=(p,)) for p in (plan, other)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for which, light in answers:
        assert np.abs(light - engine(tmp_path).draw(which, window).light).max() < THREADS
    assert np.abs(answers[0][1] - answers[1][1]).max() > 100 * THREADS
    assert list(tmp_path.iterdir()) == []


def test_a_program_that_cannot_be_started_is_a_render_error(tmp_path):
    with pytest.raises(RenderError, match="could not be started"):
        run_povray(str(tmp_path / "missing"), [], tmp_path, timeout_s=5.0)


def slow_program(folder):
    slow = folder / "slow"
    slow.write_text("#!/bin/sh\necho $$ > pid\nexec sleep 30\n")
    slow.chmod(0o755)
    return str(slow)


def gone(folder):
    number = int((folder / "pid").read_text())
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.mark.skipif(os.name == "nt", reason="needs a POSIX shell")
def test_a_render_that_takes_too_long_is_stopped(tmp_path):
    with pytest.raises(RenderError, match=r"more than 0\.5 s and was stopped"):
        run_povray(slow_program(tmp_path), [], tmp_path, timeout_s=0.5)
    assert gone(tmp_path)


@pytest.mark.skipif(os.name == "nt", reason="needs a POSIX shell")
def test_an_interrupt_stops_povray_too(tmp_path, monkeypatch):
    def interrupt(_):
        if (tmp_path / "pid").exists() and (tmp_path / "pid").read_text():
            raise KeyboardInterrupt

    monkeypatch.setattr(povray.time, "sleep", interrupt)
    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_povray(slow_program(tmp_path), [], tmp_path, timeout_s=60.0)
    assert time.monotonic() - begun < 20
    assert gone(tmp_path)


def test_without_povray_auto_takes_the_preview_and_insisting_fails(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    assert choose_engine("auto", tmp_path).name == "preview"
    with pytest.raises(RenderError, match="not installed"):
        choose_engine("povray", tmp_path)


def test_a_rendered_camera_that_is_not_the_photos_is_an_error_and_no_picture():
    class Elsewhere(PreviewEngine):
        def draw_marks(self, plan, marks_ground, straight, width, height):
            return np.roll(super().draw_marks(plan, marks_ground, straight, width, height), 1, axis=0)

    with pytest.raises(RenderError, match=r"rendered joints lie \d\.\d+ px rms"):
        render(Elsewhere(), plan_for(), photo_for())
