"""Measure calibration: detection time, coverage of the intervals, bad views, published sets.

Run from the project's root: `python benchmarks/chessboards.py [NAME ...]`, the names being published, bad,
wrong, detection, rendered and coverage.
The published sets are looked for in ../shared/chessboards, or in the folder named by CHESSBOARDS.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from scipy.stats import chi2

from autoreg.calibration.bad_views import sift
from autoreg.calibration.board import Board, BoardView
from autoreg.calibration.detection import find_board
from autoreg.calibration.models import INTRINSICS, intrinsics_of
from autoreg.calibration.observations import data_of
from autoreg.calibration.photos import search_photos
from autoreg.calibration.pipeline import calibrate, calibrate_views
from autoreg.calibration.starting import first_state
from autoreg.calibration.synthetic import BoardScene, random_pose, render_board, true_corners
from autoreg.camera import Camera
from autoreg.errors import AutoregError

T = TypeVar("T")
BOARD = Board(9, 6, 0.025, True)
_K = (1000.0, 1003.0, 655.0, 468.0)
# Lenses such as people calibrate: (fx, fy, cx, cy) for 1280 x 960, and OpenCV's coefficients.
LENSES = {
    "none": (_K, (0.0, 0.0, 0.0, 0.0, 0.0)),
    "barrel": (_K, (-0.2, 0.05, 0.0005, -0.0003, 0.0)),
    "pincushion": (_K, (0.08, 0.02, 0.0, 0.0, 0.0)),
    "weak tangential": (_K, (-0.2, 0.05, 0.0, 0.0, 0.0)),
    "phone": ((1150.0, 1149.0, 644.0, 471.0), (0.08, -0.2, 0.0002, 0.0004, 0.12)),
    "rational": ((700.0, 700.0, 630.0, 490.0), (0.3, 0.02, 0.0002, -0.0001, 0.0, 0.62, 0.1, 0.0)),
}
# A lens whose tangential terms are drawn anew in every run, from invisible to plain.
_WEAK, _TANGENTIAL = "weak tangential", (10**-4.5, 10**-3.3)
# Photos per set, and how many sets of so many.
COUNTS = ((8, 90), (15, 90), (40, 30))
PUBLISHED = {
    "opencv_left": (535.916, 535.916, 342.283, 235.571),
    "opencv_right": (534.803, 534.803, 334.557, 242.053),
    "carnd_lane": (1157.779, 1152.823, 667.111, 386.129),
    "phone_iphone3gs": None,
}


def lens(name: str, rng: np.random.Generator | None = None) -> Camera:
    """The camera of a lens; `rng` draws what differs from run to run."""
    k, dist = LENSES[name]
    if name == _WEAK and rng is not None:
        low, high = (float(np.log(size)) for size in _TANGENTIAL)
        signs, sizes = rng.choice([-1, 1], 2), rng.uniform(low, high, 2)
        p1, p2 = signs * np.exp(sizes)
        dist = (dist[0], dist[1], float(p1), float(p2), 0.0)
    return Camera(1280, 960, *k, dist)


def detection(photos: int = 55) -> None:
    """Coarse to fine in parallel against findChessboardCorners at full resolution, decoding included."""
    camera = lens("barrel").scaled(4000, 3000)
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        files: list[Path] = []
        for k in range(photos):
            blur, noise = rng.uniform(0.8, 2.5), rng.uniform(2, 8)
            pose = random_pose(camera, BOARD, rng)
            scene = BoardScene(camera, BOARD, pose, blur_px=blur, noise_grey=noise, samples=1, seed=k)
            files.append(Path(folder) / f"{k:02}.jpg")
            cv2.imwrite(str(files[-1]), render_board(scene), [cv2.IMWRITE_JPEG_QUALITY, 92])
        for file in files:
            file.read_bytes()
        plain, plain_s = _timed(lambda: [_plain(file) for file in files])
        found, ours_s = _timed(lambda: search_photos(files, BOARD))
        _, single_s = _timed(lambda: search_photos(files, BOARD, workers=1))
    hits = sum(photo.detection.found for photo in found)
    print(
        f"detection, {photos} photos of 12 megapixels, {os.cpu_count()} processors, seconds (of processors)"
    )
    print(f"  findChessboardCorners at full resolution  {plain_s}  {sum(plain)} found")
    print(f"  coarse to fine, in parallel               {ours_s}  {hits} found")
    print(f"  coarse to fine, one photo at a time       {single_s}")


def _timed(run: Callable[[], T]) -> tuple[T, str]:
    """What a run gives, and how long it took by the clock and by all processors together."""
    begun, busy = time.perf_counter(), time.process_time()
    result = run()
    return result, f"{time.perf_counter() - begun:7.2f} ({time.process_time() - busy:7.2f})"


def _plain(file: Path) -> bool:
    gray = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    assert gray is not None
    found, corners = cv2.findChessboardCorners(gray, (BOARD.columns, BOARD.rows))
    if found:
        cv2.cornerSubPix(gray, corners, (11, 11), (-1, -1), (3, 30, 0.001))
    return bool(found)


@dataclass(frozen=True)
class Run:
    """One calibration of synthetic views: the error of K, its covariance, and the noise put in and found."""

    photos: int
    model: str
    error: np.ndarray
    covariance: np.ndarray
    noise_px: float
    sigma_px: float

    @property
    def inside(self) -> np.ndarray:
        """Which of fx, fy, cx, cy lie inside their 95 % interval."""
        return np.abs(self.error) <= 1.96 * np.sqrt(self.covariance.diagonal())

    @property
    def score(self) -> float:
        """Squared error of K by its covariance; a chi-square of 4 degrees of freedom if that is right."""
        return float(self.error @ np.linalg.solve(self.covariance, self.error))


def coverage() -> None:
    """How often the true K lies inside the stated 95 % intervals, from corners with Gaussian noise."""
    print("coverage of the 95 % intervals, corners with noise of 0.05 to 0.4 px, percent ± binomial error")
    for name in LENSES:
        runs = [synthetic(name, count, k) for count, times in COUNTS for k in range(times)]
        tell(name, runs)


def rendered(runs: int = 40, photos: int = 15) -> None:
    """The same from rendered photos of 640 x 480, detection included."""
    print("coverage of the 95 % intervals, rendered photos, percent ± binomial error")
    for name in ("barrel", "phone"):
        found = [from_photos(name, photos, k) for k in range(runs)]
        tell(name, found)
        stated = np.array([run.sigma_px / run.noise_px for run in found])
        print(
            f"    corners' noise as the fit estimates it over what it is: {stated.mean():.3f} "
            f"± {stated.std() / np.sqrt(runs):.3f}; it is {np.mean([r.noise_px for r in found]):.4f} px",
            flush=True,
        )


def tell(name: str, runs: list[Run]) -> None:
    """Print how often the intervals of some runs held, and how wide they are against the errors."""
    inside = np.array([run.inside for run in runs])
    share, count = inside.mean(0), len(runs)
    each = ", ".join(
        f"{parameter} {100 * p:.1f} ± {100 * np.sqrt(p * (1 - p) / count):.1f}"
        for parameter, p in zip(INTRINSICS, share, strict=False)
    )
    # Runs differ in noise and in number of photos, and with them in error; so each is taken by its own scale.
    scale = np.array([run.noise_px / np.sqrt(run.photos) for run in runs])[:, None]
    width = np.sqrt(np.mean(np.array([run.covariance.diagonal() for run in runs]) / scale**2, axis=0))
    rmse = np.sqrt(np.mean((np.array([run.error for run in runs]) / scale) ** 2, axis=0))
    together = np.mean([run.score <= chi2.ppf(0.95, 4) for run in runs])
    models = [run.model for run in runs]
    picked = ", ".join(f"{m} {models.count(m)}" for m in sorted(set(models), key=models.count, reverse=True))
    print(
        f"  {name}, {count} sets: {each}; of all {100 * share.mean():.1f}, the four together "
        f"{100 * together:.1f}\n    stated sigma over actual error, both RMS: "
        + " ".join(f"{ratio:.2f}" for ratio in width / rmse)
        + f"; models: {picked}",
        flush=True,
    )


def synthetic(name: str, count: int, run: int) -> Run:
    """A calibration of exact corners with noise."""
    rng = np.random.default_rng([7, list(LENSES).index(name), count, run])
    camera = lens(name, rng)
    noise_px = float(np.exp(rng.uniform(np.log(0.05), np.log(0.4))))
    seen: list[BoardView] = []
    for k in range(count):
        px = camera.project(random_pose(camera, BOARD, rng).apply(BOARD.points))
        seen.append(BoardView(str(k), np.arange(BOARD.corners), px + rng.normal(0, noise_px, px.shape)))
    return _run(camera, seen, noise_px)


def from_photos(name: str, count: int, run: int) -> Run:
    """A calibration of rendered photos; the corners' noise is what detection makes of the sensor's."""
    rng = np.random.default_rng([8, list(LENSES).index(name), run])
    camera = lens(name, rng).scaled(640, 480)
    seen: list[BoardView] = []
    squares: list[float] = []
    while len(seen) < count:
        scene = BoardScene(
            camera, BOARD, random_pose(camera, BOARD, rng), blur_px=0.9, noise_grey=6,
            seed=int(rng.integers(2**31)),
        )  # fmt: skip
        found = find_board(render_board(scene), BOARD)
        if found.found:
            off = found.corners_px - true_corners(scene)[found.ids]
            squares.append(float(np.mean(off**2)))
            seen.append(BoardView(str(len(seen)), found.ids, found.corners_px))
    return _run(camera, seen, float(np.sqrt(np.mean(squares))))


def _run(camera: Camera, seen: list[BoardView], noise_px: float) -> Run:
    found = calibrate_views(seen, BOARD, camera.width, camera.height)
    error = found.fit.state.intrinsics[:4] - intrinsics_of(camera)[:4]
    return Run(
        len(seen), found.model.name, error, found.precision.covariance[:4, :4], noise_px, found.fit.sigma_px
    )


def bad(runs: int = 100, views: int = 15) -> None:
    """How often a planted bad view is found, and how often a good one is taken for bad."""
    camera = lens("barrel")
    for kind in ("blurred", "bent", "shifted", "none"):
        found = wrong = crashed = 0
        for run in range(runs):
            rng = np.random.default_rng([11, run])
            seen = _views_with_bad(camera, rng, views, kind)
            try:
                data = data_of(seen, BOARD)
                names = [b.name for b in sift(data, first_state(data, camera.width, camera.height)).bad]
            except (AutoregError, ValueError, np.linalg.LinAlgError):
                crashed += 1
                continue
            found += "bad" in names
            wrong += len([name for name in names if name != "bad"])
        print(f"bad view, {kind}: found in {found} of {runs}, good views left out {wrong}, crashes {crashed}")


def _views_with_bad(camera: Camera, rng: np.random.Generator, count: int, kind: str) -> list[BoardView]:
    views: list[BoardView] = []
    for k in range(count):
        points, sigma, name = BOARD.points.copy(), 0.1, str(k)
        if k == count // 2 and kind != "none":
            name = "bad"
            if kind == "blurred":
                sigma = 0.4
            if kind == "bent":
                u, v = BOARD.centred.T
                points[:, 2] += 0.05 * 4 * BOARD.square * (u * u - 0.5 * v)
        px = camera.project(random_pose(camera, BOARD, rng, most_tilt_deg=40).apply(points))
        px = px + rng.normal(0, sigma, px.shape)
        if name == "bad" and kind == "shifted":
            px[: BOARD.columns] += [3.0, 0.0]
        views.append(BoardView(name, np.arange(BOARD.corners), px))
    return views


def wrong(runs: int = 50, views: int = 20) -> None:
    """Whole calibrations of which one view in twenty is nonsense: other places, another order, one line."""
    camera = lens("barrel")
    ended: Counter[str] = Counter()
    kept = 0
    errors: list[float] = []
    for run in range(runs):
        rng = np.random.default_rng([12, run])
        seen = _views_with_bad(camera, rng, views, "none")
        for k in rng.choice(views, views // 20, replace=False):
            px = {
                "anywhere": rng.uniform([0, 0], [camera.width, camera.height], (BOARD.corners, 2)),
                "in another order": rng.permutation(seen[k].corners_px),
                "on a line": np.linspace([100.0, 100.0], [900.0, 700.0], BOARD.corners),
                "of another board": seen[k].corners_px[::-1] * [0.5, 1.0],
            }[str(rng.choice(["anywhere", "in another order", "on a line", "of another board"]))]
            seen[k] = BoardView("wrong", seen[k].ids, px)
        try:
            found = calibrate_views(seen, BOARD, camera.width, camera.height)
        except AutoregError as error:
            ended[f"refused: {str(error)[:40]}"] += 1
            continue
        ended[found.verdict.grade] += 1
        kept += found.data.names.count("wrong")
        sd = found.precision.std_devs[:4]
        errors.append(float(np.max(np.abs(found.fit.state.intrinsics[:4] - intrinsics_of(camera)[:4]) / sd)))
    print(
        f"one view in twenty is nonsense, {runs} sets: {dict(ended)}; such views kept {kept}, "
        f"K off by at most {max(errors, default=0):.1f} standard deviations"
    )


def published() -> None:
    """The sets that others published, against their values."""
    shared = Path(os.environ.get("CHESSBOARDS", Path(__file__).parents[2] / "shared" / "chessboards"))
    for name, values in PUBLISHED.items():
        if not (shared / name).is_dir():
            print(f"published, {name}: {shared / name} is missing")
            continue
        begun = time.perf_counter()
        found = calibrate(shared / name, "9x6")
        took = time.perf_counter() - begun
        k = found.fit.state.intrinsics[:4]
        against = "no published value"
        if values is not None:
            focal = [100 * (a / b - 1) for a, b in zip(k[:2], values[:2], strict=True)]
            centre = [a - b for a, b in zip(k[2:], values[2:], strict=True)]
            against = (
                f"focal {focal[0]:+.2f} % {focal[1]:+.2f} %, centre {centre[0]:+.2f} {centre[1]:+.2f} px "
                "against published"
            )
        print(
            f"published, {name}: {len(found.data)} views, {found.model.name}, fx fy cx cy "
            + " ".join(f"{value:.2f}" for value in k)
            + f", {against}; RMS {found.rms_px:.3f} px, per view at most {found.fit.view_rms_px.max():.2f}, "
            f"{found.verdict.grade}, {took:.1f} s"
        )
        for reason in found.verdict.reasons:
            print(f"    {reason}")


def main() -> None:
    known = (published, bad, wrong, detection, rendered, coverage)
    measures = {measure.__name__: measure for measure in known}
    for name in sys.argv[1:] or measures:
        measures[name]()


if __name__ == "__main__":
    main()
