"""The staged scene laid over the photo, by POV-Ray or by the built-in preview."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from autoreg.alignment import Alignment
from autoreg.errors import RenderError
from autoreg.layout import lay_joints
from autoreg.rendering.check import RenderCheck, check_render
from autoreg.rendering.depth_of_field import blur_px
from autoreg.rendering.engine import Engine, Plan
from autoreg.rendering.layer import Layer, assert_colour, lay_over, layer_picture
from autoreg.rendering.lens import bend, straight_window, straightened
from autoreg.rendering.povray import Progress, find_povray
from autoreg.rendering.povray_engine import PovrayEngine
from autoreg.rendering.preview import PreviewEngine
from autoreg.rendering.scene import SceneFiles, scene_files
from autoreg.rendering.staging import Staging
from autoreg.view import View, Window, window_around

EngineName = Literal["auto", "povray", "preview"]

# A rendered camera that misses the fitted one by more than this is an error and no picture.
MOST_RMS_PX = 0.1


@dataclass(frozen=True)
class Rendered:
    """The computer-generated layer (BGRA, straight alpha), and the photo with it (BGR)."""

    engine: str
    layer: UInt8[np.ndarray, "h w 4"]
    composite: UInt8[np.ndarray, "h w 3"]
    check: RenderCheck | None


def choose_engine(
    name: EngineName, scratch: Path, *, timeout_s: float = 1800.0, progress: Progress | None = None
) -> Engine:
    """The engine asked for; "auto" is POV-Ray where it is installed, else the preview.

    Args:
        name: which engine.
        scratch: a folder that POV-Ray may work in.
        timeout_s: POV-Ray is stopped after this time.
        progress: told the part that is done, 0 to 1.

    Raises:
        RenderError: POV-Ray was insisted on and is not installed.
    """
    if name == "preview":
        return PreviewEngine()
    program = find_povray()
    if program is not None:
        return PovrayEngine(program, scratch, timeout_s, progress)
    if name == "povray":
        raise RenderError(
            "POV-Ray is not installed (no program `povray` on the PATH); install it, for example with "
            "`apt-get install povray` or `brew install povray`, or use --engine preview"
        )
    return PreviewEngine()


def plan_render(alignment: Alignment, staging: Staging, photo: UInt8[np.ndarray, "h w 3"]) -> Plan:
    """All that an engine needs; `files` and `backdrop` are what a user gets as scene.pov and its picture.

    Raises:
        ValueError: the photo is not in colour.
    """
    assert_colour(photo)
    view = View(alignment.camera.camera, alignment.pose.cam_from_ground)
    backdrop = "scene-undistorted.png" if view.camera.has_distortion else "scene-photo.png"
    files: SceneFiles = scene_files(alignment, staging, backdrop)
    return Plan(view, alignment.lattice, staging, files, straightened(photo, view.camera))


def render(engine: Engine, plan: Plan, photo: UInt8[np.ndarray, "h w 3"]) -> Rendered:
    """The layer and the composite, with the measured agreement of the rendered camera with the fitted one.

    Raises:
        RenderError: the engine failed, or its camera is not the fitted one.
        ValueError: the photo is not in colour.
    """
    assert_colour(photo)
    view = plan.view
    window = staged_window(plan)
    straight = straight_window(view, window)
    planes = bend(_planes_of(engine.draw(plan, straight)), view, straight, window, (0.0, 0.0, 0.0, 1.0))
    layer = Layer(window, planes[..., :3], planes[..., 3])
    check = check_render(engine, plan)
    if check is not None and not check.rms_px <= MOST_RMS_PX:
        raise RenderError(
            f"the rendered joints lie {check.rms_px:.3f} px rms ({check.max_px:.3f} px at most) from their "
            f"computed place, more than {MOST_RMS_PX} px: the engine's camera is not the photo's. No picture "
            "was written; please report this with alignment.json"
        )
    picture = layer_picture(layer, view.camera.width, view.camera.height)
    return Rendered(engine.name, picture, lay_over(picture, photo, window), check)


def _planes_of(layer: Layer) -> Float[np.ndarray, "h w 4"]:
    """Light and transmission in one array; eight bits come of them, so that single precision is enough."""
    planes = np.empty((*layer.transmission.shape, 4), np.float32)
    planes[..., :3], planes[..., 3] = layer.light, layer.transmission
    return planes


def staged_window(plan: Plan) -> Window:
    """The part of the photo in which the solids, their shadows and the joints can appear."""
    view, staging = plan.view, plan.staging
    whole = Window(0, 0, view.camera.width, view.camera.height)
    if staging.joints and len(lay_joints(plan.lattice).along_x):
        return whole
    if not staging.solids:
        return Window(0, 0, 0, 0)
    # Edges between all corners hold those of the hull, and their visible parts reach as far as it does.
    first, second = np.triu_indices(16, 1)
    segments: list[np.ndarray] = []
    for solid in staging.solids:
        for to_lamp in (staging.lamps.to_sun, *staging.lamps.to_sky):
            shadow = solid.corners - solid.corners[:, 2:] / to_lamp[2] * to_lamp
            points = np.concatenate([solid.corners, shadow])
            segments.append(np.stack([points[first], points[second]], 1))
    # The margin holds what lies between two points of a line that the lens bends.
    px, ground = view.polylines(np.concatenate(segments), 4)
    if not len(px):
        return whole
    margin = 8
    if staging.focus is not None:
        # Outlines reach half a disc of blur farther; what fills the picture may be nearer than that.
        widest = float(np.nanmax(blur_px(view, staging.focus, ground)))
        margin += min(int(0.5 * widest) + 1, max(whole.width, whole.height))
    return window_around(px, margin).within(whole.width, whole.height)
