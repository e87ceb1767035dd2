import re

import numpy as np
import pytest
from handmade import CAMERA, POSE, ROWS, RUNNING, STACK, alignment, distorted
from hypothesis import given, settings
from hypothesis import strategies as st

from autoreg.camera import Camera
from autoreg.layout import slab_centre
from autoreg.scene import marks_text, scene_text
from autoreg.staging import demo_staging
from autoreg.view import View


def text_for(found, backdrop="scene-photo.png"):
    view = View(found.camera.camera, found.pose.cam_from_ground)
    return scene_text(found, demo_staging(view, found.lattice), backdrop)


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
    for text in (text_for(alignment()), marks_text(View(CAMERA, POSE), np.zeros((1, 4, 2)))):
        statement = re.search(r"^camera \{.*?\}", text, re.MULTILINE | re.DOTALL)[0]
        assert statement == "camera { location Eye right Cam_Right up Cam_Up direction Cam_Direction }"


def test_the_scene_names_its_picture_relatively_and_no_other_file():
    text = text_for(alignment(), "scene-photo.png")
    assert re.findall(r'"([^"]*)"', text) == ["scene-photo.png"]
    assert "#include" not in text


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
