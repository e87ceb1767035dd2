"""Non-linear least squares by jaxopt's Levenberg-Marquardt; the only file that knows jaxopt.

jaxopt supplies the step and the damping (Madsen and Nielsen, algorithm 6.18). The loop around it stands here,
because jaxopt's own never says why it stopped, judges by a tolerance that is absolute, and compiles the step
three times over.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    from jaxopt import LevenbergMarquardt
    from jaxopt._src.levenberg_marquardt import LevenbergMarquardtState

from autoreg.residuals import PARAMETERS, JointData, Numbers, distances_and_jacobian, robust, robust_curvature

# Shapes are fixed, so that one compiled function serves every photo and the compilation cache hits.
CAPACITY = 2048

# A joint that lies this many standard deviations off counts half.
CAUCHY_SIGMAS = 2.4

# A solve takes at most so many steps, and none that promises less than this share of the cost; below the last
# share it counts as converged. Where joints are still searched, a rough solve will do.
MOST_STEPS, STOP = 50, 1e-10
ROUGH_STEPS, ROUGH_STOP = 12, 1e-5
CONVERGED = 1e-6
# A cost this small is rounding. Residuals are in units of what is doubted, so the cost has no unit.
NOTHING = 1e-15
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-4, 1e-10, 1e6

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
    more, but the steps were used up. `diverged`: the start has no finite cost.

    The cost is half the sum of the robust squares; `distances_px` and `jacobian` are those of the joints
    themselves, neither weighted nor made robust.
    """

    outcome: Outcome
    parameters: Float[np.ndarray, " p"]
    cost: float
    distances_px: Float[np.ndarray, " n"]
    jacobian: Float[np.ndarray, "n p"]
    steps: int


class _Problem(NamedTuple):
    """What a step needs to know.

    The solver's variables are the parameters divided by `unit`, which is zero for a frozen one.
    """

    data: JointData
    unit: Float[Numbers, " p"]
    prior_mean: Float[Numbers, " p"]
    prior_weight: Float[Numbers, " p"]


def solve_joints(
    data: JointData, free: Float[np.ndarray, " p"], prior: Prior | None = None, *, rough: bool = False
) -> Solution:
    """Pose (and what else `free` marks with ones) that lays the projected joints on the measured ones.

    Args:
        data: measured joints, at least one and at most `CAPACITY`.
        free: one for each parameter to solve for, zero for each to keep.
        prior: what is known of the parameters beforehand.
        rough: whether the joints will be measured and solved again, so that near the minimum is enough.

    Raises:
        ValueError: no joint, or more than `CAPACITY`.
    """
    n = len(data.weight)
    if not 1 <= n <= CAPACITY:
        raise ValueError(f"data: from 1 to {CAPACITY} joints can be solved at once, got {n}")
    scale = np.asarray(data.scale, float)
    prior = prior or Prior(np.zeros(PARAMETERS), np.full(PARAMETERS, np.inf))
    with jax.enable_x64(True):
        problem = _Problem(
            data=jax.device_put(padded(data, CAPACITY)),
            unit=np.asarray(free, float),
            prior_mean=prior.mean / scale,
            prior_weight=scale / (CAUCHY_SIGMAS * prior.sigma),
        )
        q, state, unit, steps = _minimise(problem, rough)
    distances, jacobian = (np.asarray(v)[:n] for v in state.aux[:2])
    cost = float(state.value)
    outcome = outcome_of(cost, _promised(state))
    return Solution(outcome, q * unit * scale, cost, distances, jacobian / scale, steps)


def outcome_of(cost: float, promised: float) -> Outcome:
    """How a solve ended, by its last cost and the decrease that a further step promises."""
    if not np.isfinite(cost):
        return "diverged"
    return "converged" if promised <= CONVERGED * cost + NOTHING else "stalled"


