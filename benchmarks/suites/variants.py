"""Real photos, changed in ways that change no slab: is the answer still the same?

Nobody has measured these grounds, but what is true of a photo is true of its mirror image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from autoreg.align import align
from autoreg.alignment import Alignment
from autoreg.errors import Refusal
from autoreg.image import load_photo
from benchmarks.metrics import Figure
from benchmarks.options import Options
from benchmarks.parallel import measured
from benchmarks.photos import photo_files, without_photos
from benchmarks.result import Result, Table

Gray = UInt8[np.ndarray, "h w"]

# Logarithms by which the slab's sides, in camera heights, may differ from those of the photo as it is. Cut to
# a part, a photo has its principal point elsewhere than in the middle, where it is taken to be.
WHOLE_TOLERANCE, PART_TOLERANCE = 0.15, 0.5
# Larger photos are looked at in this size.
MOST_PIXELS = 3e6


@dataclass(frozen=True)
class Variant:
    """One way to change a photo, and by how much its answer may differ then."""

    name: str
    make: Callable[[Gray], Gray]
    tolerance: float = WHOLE_TOLERANCE


def _part(x: tuple[float, float], y: tuple[float, float]) -> Callable[[Gray], Gray]:
    """The part of a picture between two shares of its width and two of its height."""

    def cut(gray: Gray) -> Gray:
        height, width = gray.shape
        rows, columns = (slice(int(a * n), int(b * n)) for (a, b), n in ((y, height), (x, width)))
        return np.ascontiguousarray(gray[rows, columns])

    return cut


def resized(gray: Gray, scale: float) -> Gray:
    """The picture so many times as large."""
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    return cv2.resize(gray, None, fx=scale, fy=scale, interpolation=how).astype(np.uint8)


def _recompressed(gray: Gray) -> Gray:
    encoded = cv2.imencode(".jpg", gray, [cv2.IMWRITE_JPEG_QUALITY, 30])[1]
    return np.asarray(cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE), np.uint8)


def _noisy(gray: Gray) -> Gray:
    noise = np.random.default_rng(1).normal(0.0, 8.0, gray.shape)
    return np.clip(np.rint(gray + noise), 0, 255).astype(np.uint8)


VARIANTS = (
    Variant("mirrored", lambda gray: np.ascontiguousarray(gray[:, ::-1])),
    Variant("left 70 %", _part((0.0, 0.7), (0.0, 1.0)), PART_TOLERANCE),
    Variant("right 70 %", _part((0.3, 1.0), (0.0, 1.0)), PART_TOLERANCE),
    Variant("lower 70 %", _part((0.0, 1.0), (0.3, 1.0)), PART_TOLERANCE),
    Variant("0.6 times", lambda gray: resized(gray, 0.6)),
    Variant("1.5 times", lambda gray: resized(gray, 1.5)),
    Variant("darker", lambda gray: np.rint(255.0 * (gray / 255.0) ** 1.8).astype(np.uint8)),
    Variant("JPEG at 30", _recompressed),
    Variant("noise of 8", _noisy),
)


def same_ground(one: Alignment, other: Alignment, tolerance: float) -> bool:
    """Whether two answers show the same slabs, by their bond and their sides in camera heights.

    Of rows it is their width alone that is compared, with a side of the slabs of any lattice.
    """
    mine, theirs = _sides_in_heights(one), _sides_in_heights(other)
    if len(mine) == len(theirs) == 2:
        return one.lattice.kind == other.lattice.kind and bool((np.abs(mine - theirs) < tolerance).all())
    return bool((np.abs(mine[:, None] - theirs) < tolerance).any())


def _sides_in_heights(found: Alignment) -> np.ndarray:
    """Logarithms of the sides that are known, the shorter one first."""
    lattice, height = found.lattice, float(found.pose.cam_from_ground.origin_in_a[2])
    sides = [side for side in (lattice.spacing_x, lattice.spacing_y) if side is not None]
    return np.log(np.sort(sides) / height)


def _aligned(gray: Gray) -> Alignment | None:
    try:
        return align(gray, None)
    except Refusal:
        return None


def _became(base: Alignment | None, found: Alignment | None, variant: Variant, paved: bool) -> str:
    if found is None:
        return "refused"
    if not paved:
        return "CONTRADICTED"
    if base is None:
        return f"{found.lattice.kind}?"
    same = same_ground(base, found, variant.tolerance)
    return found.lattice.kind if same else "CONTRADICTED"


def _row(photo: tuple[Path, bool]) -> tuple[str, ...]:
    """What became of a photo, paved or not, and of its variants."""
    path, paved = photo
    gray = load_photo(path).gray
    if gray.size > MOST_PIXELS:
        gray = resized(gray, float(np.sqrt(MOST_PIXELS / gray.size)))
    base = _aligned(gray)
    became = [_became(base, _aligned(v.make(gray)), v, paved) for v in VARIANTS]
    return (path.name, "refused" if base is None else base.lattice.kind, *became)


def run(options: Options) -> Result:
    """Every photo of the folder, in every variant."""
    files = photo_files(options)
    if not files:
        return without_photos("variants", options)
    rows = measured(_row, files, options.jobs)
    told = [became for row in rows if row[1] != "refused" for became in row[2:]]
    every = [became for row in rows for became in row[2:]]
    wrong = every.count("CONTRADICTED")
    kept = sum(became not in ("refused", "CONTRADICTED") for became in told)
    return Result(
        "variants",
        about=(
            f"{len(rows)} photos without a camera, as they are and changed in {len(VARIANTS)} ways. An "
            "answer contradicts that of the photo as it is if the bond is another one or the slab's sides, "
            f"in camera heights, differ by more than {WHOLE_TOLERANCE:.0%} ({PART_TOLERANCE:.0%} where the "
            "photo is cut, which moves its principal point), or if it is one of a picture of something else. "
            "'kind?' is an answer where the photo as it is was refused."
        ),
        figures=(
            Figure("variants.contradicted", 100.0 * wrong / len(every)),
            Figure("variants.kept", 100.0 * kept / max(len(told), 1)),
        ),
        tables=(Table("Photos", ("photo", "as it is", *(v.name for v in VARIANTS)), tuple(rows)),),
    )
