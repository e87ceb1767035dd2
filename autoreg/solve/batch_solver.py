"""Many solves at once: the same least squares as `solver`, vmapped over problems, in one compiled loop.

`solver` steps through one photo's problem from Python, which says how it ended and costs a few milliseconds
of calls. Where many problems wait, all of them step together here, and a processor with many lanes has
something to do. The damping is Marquardt's (Nocedal and Wright, Numerical Optimization, 10.3): times ten
after a step that raises the cost, but only halved after one that lowers it, since where the projection bends
a damping that falls quickly fails at every second step (Transtrum and Sethna, arXiv 1201.5885).

All wait for the one that takes the most steps. Far from the minimum the cost's own curvature is much too
small (Cauchy's loss bends down again), and a step by it overshoots; the parabolas that touch the joints'
losses and lie above them everywhere do not (iteratively reweighted least squares; Huber, Robust Statistics,
7.8). Near the minimum those creep, and the cost's own curvature ends in a step or two.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from autoreg.solve.joint_data import PARAMETERS, JointData
from autoreg.solve.residuals import (
    Projection,
    distances_and_jacobian,
    moved_projection,
    pixel,
    robust_curvature,
)
from autoreg.solve.solver import (
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
)

# The cost's own curvature is believed where it promises less than this share of the cost: the step is small.
NEAR = 0.01
# The ridge keeps what nothing tells from promising; it is far below what anything tells.
RIDGE = 1e-12


class _Problem(NamedTuple):
    """One problem, or several along a first axis; the prior is that of the free parameters."""

    data: JointData
    prior_mean: Float[np.ndarray, "*k f"]
    prior_weight: Float[np.ndarray, "*k f"]


class _Model(NamedTuple):
    """The cost about some values of the free parameters."""

    p: Float[Array, " f"]
    cost: Float[Array, ""]
    gradient: Float[Array, " f"]
    majorant: Float[Array, "f f"]
    newton: Float[Array, "f f"]


class _State(NamedTuple):
    """One problem's free parameters, and what was evaluated there."""

    p: Float[Array, " f"]
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
    columns = tuple(int(k) for k in np.flatnonzero(free))
    nothing_known = Prior(np.zeros(PARAMETERS), np.full(PARAMETERS, np.inf))
    stacked = _stacked(problems, priors or [nothing_known] * len(problems), list(columns))
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


def _stacked(problems: Sequence[JointData], priors: Sequence[Prior], free: list[int]) -> _Problem:
    """All problems with as many joints as the largest, rounded up.

    Those that are added are the first, which projects to something finite, without weight.
    """
    most = _rounded(max(len(p.weight) for p in problems))

    def of(name: str) -> np.ndarray:
        return np.array([getattr(p, name) for p in problems], float)

    def filled(name: str) -> np.ndarray:
        parts = [np.asarray(getattr(p, name), float) for p in problems]
        whole = np.empty((len(parts), most, *parts[0].shape[1:]))
        for place, part in zip(whole, parts, strict=True):
            place[: len(part)], place[len(part) :] = part, part[0]
        return whole

    weight = filled("weight")
    for place, data in zip(weight, problems, strict=True):
        place[len(data.weight) :] = 0.0
    rows = filled("ground"), filled("measured_px"), filled("normal"), weight
    scale = of("scale")
    mean, sigma = (np.array([getattr(p, name)[free] for p in priors]) for name in ("mean", "sigma"))
    return _Problem(
        JointData(*rows, of("R"), of("t"), of("intrinsics"), scale),
        mean / scale[:, free],
        scale[:, free] / (CAUCHY_SIGMAS * sigma),
    )


