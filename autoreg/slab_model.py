"""A linear mixed model of irregular slabs: the likeliest pose, and how sure it is.

The places of neighbouring joints are no independent measurements. Each joint lies off its line by

    J dp + place + lift + turn of the slabs on either side + relief + bloom + noise,

where every slab's place, height and turn are random, and the relief is the shift of a joint seen aslant: a
lit wall of the far slab looks like the slab, and so the joint looks narrower and nearer than it is. Where
both edges of a joint are told apart, its width is a second measurement, off by all of these but J dp. Bright
tiles that meet dark ones without a joint bloom: every edge is moved towards the dark one. This is a linear
mixed model (Searle, Casella, McCulloch, Variance Components, ch. 6 and 9): the sizes of the random
effects come from the photo's own residuals by restricted maximum likelihood, and the pose by generalised
least squares.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import diags, hstack, identity
from scipy.sparse.csgraph import reverse_cuthill_mckee

from autoreg.design_effect import drawn_design_effect
from autoreg.joint_data import PARAMETERS
from autoreg.measured_joints import measured_joints
from autoreg.refine import Fit
from autoreg.slab_effects import bloom_effects, bow_effects, relief_effects, slab_effects, width_effects
from autoreg.solver import CAUCHY_SIGMAS, Prior

# Sizes of the relief that are weighed against each other, as shares of half the joint's width. It cannot be
# more than one by geometry, but the width itself is measured on what is left of the joint.
RELIEFS = (0.0, 0.03, 0.1, 0.25, 0.5, 1.0, 2.0)
# What is tried in turn: factors of the place's size, and sizes of lift and turn as shares of it.
WIDE_SEARCHES = (((0.3, 0.6, 1.6, 2.5), (0.0, 1.0), (0.0, 0.12, 0.5)), ((0.75, 1.3), (), ()))
NEAR_SEARCHES = (((0.45, 0.7, 1.4), (), ()),)
# Factors of the likeliest place's size over which the answer is averaged.
LIKELY = (0.55, 0.75, 1.0, 1.33, 1.8)
# Where the widths tell the relief, its shape varies beyond the model: the variance is this much larger, as
# measured on ray-traced pavings.
MISFIT = 2.0
# Pictures that are drawn from the model, to learn how its joints would agree.
DRAWS = 16
# A station farther off than this many standard deviations is none of a slab's: it is left out.
GROSS_SIGMAS = 4.0
# The sizes of the effects are searched on blocks of so many slabs square, with about so many stations in all.
BLOCK_SLABS, SEARCHED = 4, 600
# How much larger bright tiles may look that meet without a joint, beyond what the fit has taken off already.
BLOOM_PX = 0.1
# Height of the bow that even ground may have, as a share of its extent: 3 mm under a straightedge of 2 m.
BOW = 0.0015


@dataclass(frozen=True)
class Scatter:
    """Standard deviations of the slabs' irregularity, in the unit of the pose (`turn` in radians).

    `lift` and `turn` are of slabs, like `place`; `relief` is a share of half the joint's width. `misfit` is
    the factor, in variance, by which joints agree on being off beyond what all of these explain.
    """

    place: float
    lift: float
    turn: float
    relief: float
    misfit: float


@dataclass(frozen=True)
class Estimate:
    """Solution of the mixed model: a small motion from the fit, its covariance, and the scatter."""

    parameters: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    scatter: Scatter


def estimate_motion(
    fit: Fit,
    mask: Float[np.ndarray, " p"],
    prior: Prior,
    near: Scatter | None = None,
    *,
    bow: float = 0.0,
    widths: bool = True,
) -> Estimate:
    """The mixed model's motion of the free parameters from the fit, averaged over likely scatters.

    Args:
        fit: a converged fit; its Jacobian tells what the parameters move.
        mask: ones for the free parameters.
        prior: what is known of them, counted from the fit.
        near: the scatter of an earlier estimate of this photo, near which to search instead of everywhere.
        bow: how far from a plane the ground may be bent, as a share of its extent (standard deviation).
        widths: whether the joints' widths have a say.
    """
    rows = np.flatnonzero(fit.usable)
    sizes, relief = _likeliest_sizes(_Model(fit, mask, prior, bow, _in_blocks(fit, rows), widths), near)
    model = _Model(fit, mask, prior, bow, rows, widths)
    for _ in range(2):
        model.reweigh(sizes, relief)
    found: list[tuple[float, np.ndarray, np.ndarray]] = []
    for factor in LIKELY:
        model.factor((factor * sizes[0], *sizes[1:]))
        found += model.solve()
    value = np.array([f[0] for f in found])
    weight = np.exp(value - value.max())
    weight /= weight.sum()
    mean = np.tensordot(weight, np.array([f[1] for f in found]), 1)
    # What differs between likely scatters is uncertainty too; it matters where slabs are few.
    away = np.array([f[1] for f in found]) - mean
    inner = np.array([f[2] for f in found]) + away[:, :, None] * away[:, None, :]
    if near is not None:
        misfit = near.misfit
    elif len(model.joints.wide):
        flat = float(weight[:: len(RELIEFS)].sum())
        misfit = 1.0 + (MISFIT - 1.0) * (1.0 - flat)
    else:
        model.factor(sizes)
        misfit = max(1.0, model.misfit(relief))
    spread = np.tensordot(weight, inner, 1) * misfit
    parameters, covariance = np.zeros(PARAMETERS), np.zeros((PARAMETERS, PARAMETERS))
    parameters[model.free] = mean * model.unit
    covariance[np.ix_(model.free, model.free)] = spread * np.outer(model.unit, model.unit)
    place, lift, turn = sizes
    relief = RELIEFS[int(value.argmax()) % len(RELIEFS)]
    scatter = Scatter(place, place * lift, place * turn / model.side, relief, misfit)
    return Estimate(parameters, covariance, scatter)


def _in_blocks(fit: Fit, rows: Int[np.ndarray, " n"]) -> Int[np.ndarray, " k"]:
    """Some of the stations, in whole blocks of slabs spread over the ground: neighbours tell the scatter."""
    size = BLOCK_SLABS * np.array([fit.grid.spacing_x or fit.grid.spacing_y, fit.grid.spacing_y])
    block = np.floor(fit.stations.ground[rows] / size).astype(int)
    names, member, count = np.unique(block, axis=0, return_inverse=True, return_counts=True)
    # An order in which near and far blocks, left and right ones follow each other.
    order = np.argsort((5 * names[:, 0] + 3 * names[:, 1]) % 13, kind="stable")
    wanted = order[: 1 + int(np.searchsorted(np.cumsum(count[order]), SEARCHED))]
    return rows[np.isin(member.ravel(), wanted)]


_Sizes = tuple[float, float, float]


def _likeliest_sizes(model: _Model, near: Scatter | None) -> tuple[_Sizes, float]:
    """Sizes and relief of highest restricted likelihood.

    Coordinate search from an earlier estimate, or from the residuals' scatter on the ground: each size in
    turn over a few values, the relief with every one.
    """
    if near is None:
        joints = model.joints
        off_px = np.abs(joints.off_px[: len(joints.rows)])
        ground = 1.48 * float(np.median(off_px / joints.px_per_unit)) + 1e-12
        best, relief, searches = (ground, 0.33, 0.25), 0.5, WIDE_SEARCHES
    else:
        lift, turn = near.lift / near.place, near.turn * model.side / near.place
        best, relief, searches = (near.place, lift, turn), near.relief, NEAR_SEARCHES
    model.reweigh(best, relief)
    for search in searches:
        score, relief = max((value, r) for r, value in model.evidence(best).items())
        for axis, options in enumerate(search):
            centre = best
            for option in options:
                sizes = list(centre)
                sizes[axis] = option if axis else option * centre[0]
                tried = (sizes[0], sizes[1], sizes[2])
                likelihood, likeliest = max((v, r) for r, v in model.evidence(tried).items())
                if likelihood > score:
                    score, relief, best = likelihood, likeliest, tried
        model.reweigh(best, relief)
    return best, relief


class _Normal(NamedTuple):
    """Restricted log likelihood, solution and normal matrix, for each size of the relief."""

    value: Float[np.ndarray, " r"]
    x: Float[np.ndarray, "r k"]
    H: Float[np.ndarray, "r k k"]


class _Model:
    """The linear mixed model of one fit's residuals; sizes are (place, lift / place, turn / place)."""

    def __init__(
        self,
        fit: Fit,
        mask: Float[np.ndarray, " p"],
        prior: Prior,
        bow: float,
        rows: Int[np.ndarray, " n"],
        widths: bool,
    ) -> None:
        self.free = np.flatnonzero(mask)
        self.joints = joints = measured_joints(fit, rows, widths=widths)
        # The widths know nothing of the pose, but what makes them differ moves the middles as well.
        J = joints.middles_only(fit.solution.jacobian[np.ix_(rows, self.free)])
        # Columns of unit length keep the normal equations well scaled.
        self.unit = 1.0 / np.maximum(np.linalg.norm(J, axis=0), 1e-12)
        self.known = (self.unit / prior.sigma[self.free]) ** 2
        self.prior_mean = prior.mean[self.free] / self.unit
        a, b = fit.grid.spacing_x or fit.grid.spacing_y, fit.grid.spacing_y
        self.side = float(np.sqrt(a * b))
        effects = slab_effects(joints, a, b, self.side)
        Z: Any = hstack(effects).tocsc()
        # Neighbouring slabs next to each other: only they share a joint, and so the products form a band.
        order = reverse_cuthill_mckee((Z.T @ Z).tocsr(), symmetric_mode=True)
        self.Z: Any = Z[:, order].tocsr()
        # Which of the three sizes each column of Z is scaled by.
        self.kind = np.repeat(np.arange(3), [effect.get_shape()[1] for effect in effects])[order]
        self.squares = np.stack([effect.power(2).sum(1).A1 for effect in effects], 1)
        relief = relief_effects(joints)
        others = width_effects(joints), bow * bow_effects(joints), BLOOM_PX * bloom_effects(joints)
        # Which of these columns are scaled by the size of the relief.
        self.relief = np.repeat([True, False], [relief.shape[1], sum(effect.shape[1] for effect in others)])
        self.columns = np.c_[J * self.unit, relief, *others, joints.off_px]
        narrower = np.abs(joints.off_px[len(rows) :])
        usual = np.r_[fit.sigma_px[rows], np.full(len(narrower), 1.48 * _median(narrower))]
        self.weight = 1.0 / (1.0 + (joints.off_px / (CAUCHY_SIGMAS * usual)) ** 2)
        self._weigh()

    def _weigh(self) -> None:
        """The products with the inverse of D that every size needs, for the weights as they are."""
        self.D = self.joints.noise_px**2 / self.weight
        ZD = (self.Z.T @ diags(1.0 / self.D)).tocsr()
        inner = (ZD @ self.Z + identity(ZD.shape[0])).tocoo()
        below = inner.row >= inner.col
        self.row, self.column = inner.row[below], inner.col[below]
        self.diagonal = self.row == self.column
        self.products = inner.data[below] - self.diagonal
        self.ZD, self.ZDC = ZD, ZD @ self.columns
        self.CDC = self.columns.T @ (self.columns / self.D[:, None])

    def factor(self, sizes: _Sizes) -> None:
        """Factorise the residuals' covariance V = D + Z Z', by Woodbury's identity on the sparse Z."""
        place, lift, turn = sizes
        self.scale = np.array([place, place * lift, place * turn])[self.kind]
        data = self.products * self.scale[self.row] * self.scale[self.column] + self.diagonal
        width = int((self.row - self.column).max()) + 1
        band = np.zeros((width, len(self.scale)))
        band[self.row - self.column, self.column] = data
        self.cholesky = cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)
        self.logdet = float(np.log(self.D * self.weight).sum() + 2.0 * np.log(self.cholesky[0]).sum())
        across = self.scale[:, None] * self.ZDC
        self.gram = self.CDC - across.T @ self._solved(across)

    def _solved(self, right: np.ndarray) -> np.ndarray:
        return cho_solve_banded((self.cholesky, True), right, check_finite=False)

    def _whitened(self, x: Float[np.ndarray, "n c"]) -> Float[np.ndarray, "n c"]:
        """V^-1 x."""
        scale = self.scale[:, None]
        return x / self.D[:, None] - self.ZD.T @ (scale * self._solved(scale * (self.ZD @ x)))

    def misfit(self, relief: float) -> float:
        """How much more the stations that share something agree than in pictures drawn from the model."""
        p, k = len(self.free), len(self.relief)
        X = self.columns[:, :-1] * np.r_[np.ones(p), np.where(self.relief, relief, 1.0)]
        random = np.random.default_rng(0)
        drawn = np.sqrt(self.D)[:, None] * random.standard_normal((len(X), DRAWS))
        drawn += self.Z @ (self.scale[:, None] * random.standard_normal((len(self.scale), DRAWS)))
        drawn += X[:, p:] @ random.standard_normal((k, DRAWS))
        VX = self._whitened(X)
        inverse = np.linalg.inv(self._normal(np.array([relief])).H[0])
        y = np.column_stack([self.joints.off_px, drawn])
        pulls = self._whitened(y - X @ (inverse @ (VX.T @ y)))
        return drawn_design_effect(X, inverse, pulls, self.joints.shared, 6)

    def _normal(self, reliefs: Float[np.ndarray, " r"]) -> _Normal:
        """Normal equations of the motion and the relief's shifts, for each size of the relief."""
        p, k = len(self.free), len(self.relief)
        scale = np.ones((len(reliefs), p + k))
        scale[:, p:][:, self.relief] = reliefs[:, None]
        # A direction that nothing tells (along the joints of rows) stays where it is, and unknown.
        little = 1e-10 * np.diag(self.gram)[:p]
        known = np.r_[self.known + little, np.ones(k)]
        mean = np.r_[np.where(self.known > 0, self.prior_mean, 0.0), np.zeros(k)]
        H = self.gram[:-1, :-1] * scale[:, :, None] * scale[:, None, :] + np.diag(known)
        g = self.gram[:-1, -1] * scale - known * mean
        x = -np.linalg.solve(H, g[..., None])[..., 0]
        left = self.gram[-1, -1] + (g * x).sum(1) + float(known @ mean**2)
        value = -0.5 * (left + self.logdet + np.linalg.slogdet(H)[1])
        return _Normal(value, x * scale, H)

    def solve(self) -> list[tuple[float, np.ndarray, np.ndarray]]:
        """Restricted log likelihood, scaled motion and its covariance, for each size of the relief."""
        normal, p = self._normal(np.array(RELIEFS)), len(self.free)
        covariance = np.linalg.inv(normal.H)[:, :p, :p]
        return [(float(v), x[:p], C) for v, x, C in zip(normal.value, normal.x, covariance, strict=True)]

    def evidence(self, sizes: _Sizes) -> dict[float, float]:
        """Restricted log likelihood for each size of the relief."""
        self.factor(sizes)
        return dict(zip(RELIEFS, self._normal(np.array(RELIEFS)).value.tolist(), strict=True))

    def reweigh(self, sizes: _Sizes, relief: float) -> None:
        """Cauchy weights from what is left of each station's residual when the slabs have had their share."""
        self.factor(sizes)
        x = self._normal(np.array([relief])).x[0]
        left = self.columns @ np.r_[x, 1.0]
        own = self.D * self._whitened(left[:, None])[:, 0]
        # A slab's own effect would take up a side that is wholly mismeasured: it is judged as a whole.
        place, lift, turn = sizes
        variance = self.joints.noise_px**2 + self.squares @ (place * np.array([1.0, lift, turn])) ** 2
        deviation = np.abs(left) / np.sqrt(variance)
        gross = deviation > GROSS_SIGMAS * max(1.48 * float(np.median(deviation)), 1e-6)
        self.weight = np.where(gross, 1e-6, 1.0 / (1.0 + own**2 / (CAUCHY_SIGMAS**2 * self.D * self.weight)))
        self._weigh()


def _median(values: Float[np.ndarray, " n"]) -> float:
    return float(np.median(values)) + 1e-6 if len(values) else 1.0
