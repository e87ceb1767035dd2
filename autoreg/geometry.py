"""Rigid motions. A transform is named `b_from_a`: x_b = R x_a + t."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


def cross_matrix(v: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """The matrix whose product with a vector is the cross product of v with it."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_from_vector(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Rotation matrix of a rotation vector in radians (Rodrigues' formula)."""
    angle = float(np.linalg.norm(vector))
    skew = cross_matrix(vector)
    # sin(a)/a and (1 - cos a)/a^2 by numpy's sinc, which is exact at zero.
    return np.eye(3) + np.sinc(angle / np.pi) * skew + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * skew @ skew


def vector_from_rotation(R: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3"]:
    """Rotation vector in radians, of length at most pi."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(R).as_rotvec()


def angle_between_rotations(Ra: Float[np.ndarray, "3 3"], Rb: Float[np.ndarray, "3 3"]) -> float:
    """Angle in radians of the rotation that takes one orientation to the other."""
    # The arctangent of the skew part keeps precision at small angles, where an arccosine loses it.
    D = Ra @ Rb.T
    sine = 0.5 * float(np.linalg.norm([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]]))
    return float(np.arctan2(sine, 0.5 * (np.trace(D) - 1.0)))


def nearest_rotation(M: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Rotation nearest to a matrix in the Frobenius norm (orthogonal Procrustes)."""
    U, _, Vt = np.linalg.svd(M)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt


@dataclass(frozen=True)
class Rigid:
    """A rigid motion `b_from_a`: x_b = R x_a + t."""

    R: Float[np.ndarray, "3 3"]
    t: Float[np.ndarray, "3"]

    def apply(self, points: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Points of frame a, in frame b."""
        return points @ self.R.T + self.t

    def __matmul__(self, other: Rigid) -> Rigid:
        """`c_from_b @ b_from_a` is `c_from_a`."""
        return Rigid(self.R @ other.R, self.R @ other.t + self.t)

    @property
    def inverse(self) -> Rigid:
        """`a_from_b`."""
        return Rigid(self.R.T, -self.R.T @ self.t)

    @property
    def origin_in_a(self) -> Float[np.ndarray, "3"]:
        """Origin of frame b in frame a: for `cam_from_ground` the camera's place above the ground."""
        return -self.R.T @ self.t
