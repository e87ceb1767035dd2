"""The lens models to choose from, simplest first, and the parameters that each leaves free."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from autoreg.camera import Camera

# The order of cv2.projectPoints' derivatives, which is that of every intrinsic vector here.
INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
COUNT = len(INTRINSICS)

Intrinsics = Float[np.ndarray, "12"]


@dataclass(frozen=True)
class LensModel:
    """A distortion model: a name and the coefficients that it has."""

    name: str
    coefficients: tuple[str, ...]

    @property
    def free(self) -> Bool[np.ndarray, "12"]:
        """Which intrinsics the model leaves free: K and its coefficients."""
        return np.array([name in INTRINSICS[:4] + self.coefficients for name in INTRINSICS])

    def restricted(self, intrinsics: Intrinsics) -> Intrinsics:
        """The intrinsics with the coefficients that the model does not have at zero."""
        return np.where(self.free, intrinsics, 0.0)

    @property
    def polynomial(self) -> bool:
        """Whether the radial distortion is a polynomial, not a ratio of two."""
        return "k4" not in self.coefficients

    @property
    def opencv_length(self) -> int:
        """How many coefficients OpenCV's vector needs for it."""
        return 5 if self.polynomial else 8


NONE = LensModel("none", ())
LENS_MODELS = (
    NONE,
    LensModel("k1", ("k1",)),
    LensModel("k1 k2", ("k1", "k2")),
    LensModel("k1 k2 p1 p2", ("k1", "k2", "p1", "p2")),
    LensModel("k1 k2 p1 p2 k3", ("k1", "k2", "p1", "p2", "k3")),
    LensModel("rational", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
)
# What bad views are judged with, before a model is chosen: enough for any common lens, and still stable.
GENERAL = LENS_MODELS[4]


def camera_of(intrinsics: Intrinsics, width: int, height: int) -> Camera:
    """The camera of an intrinsic vector."""
    fx, fy, cx, cy, *dist = (float(value) for value in intrinsics)
    return Camera(width, height, fx, fy, cx, cy, tuple(dist))


def intrinsics_of(camera: Camera) -> Intrinsics:
    """The intrinsic vector of a camera."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.dist])
