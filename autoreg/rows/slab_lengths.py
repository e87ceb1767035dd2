"""Whether the slabs of rows are longer than their row is wide, or shorter: that tells which side is which."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.special import bdtrc

from autoreg.fitting.fit import Fit
from autoreg.rows.cross_joints import RIGHT_RAD, off_square
from autoreg.segments import Segments

# The chance that as many slabs or more would be longer, or shorter, if half of all were. A cross joint that
# is not seen makes two slabs one: shorter ones pass for longer where more than half of the joints are missed.
CHANCE = 1e-3


def slab_lengths(segments: Segments, fit: Fit, field: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, " n"]:
    """Distances of neighbouring cross joints in the rows of a field, in widths of a row.

    The fit is at the photo's own resolution. A joint that is not seen makes two lengths one.
    """
    seen, width = off_square(segments, fit, field, RIGHT_RAD), fit.grid.spacing_y
    if len(seen) == 0:
        return np.zeros(0)
    # A joint's pieces lie in one row, and its number follows that of the joint before it there.
    pieces = np.bincount(seen.joint)
    place = np.bincount(seen.joint, seen.middle[:, 0]) / pieces
    row = np.bincount(seen.joint, np.floor(seen.middle[:, 1] / width)) / pieces
    return np.diff(place)[np.diff(row) == 0] / width


def longer_than_wide(lengths: Float[np.ndarray, " n"]) -> bool | None:
    """Whether most slabs are clearly longer than their row is wide (True) or shorter; None if neither is."""
    longer, count = int((lengths > 1.0).sum()), len(lengths)
    for answer, many in ((True, longer), (False, count - longer)):
        if many and float(bdtrc(many - 1, count, 0.5)) < CHANCE:
            return answer
    return None
