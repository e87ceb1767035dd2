"""A calibration as files: autoreg's JSON with everything, OpenCV's YAML, ROS's YAML."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from autoreg.calibration.models import INTRINSICS
from autoreg.calibration.result import Calibration
from autoreg.camera_files import write_camera_json
from autoreg.jobs.outputs import write_whole

_DIGITS = 6


def write_camera_files(calibration: Calibration, path: Path, version: str) -> tuple[Path, ...]:
    """The files written: `path` in autoreg's own format, and beside it OpenCV's and ROS's."""
    write_camera_json(calibration.camera, path, camera_record(calibration, version))
    opencv, ros = path.with_suffix(".opencv.yaml"), path.with_suffix(".ros.yaml")
    write_whole(opencv, opencv_yaml(calibration).encode())
    write_whole(ros, ros_yaml(calibration, path.stem).encode())
    return path, opencv, ros


def camera_record(calibration: Calibration, version: str) -> Mapping[str, object]:
    """What the camera file says beside the camera: accuracy, valid region, quality, how it was made."""
    free = calibration.fit.free[: len(INTRINSICS)]
    names = [name for name, is_free in zip(INTRINSICS, free, strict=True) if is_free]
    covariance = calibration.precision.covariance[np.ix_(free, free)]
    return {
        "model": calibration.model.name,
        "std_devs": dict(zip(INTRINSICS, map(float, calibration.precision.std_devs), strict=True)),
        "covariance": {"names": names, "matrix": covariance.tolist()},
        "valid_region": {
            "polygon_px": np.round(calibration.coverage.hull_px, 1).tolist(),
            "meaning": "outline of all corners seen: outside it the lens model extrapolates",
        },
        "quality": quality_record(calibration),
        "made": {
            "by": f"autoreg {version}",
            "board": {
                "pattern": calibration.board.pattern,
                "kind": calibration.board.kind,
                "square_m": calibration.board.square if calibration.board.square_known else None,
                "sheet": calibration.sheet,
            },
            "views": list(calibration.data.names),
            "left_out": [{"name": out.name, "reason": out.reason} for out in calibration.left_out],
            "notes": list(calibration.notes),
        },
    }


def quality_record(calibration: Calibration) -> dict[str, Any]:
    """The verdict and the figures that it rests on."""
    halves, flat = calibration.halves, calibration.flatness
    bent = flat.bent_fit
    return {
        "verdict": calibration.verdict.grade,
        "reasons": list(calibration.verdict.reasons),
        "advice": list(calibration.verdict.advice),
        "opencv_rms_px": _plain(calibration.rms_px),
        "mean_over_views_of_l2_over_n_px": _plain(calibration.mean_l2_over_n_px),
        "corner_sigma_px": _plain(calibration.fit.sigma_px),
        "dispersion": _plain(calibration.precision.dispersion),
        "uncertainty_px": {
            "median": _plain(calibration.uncertainty.median_px),
            "p95": _plain(calibration.uncertainty.p95_px),
        },
        "halves_differ_px": None
        if halves is None
        else {
            "median": _plain(halves.difference.median_px),
            "p95": _plain(halves.difference.p95_px),
            "expected_median": _plain(halves.expected.median_px),
            "splits": halves.splits,
        },
        "coverage": {
            "area": _plain(calibration.coverage.area),
            "reach": _plain(calibration.coverage.reach),
            "bare_zones": list(calibration.coverage.bare_zones),
            "largest_tilt_deg": _plain(calibration.coverage.tilts_deg.max()),
        },
        "sheet": {
            "bent": flat.bent,
            "scatter_along_normal_over_across": _plain(np.sqrt(flat.ratio)),
            "heights_squares": _plain(flat.height_squares),
            "with_its_shape_estimated": None
            if bent is None
            else dict(zip(INTRINSICS[:4], map(_plain, bent.state.intrinsics[:4]), strict=True))
            | {"opencv_rms_px": _plain(bent.rms_px)},
        },
        "views": [
            {"name": name, "rms_px": _plain(rms), "tilt_deg": _plain(tilt)}
            for name, rms, tilt in zip(
                calibration.data.names,
                calibration.fit.view_rms_px,
                calibration.coverage.tilts_deg,
                strict=True,
            )
        ],
        "models": [
            {"name": t.model.name, "held_out_px": _plain(t.score_px), "folds_inside": t.folds_inside}
            for t in calibration.trials
        ],
    }


def opencv_yaml(calibration: Calibration) -> str:
    """The camera as OpenCV's calibration sample writes it, to be read by cv2.FileStorage."""
    camera = calibration.camera
    storage = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("board_width", calibration.board.columns)
    storage.write("board_height", calibration.board.rows)
    storage.write("square_size", calibration.board.square)
    storage.write("camera_matrix", camera.K)
    storage.write("distortion_coefficients", _coefficients(calibration).reshape(-1, 1))
    storage.write("std_deviations", calibration.precision.std_devs.reshape(-1, 1))
    storage.write("avg_reprojection_error", calibration.rms_px)
    return storage.releaseAndGetString()


def ros_yaml(calibration: Calibration, name: str) -> str:
    """The camera as ROS's camera_info_manager reads it."""
    camera, dist = calibration.camera, _coefficients(calibration)
    projection = np.column_stack([camera.K, np.zeros(3)])
    content = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": _ros_matrix(camera.K),
        "distortion_model": "plumb_bob" if len(dist) == 5 else "rational_polynomial",
        "distortion_coefficients": _ros_matrix(dist.reshape(1, -1)),
        "rectification_matrix": _ros_matrix(np.eye(3)),
        "projection_matrix": _ros_matrix(projection),
    }
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None)


def _coefficients(calibration: Calibration) -> np.ndarray:
    return np.array(calibration.camera.dist[: calibration.model.opencv_length])


def _ros_matrix(matrix: np.ndarray) -> dict[str, Any]:
    return {"rows": matrix.shape[0], "cols": matrix.shape[1], "data": [float(v) for v in matrix.ravel()]}


def _plain(value: float | np.floating) -> float | None:
    """A number as JSON takes it, to a readable number of digits; null if it is not finite."""
    return float(f"{float(value):.{_DIGITS}g}") if np.isfinite(value) else None
