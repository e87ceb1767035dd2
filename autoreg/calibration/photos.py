"""Photos of boards: their files, what each shows, searched in parallel."""

from __future__ import annotations

import glob
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from autoreg.calibration.board import Board
from autoreg.calibration.corners import trouble
from autoreg.calibration.detection import Detection, find_board, nothing
from autoreg.errors import InputError
from autoreg.formats.exif import Exif, read_exif
from autoreg.image import as_gray, load_photo, pyramid

Source = str | Path | np.ndarray
Progress = Callable[[int, int], None]

_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".bmp", ".heic", ".heif")
# `--pattern auto` looks at so many photos, reduced to so many pixels.
_LOOKED_AT, _LOOKED_AT_PIXELS = 8, 1_000_000


@dataclass(frozen=True)
class BoardPhoto:
    """A photo and what of the board was found in it.

    Attributes:
        name: as messages quote it.
        stored: width and height as the file stores it, before EXIF turns it; (0, 0) if it cannot be read.
        exif: what its EXIF says.
        detection: the corners, in pixels of the picture as its EXIF turns it, or why there are none.
    """

    name: str
    stored: tuple[int, int]
    exif: Exif
    detection: Detection

    @property
    def corners_stored_px(self) -> Float[np.ndarray, "n 2"]:
        """The corners in the picture as the file stores it, which is how the sensor saw it."""
        px = self.detection.corners_px
        width, height = self.stored
        for turns_left in range(self.exif.turned % 4, 0, -1):
            # One clockwise turn takes (u, v) of a picture h high to (h - 1 - v, u).
            high = height if turns_left % 2 == 1 else width
            px = np.column_stack([px[:, 1], high - 1 - px[:, 0]])
        if self.exif.mirrored:
            px = np.column_stack([width - 1 - px[:, 0], px[:, 1]])
        return px


def sources_of(photos: str | Path | Iterable[Source]) -> list[Source]:
    """The photos that a pattern, a folder, or files and pictures stand for.

    Raises:
        InputError: there are none.
        ValueError: it is nothing of these.
    """
    if isinstance(photos, (str, Path)):
        return list(photo_files([photos]))
    if not isinstance(photos, Iterable):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise ValueError(f"photos must be a glob pattern, a folder, or files or pictures, got {photos!r}")
    sources: list[Source] = []
    for photo in photos:
        sources += [photo] if isinstance(photo, np.ndarray) else photo_files([photo])
    if not sources:
        raise InputError("no photos were given; give photos of the board, such as 'boards/*.jpg'")
    return sources


def photo_files(sources: Iterable[str | Path]) -> tuple[Path, ...]:
    """The picture files that names, folders and glob patterns stand for, each once, in natural order.

    Raises:
        InputError: something stands for no file.
    """
    files: dict[Path, None] = {}
    for source in sources:
        files.update(dict.fromkeys(_files_of(str(source))))
    return tuple(files)


def _files_of(text: str) -> list[Path]:
    if os.path.isdir(text):
        found = [path for path in Path(text).iterdir() if path.suffix.lower() in _SUFFIXES]
        missing = f"the folder {text} holds no pictures ({', '.join(_SUFFIXES)})"
    elif os.path.lexists(text):
        return [Path(text)]
    else:
        found = [Path(name) for name in glob.glob(os.path.expanduser(text), recursive=True)]
        found = [path for path in found if path.is_file()]
        missing = f"no photo matches {text!r}"
    if not found:
        raise InputError(f"{missing}; give photos of the board, such as 'boards/*.jpg'")
    return sorted(found, key=_natural)


def _natural(path: Path) -> list[tuple[int, str]]:
    """A key that puts photo2 before photo10."""
    return [(int(part) if part.isdigit() else -1, part) for part in re.split(r"(\d+)", str(path))]


def search_photos(
    sources: Sequence[Source], board: Board, progress: Progress | None = None, workers: int | None = None
) -> tuple[BoardPhoto, ...]:
    """What each photo shows of a board; a photo that cannot be read, or shows none, says why.

    Args:
        sources: files, or pictures as arrays (grey or BGR).
        board: what to look for.
        progress: is told how many photos of how many are done.
        workers: photos searched at once; one for each processor by default.
    """
    workers = max(1, min(workers or os.cpu_count() or 1, len(sources)))
    found: dict[int, BoardPhoto] = {}
    before = cv2.getNumThreads()
    # One thread for each photo: OpenCV's own threads would only get into each other's way.
    cv2.setNumThreads(1 if workers > 1 else before)
    try:
        with ThreadPoolExecutor(workers) as pool:
            jobs = {pool.submit(_searched, source, k, board): k for k, source in enumerate(sources)}
            try:
                for done, job in enumerate(as_completed(jobs), start=1):
                    found[jobs[job]] = job.result()
                    if progress is not None:
                        progress(done, len(sources))
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    finally:
        cv2.setNumThreads(before)
    return tuple(found[k] for k in range(len(sources)))


def _searched(source: Source, index: int, board: Board) -> BoardPhoto:
    name = name_of(source, index)
    try:
        gray, exif = _read(source)
    except (InputError, ValueError) as error:
        return BoardPhoto(name, (0, 0), Exif(), nothing(str(error)))
    height, width = gray.shape if exif.turned % 2 == 0 else gray.shape[::-1]
    return BoardPhoto(name, (width, height), exif, find_board(gray, board))


def name_of(source: Source, index: int) -> str:
    """What messages call a photo."""
    return f"photo {index + 1}" if isinstance(source, np.ndarray) else Path(source).name


def _read(source: Source) -> tuple[np.ndarray, Exif]:
    """The picture as its EXIF turns it, in grey, and its EXIF."""
    if isinstance(source, np.ndarray):
        return as_gray(source), Exif()
    photo = load_photo(source)
    return photo.gray, read_exif(Path(source).read_bytes())


def find_pattern(sources: Sequence[Source]) -> tuple[int, int] | None:
    """Inner corners along the longer and the shorter side of the board that most photos show, or None.

    The sector-based detector grows a small grid as far as it goes; the size that most of a sample of photos
    agree on is the board's, because a hidden or cut-off board only ever looks smaller.
    """
    step = max(1, len(sources) // _LOOKED_AT)
    votes: Counter[tuple[int, int]] = Counter()
    for source in sources[::step][: 2 * _LOOKED_AT]:
        try:
            small, _ = pyramid(_read(source)[0], _LOOKED_AT_PIXELS)
        except (InputError, ValueError):
            continue
        flags = cv2.CALIB_CB_LARGER + cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners, meta = cv2.findChessboardCornersSBWithMeta(small, (3, 3), flags)
        if found and np.ndim(meta) == 2 and _regular(corners, meta, small):
            votes[max(meta.shape[:2]), min(meta.shape[:2])] += 1
    if not votes:
        return None
    most = max(votes.values())
    return max(size for size, count in votes.items() if count == most)


def _regular(corners: np.ndarray, meta: np.ndarray, picture: np.ndarray) -> bool:
    """Whether the corners that the detector grew are a board's; it makes small grids of anything blotchy."""
    grid = np.asarray(corners, float).reshape(*meta.shape[:2], 2)
    return trouble(grid, np.zeros(grid.shape[:2]), picture.shape[1], picture.shape[0]) is None
