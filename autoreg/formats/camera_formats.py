"""Texts that describe a camera: autoreg's JSON, OpenCV FileStorage, ROS camera_info, COLMAP's cameras.txt."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from xml.etree import ElementTree

import numpy as np

from autoreg.camera import Camera
from autoreg.errors import InputError
from autoreg.formats.camera_fields import array, distortion, find, number, numbers, scalar, shown, whole

FORMATS = "autoreg JSON, OpenCV YAML or XML, ROS camera_info YAML, COLMAP cameras.txt"

_COLMAP_LINE = re.compile(r"^\s*\d+\s+[A-Z][A-Z0-9_]*\s+\S+\s+\S+")

# Each field under the names that calibration.cpp, the calibration tutorial, interactive-calibration and
# ROS (camera_info files and dumped messages) give it, in lower case.
_WIDTH = ("image_width", "width")
_HEIGHT = ("image_height", "height")
_SIZE = ("cameraresolution",)
_MATRIX = ("camera_matrix", "cameramatrix", "k")
_DIST = ("distortion_coefficients", "dist_coeffs", "dist", "d")
_MODELS = (("distortion_model",), ("camera_model",))
_FISHEYE = ("fisheye_model", "fisheye")
_SKEW = ("skew",)
# The part of the calibrated frame that ROS's pictures show. Those that are binned have all of it, scaled.
_REGION = ("roi",)
_PLAIN_MODELS = ("", "none", "plumb_bob", "radtan", "rational", "rational_polynomial", "pinhole", "opencv")
# What a plain "model" of autoreg's own files names, which may be the make of the camera as well as its lens.
_OTHER_LENSES = re.compile(
    "fisheye|equidistant|equisolid|stereographic|orthographic|omni|kannala|mei|ucm|unified|double.?sphere|"
    "thin.?prism|division|fov",
    re.IGNORECASE,
)

# Names of COLMAP's parameters per model, in the order of the file.
_COLMAP_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}


def parse_camera(text: str) -> Camera:
    """The camera that a text in one of the formats describes; its content tells which.

    Raises:
        InputError: a key is missing, malformed or not supported.
        ValueError: a number that Camera does not accept.
        RecursionError: nested too deeply.
    """
    start = text.lstrip()
    if start.startswith("{"):
        return _from_json(text)
    if start.startswith("<"):
        return _from_xml(text)
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if "# Camera list" in text or (lines and _COLMAP_LINE.match(lines[0])):
        return _from_colmap(text)
    return _from_yaml(text)


def _from_json(text: str) -> Camera:
    try:
        content = json.loads(text)
    except ValueError as error:
        raise InputError(f"not valid JSON ({error}); write it again with the tool that made it") from error
    if not isinstance(content, dict):
        raise InputError(
            "JSON, but not an object {...}; autoreg's format has width, height, fx, fy, cx, cy, dist"
        )
    fields: dict[str, object] = content
    if "fx" not in fields and find(fields, _MATRIX) is not None:
        return _from_fields(fields)  # OpenCV's JSON
    names = ("width", "height", "fx", "fy", "cx", "cy", "dist")
    missing = [name for name in names if name not in fields]
    if missing:
        hint = ' (no distortion is "dist": [])' if missing == ["dist"] else ""
        raise InputError(f"key {missing[0]!r} is missing; add it{hint}: the format has {', '.join(names)}")
    for name in names[:-1]:
        if isinstance(fields[name], bool) or not isinstance(fields[name], (int, float)):
            raise InputError(f"key {name!r} must be a number, got {shown(fields[name])}; correct it")
    _refuse_other_models(fields)
    if _OTHER_LENSES.search(str(fields.get("model"))):
        raise _other_model("model", str(fields["model"]))
    width, height, fx, fy, cx, cy = (number(name, fields[name]) for name in names[:-1])
    if not isinstance(fields["dist"], list):
        raise InputError(f"key 'dist' must be a list of numbers, got {shown(fields['dist'])}; correct it")
    dist = distortion("dist", np.array(numbers("dist", fields["dist"])))
    return Camera(whole("width", width), whole("height", height), fx, fy, cx, cy, dist)


def _from_xml(text: str) -> Camera:
    """The camera of OpenCV's XML."""
    try:
        root = ElementTree.fromstring(text.strip())
    except ElementTree.ParseError as error:
        raise InputError(f"broken XML ({error}); write it again with the tool that made it") from error
    if root.tag != "opencv_storage":
        raise InputError(f"XML, but of <{root.tag}> and not of <opencv_storage>; give one of {FORMATS}")
    return _from_fields({element.tag: _xml_value(element) for element in root})


def _xml_value(element: ElementTree.Element) -> object:
    """A matrix as the mapping that YAML and JSON have for it, several words as a list, one word as it is."""
    parts = {child.tag: (child.text or "").split() for child in element}
    if parts:
        return {tag: words if tag in ("data", "sizes") else " ".join(words) for tag, words in parts.items()}
    words = (element.text or "").split()
    return words[0] if len(words) == 1 else words


def _from_yaml(text: str) -> Camera:
    """The camera of OpenCV's YAML, a ROS camera_info file, or a dumped CameraInfo message."""
    from autoreg.formats.camera_yaml import first_document

    try:
        content = first_document(text)
    except ValueError as error:
        place = shown(" ".join(str(error).split()), 150)
        raise InputError(f"in no known format (as YAML: {place}); give one of {FORMATS}") from error
    if not isinstance(content, dict):
        raise InputError(f"holds no keys of a camera; give one of {FORMATS}")
    return _from_fields({str(key): value for key, value in content.items()})


