"""Quadratic functions of the place on the ground: how ground that is no plane may be bent, to first order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Quadric:
    """Functions of x and y, which run from -1 to 1 over the longer side of a box on the ground."""

    low: Float[np.ndarray, "2"]
    high: Float[np.ndarray, "2"]

    @classmethod
    def over(cls, ground: Float[np.ndarray, "n 2"]) -> Quadric:
        """Those over the box of some places."""
        return cls(ground.min(0), ground.max(0))

    @property
    def extent(self) -> float:
        """The longer side of the box."""
        return float(np.max(self.high - self.low))

    def shapes(self, ground: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Values of x^2, y^2 and xy: bent along X, along Y, or twisted."""
        x, y = self._within(ground).T
        return np.stack([x * x, y * y, x * y], 1)

    def slope(
        self, ground: Float[np.ndarray, "n 2"], factors: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "n 2"]:
        """How steeply the sum of these, times their factors, rises along X and along Y."""
        xx, yy, xy = factors
        return self._within(ground) @ np.array([[2 * xx, xy], [xy, 2 * yy]]) * (2.0 / self.extent)

    def _within(self, ground: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        return (2 * ground - self.low - self.high) / self.extent
