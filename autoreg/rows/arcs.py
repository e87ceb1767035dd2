"""Whether measured joints are straight, or arcs as those of fans and waves are.

A strip of a fan's stones is a lattice, and a few of its arcs are rows, wherever they are straight enough.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from autoreg.fitting.fit import LEAST_WEIGHT, Fit
from autoreg.ground.sides import ALONG_X

# Fewer stations than this tell no bow.
FEWEST_STATIONS = 20


@dataclass(frozen=True)
class Arc:
    """By how much joints turn alike from end to end, and the standard deviation of that, in radians."""

    turn: float
    sigma: float


def common_arc(fit: Fit, family: int = ALONG_X) -> Arc | None:
    """The turn that the unbroken joints of a family share, each with a place and direction of its own.

    None where too few stations of them are measured.
    """
    stations = fit.stations
    rows = np.flatnonzero((fit.weight > LEAST_WEIGHT) & (stations.family == family))
    if len(rows) < FEWEST_STATIONS:
        return None
    along = stations.ground[rows, family]
    half = max(0.5 * float(np.ptp(along)), 1e-9)
    x = (along - along.min()) / half - 1.0
    names, line = np.unique(stations.line[rows], return_inverse=True)
    own, weight = np.eye(len(names))[line], np.sqrt(fit.weight[rows])
    columns = np.column_stack([own, own * x[:, None], x**2]) * weight[:, None]
    off = fit.distances_px[rows] / fit.profiles.px_per_unit[rows] * weight
    told = np.linalg.lstsq(columns, off, rcond=None)[0]
    variance = float(((off - columns @ told) ** 2).sum()) / max(len(rows) - columns.shape[1], 1)
    sigma = float(np.sqrt(variance * np.linalg.pinv(columns.T @ columns)[-1, -1]))
    # A parabola's ends point 4 / (its length / 2) times its rise apart.
    return Arc(4.0 / half * float(told[-1]), 4.0 / half * sigma)
