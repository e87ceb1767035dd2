"""Equivalent frames of one ground: the origin moved along it, the axes turned by quarters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from autoreg.geometry import Rigid


def quarter_turns(count: int) -> Float[np.ndarray, "3 3"]:
    """Old ground axes from axes turned by `count` quarters: after one, the new X is the old Y."""
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[count % 4]
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=float)


def turned(cam_from_ground: Rigid, count: int = 1) -> Rigid:
    """The pose for ground axes turned by `count` quarters about the origin."""
    return replace(cam_from_ground, R=cam_from_ground.R @ quarter_turns(count))


def with_origin(cam_from_ground: Rigid, x: float, y: float) -> Rigid:
    """The pose with the ground's origin moved to (x, y)."""
    R, t = cam_from_ground.R, cam_from_ground.t
    return replace(cam_from_ground, t=t + R[:, 0] * x + R[:, 1] * y)
