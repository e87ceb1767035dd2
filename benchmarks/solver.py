"""Measures the solver: compiling it, fetching it from the cache, and solves of several sizes; prints a table.

Each start is a process of its own. The problems are synthetic: joints in front of a camera, a tenth of a
pixel of noise, 15 % of them anywhere within 8 px, and a start that is some pixels off.

    python benchmarks/solver.py [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

# The script runs from a checkout, whether or not autoreg is installed.
sys.path[:0] = [str(Path(__file__).parents[1])]

from autoreg.camera import Camera  # noqa: E402
from autoreg.geometry import Rigid, rotation_from_vector  # noqa: E402
from autoreg.residuals import PARAMETERS, JointData  # noqa: E402
from autoreg.solver import CAUCHY_SIGMAS, solve_joints, warm_up  # noqa: E402

CAMERA = Camera(1600, 1200, 1300.0, 1290.0, 810.0, 590.0, (-0.12, 0.04, 0.0005, -0.0004))
# Looks down by 35° from 1.6 m.
TRUTH = Rigid(rotation_from_vector(np.array([np.deg2rad(125), 0.0, 0.0])), np.array([0.1, 0.0, 2.8]))
FREE = {"pose": np.r_[np.ones(6), np.zeros(5)], "pose, ratio, focal": np.r_[np.ones(8), np.zeros(3)]}
SIZES, PROBLEMS, STARTS = (100, 500, 2048), 12, 2
NOISE_PX, WILD_PX, WILD_SHARE = 0.1, 8.0, 0.15

CHILD = """
import pathlib, sys, time
sys.path[:0] = [sys.argv[1]]
from autoreg import solver
solver.enable_compilation_cache(pathlib.Path(sys.argv[2]))
began, worked = time.perf_counter(), time.process_time()
solver.warm_up()
print(time.perf_counter() - began, time.process_time() - worked)
"""


def problem(seed: int, n: int) -> JointData:
    """Joints measured with noise, and a pose beside the true one."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform([-1.2, -0.6], [1.2, 2.5], (n, 2)), np.zeros(n)])
    along = np.where(np.arange(n)[:, None] % 2, [1e-4, 0.0, 0.0], [0.0, 1e-4, 0.0])
    seen = CAMERA.project(TRUTH.apply(points))
    tangent = CAMERA.project(TRUTH.apply(points + along)) - seen
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    noise = NOISE_PX * rng.normal(size=n)
    noise = np.where(rng.random(n) < WILD_SHARE, rng.uniform(-WILD_PX, WILD_PX, n), noise)
    turn = rotation_from_vector(0.002 * rng.normal(size=3))
    return JointData(
        ground=points[:, :2],
        measured_px=seen + noise[:, None] * normal,
        normal=normal,
        weight=np.full(n, 1 / (CAUCHY_SIGMAS * NOISE_PX)),
        R=turn @ TRUTH.R,
        t=turn @ TRUTH.t + 0.005 * rng.normal(size=3),
        intrinsics=np.array([CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, *CAMERA.dist]),
        scale=np.array([1.0] * 3 + [1.6] * 3 + [1.0, 1.0, CAMERA.fx, CAMERA.fx, 1.0]),
    )


def start_times() -> dict[str, tuple[float, float]]:
    """Seconds on the clock and of the processor for a first start and for one from the cache."""
    root = Path(__file__).parents[1]
    cold, cached = [], []
    for _ in range(STARTS):
        with tempfile.TemporaryDirectory() as folder:
            for times in (cold, cached):
                command = [sys.executable, "-W", "ignore", "-c", CHILD, str(root), folder]
                done = subprocess.run(command, capture_output=True, text=True, check=True)
                times.append(tuple(float(word) for word in done.stdout.split()))
    return {"compile": min(cold), "from the cache": min(cached)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there as well")
    arguments = parser.parse_args()
    report: dict[str, object] = {}
    for name, (clock, processor) in start_times().items():
        report[name] = {"clock_s": clock, "processor_s": processor}
        print(f"{name:<16} {clock:6.2f} s   (processor {processor:.2f} s)")
    warm_up()
    print(f"\n{'free':<20}{'joints':>8}{'median ms':>11}{'worst ms':>10}{'steps':>7}{'converged':>11}")
    rows = []
    for free_name, free in FREE.items():
        assert free.shape == (PARAMETERS,)
        for n in SIZES:
            times, solutions = [], []
            for seed in range(PROBLEMS):
                data = problem(seed, n)
                began = time.perf_counter()
                solutions.append(solve_joints(data, free))
                times.append(1e3 * (time.perf_counter() - began))
            median, worst = statistics.median(times), max(times)
            steps = statistics.median(s.steps for s in solutions)
            converged = sum(s.outcome == "converged" for s in solutions)
            print(f"{free_name:<20}{n:>8}{median:>11.2f}{worst:>10.2f}{steps:>7g}{converged:>8}/{PROBLEMS}")
            rows.append(
                {"free": free_name, "joints": n, "median_ms": median, "worst_ms": worst, "steps": steps}
                | {"converged": converged, "problems": PROBLEMS}
            )
    report["solves"] = rows
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
