from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from paved import CAMERA
from sunk_joints import SUNK, drawn_side, fit_of, nearer

from autoreg.fitting.bare_steps import across_slope
from autoreg.fitting.fit import Fit
from autoreg.fitting.joint_parts import Parts, fit_parts, side_of
from autoreg.fitting.lit_bevels import WIDEST, bevelled
from autoreg.fitting.lit_sides import beside_lit_sides
from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.joints.joint_looks import Strip
from autoreg.slabs.measured_joints import measured_joints
from autoreg.slabs.slab_effects import rim_effects
from autoreg.synthetic import SyntheticScene, look_at_ground

WIDTH, CHAMFER, DARK, REACH = 0.006, 0.004, (-1, -1), 5.0
# Joints between bevelled slabs, seen from above; the sun stands low behind the camera and lights far bevels.
BEVELLED = replace(
    SUNK,
    camera=CAMERA,
    cam_from_ground=look_at_ground(pitch_deg=60.0, height_m=1.2, roll_deg=2.0, foot_m=(0.2, 0.1)),
    joint_width_m=WIDTH,
    joint_depth_m=0.012,
    chamfer_m=CHAMFER,
    sun_elevation_rad=np.deg2rad(25.0),
    sky_light=0.2,
    tone_spread=0.04,
    noise_grey=0.7,
)


@lru_cache
def fits(elevation_deg: float) -> tuple[SyntheticScene, Fit, Fit]:
    """A scene, the fit of its joints as strips of one tone, and that beside lit sides."""
    scene = replace(BEVELLED, sun_elevation_rad=np.deg2rad(elevation_deg))
    fit = fit_of(scene, WIDTH, DARK, REACH)
    return scene, fit, beside_lit_sides(fit)


@pytest.mark.parametrize("elevation_deg", [25.0, pytest.param(40.0, marks=pytest.mark.slow)])
def test_joints_lie_between_the_outer_edges_of_their_bevels(elevation_deg: float):
    scene, fit, measured = fits(elevation_deg)
    was, now = nearer(fit, scene), nearer(measured, scene)
    assert was > 0.5
    assert abs(now) < 0.3 * was
    along = measured.stations.family == ALONG_X
    assert (measured.bevel[along & measured.usable] > 0).all()
    assert not measured.bevel[measured.stations.family == ALONG_Y].any()
    assert measured.bevel.max() == pytest.approx(CHAMFER, rel=0.5)


@pytest.mark.parametrize(
    "changed",
    [
        {"chamfer_m": 0.0, "joint_depth_m": 0.0},
        # Sawn slabs, whose walls are in the light.
        pytest.param({"chamfer_m": 0.0}, marks=pytest.mark.slow),
        # Under the open sky alone all bevels are darker than the slabs.
        {"sky_light": 1.0},
    ],
)
def test_joints_without_bevels_in_the_light_have_none(changed: dict[str, float]):
    fit = fit_of(replace(BEVELLED, **changed), WIDTH, DARK, REACH)  # type: ignore[arg-type]
    assert not beside_lit_sides(fit).bevel.any()


def test_bevels_are_narrow_beside_their_slabs():
    _, fit, _ = fits(25.0)
    rows, slope = np.flatnonzero(fit.usable & (fit.stations.family == ALONG_X)), across_slope(fit)
    way = float(np.sign(np.median(slope[rows])))
    side = side_of(fit, rows, way, slope, WIDEST * fit.strip.width[ALONG_X])
    found = bevelled(side, fit.strip, ALONG_X, 0.3, None)
    assert found is not None
    assert bevelled(side, fit.strip, ALONG_X, 0.05, None) is None
    light = replace(fit.strip, polarity=(1, -1))
    assert bevelled(side, light, ALONG_X, 0.3, None) is None
    # What is known of walls that would look the same leaves nothing for bevels.
    assert bevelled(side, fit.strip, ALONG_X, 0.3, Parts(*found[1])) is None


def test_what_bevels_were_seen_says_how_far_the_other_joints_may_lie_aside():
    _, fit, measured = fits(25.0)
    rows = np.flatnonzero(measured.usable)
    along = measured.stations.family[rows] == ALONG_X

    def aside(one: Fit, some: np.ndarray) -> float:
        effects = rim_effects(measured_joints(one, rows))[: len(rows), [0, 1, 3, 4]]
        return float(np.median(np.abs(effects[some]).sum(1) / one.profiles.px_per_unit[rows][some]))

    assert aside(measured, ~along) > 2.0 * aside(measured, along)
    assert aside(measured, ~along) > 1.2 * aside(fit, ~along)


@pytest.mark.parametrize(("bed", "bevel", "polarity"), [(1.35, 0.7, 0), (0.6, 1.3, 0), (0.6, 1.3, -1)])
def test_joints_half_dark_and_half_light_lie_between_their_outer_edges(
    bed: float, bevel: float, polarity: int
):
    off_px, slope = 0.5, np.linspace(0.05, 0.6, 60)
    side = drawn_side(
        bed, bevel, off_px, 0.2 - 0.8 * slope, slope, half_px=2.0, px_per_unit=400.0, noise=0.01
    )
    strip = Strip((0.006, 0.006), side.blur_px, (polarity, -1), polarity_known=True)
    found = bevelled(side, strip, ALONG_X, 0.3, None)
    assert found is not None
    assert found[1].tone == pytest.approx(bevel, abs=0.15)
    assert np.median(fit_parts(side, found[1])[1]) == pytest.approx(off_px, abs=0.35)


def beside_shade(bed: float, shade: float) -> tuple[float, Parts] | None:
    """Bevels by joints whose far third is in the shade, found there as narrow dark ones."""
    slope, half_px = np.linspace(0.05, 0.6, 60), 3.0
    begins, px_per_unit = 0.4 - 0.6 * slope, 400.0
    side = drawn_side(
        bed, shade, -0.7 * half_px, begins, slope, half_px=half_px, px_per_unit=px_per_unit, noise=0.02
    )
    own = 0.35 * 2.0 * half_px / px_per_unit
    strip = Strip((own, own), side.blur_px, DARK, polarity_known=True)
    found = bevelled(side, strip, ALONG_X, 0.3, None)
    if found is not None:
        assert np.median(fit_parts(side, found[1])[1]) == pytest.approx(-0.7 * half_px, abs=0.5)
    return found


@pytest.mark.parametrize("bed", [0.9, 0.85])
def test_a_bed_in_the_light_is_found_beside_its_shade(bed: float):
    found = beside_shade(bed, 0.5)
    assert found is not None
    assert found[1].tone < 0.8
    assert found[1].width == pytest.approx(0.015, rel=0.25)


def test_a_slab_beside_a_dark_joint_is_no_bed():
    assert beside_shade(1.0, 0.5) is None


def test_what_is_darker_than_a_bevel_in_the_shade_is_a_bed_of_one_tone_beside_it():
    slope = np.linspace(0.05, 0.6, 60)
    side = drawn_side(0.5, 0.8, 0.5, 0.2 - 0.8 * slope, slope, half_px=2.0, px_per_unit=400.0, noise=0.01)
    strip = Strip((0.006, 0.006), side.blur_px, DARK, polarity_known=True)
    assert bevelled(side, strip, ALONG_X, 0.3, None) is None
