"""The equations of the mixed model of irregular slabs: its normal equations and restricted likelihood.

The residuals' covariance is V = D + Z Z', with the random effects' columns Z scaled by their sizes. Only
slabs that share a joint are correlated, so that Woodbury's identity leaves a banded matrix to be factorised
(Searle, Casella, McCulloch, Variance Components, ch. 6).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_solve_banded
from scipy.sparse import hstack
from scipy.sparse.csgraph import reverse_cuthill_mckee

from autoreg.fitting.design_effect import drawn_design_effect
from autoreg.fitting.fit import Fit
from autoreg.slabs.banded import solve_lower_banded
from autoreg.slabs.course_effects import course_effects, drift_effects
from autoreg.slabs.measured_joints import measured_joints
from autoreg.slabs.reduced_equations import NormalEquations, ReducedEquations
from autoreg.slabs.slab_band import SlabBand
from autoreg.slabs.slab_effects import (
    bloom_effects,
    bow_effects,
    common_effects,
    relief_effects,
    rim_effects,
    slab_effects,
    width_effects,
)
from autoreg.solve.joint_data import SHIFT
from autoreg.solve.solver import CAUCHY_SIGMAS, Prior
from autoreg.spread import spread_about

# Sizes of the relief that are weighed against each other, as shares of half the joint's width. It cannot be
# more than one by geometry, but the width itself is measured on what is left of the joint.
RELIEFS = (0.0, 0.03, 0.1, 0.25, 0.5, 1.0, 2.0)
# Pictures that are drawn from the model, to learn how its joints would agree.
DRAWS = 16
# A station farther off than this many standard deviations is none of a slab's: it is left out.
GROSS_SIGMAS = 4.0
# How much larger bright tiles may look that meet without a joint, beyond what the fit has taken off already.
BLOOM_PX = 0.1


class Sizes(NamedTuple):
    """Standard deviation of a slab's place, and as shares of it: lift, turn, and what a line's joints share.

    `drift` is by how much more or less the next line's share, a share of the place too. `together` is how
    many times as large as usual what all joints of a family are off by is.
    """

    place: float
    lift: float
    turn: float
    course: float
    together: float
    drift: float


class SlabEquations:
    """The linear mixed model of one fit's residuals."""

    def __init__(
        self,
        fit: Fit,
        mask: Float[np.ndarray, " p"],
        prior: Prior,
        bow: float,
        rows: Int[np.ndarray, " n"],
        widths: bool,
        sizes: Sizes | None = None,
        *,
        drifts: bool = True,
    ) -> None:
        """Effects of which the `sizes` that will be asked for have nothing are left out.

        So is the courses' drift where they are not to have any.

        Behind the motion of the parameters that the `mask` frees stands the shift of an odd bond.
        """
        free = np.flatnonzero(mask)
        self.joints = joints = measured_joints(fit, rows, widths=widths)
        # The widths know nothing of the pose, but what makes them differ moves the middles as well.
        moved = fit.solution.jacobian[np.ix_(rows, free)]
        if fit.grid.odd_bond:
            moved, free = np.column_stack([moved, fit.by_shift_px[rows]]), np.r_[free, SHIFT]
        self.free, J = free, joints.middles_only(moved)
        # Columns of unit length keep the normal equations well scaled.
        self.unit = 1.0 / np.maximum(np.linalg.norm(J, axis=0), 1e-12)
        mean, sigma = np.r_[prior.mean, 0.0][free], np.r_[prior.sigma, np.inf][free]
        self.known, self.prior_mean = (self.unit / sigma) ** 2, mean / self.unit
        effects = slab_effects(joints)
        # Which of the three sizes columns of Z are scaled by.
        kinds = [k for k in range(3) if sizes is None or k == 0 or sizes[k] > 0]
        Z: Any = hstack([effects[k] for k in kinds]).tocsc()
        # Neighbouring slabs next to each other: only they share a joint, and so the products form a band.
        order = reverse_cuthill_mckee((Z.T @ Z).tocsr(), symmetric_mode=True)
        self.Z: Any = Z[:, order].tocsr()
        self.band = SlabBand(self.Z)
        self.kind = np.repeat(kinds, [effects[k].get_shape()[1] for k in kinds])[order]
        self.squares = np.stack([effect.power(2).sum(1).A1 for effect in effects], 1)
        relief, self.expected = relief_effects(joints)
        common = common_effects(joints)
        others = np.c_[
            rim_effects(joints),
            width_effects(joints),
            bow * bow_effects(joints),
            BLOOM_PX * bloom_effects(joints),
        ]
        nothing = np.zeros((len(joints.off_px), 0))
        course = nothing if sizes is not None and sizes.course == 0 else course_effects(joints)
        still = not drifts or (sizes is not None and sizes.drift == 0)
        drift = nothing if still else drift_effects(joints)
        # Which of these columns are scaled by the sizes of the relief, of what is common, of the courses, and
        # of what these drift by.
        counts = [each.shape[1] for each in (relief, common, course, drift, others)]
        of_each = (np.repeat(of, counts) for of in np.eye(len(counts), dtype=bool))
        self.relief, self.common, self.course, self.drift, _ = of_each
        # Which unknowns are eliminated first, the motion's before all, and which are the relief's.
        of_relief = np.r_[np.zeros(len(free), dtype=bool), self.relief]
        self.first, self.last = np.flatnonzero(~of_relief), np.flatnonzero(of_relief)
        self.columns = np.c_[J * self.unit, relief, common, course, drift, others, joints.off_px]
        self.course_squares, self.drift_squares = (course**2).sum(1), (drift**2).sum(1)
        self.begin_anew()

    def begin_anew(self) -> None:
        """Go back to the weights that the joints' distances alone give."""
        joints = self.joints
        narrower = joints.off_px[len(joints.rows) :]
        usual_narrower = spread_about(narrower) + 1e-6 if len(narrower) else 1.0
        usual = np.r_[joints.fit.sigma_px[joints.rows], np.full(len(narrower), usual_narrower)]
        self.weight = 1.0 / (1.0 + (joints.off_px / (CAUCHY_SIGMAS * usual)) ** 2)
        self._weigh()

    def _weigh(self) -> None:
        """The products with the inverse of D that every size needs, for the weights as they are."""
        self.D = self.joints.noise_px**2 / self.weight
        over = self.columns / self.D[:, None]
        self.products = self.band.products(self.D)
        self.ZDC = self.Z.T @ over
        self.CDC = self.columns.T @ over
        self.factored: tuple[float, ...] | None = None

    def factor(self, sizes: Sizes) -> None:
        """Factorise the residuals' covariance V = D + Z Z', by Woodbury's identity on the sparse Z."""
        place, lift, turn, course, self.together_size, drift = sizes
        self.course_size, self.drift_size = place * course, place * drift
        if self.factored == (place, lift, turn):
            return
        self.factored = place, lift, turn
        self.scale = np.array([place, place * lift, place * turn])[self.kind]
        self.cholesky = self.band.cholesky(self.products, self.scale)
        self.logdet = float(np.log(self.D * self.weight).sum() + 2.0 * np.log(self.cholesky[0]).sum())
        across = solve_lower_banded(self.cholesky, self.scale[:, None] * self.ZDC)
        self.gram = self.CDC - across.T @ across

    def _solved(self, right: np.ndarray) -> np.ndarray:
        return cho_solve_banded((self.cholesky, True), right, check_finite=False)

    def _whitened(self, x: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n c"]:
        """V^-1 x."""
        scale, over = self.scale[:, None], 1.0 / self.D[:, None]
        return over * (x - self.Z @ (scale * self._solved(scale * (self.Z.T @ (over * x)))))

    def misfit(self, relief: float) -> float:
        """How much more the stations that share something agree than in pictures drawn from the model."""
        p, k = len(self.free), len(self.relief)
        size = self._sized(relief)
        X = self.columns[:, :-1] * size
        random = np.random.default_rng(0)
        drawn = np.sqrt(self.D)[:, None] * random.standard_normal((len(X), DRAWS))
        drawn += self.Z @ (self.scale[:, None] * random.standard_normal((len(self.scale), DRAWS)))
        drawn += X[:, p:] @ random.standard_normal((k, DRAWS))
        VX = self._whitened(X)
        inverse = np.linalg.inv(self._matrix(size, self._prior()[0]))
        y = np.column_stack([self.joints.off_px, drawn])
        pulls = self._whitened(y - X @ (inverse @ (VX.T @ y)))
        return drawn_design_effect(X, inverse, pulls, self.joints.shared, 6)

    def _sized(self, relief: float) -> Float[np.ndarray, " k"]:
        """Sizes of all columns: one for the motion and for the effects that have no size of their own."""
        of_effects = np.ones(len(self.relief))
        of_effects[self.relief], of_effects[self.common] = relief, self.together_size
        of_effects[self.course], of_effects[self.drift] = self.course_size, self.drift_size
        return np.r_[np.ones(len(self.free)), of_effects]

    def _prior(self) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """What is known beforehand of the motion and the effects: information, and mean but the relief's."""
        p, k = len(self.free), len(self.relief)
        # A direction that nothing tells (along the joints of rows) stays where it is, and unknown.
        little = 1e-10 * np.diag(self.gram)[:p]
        mean = np.where(self.known > 0, self.prior_mean, 0.0)
        return np.r_[self.known + little, np.ones(k)], np.r_[mean, np.zeros(k)]

    def _matrix(
        self, size: Float[np.ndarray, " k"], known: Float[np.ndarray, " k"]
    ) -> Float[np.ndarray, "k k"]:
        """The normal matrix of the motion and all effects, for columns of such sizes."""
        H = self.gram[:-1, :-1] * size * size[:, None]
        H[np.diag_indices(len(H))] += known
        return H

    def _reduced(self) -> ReducedEquations:
        """The normal equations for the sizes that were factorised last, the relief's eliminated last."""
        known, mean = self._prior()
        size = self._sized(1.0)
        gradient = self.gram[:-1, -1] * size - known * mean
        at_zero = float(self.gram[-1, -1] + known @ mean**2)
        equations = NormalEquations(
            self._matrix(size, known),
            gradient,
            self.first,
            self.last,
            self.expected,
            len(self.free),
            at_zero,
            self.logdet,
        )
        return ReducedEquations.of(equations)

    def solve(self) -> tuple[Float[np.ndarray, " r"], Float[np.ndarray, "r p"], Float[np.ndarray, "r p p"]]:
        """Restricted log likelihood, scaled motion and its covariance, for each size of the relief."""
        reliefs, p, reduced = np.array(RELIEFS), len(self.free), self._reduced()
        motion = reduced.solution(reliefs)[:, :p]
        return reduced.log_likelihood(reliefs), motion, reduced.covariance(reliefs)

    def evidence(self, sizes: Sizes) -> dict[float, float]:
        """Restricted log likelihood for each size of the relief."""
        self.factor(sizes)
        return dict(zip(RELIEFS, self._reduced().log_likelihood(np.array(RELIEFS)).tolist(), strict=True))

    def reweigh(self, sizes: Sizes, relief: float) -> None:
        """Cauchy weights from what is left of each station's residual when the slabs have had their share."""
        self.factor(sizes)
        x = self._reduced().solution(np.array([relief]))[0] * self._sized(1.0)
        left = self.columns @ np.r_[x, 1.0]
        own = self.D * self._whitened(left[:, None])[:, 0]
        # A slab's own effect would take up a side that is wholly mismeasured: it is judged as a whole.
        place, lift, turn, course, _, drift = sizes
        variance = self.joints.noise_px**2 + self.squares @ (place * np.array([1.0, lift, turn])) ** 2
        variance += self.course_squares * (place * course) ** 2 + self.drift_squares * (place * drift) ** 2
        deviation = np.abs(left) / np.sqrt(variance)
        gross = deviation > GROSS_SIGMAS * max(spread_about(deviation), 1e-6)
        self.weight = np.where(gross, 1e-6, 1.0 / (1.0 + own**2 / (CAUCHY_SIGMAS**2 * self.D * self.weight)))
        self._weigh()
