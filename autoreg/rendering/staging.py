"""A scene on a photo's ground: every object at its place, the sun in its direction, the lens focused."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from autoreg.errors import InputError
from autoreg.lattice import Lattice
from autoreg.layout import slab_at, slab_centre
from autoreg.rendering.depth_of_field import Focus
from autoreg.rendering.layer import assert_colour, linear_from_srgb
from autoreg.rendering.objects import (
    RGB,
    Box,
    Cone,
    Cylinder,
    Light,
    Mesh,
    Object,
    OnGround,
    OnSlab,
    Scene,
    Shape,
    Sphere,
    Text,
    Torus,
)
from autoreg.rendering.sun import Sun, sun_for
from autoreg.rendering.surface import (
    FEW_SEGMENTS,
    SEGMENTS,
    Surface,
    about_z,
    box_surface,
    frustum_surface,
    sphere_surface,
    torus_surface,
)
from autoreg.view import View

# Directions from which the sky's light comes; none lower, where houses and hedges stand.
_SKY_LIGHTS, _LOWEST_SINE = 24, 0.35
# No real surface throws back all light: a colour of 1 is that of white paint.
_WHITEST = 0.85
# Part of the light on the ground that it throws back up: that of usual paving, less a fifth for the shade in
# which objects stand themselves.
_BOUNCE = 0.4
# Part of the light that usual paving throws back: by it the photo's exposure is judged.
_PAVING_ALBEDO = 0.5
# Shapes that look the same however they are turned.
_ROUND = (Sphere, Cylinder, Cone, Torus)


@dataclass(frozen=True)
class Solid:
    """An object in the ground frame; its shape stands on its own Z = 0 around its own origin."""

    source: Object
    foot: Float[np.ndarray, "3"]

    @property
    def turn_rad(self) -> float:
        """Turn about the vertical axis through the foot."""
        return float(np.deg2rad(self.source.turn_deg))

    @cached_property
    def own_surface(self) -> Surface:
        """Its triangles in the shape's own frame."""
        return surface_of(self.source.shape)

    @cached_property
    def pictured_surface(self) -> Surface:
        """The same for a renderer that repeats the material's picture beyond its edges."""
        image = self.source.material.image
        picture = cv2.imread(str(image), cv2.IMREAD_COLOR) if image is not None and image.is_file() else None
        return self.own_surface if picture is None else self.own_surface.inset(*picture.shape[1::-1])

    @cached_property
    def surface(self) -> Surface:
        """Its triangles in the ground frame."""
        return self.own_surface.moved(self.turn_rad, self.foot)

    @cached_property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """Points all over it in the ground frame, the outermost ones along every axis among them."""
        # Without a render nothing else of the surface is needed. What is round may stay unturned.
        if isinstance(self.source.shape, _ROUND):
            return surface_of(self.source.shape, FEW_SEGMENTS).corners.reshape(-1, 3) + self.foot
        return (self.own_surface.corners @ about_z(self.turn_rad).T + self.foot).reshape(-1, 3)

    @cached_property
    def corners(self) -> Float[np.ndarray, "8 3"]:
        """Corners of the box around it, in the ground frame."""
        low, high = self.points.min(0), self.points.max(0)
        pick = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), -1).reshape(8, 3)
        return np.where(pick == 0, low, high)


@dataclass(frozen=True)
class Lamps:
    """The light on the scene, as far lamps: the sun, and the sky in pieces.

    A surface with normal n shows colour * whitest * exposure * (sun max(0, n.to_sun)
    + sum of sky max(0, n.to_sky) + bounce (1 - n_z) / 2); sun and sky together give 1 on level open ground,
    which throws `bounce` of that back up evenly.
    """

    to_sun: Float[np.ndarray, "3"]
    sun: float
    to_sky: Float[np.ndarray, "k 3"]
    sky: float
    exposure: float
    bounce: float = _BOUNCE
    whitest: float = _WHITEST

    @property
    def on_ground(self) -> tuple[float, float]:
        """What the sun and what the whole sky give on level ground; together 1."""
        return self.sun * float(self.to_sun[2]), self.sky * float(self.to_sky[:, 2].sum())


