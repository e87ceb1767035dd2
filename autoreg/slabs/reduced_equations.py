"""Normal equations of a motion and of random effects, solved for every size of the relief at once.

What is not the relief's is eliminated first. What is left of its own equations, I + r^2 S for a size r, is
turned to the axes of S.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import lu_factor, lu_solve


class NormalEquations(NamedTuple):
    """H x = -g for unknowns of which the motion's come first, with the relief's columns of size one.

    Attributes:
        H: the normal matrix, with what is known beforehand of every unknown but the relief's mean.
        g: the gradient at zero.
        first: which unknowns are eliminated, the motion's before all.
        last: which are the relief's.
        expected: the relief's prior mean.
        motion: how many unknowns are the motion's.
        at_zero: the sum of squares at zero.
        logdet: logarithm of the determinant of the residuals' covariance.
    """

    H: Float[np.ndarray, "k k"]
    g: Float[np.ndarray, " k"]
    first: Int[np.ndarray, " f"]
    last: Int[np.ndarray, " l"]
    expected: Float[np.ndarray, " l"]
    motion: int
    at_zero: float
    logdet: float


class ReducedEquations(NamedTuple):
    """Normal equations with all unknowns but the relief's eliminated.

    Attributes:
        full: the equations.
        by_relief: what a unit of each relief effect, of size one, takes from the other unknowns.
        alone: the other unknowns' solution without relief, with the sign changed.
        spread: the motion's columns of the inverse of their normal matrix.
        squares: eigenvalues of S.
        axes: its eigenvectors.
        pull: what the residuals ask of the relief along these axes, for size one.
        expected: the relief's prior mean along these axes.
        left: the sum of squares without relief.
        logdet: logarithm of the determinant of the covariance and of the other unknowns' normal matrix.
    """

    full: NormalEquations
    by_relief: Float[np.ndarray, "f l"]
    alone: Float[np.ndarray, " f"]
    spread: Float[np.ndarray, "f p"]
    squares: Float[np.ndarray, " l"]
    axes: Float[np.ndarray, "l l"]
    pull: Float[np.ndarray, " l"]
    expected: Float[np.ndarray, " l"]
    left: float
    logdet: float

    @classmethod
    def of(cls, full: NormalEquations) -> ReducedEquations:
        """The equations with all but the relief's unknowns eliminated."""
        H, g, last, p = full.H, full.g, full.last, full.motion
        rest = H[full.first]
        across, right = rest[:, last], np.zeros((len(rest), len(last) + 1 + p))
        right[:, : len(last)], right[:, len(last)] = across, g[full.first]
        right[:p, len(last) + 1 :] = np.eye(p)
        factors = lu_factor(rest[:, full.first], overwrite_a=True, check_finite=False)
        solved = lu_solve(factors, right, overwrite_b=True, check_finite=False)
        by_relief, alone, spread = solved[:, : len(last)], solved[:, len(last)], solved[:, len(last) + 1 :]
        own = H[last][:, last] - across.T @ by_relief
        own[np.diag_indices(len(own))] -= 1.0
        squares, axes = np.linalg.eigh(own)
        left = full.at_zero + full.expected @ full.expected - g[full.first] @ alone
        return cls(
            full,
            by_relief,
            alone,
            spread,
            np.maximum(squares, 0.0),
            axes,
            (across.T @ alone - g[last]) @ axes,
            full.expected @ axes,
            float(left),
            full.logdet + float(np.log(np.abs(np.diag(factors[0]))).sum()),
        )

    def log_likelihood(self, reliefs: Float[np.ndarray, " r"]) -> Float[np.ndarray, " r"]:
        """Restricted log likelihood for each size of the relief."""
        shrunk = self._shrunk(reliefs)
        left = self.left - (shrunk * self._asked(reliefs) ** 2).sum(1)
        return -0.5 * (left + self.logdet - np.log(shrunk).sum(1))

    def solution(self, reliefs: Float[np.ndarray, " r"]) -> Float[np.ndarray, "r k"]:
        """All unknowns, those of the relief times its size, for each size of it."""
        first, last = self.full.first, self.full.last
        x = np.empty((len(reliefs), len(first) + len(last)))
        shifts = (self._shrunk(reliefs) * self._asked(reliefs)) @ self.axes.T
        x[:, last] = reliefs[:, None] * shifts
        x[:, first] = -self.alone - x[:, last] @ self.by_relief.T
        return x

    def covariance(self, reliefs: Float[np.ndarray, " r"]) -> Float[np.ndarray, "r p p"]:
        """Covariance of the motion for each size of the relief."""
        p = self.full.motion
        along = self.by_relief[:p] @ self.axes
        shrunk = self._shrunk(reliefs)[:, None]
        return self.spread[:p] + reliefs[:, None, None] ** 2 * (along * shrunk) @ along.T

    def _shrunk(self, reliefs: Float[np.ndarray, " r"]) -> Float[np.ndarray, "r l"]:
        """What the priors leave of each axis, for each size of the relief."""
        return 1.0 / (1.0 + reliefs[:, None] ** 2 * self.squares)

    def _asked(self, reliefs: Float[np.ndarray, " r"]) -> Float[np.ndarray, "r l"]:
        """What is asked of each axis, for each size of the relief."""
        return reliefs[:, None] * self.pull + self.expected