def padded(data: JointData, rows: int) -> JointData:
    """The joints filled up to `rows`: by the first, which projects to something finite, without weight."""
    own = np.arange(rows) < len(data.weight)
    index = np.where(own, np.arange(rows), 0)
    whole = JointData(*(np.asarray(v, float) for v in data))
    return whole._replace(
        ground=whole.ground[index],
        measured_px=whole.measured_px[index],
        normal=whole.normal[index],
        weight=np.where(own, whole.weight[index], 0.0),
    )


def _minimise(problem: _Problem, rough: bool) -> tuple[np.ndarray, Any, np.ndarray, int]:
    """The solver's variables at the minimum, jaxopt's state there, their units, and the steps taken."""
    step = _step()
    q = np.zeros(PARAMETERS)
    _, state = step(q, _blank_state(), problem)
    # Columns of unit length, since jaxopt's damping is the same for all variables.
    length = np.sqrt(np.diagonal(np.asarray(state.jtj)))
    finer = 1.0 / np.where(length > 0, length, 1.0)
    unit = np.asarray(problem.unit) * finer
    problem = problem._replace(unit=unit)
    state = _curved(_rescaled(state, finer)._replace(damping_factor=np.float64(FIRST_DAMPING)))
    most_steps, stop = (ROUGH_STEPS, ROUGH_STOP) if rough else (MOST_STEPS, STOP)
    steps = 0
    # A cost that is not finite promises nothing; damping beyond all bounds means that the rest is rounding.
    while (
        steps < most_steps
        and _promised(state) > stop * float(state.value) + NOTHING
        and state.damping_factor < MOST_DAMPING
    ):
        steps += 1
        q_next, state_next = step(q, state, problem)
        if np.isfinite(float(state_next.value)):
            q, state = q_next, _curved(state_next)
        else:
            # The step left the range of floating point, and jaxopt's blending of old and new lets NaN in.
            state = state._replace(damping_factor=state.damping_factor * 100.0)
    return np.asarray(q), state, unit, steps


def _rescaled(state: Any, unit: np.ndarray) -> Any:
    """The state at zero with its variables in other units: it need not be evaluated again."""
    jac, both = np.asarray(state.jac) * unit, np.outer(unit, unit)
    distances, jacobian, curvature = state.aux
    return state._replace(
        gradient=np.asarray(state.gradient) * unit,
        jac=jac,
        jt=np.ascontiguousarray(jac.T),
        jtj=np.asarray(state.jtj) * both,
        aux=(distances, jacobian, np.asarray(curvature) * both),
    )


def _curved(state: Any) -> Any:
    """The state with the cost's own curvature in place of the Gauss-Newton approximation, where it is convex.

    Gauss-Newton on robust residuals creeps (its rate falls to that of the doubted joints), and then promises
    too little: what looks like a minimum can be standard deviations away from it.
    """
    newton = np.asarray(state.aux[2])
    if not np.isfinite(newton).all():
        return state
    values = np.linalg.eigvalsh(newton)
    if values[0] <= -1e-12 * values[-1]:
        return state
    return state._replace(jtj=newton, damping_factor=np.maximum(state.damping_factor, LEAST_DAMPING))


def _promised(state: Any) -> float:
    """Decrease of the cost that a Gauss-Newton step promises: a measure free of scales and of the damping."""
    gradient, normal = np.asarray(state.gradient), np.asarray(state.jtj)
    if not (np.isfinite(gradient).all() and np.isfinite(normal).all()):
        return np.nan
    # Frozen and undetermined variables promise nothing.
    values, vectors = np.linalg.eigh(normal)
    along = vectors.T @ gradient
    return float(0.5 * np.sum(along**2 / np.where(values > 1e-13 * values[-1], values, np.inf)))


class _Evaluation(NamedTuple):
    residual: Float[Array, " m"]
    jacobian: Float[Array, "m p"]
    seen: tuple[Float[Array, " n"], Float[Array, "n p"], Float[Array, "p p"]]


