"""Real photos: what becomes of each, a sheet of overlays to look at, and what is known to be right."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from autoreg.align import align_seen
from autoreg.alignment import Alignment
from autoreg.errors import Refusal
from autoreg.ground.sight import see
from autoreg.image import load_photo
from autoreg.jobs.overlay import overlay_picture
from benchmarks.metrics import Figure
from benchmarks.options import Options
from benchmarks.photos import photo_files, without_photos
from benchmarks.result import Picture, Result, Table

TILE, COLUMNS = (400, 320), 5
# Sides differ by no more than this from the ratio that the photo's slabs are known to have.
RATIO_TOLERANCE = 0.12


@dataclass(frozen=True)
class Expected:
    """What a photo is known to show: kinds of lattice that are right, and the long side over the short."""

    kinds: tuple[str, ...]
    ratio: float | None = None


# Taken from the notes of the photos' manifest, where they name a bond or call the slabs square; they are
# somebody's words, not measurements. Whole rows may be told where cross joints are too weak.
KNOWN = {
    "cmu_checker1.jpg": Expected(("stack",), 1.0),
    "cmu_pavement_bw.png": Expected(("running",)),
    "cmu_tiles5.jpg": Expected(("stack",), 1.0),
    "dp_blocks_grey_red.jpg": Expected(("running", "rows")),
    "dp_concrete_plates.png": Expected(("stack",), 1.0),
    "dp_large_slabs_pink.jpg": Expected(("running", "rows")),
    "dp_running_bond_glossy.jpg": Expected(("running", "rows")),
    "dp_square_slabs_speckled.jpg": Expected(("running",)),
    "hg_porcelain_10.jpg": Expected(("running",)),
    "ib_drive_xperia_18.jpg": Expected(("running", "rows")),
    "ib_slabs_main5.jpg": Expected(("running",)),
    "mj_brick_hose.jpg": Expected(("running", "rows")),
    "mj_square_slabs_wet.jpg": Expected(("stack",), 1.0),
}


@dataclass(frozen=True)
class Seen:
    """What became of one photo."""

    name: str
    paved: bool
    alignment: Alignment | None
    reason: str
    seconds: float
    tile: UInt8[np.ndarray, "h w 3"]

    @property
    def rms_permille(self) -> float:
        """RMS distance of the joints from their lines, in thousandths of the photo's diagonal."""
        found = self.alignment
        if found is None:
            return 0.0
        return 1e3 * found.residual.rms_px / float(np.hypot(found.width, found.height))

    @property
    def verdict(self) -> str:
        """Right, wrong, refused, or not known."""
        if self.alignment is None:
            return "refused" if self.paved else "right"
        if not self.paved:
            return "wrong"
        known = KNOWN.get(self.name)
        if known is None:
            return "look"
        return "right" if agrees(self.alignment, known) else "wrong"


def agrees(found: Alignment, known: Expected) -> bool:
    """Whether an alignment is what a photo is known to show."""
    lattice = found.lattice
    if lattice.kind not in known.kinds:
        return False
    if known.ratio is None or lattice.spacing_x is None:
        return True
    ratio = lattice.spacing_x / lattice.spacing_y
    return abs(max(ratio, 1 / ratio) / known.ratio - 1) < RATIO_TOLERANCE


def look_at(path: Path, *, paved: bool) -> Seen:
    """Align one photo as the command does without a camera."""
    photo = load_photo(path)
    began = time.monotonic()
    found: Alignment | None = None
    reason = ""
    try:
        found = align_seen(see(photo.gray), None, exif_focal_px=photo.exif_focal_px, colour=photo.colour)
    except Refusal as refusal:
        reason = refusal.code
    took = time.monotonic() - began
    colour = photo.colour()
    return Seen(
        path.name,
        paved,
        found,
        reason,
        took,
        _tile(colour if found is None else overlay_picture(found, colour)),
    )


def _tile(picture: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    width, height = TILE
    scale = min(width / picture.shape[1], (height - 24) / picture.shape[0])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    tile = np.full((height, width, 3), 30, np.uint8)
    tile[24 : 24 + small.shape[0], : small.shape[1]] = small[: height - 24, :width]
    return tile


def contact_sheet(seen: list[Seen]) -> UInt8[np.ndarray, "h w 3"]:
    """All overlays on one sheet, each with its name and what became of it."""
    colours = {"right": (120, 230, 120), "wrong": (80, 80, 255), "refused": (60, 190, 255)}
    tiles: list[np.ndarray] = []
    for photo in seen:
        tile = photo.tile.copy()
        said = f"{photo.name}: {photo.verdict} {photo.reason}"
        colour = colours.get(photo.verdict, (230, 230, 230))
        cv2.putText(tile, said, (4, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, 1, cv2.LINE_AA)
        tiles.append(tile)
    width, height = TILE
    tiles += [np.zeros((height, width, 3), np.uint8)] * (-len(tiles) % COLUMNS)
    rows = [np.concatenate(tiles[k : k + COLUMNS], 1) for k in range(0, len(tiles), COLUMNS)]
    return np.concatenate(rows, 0)


def run(options: Options) -> Result:
    """Every photo of the folder."""
    files = photo_files(options)
    if not files:
        return without_photos("real", options)
    seen = [look_at(path, paved=paved) for path, paved in files]
    sheet = options.out / "real.png"
    cv2.imwrite(str(sheet), contact_sheet(seen))
    verdicts = [photo.verdict for photo in seen]
    refused = sum(photo.alignment is None for photo in seen if not photo.paved)
    paved, others = sum(photo.paved for photo in seen), sum(not photo.paved for photo in seen)
    return Result(
        "real",
        about=(
            f"{paved} photos of paving and {others} of other things, without a camera file. 'right' "
            f"and 'wrong' "
            "compare the kind of bond and the slabs' shape with the notes of the photos' manifest, which "
            "nobody has measured; 'look' means that the notes do not say."
        ),
        figures=(
            Figure("real.wrong", float(verdicts.count("wrong"))),
            Figure("real.aligned", float(sum(p.paved and p.verdict == "right" for p in seen))),
            Figure("real.rms", max((p.rms_permille for p in seen), default=0.0)),
            Figure("real.refused", float(refused)),
        ),
        tables=(_table(seen),),
        pictures=(Picture(sheet.name, "the overlays of all photos"),),
    )  # fmt: skip


def _table(seen: list[Seen]) -> Table:
    columns = ("photo", "became", "verdict", "rms px", "joints", "turn sigma °", "height sigma %", "s")
    return Table("Photos", columns, tuple(_row(photo) for photo in seen))


def _row(photo: Seen) -> tuple[str, ...]:
    found = photo.alignment
    if found is None:
        return (photo.name, f"refused: {photo.reason}", photo.verdict, "", "", "", "", f"{photo.seconds:.1f}")
    a, b = found.lattice.spacing_x, found.lattice.spacing_y
    sides = f"{b:.2f}" if a is None else f"{a:.2f} x {b:.2f}"
    C, pose = found.pose.covariance, found.pose.cam_from_ground
    turn = np.rad2deg(np.sqrt(np.trace(C[:3, :3])))
    # The eye stands -e_z R't high; the part of its sigma that the translation alone has.
    up = pose.R[:, 2]
    height = 100 * np.sqrt(up @ C[3:, 3:] @ up) / pose.origin_in_a[2]
    return (
        photo.name,
        f"{found.lattice.kind} {sides}",
        photo.verdict,
        f"{found.residual.rms_px:.2f}",
        str(found.residual.joints),
        f"{turn:.2f}",
        f"{height:.2f}",
        f"{photo.seconds:.1f}",
    )
