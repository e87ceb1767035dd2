"""The residuals that a pose is judged by: pixel distance of every measured joint to its projected line.

Plain functions on jax; the solver differentiates them.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from autoreg.solve.joint_data import (
    ASPECT,
    CENTRE,
    FOCAL,
    RADIAL,
    RATIO,
    ROTATION,
    SECOND_RADIAL,
    TANGENTIAL,
    TRANSLATION,
    JointData,
)

Numbers = Array | np.ndarray


class Projection(NamedTuple):
    """The few numbers through which every parameter acts on every joint.

    `cam_from_plane` takes (X, Y, 1) of a ground point to the camera's frame.
    """

    cam_from_plane: Float[Array, "3 3"]
    intrinsics: Float[Array, "12"]


def project(intrinsics: Float[Array, "12"], points_cam: Float[Array, "*n 3"]) -> Float[Array, "*n 2"]:
    """Pixels of points in front of the camera, by OpenCV's rational and tangential model."""
    return jnp.stack(pixel(intrinsics, points_cam[..., 0], points_cam[..., 1], points_cam[..., 2]), -1)


def pixel(
    intrinsics: Float[Array, "12"], X: Float[Array, "*n"], Y: Float[Array, "*n"], Z: Float[Array, "*n"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """The same with each coordinate as an array of its own, which is quicker where there are many points."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6 = intrinsics
    x, y = X / Z, Y / Z
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return fx * xd + cx, fy * yd + cy


def small_rotation(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Rotation matrix of a small rotation vector (Rodrigues' formula, smooth at zero)."""
    angle2 = vector @ vector
    # Series of sin(a)/a and (1 - cos a)/a^2: the motions solved for stay below a tenth of a radian.
    s = 1 - angle2 / 6 * (1 - angle2 / 20 * (1 - angle2 / 42))
    c = 0.5 * (1 - angle2 / 12 * (1 - angle2 / 30 * (1 - angle2 / 56)))
    x, y, z = vector
    skew = jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return jnp.eye(3) + s * skew + c * skew @ skew


def moved_projection(parameters: Float[Array, " p"], data: JointData) -> Projection:
    """The projection after the small motion and the small change of the camera that the parameters mean."""
    p = parameters * data.scale
    turn = small_rotation(p[ROTATION])
    stretch = jnp.exp(p[RATIO] * jnp.array([0.5, -0.5]))
    position = turn @ data.t + p[TRANSLATION]
    cam_from_plane = jnp.concatenate([turn @ data.R[:, :2] * stretch, position[:, None]], 1)
    k = data.intrinsics
    longer = jnp.exp(p[FOCAL] + p[ASPECT] * jnp.array([0.0, 1.0]))
    radial = k[4:6] + jnp.stack([p[RADIAL], p[SECOND_RADIAL]])
    change = [k[:2] * longer, k[2:4] + p[CENTRE], radial, k[6:8] + p[TANGENTIAL], k[8:]]
    return Projection(cam_from_plane, jnp.concatenate(change))


def joint_distance(
    projection: Projection,
    ground: Float[Numbers, "2"],
    measured_px: Float[Numbers, "2"],
    normal: Float[Numbers, "2"],
) -> Float[Array, ""]:
    """Signed distance in pixels, across one joint, of where it is projected from where it was measured."""
    A = projection.cam_from_plane
    point_cam = A[:, 0] * ground[0] + A[:, 1] * ground[1] + A[:, 2]
    return (project(projection.intrinsics, point_cam) - measured_px) @ normal


def distances_and_jacobian(
    parameters: Float[Array, " p"], data: JointData
) -> tuple[Float[Array, " n"], Float[Array, "n p"]]:
    """The joints' distances and their derivatives by the parameters.

    By the chain rule through the projection's few numbers: backwards from each joint to them, forwards to
    them from the parameters. Either way alone takes two to three times as long.
    """
    every = jax.vmap(jax.value_and_grad(joint_distance), in_axes=(None, 0, 0, 0))
    inner, projection = jax.jacfwd(_moved_twice, has_aux=True)(parameters, data)
    distances, outer = every(projection, data.ground, data.measured_px, data.normal)
    jacobian = jnp.einsum("nij,ijp->np", outer.cam_from_plane, inner.cam_from_plane)
    return distances, jacobian + outer.intrinsics @ inner.intrinsics


def _moved_twice(parameters: Float[Array, " p"], data: JointData) -> tuple[Projection, Projection]:
    projection = moved_projection(parameters, data)
    return projection, projection


def robust(r: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Residuals whose squares are Cauchy's loss log(1 + r^2), and their derivatives by r.

    The sign is kept, so they stay smooth at 0.
    """
    square = r * r
    small = square < 1e-8
    safe = jnp.where(small, 1.0, square)
    share = jnp.where(small, 1.0 - 0.25 * square, jnp.sqrt(jnp.log1p(safe) / safe))
    return r * share, 1.0 / ((1.0 + square) * share)


def robust_curvature(r: Float[Array, " n"]) -> Float[Array, " n"]:
    """Second derivative of half of Cauchy's loss; negative where |r| > 1."""
    square = r * r
    return (1 - square) / (1 + square) ** 2
