"""The vanishing stage by itself on the York Urban database, beside what installs from PyPI.

Denis, Elder and Estrada, "Efficient edge-based methods for estimating Manhattan frames in urban imagery",
ECCV 2008. The folder holds the pictures and `ground_truth.json`: focal length, principal point, and for each
picture the true directions as columns in axes x right, y up, z forward. One error per direction: the angle
to the true direction that it is matched with, signs free.
"""

from __future__ import annotations

import json
import subprocess
import time
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.geometry import angle_between_rotations
from autoreg.segments import detect_segments
from autoreg.vanishing import manhattan_frame
from benchmarks.metrics import Figure
from benchmarks.options import Options
from benchmarks.result import Plot, Result, Series, Table
from benchmarks.venvs import environment

LIMITS_DEG = (1.0, 3.0, 5.0, 10.0)
CAMERA_FROM_Y_UP = np.diag([1.0, -1.0, 1.0])
# A direction that is not found counts as this far off.
NOT_FOUND_DEG = 90.0
QUICK_PICTURES = 10
LU = ("lu-vp-detect==1.0.4", "opencv-contrib-python<5", "numpy<2.3")
# Measured by others on 77 of the pictures, one error per direction.
ELSEWHERE = (
    ("CONSAC", (0.329, 0.629, 0.759, 0.871), None),
    ("J-Linkage", (0.360, 0.660, 0.777, 0.871), None),
    ("VP with gravity prior, calibrated", (0.308, 0.653, 0.784, 0.892), 0.95),
    ("Progressive-X", (0.294, 0.549, 0.666, 0.775), None),
)


@dataclass(frozen=True)
class Case:
    """A picture with its camera and its true directions (columns, camera axes)."""

    file: Path
    camera: Camera
    true_dirs: Float[np.ndarray, "3 3"]


@dataclass(frozen=True)
class Score:
    """What one method reached: errors of directions and of the rotation, and its time as a share of LSD's.

    `alone` is that share without the search for segments, where it is known. `failures` has the reason of
    each picture that it gave no directions for; those count as not found.
    """

    name: str
    errors_deg: Float[np.ndarray, " n"]
    rotation_deg: Float[np.ndarray, " k"]
    over_lsd: float
    failures: tuple[str, ...] = ()
    alone: float | None = None

    def area(self, limit: float) -> float:
        """Area under the recall curve up to a limit."""
        return area_under_recall(self.errors_deg, limit)


