"""The joints' distances as one plain function, for automatic differentiation to check the solvers by."""

from __future__ import annotations

import jax
from jaxtyping import Array, Float

from autoreg.solve.joint_data import JointData
from autoreg.solve.residuals import joint_distance, moved_projection


def joint_distances(parameters: Float[Array, " p"], data: JointData) -> Float[Array, " n"]:
    """Signed distance in pixels, across the joint, of each projected joint from where it was measured."""
    every = jax.vmap(joint_distance, in_axes=(None, 0, 0, 0))
    return every(moved_projection(parameters, data), data.ground, data.measured_px, data.normal)
