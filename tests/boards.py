"""Boards, lenses and views that the calibration tests share."""

from __future__ import annotations

import numpy as np

from autoreg.calibration.board import Board, BoardView
from autoreg.calibration.synthetic import random_pose
from autoreg.camera import Camera
from autoreg.geometry import Rigid

BOARD = Board(9, 6, 0.025, True)
CAMERA = Camera(1280, 960, 1000.0, 1003.0, 655.0, 468.0, (-0.2, 0.05, 0.0005, -0.0003, 0.0))
SMALL = Camera(640, 480, 520.0, 520.5, 325.0, 236.0, (-0.2, 0.05, 0.0005, -0.0003, 0.0))


def poses(camera: Camera, count: int, seed: int = 0, board: Board = BOARD, **options: float) -> list[Rigid]:
    rng = np.random.default_rng(seed)
    return [random_pose(camera, board, rng, **options) for _ in range(count)]


def views(
    camera: Camera,
    count: int,
    *,
    noise_px: float = 0.1,
    seed: int = 0,
    board: Board = BOARD,
    **options: float,
) -> list[BoardView]:
    """Views whose corners are exact but for Gaussian noise."""
    rng = np.random.default_rng([seed, 1])
    ids = np.arange(board.corners)
    return [
        BoardView(
            f"view{k}.jpg", ids, exact(camera, pose, board) + rng.normal(0, noise_px, (board.corners, 2))
        )
        for k, pose in enumerate(poses(camera, count, seed, board, **options))
    ]


def exact(camera: Camera, pose: Rigid, board: Board = BOARD) -> np.ndarray:
    return camera.project(pose.apply(board.points))
