"""The last stage against the Cramér-Rao bound of the very picture that it is given."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from autoreg.camera import Camera
from autoreg.geometry import Rigid
from autoreg.synthetic import SyntheticScene, clean_grey, look_at_ground
from benchmarks.bound import NAMES, cramer_rao
from benchmarks.last_stage import crossings_error_px, crossings_of, finish, grid_of, nudged, pose_error
from benchmarks.metrics import Figure
from benchmarks.options import Options
from benchmarks.parallel import measured
from benchmarks.result import Plot, Result, Series, Table

# The start of every fit: off by so many degrees and such a share of the camera's height.
TURN_DEG, MOVE = 0.1, 0.002
JOINT_TONE, CONTRAST_GREY, JOINT_M = 60.0, 90.0, 0.012


@dataclass(frozen=True)
class Case:
    """One kind of picture. Moderate ones are those whose median is the headline."""

    axis: str
    value: float
    scene: SyntheticScene
    noise_grey: float
    moderate: bool = True


@dataclass(frozen=True)
class Found:
    """RMSE over the bound, of each parameter and of the crossings, with the share of it that is bias."""

    case: Case
    ratio: Float[np.ndarray, "6"]
    bias: Float[np.ndarray, "6"]
    bound_px: float
    rmse_px: float
    lost: int

    @property
    def ratio_px(self) -> float:
        """RMSE of the crossings over its bound."""
        return self.rmse_px / self.bound_px


def scene(size: tuple[int, int], tilt_deg: float = 40.0, side_m: float = 0.4) -> SyntheticScene:
    """Printed slabs of one tone, seen from the height of a photographer's eyes.

    The sky has the tone of the paving from afar: the horizon of an endless plane is an edge that tells the
    tilt to a pixel's hundredth, but no paving has one.
    """
    width, height = size
    bare = (1.0 - JOINT_M / side_m) ** 2
    return SyntheticScene(
        camera=Camera.from_focal(width, height, 0.875 * width),
        cam_from_ground=look_at_ground(
            pitch_deg=tilt_deg, height_m=1.6, heading_deg=25.0, roll_deg=1.0, foot_m=(0.1, 0.2)
        ),
        spacing_m=(side_m, side_m),
        joint_width_m=JOINT_M,
        joint_tone=JOINT_TONE,
        slab_tone=JOINT_TONE + CONTRAST_GREY,
        sky_tone=JOINT_TONE + bare * CONTRAST_GREY,
        tone_spread=0.0,
        texture=0.0,
        blur_px=0.7,
        colour=False,
    )


def cases(*, quick: bool) -> tuple[Case, ...]:
    """The grid: one quantity at a time, around a plain picture."""
    size = (400, 300) if quick else (640, 480)
    plain, noise = scene(size), 4.0
    if quick:
        return (
            Case("noise", noise, plain, noise),
            Case("tilt", 25.0, scene(size, tilt_deg=25.0), noise),
        )
    made = [Case("noise", n, plain, n, moderate=2.0 <= n <= 8.0) for n in (1.0, 2.0, 4.0, 8.0, 16.0, 24.0)]
    made += [
        Case("tilt", t, scene(size, tilt_deg=t), noise, moderate=t >= 20.0)
        for t in (12.0, 20.0, 30.0, 55.0, 75.0)
    ]
    made += [
        Case("blur", b, replace(plain, blur_px=b), noise, moderate=b <= 1.5) for b in (0.4, 1.0, 1.5, 2.5)
    ]
    made += [
        Case("joint width", 1000 * w, replace(plain, joint_width_m=w), noise, moderate=w >= 0.005)
        for w in (0.003, 0.005, 0.02, 0.03)
    ]
    made += [
        Case("slab side", s, scene(size, side_m=s), noise, moderate=s <= 0.8)
        for s in (0.2, 0.3, 0.6, 0.8, 1.2)
    ]
    return tuple(made)


def examine(case: Case, seeds: int) -> Found:
    """RMSE over the bound from so many draws of the noise."""
    scene, true = case.scene, case.scene.cam_from_ground
    ground = crossings_of(scene)
    bound, clean = cramer_rao(scene), clean_grey(scene)
    errors: list[np.ndarray] = []
    off_px: list[float] = []
    for seed in range(seeds):
        found = fitted(case, clean, seed)
        if found is not None:
            errors.append(pose_error(found, true))
            off_px.append(crossings_error_px(found, scene, ground))
    sigma, made = bound.sigma(case.noise_grey), np.array(errors)
    if not len(made):
        return Found(case, np.full(6, np.nan), np.full(6, np.nan), np.nan, np.nan, seeds)
    return Found(
        case,
        np.sqrt((made**2).mean(0)) / sigma,
        made.mean(0) / sigma,
        bound.crossings_px(scene, ground, case.noise_grey),
        float(np.sqrt(np.mean(np.square(off_px)))),
        seeds - len(made),
    )


def fitted(case: Case, clean: Float[np.ndarray, "h w"], seed: int) -> Rigid | None:
    """The pose found in one draw of a case's noise over its `clean` picture; None if the fit is lost."""
    rng, scene = np.random.default_rng([11, seed]), case.scene
    photo = np.clip(np.round(clean + case.noise_grey * rng.standard_normal(clean.shape)), 0, 255)
    start = nudged(scene.cam_from_ground, TURN_DEG, MOVE, rng)
    done = finish(photo.astype(np.float32), scene.camera, start, grid_of(scene))
    return None if done is None else done.cam_from_ground


