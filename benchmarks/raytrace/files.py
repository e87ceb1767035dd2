"""A scene as files: NAME.jpg, NAME.camera.json and NAME.truth.json."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from .picture import take
from .scene import Scene


def truth(scene: Scene) -> dict[str, object]:
    """Content of NAME.truth.json."""
    forward = scene.cam_from_ground.R[2]
    kind = "rows" if scene.paving.layout == "rows" else "running" if scene.paving.shift else "stack"
    return {
        "name": scene.name,
        "kind": scene.kind,
        "seed": scene.seed,
        "lattice": scene.has_lattice,
        "lattice_kind": kind,
        "size": [scene.camera.width, scene.camera.height],
        "K": scene.camera.K.tolist(),
        "dist": list(scene.camera.dist[:5]),
        "R": scene.cam_from_ground.R.tolist(),
        "t": scene.cam_from_ground.t.tolist(),
        "slab": list(scene.paving.slab_m),
        "bond": scene.paving.shift,
        "joint": scene.paving.joint_m,
        "height": float(scene.cam_from_ground.origin_in_a[2]),
        "tell_slab": scene.tell_slab,
        "tell_camera": scene.tell_camera,
        "wrong_k": scene.wrong_camera,
        "pitch_deg": float(np.rad2deg(np.arcsin(-forward[2]))),
    }


def camera_file(scene: Scene) -> dict[str, object]:
    """Content of NAME.camera.json."""
    told = scene.told
    own = {key: getattr(told, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    return {**own, "dist": list(told.dist[:5])}


def write(scene: Scene, folder: Path) -> None:
    """Render a scene and write its three files; the truth last, so that it marks a finished scene."""
    folder.mkdir(parents=True, exist_ok=True)
    quality = [cv2.IMWRITE_JPEG_QUALITY, scene.jpeg_quality]
    cv2.imwrite(str(folder / f"{scene.name}.jpg"), take(scene), quality)
    (folder / f"{scene.name}.camera.json").write_text(json.dumps(camera_file(scene), indent=1))
    (folder / f"{scene.name}.truth.json").write_text(json.dumps(truth(scene), indent=1))
