"""alignment.json read back: the pose that an earlier run found."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from autoreg.alignment import Alignment, CameraReport, JointFit, Pose, Residual
from autoreg.camera import Camera
from autoreg.errors import InputError
from autoreg.geometry import Rigid
from autoreg.lattice import Lattice

_VERSION = 1
# How far R may be from a rotation: the file holds all digits, so more is somebody's edit.
_NOT_A_ROTATION = 1e-6


@dataclass(frozen=True)
class SavedAlignment:
    """An alignment with its report as it was read, and the photo's path as it was given."""

    alignment: Alignment
    report: dict[str, Any]
    photo: Path


def read_alignment(path: Path) -> SavedAlignment:
    """The alignment in a file.

    Raises:
        InputError: it cannot be read, is no alignment.json, or its photo was refused.
    """
    try:
        report = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            f"{path} cannot be read: {error.strerror}; give the alignment.json of a run"
        ) from error
    except ValueError as error:
        raise InputError(f"{path} is no JSON ({error}); give the alignment.json of a run") from error
    if not isinstance(report, dict) or "schema_version" not in report:
        raise InputError(f"{path} is no alignment.json: it has no schema_version")
    if report["schema_version"] != _VERSION:
        raise InputError(
            f"{path} has schema_version {report['schema_version']!r}, and this autoreg reads {_VERSION}; "
            "align the photo anew"
        )
    if report.get("status") != "aligned":
        reason = (report.get("reason") or {}).get("message", "no reason is given")
        raise InputError(f"{path} holds no pose, because the photo was refused: {reason}")
    try:
        return SavedAlignment(_alignment(report), report, Path(report["image"]["path"]))
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(
            f"{path} is damaged ({type(error).__name__}: {error}); align the photo anew"
        ) from error


def _alignment(report: dict[str, Any]) -> Alignment:
    image, camera, pose, lattice = (report[key] for key in ("image", "camera", "pose", "lattice"))
    K, dist = np.array(camera["K"], float), tuple(camera["dist"])
    width, height = image["width"], image["height"]
    residual = report["residual"]
    R, t = np.array(pose["R"], float), np.array(pose["t"], float)
    if R.shape != (3, 3) or t.shape != (3,) or not np.abs(R @ R.T - np.eye(3)).max() < _NOT_A_ROTATION:
        raise ValueError("pose.R and pose.t are no rigid motion")
    return Alignment(
        width,
        height,
        CameraReport(
            Camera(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2], dist),
            camera["source"],
            camera["consistent"],
            camera["focal_from_photo_px"],
            camera["focal_from_photo_sigma_px"],
        ),
        Pose(Rigid(R, t), _numbers(pose["covariance"])),
        report["scale"]["source"],
        Lattice(
            lattice["kind"],
            lattice["spacing"][0],
            lattice["spacing"][1],
            lattice["shift"],
            lattice["joint_width"],
            np.array(lattice["extent"], float),
        ),
        Residual(**{key: _number(residual[key]) for key in Residual.__dataclass_fields__}),
        tuple(
            JointFit(joint["family"], joint["index"], _numbers(joint["ends_px"]), _number(joint["rms_px"]))
            for joint in report["joints"]
        ),
        tuple(report.get("warnings", ())),
    )


def _number(value: Any) -> Any:
    """A number as it was; null stands for what was not finite."""
    return float("nan") if value is None else value


def _numbers(value: Any) -> np.ndarray:
    return np.array(value, float)
