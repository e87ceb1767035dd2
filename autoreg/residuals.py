"""The residuals that a pose is judged by: pixel distance of every measured joint to its projected line.

Plain functions on jax; the solver differentiates them.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

# Parameters: rotation vector (rad) and translation of a small motion on the camera's side, logarithm of the
# spacing ratio, logarithm of the focal length, principal point (px), first radial distortion coefficient.
PARAMETERS = 11
ROTATION, TRANSLATION, RATIO, FOCAL, CENTRE, RADIAL = slice(0, 3), slice(3, 6), 6, 7, slice(8, 10), 10


class JointData(NamedTuple):
    """Measured joints, the pose around which small motions are taken, and the camera.

    A padded row has zero weight. `intrinsics` are fx fy cx cy and the eight distortion coefficients.
    """

    ground: Float[Array, "n 2"]
    measured_px: Float[Array, "n 2"]
    normal: Float[Array, "n 2"]
    weight: Float[Array, " n"]
    R: Float[Array, "3 3"]
    t: Float[Array, "3"]
    intrinsics: Float[Array, "12"]
    scale: Float[Array, " p"]


def project(intrinsics: Float[Array, "12"], points_cam: Float[Array, "n 3"]) -> Float[Array, "n 2"]:
    """Pixels of points in front of the camera, by OpenCV's rational and tangential model."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6 = intrinsics
    x, y = points_cam[:, 0] / points_cam[:, 2], points_cam[:, 1] / points_cam[:, 2]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return jnp.stack([fx * xd + cx, fy * yd + cy], -1)


def rotate(vector: Float[Array, "3"], points: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Points turned by a small rotation vector (Rodrigues' formula, smooth at zero)."""
    angle2 = vector @ vector
    # Series of sin(a)/a and (1 - cos a)/a^2: the motions solved for stay below a tenth of a radian.
    s = 1 - angle2 / 6 * (1 - angle2 / 20 * (1 - angle2 / 42))
    c = 0.5 * (1 - angle2 / 12 * (1 - angle2 / 30 * (1 - angle2 / 56)))
    once = jnp.cross(vector, points)
    return points + s * once + c * jnp.cross(vector, once)


def joint_distances(parameters: Float[Array, " p"], data: JointData) -> Float[Array, " n"]:
    """Signed distance in pixels, across the joint, of each projected joint from where it was measured."""
    p = parameters * data.scale
    stretch = jnp.array([jnp.exp(0.5 * p[RATIO]), jnp.exp(-0.5 * p[RATIO])])
    ground = data.ground * stretch
    cam = rotate(p[ROTATION], ground @ data.R[:, :2].T + data.t) + p[TRANSLATION]
    focal = jnp.exp(p[FOCAL])
    intrinsics = data.intrinsics.at[:2].multiply(focal).at[2:4].add(p[CENTRE]).at[4].add(p[RADIAL])
    return ((project(intrinsics, cam) - data.measured_px) * data.normal).sum(-1)


def robust(r: Float[Array, " n"]) -> Float[Array, " n"]:
    """Residuals whose squares are Cauchy's loss log(1 + r^2); the sign is kept, so they stay smooth at 0."""
    square = r * r
    small = square < 1e-8
    safe = jnp.where(small, 1.0, square)
    return r * jnp.where(small, 1.0 - 0.25 * square, jnp.sqrt(jnp.log1p(safe) / safe))


def joint_residuals(parameters: Float[Array, " p"], data: JointData) -> Float[Array, " n"]:
    """Robust weighted distances; `weight` is one over the distance at which a joint is doubted."""
    return robust(joint_distances(parameters, data) * data.weight)
