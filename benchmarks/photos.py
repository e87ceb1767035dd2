"""The folder of real photos: `paved/` to be aligned, and `refuse/`, pictures of other things."""

from __future__ import annotations

from pathlib import Path

from benchmarks.options import Options
from benchmarks.result import Result

SUFFIXES = (".jpg", ".jpeg", ".png")
QUICK_PHOTOS = 3


def photo_files(options: Options) -> list[tuple[Path, bool]]:
    """The photos, each with whether it is paved: the first few of them for a quick run."""
    files = [
        (path, kind == "paved")
        for kind in ("paved", "refuse")
        for path in sorted((options.photos / kind).glob("*"))
        if path.suffix.lower() in SUFFIXES
    ]
    return files[:QUICK_PHOTOS] if options.quick else files


def without_photos(suite: str, options: Options) -> Result:
    """What a suite says where there are none."""
    return Result(
        suite,
        skipped=f"{options.photos} has no photos in paved/ or refuse/ (--photos DIR)",
        absent=options.is_absent("photos"),
    )
