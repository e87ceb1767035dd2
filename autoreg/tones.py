"""The tones of slabs and joints, block by block: what is eliminated before a pose is solved for."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float
from scipy.sparse import csc_matrix

from autoreg.joint_pixels import JOINT, TONES, JointPixels

# Tones that are told worse than this, in variances of a pixel's noise, say nothing of how tones vary.
DOUBTFUL = 2.0


class Shares:
    """The shares of tones in some pixels, times the pixels' weights, block by block."""

    def __init__(self, pixels: JointPixels, share: np.ndarray, weight: np.ndarray) -> None:
        n, m = share.shape
        self.count = pixels.blocks
        told = share > 1e-6
        place = (pixels.block * m)[:, None] + np.arange(m)
        ends = np.r_[0, np.cumsum(np.count_nonzero(told, axis=1))]
        entries = (share * weight[:, None])[told], place[told], ends
        self.gather = csc_matrix(entries, shape=(self.count * m, n))
        self.normal = self.sums(share)

    def sums(self, columns: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "m t c"]:
        """Weighted products of every block's shares with some columns."""
        return (self.gather @ columns).reshape(self.count, TONES, -1)


class Blocks:
    """The tones' normal equations, block by block, of all pixels."""

    def __init__(self, parts: Iterable[Shares]) -> None:
        self.normal: np.ndarray = np.sum([part.normal for part in parts], 0)

    def solve(
        self, sums: Float[np.ndarray, "m t c"], ridge: float | np.ndarray
    ) -> Float[np.ndarray, "m t c"]:
        """Tones by least squares, with what is known of them beforehand as a ridge."""
        return np.linalg.solve(self._known(ridge), sums)

    def freedom(self, ridge: float | np.ndarray) -> float:
        """How many values the tones are fitted to: that of free tones, less what is known beforehand."""
        return float(np.trace(np.linalg.solve(self._known(ridge), self.normal), axis1=1, axis2=2).sum())

    def _known(self, ridge: float | np.ndarray) -> Float[np.ndarray, "m t t"]:
        return self.normal + np.diag(np.broadcast_to(ridge, TONES) + 1e-6)


def tone_variances(blocks: Blocks, tones: np.ndarray, noise: float) -> Float[np.ndarray, "2"]:
    """Variance of the slabs' and of the joints' tones about their means, by moments.

    `tones` are least squares' own; those that are hardly told do not count.
    """
    doubt = np.diagonal(np.linalg.inv(blocks.normal + 1e-3 * np.eye(TONES)), axis1=1, axis2=2)
    told: list[float] = []
    for kind in (slice(0, JOINT), slice(JOINT, TONES)):
        v, t = doubt[:, kind], tones[:, kind]
        good = v < DOUBTFUL
        v, t = v[good], t[good]
        if len(t) < 3:
            told.append(noise**2)
            continue
        mean = (t / v).sum() / (1.0 / v).sum()
        excess = ((t - mean) ** 2 / v).sum() - noise**2 * len(t)
        told.append(max(float(excess / (1.0 / v).sum()), 1e-6))
    return np.array(told)
