"""Floors of boards in a running bond, with a grain that runs along them, as photographed."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from autoreg.camera import Camera
from autoreg.geometry import Rigid

CAMERA = Camera.from_focal(1200, 800, 960.0)
LENGTH_M, WIDTH_M = 1.5, 0.14
PX_PER_M, SIZE_M = 250, 8.0


def boards(streak_grey: float, seed: int = 6) -> Float32[np.ndarray, "n n"]:
    """A plan of boards whose grain has streaks of so many grey levels (standard deviation)."""
    rng, size = np.random.default_rng(seed), round(SIZE_M * PX_PER_M)
    width, length = round(WIDTH_M * PX_PER_M), round(LENGTH_M * PX_PER_M)
    plan = np.empty((size, size), np.float32)
    for course, y in enumerate(range(0, size, width)):
        for x in range(-(course % 2) * length // 2, size, length):
            board = plan[y : y + width, max(x, 0) : x + length]
            streaks = cv2.GaussianBlur(rng.normal(size=(width, 1)).astype(np.float32), (0, 0), 0.8)
            board[:] = 150.0 + rng.normal(0.0, 4.0) + streak_grey * streaks[: len(board)] / streaks.std()
            board[:, :2] -= 40.0
        plan[y : y + 2] = 110.0
    return plan + rng.normal(0.0, 2.0, plan.shape).astype(np.float32)


def photographed(plan: Float32[np.ndarray, "n n"], pose: Rigid) -> UInt8[np.ndarray, "h w"]:
    """What `CAMERA` sees of a plan from above the ground, wherever it looks."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = CAMERA.unproject(np.stack([u, v], -1).reshape(-1, 2).astype(float)) @ pose.R
    eye = pose.origin_in_a
    ground = eye[:2] - rays[:, :2] * (eye[2] / rays[:, 2:])
    at = ((ground + 0.5 * SIZE_M) * PX_PER_M).astype(np.float32).reshape(CAMERA.height, CAMERA.width, 2)
    soft = cv2.GaussianBlur(plan, (0, 0), 1.0)
    seen = cv2.GaussianBlur(
        cv2.remap(soft, at, None, cv2.INTER_AREA, borderMode=cv2.BORDER_WRAP), (0, 0), 0.6
    )
    noise = np.random.default_rng(1).normal(0.0, 1.5, seen.shape)
    return np.clip(np.rint(seen + noise), 0, 255).astype(np.uint8)
