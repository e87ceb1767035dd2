"""What the drawing of joints leaves out: how likely each such effect is, and what it does to the answer.

An answer to a fraction of the noise is no better than the drawing: a joint with a shadow on its bed, a
chamfer in the light, a lens a ten-thousandth off move all joints alike, and no scatter tells. What they would
change in the picture does. An effect's size d is as likely as N(d; 0, S + T) makes it, where S is the
covariance of its estimate and T its own variance, over which the answer is averaged (Raftery 1995, Bayesian
model selection in social research).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Doubt:
    """Columns that share a standard deviation, those that it may have, and how likely it is to be none.

    It is never none where that is 0. Effects below the `floor` are those of the drawing's own approximations.
    `vague` is the share of what such an effect does to the answer that its drawing may be off by.
    """

    columns: tuple[int, ...]
    sizes: tuple[float, ...]
    absent: float
    floor: float
    vague: float


@dataclass(frozen=True)
class Averaged:
    """A step of all unknowns, and the covariance of those not doubted.

    `plain` is what it would be if all doubts were unfounded, `added` what they add. `sigma` is how well the
    picture tells the size of each effect.
    """

    step: Float[np.ndarray, " k"]
    plain: Float[np.ndarray, "j j"]
    added: Float[np.ndarray, "j j"]
    sigma: Float[np.ndarray, " d"]


def averaged_over(
    doubts: Sequence[Doubt],
    information: Float[np.ndarray, "k k"],
    score: Float[np.ndarray, " k"],
    known: int,
) -> Averaged:
    """The answer of normal equations, averaged over how large the doubted effects may be.

    Args:
        doubts: groups of the columns from `known` on.
        information: of all unknowns, those that are not doubted first.
        score: its right side.
        known: how many unknowns are not doubted.
    """
    H, C = information, np.linalg.inv(information[:known, :known])
    carried = C @ H[:known, known:]
    plain = C @ score[:known]
    # An effect that no pixel shows stays at what is thought of it beforehand.
    inner = H[known:, known:] - H[known:, :known] @ carried
    inner += np.diag(1e-12 + 1e-9 * np.diag(H)[known:])
    S = np.linalg.inv(inner)
    estimate = S @ (score[known:] - H[known:, :known] @ plain)
    sigma = np.sqrt(np.diag(S))
    for doubt in doubts:
        S[doubt.columns, doubt.columns] += doubt.floor**2
    weight, mean, inside, present = _weighed(doubts, estimate, S)
    # What is likelier not there leaves the answer alone, and is uncertainty only.
    effect, vague = np.zeros(len(S)), np.zeros(len(S))
    for doubt, there in zip(doubts, weight @ present, strict=True):
        columns = list(doubt.columns)
        effect[columns] = (weight @ mean)[columns] if doubt.absent and there > 0.5 else 0.0
        vague[columns] = doubt.vague * effect[columns]
    away = mean - effect
    spread = np.tensordot(weight, inside + away[:, :, None] * away[:, None, :], 1) + np.diag(vague**2)
    added = carried @ spread @ carried.T
    return Averaged(np.r_[plain - carried @ effect, effect], C, 0.5 * (added + added.T), sigma)


def _weighed(
    doubts: Sequence[Doubt], estimate: Float[np.ndarray, " d"], S: Float[np.ndarray, "d d"]
) -> tuple[
    Float[np.ndarray, " h"], Float[np.ndarray, "h d"], Float[np.ndarray, "h d d"], Float[np.ndarray, "h g"]
]:
    """Of every combination of sizes: probability, the effects' mean and covariance, and which are there."""
    sizes = np.array(
        list(product(*[((0.0,) if doubt.absent else ()) + doubt.sizes for doubt in doubts])), float
    )
    T, prior = np.zeros((len(sizes), len(S))), np.zeros(len(sizes))
    for doubt, size in zip(doubts, sizes.T, strict=True):
        T[:, doubt.columns] = size[:, None] ** 2
        there = (1.0 - doubt.absent) / len(doubt.sizes)
        prior += np.log(np.where(size == 0, doubt.absent, there))
    V = S + T[:, :, None] * np.eye(len(S))
    inverse = np.linalg.inv(V)
    gain, pulled = T[:, :, None] * inverse, inverse @ estimate
    value = prior - 0.5 * (pulled @ estimate + np.linalg.slogdet(V)[1])
    weight = np.exp(value - value.max())
    return weight / weight.sum(), gain @ estimate, gain @ S, (sizes > 0).astype(float)
