"""One step of jaxopt's Levenberg-Marquardt, compiled once; the only file that knows jaxopt.

jaxopt is imported where the step is traced. A step that an earlier process compiled is fetched from a folder,
machine code and all, and then neither is jaxopt imported nor anything traced.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from autoreg import residuals
from autoreg.machine_code import fetch_code, fingerprint, keep_code
from autoreg.residuals import PARAMETERS, JointData, Numbers, distances_and_jacobian, robust, robust_curvature

# Shapes are fixed, so that one compiled function serves every photo.
CAPACITY = 2048


class Problem(NamedTuple):
    """What a step needs to know.

    The solver's variables are the parameters divided by `unit`, which is zero for a frozen one.
    """

    data: JointData
    unit: Float[Numbers, " p"]
    prior_mean: Float[Numbers, " p"]
    prior_weight: Float[Numbers, " p"]


class State(NamedTuple):
    """What one step hands on to the next: jaxopt's state without what it does not use.

    Attributes:
        damping_factor: Marquardt's.
        increase_factor: by which the damping grows after the next step that fails.
        residual: robust residuals of the joints and of the prior.
        value: the cost, half their sum of squares.
        delta: the last step.
        gradient: of the cost.
        jac: derivatives of the residuals by the variables.
        jt: the same, transposed.
        jtj: what stands for the cost's second derivatives.
        aux: the joints' own distances and derivatives, and the cost's second derivatives.
    """

    damping_factor: Any
    increase_factor: Any
    residual: Any
    value: Any
    delta: Any
    gradient: Any
    jac: Any
    jt: Any
    jtj: Any
    aux: Any


Step = Callable[[Any, State, Problem], tuple[Any, State]]


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


def _traced() -> Any:
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

    return jax.jit(step).lower(*_example())


def _example() -> tuple[np.ndarray, State, Problem]:
    """Arguments of a step, of the right shapes."""
    n = CAPACITY
    rows = np.zeros((n, 2))
    data = JointData(rows, rows, rows, np.zeros(n), np.eye(3), np.ones(3), np.zeros(12), np.ones(PARAMETERS))
    return np.zeros(PARAMETERS), blank_state(), Problem(data, *(np.zeros(PARAMETERS) for _ in range(3)))


@cache
def blank_state() -> State:
    """A state from which a step stays where it is and only evaluates: infinite cost, and no gradient.

    jaxopt's own first state would need a second copy of the evaluation to be traced and compiled.
    """
    n, p = CAPACITY, PARAMETERS
    rows = n + p
    return State(
        damping_factor=np.float64(1.0),
        increase_factor=np.float64(2.0),
        residual=np.zeros(rows),
        value=np.float64(np.inf),
        delta=np.zeros(p),
        gradient=np.zeros(p),
        jac=np.zeros((rows, p)),
        jt=np.zeros((p, rows)),
        jtj=np.zeros((p, p)),
        aux=(np.zeros(n), np.zeros((n, p)), np.zeros((p, p))),
    )


_COMPILING = threading.Lock()
_STEP: list[Step] = []


def compiled_step(folder: Path | None = None) -> Step:
    """The step, compiled once for this process; jax's 64-bit mode must be on.

    Args:
        folder: where an earlier process may have left its machine code, and where else it is left.
    """
    # Whoever comes while another thread compiles (beside the reading of a photo) waits for it.
    with _COMPILING:
        if not _STEP:
            _STEP.append(_traced().compile() if folder is None else _kept(folder))
        return _STEP[0]


def _kept(folder: Path) -> Step:
    arguments = _example()
    path = folder / f"step-{fingerprint(__file__, residuals.__file__, packages=('jaxopt',))}"
    fetched = fetch_code(path, arguments, arguments[:2])
    if fetched is not None:
        return fetched
    step = _traced().compile()
    keep_code(path, step)
    return step
