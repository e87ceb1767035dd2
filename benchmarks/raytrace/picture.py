"""From a scene to its picture: POV-Ray's text, its run, the lens, and the sensor."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from autoreg.camera import Camera

from .content import scene_text
from .scene import Scene


def run_povray(text: str, width: int, height: int, extra: tuple[str, ...]) -> UInt8[np.ndarray, "h w 3"]:
    """The picture that POV-Ray makes of a scene's text, BGR."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "scene.pov").write_text(text)
        command = [
            "povray",
            "+Iscene.pov",
            "+Oout.png",
            f"+W{width}",
            f"+H{height}",
            "-D",
            "+FN8",
            "-J",
            "+WT1",
        ]
        done = subprocess.run([*command, *extra], cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"povray ended with {done.returncode}:\n{done.stderr[-1500:]}")
        picture = cv2.imread(str(Path(folder) / "out.png"), cv2.IMREAD_COLOR)
    assert picture is not None
    return picture


def _ideal_xy(camera: Camera, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    xy = camera.normalise(pixels)
    if np.isnan(xy).any():
        raise ValueError(f"the distortion {camera.dist} cannot be inverted over the whole picture")
    return xy


def through_lens(scene: Scene) -> UInt8[np.ndarray, "h w 3"]:
    """The picture through a lens with distortion: a finer ideal picture, sampled nine times a pixel."""
    camera = scene.camera
    w, h, finer = camera.width, camera.height, 1.6
    edge = np.concatenate(
        [np.column_stack([np.linspace(-1, w, 60), np.full(60, v)]) for v in (-1.0, float(h))]
        + [np.column_stack([np.full(60, u), np.linspace(-1, h, 60)]) for u in (-1.0, float(w))]
    )
    xy_edge = _ideal_xy(camera, edge)
    low, high = xy_edge.min(0), xy_edge.max(0)
    fx, fy = finer * camera.fx, finer * camera.fy
    ideal = Camera(
        int(np.ceil((high[0] - low[0]) * fx)) + 4,
        int(np.ceil((high[1] - low[1]) * fy)) + 4,
        fx,
        fy,
        2 - low[0] * fx,
        2 - low[1] * fy,
    )
    sharp = run_povray(scene_text(scene, ideal), ideal.width, ideal.height, ("-A",))
    U, V = np.meshgrid(np.arange(float(w)), np.arange(float(h)))
    total = np.zeros((h, w, 3), np.float32)
    for du in (-1 / 3, 0, 1 / 3):
        for dv in (-1 / 3, 0, 1 / 3):
            xy = _ideal_xy(camera, np.column_stack([U.ravel() + du, V.ravel() + dv]))
            at = (xy * [fx, fy] + [ideal.cx, ideal.cy]).astype(np.float32).reshape(h, w, 2)
            total += cv2.remap(sharp, at, None, cv2.INTER_LINEAR)  # pyright: ignore
    return np.clip(np.round(total / 9), 0, 255).astype(np.uint8)


def take(scene: Scene) -> UInt8[np.ndarray, "h w 3"]:
    """The photo of a scene before JPEG: ray-traced, seen through the lens, with the sensor's noise."""
    camera = scene.camera
    if camera.has_distortion:
        picture = through_lens(scene)
    else:
        text = scene_text(scene, camera)
        # Nine rays for every pixel measure areas; POV-Ray's usual adaptive rays dot thin joints.
        rays = ("+A0.0", "+AM1", "+R3") if scene.area_sampled else ("+A0.1", "+AM2", "+R2")
        picture = run_povray(text, camera.width, camera.height, rays)
    rng = np.random.default_rng([scene.seed, 11])
    grey = picture.astype(np.float32)
    if scene.blur_px > 0:
        grey = cv2.GaussianBlur(grey, (0, 0), scene.blur_px)
    noise = rng.standard_normal(grey.shape, np.float32) * np.float32(0.6 * scene.noise_grey)
    shared = rng.standard_normal((*grey.shape[:2], 1), np.float32) * np.float32(0.8 * scene.noise_grey)
    return np.clip(np.round(grey + noise + shared), 0, 255).astype(np.uint8)
