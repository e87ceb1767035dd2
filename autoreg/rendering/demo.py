"""The objects that show a first user that it works."""

from __future__ import annotations

import numpy as np

from autoreg.lattice import Lattice
from autoreg.layout import slab_at, slab_centre, slab_side_x, was_seen
from autoreg.rendering.objects import Box, Cone, Material, Object, OnSlab, Sphere, colour
from autoreg.view import View

# So many places along either side of the picture are looked at for paving.
PLACES = 24


def demo_objects(view: View, lattice: Lattice) -> tuple[Object, ...]:
    """A block with a ball on it near the middle of the picture, and a small cone beside it.

    The block is as long as a whole number of slabs, or that part of one, that makes it about a seventh
    of the picture high.
    """
    i, j = _slab_near_the_middle(view, lattice)
    short = min(slab_side_x(lattice), lattice.spacing_y)
    depth = view.cam_from_ground.apply(np.append(slab_centre(lattice, i, j), 0.0))[2]
    wanted = view.camera.height / 7 * max(float(depth), 0.1 * abs(view.eye[2])) / view.camera.fy
    side = short * round(wanted / short) if wanted > short else short / round(short / wanted)
    ball = 0.36 * side
    # Beside the block on the picture's right, where a default sun throws the shadow behind it.
    right = view.cam_from_ground.R[0, :2] / np.linalg.norm(view.cam_from_ground.R[0, :2])
    beside = tuple(float(v) for v in 1.15 * side * right)
    place = OnSlab(i, j)
    return (
        Object("block", Box((side, side, side)), place, Material(colour("#c8502d"))),
        Object("ball", Sphere(ball), place, Material(colour("#f2f0ea"), finish="Glossy"), lift_m=side),
        Object(
            "cone",
            Cone(0.3 * side, 0.8 * side),
            OnSlab(i, j, (beside[0], beside[1])),
            Material(colour("#2f6f9f")),
        ),
    )


def _slab_near_the_middle(view: View, lattice: Lattice) -> tuple[int, int]:
    """The slab a little below the picture's middle, where the ground is, or the paving that is nearest to it.

    Slab (0, 0) if no paving is in the picture.
    """
    middle = np.array([0.5 * view.camera.width, 0.65 * view.camera.height])
    px, ground = view.looked_over(PLACES)
    nearest = np.argsort(np.linalg.norm(px - middle, axis=1), kind="stable")
    for point in (view.ground_under(middle), *ground[nearest]):
        if np.isfinite(point).all() and was_seen(lattice, point):
            return slab_at(lattice, point)
    return 0, 0
