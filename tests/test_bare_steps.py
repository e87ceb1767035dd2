from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from drawn_joints import PLAIN
from paved import POSE_ALONE, gray_of

from autoreg.bare_steps import across_slope, from_near_rims, only_steps, without_joints
from autoreg.fit import Fit
from autoreg.joint_looks import Strip
from autoreg.refine import refine_until_still
from autoreg.stations import ALONG_X, Grid, project_ground
from autoreg.synthetic import SyntheticScene, look_at_ground, render_paving

WIDTH, BLUR = 0.012, 0.7
# In the sun alone at 45° from behind the camera, the walls that it faces are as light as level stone, and
# deep beds are hidden; joints that run along the view show theirs.
HIDDEN = replace(
    PLAIN,
    cam_from_ground=look_at_ground(pitch_deg=38.0, height_m=1.5, roll_deg=2.0, foot_m=(0.2, 0.1)),
    spacing_m=(0.4, 0.3),
    joint_width_m=WIDTH,
    joint_depth_m=0.03,
    sun_azimuth_rad=-np.pi / 2,
    sun_elevation_rad=np.pi / 4,
    sky_light=0.0,
    tone_spread=0.12,
    noise_grey=0.5,
    blur_px=BLUR,
    samples=3,
    seed=4,
)


def fit_of(scene: SyntheticScene, width: float, polarity: tuple[int, int]) -> Fit:
    """The fit from the true pose, of joints along X that are thought to be so wide."""
    strip = Strip((width, WIDTH), BLUR, polarity, polarity_known=True)
    fit = refine_until_still(
        gray_of(render_paving(scene)), scene.camera, scene.cam_from_ground, Grid(0.4, 0.3),
        free=POSE_ALONE, search=0.0, reach=6.0, strip=strip,
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


@pytest.mark.parametrize("width", [0.6 * WIDTH, WIDTH, 1.4 * WIDTH])
def test_steps_are_taken_for_the_near_rims_of_hidden_beds_however_wide_a_strip_was_thought(width: float):
    fit = fit_of(HIDDEN, width, (0, -1))
    measured = from_near_rims(fit)
    assert only_steps(fit) == (ALONG_X,)
    assert abs(nearer(measured, HIDDEN)) < 0.15
    # Joints along the view are left alone, and what is told of the others goes together.
    cross = fit.stations.family != ALONG_X
    assert np.array_equal(measured.offsets.offset_px[cross], fit.offsets.offset_px[cross])
    moved = measured.offsets.offset_px - fit.offsets.offset_px
    assert np.allclose(measured.distances_px - fit.distances_px, -moved)


def test_a_bare_step_lies_half_a_width_nearer_than_its_joint():
    assert nearer(fit_of(HIDDEN, WIDTH, (0, -1)), HIDDEN) == pytest.approx(0.5, abs=0.1)


def test_joints_with_a_tone_of_their_own_are_left_alone():
    flat = replace(HIDDEN, joint_depth_m=0.0)
    for polarity in ((0, -1), (-1, -1), (0, 0)):
        fit = fit_of(flat, WIDTH, polarity)
        assert from_near_rims(fit) is fit
    assert without_joints(fit) == (0, 1)
    assert only_steps(fit) == ()
