"""Where in the picture boards were seen, and from which sides."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from autoreg.calibration.observations import Data
from autoreg.calibration.unknowns import State

_CELLS = 16
_ZONES = ("top left", "top", "top right", "left", "middle", "right", "bottom left", "bottom", "bottom right")


@dataclass(frozen=True)
class Coverage:
    """What the views showed.

    Attributes:
        area: part of the picture's area that boards covered, at least once.
        reach: distance of the furthest corner from the picture's middle, in half diagonals.
        bare_zones: names of the ninths of the picture that hold hardly any corner.
        hull_px: outline of all corners: the region in which the calibration is measured.
        tilts_deg: angle between the sheet's normal and the optical axis, per view.
        lean: RMS of the normals' sideways parts in their weaker direction: 0 if all lean one way only.
        sizes: the board's size as a part of the picture's, per view.
    """

    area: float
    reach: float
    bare_zones: tuple[str, ...]
    hull_px: Float[np.ndarray, "h 2"]
    tilts_deg: Float[np.ndarray, " v"]
    lean: float
    sizes: Float[np.ndarray, " v"]


def coverage_of(data: Data, state: State, width: int, height: int) -> Coverage:
    """The coverage of some views."""
    corners = data.px[data.present]
    outlines = [
        cv2.convexHull(data.px[k][data.present[k]].astype(np.float32)).reshape(-1, 2)
        for k in range(len(data))
    ]
    rows = max(4, round(_CELLS * height / width))
    scale = np.array([_CELLS / width, rows / height]) * 16
    covered = np.zeros((rows * 16, _CELLS * 16), np.uint8)
    for outline in outlines:
        cv2.fillConvexPoly(covered, np.round((outline + 0.5) * scale - 0.5).astype(np.int32), 1)
    middle = np.array([width - 1, height - 1]) / 2
    normals = state.normals
    sideways = normals[:, :2] * np.sign(normals[:, 2:])
    areas = np.array([cv2.contourArea(outline) for outline in outlines])
    return Coverage(
        area=float(covered.mean()),
        reach=float(np.linalg.norm(corners - middle, axis=1).max() / np.linalg.norm(middle)),
        bare_zones=_bare_zones(corners, width, height),
        hull_px=cv2.convexHull(corners.astype(np.float32)).reshape(-1, 2).astype(float),
        tilts_deg=np.degrees(np.arccos(np.clip(np.abs(normals[:, 2]), 0, 1))),
        lean=float(np.linalg.svd(sideways, compute_uv=False)[-1] / np.sqrt(len(sideways)))
        if len(sideways) > 1
        else 0.0,
        sizes=np.sqrt(areas / (width * height)),
    )


def _bare_zones(corners: Float[np.ndarray, "n 2"], width: int, height: int) -> tuple[str, ...]:
    """Ninths of the picture with less than a tenth of an even share of the corners."""
    column = np.clip((corners[:, 0] + 0.5) / width * 3, 0, 2.999).astype(int)
    row = np.clip((corners[:, 1] + 0.5) / height * 3, 0, 2.999).astype(int)
    counts = np.bincount(3 * row + column, minlength=9)
    return tuple(name for name, n in zip(_ZONES, counts, strict=True) if n < 0.1 * len(corners) / 9)
