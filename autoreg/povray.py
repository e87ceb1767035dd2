"""Rendering by POV-Ray, the only module that starts another program."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates

from autoreg import scene
from autoreg.errors import RenderError
from autoreg.lattice import Lattice
from autoreg.layer import Layer
from autoreg.staging import Staging
from autoreg.view import View, Window, window_around

_TIMEOUT_S = 600.0
# POV-Ray knows no lens distortion: it renders the straight picture that holds all rays of the bent one.
# Beyond this many pixels a lens is too wide for that.
_MOST_PIXELS = 120_000_000


def find_povray() -> str | None:
    """The POV-Ray program, or None if it is not installed."""
    return shutil.which("povray")


def povray_version(program: str) -> str:
    """What the program calls itself, such as "3.7.0.10.unofficial"."""
    # It has no option that prints the version alone, and answers this one on stderr.
    done = subprocess.run([program, "--version"], capture_output=True, text=True, timeout=30, check=False)
    lines = (done.stdout + done.stderr).splitlines()
    return next((line.split()[1] for line in lines if line.startswith("POV-Ray ")), "unknown")


@dataclass(frozen=True)
class PovrayEngine:
    """Renders the very scene.pov that the user gets, in passes, and bends the result as the lens does.

    Attributes:
        program: the POV-Ray program.
        text: the scene.
        scratch: a folder in which to make (and take away) a working folder.
    """

    program: str
    text: str
    scratch: Path
    name: str = "povray"

    def draw(self, view: View, lattice: Lattice, staging: Staging, window: Window) -> Layer:
        """The staged solids and their shadows on the ground, in a window of the photo."""
        straight = _straight_window(view, window)
        passes = (scene.PASS_SOLIDS, scene.PASS_SHADOWED_GROUND, scene.PASS_BARE_GROUND)
        solids, shadowed, bare = (self._render(self.text, straight, number) for number in passes)
        alpha = solids[..., 3:]
        # Above the horizon both are black: there the sun takes nothing away.
        ground = bare[..., :3].mean(-1)
        kept = np.where(ground > 1e-4, shadowed[..., :3].mean(-1) / np.maximum(ground, 1e-4), 1.0)
        planes = np.concatenate([solids[..., 2::-1] * alpha, ((1 - alpha[..., 0]) * kept)[..., None]], -1)
        planes = _bend(planes, view, straight, window, outside=(0.0, 0.0, 0.0, 1.0))
        return Layer(window, np.clip(planes[..., :3], 0.0, 1.0), np.clip(planes[..., 3], 0.0, 1.0))

    def draw_marks(self, view: View, marks_ground: Float[np.ndarray, "n 4 2"]) -> Float[np.ndarray, "h w"]:
        """Coverage, 0 to 1, of each pixel of the photo by flat marks on the ground."""
        window = window_around(view.project(marks_ground), 3).within(view.camera.width, view.camera.height)
        straight = _straight_window(view, window)
        alpha = self._render(scene.marks_text(view, marks_ground), straight, 0)[..., 3:]
        coverage = np.zeros((view.camera.height, view.camera.width))
        part = coverage[window.y : window.y + window.height, window.x : window.x + window.width]
        part[:] = _bend(alpha, view, straight, window, outside=(0.0,))[..., 0]
        return coverage

    def _render(self, text: str, window: Window, number: int) -> Float[np.ndarray, "h w 4"]:
        """One pass over a window of the straight picture: BGRA, straight alpha, linear."""
        with tempfile.TemporaryDirectory(dir=self.scratch, prefix=".render-") as name:
            folder = Path(name)
            (folder / "scene.pov").write_text(text, encoding="utf-8")
            places = {"X": window.x, "Y": window.y, "W": window.width, "H": window.height}
            # Alpha and linear 16-bit colours; pixels that differ by less than an 8-bit step from their
            # neighbours are not subdivided, and nothing is jittered.
            command = [self.program, "+Iscene.pov", "+Oout.png", f"+W{window.width}", f"+H{window.height}"]
            command += ["-D", "+FN16", "+UA", "File_Gamma=1.0", "+A0.003", "+AM2", "+R5", "-J"]
            command += [f"+WT{os.cpu_count() or 1}", f"Declare=Pass={number}"]
            command += [f"Declare=Win_{key}={value}" for key, value in places.items()]
            self._run(command, folder)
            picture = cv2.imread(str(folder / "out.png"), cv2.IMREAD_UNCHANGED)
        if picture is None or picture.shape != (window.height, window.width, 4):
            size = f"{window.width} x {window.height}"
            raise RenderError(f"POV-Ray ended well but wrote no picture of {size} pixels")
        return picture / 65535.0

    def _run(self, command: list[str], folder: Path) -> None:
        # The working folder holds relative names only, as POV-Ray's own restrictions on files want it.
        try:
            done = subprocess.run(
                command,
                cwd=folder,
                capture_output=True,
                timeout=_TIMEOUT_S,
                check=False,
                stdin=subprocess.DEVNULL,
            )
        except subprocess.TimeoutExpired as error:
            raise RenderError(
                f"POV-Ray took more than {_TIMEOUT_S:g} s and was stopped; --engine preview is faster"
            ) from error
        except OSError as error:
            raise RenderError(f"POV-Ray could not be started: {error}") from error
        if done.returncode != 0:
            said = done.stderr.decode("utf-8", "replace").splitlines()
            telling = [line.strip() for line in said if "rror" in line or "annot" in line][-4:]
            words = " ".join(telling) or "it said nothing"
            raise RenderError(f"POV-Ray ended with code {done.returncode}: {words}")


def find_engine(text: str, scratch: Path) -> PovrayEngine | None:
    """The engine for a scene, or None if POV-Ray is not installed."""
    program = find_povray()
    return None if program is None else PovrayEngine(program, text, scratch)


def _straight_window(view: View, window: Window) -> Window:
    """The window of the distortion-free picture that holds every ray of a window of the photo."""
    if not view.camera.has_distortion:
        return window
    u = np.linspace(window.x - 0.5, window.x + window.width - 0.5, 65)
    v = np.linspace(window.y - 0.5, window.y + window.height - 0.5, 65)
    straight = _straight_pixels(view, np.stack(np.meshgrid(u, v), -1))
    if not np.isfinite(straight).all():
        raise RenderError("the lens model has no rays for part of the picture; use --engine preview")
    found = window_around(straight, 4)
    if found.width * found.height > _MOST_PIXELS:
        raise RenderError(
            f"without its distortion this part of the photo has {found.width} x {found.height} pixels, more "
            f"than {_MOST_PIXELS // 1_000_000} million; use --engine preview, which looks through the lens"
        )
    return found


def _straight_pixels(view: View, px: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """Where pixels of the photo lie in the picture of a lens without distortion."""
    c = view.camera
    return c.normalise(px) * [c.fx, c.fy] + [c.cx, c.cy]


def _bend(
    planes: Float[np.ndarray, "a b c"],
    view: View,
    straight: Window,
    window: Window,
    outside: tuple[float, ...],
) -> Float[np.ndarray, "h w c"]:
    """A straight picture's planes as the lens shows them in a window of the photo."""
    if not view.camera.has_distortion:
        return planes
    bent = np.empty((window.height, window.width, planes.shape[-1]))
    rows = max(1, (1 << 20) // max(window.width, 1))
    for top in range(0, window.height, rows):
        band = Window(window.x, window.y + top, window.width, min(rows, window.height - top))
        place = np.moveaxis(_straight_pixels(view, band.pixels()) - [straight.x, straight.y], -1, 0)[::-1]
        for plane, fill in enumerate(outside):
            # Linear: a smoother kernel would ring, and the photo would no longer be untouched around solids.
            bent[top : top + band.height, :, plane] = map_coordinates(
                planes[..., plane], place, order=1, cval=fill
            )
    return bent
