"""Many solves at once: the same least squares as `solver`, vmapped over problems, in one compiled loop.

`solver` steps through one photo's problem from Python, which says how it ended and costs a few milliseconds
of calls. Where many problems wait, all of them step together here, and a processor with many lanes has
something to do. The damping is Marquardt's: down tenfold after a step that lowers the cost, up tenfold else
(Nocedal and Wright, Numerical Optimization, 10.3).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from autoreg.joint_data import PARAMETERS, JointData
from autoreg.residuals import Numbers, joint_distance, moved_projection, robust, robust_curvature
from autoreg.solver import (
    CAUCHY_SIGMAS,
    FIRST_DAMPING,
    LEAST_DAMPING,
    MOST_DAMPING,
    MOST_STEPS,
    NOTHING,
    STOP,
    Prior,
    Solution,
    outcome_of,
    padded,
)


class _Problem(NamedTuple):
    """One problem; the solver's variables are the free parameters divided by `unit`."""

    data: JointData
    unit: Float[Numbers, " f"]
    prior_mean: Float[Numbers, " f"]
    prior_weight: Float[Numbers, " f"]


class _State(NamedTuple):
    """One problem's variables, and what was evaluated there."""

    q: Float[Array, " f"]
    cost: Float[Array, ""]
    gradient: Float[Array, " f"]
    curvature: Float[Array, "f f"]
    damping: Float[Array, ""]
    promised: Float[Array, ""]
    steps: Int[Array, ""]
    going: Bool[Array, ""]


def solve_batch(
    problems: Sequence[JointData], free: Float[np.ndarray, " p"], priors: Sequence[Prior] | None = None
) -> tuple[Solution, ...]:
    """Solutions of many problems in which the same parameters are free, as `solve_joints` finds them.

    Problems are padded to the joints of the largest, rounded up to an eighth of a power of two: one
    compilation serves all batches of like size.

    Args:
        problems: measured joints of each problem, at least one joint each.
        free: one for each parameter to solve for, zero for each to keep.
        priors: what is known of each problem's parameters beforehand.

    Raises:
        ValueError: no problem, or one without joints.
    """
    if not problems or min(len(p.weight) for p in problems) < 1:
        raise ValueError(f"problems: want at least one, each with a joint; got {len(problems)}")
    most = _rounded(max(len(p.weight) for p in problems))
    columns = tuple(int(k) for k in np.flatnonzero(free))
    nothing_known = Prior(np.zeros(PARAMETERS), np.full(PARAMETERS, np.inf))
    ready = [
        _problem(data, columns, prior, most)
        for data, prior in zip(problems, priors or [nothing_known] * len(problems), strict=True)
    ]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *ready)
    with jax.enable_x64(True):
        parameters, cost, promised, distances, jacobian, steps = (
            np.asarray(part) for part in _compiled(columns)(stacked)
        )
    return tuple(
        Solution(
            outcome_of(float(cost[k]), float(promised[k])),
            parameters[k],
            float(cost[k]),
            distances[k, : len(data.weight)],
            jacobian[k, : len(data.weight)],
            int(steps[k]),
        )
        for k, data in enumerate(problems)
    )


