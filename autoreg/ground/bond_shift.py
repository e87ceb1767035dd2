"""By what part of a slab pavers move one row of a running bond from the next."""

from __future__ import annotations

import numpy as np

CUSTOMARY = np.array([0.0, 1 / 5, 1 / 4, 1 / 3, 2 / 5, 1 / 2, 3 / 5, 2 / 3, 3 / 4, 4 / 5, 1.0])


def nearest_customary(shift: float) -> float:
    """The shift in use by pavers that is nearest to a given one, up to a whole slab."""
    return float(CUSTOMARY[np.abs(CUSTOMARY - shift).argmin()])


def is_customary(shift: float) -> bool:
    """Whether a shift is exactly one that is in use by pavers."""
    return abs(nearest_customary(shift) - shift) < 1e-9
