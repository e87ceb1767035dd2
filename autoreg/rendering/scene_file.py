"""A scene from its TOML file, with errors that name the key and the line."""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2

from autoreg.errors import InputError
from autoreg.rendering.letters import text_surface
from autoreg.rendering.mesh_files import read_mesh
from autoreg.rendering.objects import (
    FINISHES,
    RGB,
    Box,
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

T = TypeVar("T")

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
_LIGHT_KEYS = ("sun", "sky", "exposure")
_TOP_KEYS = ("joints", "joint_colour", "focus", "light", "object")


def read_scene(path: Path) -> Scene:
    """The scene that a TOML file describes; files it names are found beside it.

    Raises:
        InputError: it cannot be read, or something in it is wrong; the message names the line.
    """
    try:
        text = path.read_text(encoding="utf-8")
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
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{name} is not valid TOML: {error}") from error
    top = _Table(content, name, text, "", 0, folder)
    top.known(_TOP_KEYS)
    joint_colour = top.get("joint_colour", _as_colour, (1.0, 0.7, 0.0))
    light = top.get("light", _as_table, {})
    objects = top.get("object", _as_tables, [])
    return Scene(
        tuple(_object(_Table(entry, name, text, "object", n, folder), n) for n, entry in enumerate(objects)),
        _light(_Table(light, name, text, "light", 0, folder)),
        top.get("joints", _as_flag, False),
        joint_colour,
        top.get("focus", _pair, None),
    )


@dataclass(frozen=True)
class _Table:
    """One table of the file, and where it is, for the messages."""

    content: dict[str, Any]
    name: str
    text: str
    header: str
    number: int
    folder: Path

    def error(self, key: str, words: str) -> InputError:
        line = self._line(key)
        what = f"[[object]] {self.number + 1}" if self.header == "object" else f"[{self.header}]"
        inside = f" in {what}" if self.header else ""
        return InputError(f"{self.name} line {line}: {key}{inside} {words}")

    def known(self, keys: tuple[str, ...]) -> None:
        """Raise InputError for a key that has no meaning here."""
        for key in self.content:
            if key not in keys:
                near = difflib.get_close_matches(key, keys, 1)
                advice = f'did you mean "{near[0]}"?' if near else f"known are {', '.join(keys)}"
                raise self.error(key, f"is not known; {advice}")

    def get(self, key: str, read: Callable[[Any], T], default: T) -> T:
        return default if key not in self.content else self.need(key, read)

    def need(self, key: str, read: Callable[[Any], T]) -> T:
        """The value of a key, which must be there."""
        if key not in self.content:
            raise self.error(key, "is missing")
        try:
            return read(self.content[key])
        except ValueError as error:
            raise self.error(key, str(error)) from None

    def file(self, key: str) -> Path | None:
        """A file beside the scene."""
        if key not in self.content:
            return None
        path = self.folder / self.need(key, _as_text)
        if not path.is_file():
            raise self.error(key, f"names {path}, which does not exist")
        return path

    def _line(self, key: str) -> int:
        """The line of a key, or of the table that lacks it; TOML's parser does not tell them."""
        lines = self.text.splitlines()
        begin = 0
        if self.header:
            pattern = re.compile(rf"\s*\[{{1,2}}\s*[\"']?{self.header}[\"']?\s*\]{{1,2}}")
            headers = [n for n, line in enumerate(lines) if pattern.match(line)]
            begin = headers[min(self.number, len(headers) - 1)] if headers else 0
        for n in range(begin + bool(self.header), len(lines)):
            if self.header and re.match(r"\s*\[[\"'\w\[]", lines[n]) and "=" not in lines[n]:
                break
            if re.match(rf"\s*[\"']?{re.escape(key)}[\"']?\s*=", lines[n]):
                return n + 1
        tables = [n for n, line in enumerate(lines) if re.match(rf"\s*\[{{1,2}}\s*{re.escape(key)}\b", line)]
        return tables[0] + 1 if not self.header and tables else begin + 1


def _light(table: _Table) -> Light:
    table.known(_LIGHT_KEYS)
    sun = table.get("sun", _numbers(2), None)
    values: dict[str, Any] = {}
    if "sky" in table.content:
        values["sky"] = table.need("sky", _as_number)
    if "exposure" in table.content:
        values["exposure"] = table.need("exposure", _as_number)
    try:
        return Light(None if sun is None else (sun[0], sun[1]), **values)
    except ValueError as error:
        key, _, words = str(error).partition(" ")
        raise table.error(key, words) from None


def _object(table: _Table, number: int) -> Object:
    kind = table.need("shape", _one_of(tuple(_SHAPE_KEYS)))
    table.known((*_COMMON, *_SHAPE_KEYS[kind]))
    name = table.get("name", _as_text, f"{kind} {number + 1}")
    lift = table.get("lift", _as_number, 0.0)
    if lift < 0:
        raise table.error("lift", f"must not be negative, got {lift:g}: nothing can sink into the photo")
    try:
        shape = _shape(table, kind)
    except ValueError as error:
        key, _, words = str(error).partition(" ")
        raise table.error(key, words) from None
    return Object(name, shape, _place(table), _material(table), table.get("turn", _as_number, 0.0), lift)


def _shape(table: _Table, kind: str) -> Shape:
    length = lambda key: table.need(key, _as_number)  # noqa: E731
    match kind:
        case "box":
            x, y, z = table.need("size", _numbers(3))
            return Box((x, y, z))
        case "sphere":
            return Sphere(length("radius"))
        case "cylinder":
            return Cylinder(length("radius"), length("height"))
        case "cone":
            return Cone(length("radius"), length("height"), table.get("top_radius", _as_number, 0.0))
        case "torus":
            return Torus(length("radius"), length("tube"))
        case "text":
            height = length("height")
            depth = table.get("depth", _as_number, 0.2 * height)
            text = Text(table.need("text", _as_text), height, depth, table.file("font"))
            _assert_written(table, text)
            return text
        case _:
            return _mesh(table)


def _assert_written(table: _Table, text: Text) -> None:
    try:
        text_surface(text.text, text.height_m, text.depth_m, text.font)
    except ValueError as error:
        raise table.error(
            "font" if str(error).startswith("font") else "text", f"cannot be set: {error}"
        ) from None


def _mesh(table: _Table) -> Mesh:
    file = table.file("file")
    if file is None:
        raise table.error("file", "is missing")
    height = table.get("height", _as_number, None)
    scale = table.get("scale", _as_number, 1.0)
    if height is not None and "scale" in table.content:
        raise table.error("scale", "and height both say how large it is; give one of them")
    for key, value in (("height", height), ("scale", scale)):
        if value is not None and not value > 0:
            raise table.error(key, f"must be positive, got {value:g}")
    try:
        surface = read_mesh(file, "y" if table.get("up", _one_of(("y", "z")), "z") == "y" else "z")
        return Mesh(stand_up(surface, height_m=height, scale=scale))
    except ValueError as error:
        raise table.error("file", f": {error}") from None


def _place(table: _Table) -> Place:
    given = [key for key in _PLACES if key in table.content]
    if len(given) != 1:
        words = "is missing; say where it stands with one of slab, ground or pixel"
        if given:
            words = f"and {' and '.join(given[1:])} both say where it stands; give one of them"
        raise table.error(given[0] if given else "slab", words)
    if given[0] != "slab" and "offset" in table.content:
        raise table.error("offset", f"goes with slab, not with {given[0]}")
    if given[0] == "slab":
        i, j = table.need("slab", _integers(2))
        x, y = table.get("offset", _numbers(2), (0.0, 0.0))
        return OnSlab(i, j, (x, y))
    a, b = table.need(given[0], _numbers(2))
    return OnGround(a, b) if given[0] == "ground" else UnderPixel(a, b)


def _material(table: _Table) -> Material:
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
    finish = table.get("finish", _one_of(tuple(FINISHES)), None)
    return Material(table.get(key, _as_colour, (0.6, 0.6, 0.6)), image, finish)


def _as_number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"must be a number, got {value!r}")
    return float(value)


