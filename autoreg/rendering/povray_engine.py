"""The layer by POV-Ray: the very scene.pov that the user gets, in passes."""

from __future__ import annotations

import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from autoreg.errors import RenderError
from autoreg.rendering import povray, scene
from autoreg.rendering.depth_of_field import defocused_ground
from autoreg.rendering.engine import Plan
from autoreg.rendering.layer import Layer
from autoreg.rendering.povray import Progress
from autoreg.view import Window

# Alpha and linear 16-bit colours, nothing jittered.
_PICTURE = ["-D", "+FN16", "+UA", "File_Gamma=1.0", "-J"]
# Pixels that differ from their neighbours by more than the first number are divided again and again:
# finely for outlines, less so for shadows, which the sun's and the sky's width make soft.
_FINE, _SHADOW, _MARKS = ["+A0.01", "+AM2", "+R3"], ["+A0.03", "+AM2", "+R3"], ["+A0.003", "+AM2", "+R5"]
# Focal blur has its own samples, each of which any division would take anew.
_DEFOCUSED = ["-A"]
# Of the whole, what each pass usually takes, for the progress bar.
_PART = {scene.PASS_SOLIDS: (0.0, 0.4), scene.PASS_SHADOWED_GROUND: (0.4, 0.9), scene.PASS_MARKS: (0.9, 1.0)}


@dataclass(frozen=True)
class PovrayEngine:
    """Renders scene.pov in passes and makes a layer of them.

    Attributes:
        program: the POV-Ray program.
        scratch: a folder in which to make (and take away) a working folder.
        timeout_s: each pass is stopped after this time.
        progress: told the part of the whole that is done, 0 to 1.
    """

    program: str
    scratch: Path
    timeout_s: float = 1800.0
    progress: Progress | None = None
    name: str = "povray"

    def draw(self, plan: Plan, straight: Window) -> Layer:
        """The solids, the joints if wanted, and the shadows, in a window of the straight picture."""
        height, width = straight.height, straight.width
        if not width * height:
            return Layer(straight, np.zeros((height, width, 3)), np.ones((height, width)))
        with self._folder(plan) as folder:
            solids = self._render(folder, straight, scene.PASS_SOLIDS, _smooth(plan, _FINE))
            alpha = solids[..., 3]
            light = solids[..., 2::-1] * alpha[..., None]
            kept = self._kept(folder, plan, straight)
        return Layer(straight, np.clip(light, 0.0, 1.0), np.clip((1 - alpha) * kept, 0.0, 1.0))

    def draw_marks(
        self, plan: Plan, marks_ground: Float[np.ndarray, "n 4 2"], straight: Window, width: int, height: int
    ) -> Float[np.ndarray, "height width"]:
        """Coverage, 0 to 1, by flat marks on the ground, of a window of the straight picture."""
        with self._folder(plan) as folder:
            (folder / scene.MARKS_NAME).write_text(scene.marks_text(marks_ground))
            return self._render(folder, straight, scene.PASS_MARKS, _smooth(plan, _MARKS), (width, height))[
                ..., 3
            ]

    def _kept(self, folder: Path, plan: Plan, straight: Window) -> Float[np.ndarray, "h w"]:
        """The part of its light that the shadowed ground keeps; 1 where no ground is."""
        if not plan.staging.solids:
            return np.ones((straight.height, straight.width))
        shadowed = self._render(folder, straight, scene.PASS_SHADOWED_GROUND, _SHADOW)
        there = shadowed[..., 3]
        if not there.any():
            return np.ones((straight.height, straight.width))
        # All lamps are far, so the bare ground looks the same everywhere and one pixel of it will do.
        v, u = np.unravel_index(int(np.argmax(there)), there.shape)
        spot = Window(straight.x + int(u), straight.y + int(v), 1, 1)
        bare = float(self._render(folder, spot, scene.PASS_BARE_GROUND, [])[0, 0, :3].mean())
        if not bare > 0:
            raise RenderError("POV-Ray shows no light on the ground; check the light of the scene")
        ratio = np.clip(shadowed[..., :3].mean(-1) / bare, 0.0, 1.0)
        # Two steps of 16 bits below 1 are rounding, and no shadow.
        ratio = np.where(ratio > 1 - 1e-4, 1.0, ratio)
        kept = 1.0 - there * (1.0 - ratio)
        focus = plan.staging.focus
        # The ground hides nothing from itself, so that its blur need not be traced, which takes minutes.
        return kept if focus is None else defocused_ground(kept, plan.view, straight, focus)

    @contextmanager
    def _folder(self, plan: Plan) -> Generator[Path]:
        """A working folder of this render alone, with the scene and all that it names."""
        with tempfile.TemporaryDirectory(dir=self.scratch, prefix=".render-") as name:
            folder, files = Path(name), plan.files
            (folder / "scene.pov").write_text(files.text, encoding="utf-8")
            for include, text in files.includes:
                (folder / include).write_text(text, encoding="utf-8")
            for image, source in files.images:
                write_image(source, folder / image)
            if files.reflects:
                cv2.imwrite(str(folder / files.backdrop), plan.backdrop, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            yield folder

    def _render(
        self,
        folder: Path,
        window: Window,
        number: int,
        smooth: list[str],
        size: tuple[int, int] | None = None,
    ) -> Float[np.ndarray, "h w 4"]:
        """One pass over a window of the straight picture: BGRA, straight alpha, linear."""
        width, height = size or (window.width, window.height)
        places = {"X": window.x, "Y": window.y, "W": window.width, "H": window.height}
        options = ["+Iscene.pov", "+Oout.png", f"+W{width}", f"+H{height}", *_PICTURE, *smooth]
        options += [f"+WT{povray.threads()}", f"Declare=Pass={number}"]
        options += [f"Declare=Win_{key}={value}" for key, value in places.items()]
        progress = None
        if self.progress is not None and number in _PART:
            tell, (start, end) = self.progress, _PART[number]
            progress = lambda part: tell(start + part * (end - start))  # noqa: E731
        povray.run_povray(self.program, options, folder, timeout_s=self.timeout_s, progress=progress)
        picture = cv2.imread(str(folder / "out.png"), cv2.IMREAD_UNCHANGED)
        if picture is None or picture.shape != (height, width, 4):
            raise RenderError(f"POV-Ray ended well but wrote no picture of {width} x {height} pixels")
        return picture / 65535.0


def _smooth(plan: Plan, sharp: list[str]) -> list[str]:
    return sharp if plan.staging.focus is None else _DEFOCUSED


def write_image(source: Path, target: Path) -> None:
    """A picture as the PNG file that the scene names, opaque as the preview shows it.

    Raises:
        RenderError: it cannot be read any more.
    """
    picture = cv2.imread(str(source), cv2.IMREAD_COLOR)
    if picture is None or not cv2.imwrite(str(target), picture):
        raise RenderError(f"the picture {source} cannot be read")
