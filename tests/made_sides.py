"""Sides of a made lattice, of which some are there."""

from __future__ import annotations

import numpy as np

from autoreg.ground.sides import Grid, Sides, slab_sides
from autoreg.paving.presence import Presence


def presence_with(
    sides: Sides, p: np.ndarray, beaten: np.ndarray | None = None, support: np.ndarray | None = None
) -> Presence:
    """Sides of one size with given p-values, which tell their support if that is not given."""
    n = len(sides)
    none = np.zeros(n) if beaten is None else beaten
    support = 1.0 - p if support is None else support
    return Presence(sides, p, np.full(n, 20.0), support, none, 20.0 * sides.ends.mean(1))


def drawn_presence(
    sides: Sides, there: np.ndarray, rng: np.random.Generator, clearness: float = 2.0
) -> Presence:
    """Sides of which some are there: the clearer, the smaller their p-values; any for the others."""
    p = np.where(there, rng.beta(0.2, clearness, len(sides)), rng.uniform(size=len(sides)))
    return presence_with(sides, np.maximum(p, 1e-3))


def made_presence(there: np.ndarray) -> Presence:
    """Sides of a lattice of which some are there: clear p-values for them, uniform ones for the others."""
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 10.0))
    return drawn_presence(sides, there, np.random.default_rng(0))
