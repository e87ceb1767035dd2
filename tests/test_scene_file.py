import re
import tempfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from handmade import plan_for
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import ImageFont

from autoreg.errors import InputError
from autoreg.rendering.objects import (
    Box,
    Cone,
    Cylinder,
    Mesh,
    OnGround,
    OnSlab,
    Sphere,
    Text,
    Torus,
    UnderPixel,
)
from autoreg.rendering.scene_file import parse_scene, read_scene

ALL = """
joints = true
joint_colour = "#00ff00"
focus = [0.5, 1]

[light]
sun = [135, 40]
sky = 0.3
exposure = 0.9

[[object]]
name = "crate"
shape = "box"
size = [0.4, 0.3, 0.2]
slab = [2, -1]
offset = [0.1, 0]
turn = 30
colour = "white"

[[object]]
shape = "sphere"
radius = 0.2
ground = [1, 2.5]
lift = 0.4
color = [0.5, 0.0, 0]
finish = "Glossy"

[[object]]
shape = "cylinder"
radius = 0.1
height = 1
pixel = [300, 400]

[[object]]
shape = "cone"
radius = 0.2
top_radius = 0.1
height = 0.5
slab = [0, 0]

[[object]]
shape = "torus"
radius = 0.3
tube = 0.05
slab = [0, 1]

[[object]]
shape = "text"
text = "8 Ba"
height = 0.3
slab = [1, 1]

[[object]]
shape = "mesh"
file = "pyramid.ply"
height = 0.7
slab = [1, 0]
"""


@pytest.fixture
def folder(tmp_path):
    trimesh.creation.cone(1.0, 2.0, sections=4).export(tmp_path / "pyramid.ply")
    return tmp_path


def test_every_shape_place_and_light_is_read(folder):
    scene = parse_scene(ALL, folder)
    shapes = [thing.shape for thing in scene.objects]
    assert [type(s) for s in shapes] == [Box, Sphere, Cylinder, Cone, Torus, Text, Mesh]
    crate, ball, post = scene.objects[:3]
    assert (crate.name, crate.turn_deg, crate.material.colour) == ("crate", 30.0, (1.0, 1.0, 1.0))
    assert crate.place == OnSlab(2, -1, (0.1, 0.0))
    assert (ball.place, ball.lift_m, ball.material.finish) == (OnGround(1.0, 2.5), 0.4, "Glossy")
    # sRGB 0.5 is 0.214 of the light.
    assert ball.material.colour == pytest.approx((0.2140, 0, 0), abs=1e-4)
    assert post.place == UnderPixel(300.0, 400.0)
    assert scene.light.sun_deg == (135.0, 40.0)
    assert (scene.joints, scene.joint_colour, scene.focus_m) == (True, (0.0, 1.0, 0.0), (0.5, 1.0))
    assert np.ptp(shapes[6].surface.corners[..., 2]) == pytest.approx(0.7)


BALL = '[[object]]\nshape = "sphere"\nradius = 0.2\nslab = [0, 0]\n'


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("joints = 1", 1, "joints must be true or false"),
        ("\njoint = true", 2, 'joint is not known; did you mean "joints"?'),
        ("[light]\nsun = [100]", 2, "sun in [light] must be 2 numbers"),
        ("[light]\nsun = [100, 2]", 2, "sun in [light] must be an azimuth and an elevation of 5 to 90"),
        ("[light]\nshadow = 3", 2, "must say foot, top and tip"),
        ("[light]\nshadow = { foot = [1, 2], top = [1, 2] }", 2, "must say foot, top and tip"),
        ("[light]\nshadow = { foot = [1, 2], top = [1, 2], tip = [1] }", 2, "must be 2 numbers"),
        (
            "[light]\nsun = [9, 9]\nshadow = { foot = [1, 2], top = [1, 2], tip = [3, 2] }",
            3,
            "give one of them",
        ),
        ("[light]\nsky = 3", 2, "sky in [light] must lie within"),
        ("[light]\nmoon = 3", 2, "moon in [light] is not known"),
        (BALL + "colr = 3", 5, 'colr in [[object]] 1 is not known; did you mean "color"?'),
        (BALL + BALL.replace("0.2", "-0.2"), 7, "radius in [[object]] 2 must be positive, got -0.2"),
        (BALL + BALL.replace("0.2", "true"), 7, "radius in [[object]] 2 must be a number, got True"),
        (BALL + BALL.replace("radius = 0.2\n", ""), 5, "radius in [[object]] 2 is missing"),
        (
            BALL.replace("sphere", "sphre"),
            2,
            "shape in [[object]] 1 'sphre' is not known; did you mean \"sphere\"",
        ),
        (BALL.replace("slab = [0, 0]", ""), 1, "say where it stands with one of slab, ground or pixel"),
        (BALL + "pixel = [3, 4]", 4, "both say where it stands"),
        (BALL.replace("[0, 0]", "[0.5, 0]"), 4, "slab in [[object]] 1 must be 2 whole numbers"),
        (BALL + 'colour = "reddish"', 5, 'must be a name, "#rrggbb" or three numbers'),
        (BALL + "lift = -1", 5, "lift in [[object]] 1 must not be negative"),
        (BALL + 'finish = "Glosy"', 5, 'did you mean "Glossy"?'),
        (BALL + 'image = "no.png"', 5, "does not exist"),
        (BALL + "height = 2", 5, "height in [[object]] 1 is not known"),
        ('[[object]]\nshape = "text"\ntext = "\\u6f22"\nheight = 1\nslab = [0, 0]', 3, "no letter"),
        ('[[object]]\nshape = "torus"\nradius = 0.1\ntube = 0.2\nslab = [0, 0]', 4, "must not exceed radius"),
        ('[[object]]\nshape = "mesh"\nfile = "x.ply"\nslab = [0, 0]', 3, "does not exist"),
        ("[object]\nshape = 'box'", 1, "must be written as [[object]]"),
        ("x = = 1", 1, "not valid TOML"),
        ('joint_colour = "rgb(300, 0, 0)"', 1, 'must be a name, "#rrggbb" or three numbers'),
        (BALL.replace("0.2", "1e-9"), 3, "must be at least 1e-06"),
        (BALL.replace("0.2", "9" * 400), 3, "must lie within"),
        (BALL.replace("0.2", "nan"), 3, "must be a number"),
        (BALL + 'image = "."', 5, "is no file"),
        (BALL + f'image = "{"a" * 5000}"', 5, "does not exist"),
    ],
)
def test_a_mistake_is_named_with_its_line(text, line, words, tmp_path):
    with pytest.raises(InputError) as caught:
        parse_scene(text, tmp_path, "mine.toml")
    said = str(caught.value)
    assert words in said
    assert re.search(rf"line {line}\b", said), said


