"""What is put into the photo: solids that stand on a slab, and the light on them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from autoreg.lattice import Lattice
from autoreg.layout import slab_at, slab_centre, slab_side_x, was_seen
from autoreg.view import View

RGB = tuple[float, float, float]


@dataclass(frozen=True)
class Box:
    """A box with its sides along the joints; colours are linear, 0 to 1."""

    centre: Float[np.ndarray, "3"]
    size: Float[np.ndarray, "3"]
    colour: RGB


@dataclass(frozen=True)
class Ball:
    """A sphere."""

    centre: Float[np.ndarray, "3"]
    radius: float
    colour: RGB


Solid = Box | Ball


@dataclass(frozen=True)
class Light:
    """A far sun, and light from everywhere: surfaces show colour * (ambient + diffuse * cosine)."""

    to_sun: Float[np.ndarray, "3"]
    ambient: float = 0.35
    diffuse: float = 0.65


@dataclass(frozen=True)
class Staging:
    """Solids in the frame of one slab: origin at the slab's centre on the ground, Z up."""

    slab: tuple[int, int]
    solids: tuple[Solid, ...]
    light: Light

    def solids_on(self, lattice: Lattice) -> tuple[Solid, ...]:
        """The solids in the ground frame."""
        foot = np.append(slab_centre(lattice, *self.slab), 0.0)
        return tuple(
            Box(s.centre + foot, s.size, s.colour)
            if isinstance(s, Box)
            else Ball(s.centre + foot, s.radius, s.colour)
            for s in self.solids
        )


def corners(solid: Solid) -> Float[np.ndarray, "8 3"]:
    """Corners of the box around a solid."""
    half = 0.5 * solid.size if isinstance(solid, Box) else np.full(3, solid.radius)
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(8, 3)
    return solid.centre + signs * half


def shadow_corners(solid: Solid, light: Light) -> Float[np.ndarray, "8 3"]:
    """Ground points whose hull holds the solid's shadow on the ground."""
    points = corners(solid)
    return points - points[:, 2:] / light.to_sun[2] * light.to_sun


def demo_staging(view: View, lattice: Lattice) -> Staging:
    """A block with a ball on it near the middle of the picture, lit from behind the camera's left shoulder.

    The block is as long as a whole number of slabs, or that part of one, that makes it about a seventh
    of the picture high.
    """
    # A little below the middle, where the ground is; slab (0, 0) if no paving was seen there.
    wish = view.ground_under(np.array([0.5 * view.camera.width, 0.65 * view.camera.height]))
    slab = slab_at(lattice, wish) if np.isfinite(wish).all() and was_seen(lattice, wish) else (0, 0)
    short = min(slab_side_x(lattice), lattice.spacing_y)
    depth = view.cam_from_ground.apply(np.append(slab_centre(lattice, *slab), 0.0))[2]
    wanted = view.camera.height / 7 * max(float(depth), 0.1 * abs(view.eye[2])) / view.camera.fy
    side = short * round(wanted / short) if wanted > short else short / round(short / wanted)
    solids = (
        Box(np.array([0.0, 0.0, 0.5 * side]), np.full(3, side), (0.75, 0.09, 0.05)),
        Ball(np.array([0.0, 0.0, 1.35 * side]), 0.35 * side, (0.05, 0.22, 0.62)),
    )
    # The camera looks along its z axis; the sun stands 135 degrees to the left of that, 40 degrees high.
    heading = np.arctan2(view.cam_from_ground.R[2, 1], view.cam_from_ground.R[2, 0]) + np.deg2rad(135)
    high = np.deg2rad(40)
    to_sun = np.array([np.cos(high) * np.cos(heading), np.cos(high) * np.sin(heading), np.sin(high)])
    return Staging(slab, solids, Light(to_sun))
