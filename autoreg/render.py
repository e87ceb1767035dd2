"""The staged solids laid over the photo, by POV-Ray or by the built-in preview."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from autoreg.alignment import Alignment
from autoreg.check import Engine, RenderCheck, check_render
from autoreg.errors import RenderError
from autoreg.layer import lay_over, layer_picture
from autoreg.povray import find_engine
from autoreg.preview import PreviewEngine
from autoreg.staging import Staging, corners, shadow_corners
from autoreg.view import View, Window, window_around

EngineName = Literal["auto", "povray", "preview"]


@dataclass(frozen=True)
class Rendered:
    """The computer-generated layer (BGRA, straight alpha) and the photo under it (BGR)."""

    engine: str
    layer: UInt8[np.ndarray, "h w 4"]
    composite: UInt8[np.ndarray, "h w 3"]
    check: RenderCheck | None


def choose_engine(name: EngineName, scene: str, scratch: Path) -> Engine:
    """The engine asked for; "auto" is POV-Ray where it is installed, else the preview.

    Args:
        name: which engine.
        scene: the scene's text, which POV-Ray renders.
        scratch: a folder that POV-Ray may work in.

    Raises:
        RenderError: POV-Ray was insisted on and is not installed.
    """
    if name == "preview":
        return PreviewEngine()
    engine = find_engine(scene, scratch)
    if engine is None and name == "povray":
        raise RenderError(
            "POV-Ray is not installed (no program `povray` on the PATH); install it, for example with "
            "`apt-get install povray` or `brew install povray`, or use --engine preview"
        )
    return engine or PreviewEngine()


def render(
    engine: Engine, alignment: Alignment, staging: Staging, photo: UInt8[np.ndarray, "h w 3"]
) -> Rendered:
    """The layer and the composite, with the measured agreement of the rendered camera with the fitted one.

    Raises:
        RenderError: the engine failed.
    """
    view = View(alignment.camera.camera, alignment.pose.cam_from_ground)
    window = staged_window(view, alignment, staging)
    layer = engine.draw(view, alignment.lattice, staging, window)
    check = check_render(engine, view, alignment.lattice)
    picture = layer_picture(layer, alignment.width, alignment.height)
    return Rendered(engine.name, picture, lay_over(picture, photo, window), check)


def staged_window(view: View, alignment: Alignment, staging: Staging) -> Window:
    """The part of the photo in which the solids and their shadows can appear."""
    solids = staging.solids_on(alignment.lattice)
    points = [corners(s) for s in solids] + [shadow_corners(s, staging.light) for s in solids]
    px = view.project(np.concatenate([np.empty((0, 3)), *points]))
    whole = Window(0, 0, view.camera.width, view.camera.height)
    # A corner out of sight may lie on any side of the picture: then all of it has to be drawn.
    if not np.isfinite(px).all():
        return whole
    return window_around(px, 4).within(whole.width, whole.height) if len(px) else Window(0, 0, 0, 0)
