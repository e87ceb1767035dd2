"""Triangular band systems with many right sides, in blocks of dense ones.

LAPACK solves them column by column. In the band's own storage a block on the diagonal, and the one below it,
is a dense triangle whose rows lie one place less than the band's height apart: BLAS takes these in place,
and the right sides all at once.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy.lib.stride_tricks import as_strided
from scipy.linalg.blas import dtrmm, dtrsm  # pyright: ignore[reportAttributeAccessIssue]
from scipy.linalg.lapack import dtbtrs  # pyright: ignore[reportAttributeAccessIssue]

# Bands that reach less far below the diagonal are too narrow for blocks.
LEAST_REACH = 16


def solve_lower_banded(
    cholesky: Float[np.ndarray, "b n"], right: Float[np.ndarray, "n k"]
) -> Float[np.ndarray, "n k"]:
    """Solution x of L x = right, which is overwritten.

    Args:
        cholesky: the lower triangle L in LAPACK's band storage, column by column (Fortran's order), as
            `scipy.linalg.cholesky_banded` makes it of such an array.
        right: the right sides, row by row.
    """
    height, size = cholesky.shape
    reach = height - 1
    if reach < LEAST_REACH:
        return dtbtrs(cholesky, right, uplo="L", overwrite_b=1)[0]
    entries = cholesky.ravel(order="K")
    rows = right.T
    for start in range(0, size, reach):
        end, after = min(start + reach, size), min(start + 2 * reach, size)
        own = _dense(entries[start * height :], end - start, end - start, reach)
        solved = dtrsm(1.0, own, rows[:, start:end], side=1, lower=1, trans_a=1)
        rows[:, start:end] = solved
        if after > end:
            below = _dense(entries[start * height + reach :], after - end, reach, reach)
            # Short of a whole block BLAS has no such product, and there is only one such block.
            whole = after - end == reach
            moved = dtrmm(1.0, below, solved, side=1, trans_a=1) if whole else solved @ np.triu(below).T
            rows[:, end:after] -= moved
    return right


def _dense(entries: np.ndarray, rows: int, columns: int, reach: int) -> np.ndarray:
    """A view of a block; what the band does not hold of it is anything."""
    step = entries.itemsize
    return as_strided(entries, (rows, columns), (step, reach * step), writeable=False)
