"""The content of alignment.json: what was found, or why nothing was."""

from __future__ import annotations

import json
import math
import platform
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from autoreg.alignment import Alignment
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.rendering.check import RenderCheck
from autoreg.rendering.sun import Sun

SCHEMA_VERSION = 1

# What json.dumps takes: strings, numbers, booleans, null, and lists and objects of them.
Report = dict[str, Any]

# Distributions whose versions can change a result. OpenCV has several names on the package index.
_PACKAGES = {
    "autoreg": ("autoreg",),
    "opencv": ("opencv-python-headless", "opencv-python", "opencv-contrib-python"),
    "jax": ("jax",),
    "jaxopt": ("jaxopt",),
    "numpy": ("numpy",),
    "scipy": ("scipy",),
    "scikit-image": ("scikit-image",),
}


@dataclass(frozen=True)
class RenderReport:
    """What a render made: file names beside the report, how well its camera agrees, and its sun."""

    engine: str
    files: tuple[str, ...]
    check: RenderCheck | None
    sun: Sun | None = None


def aligned_report(
    photo: Path, alignment: Alignment, render: RenderReport | None, *, sha256: str | None = None
) -> Report:
    """The report on an aligned photo.

    Args:
        photo: the photo's path as it was given.
        alignment: what was found.
        render: what was rendered, if anything.
        sha256: digest of the photo's file, by which a later render knows it again.
    """
    camera, lattice, pose = alignment.camera, alignment.lattice, alignment.pose
    return {
        "schema_version": SCHEMA_VERSION,
        "status": "aligned",
        "reason": None,
        "image": _image(photo, alignment.width, alignment.height) | {"sha256": sha256},
        "camera": _camera(camera.camera, camera.source)
        | {
            "consistent": camera.consistent,
            "focal_from_photo_px": _plain(camera.focal_from_photo_px),
            "focal_from_photo_sigma_px": _plain(camera.focal_from_photo_sigma_px),
        },
        "pose": {
            "R": _plain(pose.cam_from_ground.R),
            "t": _plain(pose.cam_from_ground.t),
            "covariance": _plain(pose.covariance),
        },
        "scale": {"source": alignment.scale_source},
        "lattice": {
            "kind": lattice.kind,
            "spacing": [_plain(lattice.spacing_x), _plain(lattice.spacing_y)],
            "shift": _plain(lattice.shift),
            "joint_width": _plain(lattice.joint_width),
            "extent": _plain(lattice.extent),
        },
        "residual": {
            "rms_px": _plain(alignment.residual.rms_px),
            "median_px": _plain(alignment.residual.median_px),
            "p95_px": _plain(alignment.residual.p95_px),
            "joints": alignment.residual.joints,
            "samples": alignment.residual.samples,
            "inlier_fraction": _plain(alignment.residual.inlier_fraction),
        },
        "joints": [
            {
                "family": joint.family,
                "index": joint.index,
                "ends_px": _plain(joint.ends_px),
                "rms_px": _plain(joint.rms_px),
            }
            for joint in alignment.joints
        ],
        "render": None if render is None else render_report(render),
        "warnings": list(alignment.warnings),
        "versions": versions(),
    }


def refused_report(photo: Path, width: int, height: int, refusal: Refusal, camera: Camera | None) -> Report:
    """The report on a photo that could not be aligned; what is not known is null.

    Args:
        photo: the photo's path as it was given.
        width: its width in pixels.
        height: its height in pixels.
        refusal: why.
        camera: the camera that was given for it, if any.
    """
    known = None
    if camera is not None:
        nothing = dict.fromkeys(("consistent", "focal_from_photo_px", "focal_from_photo_sigma_px"))
        known = _camera(camera, "file") | nothing
    return {
        "schema_version": SCHEMA_VERSION,
        "status": "refused",
        "reason": {
            "code": refusal.code,
            "message": refusal.message,
            "measured": _plain(refusal.measured),
            "limit": _plain(refusal.limit),
        },
        "image": _image(photo, width, height),
        "camera": known,
        "pose": None,
        "scale": None,
        "lattice": None,
        "residual": None,
        "joints": [],
        "render": None,
        "warnings": [],
        "versions": versions(),
    }


def render_report(render: RenderReport) -> Report:
    """The `render` entry of a report."""
    check = render.check
    return {
        "engine": render.engine,
        "files": list(render.files),
        "check": None
        if check is None
        else {"rms_px": _plain(check.rms_px), "max_px": _plain(check.max_px), "samples": check.samples},
        "sun": None if render.sun is None else _sun(render.sun),
    }


def _sun(sun: Sun) -> Report:
    """Where the sun of the picture stands, and why there; an estimate has its standard deviations."""
    return {
        "azimuth_deg": _plain(sun.azimuth_deg),
        "elevation_deg": _plain(sun.elevation_deg),
        "source": sun.source,
        "sigma_deg": None if sun.sigma_deg is None else [_plain(s) for s in sun.sigma_deg],
    }


def report_text(report: Report) -> str:
    """The report as JSON text, in ASCII so that any terminal and any file system's names survive it."""
    return json.dumps(report, indent=1, allow_nan=False) + "\n"


def versions() -> Report:
    """Versions of autoreg and of what its results rest on; null for what is not installed as a package."""
    found: Report = {"python": platform.python_version()}
    for name, distributions in _PACKAGES.items():
        found[name] = next((v for v in map(_version, distributions) if v is not None), None)
    return found


@cache
def _version(distribution: str) -> str | None:
    # It takes long to import, and is not needed before a photo is aligned.
    from importlib import metadata

    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None


def _image(photo: Path, width: int, height: int) -> Report:
    return {"path": str(photo), "width": width, "height": height}


def _camera(camera: Camera, source: str) -> Report:
    return {"K": _plain(camera.K), "dist": [_plain(k) for k in camera.dist], "source": source}


def _plain(value: np.ndarray | float | None) -> Any:
    """Plain JSON numbers; what is not finite becomes null, which strict JSON readers accept."""
    if value is None:
        return None
    if isinstance(value, np.ndarray):
        return [_plain(part) for part in value]
    return float(value) if math.isfinite(value) else None