@jax.jit
def _evaluate(q: Float[Array, " p"], problem: _Problem) -> _Evaluation:
    """Robust residuals with those of the prior, their derivatives by q, and what is seen beside them.

    That is the joints' own distances and derivatives, and the cost's second derivatives by q (without the
    bending of the projection, which small distances make negligible). jaxopt asks for the parts one by one:
    they are traced once, and the compiler merges the repeated calls.
    """
    data, unit, mean, weight = problem
    p = q * unit
    distances, jacobian = distances_and_jacobian(p, data)
    doubt = distances * data.weight
    joints, slope = robust(doubt)
    residual = jnp.concatenate([joints, weight * (p - mean)])
    rows, prior_rows = jacobian * data.weight[:, None] * unit, jnp.diag(weight * unit)
    by_q = jnp.concatenate([rows * slope[:, None], prior_rows])
    curvature = rows.T @ (rows * robust_curvature(doubt)[:, None]) + prior_rows**2
    return _Evaluation(residual, by_q, (distances, jacobian, curvature))


def _residual(q: Float[Array, " p"], problem: _Problem) -> tuple[Array, Any]:
    evaluation = _evaluate(q, problem)
    return evaluation.residual, evaluation.seen


def _jacobian(q: Float[Array, " p"], problem: _Problem) -> Array:
    return _evaluate(q, problem).jacobian


@cache
def _solver() -> LevenbergMarquardt:
    # Neither `jit` nor `run`: the loop is ours, and the step is compiled once, by `_compiled_step`.
    solver = LevenbergMarquardt(
        _residual, jac_fun=_jacobian, has_aux=True, materialize_jac=True, solver="cholesky", jit=False
    )
    # jaxopt 0.8.5 takes a `jac_fun` but forgets it when the Jacobian is materialised.
    solver._jac_fun = _jacobian  # pyright: ignore
    return solver


@cache
def _blank_state() -> Any:
    """A state from which an update stays where it is and only evaluates: infinite cost, and no gradient.

    jaxopt's own first state would need a second copy of the evaluation to be traced and compiled.
    """
    n, p = CAPACITY, PARAMETERS
    rows = n + p
    return LevenbergMarquardtState(
        # As the step hands it on: of 64 bits, where the state declares a plain int.
        iter_num=np.int64(0),  # pyright: ignore[reportArgumentType]
        damping_factor=np.float64(1.0),
        increase_factor=np.float64(2.0),
        residual=np.zeros(rows),
        value=np.float64(np.inf),
        delta=np.zeros(p),
        error=np.float64(0.0),
        gradient=np.zeros(p),
        jac=np.zeros((rows, p)),
        jt=np.zeros((p, rows)),
        jtj=np.zeros((p, p)),
        hess_res=None,
        aux=(np.zeros(n), np.zeros((n, p)), np.zeros((p, p))),
    )


_COMPILING = threading.Lock()


def _step() -> Callable[[Any, Any, _Problem], tuple[Any, Any]]:
    # Whoever comes while another thread compiles (`warm_up` beside the reading of a photo) waits for it.
    with _COMPILING:
        return _compiled_step()


@cache
def _compiled_step() -> Callable[[Any, Any, _Problem], tuple[Any, Any]]:
    return jax.jit(_solver().update).lower(np.zeros(PARAMETERS), _blank_state(), _example()).compile()


def _example() -> _Problem:
    """A problem of the right shapes."""
    n = CAPACITY
    rows = np.zeros((n, 2))
    data = JointData(rows, rows, rows, np.zeros(n), np.eye(3), np.ones(3), np.zeros(12), np.ones(PARAMETERS))
    return _Problem(data, *(np.zeros(PARAMETERS) for _ in range(3)))


def warm_up() -> None:
    """Compile the solver's step, or fetch it from jax's cache, so that no photo need wait for it."""
    with jax.enable_x64(True):
        _step()


def enable_compilation_cache(folder: Path) -> None:
    """Keep compiled functions in a folder, for this and later processes; call it before the first solve.

    It changes jax's configuration for the whole process, so it is for programs to call, not for libraries.
    """
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # By default jax keeps only what took more than a second to compile, which this may not.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
