"""How much less sure an answer is than white noise would leave it, by how the scores of cells agree.

The variance of a sum of scores is that of its parts and of all that they share. Pixels of one cell share
the sensor's and the stone's grain, cells around one slab share its place: the sum over pairs of neighbours
(Conley 1999, GMM estimation with cross sectional dependence; the kernel is flat) has both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.spatial import KDTree

# Cells share a slab if they are no farther apart than this, in slabs along either axis.
NEIGHBOUR = 1.01
# With fewer cells than leave this share of the white scores' sum, neighbours tell nothing.
LEAST_TOLD = 0.3


@dataclass(frozen=True)
class Asked:
    """The combinations of unknowns whose variance is asked for, of a unit each.

    `combined` makes them of scores; `known` whitens what is told of all unknowns.
    """

    combined: Float[np.ndarray, "j k"]
    known: Float[np.ndarray, "k k"]

    @classmethod
    def of(cls, information: Float[np.ndarray, "k k"], asked: slice) -> Asked:
        """Some of the unknowns that the information is about."""
        # In units of their own: what is doubted may look nearly like what is asked for.
        unit = 1.0 / np.sqrt(np.diagonal(information))
        known = np.linalg.inv(np.linalg.cholesky(information * unit[:, None] * unit)).T
        inverse = known @ known.T
        white = np.linalg.cholesky(np.linalg.inv(inverse[asked, asked]))
        return cls(white.T @ inverse[asked] * unit, unit[:, None] * known)


def design_effects(
    scores: Float[np.ndarray, "c j"],
    told: Float[np.ndarray, "c j k"],
    asked: Asked,
    places: Float[np.ndarray, "c 2"],
    noise: float,
) -> tuple[float, float]:
    """Variance of the unknowns that are asked for, over what the information claims: by cells, by neighbours.

    The unknowns have been solved for, which makes cells' scores cancel each other: both sums are divided by
    what they are expected to be for white noise, exactly.

    Args:
        scores: gradient of every cell's misfit by what is asked for.
        told: of each cell's own information, in units of the noise, what it tells of that.
        asked: combinations of the unknowns.
        places: of the cells, in slabs.
        noise: standard deviation of a pixel.
    """
    taken = told @ asked.known
    own = np.einsum("cjk,jk->c", told, asked.combined)
    pairs = KDTree(places).query_pairs(NEIGHBOUR, p=np.inf, output_type="ndarray")
    count = len(places)
    one = np.ones(len(pairs))
    beside = csr_matrix((one, (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    flat = taken.reshape(count, -1)
    total, claimed = float((scores**2).sum()), float(own.sum() - (flat**2).sum())
    alone = total / (claimed * noise**2)
    total += 2.0 * float((scores * (beside @ scores)).sum())
    claimed -= 2.0 * float((flat * (beside @ flat)).sum())
    if claimed < LEAST_TOLD * own.sum():
        return alone, alone
    return alone, total / (claimed * noise**2)


def drawn_design_effect(
    columns: Float[np.ndarray, "n k"],
    inverse: Float[np.ndarray, "k k"],
    pulls: Float[np.ndarray, "n m"],
    shared: Sequence[Int[np.ndarray, " n"]],
    asked: int,
) -> float:
    """The same for correlated measurements: the largest over what they may share, by drawn data.

    What the scores of those that share something would add up to under the model is the mean over drawn data,
    since what was solved for and what the model itself correlates leave no simple sum.

    Args:
        columns: derivatives of the measurements by the unknowns.
        inverse: of the unknowns' normal matrix.
        pulls: whitened residuals; of the true data first, then of data drawn from the model, solved alike.
        shared: for everything that measurements may share, which of it each has.
        asked: how many unknowns, the first ones, the variance is asked of.
    """
    size, axes = np.linalg.eigh(inverse[:asked, :asked])
    white = (axes / np.sqrt(np.maximum(size, 1e-12 * size[-1]))).T
    ask = columns @ (white @ inverse[:asked]).T
    found: list[float] = []
    for member in shared:
        count = int(member.max()) + 1
        gather = csr_matrix(
            (np.ones(len(member)), (member, np.arange(len(member)))), shape=(count, len(member))
        )
        squares = np.zeros(pulls.shape[1])
        for along in ask.T:
            squares += (np.asarray(gather @ (along[:, None] * pulls)) ** 2).sum(0)
        found.append(float(squares[0] / squares[1:].mean()))
    return max(found)
