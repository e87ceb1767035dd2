"""Products of the columns of slabs' own effects, which form a band where neighbours stand together."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.linalg import cholesky_banded


class SlabBand:
    """Where the products of Z's entries stand in the band of Z' D^-1 Z, whatever D is.

    Two slabs move every measurement, each by its place, its lift and its turn, and so all rows of Z have as
    many entries. Those that are zero would widen the band.
    """

    def __init__(self, Z: Any) -> None:
        """The band of a sparse matrix, row by row (CSR), in which slabs that share a joint stand together."""
        count, self.size = Z.shape
        column, value = (entries.reshape(count, -1) for entries in (Z.indices, Z.data))
        one, other = np.tril_indices(column.shape[1])
        product = value[:, one] * value[:, other]
        self.row, pair = np.nonzero(product)
        self.product = product[self.row, pair]
        ends = column[self.row, one[pair]].astype(np.int64), column[self.row, other[pair]]
        low, high = np.minimum(*ends), np.maximum(*ends)
        place = (high - low) * self.size + low
        used = np.flatnonzero(np.bincount(place))
        self.below, self.column = np.divmod(used, self.size)
        number = np.zeros(used[-1] + 1, dtype=np.int64)
        number[used] = np.arange(len(used))
        self.pair = number[place]

    def products(self, D: Float[np.ndarray, " n"]) -> Float[np.ndarray, " u"]:
        """The band's entries that may be other than zero, for variances D of the measurements."""
        return np.bincount(self.pair, self.product / D[self.row])

    def cholesky(
        self, products: Float[np.ndarray, " u"], scale: Float[np.ndarray, " q"]
    ) -> Float[np.ndarray, "b q"]:
        """The lower factor of I + S Z' D^-1 Z S in LAPACK's band storage, for columns scaled by S."""
        band = np.zeros((int(self.below[-1]) + 1, self.size), order="F")
        band[self.below, self.column] = products * (scale[self.column] * scale[self.column + self.below])
        band[0] += 1.0
        return cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)
