"""Measures the vanishing stage on the York Urban database and prints a table (or JSON).

Denis, Elder and Estrada, "Efficient edge-based methods for estimating Manhattan frames in urban imagery",
ECCV 2008. The folder holds the pictures and `ground_truth.json`: focal length, principal point, and for each
picture the true directions as columns in axes x right, y up, z forward. One error per direction: the angle
to the true direction that it is matched with, signs free.

    python benchmarks/yorkurban.py ../shared/yorkurban [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import cv2
import numpy as np

# The script runs from a checkout, whether or not autoreg is installed.
sys.path[:0] = [str(Path(__file__).parents[1])]

from autoreg.camera import Camera  # noqa: E402
from autoreg.geometry import angle_between_rotations  # noqa: E402
from autoreg.segments import detect_segments  # noqa: E402
from autoreg.vanishing import manhattan_frame  # noqa: E402

AUC_LIMITS_DEG = (1.0, 3.0, 5.0, 10.0)
CAMERA_FROM_Y_UP = np.diag([1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Metric:
    """One figure of the report, with what it has to reach."""

    name: str
    unit: str
    value: float
    limit: float
    lower_is_better: bool

    @property
    def passed(self) -> bool:
        """Whether the figure reaches its limit."""
        return self.value <= self.limit if self.lower_is_better else self.value >= self.limit


def matched_errors_deg(dirs: np.ndarray, true_dirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angles between directions (columns) and the true ones in the best order, and the ordered directions."""
    best = None
    for order in permutations(range(3)):
        ordered = dirs[:, order]
        sine = np.linalg.norm(np.cross(ordered.T, true_dirs.T), axis=1)
        errors = np.degrees(np.arctan2(sine, np.abs((ordered * true_dirs).sum(0))))
        if best is None or errors.sum() < best[0].sum():
            best = (errors, ordered * np.sign((ordered * true_dirs).sum(0)))
    assert best is not None
    return best


def area_under_recall(errors: np.ndarray, limit: float) -> float:
    """Area under the share of errors below a threshold, up to the limit, divided by the limit."""
    errors = np.concatenate([[0.0], np.sort(errors)])
    share = np.linspace(0.0, 1.0, len(errors))
    last = int(np.searchsorted(errors, limit))
    x = np.concatenate([errors[:last], [limit]])
    return float(np.trapezoid(np.concatenate([share[:last], share[last - 1 : last]]), x) / limit)


def measure(folder: Path) -> tuple[list[Metric], list[Metric], list[dict[str, object]]]:
    truth = json.loads((folder / "ground_truth.json").read_text())
    errors: dict[str, list[np.ndarray]] = {"vp_orthogonal": [], "vp": []}
    rotation_deg, seconds, rows = [], [], []
    for name, entry in sorted(truth["images"].items()):
        gray = cv2.imread(str(folder / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE)
        if gray is None:
            continue
        focal_px = truth["focal_px"]
        camera = Camera(gray.shape[1], gray.shape[0], focal_px, focal_px, *truth["pp"])
        start = time.perf_counter()
        frame = manhattan_frame(detect_segments(gray), camera)
        seconds.append(time.perf_counter() - start)
        for key, found in errors.items():
            true_dirs = CAMERA_FROM_Y_UP @ np.array(entry[key])
            error, ordered = matched_errors_deg(frame.dirs_cam, true_dirs)
            found.append(error)
            if key == "vp_orthogonal":
                # Both made of matched signs, so either both are rotations or both are mirrored alike.
                rotation_deg.append(np.degrees(angle_between_rotations(ordered, true_dirs)))
        row = {
            "name": name,
            "rotation_deg": rotation_deg[-1],
            "errors_deg": errors["vp_orthogonal"][-1].tolist(),
        }
        rows.append(row)
    gated = summary(np.concatenate(errors["vp_orthogonal"]), (0.74, 0.36, 0.66, 0.78, 0.89), "orthogonal")
    gated.append(Metric("rotation, median", "deg", float(np.median(rotation_deg)), 0.95, True))
    told = summary(np.concatenate(errors["vp"]), (np.inf, 0, 0, 0, 0), "as measured")
    told.append(Metric("time per picture, median", "s", float(np.median(seconds)), np.inf, True))
    return gated, told, rows


def summary(errors: np.ndarray, limits: tuple[float, ...], truth: str) -> list[Metric]:
    metrics = [Metric(f"direction, median ({truth} truth)", "deg", float(np.median(errors)), limits[0], True)]
    for at, limit in zip(AUC_LIMITS_DEG, limits[1:], strict=True):
        name = f"AUC at {at:g} deg ({truth} truth)"
        metrics.append(Metric(name, "", area_under_recall(errors, at), limit, False))
    return metrics


def main() -> int:
    parser = argparse.ArgumentParser(description="Vanishing directions on the York Urban database")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    gated, told, rows = measure(args.folder)
    for metric in gated + told:
        limit = f"{metric.limit:6.2f}  {'pass' if metric.passed else 'FAIL'}" if metric in gated else ""
        print(f"{metric.name:38s} {metric.value:7.3f} {metric.unit:4s} {limit}")
    if args.json:
        metrics = [metric.__dict__ | {"passed": metric.passed} for metric in gated]
        args.json.write_text(json.dumps({"metrics": metrics, "pictures": rows}, indent=1))
    return 0 if all(metric.passed for metric in gated) else 1


if __name__ == "__main__":
    raise SystemExit(main())
