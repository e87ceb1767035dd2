"""Segments along the rows: whether those of the ground lie on the joints that the rows predict.

Rows have no other joints in that direction. A corner of a field whose courses are uneven, or the soldier
course beside herringbone, may suit an even spacing; the rest of the ground then says otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from autoreg.fitting.fit import Fit
from autoreg.ground.points import inside_box, on_ground
from autoreg.segments import Segments

# Segments run along the rows within this angle.
ALONG_RAD = np.radians(4.0)
# The ground around a field reaches so many of its sizes to either side: a wall far beyond it has no say.
AROUND = 1.0
# They lie on a joint if their middles are no farther from it than this share of a row's width; a quarter of
# those at any place do.
ON_JOINT = 0.12
# Shares of their length that lie on joints, in the field and with all that is around it, must be larger.
LEAST_IN_FIELD, LEAST_AROUND = 0.75, 0.5


@dataclass(frozen=True)
class AlongRows:
    """Shares of the length, in pixels, of the segments along the rows that lie on the rows' joints."""

    in_field: float
    around: float

    @property
    def contradict(self) -> bool:
        """Whether they speak against these rows."""
        return self.in_field < LEAST_IN_FIELD or self.around < LEAST_AROUND


def along_rows(
    segments: Segments, fit: Fit, field: Float[np.ndarray, "k 2"], size: tuple[int, int]
) -> AlongRows:
    """What the segments of the ground that run along the rows say of them; one where there are none.

    `size` is the photo's width and height, in whose pixels the segments are.
    """
    ground = on_ground(segments.ends_px, fit.camera.scaled(*size), fit.cam_from_ground)
    along, middle = ground[:, 1] - ground[:, 0], ground.mean(1)
    with np.errstate(invalid="ignore"):
        chosen = np.abs(along[:, 1]) < np.tan(ALONG_RAD) * np.abs(along[:, 0])
    middle, length = middle[chosen], segments.length_px[chosen]
    row = middle[:, 1] / fit.grid.spacing_y
    on_joint = np.abs(row - np.round(row)) < ON_JOINT
    inside, around = (inside_box(middle, field, margin) for margin in (0.0, AROUND))
    return AlongRows(_share(length, on_joint, inside), _share(length, on_joint, around))


def _share(length: np.ndarray, on_joint: np.ndarray, counted: np.ndarray) -> float:
    whole = float(length[counted].sum())
    return float(length[counted & on_joint].sum()) / whole if whole else 1.0
