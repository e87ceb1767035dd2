from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drawn_joints import PLAIN
from paved import CAMERA, POSE_ALONE, gray_of

from autoreg.bare_steps import across_slope
from autoreg.fit import Fit
from autoreg.joint_looks import Strip
from autoreg.lit_walls import beside_lit_walls
from autoreg.measured_joints import measured_joints
from autoreg.refine import refine_until_still
from autoreg.slab_effects import relief_effects
from autoreg.stations import ALONG_X, ALONG_Y, Grid, project_ground
from autoreg.synthetic import SyntheticScene, look_at_ground, render_paving

WIDTH, BLUR = 0.016, 0.7
# The low sun behind the camera makes the walls that it faces lighter than level stone; of their beds some is
# left to be seen. Joints along the view show theirs.
LIT = replace(
    PLAIN,
    camera=CAMERA,
    cam_from_ground=look_at_ground(pitch_deg=42.0, height_m=1.5, roll_deg=2.0, foot_m=(0.2, 0.1)),
    spacing_m=(0.4, 0.3),
    joint_width_m=WIDTH,
    joint_depth_m=0.03,
    sun_azimuth_rad=-np.pi / 2,
    sun_elevation_rad=np.deg2rad(35.0),
    sky_light=0.2,
    tone_spread=0.04,
    noise_grey=0.7,
    blur_px=BLUR,
    samples=3,
    seed=4,
)


def fit_of(scene: SyntheticScene, width: float = WIDTH) -> Fit:
    """The fit from the true pose, of dark joints, those along X of such a width to begin with."""
    strip = Strip((width, WIDTH), BLUR, (-1, -1), polarity_known=True)
    fit = refine_until_still(
        gray_of(render_paving(scene)), scene.camera, scene.cam_from_ground, Grid(0.4, 0.3),
        free=POSE_ALONE, search=0.0, reach=5.0, strip=strip,
    )  # fmt: skip
    assert fit is not None
    return fit


def nearer(fit: Fit, scene: SyntheticScene) -> float:
    """By what share of their width the joints along X are seen nearer than they are."""
    rows = np.flatnonzero(fit.usable & (fit.stations.family == ALONG_X))
    profiles = fit.profiles.take(rows)
    true_px = project_ground(scene.camera, scene.cam_from_ground, fit.stations.ground[rows])
    off = ((profiles.centre_px - true_px) * profiles.normal).sum(1) + fit.offsets.offset_px[rows]
    way = np.sign(across_slope(fit)[rows])
    return float(np.median(-way * off / (WIDTH * profiles.px_per_unit)))


@pytest.mark.parametrize("elevation_deg", [25.0, 30.0, 35.0])
def test_joints_lie_half_a_width_beyond_the_near_rim_whatever_the_wall_looks_like(elevation_deg: float):
    scene = replace(LIT, sun_elevation_rad=np.deg2rad(elevation_deg))
    fit = fit_of(scene)
    measured = beside_lit_walls(fit)
    assert nearer(fit, scene) > 0.2
    assert abs(nearer(measured, scene)) < 0.06
    moved = measured.offsets.offset_px - fit.offsets.offset_px
    assert np.allclose(measured.distances_px - fit.distances_px, -moved)


def test_what_is_measured_from_near_rims_says_no_width_and_is_asked_for_no_relief():
    fit = fit_of(LIT)
    measured = beside_lit_walls(fit)
    assert not fit.rimmed.any()
    lit = measured.rimmed
    assert np.array_equal(np.unique(measured.stations.family[lit]), [ALONG_X])
    assert (fit.apart & lit).any()
    assert not (measured.apart & lit).any()
    rows = np.flatnonzero(measured.usable)
    middles = relief_effects(measured_joints(measured, rows))[: len(rows)]
    assert not middles[lit[rows]].any()
    assert middles[~lit[rows]].any()


def test_joints_along_the_view_are_left_alone():
    fit = fit_of(LIT)
    cross = fit.stations.family == ALONG_Y
    assert np.array_equal(beside_lit_walls(fit).offsets.offset_px[cross], fit.offsets.offset_px[cross])


@pytest.mark.parametrize(
    "changed",
    [
        {"joint_depth_m": 0.0},
        # Walls in the shade, seen against the sun.
        {"sun_azimuth_rad": np.pi / 2},
    ],
)
@pytest.mark.parametrize("width", [WIDTH, 0.7 * WIDTH])
def test_joints_of_one_tone_stay_where_they_are(changed: dict[str, float], width: float):
    scene = replace(LIT, **changed)  # type: ignore[arg-type]
    fit = fit_of(scene, width)
    assert abs(nearer(beside_lit_walls(fit), scene)) < 0.08
