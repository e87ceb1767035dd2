"""Which photos can be of one camera: those of one frame size and one lens setting, however turned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from autoreg.calibration.board import BoardView
from autoreg.calibration.photos import BoardPhoto
from autoreg.camera import same_aspect
from autoreg.errors import InputError

# The largest group is calibrated if it holds at least this part of the boards found; else nobody can say
# which camera is meant.
LEAST_SHARE = 0.75
_FOCAL_TOLERANCE = 0.02


@dataclass(frozen=True)
class Group:
    """Photos that may be of one camera.

    Attributes:
        width: of the frame, in pixels, as the sensor sees it.
        height: likewise.
        lens: what EXIF says of camera and lens, or "".
        members: which photos.
        views: their corners in the frame.
        notes: sentences on what was done to bring them into one frame.
    """

    width: int
    height: int
    lens: str
    members: tuple[int, ...]
    views: tuple[BoardView, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Key:
    """What makes photos alike: frame size, camera, focal length."""

    width: int
    height: int
    camera: str
    focal_mm: float | None

    def fits(self, other: _Key) -> bool:
        """Whether photos of both may be of one camera; what EXIF leaves out contradicts nothing."""
        if self.camera and other.camera and self.camera != other.camera:
            return False
        a, b = self.focal_mm, other.focal_mm
        if a is not None and b is not None and abs(a - b) > _FOCAL_TOLERANCE * a:
            return False
        if abs(self.width - other.width) <= 1 and abs(self.height - other.height) <= 1:
            return True
        # Another resolution of the same frame: only if EXIF says that camera and lens are the same.
        same = bool(self.camera) and self.camera == other.camera and a is not None and b is not None
        return same and same_aspect(self.width, self.height, other.width, other.height)

    @property
    def words(self) -> str:
        """The key as messages quote it."""
        lens = f" at {self.focal_mm:g} mm" if self.focal_mm else ""
        camera = f", {self.camera}{lens}" if self.camera or lens else ""
        return f"{self.width} x {self.height}{camera}"


def one_camera(photos: Sequence[BoardPhoto]) -> tuple[Group, tuple[tuple[str, str], ...]]:
    """The group of photos to calibrate, and the names and reasons of those that are not of it.

    Args:
        photos: all photos; those without a board are passed over.

    Raises:
        InputError: no group holds most of the boards.
    """
    groups: list[tuple[_Key, list[int]]] = []
    for k, photo in enumerate(photos):
        if not photo.detection.found:
            continue
        key = _key(photo)
        for index, (first, members) in enumerate(groups):
            if first.fits(key):
                members.append(k)
                # EXIF that only some of the photos have still tells the others apart.
                if not first.camera or first.focal_mm is None:
                    groups[index] = (_Key(first.width, first.height, first.camera or key.camera,
                                          first.focal_mm or key.focal_mm), members)  # fmt: skip
                break
        else:
            groups.append((key, [k]))
    groups.sort(key=lambda group: -len(group[1]))
    total = sum(len(members) for _, members in groups)
    key, members = groups[0]
    if len(members) < LEAST_SHARE * total:
        raise _mixture(groups, photos)
    left_out = tuple((photos[k].name, _why_not(key, other)) for other, others in groups[1:] for k in others)
    return _gathered(key, members, photos), left_out


def _key(photo: BoardPhoto) -> _Key:
    exif = photo.exif
    camera = " ".join(word for word in (exif.maker, exif.model) if word)
    return _Key(*photo.stored, camera, exif.focal_mm)


def _gathered(key: _Key, members: Sequence[int], photos: Sequence[BoardPhoto]) -> Group:
    """The group's corners in one frame: turned as EXIF says, scaled where the size differs."""
    chosen = [photos[k] for k in members]
    sizes = [photo.stored for photo in chosen]
    width, height = max(set(sizes), key=sizes.count)
    turned = [photo for photo in chosen if photo.exif.turned % 4]
    # A camera file is taken to be of pictures that stand as their EXIF turns them, if that is by half a turn.
    upside_down = sum(photo.exif.turned % 4 == 2 for photo in chosen) > len(chosen) / 2
    views: list[BoardView] = []
    for photo in chosen:
        scale = np.array([width / photo.stored[0], height / photo.stored[1]])
        px = (photo.corners_stored_px + 0.5) * scale - 0.5
        if upside_down:
            px = np.array([width - 1, height - 1]) - px
        views.append(BoardView(photo.name, photo.detection.ids, px))
    notes: list[str] = []
    if turned and not all(photo.exif.turned % 4 == 2 for photo in chosen):
        notes.append(
            f"{len(turned)} of {len(chosen)} photos were turned back, as their EXIF says, into the frame of "
            f"the sensor, {width} x {height}"
        )
    for size in sorted(set(sizes) - {(width, height)}):
        names = [photo.name for photo in chosen if photo.stored == size]
        notes.append(f"scaled from {size[0]} x {size[1]} to {width} x {height}: {', '.join(names)}")
    return Group(width, height, key.words, tuple(members), tuple(views), tuple(notes))


def _why_not(main: _Key, other: _Key) -> str:
    if (other.height, other.width) == (main.width, main.height) and main.width != main.height:
        return (
            f"it is {other.width} x {other.height}, on its side against the others, and carries no EXIF "
            "orientation that says which way it was turned"
        )
    return f"it is of another camera or setting ({other.words}) than most ({main.words})"


def _mixture(groups: Sequence[tuple[_Key, list[int]]], photos: Sequence[BoardPhoto]) -> InputError:
    lines = [
        f"  {len(members)} of {key.words}: {few([photos[k].name for k in members])}"
        for key, members in groups
    ]
    return InputError(
        "the photos cannot all be of one camera at one setting; calibrate each group by itself, as the "
        "camera took them (unturned, uncropped, one zoom):\n" + "\n".join(lines)
    )


def few(names: Sequence[str]) -> str:
    """Names for a message: all of a few, or the first and the last of many."""
    return ", ".join(names) if len(names) <= 4 else f"{', '.join(names[:3])} ... {names[-1]}"
