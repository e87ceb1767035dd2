"""How far the ground lies off the plane of a fit: paving falls to its gutters, which no plane does.

The ground's height over the plane is taken for a quadratic function of the place, which moves a joint by what
its height does, seen from the camera. Where the joints show one beyond chance, what stands on the ground at
one place leans against what stands at another: the pose is that of neither, and is no surer than that.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import fdtrc

from autoreg.fitting.fit import Fit
from autoreg.numbering import numbered
from autoreg.slabs.quadric import Quadric
from autoreg.solve.joint_data import ROTATION, TRANSLATION
from autoreg.solve.solver import CAUCHY_SIGMAS
from autoreg.spread import spread_about

# A bend that joints in a plane show more often than this by chance is none, nor is one by which the ground
# leans less: of drawn planes the joints' relief imitates one by a hundredth of a degree or two.
BY_CHANCE, LEAST_LEAN = 1e-4, np.radians(0.1)
# Factors of a quadratic function; with fewer degrees of freedom to judge them by there is no bend.
FACTORS, FEWEST_SPARE = 3, 2
# A line tells two numbers: where it lies, and how it runs.
TOLD_BY_LINE = 2
# Rounds of reweighted least squares.
ROUNDS = 6
# What joints tell by less than this share of what they tell best they do not tell.
SINGULAR = 1e-7
# Most of the ground, as a share of the stations: a few far ones are farthest off.
MOST_STATIONS = 0.95


@dataclass(frozen=True)
class Bend:
    """How the ground lies about the plane of a fit, where its joints were measured.

    `spread` is the second moment of the motions (rotation vector, translation, on the camera's side) that lay
    the plane on the ground at one place or another. Most of the ground is no more than `off` above or below
    the plane, in the unit of the pose, and leans against it by the angle `lean` (RMS).
    """

    spread: Float[np.ndarray, "6 6"]
    off: float
    lean: float


def bend_of(fit: Fit) -> Bend | None:
    """The bend of the ground that a fit's joints show; None where they may lie in a plane.

    Nor is there one where the camera is solved for: another camera lays bent ground into a plane, and
    `settle` allows for that.
    """
    rows, free = np.flatnonzero(fit.usable), np.flatnonzero(fit.free.mask)
    stations, pose = fit.stations.take(rows), fit.cam_from_ground
    line, names = numbered(stations.family, stations.line)
    # Those of the covariance, by the lines that are left when the others tell the pose (Hotelling, Ann. Math.
    # Stat. 2, 1931).
    of_lines = len(names) - 1 - len(free) // TOLD_BY_LINE
    spare = of_lines - FACTORS + 1
    if fit.free.focal or spare < FEWEST_SPARE:
        return None
    ground, jacobian = stations.ground, fit.solution.jacobian[rows]
    quadric = Quadric.over(ground)
    # Of height over the plane: the ground moves along up, as the solver's motion beside it would move it.
    rise = (jacobian[:, TRANSLATION] @ pose.R[:, 2])[:, None] * quadric.shapes(ground)
    told, covariance = _laid(np.column_stack([jacobian[:, free], rise]), fit.distances_px[rows], line)
    factors, of_factors = told[len(free) :], covariance[len(free) :, len(free) :]
    squared = float(factors @ np.linalg.pinv(of_factors, SINGULAR, hermitian=True) @ factors)
    if fdtrc(FACTORS, spare, squared * spare / (FACTORS * of_lines)) > BY_CHANCE:
        return None
    motion = np.zeros(jacobian.shape[1])
    motion[free] = told[: len(free)]
    # The solver's motion turns the translation as well; seen from the ground, the plane turns and moves.
    turn = pose.R.T @ motion[ROTATION]
    move = pose.R.T @ (motion[TRANSLATION] + np.cross(motion[ROTATION], pose.t))
    tilt = np.array([-turn[1], turn[0]])
    height = move[2] + ground @ tilt + quadric.shapes(ground) @ factors
    slope = quadric.slope(ground, factors) + tilt
    lean = float(np.sqrt(np.mean((slope**2).sum(1))))
    if lean < LEAST_LEAN:
        return None
    motions = motions_to(ground, height, slope) @ np.kron(np.eye(2), pose.R.T)
    off = float(np.quantile(np.abs(height), MOST_STATIONS))
    return Bend(motions.T @ motions / len(rows), off, lean)


def motions_to(
    ground: Float[np.ndarray, "n 2"], height: Float[np.ndarray, " n"], slope: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 6"]:
    """Turns and moves of the plane, along the ground's axes, that lay it on the ground at each place."""
    level = np.zeros((len(ground), 1))
    turns = np.column_stack([slope[:, 1], -slope[:, 0], level])
    moves = np.cross(np.column_stack([ground, level]), turns)
    moves[:, 2] += height
    return np.column_stack([turns, moves])


def _laid(
    columns: Float[np.ndarray, "n p"], off: Float[np.ndarray, " n"], line: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p p"]]:
    """What lays the joints on their lines, and its covariance, where stations of one line may be off alike.

    By reweighted least squares; the covariance is the jackknife's, from what they are without each line (Bell
    and McCaffrey, Survey Methodology 28, 2002). That of the lines' own sums is too small for a few lines.
    """
    unit = np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    columns = columns / unit
    weight, told, left = np.ones(len(off)), np.zeros(len(unit)), off
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        told = np.linalg.lstsq(columns * root[:, None], -off * root, rcond=SINGULAR)[0]
        left = off + columns @ told
        weight = 1.0 / (1.0 + (left / (CAUCHY_SIGMAS * spread_about(left) + 1e-12)) ** 2)
    weighted, members = columns * weight[:, None], [line == k for k in range(int(line.max()) + 1)]
    pull = np.stack([left[rows] @ weighted[rows] for rows in members])
    normal = np.stack([weighted[rows].T @ columns[rows] for rows in members])
    without = np.linalg.pinv(normal.sum(0) - normal, SINGULAR**2, hermitian=True)
    moved = (without @ pull[:, :, None])[:, :, 0]
    covariance = moved.T @ moved * (1.0 - 1.0 / len(members))
    return told / unit, covariance / np.outer(unit, unit)
