"""alignment.json read back: the pose that an earlier run found."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from autoreg.alignment import Alignment, CameraReport, JointFit, Pose, Residual
from autoreg.camera import Camera
from autoreg.errors import InputError
from autoreg.geometry import Rigid
from autoreg.lattice import Lattice, LatticeKind

_VERSION = 1
# How far R may be from a rotation: the file holds all digits, so more is somebody's edit.
_NOT_A_ROTATION = 1e-6
# No photo tells apart so many slabs in a row.
_MOST_SLABS = 10_000


@dataclass(frozen=True)
class SavedAlignment:
    """An alignment with its report as it was read, and the photo's path as it was given.

    `sha256` is the digest of the photo's file; None in a report that names none.
    """

    alignment: Alignment
    report: dict[str, Any]
    photo: Path
    sha256: str | None = None


def read_alignment(path: Path) -> SavedAlignment:
    """The alignment in a file.

    Raises:
        InputError: it cannot be read, is no alignment.json, or its photo was refused.
    """
    try:
        report = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(
            f"{path} cannot be read: {error.strerror}; give the alignment.json of a run"
        ) from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is no JSON ({error}); give the alignment.json of a run") from error
    if not isinstance(report, dict) or "schema_version" not in report:
        raise InputError(f"{path} is no alignment.json: it has no schema_version")
    if report["schema_version"] != _VERSION:
        raise InputError(
            f"{path} has schema_version {report['schema_version']!r}, and this autoreg reads {_VERSION}; "
            "align the photo anew"
        )
    if report.get("status") != "aligned":
        reason = report.get("reason")
        said = reason.get("message") if isinstance(reason, dict) else reason
        raise InputError(
            f"{path} holds no pose, because the photo was refused: {said or 'no reason is given'}"
        )
    try:
        image = report["image"]
        return SavedAlignment(_alignment(report), report, Path(image["path"]), image.get("sha256"))
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise InputError(
            f"{path} is damaged ({type(error).__name__}: {error}); align the photo anew"
        ) from error


def aligned_photo(alignment: Path, saved: SavedAlignment) -> Path:
    """The photo that was aligned, by its path in the report: from here, from the report's folder or above.

    Raises:
        InputError: it is not there, or what is there is another picture of that name.
    """
    beside = alignment.absolute().parent
    above = beside.parent
    places = (saved.photo, beside / saved.photo, above / saved.photo, above / saved.photo.name)
    found = [place for place in places if place.is_file()]
    if not found:
        raise InputError(
            f"the photo {saved.photo} is neither here nor near {alignment}; say where it is with --photo"
        )
    if saved.sha256 is None:
        return found[0]
    for place in found:
        if hashlib.sha256(place.read_bytes()).hexdigest() == saved.sha256:
            return place
    raise InputError(
        f"{found[0]} is not the photo that was aligned, or it has been changed since; give the one that is "
        "meant with --photo"
    )


def with_photo(saved: SavedAlignment, photo: Path, sha256: str) -> SavedAlignment:
    """The alignment with another file as its photo."""
    image = saved.report["image"] | {"path": str(photo), "sha256": sha256}
    return replace(saved, report=saved.report | {"image": image}, photo=photo, sha256=sha256)


def _alignment(report: dict[str, Any]) -> Alignment:
    image, camera, pose = (report[key] for key in ("image", "camera", "pose"))
    K, dist = np.array(camera["K"], float), tuple(camera["dist"])
    width, height = image["width"], image["height"]
    residual = report["residual"]
    R, t = np.array(pose["R"], float), np.array(pose["t"], float)
    if R.shape != (3, 3) or t.shape != (3,) or not np.isfinite(t).all():
        raise ValueError("pose.R and pose.t are no rigid motion")
    if not np.abs(R @ R.T - np.eye(3)).max() < _NOT_A_ROTATION or np.linalg.det(R) < 0:
        raise ValueError("pose.R is no rotation")
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
        _lattice(report["lattice"]),
        Residual(**{key: _number(residual[key]) for key in Residual.__dataclass_fields__}),
        tuple(
            JointFit(joint["family"], joint["index"], _numbers(joint["ends_px"]), _number(joint["rms_px"]))
            for joint in report["joints"]
        ),
        tuple(report.get("warnings", ())),
    )


def _lattice(lattice: dict[str, Any]) -> Lattice:
    kind, extent = lattice["kind"], _numbers(lattice["extent"])
    if kind not in get_args(LatticeKind):
        raise ValueError(f"lattice.kind is {kind!r}")
    spacing = [value if value is None else float(value) for value in lattice["spacing"]]
    shift, joint_width = lattice["shift"], float(lattice["joint_width"])
    sides = [value for value in spacing if value is not None]
    if len(spacing) != 2 or spacing[1] is None or (spacing[0] is None) != (kind == "rows"):
        raise ValueError(f"lattice.spacing of {kind} is {spacing}")
    if not all(0 < side < np.inf for side in sides) or not 0 <= joint_width < min(sides):
        raise ValueError(f"lattice.spacing {spacing} and joint_width {joint_width} are none of slabs")
    if extent.ndim != 2 or extent.shape[1] != 2 or len(extent) < 3 or not np.isfinite(extent).all():
        raise ValueError("lattice.extent is no polygon")
    if np.ptp(extent, axis=0).max() > _MOST_SLABS * min(sides):
        raise ValueError(f"lattice.extent spans more than {_MOST_SLABS} slabs")
    return Lattice(kind, spacing[0], spacing[1], None if shift is None else float(shift), joint_width, extent)


def _number(value: Any) -> Any:
    """A number as it was; null stands for what was not finite."""
    return float("nan") if value is None else value


def _numbers(value: Any) -> np.ndarray:
    return np.array(value, float)
