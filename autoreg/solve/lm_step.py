"""One step of jaxopt's Levenberg-Marquardt, traced and compiled; the only file that knows jaxopt.

It is imported where a step has to be compiled, and not where one is fetched that an earlier process compiled.
"""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from autoreg.solve.residuals import distances_and_jacobian, robust, robust_curvature
from autoreg.solve.step_state import Problem, State, example_arguments


class _Evaluation(NamedTuple):
    residual: Float[Array, " m"]
    jacobian: Float[Array, "m p"]
    seen: tuple[Float[Array, " n"], Float[Array, "n p"], Float[Array, "p p"]]


@jax.jit
def _evaluate(q: Float[Array, " p"], problem: Problem) -> _Evaluation:
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


def _residual(q: Float[Array, " p"], problem: Problem) -> tuple[Array, Any]:
    evaluation = _evaluate(q, problem)
    return evaluation.residual, evaluation.seen


def _jacobian(q: Float[Array, " p"], problem: Problem) -> Array:
    return _evaluate(q, problem).jacobian


def compiled_with_jax() -> jax.stages.Compiled:
    """The step, compiled for 64-bit numbers and this computer's processor.

    The step is so small that an accelerator would mostly wait for its numbers, and answers are the same
    on every computer of one kind.
    """
    with jax.enable_x64(True), jax.default_device(_processor()):
        return _traced().compile()


def _processor() -> Any:
    """Where to compile for; None is jax's own choice."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        # Whoever runs the program has told jax to use nothing but something else.
        return None


def _traced() -> jax.stages.Lowered:
    """The step as jax sees it, ready to be compiled."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        from jaxopt import LevenbergMarquardt
        from jaxopt._src.levenberg_marquardt import LevenbergMarquardtState

    # Neither `jit` nor `run`: the loop is ours, and the step is compiled once, here.
    solver = LevenbergMarquardt(
        _residual, jac_fun=_jacobian, has_aux=True, materialize_jac=True, solver="cholesky", jit=False
    )
    # jaxopt 0.8.5 takes a `jac_fun` but forgets it when the Jacobian is materialised.
    solver._jac_fun = _jacobian  # pyright: ignore

    def step(q: Any, state: State, problem: Problem) -> tuple[Any, State]:
        unused = {"iter_num": 0, "error": 0.0, "hess_res": None}
        moved = solver.update(q, LevenbergMarquardtState(**unused, **state._asdict()), problem)
        return moved.params, State(*(getattr(moved.state, name) for name in State._fields))

    # Arguments that the step does not use stay its arguments, so that nobody need know which they are.
    return jax.jit(step, keep_unused=True).lower(*example_arguments())
