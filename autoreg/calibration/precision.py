"""How well the intrinsics are known: their covariance, and whether the views bear it out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from autoreg.calibration.adjustment import Adjustment
from autoreg.calibration.models import COUNT

# An excess of this many standard errors is taken for real; less is chance.
_EXCESS_SIGMAS = 2.0
# Directions of the unknowns that are known less well than this, against their own scale, are not known.
_UNDETERMINED = 1e-12


@dataclass(frozen=True)
class Precision:
    """Uncertainty of the intrinsics.

    Attributes:
        covariance: of (fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6); zero for those that the model does not have.
        dispersion: by how much the views scatter more than their corners' scatter allows (as a ratio of
            standard deviations); the covariance includes it.
        determined: whether the views determine all the intrinsics.
    """

    covariance: Float[np.ndarray, "12 12"]
    dispersion: float
    determined: bool

    @property
    def std_devs(self) -> Float[np.ndarray, "12"]:
        """Standard deviations of the intrinsics."""
        return np.sqrt(self.covariance.diagonal())


def precision_of(fit: Adjustment) -> Precision:
    """The intrinsics' covariance s² D² S^-1.

    S is the sum of the views' information and s the scatter of the corners. D, the dispersion, is 1 unless
    the views' own gradients g_v are larger than independent corners make them: bent sheets, blur and lens
    errors are shared by neighbouring corners, and such corners tell less than their number. Its estimate,
    D² = sum g' S^-1 g / (s² (p - sum tr (S^-1 S_v)²)), is that of Birge's ratio and of the sandwich
    covariance, pooled over the unknowns.
    """
    total = fit.total
    size = total.diagonal()
    unit = 1 / np.sqrt(np.where(size > 0, size, 1.0))
    values, vectors = np.linalg.eigh(total * unit[:, None] * unit)
    determined = bool((size > 0).all() and values[0] > _UNDETERMINED * values[-1])
    inverse = unit[:, None] * (vectors / np.maximum(values, 1e-15)) @ vectors.T * unit
    dispersion = _dispersion(fit, inverse)
    count = int(fit.free[:COUNT].sum())
    covariance = np.zeros((COUNT, COUNT))
    which = np.flatnonzero(fit.free[:COUNT])
    covariance[np.ix_(which, which)] = (inverse * (fit.sigma_px * dispersion) ** 2)[:count, :count]
    return Precision(covariance, dispersion, determined)


def shared_variance(fit: Adjustment) -> float:
    """The variance in px² that a view's corners share, beyond their scatter: what a wrong camera leaves."""
    return fit.sigma_px**2 * (precision_of(fit).dispersion ** 2 - 1)


def _dispersion(fit: Adjustment, inverse: Float[np.ndarray, "f f"]) -> float:
    # Views that repeat one another share their errors and count as one.
    member = np.equal.outer(np.unique(fit.standpoint), fit.standpoint).astype(float)
    information = np.einsum("gv,vij->gij", member, fit.information)
    gradients = member @ fit.gradients
    shares = inverse @ information
    traces = np.einsum("vij,vji->v", shares, shares)
    expected = float(np.einsum("vii->", shares)) - float(traces.sum())
    if expected <= 0 or fit.sigma_px <= 0:
        return 1.0
    found = float(np.einsum("vi,ij,vj->", gradients, inverse, gradients)) / fit.sigma_px**2
    # Each view adds a sum of squares with weights between 0 and 1; their squares give its variance.
    spread = np.sqrt(2 * float((traces - traces**2 / len(inverse)).clip(min=0).sum())) / expected
    squared = found / expected
    return float(np.sqrt(squared)) if squared > 1 + _EXCESS_SIGMAS * spread else 1.0
