"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Collection, Generator, Iterable
from contextlib import contextmanager, suppress
from hashlib import sha256
from itertools import count
from pathlib import Path

import cv2
import numpy as np

from autoreg.errors import InputError


def as_paths(record: object, *names: str) -> None:
    """Make paths of those fields of a frozen dataclass that were given as text."""
    for name in names:
        value = getattr(record, name)
        if isinstance(value, str):
            object.__setattr__(record, name, Path(value))


def write_whole(path: Path, content: bytes) -> Path:
    """The path, which now holds `content`; if anything fails it holds what it held before.

    The bytes go to a hidden file beside it, which then takes its name: a rename within one folder
    happens at once, so no reader ever sees half a file, whatever interrupts the writing.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(content)
        os.replace(part, path)
    except OSError as error:
        part.unlink(missing_ok=True)
        # A full disk does not say by itself what it has no place for.
        raise OSError(error.errno, error.strerror, str(path)) from error
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    return path


def write_png(path: Path, image: np.ndarray) -> Path:
    """The path of a lossless picture (grey, BGR or BGRA), written whole."""
    # Level 1 is several times faster than the default on a photo, and not much bigger; one kind of filter for
    # all rows is twice as fast again as the choice of the best for each, and smaller.
    options = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP]
    done, encoded = cv2.imencode(".png", image, options)
    if not done:
        raise ValueError(f"a picture of shape {image.shape} and type {image.dtype} has no PNG form")
    return write_whole(path, encoded.tobytes())


def usable_folder(folder: Path) -> Path:
    """The folder itself, if results can be written there; nothing is made yet.

    Raises:
        InputError: a file stands in the way, or the place may not be written to.
    """
    place = folder.absolute()
    while not os.path.lexists(place):
        place = place.parent
    if not place.is_dir():
        raise InputError(f"{place} is a file, so the folder {folder} cannot be made; give another with -o")
    if not os.access(place, os.W_OK | os.X_OK):
        raise InputError(f"nothing may be written in {place}; give another folder with -o")
    return folder


# Stands in a scene's last line, before the digest of all that comes before it.
SEAL = b"// As autoreg wrote it, as long as this is the SHA-256 of all above: "
REPORT_NAME, SCENE_NAME, OVERLAY_NAME = "alignment.json", "scene.pov", "overlay.png"
# The pictures and texts of one run; a later run into the same folder must not mix with them.
RESULT_NAMES = (
    OVERLAY_NAME,
    SCENE_NAME,
    "scene-photo.png",
    "scene-undistorted.png",
    "render.png",
    "composite.png",
)


def results_in(folder: Path) -> list[Path]:
    """All that a run writes into a folder, or takes away from it."""
    # Meshes and pictures of a scene's objects are named after them.
    objects = [*folder.glob("scene-thing_*.inc"), *folder.glob("scene-thing_*.png")]
    return [folder / REPORT_NAME, *(folder / name for name in RESULT_NAMES), *objects]


def kept_apart(inputs: Iterable[Path | None], outputs: Iterable[Path]) -> None:
    """Nothing, if no file that is read would be written over.

    Raises:
        InputError: one would be.
    """
    there = [path for path in outputs if path.exists()]
    for given in inputs:
        if given is None or not given.exists():
            continue
        if any(given.samefile(path) for path in there):
            raise InputError(f"{given} would be written over by the results; give another folder with -o")


def places_free(outputs: Iterable[Path]) -> None:
    """Nothing, if no folder has the name of a file that is to be written.

    Raises:
        InputError: one has.
    """
    for path in outputs:
        if path.is_dir():
            raise InputError(
                f"the folder {path} is in the way of the file of that name; move it, or give another folder "
                "with -o"
            )


@contextmanager
def whole_run(folder: Path, note: Callable[[str], None], staying: Collection[str] = ()) -> Generator[Path]:
    """A hidden folder for a run's results, which take their places in `folder` when all of them are there.

    Only then do an earlier run's give way, but for those of the names that are `staying`, and all of them
    stay if anything fails; `note` is told what is kept.

    Raises:
        InputError: the folder cannot be made, or takes no files.
    """
    fresh = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        hidden = Path(tempfile.mkdtemp(prefix=".run-", dir=folder))
    except OSError as error:
        raise InputError(
            f"the results cannot be written in {folder}: {error.strerror}; give another folder with -o"
        ) from error
    try:
        yield hidden
        keep_edited(folder, note)
        clear_results(folder, staying)
        # The report says that all that it stands beside is there.
        for path in sorted(hidden.iterdir(), key=lambda path: path.name == REPORT_NAME):
            os.replace(path, folder / path.name)
    except BaseException as error:
        shutil.rmtree(hidden, ignore_errors=True)
        if fresh:
            with suppress(OSError):
                folder.rmdir()
        if isinstance(error, OSError) and error.filename is not None:
            name = Path(error.filename)
            # Nobody knows of the hidden folder.
            place = folder / name.name if name.parent == hidden else name
            raise OSError(error.errno, error.strerror, str(place)) from error
        raise
    hidden.rmdir()


def clear_results(folder: Path, staying: Collection[str] = ()) -> None:
    """Take away an earlier run's results, so that a folder never shows two runs at once.

    Only in a folder that holds an alignment.json: any other is not known to be ours. Those of the names that
    are `staying` do.
    """
    report, *others = results_in(folder)
    if report.is_file():
        for path in others:
            if path.name not in staying:
                path.unlink(missing_ok=True)
        report.unlink()


def sealed(text: str) -> bytes:
    """A scene's text as it is written, with what tells whether anybody has changed it since."""
    content = text.encode()
    return content + SEAL + sha256(content).hexdigest().encode() + b"\n"


def is_sealed(content: bytes) -> bool:
    """Whether what a scene's file holds is as it was written."""
    text, _, digest = content.rpartition(SEAL)
    return digest.strip() == sha256(text).hexdigest().encode()


def keep_edited(folder: Path, note: Callable[[str], None]) -> None:
    """Give a scene.pov that is not as a run wrote it another name, and say so: the next writes over it."""
    scene = folder / SCENE_NAME
    if not scene.is_file() or is_sealed(scene.read_bytes()):
        return
    names = (f"scene-edited-{number}.pov" for number in count(1))
    free = next(folder / name for name in names if not (folder / name).exists())
    os.replace(scene, free)
    note(f"{scene} was changed after it had been written; it is kept as {free.name}")
