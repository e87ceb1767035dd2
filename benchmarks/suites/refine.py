"""The last stage by itself, beside line solvers of others on the same picture from the same start."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from autoreg.camera import Camera
from autoreg.fitting.refine import refine
from autoreg.geometry import Rigid, angle_between_rotations
from autoreg.solve.batch_solver import solve_batch
from autoreg.solve.freedom import Free
from autoreg.solve.joint_data import JointData
from autoreg.solve.solver import solve_joints
from autoreg.synthetic import SyntheticScene, look_at_ground, render_paving
from benchmarks.last_stage import crossings_error_px, crossings_of, finish, grid_of, nudged
from benchmarks.metrics import Figure
from benchmarks.options import Options
from benchmarks.peers import (
    GATES_PX,
    Edges,
    Solve,
    as_joint_data,
    lsd_segments,
    match_edges,
    refine_with,
    solve_poselib,
    solve_scipy,
)
from benchmarks.result import Result, Table

TURN_DEG, MOVE = 0.5, 0.01
SEGMENTS, REPEATS, BATCH = 300, 5, 64


@dataclass(frozen=True)
class Row:
    """One method's errors on every scene it finished, and its time for a solve."""

    name: str
    degrees: tuple[float, ...]
    pixels: tuple[float, ...]
    solve_ms: float

    def medians(self) -> tuple[float, float]:
        """Median rotation error and crossings' error."""
        if not self.degrees:
            return np.inf, np.inf
        return float(np.median(self.degrees)), float(np.median(self.pixels))


def draw(seed: int, *, quick: bool) -> SyntheticScene:
    """A printed stack bond whose joints are some pixels wide, so that each has two edges."""
    rng = np.random.default_rng([21, seed])
    width, height = (800, 600) if quick else (1280, 960)
    pose = look_at_ground(
        pitch_deg=rng.uniform(30, 60),
        height_m=rng.uniform(1.3, 2.0),
        heading_deg=rng.uniform(0, 90),
        roll_deg=rng.uniform(-3, 3),
        foot_m=(rng.uniform(0, 1), rng.uniform(0, 1)),
    )
    side = rng.uniform(0.3, 0.5)
    return SyntheticScene(
        camera=Camera.from_focal(width, height, rng.uniform(0.8, 1.1) * width),
        cam_from_ground=pose,
        spacing_m=(side, side * rng.uniform(0.8, 1.0)),
        joint_width_m=rng.uniform(0.012, 0.02),
        tone_spread=0.03,
        texture=0.02,
        noise_grey=1.5,
        colour=False,
        seed=seed,
    )


def ours(gray: np.ndarray, scene: SyntheticScene, start: Rigid) -> Rigid | None:
    """The last stage of autoreg from a start several pixels off: coarse to fine, then as `align` ends."""
    picture = gray.astype(np.float32)
    near = refine(
        picture, scene.camera, start, grid_of(scene), free=Free(), search=0.1, reaches=(3.0, 6.0, 12.0)
    )
    if near is None:
        return None
    done = finish(picture, scene.camera, near.cam_from_ground, grid_of(scene), search=0.0)
    return None if done is None else done.cam_from_ground


def peers() -> tuple[tuple[str, Solve], ...]:
    """The peers that are installed."""
    known: list[tuple[str, Solve]] = [("SciPy least_squares on LSD segments", solve_scipy)]
    if importlib.util.find_spec("poselib") is not None:
        known.insert(0, ("PoseLib line refinement on LSD segments", solve_poselib))
    return tuple(known)


def run(options: Options) -> Result:
    """Every method on every scene, then the time of one solve of 300 segments."""
    count = options.count(8, 40)
    scenes = [draw(seed, quick=options.quick) for seed in range(count)]
    errors: dict[str, list[tuple[float, float]]] = {"autoreg": [], **{name: [] for name, _ in peers()}}
    matched: list[tuple[Edges, Camera, Rigid]] = []
    for seed, scene in enumerate(scenes):
        gray = render_paving(scene).pixels
        true, ground = scene.cam_from_ground, crossings_of(scene)
        start = nudged(true, TURN_DEG, MOVE, np.random.default_rng([22, seed]))
        segments = lsd_segments(gray)
        found: dict[str, Rigid | None] = {"autoreg": ours(gray, scene, start)}
        for name, solve in peers():
            found[name] = refine_with(solve, segments, scene, start)
        for name, pose in found.items():
            if pose is not None:
                angle = float(np.rad2deg(angle_between_rotations(pose.R, true.R)))
                errors[name].append((angle, crossings_error_px(pose, scene, ground)))
        # A solve is timed from a tenth of the start's error, where the second round of matching begins.
        near = nudged(true, 0.1 * TURN_DEG, 0.1 * MOVE, np.random.default_rng([23, seed]))
        matched.append((match_edges(*segments, scene, near, GATES_PX[1]), scene.camera, near))
    problems = [_of_size(edges, SEGMENTS, k) for k, (edges, _, _) in enumerate(matched)]
    cases = [(edges, camera, near) for edges, (_, camera, near) in zip(problems, matched, strict=True)]
    times = {name: _peer_ms(solve, cases) for name, solve in peers()}
    data = [as_joint_data(*case) for case in cases]
    batch_ms, single_ms = _batch_ms(data), _single_ms(data)
    rows = [_row(name, errors[name], batch_ms if name == "autoreg" else times[name]) for name in errors]
    return _result(rows, single_ms, count, scenes[0].camera, options)


