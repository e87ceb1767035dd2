from dataclasses import replace

import numpy as np
import pytest
from handmade import CAMERA, POSE, ROWS, RUNNING, STACK, looking

from autoreg.staging import Ball, Box, corners, demo_staging, shadow_corners
from autoreg.view import View

LATTICES = pytest.mark.parametrize("lattice", [STACK, RUNNING, ROWS], ids=["stack", "running", "rows"])


@LATTICES
def test_the_demo_stands_on_the_ground_in_the_lower_middle_of_the_picture(lattice):
    view = View(CAMERA, POSE)
    block, ball = demo_staging(view, lattice).solids_on(lattice)
    assert isinstance(block, Box)
    assert isinstance(ball, Ball)
    assert corners(block)[:, 2].min() == pytest.approx(0.0)
    assert ball.centre[2] - ball.radius == pytest.approx(corners(block)[:, 2].max())
    foot = view.project(block.centre * [1, 1, 0])
    assert 0.3 * 640 < foot[0] < 0.7 * 640
    assert 0.45 * 480 < foot[1] < 0.85 * 480


@pytest.mark.parametrize("size", [0.05, 0.4, 1.0])
def test_the_demo_has_about_the_same_size_in_the_picture_for_any_slab(size):
    lattice = replace(STACK, spacing_x=size, spacing_y=size)
    view = View(CAMERA, POSE)
    block = demo_staging(view, lattice).solids_on(lattice)[0]
    height = np.ptp(view.project(corners(block))[:, 1])
    assert 480 / 12 < height < 480 / 2.5
    steps = block.size[0] / size
    assert min(abs(steps - round(steps)), abs(1 / steps - round(1 / steps))) < 1e-9


def test_where_no_paving_was_seen_in_the_middle_the_demo_stands_at_the_origin():
    aside = View(CAMERA, looking([-0.6, -2.6, 1.6], [-6.0, 0.3, 0.0]))
    assert demo_staging(aside, replace(STACK, extent=0.2 * STACK.extent)).slab == (0, 0)


def test_the_sun_stands_behind_the_camera_and_shadows_fall_away_from_it():
    view = View(CAMERA, POSE)
    staging = demo_staging(view, STACK)
    light = staging.light
    assert np.linalg.norm(light.to_sun) == pytest.approx(1.0)
    assert light.to_sun @ POSE.R[2] < 0
    assert light.to_sun @ POSE.R[0] < 0
    block = staging.solids_on(STACK)[0]
    shadow = shadow_corners(block, light)
    assert np.abs(shadow[:, 2]).max() < 1e-12
    assert (shadow.mean(0) - block.centre) @ light.to_sun < 0
