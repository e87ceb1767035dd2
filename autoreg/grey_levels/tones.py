"""The tones of slabs and joints, block by block: what is eliminated before a pose is solved for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.sparse import csc_matrix

from autoreg.grey_levels.joint_pixels import JOINT, TONES, JointPixels

# Tones that are told worse than this, in variances of a pixel's noise, say nothing of how tones vary.
DOUBTFUL = 2.0


class Shares:
    """The shares of tones in the pixels of a part, times the pixels' weights: sums by the blocks' tones."""

    def __init__(self, pixels: JointPixels, share: Float[np.ndarray, "s n"], weight: np.ndarray) -> None:
        s, n = share.shape
        first, last = int(pixels.block[0]), int(pixels.block[-1])
        # Pixels are in the order of their blocks, of which a part has a few.
        self.blocks = slice(first, last + 1)
        place = (pixels.tone - first * TONES).T.ravel()
        entries = (share * weight).T.ravel(), place, np.arange(0, s * n + 1, s, dtype=np.int32)
        self.gather = csc_matrix(entries, shape=((last + 1 - first) * TONES, n))

    def sums(self, columns: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "b t c"]:
        """Weighted products of the shares in each of the part's blocks with some columns."""
        return np.asarray(self.gather @ columns).reshape(-1, TONES, columns.shape[1])


def over_parts(
    blocks: int, parts: Sequence[Shares], sums: Sequence[np.ndarray]
) -> Float[np.ndarray, "m t c"]:
    """Sums over all pixels, from those of each part."""
    total = np.zeros((blocks, *sums[0].shape[1:]))
    for part, own in zip(parts, sums, strict=True):
        total[part.blocks] += own
    return total


class Blocks:
    """The tones' normal equations, block by block, of all pixels."""

    def __init__(self, normal: Float[np.ndarray, "m t t"]) -> None:
        self.normal = normal
        self._inverses: dict[bytes, Float[np.ndarray, "m t t"]] = {}

    def solve(
        self, sums: Float[np.ndarray, "m t c"], ridge: float | np.ndarray
    ) -> Float[np.ndarray, "m t c"]:
        """Tones by least squares, with what is known of them beforehand as a ridge."""
        return self._inverse(ridge) @ sums

    def freedom(self, ridge: float | np.ndarray) -> float:
        """How many values the tones are fitted to: that of free tones, less what is known beforehand."""
        # The trace of a product with a symmetric matrix is the sum of the products of their entries.
        return float(np.vdot(self._inverse(ridge), self.normal))

    def _inverse(self, ridge: float | np.ndarray) -> Float[np.ndarray, "m t t"]:
        """Covariances of the tones, in variances of a pixel's noise; the same are asked for several times."""
        ridges = np.broadcast_to(np.asarray(ridge, float), TONES)
        key = ridges.tobytes()
        if key not in self._inverses:
            self._inverses[key] = np.linalg.inv(self.normal + np.diag(ridges + 1e-6))
        return self._inverses[key]


def tone_variances(blocks: Blocks, sums: Float[np.ndarray, "m t 1"], noise: float) -> Float[np.ndarray, "2"]:
    """Variance of the slabs' and of the joints' tones about their means, by moments.

    The tones are least squares' own, from the blocks' `sums`; those that are hardly told do not count.
    """
    inverse = np.linalg.inv(blocks.normal + 1e-3 * np.eye(TONES))
    doubt, tones = np.diagonal(inverse, axis1=1, axis2=2), (inverse @ sums)[..., 0]
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