def _row(name: str, errors: Sequence[tuple[float, float]], solve_ms: float) -> Row:
    return Row(name, tuple(e[0] for e in errors), tuple(e[1] for e in errors), solve_ms)


def _of_size(edges: Edges, size: int, seed: int) -> Edges:
    """As many segments as asked for: drawn without repeating, or with where there are too few."""
    rng = np.random.default_rng([24, seed])
    rows = rng.choice(len(edges), size, replace=len(edges) < size)
    return replace(edges, ends_px=edges.ends_px[rows], ground=edges.ground[rows])


def _peer_ms(solve: Solve, cases: Sequence[tuple[Edges, Camera, Rigid]]) -> float:
    """Processor time of one solve, median of the scenes, each the best of some repeats."""
    times: list[float] = []
    for case in cases:
        best = np.inf
        for _ in range(REPEATS):
            began = time.process_time()
            solve(*case)
            best = min(best, time.process_time() - began)
        times.append(1e3 * best)
    return float(np.median(times))


POSE = Free().mask


def _batch_ms(data: Sequence[JointData]) -> float:
    """Processor time of one solve in a batch; the first call, which compiles, does not count."""
    batch = [data[k % len(data)] for k in range(BATCH)]
    solve_batch(batch, POSE)
    best = np.inf
    for _ in range(REPEATS):
        began = time.process_time()
        solve_batch(batch, POSE)
        best = min(best, time.process_time() - began)
    return 1e3 * best / BATCH


def _single_ms(data: Sequence[JointData]) -> float:
    """The same by the solver that a single photo uses, one by one."""
    solve_joints(data[0], POSE)
    times: list[float] = []
    for problem in data:
        began = time.process_time()
        solve_joints(problem, POSE)
        times.append(1e3 * (time.process_time() - began))
    return float(np.median(times))


def _result(rows: Sequence[Row], single_ms: float, count: int, camera: Camera, options: Options) -> Result:
    mine, others = rows[0], rows[1:]
    degrees, pixels = mine.medians()
    best_degrees = min(row.medians()[0] for row in others)
    best_pixels = min(row.medians()[1] for row in others)
    fastest = min(row.solve_ms for row in others)
    table = Table(
        f"{count} printed lattices of {camera.width} x {camera.height}, start {TURN_DEG}° and "
        f"{100 * MOVE:g} % off",
        (
            "method",
            "rotation, median °",
            "worst °",
            "crossings, median px",
            "worst px",
            "finished",
            "ms per solve",
        ),
        tuple(
            (
                row.name,
                f"{row.medians()[0]:.5f}",
                f"{max(row.degrees, default=np.nan):.4f}",
                f"{row.medians()[1]:.4f}",
                f"{max(row.pixels, default=np.nan):.3f}",
                f"{len(row.degrees)} of {count}",
                f"{row.solve_ms:.3f}",
            )
            for row in rows
        ),
    )
    missing = (
        () if len(others) > 1 else ("PoseLib is not installed (`pip install '.[bench]'`): not compared.",)
    )
    return Result(
        "refine",
        about=(
            "autoreg's last stage (edges, refinement, mixed model) against solvers on the segments of "
            "OpenCV's LSD at "
            "scale 1.0, matched anew in "
            f"{len(GATES_PX)} rounds with the edges of the joints, whose side the segment's contrast tells. "
            f"Times are processor time of one solve of {SEGMENTS} segments from 0.05° and 0.1 % off; "
            f"autoreg's is that of "
            f"`batch_solver`, {BATCH} problems at a time on the processor."
        ),
        figures=(
            Figure("refine.rotation", degrees),
            Figure("refine.crossings", pixels),
            Figure("refine.rotation_ratio", degrees / best_degrees),
            Figure("refine.crossings_ratio", pixels / best_pixels),
            Figure("refine.solve_ms", mine.solve_ms),
            Figure("refine.solve_ratio", mine.solve_ms / fastest),
        ),
        tables=(table,),
        notes=(
            f"autoreg's solver for single photos, padded to its fixed size, takes {single_ms:.1f} ms.",
            *missing,
        ),
    )
