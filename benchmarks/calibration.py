"""Coverage of the stated uncertainty: does the truth lie where the covariance says it does?

Draws synthetic pavings with exact truth, fits each from near the truth, and prints how often the 95 %
ellipsoids of the rotation and of the pose hold the truth, and the median normalised squared errors, which
should be those of chi-squares with 3 and 6 degrees of freedom (2.4 and 5.3).

    python benchmarks/calibration.py --scenes 20
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import chi2

sys.path.insert(0, str(Path(__file__).parents[1]))

from autoreg.camera import Camera
from autoreg.geometry import vector_from_rotation
from autoreg.image import as_gray
from autoreg.refine import Free, refine_until_still
from autoreg.stations import Grid
from autoreg.synthetic import SyntheticScene, look_at_ground, render_paving
from autoreg.uncertainty import check_camera, settle


@dataclass(frozen=True)
class Regime:
    """A kind of paving: jitter and side of the slabs in metres, and the joints' width."""

    name: str
    jitter_m: float
    side_m: float
    joint_m: float = 0.012


REGIMES = (
    Regime("even, many", 0.0, 0.3),
    Regime("even, few", 0.0, 1.0),
    Regime("irregular, many", 0.0015, 0.3),
    Regime("irregular", 0.0015, 0.5),
    Regime("irregular, few", 0.002, 1.0),
)


@dataclass(frozen=True)
class Outcome:
    """Normalised squared errors of one scene, and what its joints said of its camera."""

    rotation: float
    pose: float
    focal: float
    consistent: bool
    rotation_deg: float


def draw(regime: Regime, seed: int) -> SyntheticScene:
    """A random scene of a regime."""
    rng = np.random.default_rng(seed)
    camera = Camera.from_focal(800, 600, float(rng.uniform(560, 800)))
    pose = look_at_ground(
        pitch_deg=rng.uniform(25, 65),
        height_m=rng.uniform(1.3, 2.2),
        heading_deg=rng.uniform(0, 90),
        roll_deg=rng.uniform(-5, 5),
        foot_m=(rng.uniform(0, 1), rng.uniform(0, 1)),
    )
    return SyntheticScene(
        camera=camera,
        cam_from_ground=pose,
        spacing_m=(regime.side_m, regime.side_m),
        joint_width_m=regime.joint_m,
        jitter_m=regime.jitter_m,
        noise_grey=rng.uniform(1, 3),
        texture=rng.uniform(0.02, 0.06),
        colour=False,
        seed=seed,
    )


def measure(scene: SyntheticScene) -> Outcome | None:
    """What the fit of a scene's photo states, against the truth; None where nothing could be fitted."""
    gray = as_gray(render_paving(scene).pixels).astype(np.float32)
    true = scene.cam_from_ground
    fit = refine_until_still(
        gray, scene.camera, true, Grid(*scene.spacing_m, scene.shift), free=Free(), search=0.04, reach=12.0
    )
    if fit is None:
        return None
    settled = settle(fit)
    pose, C = settled.fit.cam_from_ground, settled.covariance
    error = np.r_[vector_from_rotation(pose.R @ true.R.T), pose.t - true.t]
    check = check_camera(fit)
    return Outcome(
        rotation=float(error[:3] @ np.linalg.solve(C[:3, :3], error[:3])),
        pose=float(error @ np.linalg.solve(C, error)),
        focal=float(((check.focal_px - scene.camera.fx) / check.focal_sigma_px) ** 2),
        consistent=check.consistent,
        rotation_deg=float(np.rad2deg(np.linalg.norm(error[:3]))),
    )


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Coverage of the stated uncertainty.")
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    print("                      covered by 95 %         median nees        rot    false")
    print("regime          n   rotation  pose  focal   rotation   pose     deg    alarms")
    limits = chi2.ppf(0.95, [3, 6, 1])
    for regime in REGIMES:
        drawn = (measure(draw(regime, 1000 * options.seed + k)) for k in range(options.scenes))
        found = [outcome for outcome in drawn if outcome is not None]
        if not found:
            print(f"{regime.name:15s} nothing fitted")
            continue
        nees = np.array([(o.rotation, o.pose, o.focal) for o in found])
        covered, middle = (nees < limits).mean(0), np.median(nees, axis=0)
        alarms, degrees = sum(not o.consistent for o in found), np.median([o.rotation_deg for o in found])
        print(
            f"{regime.name:15s} {len(found):3d} {covered[0]:7.2f} {covered[1]:7.2f} {covered[2]:6.2f}"
            f" {middle[0]:9.1f} {middle[1]:7.1f} {degrees:9.4f} {alarms:6d}",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
