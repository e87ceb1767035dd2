"""Rendering without POV-Ray: z-buffer, one lamp for the sun, an even sky, and hard shadows on the ground."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from autoreg.errors import InputError
from autoreg.layout import lay_joints
from autoreg.rendering.engine import Plan
from autoreg.rendering.layer import Layer, bands, linear_from_srgb
from autoreg.rendering.lens import window_view
from autoreg.rendering.raster import ZBuffer
from autoreg.rendering.scene import drawn_joint_width
from autoreg.rendering.staging import Lamps
from autoreg.rendering.surface import Surface, flat_normals
from autoreg.view import View, Window, window_around

# Samples per pixel side: of the picture, and of the marks by which its camera is checked.
_SAMPLES, _MARK_SAMPLES = 3, 16
# Finishes that POV-Ray lights without a lamp.
_GLOWING = ("Luminous",)


@dataclass(frozen=True)
class _Painted:
    """Triangles in the ground frame with what they look like; `glows` are shown as they are, unlit."""

    surface: Surface
    colour: tuple[float, float, float]
    image: Float[np.ndarray, "h w 3"] | None
    glows: bool


class PreviewEngine:
    """The same objects at the same places as POV-Ray draws, shaded simply.

    No shadows of objects on each other, no mirroring, no depth of field.
    """

    name = "preview"

    def draw(self, plan: Plan, straight: Window) -> Layer:
        """The solids, the joints if wanted, and the shadows, in a window of the straight picture."""
        width, height = straight.width, straight.height
        light, transmission = np.zeros((height, width, 3), np.float32), np.ones((height, width), np.float32)
        layer = Layer(straight, light, transmission)
        if not width * height:
            return layer
        view = window_view(plan.view, straight, width, height)
        painted = _painted(plan)
        lamps = plan.staging.lamps
        casting = [s.surface.corners for s in plan.staging.solids]
        shadows = _on_ground(np.concatenate([np.empty((0, 3, 3)), *casting]), lamps)
        kept = lamps.on_ground[1]
        for part in bands(width, height):
            buffer = ZBuffer(view, part.start, part.stop - part.start, _SAMPLES)
            for thing in painted:
                buffer.draw(thing.surface.corners)
            hit = buffer.nearest >= 0
            shaded = buffer.mask(shadows) & ~hit
            light[part] = _pooled(_lit(view, buffer, hit, painted, lamps))
            transmission[part] = _pooled(np.where(hit, 0.0, np.where(shaded, kept, 1.0))[..., None])[..., 0]
        return layer

    def draw_marks(
        self, plan: Plan, marks_ground: Float[np.ndarray, "n 4 2"], straight: Window, width: int, height: int
    ) -> Float[np.ndarray, "height width"]:
        """Coverage, 0 to 1, by flat convex marks on the ground, of a window of the straight picture."""
        view = window_view(plan.view, straight, width, height)
        coverage = np.zeros((height, width))
        ground = np.concatenate([marks_ground, np.zeros((*marks_ground.shape[:2], 1))], -1)
        for mark, px in zip(ground, view.camera.project(view.cam_from_ground.apply(ground)), strict=True):
            if not np.isfinite(px).all():
                continue
            around = window_around(px, 2).within(width, height)
            if not around.width * around.height:
                continue
            buffer = ZBuffer(
                window_view(view, around, around.width, around.height), 0, around.height, _MARK_SAMPLES
            )
            inside = buffer.mask(np.stack([mark[[0, 1, 2]], mark[[0, 2, 3]]]))
            part = coverage[around.y : around.y + around.height, around.x : around.x + around.width]
            part[:] = np.maximum(part, _pooled(inside[..., None].astype(float), _MARK_SAMPLES)[..., 0])
        return coverage


def _painted(plan: Plan) -> list[_Painted]:
    found: list[_Painted] = []
    for solid in plan.staging.solids:
        material = solid.source.material
        image = None if material.image is None or solid.surface.uv is None else _texture(material.image)
        found.append(_Painted(solid.surface, material.colour, image, material.finish in _GLOWING))
    if plan.staging.joints:
        joints = lay_joints(plan.lattice)
        lines = np.concatenate([joints.along_x, joints.along_y])
        along = lines[:, 1] - lines[:, 0]
        across = np.stack([-along[:, 1], along[:, 0]], -1) / np.linalg.norm(along, axis=-1, keepdims=True)
        half = 0.5 * drawn_joint_width(plan.lattice) * across
        quad = np.stack([lines[:, 0] - half, lines[:, 1] - half, lines[:, 1] + half, lines[:, 0] + half], 1)
        quad = np.concatenate([quad, np.zeros((*quad.shape[:2], 1))], -1)
        corners = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
        found.append(_Painted(Surface(corners, flat_normals(corners)), plan.staging.joint_colour, None, True))
    return found


def _texture(path: Path) -> Float[np.ndarray, "h w 3"]:
    """A picture's linear light, RGB."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise InputError(f"the picture {path} cannot be read")
    return linear_from_srgb(picture[..., ::-1])