@dataclass(frozen=True)
class Staging:
    """What is drawn."""

    solids: tuple[Solid, ...]
    sun: Sun
    lamps: Lamps
    joints: bool = False
    joint_colour: RGB = (1.0, 0.7, 0.0)
    focus: Focus | None = None


def surface_of(shape: Shape, segments: int = SEGMENTS) -> Surface:
    """The triangles of a shape, standing on Z = 0 around the origin; a full circle has so many pieces."""
    match shape:
        case Box(size):
            return box_surface(size)
        case Sphere(radius):
            return sphere_surface(radius, segments)
        case Cylinder(radius, height):
            return frustum_surface(radius, radius, height, segments)
        case Cone(radius, height, top):
            return frustum_surface(radius, top, height, segments)
        case Torus(radius, tube):
            return torus_surface(radius, tube, segments)
        case Text(text, height, depth, font):
            # Only scenes with letters need what reads fonts.
            from autoreg.rendering.letters import text_surface

            return text_surface(text, height, depth, font)
        case Mesh(surface):
            return surface


def stage(
    scene: Scene, view: View, lattice: Lattice, photo: UInt8[np.ndarray, "h w 3"] | None = None
) -> Staging:
    """The scene on this photo's ground.

    Args:
        scene: what to show.
        view: the fitted camera.
        lattice: the fitted lattice.
        photo: the photo (BGR), by which the exposure is judged if the scene does not give it.

    Raises:
        InputError: an object would stand behind the camera, out of the picture, or nowhere; or a shadow
            that is to show the sun does not.
        ValueError: the photo is not in colour.
    """
    if photo is not None:
        assert_colour(photo)
    solids = tuple(Solid(thing, _foot(thing, view, lattice)) for thing in scene.objects)
    for solid in solids:
        _assert_seen(solid, view, lattice)
    exposure = scene.light.exposure
    if exposure is None:
        exposure = 1.0 if photo is None else judged_exposure(photo, view, lattice)
    sun = sun_for(scene.light, view)
    lamps = lamps_for(scene.light, sun, exposure)
    return Staging(solids, sun, lamps, scene.joints, scene.joint_colour)


def can_be_staged(thing: Object, view: View, lattice: Lattice) -> bool:
    """Whether an object would stand where some of it is in the picture."""
    try:
        _assert_seen(Solid(thing, _foot(thing, view, lattice)), view, lattice)
    except InputError:
        return False
    return True


def focused(staging: Staging, focus: Focus | None) -> Staging:
    """The same through a lens with an opening; None is a pinhole."""
    return replace(staging, focus=focus)


def lamps_for(light: Light, sun: Sun, exposure: float) -> Lamps:
    """The lamps of a light."""
    to_sun = sun.direction
    # Even heights on a golden-angle spiral: every lamp stands for the same piece of sky.
    n = np.arange(_SKY_LIGHTS)
    sine = _LOWEST_SINE + (1 - _LOWEST_SINE) * (n + 0.5) / _SKY_LIGHTS
    turn = n * np.pi * (3 - np.sqrt(5))
    level = np.sqrt(1 - sine**2)
    to_sky = np.stack([level * np.cos(turn), level * np.sin(turn), sine], -1)
    return Lamps(to_sun, (1 - light.sky) / float(to_sun[2]), to_sky, light.sky / sine.sum(), exposure)


def judged_exposure(photo: UInt8[np.ndarray, "h w 3"], view: View, lattice: Lattice) -> float:
    """What a white sheet on this ground would show as, if the paving throws back half of the light.

    The brighter quarter of the paving stands for its sunlit part. A guess within the limits of what is
    usual: the paving's own albedo cannot be told from a photo.
    """
    low, high = lattice.extent.min(0), lattice.extent.max(0)
    grid = np.stack(np.meshgrid(*(np.linspace(low[k], high[k], 60) for k in (0, 1))), -1).reshape(-1, 2)
    px = view.project(grid)
    px = np.round(px[np.isfinite(px).all(1)]).astype(int)
    inside = ((px >= 0) & (px < [view.camera.width, view.camera.height])).all(1)
    if inside.sum() < 20:
        return 1.0
    u, v = px[inside].T
    # Weights of BGR in luminance (ITU-R BT.709).
    luminance = linear_from_srgb(photo[v, u]) @ [0.0722, 0.7152, 0.2126]
    return float(np.clip(np.quantile(luminance, 0.75) / _PAVING_ALBEDO, 0.2, 1.2))