def _rounded(rows: int) -> int:
    part = max(8, 1 << max((rows - 1).bit_length() - 3, 0))
    return -(-rows // part) * part


@cache
def _compiled(columns: tuple[int, ...]) -> Any:
    return jax.jit(jax.vmap(partial(_solve, columns)))


def _solve(columns: tuple[int, ...], problem: _Problem) -> tuple[Array, ...]:
    """Parameters, cost, promised decrease, distances, Jacobian and steps of one problem."""
    start = _model(jnp.zeros(len(columns)), columns, problem)
    # What the parameters' units are does not matter: ridge and damping are shares of the first curvature.
    own = jnp.diag(start.majorant)
    size = jnp.where(own > 0, own, 1.0)
    first = _state(start, size, jnp.asarray(FIRST_DAMPING), jnp.asarray(0))
    end = jax.lax.while_loop(lambda s: s.going, lambda s: _step(s, size, columns, problem), first)
    whole = _whole(end.p, columns)
    distances, jacobian = distances_and_jacobian(whole, problem.data)
    scale = jnp.asarray(problem.data.scale)
    return whole * scale, end.cost, end.promised, distances, jacobian / scale, end.steps


def _whole(p: Array, columns: tuple[int, ...]) -> Float[Array, " p"]:
    """All parameters, those that are not free zero."""
    return jnp.zeros(PARAMETERS).at[np.array(columns)].set(p)


def _distances(
    p: Float[Array, " p"], columns: tuple[int, ...], data: JointData
) -> tuple[Float[Array, " n"], Float[Array, "f n"]]:
    """Distances of the joints across them, and their derivatives by the chosen parameters."""
    chosen = np.array(columns)
    # Coordinates as arrays of their own: points of two numbers would leave most of a register empty.
    (gx, gy), (x, y), (nx, ny) = data.ground.T, data.measured_px.T, data.normal.T

    def distances(moved: Projection) -> Array:
        A = moved.cam_from_plane
        u, v = pixel(moved.intrinsics, *(A[k, 0] * gx + A[k, 1] * gy + A[k, 2] for k in range(3)))
        return (u - x) * nx + (v - y) * ny

    moved, by_parameter = jax.linearize(
        lambda some: moved_projection(p.at[chosen].set(some), data), p[chosen]
    )
    found, by_projection = jax.linearize(distances, moved)
    # Row by row: what `vmap` makes of it would be worked out anew wherever it is used.
    return found, jnp.stack([by_projection(by_parameter(column)) for column in np.eye(len(columns))])


def _model(p: Array, columns: tuple[int, ...], problem: _Problem) -> _Model:
    """The cost at some parameters, its gradient, and the two curvatures that may stand for it."""
    weight = jnp.asarray(problem.data.weight)
    distances, jacobian = _distances(_whole(p, columns), columns, problem.data)
    doubt, J = distances * weight, jacobian * weight
    known, off = problem.prior_weight, problem.prior_weight * (p - problem.prior_mean)
    share = 1 / (1 + doubt**2)
    # One product for all three sums over the joints.
    sums = jnp.concatenate([J * share, J * robust_curvature(doubt), (doubt * share)[None]]) @ J.T
    majorant, newton, gradient = jnp.split(sums, [len(J), 2 * len(J)])
    prior = jnp.diag(known**2)
    cost = 0.5 * (jnp.log1p(doubt**2).sum() + off @ off)
    return _Model(p, cost, gradient[0] + known * off, majorant + prior, newton + prior)


def _state(model: _Model, size: Array, damping: Array, steps: Array) -> _State:
    ridge = RIDGE * jnp.diag(size)
    cautious, bold = (_promised(c + ridge, model.gradient) for c in (model.majorant, model.newton))
    # Where the cost is not convex, nothing is promised that could be compared.
    near = bold < NEAR * model.cost
    promised = jnp.where(near, bold, cautious)
    going = (promised > STOP * model.cost + NOTHING) & (damping < MOST_DAMPING) & (steps < MOST_STEPS)
    return _State(
        model.p, model.cost, model.gradient, jnp.where(near, model.newton, model.majorant),
        damping, promised, steps, going & jnp.isfinite(model.cost),
    )  # fmt: skip


def _promised(curvature: Float[Array, "f f"], gradient: Float[Array, " f"]) -> Float[Array, ""]:
    """By how much a step lowers the cost that such a curvature describes; NaN where it is not convex."""
    half = jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(curvature), gradient, lower=True)
    return 0.5 * half @ half


def _step(state: _State, size: Array, columns: tuple[int, ...], problem: _Problem) -> _State:
    factor = jnp.linalg.cholesky(state.curvature + state.damping * jnp.diag(size))
    step = jax.scipy.linalg.cho_solve((factor, True), state.gradient)
    there = _state(
        _model(state.p - step, columns, problem),
        size,
        jnp.maximum(0.5 * state.damping, LEAST_DAMPING),
        state.steps + 1,
    )
    damping, steps = 10.0 * state.damping, state.steps + 1
    stay = state._replace(damping=damping, steps=steps, going=(damping < MOST_DAMPING) & (steps < MOST_STEPS))
    return jax.tree.map(partial(jnp.where, there.cost < state.cost), there, stay)
