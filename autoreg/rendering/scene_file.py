"""A scene from its TOML file, with errors that name the key and the line."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import cv2

from autoreg.errors import InputError
from autoreg.rendering.mesh_files import read_mesh
from autoreg.rendering.objects import (
    FINISHES,
    RGB,
    Box,
    CastShadow,
    Cone,
    Cylinder,
    Light,
    Material,
    Mesh,
    Object,
    OnGround,
    OnSlab,
    Place,
    Scene,
    Shape,
    Sphere,
    Text,
    Torus,
    UnderPixel,
    colour,
)
from autoreg.rendering.surface import stand_up
from autoreg.rendering.toml_table import (
    Table,
    as_flag,
    as_number,
    as_table,
    as_tables,
    as_text,
    integers,
    numbers,
    one_of,
    pair,
)

_SHAPE_KEYS = {
    "box": ("size",),
    "sphere": ("radius",),
    "cylinder": ("radius", "height"),
    "cone": ("radius", "height", "top_radius"),
    "torus": ("radius", "tube"),
    "text": ("text", "height", "depth", "font"),
    "mesh": ("file", "height", "scale", "up"),
}
_PLACES = ("slab", "ground", "pixel")
_COMMON = ("name", "shape", *_PLACES, "offset", "turn", "lift", "colour", "color", "image", "finish")
_LIGHT_KEYS = ("sun", "shadow", "sky", "exposure")
_SHADOW_KEYS = ("foot", "top", "tip")
_TOP_KEYS = ("joints", "joint_colour", "focus", "light", "object")


def read_scene(path: Path) -> Scene:
    """The scene that a TOML file describes; files it names are found beside it.

    Raises:
        InputError: it cannot be read, or something in it is wrong; the message names the line.
    """
    try:
        # With or without the mark that some editors put before it.
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"scene {path} is not UTF-8 text: {error}") from error
    except OSError as error:
        raise InputError(f"scene {path} cannot be read: {error.strerror}; check the path") from error
    return parse_scene(text, path.parent, str(path))


def parse_scene(text: str, folder: Path, name: str = "scene") -> Scene:
    """The scene that a TOML text describes.

    Args:
        text: the text.
        folder: where the files lie that it names.
        name: what errors call it.

    Raises:
        InputError: something in it is wrong.
    """
    try:
        content = tomllib.loads(text)
    except RecursionError as error:
        raise InputError(f"{name} is not valid: its brackets are nested too deeply") from error
    except ValueError as error:
        # Its own error, or Python's about a whole number of thousands of digits.
        raise InputError(f"{name} is not valid TOML: {error}") from error
    top = Table(content, name, text, "", 0, folder)
    top.known(_TOP_KEYS)
    joint_colour = top.get("joint_colour", _as_colour, (1.0, 0.7, 0.0))
    light = top.get("light", as_table, {})
    objects = top.get("object", as_tables, [])
    return Scene(
        tuple(_object(Table(entry, name, text, "object", n, folder), n) for n, entry in enumerate(objects)),
        _light(Table(light, name, text, "light", 0, folder)),
        top.get("joints", as_flag, False),
        joint_colour,
        top.get("focus", pair, None),
    )


def _light(table: Table) -> Light:
    table.known(_LIGHT_KEYS)
    sun = table.get("sun", numbers(2), None)
    values: dict[str, Any] = {}
    if "shadow" in table.content:
        values["shadow"] = table.need("shadow", _as_shadow)
    if "sky" in table.content:
        values["sky"] = table.need("sky", as_number)
    if "exposure" in table.content:
        values["exposure"] = table.need("exposure", as_number)
    try:
        return Light(None if sun is None else (sun[0], sun[1]), **values)
    except ValueError as error:
        key, _, words = str(error).partition(" ")
        raise table.error(key, words) from None


def _object(table: Table, number: int) -> Object:
    kind = table.need("shape", one_of(tuple(_SHAPE_KEYS)))
    table.known((*_COMMON, *_SHAPE_KEYS[kind]))
    name = table.get("name", as_text, f"{kind} {number + 1}")
    lift = table.get("lift", as_number, 0.0)
    if lift < 0:
        raise table.error("lift", f"must not be negative, got {lift:g}: nothing can sink into the photo")
    try:
        shape = _shape(table, kind)
    except ValueError as error:
        key, _, words = str(error).partition(" ")
        raise table.error(key, words) from None
    return Object(name, shape, _place(table), _material(table), table.get("turn", as_number, 0.0), lift)


def _shape(table: Table, kind: str) -> Shape:
    length = lambda key: table.need(key, as_number)  # noqa: E731
    match kind:
        case "box":
            x, y, z = table.need("size", numbers(3))
            return Box((x, y, z))
        case "sphere":
            return Sphere(length("radius"))
        case "cylinder":
            return Cylinder(length("radius"), length("height"))
        case "cone":
            return Cone(length("radius"), length("height"), table.get("top_radius", as_number, 0.0))
        case "torus":
            return Torus(length("radius"), length("tube"))
        case "text":
            height = length("height")
            depth = table.get("depth", as_number, 0.2 * height)
            text = Text(table.need("text", as_text), height, depth, table.file("font"))
            _assert_written(table, text)
            return text
        case _:
            return _mesh(table)


def _assert_written(table: Table, text: Text) -> None:
    # Only scenes with letters need what reads fonts.
    from autoreg.rendering.letters import text_surface

    try:
        text_surface(text.text, text.height_m, text.depth_m, text.font)
    except ValueError as error:
        key, verb = ("font", "used") if str(error).startswith("font") else ("text", "set")
        raise table.error(key, f"cannot be {verb}: {error}") from None


def _mesh(table: Table) -> Mesh:
    file = table.file("file")
    if file is None:
        raise table.error("file", "is missing")
    height = table.get("height", as_number, None)
    scale = table.get("scale", as_number, 1.0)
    if height is not None and "scale" in table.content:
        raise table.error("scale", "and height both say how large it is; give one of them")
    for key, value in (("height", height), ("scale", scale)):
        if value is not None and not value > 0:
            raise table.error(key, f"must be positive, got {value:g}")
    try:
        surface = read_mesh(file, "y" if table.get("up", one_of(("y", "z")), "z") == "y" else "z")
        return Mesh(stand_up(surface, height_m=height, scale=scale))
    except ValueError as error:
        raise table.error("file", f"cannot be used: {error}") from None


def _place(table: Table) -> Place:
    given = [key for key in _PLACES if key in table.content]
    if len(given) != 1:
        words = "is missing; say where it stands with one of slab, ground or pixel"
        if given:
            words = f"and {' and '.join(given[1:])} both say where it stands; give one of them"
        raise table.error(given[0] if given else "slab", words)
    if given[0] != "slab" and "offset" in table.content:
        raise table.error("offset", f"goes with slab, not with {given[0]}")
    if given[0] == "slab":
        i, j = table.need("slab", integers(2))
        x, y = table.get("offset", numbers(2), (0.0, 0.0))
        return OnSlab(i, j, (x, y))
    a, b = table.need(given[0], numbers(2))
    return OnGround(a, b) if given[0] == "ground" else UnderPixel(a, b)


def _material(table: Table) -> Material:
    if "colour" in table.content and "color" in table.content:
        raise table.error("color", "and colour are the same; give one of them")
    key = "color" if "color" in table.content else "colour"
    if "image" in table.content and key in table.content:
        raise table.error("image", f"lies instead of the {key}; give one of them")
    image = table.file("image")
    if image is not None and cv2.imread(str(image), cv2.IMREAD_COLOR) is None:
        raise table.error(
            "image", f"names {image}, which is no picture that can be read; save it as PNG or JPEG"
        )
    finish = table.get("finish", one_of(FINISHES), None)
    return Material(table.get(key, _as_colour, (0.6, 0.6, 0.6)), image, finish)


def _as_shadow(value: Any) -> CastShadow:
    if not isinstance(value, dict) or set(value) != set(_SHADOW_KEYS):
        raise ValueError("must say foot, top and tip: { foot = [u, v], top = [u, v], tip = [u, v] }")
    foot, top, tip = (pair(value[key]) for key in _SHADOW_KEYS)
    return CastShadow(foot, top, tip)


def _as_colour(value: Any) -> RGB:
    if isinstance(value, str):
        return colour(value)
    r, g, b = numbers(3)(value)
    return colour((r, g, b))