def _on_ground(corners: Float[np.ndarray, "n 3 3"], lamps: Lamps) -> Float[np.ndarray, "n 3 3"]:
    """Triangles thrown onto the ground by the sun."""
    return corners - corners[..., 2:] / lamps.to_sun[2] * lamps.to_sun


def _lit(
    view: View, buffer: ZBuffer, hit: Bool[np.ndarray, "a b"], painted: list[_Painted], lamps: Lamps
) -> Float[np.ndarray, "a b 3"]:
    """Light of each sample; none where no solid is."""
    shown = np.zeros((*hit.shape, 3))
    first = 0
    for thing in painted:
        count = len(thing.surface.corners)
        y, x = np.nonzero(hit & (buffer.nearest >= first) & (buffer.nearest < first + count))
        triangle = buffer.nearest[y, x] - first
        first += count
        if not len(y):
            continue
        rays = buffer.rays(y, x)
        weights = _weights(view.eye, rays, thing.surface.corners[triangle])
        colour = np.broadcast_to(np.array(thing.colour), (len(y), 3))
        if thing.image is not None and thing.surface.uv is not None:
            colour = _looked_up(thing.image, np.einsum("nk,nkd->nd", weights, thing.surface.uv[triangle]))
        if thing.glows:
            shown[y, x] = colour
            continue
        normal = np.einsum("nk,nkd->nd", weights, thing.surface.normals[triangle])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        # An open surface is lit on the side that is seen.
        flat = flat_normals(thing.surface.corners)[triangle, 0]
        normal = np.where((np.einsum("nd,nd->n", flat, rays) > 0)[:, None], -normal, normal)
        shown[y, x] = colour * _irradiance(normal, lamps)[:, None]
    return shown


def _irradiance(normal: Float[np.ndarray, "n 3"], lamps: Lamps) -> Float[np.ndarray, " n"]:
    """Light on surfaces that nothing stands before."""
    sun = lamps.sun * np.clip(normal @ lamps.to_sun, 0.0, None)
    # The lamps of the sky are many: their sum is that of an even sky, to a hundredth.
    sky = lamps.on_ground[1] * 0.5 * (1.0 + normal[:, 2])
    ground = lamps.bounce * 0.5 * (1.0 - normal[:, 2])
    return lamps.whitest * lamps.exposure * (sun + sky + ground)


def _weights(
    eye: Float[np.ndarray, "3"], rays: Float[np.ndarray, "n 3"], corners: Float[np.ndarray, "n 3 3"]
) -> Float[np.ndarray, "n 3"]:
    """Weights of a triangle's corners at the point where a ray meets it (Moeller and Trumbore 1997)."""
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p, s = np.cross(rays, e2), eye - corners[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / np.einsum("nd,nd->n", e1, p)
        u = np.einsum("nd,nd->n", s, p) * scale
        v = np.einsum("nd,nd->n", rays, np.cross(s, e1)) * scale
    # Samples on a triangle that is seen edge-on may miss it by rounding.
    u, v = np.clip(np.nan_to_num(u), 0.0, 1.0), np.clip(np.nan_to_num(v), 0.0, 1.0)
    return np.stack([np.clip(1.0 - u - v, 0.0, 1.0), u, v], -1)


def _looked_up(image: Float[np.ndarray, "h w 3"], uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    height, width = image.shape[:2]
    # Repeated beyond its edges, which are its own.
    u, v = np.where((uv < 0) | (uv > 1), uv % 1.0, uv).T
    x: Int[np.ndarray, " n"] = np.floor(u * width).astype(np.int64).clip(0, width - 1)
    y: Int[np.ndarray, " n"] = np.floor((1.0 - v) * height).astype(np.int64).clip(0, height - 1)
    return image[y, x]


def _pooled(values: Float[np.ndarray, "a b c"], samples: int = _SAMPLES) -> Float[np.ndarray, "h w c"]:
    """Means over the samples of each pixel."""
    height, width = values.shape[0] // samples, values.shape[1] // samples
    return values.reshape(height, samples, width, samples, -1).mean((1, 3))
