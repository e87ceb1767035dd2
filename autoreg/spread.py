"""Standard deviations that a few wild values leave alone."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

# Standard deviation of normal values per median of their distances from their middle (Hampel 1974).
BY_MEDIAN = 1.4826


def spread_about(values: Float[np.ndarray, " n"], middle: float = 0.0) -> float:
    """Standard deviation of values about a known middle, by the median of their distances from it."""
    return BY_MEDIAN * float(np.median(np.abs(values - middle)))


def spread(values: Float[np.ndarray, " n"]) -> float:
    """Standard deviation of values about their median, by the median of their distances from it."""
    return spread_about(values, float(np.median(values)))
