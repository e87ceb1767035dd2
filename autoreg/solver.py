"""Non-linear least squares by jaxopt's Levenberg-Marquardt; the only file that knows jaxopt.

jaxopt's LM never says why it stopped and its tolerance is absolute, so convergence is judged here, by the
decrease that a further Gauss-Newton step promises relative to the cost.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    from jaxopt import LevenbergMarquardt

from autoreg.residuals import PARAMETERS, JointData, joint_distances, joint_residuals

# Shapes are fixed, so that one compiled function serves every photo and the compilation cache hits.
CAPACITY = 2048

# A joint that lies this many standard deviations off counts half.
CAUCHY_SIGMAS = 2.4

Outcome = Literal["converged", "stalled", "diverged"]


@dataclass(frozen=True)
class Prior:
    """Gaussian knowledge of the parameters; an infinite `sigma` is none."""

    mean: Float[np.ndarray, " p"]
    sigma: Float[np.ndarray, " p"]


@dataclass(frozen=True)
class Solution:
    """Where a solve ended, and in what state.

    `converged`: a further step would lower the cost by less than a millionth. `stalled`: it would lower it
    more, but the iterations were used up. `diverged`: the cost is not finite or has grown.
    """

    outcome: Outcome
    parameters: Float[np.ndarray, " p"]
    cost: float
    distances_px: Float[np.ndarray, " n"]
    jacobian: Float[np.ndarray, "n p"]


@jax.jit
def _solve(data: JointData, free: Float[Array, " p"], prior: tuple[Array, Array]) -> tuple[Array, ...]:
    def residual(p: Array, data: JointData) -> Array:
        return jnp.concatenate([joint_residuals(p * free, data), prior[1] * (p - prior[0])])

    jacobian = partial(jax.jacfwd(residual))
    start = jnp.zeros(PARAMETERS)
    J0 = jacobian(start, data)
    # Columns of unit length: jaxopt's damping is the same for all parameters.
    unit = 1.0 / jnp.maximum(jnp.linalg.norm(J0, axis=0), 1e-12)
    unit = jnp.where(free > 0, unit, 0.0)

    def scaled(q: Array, data: JointData) -> Array:
        # Frozen parameters get a residual of their own, which keeps the normal equations regular.
        return jnp.concatenate([residual(q * unit, data), jnp.where(free > 0, 0.0, q)])

    solver = LevenbergMarquardt(scaled, maxiter=30, tol=1e-10, jit=True, implicit_diff=False, damping_parameter=1e-4)
    q = solver.run(start, data).params
    p = q * unit * free
    J = jacobian(p, data) * unit
    r = residual(p, data)
    gradient = J.T @ r
    normal = J.T @ J + jnp.diag(jnp.where(free > 0, 1e-12, 1.0))
    promised = 0.5 * gradient @ jnp.linalg.solve(normal, gradient)
    start_cost = 0.5 * jnp.sum(residual(start, data) ** 2)
    plain = jax.jacfwd(lambda x: joint_distances(x, data))(p)
    return p, 0.5 * jnp.sum(r**2), promised, start_cost, joint_distances(p, data), plain


def solve_joints(
    data: JointData, free: Float[np.ndarray, " p"], prior: Prior | None = None
) -> Solution:
    """Pose (and what else `free` marks with ones) that lays the projected joints on the measured ones.

    Args:
        data: measured joints, at most `CAPACITY`.
        free: one for each parameter to solve for, zero for each to keep.
        prior: what is known of the parameters beforehand.

    Raises:
        ValueError: more rows than `CAPACITY`.
    """
    n = len(data.weight)
    if n > CAPACITY:
        raise ValueError(f"data: at most {CAPACITY} joints can be solved at once, got {n}")
    scale = np.asarray(data.scale)
    prior = prior or Prior(np.zeros(PARAMETERS), np.full(PARAMETERS, np.inf))
    with jax.enable_x64(True):
        known = (jnp.asarray(prior.mean / scale), jnp.asarray(scale / (CAUCHY_SIGMAS * prior.sigma)))
        padded = _padded(data)
        p, cost, promised, start_cost, distances, jacobian = (np.asarray(v) for v in _solve(padded, jnp.asarray(free), known))
    outcome: Outcome = "converged" if promised <= 1e-6 * cost + 1e-12 else "stalled"
    if not (np.isfinite(p).all() and np.isfinite(cost)) or cost > start_cost * (1 + 1e-9) + 1e-12:
        outcome = "diverged"
    return Solution(
        outcome=outcome,
        parameters=np.asarray(p * np.asarray(data.scale), dtype=float),
        cost=float(cost),
        distances_px=np.asarray(distances, dtype=float)[:n],
        jacobian=np.asarray(jacobian, dtype=float)[:n] / np.asarray(data.scale),
    )


def _padded(data: JointData) -> JointData:
    n = len(data.weight)
    # A padding row repeats the first joint, so that it projects to something finite, with no weight.
    rows = np.where(np.arange(CAPACITY) < n, np.arange(CAPACITY), 0)
    weight = np.where(np.arange(CAPACITY) < n, np.asarray(data.weight)[rows], 0.0)
    return JointData(
        ground=jnp.asarray(np.asarray(data.ground)[rows]),
        measured_px=jnp.asarray(np.asarray(data.measured_px)[rows]),
        normal=jnp.asarray(np.asarray(data.normal)[rows]),
        weight=jnp.asarray(weight),
        R=jnp.asarray(data.R),
        t=jnp.asarray(data.t),
        intrinsics=jnp.asarray(data.intrinsics),
        scale=jnp.asarray(data.scale),
    )


def warm_up() -> None:
    """Compile (or fetch from jax's cache) the solve, so that the first photo need not wait for it."""
    data = JointData(
        ground=np.ones((1, 2)), measured_px=np.zeros((1, 2)), normal=np.array([[1.0, 0.0]]),
        weight=np.ones(1), R=np.eye(3), t=np.array([0.0, 0.0, 3.0]),
        intrinsics=np.array([1.0, 1.0] + [0.0] * 10), scale=np.ones(PARAMETERS),
    )  # fmt: skip
    solve_joints(data, np.ones(PARAMETERS))
