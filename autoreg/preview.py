"""Rendering without POV-Ray: a small ray caster that looks through the photo's own lens."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from autoreg.lattice import Lattice
from autoreg.layer import Layer
from autoreg.staging import Box, Light, Solid, Staging
from autoreg.view import View, Window, window_around

# Rays per pixel side where something begins or ends; one ray does elsewhere.
_SUBPIXELS = 5
# Rays cast at a time: bounds the memory, whatever the photo's size.
_BATCH = 1 << 18


class PreviewEngine:
    """Boxes, balls and their hard shadows, shaded as POV-Ray shades the scene.

    Rays are bent by the lens before they are cast, so nothing is warped or resampled.
    """

    name = "preview"

    def draw(self, view: View, lattice: Lattice, staging: Staging, window: Window) -> Layer:
        """The solids and their shadows on the ground, in a window of the photo."""
        solids = staging.solids_on(lattice)
        light = np.zeros((window.height, window.width, 3))
        transmission = np.ones((window.height, window.width))
        what = np.zeros((window.height, window.width), np.int16)
        rows = max(1, _BATCH // max(window.width, 1))
        for top in range(0, window.height, rows):
            band = Window(window.x, window.y + top, window.width, min(rows, window.height - top))
            part = slice(top, top + band.height)
            light[part], transmission[part], what[part] = _cast(view, band.pixels(), solids, staging.light)
        if not what.size:
            return Layer(window, light, transmission)

        kernel = np.ones((3, 3), np.uint8)
        at = np.argwhere(cv2.dilate(what, kernel) != cv2.erode(what, kernel))
        step = (np.arange(_SUBPIXELS) + 0.5) / _SUBPIXELS - 0.5
        offsets = np.stack(np.meshgrid(step, step), -1).reshape(1, -1, 2)
        for chunk in np.array_split(at, len(at) * _SUBPIXELS**2 // _BATCH + 1):
            centres = chunk[:, ::-1] + [window.x, window.y]
            found = _cast(view, centres[:, None] + offsets, solids, staging.light)
            light[chunk[:, 0], chunk[:, 1]] = found[0].mean(1)
            transmission[chunk[:, 0], chunk[:, 1]] = found[1].mean(1)
        return Layer(window, light, transmission)

    def draw_marks(self, view: View, marks_ground: Float[np.ndarray, "n 4 2"]) -> Float[np.ndarray, "h w"]:
        """Coverage, 0 to 1, of each pixel of the photo by flat convex marks on the ground."""
        coverage = np.zeros((view.camera.height, view.camera.width))
        step = (np.arange(16) + 0.5) / 16
        across, down = np.meshgrid(step, step)
        # Within one pixel the ground is as good as linear, so rays are cast through pixel corners only.
        left, up = 1 - across, 1 - down
        weights = np.stack([left * up, across * up, left * down, across * down])
        for mark in marks_ground:
            px = view.project(mark)
            if not np.isfinite(px).all():
                continue
            window = window_around(px, 2).within(view.camera.width, view.camera.height)
            grid = Window(window.x, window.y, window.width + 1, window.height + 1).pixels() - 0.5
            g = view.ground_under(grid)
            corners = np.stack([g[:-1, :-1], g[:-1, 1:], g[1:, :-1], g[1:, 1:]], -1)
            ground = np.moveaxis(corners @ weights.reshape(4, -1), -1, -2)
            part = coverage[window.y : window.y + window.height, window.x : window.x + window.width]
            part[:] = np.maximum(part, _inside(mark, ground).mean(-1))
        return coverage


def _inside(mark: Float[np.ndarray, "4 2"], points: Float[np.ndarray, "*n 2"]) -> Bool[np.ndarray, "*n"]:
    """Whether points lie in a convex quadrilateral, whichever way round its corners go."""
    side = np.roll(mark, -1, axis=0) - mark
    away = points[..., None, :] - mark
    turn = side[:, 0] * away[..., 1] - side[:, 1] * away[..., 0]
    return np.all(turn > 0, axis=-1) | np.all(turn < 0, axis=-1)


def _cast(
    view: View, px: Float[np.ndarray, "*n 2"], solids: tuple[Solid, ...], light: Light
) -> tuple[Float[np.ndarray, "*n 3"], Float[np.ndarray, "*n"], Int[np.ndarray, "*n"]]:
    """Light, transmission, and a number for what each ray meets first (a face, shadow or bare ground)."""
    rays = view.directions(px).reshape(-1, 3)
    eye = np.broadcast_to(view.eye, rays.shape)
    reach, normal, colour, what = _first_hit(eye, rays, solids)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_ground = -view.eye[2] / rays[:, 2]
    on_ground = (to_ground > 0) & ~(reach < to_ground)
    on_solid = np.isfinite(reach) & ~on_ground

    shown = np.zeros_like(rays)
    at = eye[on_solid] + reach[on_solid, None] * rays[on_solid]
    cosine = np.clip(normal[on_solid] @ light.to_sun, 0.0, None)
    # Starting a hair off the surface keeps it from shading itself.
    lit = ~_blocked(
        at + 1e-6 * np.linalg.norm(at - view.eye, axis=1)[:, None] * normal[on_solid], solids, light
    )
    shown[on_solid] = colour[on_solid] * (light.ambient + light.diffuse * cosine * lit)[:, None]

    transmission = np.where(on_solid, 0.0, 1.0)
    ground = eye[on_ground] + to_ground[on_ground, None] * rays[on_ground]
    shaded = _blocked(ground, solids, light)
    sun = light.diffuse * light.to_sun[2]
    transmission[on_ground] = np.where(shaded, light.ambient / (light.ambient + sun), 1.0)
    what = np.where(on_solid, what, 0)
    what[on_ground] = -1 - shaded.astype(np.int64)
    what[on_solid] += 1000 * lit
    shape = px.shape[:-1]
    return shown.reshape(*shape, 3), transmission.reshape(shape), what.reshape(shape)


def _first_hit(
    origin: Float[np.ndarray, "n 3"], rays: Float[np.ndarray, "n 3"], solids: tuple[Solid, ...]
) -> tuple[
    Float[np.ndarray, " n"], Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]
]:
    """Distance (infinite if none), outward normal, colour and face number of what each ray meets first."""
    reach = np.full(len(rays), np.inf)
    normal, colour = np.zeros_like(rays), np.zeros_like(rays)
    what = np.zeros(len(rays), np.int64)
    for number, solid in enumerate(solids):
        t, n, face = _hit(origin, rays, solid)
        nearer = t < reach
        reach = np.where(nearer, t, reach)
        normal = np.where(nearer[:, None], n, normal)
        colour = np.where(nearer[:, None], np.array(solid.colour), colour)
        what = np.where(nearer, 10 * (number + 1) + face, what)
    return reach, normal, colour, what


def _blocked(
    points: Float[np.ndarray, "n 3"], solids: tuple[Solid, ...], light: Light
) -> Bool[np.ndarray, " n"]:
    """Whether a solid stands between each point and the sun."""
    rays = np.broadcast_to(light.to_sun, points.shape)
    blocked = np.zeros(len(points), bool)
    for solid in solids:
        blocked |= np.isfinite(_hit(points, rays, solid)[0])
    return blocked


def _hit(
    origin: Float[np.ndarray, "n 3"], rays: Float[np.ndarray, "n 3"], solid: Solid
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Distance along each ray (infinite if it misses), outward normal, and which face was met."""
    with np.errstate(divide="ignore", invalid="ignore"):
        if isinstance(solid, Box):
            # A ray is inside a box while it is between all three pairs of parallel faces.
            one = (solid.centre - 0.5 * solid.size - origin) / rays
            other = (solid.centre + 0.5 * solid.size - origin) / rays
            enter, leave = np.minimum(one, other), np.maximum(one, other)
            face = enter.argmax(1)
            t = enter.max(1)
            t = np.where((t > 0) & (t <= leave.min(1)), t, np.inf)
            normal = np.zeros_like(rays)
            at = np.arange(len(rays))
            normal[at, face] = -np.sign(rays[at, face])
            return t, normal, face
        to_centre = solid.centre - origin
        length2 = (rays**2).sum(1)
        middle = (rays * to_centre).sum(1) / length2
        # |ray t - to_centre|^2 = radius^2, solved for the nearer t.
        half2 = (solid.radius**2 - ((middle[:, None] * rays - to_centre) ** 2).sum(1)) / length2
        t = middle - np.sqrt(np.where(half2 >= 0, half2, np.nan))
        t = np.where(t > 0, t, np.inf)
    reach = np.where(np.isfinite(t), t, 0.0)
    normal = (reach[:, None] * rays - to_centre) / solid.radius
    return t, normal, np.zeros(len(rays), np.int64)
