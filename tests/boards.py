"""Boards, lenses and views that the calibration tests share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from autoreg.calibration.board import Board, BoardView
from autoreg.calibration.synthetic import bent_points, random_pose
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


def restless_views(camera: Camera, count: int, kind: str, seed: int = 0) -> list[BoardView]:
    """Views of one camera that scatter: the sheet "bent", the lens "focusing", or the "moving sensor"."""
    rng = np.random.default_rng(seed)
    places = bent_points(BOARD, (0.03, 0.01, -0.02)) if kind == "bent" else BOARD.points
    seen = []
    for k, pose in enumerate(poses(camera, count, seed)):
        focal = 1 + 0.01 * rng.standard_normal() * (kind == "focusing")
        dx, dy = 8 * rng.standard_normal(2) * (kind == "moving sensor")
        here = replace(
            camera, fx=camera.fx * focal, fy=camera.fy * focal, cx=camera.cx + dx, cy=camera.cy + dy
        )
        px = here.project(pose.apply(places)) + rng.normal(0, 0.1, (BOARD.corners, 2))
        seen.append(BoardView(str(k), np.arange(BOARD.corners), px))
    return seen
