import re
from pathlib import Path

import numpy as np
import pytest
from handmade import POSE, ROWS, RUNNING, STACK, alignment, distorted, plan_for
from hypothesis import given, settings
from hypothesis import strategies as st

from autoreg.camera import Camera
from autoreg.layout import slab_centre
from autoreg.rendering.objects import Box, Material, Object, OnGround, OnSlab, Scene, Sphere, UnderPixel
from autoreg.rendering.scene import marks_text
from autoreg.rendering.scene_objects import mesh_text
from autoreg.rendering.surface import box_surface


def text_for(found=None, scene=None):
    return plan_for(scene, found).files.text


def constant(text, name):
    """A named constant of the scene, a number or a vector."""
    value = re.search(rf"#declare {name}\s*= ([^;]+);", text)[1]
    return np.array([float(v) for v in value.strip("<>").split(",")])


def seen_by_povray(text, point):
    """Pixel at which POV-Ray's camera, by the constants in the text, shows a point of the ground frame.

    POV-Ray's own definition: a pixel's ray is direction + x right + y up, with x and y from -1/2 to 1/2.
    """
    w, h, fx, fy, cx, cy = (constant(text, n)[0] for n in ("Photo_W", "Photo_H", "FX", "FY", "CX", "CY"))
    right = w / fx * constant(text, "Axis_Right")
    up = -h / fy * constant(text, "Axis_Down")
    direction = constant(text, "Axis_Forward") + ((w - 1) / 2 - cx) / fx * constant(text, "Axis_Right")
    direction += ((h - 1) / 2 - cy) / fy * constant(text, "Axis_Down")
    ray = point - constant(text, "Eye")
    depth, x, y = np.linalg.solve(np.stack([direction, right, up], 1), ray)
    return np.array([(x / depth + 0.5) * w - 0.5, (0.5 - y / depth) * h - 0.5])


@settings(deadline=None, derandomize=True, max_examples=30)
@given(
    st.floats(400, 900),
    st.floats(400, 900),
    st.floats(250, 390),
    st.floats(180, 300),
    st.floats(-1, 1),
    st.floats(-1, 1),
)
def test_the_scenes_camera_puts_ground_points_where_the_fitted_camera_does(fx, fy, cx, cy, x, y):
    camera = Camera(640, 480, fx, fy, cx, cy)
    point = np.array([x, y, 0.3])
    expected = camera.project(POSE.apply(point))
    assert seen_by_povray(text_for(alignment(camera=camera)), point) == pytest.approx(expected, abs=1e-6)


def test_the_camera_is_never_rebuilt_by_look_at_or_angle():
    statement = re.findall(r"^camera \{.*?\}", text_for(), re.MULTILINE | re.DOTALL)
    assert statement == ["camera { location Eye right Cam_Right up Cam_Up direction Cam_Direction }"]
    assert "camera" not in marks_text(np.zeros((1, 4, 2)))


def test_the_scene_names_its_files_relatively_and_only_those_it_comes_with():
    box = Object("Café table", Box((0.2, 0.2, 0.2)), OnSlab(0, 0), Material(image=Path("/else/where.jpg")))
    files = plan_for(Scene((box,))).files
    named = set(re.findall(r'"([^"]*)"', files.text))
    brought = {files.backdrop, *(name for name, _ in files.includes), *(name for name, _ in files.images)}
    assert named == brought | {"scene.pov", "scene-marks.inc"}
    assert brought == {"scene-photo.png", "scene-thing_caf_table.inc", "scene-thing_caf_table.png"}


def test_objects_are_placed_by_the_macro_that_says_how_they_were_placed():
    ball = Sphere(0.1)
    things = (
        Object("a", ball, OnSlab(1, 2)),
        Object("a", ball, OnSlab(0, 1, (0.05, 0.0)), turn_deg=30.0),
        Object("union", ball, OnGround(0.25, 0.5), lift_m=0.1),
        Object("...", ball, UnderPixel(300.0, 250.0)),
    )
    text = text_for(scene=Scene(things))
    assert "  Stand_On_Slab(Thing_a, 1, 2)\n" in text
    assert "  Put_On_Slab(Thing_a_2, 0, 1, <0.05, 0, 0>, 30)\n" in text
    assert "  Stand_At(Thing_union, <0.25, 0.5>, 0.1, 0)\n" in text
    assert re.search(r"  Stand_At\(Thing_unnamed, .*// under pixel \(300, 250\)\n", text)


def test_a_mesh_is_written_once_for_each_corner():
    text = mesh_text("Thing_Mesh", box_surface((1.0, 2.0, 3.0)))
    assert "vertex_vectors { 8," in text
    assert "normal_vectors { 6," in text
    assert "face_indices { 12," in text


def test_the_slab_macro_gives_the_centres_of_the_layout():
    for lattice in (STACK, RUNNING):
        text = text_for(alignment(lattice))
        a, b, shift = (constant(text, name)[0] for name in ("A", "B", "Shift"))
        assert "#macro Slab_Centre(I, J) <(I + J*Shift + 0.5)*A, (J + 0.5)*B, 0> #end" in text
        assert [(2 + 3 * shift + 0.5) * a, 3.5 * b] == pytest.approx(slab_centre(lattice, 2, 3))


def test_a_stack_bond_draws_every_joint_once():
    text = text_for(alignment(STACK))
    assert len(re.findall(r"^  Joint_X\(", text, re.MULTILINE)) == 21
    assert len(re.findall(r"^  Joint_Y\(", text, re.MULTILINE)) == 13


def test_rows_draw_only_the_unbroken_joints():
    text = text_for(alignment(ROWS))
    assert re.search(r"^  Joint_X\(", text, re.MULTILINE)
    assert not re.search(r"^  Joint_Y\(", text, re.MULTILINE)


def test_a_bending_lens_is_explained_where_the_backdrop_is_resampled():
    assert "pixel for pixel" in text_for(alignment())
    assert "bend taken out" in text_for(alignment(camera=distorted()))


def test_the_scene_is_plain_ascii_whatever_the_lattice():
    for lattice in (STACK, RUNNING, ROWS):
        assert text_for(alignment(lattice)).isascii()