def _foot(thing: Object, view: View, lattice: Lattice) -> Float[np.ndarray, "3"]:
    place = thing.place
    if isinstance(place, OnSlab):
        ground = slab_centre(lattice, place.i, place.j) + np.array(place.offset_m)
    elif isinstance(place, OnGround):
        ground = np.array([place.x_m, place.y_m])
    else:
        c = view.camera
        px = np.array([place.u_px, place.v_px])
        if not (-0.5 <= px[0] <= c.width - 0.5 and -0.5 <= px[1] <= c.height - 0.5):
            raise InputError(
                f"{thing.name}: pixel ({place.u_px:g}, {place.v_px:g}) lies outside the photo of "
                f"{c.width} x {c.height} pixels"
            )
        ground = view.ground_under(px)
        if not np.isfinite(ground).all():
            raise InputError(
                f"{thing.name}: no ground lies under pixel ({place.u_px:g}, {place.v_px:g}), which is at or "
                "above the horizon; choose a pixel on the paving"
            )
    return np.array([*ground, thing.lift_m], float)


def _assert_seen(solid: Solid, view: View, lattice: Lattice) -> None:
    """Raise unless some of the solid can be in the picture.

    Raises:
        InputError: none of it can.
    """
    name, c = solid.source.name, view.camera
    depth = view.cam_from_ground.apply(solid.corners)[:, 2]
    place = solid.source.place
    where = (
        f"slab ({place.i}, {place.j})"
        if isinstance(place, OnSlab)
        else f"ground point ({solid.foot[0]:.3g}, {solid.foot[1]:.3g})"
    )
    if depth.max() <= 0:
        raise InputError(f"{name}: {where} is behind the camera; {visible_slabs(view, lattice)}")
    if (
        depth.min() <= 0
        and (solid.corners.min(0) < view.eye).all()
        and (view.eye < solid.corners.max(0)).all()
    ):
        raise InputError(f"{name}: the camera stands inside it; make it smaller or move it away")
    px = view.project(solid.points[:: max(1, len(solid.points) // 20_000)])
    seen = ((px > -0.5) & (px < [c.width - 0.5, c.height - 0.5])).all(1)
    # Large triangles may cross the picture with all of their corners outside.
    if not seen.any() and np.isfinite(px).all():
        low, high = px.min(0), px.max(0)
        seen = np.array([low[0] < c.width and low[1] < c.height and high[0] > -1 and high[1] > -1])
    if not seen.any() and depth.min() > 0:
        raise InputError(f"{name}: {where} lies outside the picture; {visible_slabs(view, lattice)}")


def visible_slabs(view: View, lattice: Lattice) -> str:
    """A sentence that says which slabs the picture shows."""
    c = view.camera
    _, ground = view.looked_over(24)
    low, high = lattice.extent.min(0), lattice.extent.max(0)
    with np.errstate(invalid="ignore"):
        inside = ((ground >= low) & (ground <= high)).all(1)
    slabs = np.array([slab_at(lattice, point) for point in ground[inside]])
    if not len(slabs):
        return "no slab is in the picture"
    (i0, j0), (i1, j1) = slabs.min(0), slabs.max(0)
    middle = view.ground_under(np.array([0.5 * c.width, 0.7 * c.height]))
    near = (
        f", and ({', '.join(map(str, slab_at(lattice, middle)))}) is in its middle"
        if (np.isfinite(middle).all())
        else ""
    )
    return f"the picture shows slabs with i from {i0} to {i1} and j from {j0} to {j1}{near}"
