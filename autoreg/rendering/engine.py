"""What every engine is given, and what it has to answer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from autoreg.lattice import Lattice
from autoreg.rendering.layer import Layer
from autoreg.rendering.scene import SceneFiles
from autoreg.rendering.staging import Staging
from autoreg.view import View, Window


@dataclass(frozen=True)
class Plan:
    """All that is to be drawn.

    Attributes:
        view: the photo's camera, with its lens.
        lattice: the joints.
        staging: objects and light.
        files: the same for POV-Ray.
        backdrop: the photo (BGR) as an ideal lens would have taken it.
    """

    view: View
    lattice: Lattice
    staging: Staging
    files: SceneFiles
    backdrop: UInt8[np.ndarray, "h w 3"]


@runtime_checkable
class Engine(Protocol):
    """What can draw the computer-generated layer, as a lens without distortion shows it."""

    @property
    def name(self) -> str:
        """The engine's name in the report."""
        ...

    def draw(self, plan: Plan, straight: Window) -> Layer:
        """The solids, the joints if wanted, and the shadows, in a window of the straight picture."""
        ...

    def draw_marks(
        self, plan: Plan, marks_ground: Float[np.ndarray, "n 4 2"], straight: Window, width: int, height: int
    ) -> Float[np.ndarray, "height width"]:
        """Coverage, 0 to 1, by flat marks on the ground, of a window of the straight picture.

        The window is drawn `width` x `height` pixels large.
        """
        ...
