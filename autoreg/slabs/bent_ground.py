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
# Factors of a quadratic function; joints of fewer lines than this beyond these tell no bend.
FACTORS, SPARE_LINES = 3, 4
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
    spare = len(names) - FACTORS
    if fit.free.focal or spare < SPARE_LINES:
        return None
    ground, jacobian = stations.ground, fit.solution.jacobian[rows]
    quadric = Quadric.over(ground)
    # Of height over the plane: the ground moves along up, as the solver's motion beside it would move it.
    rise = (jacobian[:, TRANSLATION] @ pose.R[:, 2])[:, None] * quadric.shapes(ground)
    told, covariance = _laid(np.column_stack([jacobian[:, free], rise]), fit.distances_px[rows], line)
    factors, of_factors = told[len(free) :], covariance[len(free) :, len(free) :]
    surprise = float(factors @ np.linalg.pinv(of_factors, SINGULAR, hermitian=True) @ factors) / FACTORS
    if fdtrc(FACTORS, spare, surprise) > BY_CHANCE:
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

    By reweighted least squares; the covariance is the sandwich of the lines' sums (Liang and Zeger,
    Biometrika 73, 1986).
    """
    unit = np.maximum(np.linalg.norm(columns, axis=0), 1e-12)
    columns = columns / unit
    weight, told, left = np.ones(len(off)), np.zeros(len(unit)), off
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        told = np.linalg.lstsq(columns * root[:, None], -off * root, rcond=SINGULAR)[0]
        left = off + columns @ told
        weight = 1.0 / (1.0 + (left / (CAUCHY_SIGMAS * spread_about(left) + 1e-12)) ** 2)
    inverse = np.linalg.pinv((columns * weight[:, None]).T @ columns, SINGULAR**2, hermitian=True)
    sums = np.zeros((int(line.max()) + 1, len(unit)))
    np.add.at(sums, line, columns * (weight * left)[:, None])
    covariance = inverse @ (sums.T @ sums) @ inverse * len(sums) / (len(sums) - 1)
    return told / unit, covariance / np.outer(unit, unit)