def matched_errors_deg(
    dirs: Float[np.ndarray, "3 3"], true_dirs: Float[np.ndarray, "3 3"]
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Angles between directions (columns) and the true ones in the best order, and the ordered directions."""
    best: tuple[np.ndarray, np.ndarray] | None = None
    for order in permutations(range(3)):
        ordered = dirs[:, order]
        sine = np.linalg.norm(np.cross(ordered.T, true_dirs.T), axis=1)
        errors = np.degrees(np.arctan2(sine, np.abs((ordered * true_dirs).sum(0))))
        if best is None or errors.sum() < best[0].sum():
            best = (errors, ordered * np.sign((ordered * true_dirs).sum(0)))
    assert best is not None
    return best


def area_under_recall(errors: Float[np.ndarray, " n"], limit: float) -> float:
    """Area under the share of errors below a threshold, up to the limit, divided by the limit."""
    sorted_errors = np.concatenate([[0.0], np.sort(errors)])
    share = np.linspace(0.0, 1.0, len(sorted_errors))
    last = int(np.searchsorted(sorted_errors, limit))
    x = np.concatenate([sorted_errors[:last], [limit]])
    return float(np.trapezoid(np.concatenate([share[:last], share[last - 1 : last]]), x) / limit)


def cases(folder: Path, most: int | None) -> tuple[Case, ...]:
    """The pictures of the database, or an even choice of so many."""
    truth = json.loads((folder / "ground_truth.json").read_text())
    found: list[Case] = []
    for name, entry in sorted(truth["images"].items()):
        file = folder / f"{name}.jpg"
        gray = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        if gray is None:
            continue
        focal = float(truth["focal_px"])
        camera = Camera(gray.shape[1], gray.shape[0], focal, focal, *truth["pp"])
        found.append(Case(file, camera, CAMERA_FROM_Y_UP @ np.array(entry["vp_orthogonal"])))
    if most is not None and len(found) > most:
        found = [found[int(k)] for k in np.linspace(0, len(found) - 1, most)]
    return tuple(found)


def score(
    name: str,
    found: list[Float[np.ndarray, "3 3"] | None],
    over_lsd: float,
    asked: tuple[Case, ...],
    failures: tuple[str, ...] = (),
    alone: float | None = None,
) -> Score:
    """The errors of a method's directions (columns), None where it found nothing."""
    errors: list[np.ndarray] = []
    rotation: list[float] = []
    for dirs, case in zip(found, asked, strict=True):
        if dirs is None:
            errors.append(np.full(3, NOT_FOUND_DEG))
            rotation.append(NOT_FOUND_DEG)
            continue
        error, ordered = matched_errors_deg(dirs, case.true_dirs)
        errors.append(error)
        # Both made of matched signs, so either both are rotations or both are mirrored alike.
        rotation.append(float(np.degrees(angle_between_rotations(ordered, case.true_dirs))))
    return Score(name, np.concatenate(errors), np.array(rotation), over_lsd, failures, alone)


def ours(asked: tuple[Case, ...]) -> tuple[Score, list[float]]:
    """The vanishing stage, and the seconds of one LSD pass of OpenCV's own settings on each picture."""
    found: list[np.ndarray | None] = []
    refused: list[str] = []
    whole: list[float] = []
    alone: list[float] = []
    lsd: list[float] = []
    for case in asked:
        gray = cv2.imread(str(case.file), cv2.IMREAD_GRAYSCALE)
        assert gray is not None
        began = time.process_time()
        cv2.createLineSegmentDetector().detect(gray)
        passed = time.process_time()
        segments = detect_segments(np.asarray(gray, np.uint8))
        detected = time.process_time()
        try:
            found.append(manhattan_frame(segments, case.camera).dirs_cam)
        except Refusal as refusal:
            found.append(None)
            refused.append(refusal.code)
        ended = time.process_time()
        lsd.append(passed - began)
        whole.append((ended - passed) / lsd[-1])
        alone.append((ended - detected) / lsd[-1])
    shares = float(np.median(whole)), float(np.median(alone))
    return score("autoreg", found, shares[0], asked, tuple(refused), shares[1]), lsd


def lu(asked: tuple[Case, ...], lsd: list[float], folder: Path) -> Score | str:
    """lu-vp-detect on the same pictures with the same camera; else why not."""
    python = environment(folder, LU)
    if isinstance(python, str):
        return python
    words = [
        {"file": str(c.file), "focal_px": c.camera.fx, "centre_px": [c.camera.cx, c.camera.cy]} for c in asked
    ]
    program = Path(__file__).parents[1] / "peer_lu.py"
    done = subprocess.run(
        [str(python), str(program)], input=json.dumps(words), capture_output=True, text=True, check=False
    )
    if done.returncode:
        said = done.stderr.strip().splitlines()
        return f"it failed: {said[-1] if said else f'exit code {done.returncode}'}"
    return lu_score(json.loads(done.stdout), asked, lsd)


def lu_score(answers: list[dict[str, Any]], asked: tuple[Case, ...], lsd: list[float]) -> Score | str:
    """The score of lu-vp-detect's answers; a word instead where it failed on every picture."""
    failures = tuple(str(a["error"]) for a in answers if a["dirs"] is None)
    if len(failures) == len(answers):
        return f"it failed on every picture, first by {failures[0]}"
    # Its axes: it gives rows; signs are free.
    found = [None if a["dirs"] is None else np.array(a["dirs"], float).T for a in answers]
    ratio = float(np.median([a["seconds"] / s for a, s in zip(answers, lsd, strict=True)]))
    return score("lu-vp-detect 1.0.4", found, ratio, asked, failures)


def run(options: Options) -> Result:
    """The stage and its peers on the database."""
    if not (options.yorkurban / "ground_truth.json").is_file():
        return Result(
            "vanishing",
            skipped=f"{options.yorkurban} has no ground_truth.json (--yorkurban DIR)",
            absent=options.is_absent("yorkurban"),
        )
    asked = cases(options.yorkurban, QUICK_PICTURES if options.quick else None)
    mine, lsd = ours(asked)
    # The short run installs nothing.
    other = "not in the short run" if options.quick else lu(asked, lsd, options.cache("lu-vp-detect"))
    scores = [mine] if isinstance(other, str) else [mine, other]
    figures = [
        *(Figure(f"vanishing.auc{limit:g}", mine.area(limit)) for limit in LIMITS_DEG),
        Figure("vanishing.rotation", float(np.median(mine.rotation_deg))),
        Figure("vanishing.with_segments", mine.over_lsd),
    ]
    figures += [] if mine.alone is None else [Figure("vanishing.time", mine.alone)]
    notes = [
        "The figures measured elsewhere are of 77 of the database's 102 pictures, "
        f"ours of the {len(asked)} at hand: they are beside, not against, each other.",
    ]
    notes += [
        f"{s.name} gave nothing on {len(s.failures)} of {len(asked)} pictures, which count as not found: "
        f"{'; '.join(sorted(set(s.failures)))}."
        for s in scores
        if s.failures
    ]
    if isinstance(other, str):
        notes.append(f"lu-vp-detect was not run beside it: {other}.")
    else:
        figures.append(Figure("vanishing.lead", mine.area(3.0) - other.area(3.0)))
    return Result(
        "vanishing",
        about=(
            f"{len(asked)} pictures of York Urban with the published camera; one error per direction "
            f"against the "
            "orthogonal truth. Times are processor time over one LSD pass of OpenCV's own settings: of "
            "all that a method does, and of the stage alone, which is given its segments."
        ),
        figures=tuple(figures),
        tables=(_table(scores),),
        plots=(_recall(scores),),
        notes=tuple(notes),
    )


def _table(scores: list[Score]) -> Table:
    rows = [
        (
            s.name,
            *(f"{s.area(limit):.3f}" for limit in LIMITS_DEG),
            f"{np.median(s.rotation_deg):.2f}",
            f"{s.over_lsd:.2f}",
            "" if s.alone is None else f"{s.alone:.2f}",
            str(len(s.failures)),
        )
        for s in scores
    ]
    rows += [
        (
            f"{name} (elsewhere)",
            *(f"{a:.3f}" for a in areas),
            "" if turn is None else f"{turn:.2f}",
            "",
            "",
            "",
        )
        for name, areas, turn in ELSEWHERE
    ]
    areas = tuple(f"AUC at {limit:g}°" for limit in LIMITS_DEG)
    columns = ("method", *areas, "rotation, median °", "LSD passes", "alone", "failed")
    return Table("York Urban", columns, tuple(rows))


def _recall(scores: list[Score]) -> Plot:
    at = np.linspace(0.1, 10.0, 60)
    series = tuple(
        Series(s.name, tuple(map(float, at)), tuple(float(np.mean(s.errors_deg <= a)) for a in at))
        for s in scores
    )
    return Plot("recall", "Share of directions within an angle", "angle, degrees", "share", series)