def _rounded(rows: int) -> int:
    part = max(8, 1 << max((rows - 1).bit_length() - 3, 0))
    return -(-rows // part) * part


def _problem(data: JointData, columns: tuple[int, ...], prior: Prior, most: int) -> _Problem:
    free = list(columns)
    scale = np.asarray(data.scale, float)[free]
    return _Problem(
        data=padded(data, most),
        unit=np.ones(len(free)),
        prior_mean=prior.mean[free] / scale,
        prior_weight=scale / (CAUCHY_SIGMAS * prior.sigma[free]),
    )


@cache
def _compiled(columns: tuple[int, ...]) -> Any:
    return jax.jit(jax.vmap(partial(_solve, columns)))


def _solve(columns: tuple[int, ...], problem: _Problem) -> tuple[Array, ...]:
    """Parameters, cost, promised decrease, distances, Jacobian and steps of one problem."""
    zero = jnp.zeros(len(columns))
    _, slope, J = _weighted(zero, columns, problem)
    # Columns of unit length, since the damping is the same for all variables.
    length = jnp.linalg.norm(J * slope[:, None], axis=0)
    unit = 1.0 / jnp.where(length > 0, length, 1.0)
    scaled = problem._replace(unit=unit)
    first = _at(zero, columns, scaled, jnp.asarray(FIRST_DAMPING), jnp.asarray(0))
    state = jax.lax.while_loop(lambda s: s.going, lambda s: _step(s, columns, scaled), first)
    scale = jnp.asarray(problem.data.scale)
    whole = _whole(state.q * unit, columns)
    distances, outer, inner = _slopes(whole, tuple(range(PARAMETERS)), problem.data)
    jacobian = (outer @ inner) / scale
    return whole * scale, state.cost, state.promised, distances, jacobian, state.steps


def _whole(p: Array, columns: tuple[int, ...]) -> Float[Array, " p"]:
    """All parameters, those that are not free zero."""
    return jnp.zeros(PARAMETERS).at[np.array(columns)].set(p)


def _slopes(p: Array, columns: tuple[int, ...], data: JointData) -> tuple[Array, Array, Array]:
    """Distances, their derivatives by the projection's few numbers, and of those by the chosen parameters."""
    every = jax.vmap(jax.value_and_grad(joint_distance), in_axes=(None, 0, 0, 0))
    distances, outer = every(moved_projection(p, data), data.ground, data.measured_px, data.normal)

    def numbers(some: Array) -> Array:
        moved = moved_projection(p.at[np.array(columns)].set(some), data)
        return jnp.concatenate([moved.cam_from_plane.ravel(), moved.intrinsics])

    inner = jax.jacfwd(numbers)(p[np.array(columns)])
    flat = jnp.concatenate([outer.cam_from_plane.reshape(len(distances), -1), outer.intrinsics], 1)
    return distances, flat, inner


def _weighted(q: Array, columns: tuple[int, ...], problem: _Problem) -> tuple[Array, Array, Array]:
    """Weighted distances, the robust slope of each, and the weighted derivatives by the variables."""
    data = problem.data
    distances, outer, inner = _slopes(_whole(q * problem.unit, columns), columns, data)
    doubt = distances * data.weight
    _, slope = robust(doubt)
    return doubt, slope, (outer * jnp.asarray(data.weight)[:, None]) @ (inner * problem.unit)


def _at(q: Array, columns: tuple[int, ...], problem: _Problem, damping: Array, steps: Array) -> _State:
    """The state at some variables; the cost's own curvature where it is convex, else Gauss and Newton's."""
    doubt, slope, J = _weighted(q, columns, problem)
    known = problem.prior_weight * problem.unit
    off = problem.prior_weight * (q * problem.unit - problem.prior_mean)
    r, _ = robust(doubt)
    cost, gradient = 0.5 * (r @ r + off @ off), J.T @ (r * slope) + known * off
    newton = J.T @ (J * robust_curvature(doubt)[:, None]) + jnp.diag(known**2)
    normal = J.T @ (J * (slope**2)[:, None]) + jnp.diag(known**2)
    convex = jnp.isfinite(jnp.linalg.cholesky(newton)).all()
    curvature = jnp.where(convex, newton, normal)
    # The ridge keeps what nothing tells from promising; it is far below what anything tells.
    ridge = 1e-13 * jnp.trace(curvature) * jnp.eye(len(columns))
    promised = 0.5 * gradient @ jnp.linalg.solve(curvature + ridge, gradient)
    going = (promised > STOP * cost + NOTHING) & (damping < MOST_DAMPING) & (steps < MOST_STEPS)
    return _State(q, cost, gradient, curvature, damping, promised, steps, going & jnp.isfinite(cost))


def _step(state: _State, columns: tuple[int, ...], problem: _Problem) -> _State:
    damped = state.curvature + state.damping * jnp.eye(len(columns))
    there = _at(
        state.q - jnp.linalg.solve(damped, state.gradient),
        columns,
        problem,
        jnp.maximum(0.1 * state.damping, LEAST_DAMPING),
        state.steps + 1,
    )
    better = there.cost < state.cost
    damping, steps = 10.0 * state.damping, state.steps + 1
    stay = state._replace(damping=damping, steps=steps, going=(damping < MOST_DAMPING) & (steps < MOST_STEPS))
    return jax.tree.map(lambda new, old: jnp.where(better, new, old), there, stay)
