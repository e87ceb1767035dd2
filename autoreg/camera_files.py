"""Camera files: read in any of the formats, written in autoreg's own, with what they say of themselves."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path

from autoreg.camera import Camera
from autoreg.errors import InputError
from autoreg.formats.camera_formats import FORMATS, parse_camera

# Focal lengths that lenses have, in longer sides of the picture.
_FOCAL_LENGTHS = (0.01, 1000.0)
# A camera file of any of the formats is a few kilobytes; more is a picture or a log given by mistake.
_MAX_BYTES = 4_000_000


def read_camera(path: str | Path) -> Camera:
    """The camera of a file, whose format is told by its content.

    Raises:
        InputError: the file cannot be read, or a key of it is missing, malformed or not supported.
    """
    path = Path(path)
    text = _text_of(path)
    try:
        return _possible(parse_camera(text))
    except InputError as error:
        raise InputError(f"camera file {path}: {error}") from error
    except ValueError as error:  # a number that Camera does not accept, named by Camera
        raise InputError(f"camera file {path}: {error}; correct it in the file") from error
    except RecursionError as error:
        raise InputError(f"camera file {path}: nested too deeply; give one of {FORMATS}") from error


def _possible(camera: Camera) -> Camera:
    """The camera, if some lens may have its focal length.

    Raises:
        InputError: none has.
    """
    longer = max(camera.width, camera.height)
    for name, focal in (("fx", camera.fx), ("fy", camera.fy)):
        if not _FOCAL_LENGTHS[0] <= focal / longer <= _FOCAL_LENGTHS[1]:
            raise InputError(
                f"{name} must be between {_FOCAL_LENGTHS[0]:g} and {_FOCAL_LENGTHS[1]:g} times the longer "
                f"side of the picture ({longer} pixels), got {focal:.6g} pixels; correct it"
            )
    return camera


def read_camera_record(path: str | Path) -> Mapping[str, object]:
    """All that a camera file in autoreg's own format says; nothing for other formats.

    Raises:
        InputError: the file cannot be read.
    """
    try:
        content = json.loads(_text_of(Path(path)))
    except (ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def distrust(path: str | Path) -> str | None:
    """Why a camera file says of itself that it should not be used, or None."""
    quality = read_camera_record(path).get("quality")
    if not isinstance(quality, dict) or quality.get("verdict") != "do not use":
        return None
    reasons = quality.get("reasons")
    said = "; ".join(map(str, reasons)) if isinstance(reasons, list) else "see its report"
    return f"the camera file {path} says of itself: do not use: {said}"


def write_camera_json(camera: Camera, path: str | Path, record: Mapping[str, object] | None = None) -> None:
    """Write a camera in autoreg's own format, whole or not at all.

    Args:
        camera: the camera.
        path: where.
        record: what else to say of it: its accuracy, where it is valid, how it was made.
    """
    path = Path(path)
    names = ("width", "height", "fx", "fy", "cx", "cy")
    fields: dict[str, object] = {name: getattr(camera, name) for name in names}
    # Five coefficients unless the rational ones are used: more programs understand the short form.
    fields["dist"] = list(camera.dist if any(camera.dist[5:]) else camera.dist[:5])
    fields |= record or {}
    beside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        beside.write_text(json.dumps(fields, indent=1) + "\n", encoding="utf-8")
        beside.replace(path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise InputError(
            f"cannot write camera file {path}: {error.strerror}; choose another place"
        ) from error


def _text_of(path: Path) -> str:
    # os.path answers "no" where Path raises: names that are too long, folders that may not be searched.
    if not os.path.exists(path):
        raise InputError(f"camera file {path} does not exist; check the path")
    if not os.path.isfile(path):
        raise InputError(f"camera file {path} is not a file; give the file itself ({FORMATS})")
    try:
        with path.open("rb") as file:
            data = file.read(_MAX_BYTES + 1)
    except OSError as error:
        raise InputError(
            f"camera file {path} cannot be read: {error.strerror}; check its permissions"
        ) from error
    if len(data) > _MAX_BYTES:
        raise InputError(f"camera file {path} is larger than {_MAX_BYTES} bytes; give one of {FORMATS}")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise InputError(f"camera file {path} is not UTF-8 text; give one of {FORMATS}")
    if not text.strip():
        raise InputError(f"camera file {path} is empty; give one of {FORMATS}")
    return text
