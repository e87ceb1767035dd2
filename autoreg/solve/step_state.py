"""What a step of the solver is given and what it hands on: plain arrays, whoever carries it out."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from autoreg.solve.joint_data import PARAMETERS, JointData

# Shapes are fixed, so that one compiled function serves every photo.
CAPACITY = 2048


class Problem(NamedTuple):
    """What a step needs to know.

    The solver's variables are the parameters divided by `unit`, which is zero for a frozen one.
    """

    data: JointData
    unit: Float[np.ndarray, " p"]
    prior_mean: Float[np.ndarray, " p"]
    prior_weight: Float[np.ndarray, " p"]


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


def example_arguments() -> tuple[np.ndarray, State, Problem]:
    """Arguments of a step, of the right shapes."""
    n = CAPACITY
    rows = np.zeros((n, 2))
    data = JointData(rows, rows, rows, np.zeros(n), np.eye(3), np.ones(3), np.zeros(12), np.ones(PARAMETERS))
    return np.zeros(PARAMETERS), blank_state(), Problem(data, *(np.zeros(PARAMETERS) for _ in range(3)))
