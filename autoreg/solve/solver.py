"""Non-linear least squares by jaxopt's Levenberg-Marquardt: the loop around its step.

jaxopt supplies the step and the damping (Madsen and Nielsen, algorithm 6.18). The loop stands here,
because jaxopt's own never says why it stopped, judges by a tolerance that is absolute, and compiles the step
three times over.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from autoreg.solve.compiled_step import compiled_step
from autoreg.solve.joint_data import PARAMETERS, JointData
from autoreg.solve.step_state import CAPACITY, Problem, State, blank_state

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


def solve_joints(
    data: JointData,
    free: Float[np.ndarray, " p"],
    prior: Prior | None = None,
    *,
    rough: bool = False,
    most_steps: int = MOST_STEPS,
) -> Solution:
    """Pose (and what else `free` marks with ones) that lays the projected joints on the measured ones.

    Args:
        data: measured joints, at least one and at most `CAPACITY`.
        free: one for each parameter to solve for, zero for each to keep.
        prior: what is known of the parameters beforehand.
        rough: whether the joints will be measured and solved again, so that near the minimum is enough.
        most_steps: after so many the solve ends, converged or not.

    Raises:
        ValueError: no joint, or more than `CAPACITY`.
    """
    n = len(data.weight)
    if not 1 <= n <= CAPACITY:
        raise ValueError(f"data: from 1 to {CAPACITY} joints can be solved at once, got {n}")
    scale = np.asarray(data.scale, float)
    prior = prior or Prior(np.zeros(PARAMETERS), np.full(PARAMETERS, np.inf))
    problem = Problem(
        data=padded(data, CAPACITY),
        unit=np.asarray(free, float),
        prior_mean=prior.mean / scale,
        prior_weight=scale / (CAUCHY_SIGMAS * prior.sigma),
    )
    stop, most_steps = (ROUGH_STOP, min(ROUGH_STEPS, most_steps)) if rough else (STOP, most_steps)
    q, state, unit, steps = _minimise(problem, stop, most_steps)
    distances, jacobian = (v[:n] for v in state.aux[:2])
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


def _minimise(problem: Problem, stop: float, most_steps: int) -> tuple[np.ndarray, State, np.ndarray, int]:
    """The solver's variables at the minimum, jaxopt's state there, their units, and the steps taken."""
    step = compiled_step()
    q = np.zeros(PARAMETERS)
    _, state = step(q, blank_state(), problem)
    # Columns of unit length, since jaxopt's damping is the same for all variables.
    length = np.sqrt(np.diagonal(state.jtj))
    finer = 1.0 / np.where(length > 0, length, 1.0)
    unit = problem.unit * finer
    problem = problem._replace(unit=unit)
    state = _curved(_rescaled(state, finer)._replace(damping_factor=np.float64(FIRST_DAMPING)))
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
    return q, state, unit, steps


def _rescaled(state: State, unit: np.ndarray) -> State:
    """The state at zero with its variables in other units: it need not be evaluated again."""
    jac, both = state.jac * unit, np.outer(unit, unit)
    distances, jacobian, curvature = state.aux
    return state._replace(
        gradient=state.gradient * unit,
        jac=jac,
        jt=np.ascontiguousarray(jac.T),
        jtj=state.jtj * both,
        aux=(distances, jacobian, curvature * both),
    )


def _curved(state: State) -> State:
    """The state with the cost's own curvature in place of the Gauss-Newton approximation, where it is convex.

    Gauss-Newton on robust residuals creeps (its rate falls to that of the doubted joints), and then promises
    too little: what looks like a minimum can be standard deviations away from it.
    """
    newton = state.aux[2]
    if not np.isfinite(newton).all():
        return state
    values = np.linalg.eigvalsh(newton)
    if values[0] <= -1e-12 * values[-1]:
        return state
    return state._replace(jtj=newton, damping_factor=np.maximum(state.damping_factor, LEAST_DAMPING))


def _promised(state: State) -> float:
    """Decrease of the cost that a Gauss-Newton step promises: a measure free of scales and of the damping."""
    gradient, normal = state.gradient, state.jtj
    if not (np.isfinite(gradient).all() and np.isfinite(normal).all()):
        return np.nan
    # Frozen and undetermined variables promise nothing.
    values, vectors = np.linalg.eigh(normal)
    along = vectors.T @ gradient
    return float(0.5 * np.sum(along**2 / np.where(values > 1e-13 * values[-1], values, np.inf)))


def warm_up(folder: Path | None = None) -> None:
    """Compile the solver's step, so that no photo need wait for it.

    Args:
        folder: where it is fetched from if an earlier process left it there, and else kept: one's own, since
            what it holds is run unseen. It is for programs to give, not for libraries.
    """
    compiled_step(folder)
