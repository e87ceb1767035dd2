"""Measured joints made by hand, and a solve of them."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from handmade import looking

from autoreg.camera import Camera
from autoreg.geometry import rotation_from_vector
from autoreg.solve.freedom import Free
from autoreg.solve.joint_data import JointData, parameter_scale
from autoreg.solve.solver import CAUCHY_SIGMAS, solve_joints

CAMERA = Camera(1600, 1200, 1300.0, 1290.0, 810.0, 590.0, (-0.12, 0.04, 0.0005, -0.0004))
TRUTH = looking([-0.4, -3.0, 1.6], [0.1, 0.6, 0.0], 0.04)
POSE = Free().mask
SIGMA_PX = 0.1


@dataclass(frozen=True)
class Start:
    """How far from the truth a solve begins."""

    turn_rad: float = 0.01
    shift: float = 0.03


def problem(
    seed: int = 0,
    n: int = 300,
    noise_px: float = 0.0,
    outliers: float = 0.0,
    start: Start = Start(),
    sigma_px: float = SIGMA_PX,
) -> JointData:
    """Joints seen by the true camera, with noise, and a pose beside the true one."""
    rng = np.random.default_rng(seed)
    along_x = np.arange(n) % 2 == 0
    ground = rng.uniform([-1.5, -1.0], [1.5, 4.0], (n, 2))
    points = np.column_stack([ground, np.zeros(n)])
    direction = np.where(along_x[:, None], [1e-4, 0.0, 0.0], [0.0, 1e-4, 0.0])
    seen = CAMERA.project(TRUTH.apply(points))
    tangent = CAMERA.project(TRUTH.apply(points + direction)) - seen
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    across = noise_px * rng.normal(size=n)
    wild = rng.random(n) < outliers
    across = np.where(wild, rng.uniform(-8, 8, n), across)
    # Along the joint nothing is known, so the measured point may lie anywhere there.
    measured = seen + across[:, None] * normal + rng.normal(0, 3, (n, 1)) * tangent
    turn = rotation_from_vector(start.turn_rad * rng.normal(size=3))
    return JointData(
        ground=ground,
        measured_px=measured,
        normal=normal,
        weight=np.full(n, 1 / (CAUCHY_SIGMAS * sigma_px)),
        R=turn @ TRUTH.R,
        t=turn @ TRUTH.t + start.shift * rng.normal(size=3),
        intrinsics=np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, *CAMERA.dist]),
        scale=parameter_scale(1.6, CAMERA.fx),
    )


def solved() -> str:
    """Every bit of a solve's answer, in short."""
    solution = solve_joints(problem(13, noise_px=SIGMA_PX), POSE)
    answer = solution.parameters, solution.distances_px, solution.jacobian
    return hashlib.sha256(b"".join(part.tobytes() for part in answer)).hexdigest()