def run(options: Options) -> Result:
    """Every case of the grid."""
    seeds = options.count(10, 200)
    found = measured(partial(examine, seeds=seeds), cases(quick=options.quick), options.jobs)
    usable = [f for f in found if np.isfinite(f.ratio).all()]
    moderate = [f for f in usable if f.case.moderate]
    tried = seeds * len(found)
    figures = (
        Figure("limit.ratio", float(np.median([f.ratio for f in moderate]))),
        Figure("limit.ratio_crossings", float(np.median([f.ratio_px for f in moderate]))),
        Figure("limit.worst", float(np.max([f.ratio for f in usable]))),
        Figure("limit.lost", 100.0 * sum(f.lost for f in found) / tried),
    )
    return Result(
        "limit",
        about=(
            "Printed lattices with Gaussian noise, rounded to eight bits. RMSE of the last stage "
            "(measuring the joints, "
            "the mixed model, the last shift, as `align` ends) from a start "
            f"{TURN_DEG}° and {100 * MOVE:g} % off, over the Cramér-Rao bound from the renderer's own "
            f"derivatives; "
            "joint width, tones and blur count as unknown in the bound. "
            f"{seeds} seeds for each picture of {found[0].case.scene.camera.width} x "
            f"{found[0].case.scene.camera.height}, contrast {CONTRAST_GREY:g} grey levels; where not "
            f"varied: noise 4 "
            "grey levels, tilt 40° below the horizon, blur 0.7 px, joints of 12 mm, slabs of 0.4 m. "
            "The sky has the tone of far paving, so that no horizon tells the tilt. "
            "Moderate: noise 2 to 8, tilt from 20°, blur to 1.5 px, joints from 5 mm, slabs to 0.8 m."
        ),
        figures=figures,
        tables=(_table(found),),
        plots=_plots(found),
        notes=_notes(found),
    )


def _table(found: list[Found]) -> Table:
    rows = tuple(
        (
            f.case.axis,
            f"{f.case.value:g}",
            "yes" if f.case.moderate else "",
            *(f"{r:.2f}" for r in f.ratio),
            f"{f.ratio_px:.2f}",
            f"{1e3 * f.bound_px:.2f}",
            f"{np.abs(f.bias).max():.1f}",
            str(f.lost),
        )
        for f in found
    )
    columns = ("varied", "value", "moderate", *NAMES, "crossings", "bound, 1e-3 px", "bias at most", "lost")
    return Table("RMSE over the Cramér-Rao bound; bias in sigmas of the bound", columns, rows)


def _plots(found: list[Found]) -> tuple[Plot, ...]:
    units = {
        "noise": "grey levels",
        "tilt": "degrees below the horizon",
        "blur": "px",
        "joint width": "mm",
        "slab side": "m",
    }
    plots: list[Plot] = []
    for axis in dict.fromkeys(f.case.axis for f in found):
        mine = sorted((f for f in found if f.case.axis == axis), key=lambda f: f.case.value)
        if len(mine) < 3:
            continue
        x = tuple(f.case.value for f in mine)
        worst = Series("worst parameter", x, tuple(float(f.ratio.max()) for f in mine))
        middle = Series("median parameter", x, tuple(float(np.median(f.ratio)) for f in mine))
        plots.append(
            Plot(
                axis.replace(" ", "-"), f"RMSE over the bound by {axis}", f"{axis}, {units[axis]}",
                "RMSE / bound",
                (worst, middle), goal=1.3, log_y=True,
            )
        )  # fmt: skip
    return tuple(plots)


def _notes(found: list[Found]) -> tuple[str, ...]:
    biased = [f for f in found if np.isfinite(f.bias).all() and np.abs(f.bias).max() > 1.0]
    if not biased:
        return ()
    worst = max(biased, key=lambda f: float(np.abs(f.bias).max()))
    return (
        f"In {len(biased)} of {len(found)} pictures a systematic error is larger than the bound's "
        f"standard deviation, "
        f"at most {np.abs(worst.bias).max():.1f} times ({worst.case.axis} {worst.case.value:g}): "
        f"there, less noise "
        "does not help.",
    )
