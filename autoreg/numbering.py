"""Numbers for what has the same keys."""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

# Codes of keys up to this one have a table; it takes a few megabytes.
MOST_CODES = 500_000


def numbered(*keys: np.ndarray) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " m"]]:
    """Numbers from zero for equal whole numbers, in the order of their keys, and where one of each is.

    What `numpy.unique` of rows does, in a tenth of the time.
    """
    code = np.zeros(len(keys[0]), dtype=np.int64)
    size = 1
    for key in keys:
        whole = key.astype(np.int64)
        low, high = (int(whole.min()), int(whole.max())) if len(key) else (0, 0)
        size *= high - low + 1
        code = code * (high - low + 1) + (whole - low)
    if size > MOST_CODES:
        _, first, number = np.unique(code, return_index=True, return_inverse=True)
        return number.ravel(), first
    where = np.full(size, -1)
    where[code] = np.arange(len(code))
    there = np.flatnonzero(where >= 0)
    number = np.empty(size, dtype=np.int64)
    number[there] = np.arange(len(there))
    return number[code], where[there]
