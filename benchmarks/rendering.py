"""How exactly the final render meets the fitted camera, and what it costs beside POV-Ray itself.

    python benchmarks/rendering.py [--cameras 40] [--seed 1] [--engine povray|preview] [--cost]

Closed loop: joints are rendered through random cameras, found again in the layer, and compared with where the
camera model puts them. Cost: a scene of 2 megapixels by `render`, against the same POV-Ray runs alone.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

# The script runs from a checkout, whether or not autoreg is installed.
sys.path[:0] = [str(Path(__file__).parents[1])]

from autoreg.alignment import Alignment, CameraReport, Pose, Residual  # noqa: E402
from autoreg.camera import Camera  # noqa: E402
from autoreg.geometry import Rigid  # noqa: E402
from autoreg.lattice import Lattice  # noqa: E402
from autoreg.rendering import povray  # noqa: E402
from autoreg.rendering.check import check_render  # noqa: E402
from autoreg.rendering.demo import demo_objects  # noqa: E402
from autoreg.rendering.engine import Plan  # noqa: E402
from autoreg.rendering.objects import Scene  # noqa: E402
from autoreg.rendering.render import choose_engine, plan_render, render  # noqa: E402
from autoreg.rendering.staging import stage  # noqa: E402
from autoreg.synthetic import look_at_ground  # noqa: E402
from autoreg.view import View  # noqa: E402

LIMIT_RMS_PX, LIMIT_MAX_PX, LIMIT_COST = 0.02, 0.1, 1.3


def random_camera(rng: np.random.Generator) -> tuple[Camera, float]:
    """A camera and its tilt in degrees: unequal focal lengths, off-centre, portrait, strong distortion."""
    width, height = (1600, 1200) if rng.uniform() < 0.6 else (1200, 1600)
    fx = rng.uniform(0.6, 1.6) * max(width, height)
    centre = 0.5 * np.array([width - 1, height - 1]) + rng.uniform(-0.4, 0.4, 2) * [width, height]
    dist = ()
    if rng.uniform() < 0.6:
        # Strong at the farthest corner, whatever the focal length, and one-to-one up to there.
        corner = np.abs(np.array([[-0.5, -0.5], [width - 0.5, height - 0.5]]) - centre).max(0) / fx
        r2 = float(corner @ corner)
        k1 = rng.uniform(-0.22, 0.18) / r2
        dist = (k1, rng.uniform(0.0, 0.05) / r2**2, *(rng.uniform(-2e-3, 2e-3, 2) / np.sqrt(r2)), 0.0)
    fy, (cx, cy) = fx * rng.uniform(0.85, 1.18), centre
    camera = Camera(width, height, fx, fy, float(cx), float(cy), tuple(map(float, dist)))
    return camera, float(rng.uniform(5.0, 89.0))


def aligned(camera: Camera, cam_from_ground: Rigid, side: tuple[float, float]) -> Alignment:
    """An alignment that is exact, with a field all around what the camera sees."""
    view = View(camera, cam_from_ground)
    u, v = np.meshgrid(np.linspace(0, camera.width - 1, 20), np.linspace(0, camera.height - 1, 20))
    ground = view.ground_under(np.stack([u, v], -1)).reshape(-1, 2)
    near = np.linalg.norm(ground - view.eye[:2], axis=1) < 12 * view.eye[2]
    low, high = ground[near].min(0), ground[near].max(0)
    field = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    lattice = Lattice("running", *side, 0.5, 0.008, field)
    return Alignment(
        camera.width,
        camera.height,
        CameraReport(camera, "file", None, None, None),
        Pose(cam_from_ground, 1e-8 * np.eye(6)),
        "slab",
        lattice,
        Residual(0.1, 0.1, 0.2, 10, 100, 1.0),
        (),
    )


def plan_of(found: Alignment, scene: Scene, photo: np.ndarray) -> Plan:
    view = View(found.camera.camera, found.pose.cam_from_ground)
    return plan_render(found, stage(scene, view, found.lattice, photo), photo)


def closed_loop(count: int, seed: int, engine_name: str) -> bool:
    """Print one line for each camera, and the worst."""
    rng = np.random.default_rng(seed)
    worst_rms, worst_max = 0.0, 0.0
    with tempfile.TemporaryDirectory() as folder:
        engine = choose_engine("preview" if engine_name == "preview" else "povray", Path(folder))
        for n in range(count):
            camera, tilt = random_camera(rng)
            pose = look_at_ground(
                pitch_deg=tilt,
                height_m=rng.uniform(1.0, 4.0),
                roll_deg=rng.uniform(-30, 30),
                heading_deg=rng.uniform(0, 360),
                foot_m=tuple(rng.uniform(-2, 2, 2)),
            )
            found = aligned(camera, pose, (0.6, 0.4))
            photo = np.full((camera.height, camera.width, 3), 128, np.uint8)
            check = check_render(engine, plan_of(found, Scene(), photo))
            c = camera
            print(
                f"{n:3d}  {c.width:4d} x {c.height:4d}  "
                f"f {c.fx:6.0f} {c.fy:6.0f}  c {c.cx:6.0f} {c.cy:6.0f}  "
                f"tilt {tilt:4.1f}  k1 {c.dist[0]:6.3f}  "
                + ("no joint to mark" if check is None else
                   f"rms {check.rms_px:.4f}  max {check.max_px:.4f}  of {check.samples}"),
                flush=True,
            )  # fmt: skip
            if check is not None:
                worst_rms, worst_max = max(worst_rms, check.rms_px), max(worst_max, check.max_px)
    print(
        f"worst: rms {worst_rms:.4f} px (limit {LIMIT_RMS_PX}), max {worst_max:.4f} px (limit {LIMIT_MAX_PX})"
    )
    return worst_rms <= LIMIT_RMS_PX and worst_max <= LIMIT_MAX_PX


def cost() -> bool:
    """Print what `render` takes beside the POV-Ray runs that it consists of, for both kinds of lens."""
    good = True
    for dist in ((), (-0.12, 0.04, 3e-4, -2e-4)):
        camera = Camera(1640, 1230, 1480.0, 1484.0, 826.0, 608.0, dist)
        pose = look_at_ground(pitch_deg=27.0, height_m=1.6, heading_deg=20.0, foot_m=(0.1, 0.2))
        found = aligned(camera, pose, (0.6, 0.4))
        rng = np.random.default_rng(0)
        photo = rng.integers(90, 190, (camera.height, camera.width, 3)).astype(np.uint8)
        objects = demo_objects(View(camera, pose), found.lattice)
        with tempfile.TemporaryDirectory() as folder:
            inside, alone = 0.0, 0.0
            run = povray.run_povray

            def timed(*args: Any, run: Any = run, **options: Any) -> None:
                nonlocal alone, inside
                begun = time.monotonic()
                run(*args, **options)
                inside += time.monotonic() - begun
                # The very same pass once more, by POV-Ray alone.
                begun = time.monotonic()
                subprocess.run([args[0], *args[1]], cwd=args[2], capture_output=True, check=True)
                alone += time.monotonic() - begun

            povray.run_povray = timed
            begun = time.monotonic()
            render(choose_engine("povray", Path(folder)), plan_of(found, Scene(objects), photo), photo)
            whole = time.monotonic() - begun - alone
            povray.run_povray = run
        kind = "bent lens" if dist else "pinhole"
        print(f"{kind:10} render {whole:6.2f} s, POV-Ray alone {alone:6.2f} s: {whole / alone:.2f} times")
        good &= whole <= LIMIT_COST * alone
    return good


def main() -> int:
    """Run what was asked for; exit code 1 if a limit is missed."""
    parser = argparse.ArgumentParser(description="Exactness and cost of the final render.")
    parser.add_argument("--cameras", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--engine", choices=("povray", "preview"), default="povray")
    parser.add_argument("--cost", action="store_true", help="Only measure the cost.")
    options = parser.parse_args()
    if options.cost:
        return 0 if cost() else 1
    return 0 if closed_loop(options.cameras, options.seed, options.engine) else 1


if __name__ == "__main__":
    sys.exit(main())