def _from_fields(fields: Mapping[str, object]) -> Camera:
    """The camera of a file with a camera matrix and a distortion vector (OpenCV's and ROS's)."""
    _refuse_other_models(fields)
    if find(fields, _SIZE) is None:
        width = whole(*scalar(fields, _WIDTH))
        height = whole(*scalar(fields, _HEIGHT))
    else:
        name, size = array(fields, _SIZE)
        if size.size != 2:
            raise InputError(f"key {name!r} must hold width and height, got {size.size} numbers")
        width, height = (whole(name, float(side)) for side in size.ravel())
    name, matrix = array(fields, _MATRIX)
    if matrix.size != 9 or (matrix.ndim == 2 and matrix.shape != (3, 3)):
        raise InputError(
            f"key {name!r} must be a 3x3 matrix, got shape {' x '.join(map(str, matrix.shape))}; correct it"
        )
    K = matrix.reshape(3, 3)
    if abs(K[0, 1]) > 1e-9 * abs(K[0, 0]) or K[1, 0] or list(K[2]) != [0, 0, 1]:
        raise InputError(
            f"key {name!r} must read fx 0 cx / 0 fy cy / 0 0 1: skew is not supported; got {K.tolist()}"
        )
    _refuse_region(fields, width, height)
    name, dist = array(fields, _DIST)
    return Camera(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], distortion(name, dist.ravel()))


def _refuse_other_models(fields: Mapping[str, object]) -> None:
    """Refuse a camera of which a key says what Camera cannot hold."""
    fisheye = find(fields, _FISHEYE)
    if fisheye is not None and str(fields[fisheye]).lower() not in ("0", "false", "none"):
        raise _other_model(fisheye, "fisheye")
    for names in _MODELS:
        found = find(fields, names)
        model = "" if found is None or fields[found] is None else str(fields[found]).strip()
        if found is not None and model.lower() not in _PLAIN_MODELS:
            raise _other_model(found, model)
    skew = find(fields, _SKEW)
    if skew is not None and fields[skew] is not None and number(f"key {skew!r}", fields[skew]) != 0:
        raise InputError(
            f"key {skew!r} is {shown(fields[skew])}, and skew is not supported; calibrate without it"
        )


def _other_model(key: str, model: str) -> InputError:
    return InputError(
        f"{key} is {shown(model)}, which is not supported; calibrate with plumb_bob or rational_polynomial, "
        "or undistort the photo and give its pinhole camera"
    )


def _refuse_region(fields: Mapping[str, object], width: int, height: int) -> None:
    """Refuse a camera whose pictures show a part of the calibrated frame: how this was cut is not guessed."""
    found = find(fields, _REGION)
    region = None if found is None else fields[found]
    if found is None or not isinstance(region, Mapping):
        return
    sides = ("x_offset", "y_offset", "width", "height")
    x, y, w, h = (number(f"{found}.{side}", region.get(side, 0)) for side in sides)
    if w > 0 and h > 0 and (w, h) != (width, height):
        cut = f"{x:g},{y:g},{w:g},{h:g}"
        raise InputError(
            f"key {found!r} says that the pictures are a part of the calibrated {width}x{height} ({cut}); "
            f"take the key out of the file, and say --crop {cut} if this photo was cut like that"
        )


def _from_colmap(text: str) -> Camera:
    """The camera of COLMAP's cameras.txt; COLMAP's (0, 0) is the corner of the top-left pixel."""
    cameras: dict[str, Camera] = {}
    for line in text.splitlines():
        words = line.split()
        if words and not words[0].startswith("#"):
            cameras[words[0]] = _colmap_camera(words)
    if not cameras:
        raise InputError("COLMAP's cameras.txt without any camera; export the model again")
    if len(set(cameras.values())) > 1:
        raise InputError(
            f"holds {len(cameras)} different cameras (ids {', '.join(cameras)}); "
            "keep only the line of this photo's camera"
        )
    return next(iter(cameras.values()))


def _colmap_camera(words: list[str]) -> Camera:
    if len(words) < 4:
        raise InputError(f"camera line {' '.join(words)!r} must read ID MODEL WIDTH HEIGHT PARAMS")
    identity, model = f"camera {words[0]}", words[1]
    if model not in _COLMAP_MODELS:
        raise InputError(
            f"{identity} has the model {model!r}, which is not supported; reconstruct with one of "
            f"{', '.join(_COLMAP_MODELS)}, or let COLMAP undistort the photo"
        )
    names = _COLMAP_MODELS[model].split()
    if len(words) != 4 + len(names):
        raise InputError(
            f"{identity}: {model} takes {len(names)} parameters ({' '.join(names)}), got {len(words) - 4}"
        )
    width, height = (
        whole(f"{identity} {k}", number(k, w)) for k, w in zip(("width", "height"), words[2:4], strict=True)
    )
    values = {k: number(f"{identity} {k}", word) for k, word in zip(names, words[4:], strict=True)}
    fx, fy = (values.get(axis, values.get("f", math.nan)) for axis in ("fx", "fy"))
    dist = tuple(values.get(k, 0.0) for k in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"))
    return Camera(width, height, fx, fy, values["cx"] - 0.5, values["cy"] - 0.5, dist)
