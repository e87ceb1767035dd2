from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from paved import CAMERA
from sunk_joints import SUNK, drawn_side, fit_of, nearer

from autoreg.fitting.bare_steps import across_slope
from autoreg.fitting.joint_parts import Parts, fit_parts
from autoreg.fitting.lit_sides import beside_lit_sides
from autoreg.fitting.lit_walls import _likeliest_looks
from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.slabs.measured_joints import measured_joints
from autoreg.slabs.slab_effects import relief_effects
from autoreg.synthetic import look_at_ground

WIDTH, DARK, REACH = 0.016, (-1, -1), 5.0
# The low sun behind the camera makes the walls that it faces lighter than level stone; of their beds some is
# left to be seen. Joints along the view show theirs.
LIT = replace(
    SUNK,
    camera=CAMERA,
    cam_from_ground=look_at_ground(pitch_deg=42.0, height_m=1.5, roll_deg=2.0, foot_m=(0.2, 0.1)),
    joint_width_m=WIDTH,
    sun_elevation_rad=np.deg2rad(35.0),
    sky_light=0.2,
    tone_spread=0.04,
    noise_grey=0.7,
)


@pytest.mark.parametrize(
    "elevation_deg", [25.0, *(pytest.param(deg, marks=pytest.mark.slow) for deg in (30.0, 35.0))]
)
def test_joints_lie_half_a_width_beyond_the_near_rim_whatever_the_wall_looks_like(elevation_deg: float):
    scene = replace(LIT, sun_elevation_rad=np.deg2rad(elevation_deg))
    fit = fit_of(scene, WIDTH, DARK, REACH)
    measured = beside_lit_sides(fit)
    assert nearer(fit, scene) > 0.2
    assert abs(nearer(measured, scene)) < 0.06
    moved = measured.offsets.offset_px - fit.offsets.offset_px
    assert np.allclose(measured.distances_px - fit.distances_px, -moved)


@pytest.mark.parametrize("elevation_deg", [25.0, pytest.param(35.0, marks=pytest.mark.slow)])
def test_near_joints_that_are_dark_count_although_the_farther_ones_look_light(elevation_deg: float):
    scene = replace(LIT, sun_elevation_rad=np.deg2rad(elevation_deg))
    fit = fit_of(scene, WIDTH, (1, -1), REACH)
    near = (fit.stations.family == ALONG_X) & (across_slope(fit) < 1.0)
    assert not fit.usable[near].any()
    measured = beside_lit_sides(fit)
    assert measured.usable[near].all()
    at_feet = replace(measured, usable=near)
    assert abs(nearer(at_feet, scene)) < 0.06
    assert abs(nearer(measured, scene)) < 0.06


def test_what_is_measured_from_near_rims_says_no_width_and_is_asked_for_no_relief():
    fit = fit_of(LIT, WIDTH, DARK, REACH)
    measured = beside_lit_sides(fit)
    assert not fit.rimmed.any()
    lit = measured.rimmed
    assert np.array_equal(np.unique(measured.stations.family[lit]), [ALONG_X])
    assert (fit.apart & lit).any()
    assert not (measured.apart & lit).any()
    rows = np.flatnonzero(measured.usable)
    middles = relief_effects(measured_joints(measured, rows))[0][: len(rows)]
    assert not middles[lit[rows]].any()
    assert middles[~lit[rows]].any()


def test_walls_that_would_leave_the_joints_farther_from_their_lines_are_not_believed(
    monkeypatch: pytest.MonkeyPatch,
):
    flat = replace(LIT, joint_depth_m=0.0)
    fit = fit_of(flat, WIDTH, DARK, REACH)
    monkeypatch.setattr("autoreg.fitting.lit_sides.walled", lambda *_: Parts(WIDTH, 0.0, 0.5, 0.95))
    assert abs(nearer(beside_lit_sides(fit), flat)) < 0.02
    monkeypatch.setattr("autoreg.fitting.lit_sides._rougher", lambda *_, **__: False)
    assert abs(nearer(beside_lit_sides(fit), flat)) > 0.1


def test_joints_along_the_view_are_left_alone():
    fit = fit_of(LIT, WIDTH, DARK, REACH)
    cross = fit.stations.family == ALONG_Y
    assert np.array_equal(beside_lit_sides(fit).offsets.offset_px[cross], fit.offsets.offset_px[cross])


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
    fit = fit_of(scene, width, DARK, REACH)
    assert abs(nearer(beside_lit_sides(fit), scene)) < 0.08


@pytest.mark.parametrize("wall", [0.5, 0.65, 1.15])
def test_walls_in_the_shade_are_told_as_those_in_the_light(wall: float):
    off_px = 0.6
    slope = np.full(60, 0.8)
    side = drawn_side(
        0.25,
        wall,
        off_px,
        np.full(60, 0.2),
        slope,
        half_px=0.5 * WIDTH * 300.0,
        px_per_unit=300.0,
        noise=0.02,
    )
    looks = _likeliest_looks(side, tuple(share * WIDTH for share in (1.0, 0.8, 0.6)), WIDTH, 20.0)
    assert looks is not None
    assert looks.tone == pytest.approx(wall, abs=0.08)
    assert np.median(fit_parts(side, looks)[1]) == pytest.approx(off_px, abs=0.15)


@pytest.mark.parametrize("width", [0.003, 0.006])
def test_thin_joints_that_are_thought_too_wide_have_no_walls_in_the_light(width: float):
    # A width that is hardly told beside the blur may come out too large by half or more.
    scene = replace(LIT, joint_depth_m=0.0, joint_width_m=width)
    fit = fit_of(scene, width, DARK, REACH)
    too_wide = replace(fit, strip=replace(fit.strip, width=(1.25 * fit.strip.width[0], fit.strip.width[1])))
    assert too_wide.strip.width[0] > 1.5 * width
    assert not beside_lit_sides(too_wide).rimmed.any()
