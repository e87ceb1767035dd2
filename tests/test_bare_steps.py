from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sunk_joints import SUNK, fit_of, nearer

from autoreg.fitting.bare_steps import from_near_rims, only_steps, without_joints
from autoreg.ground.sides import ALONG_X
from autoreg.synthetic import look_at_ground

WIDTH, REACH = 0.012, 6.0
# In the sun alone at 45° from behind the camera, the walls that it faces are as light as level stone, and
# deep beds are hidden; joints that run along the view show theirs.
HIDDEN = replace(
    SUNK,
    cam_from_ground=look_at_ground(pitch_deg=38.0, height_m=1.5, roll_deg=2.0, foot_m=(0.2, 0.1)),
    joint_width_m=WIDTH,
    sun_elevation_rad=np.pi / 4,
    sky_light=0.0,
    tone_spread=0.12,
    noise_grey=0.5,
)


@pytest.mark.parametrize("width", [0.6 * WIDTH, pytest.param(WIDTH, marks=pytest.mark.slow), 1.4 * WIDTH])
def test_steps_are_taken_for_the_near_rims_of_hidden_beds_however_wide_a_strip_was_thought(width: float):
    fit = fit_of(HIDDEN, width, (0, -1), REACH)
    measured = from_near_rims(fit)
    assert only_steps(fit) == (ALONG_X,)
    assert abs(nearer(measured, HIDDEN)) < 0.15
    # Joints along the view are left alone, and what is told of the others goes together.
    cross = fit.stations.family != ALONG_X
    assert np.array_equal(measured.offsets.offset_px[cross], fit.offsets.offset_px[cross])
    moved = measured.offsets.offset_px - fit.offsets.offset_px
    assert np.allclose(measured.distances_px - fit.distances_px, -moved)


def test_a_bare_step_lies_half_a_width_nearer_than_its_joint():
    assert nearer(fit_of(HIDDEN, WIDTH, (0, -1), REACH), HIDDEN) == pytest.approx(0.5, abs=0.1)


def test_joints_with_a_tone_of_their_own_are_left_alone():
    flat = replace(HIDDEN, joint_depth_m=0.0)
    for polarity in ((0, -1), (-1, -1), (0, 0)):
        fit = fit_of(flat, WIDTH, polarity, REACH)
        assert from_near_rims(fit) is fit
    assert without_joints(fit) == (0, 1)
    assert only_steps(fit) == ()