@pytest.mark.parametrize("text", ["x = " + "[" * 5000, "x = " + "9" * 5000])
def test_what_the_parser_itself_chokes_on_is_an_input_error(text, tmp_path):
    with pytest.raises(InputError, match=r"mine\.toml is not valid"):
        parse_scene(text, tmp_path, "mine.toml")


def test_a_mark_before_the_text_is_not_part_of_it(tmp_path):
    (tmp_path / "scene.toml").write_bytes(b"\xef\xbb\xbfjoints = true")
    assert read_scene(tmp_path / "scene.toml").joints


@pytest.mark.parametrize("damage", ["cut", "zeroed", "empty"])
def test_a_damaged_font_is_named(damage, tmp_path):
    whole = ImageFont.load_default(size=10).font_bytes
    broken = {"cut": whole[: len(whole) // 2], "zeroed": whole[:300] + bytes(len(whole) - 300), "empty": b""}
    (tmp_path / "bad.ttf").write_bytes(broken[damage])
    text = '[[object]]\nshape = "text"\ntext = "Ab"\nheight = 1\nslab = [0, 0]\nfont = "bad.ttf"'
    with pytest.raises(InputError, match=r"line 6: font .*bad\.ttf cannot be read"):
        parse_scene(text, tmp_path)


# Values that some key wants and others do not, at and beyond what is allowed.
VALUES = st.sampled_from(
    [
        "0",
        "-1",
        "1",
        "0.2",
        "1e-300",
        "1e9",
        "1e300",
        "inf",
        "nan",
        "true",
        '""',
        '"x"',
        "[]",
        "[1]",
        "[1,2]",
        "[0.1,0.2,0.3]",
        "[1,2,3,4]",
        "[[1],2]",
        '["a","b"]',
        "{}",
        "{a=1}",
        "2024-01-01",
        '"white"',
        '"hsv(999,200%,500%)"',
        '"#12"',
        '"box"',
        '"y"',
        '"Mirror"',
        "[0,0]",
        "[-0.6,-2.6]",
        "[-1e9,0]",
        "[0,1e300]",
        "[320,240]",
        "[320,1]",
        "[9e8,9e8]",
        "[2,-1]",
        '"flat.obj"',
        '"."',
        '"a/\\u0000b"',
        '"\\u6f22\\n"',
    ]
)
KEYS = st.sampled_from(
    [
        "name",
        "slab",
        "ground",
        "pixel",
        "offset",
        "turn",
        "lift",
        "colour",
        "color",
        "image",
        "finish",
        "size",
        "radius",
        "height",
        "top_radius",
        "tube",
        "text",
        "depth",
        "font",
        "file",
        "scale",
        "up",
        "shape",
    ]
)
COMPLETE = {
    "box": {"size": "[0.3, 0.3, 0.3]"},
    "sphere": {"radius": "0.2"},
    "cone": {"radius": "0.2", "height": "0.3"},
    "torus": {"radius": "0.2", "tube": "0.05"},
    "text": {"text": '"Ab"', "height": "0.2"},
    "mesh": {"file": '"flat.obj"'},
}


@settings(deadline=None, derandomize=True, max_examples=300)
@given(
    st.sampled_from(sorted(COMPLETE)),
    st.dictionaries(KEYS, VALUES, max_size=2),
    st.dictionaries(
        st.sampled_from(["joints", "joint_colour", "focus", "light", "object"]), VALUES, max_size=1
    ),
    st.dictionaries(st.sampled_from(["sun", "shadow", "sky", "exposure"]), VALUES, max_size=1),
)
def test_whatever_a_scene_says_it_is_drawn_or_answered_in_words(shape, keys, top, light):
    table = {"shape": f'"{shape}"', "slab": "[0, 0]", **COMPLETE[shape]} | keys
    parts = [(top, ""), (light, "[light]"), (table, "[[object]]")]
    text = "\n".join("\n".join([head, *(f"{k} = {v}" for k, v in part.items())]) for part, head in parts)
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        try:
            answer = plan_for(parse_scene(text, Path(folder))).files.text
        except InputError as error:
            answer = str(error)
    assert len(answer) > 20


def test_a_missing_file_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_scene(tmp_path / "none.toml")


def test_a_broken_mesh_is_named(tmp_path):
    (tmp_path / "bad.obj").write_text("v 1 2\nf 1 2 9\n")
    text = '[[object]]\nshape = "mesh"\nfile = "bad.obj"\nslab = [0, 0]'
    with pytest.raises(InputError, match=r"line 3.*bad\.obj"):
        parse_scene(text, tmp_path)
