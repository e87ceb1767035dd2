"""The bond's shift is measured by the cross joints where it is another one than pavers use."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from paved import HALF_BOND, fit_of, gray_of, nearest_pose, true_grid
from scipy.stats import chi2

from autoreg.align import align
from autoreg.fitting.fit import Fit
from autoreg.fitting.refine import refine_until_still
from autoreg.geometry import vector_from_rotation
from autoreg.ground.sides import ALONG_Y
from autoreg.paving.corrections import with_measured_shift
from autoreg.slabs.uncertainty import settle
from autoreg.solve.freedom import Free
from autoreg.synthetic import look_at_ground, render_paving


def sheared(fit: Fit, shift: float) -> Fit:
    """The fit as it would be measured if its courses moved on by this much more."""
    along = fit.stations.cell * shift * (fit.grid.spacing_x or 1.0) * (fit.stations.family == ALONG_Y)
    return replace(fit, distances_px=fit.distances_px - along * fit.profiles.px_per_unit)


@pytest.mark.parametrize("more", [0.02, -0.006])
def test_an_uncustomary_shift_is_measured(half_fit: Fit, more: float):
    measured = with_measured_shift(sheared(half_fit, more))
    assert measured is not None
    assert measured.grid.shift - 0.5 == pytest.approx(more, abs=0.001)


@pytest.mark.parametrize("more", [0.0, 0.001, -0.001])
def test_a_customary_shift_is_kept_however_surely_the_cross_joints_contradict_it(half_fit: Fit, more: float):
    even = replace(half_fit, distances_px=1e-3 * half_fit.distances_px)
    assert with_measured_shift(sheared(even, more)) is None
    # Where the shift is no customary one, as much is a correction.
    odd = replace(even, grid=replace(even.grid, shift=0.46))
    assert (with_measured_shift(sheared(odd, more)) is None) == (more == 0.0)


@pytest.mark.parametrize(("thought", "told"), [(0.4985, 0.5), (0.5008, 0.5), (0.0009, 0.0), (0.9991, 0.0)])
def test_a_shift_that_may_be_a_customary_one_is_taken_for_it(half_fit: Fit, thought: float, told: float):
    even = replace(half_fit, distances_px=1e-3 * half_fit.distances_px)
    odd = sheared(replace(even, grid=replace(even.grid, shift=thought)), 0.0002)
    measured = with_measured_shift(odd)
    assert measured is not None
    assert measured.grid.shift == told


@pytest.mark.slow
def test_what_is_known_of_the_camera_holds_it_while_the_shift_is_measured():
    # The joints alone leave a free camera open: their linear equations would turn it by tens of degrees.
    photo = render_paving(replace(HALF_BOND, spacing_m=(0.4, 0.25), shift=0.36))
    found = align(photo.pixels, None, slab=(0.4, 0.25), exif_focal_px=575.0)
    assert found.camera.source == "exif"
    assert found.lattice.shift == pytest.approx(0.36, abs=0.0005)
    assert found.camera.camera.fx == pytest.approx(photo.camera.fx, rel=0.01)


def test_a_photo_of_an_odd_bond_tells_its_shift():
    fit = fit_of(render_paving(replace(HALF_BOND, shift=0.47)))
    thought = replace(fit, grid=replace(fit.grid, shift=0.5))
    moved = sheared(thought, -0.03)
    measured = with_measured_shift(moved)
    assert measured is not None
    assert measured.grid.shift == pytest.approx(0.47, abs=0.001)
    assert np.isfinite(measured.distances_px).all()


def test_the_likeliest_pose_of_an_odd_bond_is_found_together_with_its_shift():
    photo = render_paving(replace(HALF_BOND, shift=0.45))
    thought = replace(true_grid(photo), shift=0.4508)
    fit = refine_until_still(
        gray_of(photo), photo.camera, photo.cam_from_ground, thought, free=Free(), search=0.0, reach=9.0
    )
    assert fit is not None
    settled = settle(fit, widths=False)
    assert settled.fit.grid.shift == pytest.approx(0.45, abs=0.0001)
    turn = vector_from_rotation(settled.fit.cam_from_ground.R @ photo.cam_from_ground.R.T)
    assert turn @ np.linalg.solve(settled.covariance[:3, :3], turn) < chi2.ppf(0.999, 3)
    # The stations of the cross joints move with them.
    moved = (settled.fit.stations.ground - fit.stations.ground)[:, 0]
    along = fit.stations.family == ALONG_Y
    assert not moved[~along].any()
    a = fit.grid.spacing_x or 1.0
    assert moved[along] == pytest.approx(fit.stations.cell[along] * (settled.fit.grid.shift - 0.4508) * a)


@pytest.mark.slow
@pytest.mark.parametrize("depth_m", [0.0, 0.004])
def test_the_pose_of_an_odd_bond_is_as_sure_as_it_says(depth_m: float):
    scene = replace(HALF_BOND, spacing_m=(0.4, 0.25), shift=0.1, joint_depth_m=depth_m, seed=3)
    photo = render_paving(scene)
    found = align(photo.pixels, photo.camera, slab=(0.4, 0.25))
    assert found.lattice.shift in (pytest.approx(0.1, abs=0.0004), pytest.approx(0.9, abs=0.0004))
    pose = found.pose.cam_from_ground
    true = nearest_pose(pose, photo)
    error = np.r_[vector_from_rotation(pose.R @ true.R.T), pose.t - true.t]
    assert error @ np.linalg.solve(found.pose.covariance, error) < chi2.ppf(0.999, 6)


# Taken for a third, and for a half as every second course suggests, the farther courses are lost.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("shift", "slab", "pose", "seed"),
    [
        (0.3105, (0.4, 0.25), (21.6, 1.49, 66.9, -3.1, (0.8, 0.67)), 37),
        (0.5173, (0.6, 0.2), (37.5, 1.67, 92.3, -2.4, (0.56, 0.8)), 73),
    ],
)
def test_a_shift_beside_a_usual_one_is_told_while_the_lattice_is_looked_for(
    shift: float,
    slab: tuple[float, float],
    pose: tuple[float, float, float, float, tuple[float, float]],
    seed: int,
):
    pitch, height, heading, roll, foot = pose
    scene = replace(
        HALF_BOND,
        cam_from_ground=look_at_ground(
            pitch_deg=pitch, height_m=height, heading_deg=heading, roll_deg=roll, foot_m=foot
        ),
        spacing_m=slab,
        shift=shift,
        joint_depth_m=0.004,
        seed=seed,
    )
    photo = render_paving(scene)
    found = align(photo.pixels, photo.camera, slab=slab)
    assert found.lattice.shift == pytest.approx(shift, abs=0.0003)
    assert found.residual.rms_px < 0.1
