"""Measure calibration: detection time, coverage of the intervals, bad views, published sets.

Run from the project's root: `python benchmarks/chessboards.py [detection] [coverage] [bad] [published]`.
The published sets are looked for in ../shared/chessboards, or in the folder named by CHESSBOARDS.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

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
from autoreg.calibration.result import Calibration
from autoreg.calibration.starting import first_state
from autoreg.calibration.synthetic import BoardScene, random_pose, render_board
from autoreg.camera import Camera
from autoreg.errors import AutoregError

BOARD = Board(9, 6, 0.025, True)
# Lenses such as people calibrate: (fx, fy, cx, cy) for 1280 x 960, and OpenCV's coefficients.
LENSES = {
    "barrel": ((1000, 1003, 655, 468), (-0.2, 0.05, 0.0005, -0.0003, 0.0)),
    "strong": ((820, 820, 630, 490), (-0.26, 0.08, -0.0004, 0.0002, -0.008)),
    "phone": ((1150, 1149, 644, 471), (0.08, -0.2, 0.0002, 0.0004, 0.12)),
    "long": ((2400, 2402, 633, 485), (-0.05, 0.0, 0.0, 0.0, 0.0)),
}
PUBLISHED = {
    "opencv_left": (535.916, 535.916, 342.283, 235.571),
    "opencv_right": (534.803, 534.803, 334.557, 242.053),
    "carnd_lane": (1157.779, 1152.823, 667.111, 386.129),
    "phone_iphone3gs": None,
}


def lens(name: str) -> Camera:
    k, dist = LENSES[name]
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
        begun = time.perf_counter()
        plain = [_plain(file) for file in files]
        plain_s = time.perf_counter() - begun
        begun = time.perf_counter()
        found = search_photos(files, BOARD)
        ours_s = time.perf_counter() - begun
        begun = time.perf_counter()
        search_photos(files, BOARD, workers=1)
        single_s = time.perf_counter() - begun
    hits = sum(photo.detection.found for photo in found)
    print(f"detection, {photos} photos of 12 megapixels, {os.cpu_count()} processors")
    print(f"  findChessboardCorners at full resolution  {plain_s:7.2f} s  {sum(plain)} found")
    print(f"  coarse to fine, in parallel               {ours_s:7.2f} s  {hits} found")
    print(f"  coarse to fine, one photo at a time       {single_s:7.2f} s")


def _plain(file: Path) -> bool:
    gray = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    found, corners = cv2.findChessboardCorners(gray, (BOARD.columns, BOARD.rows))
    if found:
        cv2.cornerSubPix(gray, corners, (11, 11), (-1, -1), (3, 30, 0.001))
    return bool(found)


def coverage(runs: int = 100, views: int = 15, *, rendered: bool = True) -> None:
    """How often the true K lies inside the stated 95 % intervals."""
    for name in LENSES:
        camera, inside, together, models = lens(name), [], [], []
        for run in range(runs):
            found = _synthetic(camera, run, views, rendered=rendered)
            error = found.fit.state.intrinsics[:4] - intrinsics_of(camera)[:4]
            covariance = found.precision.covariance[:4, :4]
            inside.append(np.abs(error) <= 1.96 * np.sqrt(covariance.diagonal()))
            together.append(error @ np.linalg.solve(covariance, error) <= chi2.ppf(0.95, 4))
            models.append(found.model.name)
        counts = ", ".join(f"{n} {100 * p:.0f}" for n, p in zip(INTRINSICS, np.mean(inside, 0), strict=False))
        picked = ", ".join(f"{m}: {models.count(m)}" for m in dict.fromkeys(models))
        kind = "rendered photos" if rendered else "corners with noise of 0.15 px"
        print(
            f"coverage, {name}, {runs} runs of {views} {kind}: {counts}; all four together "
            f"{100 * np.mean(together):.0f}, of all intervals {100 * np.mean(inside):.1f} % ({picked})",
            flush=True,
        )


def _synthetic(camera: Camera, run: int, views: int, *, rendered: bool) -> Calibration:
    rng = np.random.default_rng([7, run])
    seen: list[BoardView] = []
    while len(seen) < views:
        pose = random_pose(camera, BOARD, rng)
        if rendered:
            scene = BoardScene(camera, BOARD, pose, blur_px=0.9, noise_grey=6, seed=len(seen) + 1000 * run)
            found = find_board(render_board(scene), BOARD)
            if found.found:
                seen.append(BoardView(str(len(seen)), found.ids, found.corners_px))
        else:
            px = camera.project(pose.apply(BOARD.points)) + rng.normal(0, 0.15, (BOARD.corners, 2))
            seen.append(BoardView(str(len(seen)), np.arange(BOARD.corners), px))
    return calibrate_views(seen, BOARD, camera.width, camera.height)


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
    wanted = sys.argv[1:] or ["published", "bad", "detection", "coverage"]
    for name in wanted:
        {"detection": detection, "coverage": coverage, "bad": bad, "published": published}[name]()


if __name__ == "__main__":
    main()
