"""Is the stated uncertainty true? Coverage of its 95 % regions over random pavings with exact truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import binom, chi2

from autoreg.camera import Camera
from autoreg.image import as_gray
from autoreg.slabs.camera_check import check_camera
from autoreg.synthetic import SyntheticScene, look_at_ground, render_paving
from benchmarks.last_stage import finish, grid_of, pose_error
from benchmarks.metrics import Figure
from benchmarks.options import Options
from benchmarks.parallel import measured
from benchmarks.result import Result, Table

SHARE = 0.95
# What joints in the open are like: metres wide and deep, and slabs beside them that lie half as much too high
# or too low as they lie aside (DIN 18318 allows neighbours a step of 2 mm) and turned by so much.
WIDTHS_M, DEPTHS_M = (0.008, 0.014), (0.003, 0.008)
# Of three pavings one has sawn rims; one has rims bevelled by so much at the most, as cast slabs and pavers
# have, over a bed that is deeper; and one has joints filled up to their bevels or worn rims, so that no wall
# shows: so deep, with a bed of any tone between dark soil and the slabs' own.
MOST_CHAMFER_M = 0.003
FILLED_DEPTHS_M, FILLED_CHAMFER, FILLED_TONES = (0.001, 0.005), 0.9, (50.0, 130.0)
LIFT, SLAB_TURN_DEG = 0.5, 0.05
# A sun that is worth taking photos by, and the sky's share of the light, from a clear day to a hazy one.
ELEVATIONS_DEG, SKY_LIGHT = (25.0, 65.0), (0.3, 0.6)
# Grey levels of the noise of plain photos, and of those taken in little light.
PLAIN_GREY, NOISY_GREY = (1.0, 3.0), (10.0, 30.0)


@dataclass(frozen=True)
class Regime:
    """A kind of paving: jitter and side in metres, whether its joints are sunk, jitter and drift of courses.

    The photo's noise is anything between two numbers of grey levels.
    """

    name: str
    jitter_m: float
    side_m: float
    sunk: bool = True
    course_m: float = 0.0
    drift_m: float = 0.0
    noise_grey: tuple[float, float] = PLAIN_GREY


REGIMES = (
    Regime("even, many", 0.0, 0.3),
    Regime("even, few", 0.0, 1.0),
    Regime("irregular, many", 0.0015, 0.3),
    Regime("irregular", 0.0015, 0.5),
    Regime("irregular, few", 0.002, 1.0),
    Regime("irregular courses", 0.001, 0.5, course_m=0.0015),
    Regime("drifting courses", 0.0005, 0.3, drift_m=0.001),
    Regime("printed", 0.0, 0.5, sunk=False),
    Regime("even, noisy", 0.0, 0.5, noise_grey=NOISY_GREY),
    Regime("irregular, noisy", 0.0015, 0.5, noise_grey=NOISY_GREY),
)
# Those of the short run.
QUICK = ("even, many", "irregular, many", "irregular, few")


@dataclass(frozen=True)
class Outcome:
    """Normalised squared errors of one scene, and what its joints said of its camera."""

    regime: Regime
    rotation: float
    pose: float
    focal: float
    consistent: bool


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
    scene = SyntheticScene(
        camera=camera,
        cam_from_ground=pose,
        spacing_m=(regime.side_m, regime.side_m),
        noise_grey=rng.uniform(*regime.noise_grey),
        texture=rng.uniform(0.02, 0.06),
        # Slabs that lie a lot aside have joints in which they can.
        joint_width_m=max(rng.uniform(*WIDTHS_M), 5 * float(np.hypot(regime.jitter_m, regime.course_m))),
        jitter_m=regime.jitter_m,
        course_jitter_m=regime.course_m,
        course_drift_m=regime.drift_m,
        colour=False,
        seed=seed,
    )
    if not regime.sunk:
        return scene
    scene = replace(
        scene,
        joint_depth_m=rng.uniform(*DEPTHS_M),
        lift_m=LIFT * regime.jitter_m,
        slab_turn_rad=np.deg2rad(SLAB_TURN_DEG) if regime.jitter_m else 0.0,
        sun_azimuth_rad=rng.uniform(0, 2 * np.pi),
        sun_elevation_rad=np.deg2rad(rng.uniform(*ELEVATIONS_DEG)),
        sky_light=rng.uniform(*SKY_LIGHT),
    )
    if seed % 3 == 0:
        return scene
    if seed % 3 == 1:
        chamfer = rng.uniform(0.3, 1.0) * min(MOST_CHAMFER_M, 0.8 * scene.joint_depth_m)
        return replace(scene, chamfer_m=chamfer)
    depth = rng.uniform(*FILLED_DEPTHS_M)
    return replace(
        scene,
        joint_depth_m=depth,
        chamfer_m=FILLED_CHAMFER * depth,
        lift_m=min(scene.lift_m, 0.4 * depth),
        joint_tone=rng.uniform(*FILLED_TONES),
    )


def measure(regime: Regime, seed: int) -> Outcome | None:
    """What the answer states of itself, against the truth; None where nothing could be fitted."""
    scene = draw(regime, seed)
    gray = as_gray(render_paving(scene).pixels).astype(np.float32)
    found = finish(gray, scene.camera, scene.cam_from_ground, grid_of(scene))
    if found is None:
        return None
    error, C = pose_error(found.cam_from_ground, scene.cam_from_ground), found.covariance
    check = check_camera(found.fit)
    return Outcome(
        regime,
        rotation=float(error[:3] @ np.linalg.solve(C[:3, :3], error[:3])),
        pose=float(error @ np.linalg.solve(C, error)),
        focal=float(((check.focal_px - scene.camera.fx) / check.focal_sigma_px) ** 2),
        consistent=check.consistent is not False,
    )


def _measure(asked: tuple[Regime, int]) -> Outcome | None:
    return measure(*asked)


def covered(values: Sequence[float], freedom: int) -> float:
    """Per cent of normalised squared errors within the 95 % region."""
    return 100.0 * float(np.mean(np.array(values) <= chi2.ppf(SHARE, freedom)))


def run(options: Options) -> Result:
    """Every regime."""
    seeds = options.count(4, 60)
    regimes = tuple(regime for regime in REGIMES if not options.quick or regime.name in QUICK)
    drawn = measured(_measure, [(regime, 1000 + k) for regime in regimes for k in range(seeds)], options.jobs)
    found = [outcome for outcome in drawn if outcome is not None]
    rows = tuple(_row(regime.name, [o for o in found if o.regime == regime]) for regime in regimes)
    even = [o.pose for o in found if o.regime.jitter_m == 0]
    uneven = [o.pose for o in found if o.regime.jitter_m > 0]
    low, high = (100.0 * float(binom.ppf(q, len(found), SHARE)) / len(found) for q in (0.025, 0.975))
    return Result(
        "truth",
        about=(
            f"{seeds} random pavings for each regime (800 x 600, tilt 25° to 65°, noise 1 to 3 grey levels, "
            "noisy ones 10 to 30), fitted by the last stage from the truth; the pose and covariance are "
            "those that `align` reports. Joints are 8 to 14 mm wide and 3 to 8 mm deep, in a sun 25° to 65° "
            "high from anywhere, with 30 to 60 % of the light from the sky. Of three pavings with sunk "
            "joints one has sawn rims, one rims that are bevelled by 0.7 to 3 mm, and one joints that are "
            "filled to within 1 to 5 mm of the slabs' tops, bevelled or worn down to that, by anything from "
            "dark soil to what is nearly as light as the slabs. Irregular slabs lie aside by a standard "
            "deviation of 1.5 or 2 mm (with irregular courses by 1 mm, and the courses as a whole by 1.5 "
            "mm; with drifting ones by 0.5 mm, and each course by 1 mm from nine tenths of what the one "
            "before has drifted by), too high or low by half of that, and turned by 0.05°; even ones lie "
            "just where they ought "
            "to. Printed ones are flat joints whose two sides look alike, through a perfect lens: they are "
            "covered too often, as the covariance allows for more than that. Every regime counts. Errors are "
            "normalised by the stated covariance; the medians should be 2.4 (rotation), 5.3 (pose) and 0.45 "
            "(focal)."
        ),
        figures=(
            Figure("truth.pose", covered([o.pose for o in found], 6)),
            Figure("truth.rotation", covered([o.rotation for o in found], 3)),
            Figure("truth.even", covered(even, 6)),
            Figure("truth.uneven", covered(uneven, 6)),
            Figure("truth.focal", covered([o.focal for o in found], 1)),
            Figure("truth.alarms", 100.0 * float(np.mean([not o.consistent for o in found]))),
        ),
        tables=(
            Table(
                "Coverage of 95 % regions, per cent, and median normalised squared errors",
                (
                    "regime", "scenes", "rotation", "pose", "focal", "median rotation", "median pose",
                    "median focal", "false alarms",
                ),
                rows,
            ),
        ),
        notes=(
            f"With {len(found)} scenes, exact 95 % regions would be seen to cover between {low:.1f} "
            f"and {high:.1f} % "
            "in 19 of 20 runs.",
        ),
    )  # fmt: skip


def _row(name: str, found: Sequence[Outcome]) -> tuple[str, ...]:
    if not found:
        return (name, "0", *([""] * 7))
    nees = np.array([(o.rotation, o.pose, o.focal) for o in found])
    shares = [f"{covered(list(nees[:, k]), freedom):.0f}" for k, freedom in enumerate((3, 6, 1))]
    alarms = str(sum(not o.consistent for o in found))
    return (name, str(len(found)), *shares, *(f"{v:.2f}" for v in np.median(nees, axis=0)), alarms)