def _as_text(value: Any) -> str:
    if not isinstance(value, str) or not value:
        raise ValueError(f"must be a text in quotes, got {value!r}")
    return value


def _as_flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError(f"must be true or false, got {value!r}")
    return value


def _as_colour(value: Any) -> RGB:
    if isinstance(value, str):
        return colour(value)
    r, g, b = _numbers(3)(value)
    return colour((r, g, b))


def _as_table(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError("must be a table, such as [light]")
    return value


def _as_tables(value: Any) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise ValueError("must be written as [[object]], once for each")
    return value


def _numbers(count: int) -> Callable[[Any], tuple[float, ...]]:
    def read(value: Any) -> tuple[float, ...]:
        if not isinstance(value, list) or len(value) != count:
            raise ValueError(f"must be {count} numbers in brackets, got {value!r}")
        return tuple(_as_number(part) for part in value)

    return read


def _pair(value: Any) -> tuple[float, float]:
    x, y = _numbers(2)(value)
    return x, y


def _integers(count: int) -> Callable[[Any], tuple[int, ...]]:
    def read(value: Any) -> tuple[int, ...]:
        parts = _numbers(count)(value)
        if any(part != int(part) for part in parts):
            raise ValueError(f"must be {count} whole numbers in brackets, got {value!r}")
        return tuple(int(part) for part in parts)

    return read


def _one_of(names: tuple[str, ...]) -> Callable[[Any], str]:
    def read(value: Any) -> str:
        if value not in names:
            near = difflib.get_close_matches(str(value), names, 1)
            advice = f'did you mean "{near[0]}"?' if near else f"known are {', '.join(names)}"
            raise ValueError(f"{value!r} is not known; {advice}")
        return value

    return read
