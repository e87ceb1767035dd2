import re

import numpy as np
import pytest
import trimesh

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
    ],
)
def test_a_mistake_is_named_with_its_line(text, line, words, tmp_path):
    with pytest.raises(InputError) as caught:
        parse_scene(text, tmp_path, "mine.toml")
    said = str(caught.value)
    assert words in said
    assert re.search(rf"line {line}\b", said), said


def test_a_missing_file_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        read_scene(tmp_path / "none.toml")


def test_a_broken_mesh_is_named(tmp_path):
    (tmp_path / "bad.obj").write_text("v 1 2\nf 1 2 9\n")
    text = '[[object]]\nshape = "mesh"\nfile = "bad.obj"\nslab = [0, 0]'
    with pytest.raises(InputError, match=r"line 3.*bad\.obj"):
        parse_scene(text, tmp_path)
