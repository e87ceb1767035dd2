from dataclasses import replace

import numpy as np
import pytest
from handmade import CAMERA, POSE, ROWS, RUNNING, STACK, distorted, looking
from hypothesis import given, settings
from hypothesis import strategies as st

from autoreg.errors import InputError
from autoreg.layout import slab_centre
from autoreg.rendering.demo import demo_objects
from autoreg.rendering.objects import Box, Light, Object, OnGround, OnSlab, Scene, Sphere, UnderPixel
from autoreg.rendering.staging import can_be_staged, judged_exposure, lamps_for, stage
from autoreg.rendering.sun import Sun
from autoreg.view import View

VIEW = View(CAMERA, POSE)
LATTICES = pytest.mark.parametrize("lattice", [STACK, RUNNING, ROWS], ids=["stack", "running", "rows"])
BALL = Sphere(0.1)


def staged(*things, lattice=STACK, view=VIEW):
    return stage(Scene(things), view, lattice).solids


@LATTICES
def test_the_demo_stands_on_the_ground_in_the_lower_middle_of_the_picture(lattice):
    block, ball, cone = staged(*demo_objects(VIEW, lattice), lattice=lattice)
    assert block.corners[:, 2].min() == pytest.approx(0.0)
    assert cone.corners[:, 2].min() == pytest.approx(0.0)
    assert ball.corners[:, 2].min() == pytest.approx(block.corners[:, 2].max())
    foot = VIEW.project(block.foot)
    assert 0.3 * 640 < foot[0] < 0.7 * 640
    assert 0.45 * 480 < foot[1] < 0.85 * 480


@pytest.mark.parametrize("size", [0.05, 0.4, 1.0])
def test_the_demo_has_about_the_same_size_in_the_picture_for_any_slab(size):
    lattice = replace(STACK, spacing_x=size, spacing_y=size)
    block = staged(*demo_objects(VIEW, lattice), lattice=lattice)[0]
    height = np.ptp(VIEW.project(block.corners)[:, 1])
    assert 480 / 12 < height < 480 / 2.5
    steps = np.ptp(block.corners[:, 0]) / size
    assert min(abs(steps - round(steps)), abs(1 / steps - round(1 / steps))) < 1e-9


def test_where_no_paving_was_seen_in_the_middle_the_demo_stands_at_the_origin():
    aside = View(CAMERA, looking([-0.6, -2.6, 1.6], [-6.0, 0.3, 0.0]))
    place = demo_objects(aside, replace(STACK, extent=0.2 * STACK.extent))[0].place
    assert (place.i, place.j) == (0, 0)


def test_where_paving_was_seen_far_off_alone_the_demo_stands_there():
    # What lies in the upper part of the picture, beyond a lawn say.
    far = STACK.extent + VIEW.ground_under(np.array([320.0, 60.0])) - STACK.extent.mean(0)
    near_it = replace(STACK, extent=0.2 * (far - far.mean(0)) + far.mean(0))
    objects = demo_objects(VIEW, near_it)
    foot = slab_centre(near_it, objects[0].place.i, objects[0].place.j)
    assert np.abs(foot - far.mean(0)).max() < 2 * STACK.spacing_x
    seen = [thing for thing in objects if can_be_staged(thing, VIEW, near_it)]
    assert staged(*seen, lattice=near_it)


def test_what_is_out_of_the_picture_cannot_be_staged():
    near, above = (Object("ball", BALL, OnSlab(0, 0), lift_m=lift) for lift in (0.0, 30.0))
    assert can_be_staged(near, VIEW, STACK)
    assert not can_be_staged(above, VIEW, STACK)
    with pytest.raises(InputError):
        staged(above)


@pytest.mark.parametrize("camera", [CAMERA, distorted()], ids=["pinhole", "lens"])
@settings(deadline=None, derandomize=True, max_examples=25)
@given(u=st.floats(0, 639), v=st.floats(200, 479))
def test_what_is_put_under_a_pixel_shows_at_that_pixel(camera, u, v):
    view = View(camera, POSE)
    (solid,) = staged(Object("ball", BALL, UnderPixel(u, v)), view=view)
    assert view.camera.project(POSE.apply(solid.foot)) == pytest.approx([u, v], abs=1e-6)
    assert solid.foot[2] == 0


def test_a_place_on_a_slab_is_its_centre_moved_and_the_object_turned():
    box = Box((0.4, 0.1, 0.2))
    (solid,) = staged(
        Object("box", box, OnSlab(1, 2, (0.05, -0.02)), turn_deg=90.0, lift_m=0.3), lattice=RUNNING
    )
    expected = slab_centre(RUNNING, 1, 2) + np.array([0.05, -0.02])
    assert solid.foot == pytest.approx([*expected, 0.3])
    assert np.ptp(solid.corners, axis=0) == pytest.approx([0.1, 0.4, 0.2])


@pytest.mark.parametrize(
    ("place", "words"),
    [
        (OnSlab(200, 3), r"ball: slab \(200, 3\) lies outside the picture.*slabs with i from -?\d+ to"),
        (OnGround(0.0, -9.0), r"ball: ground point \(0, -9\) is behind the camera"),
        (UnderPixel(320.0, 5.0), "at or above the horizon"),
        (UnderPixel(700.0, 300.0), r"outside the photo of 640 x 480"),
    ],
)
def test_what_cannot_be_seen_is_refused_by_name(place, words):
    level = View(CAMERA, looking([-0.6, -2.6, 1.6], [0.2, 6.0, 0.6]))
    with pytest.raises(InputError, match=words):
        staged(Object("ball", BALL, place), view=level)


def test_a_box_around_the_camera_is_refused():
    with pytest.raises(InputError, match="camera stands inside"):
        staged(Object("house", Box((8.0, 8.0, 3.0)), OnGround(-0.6, -2.6)))


@settings(deadline=None, derandomize=True, max_examples=30)
@given(st.floats(-360, 360), st.floats(5, 90), st.floats(0.02, 1))
def test_sun_and_sky_together_give_1_on_level_ground(azimuth, elevation, sky):
    lamps = lamps_for(Light((azimuth, elevation), sky), Sun(azimuth, elevation, "given"), 1.0)
    assert sum(lamps.on_ground) == pytest.approx(1.0)
    assert lamps.on_ground[1] == pytest.approx(sky)
    assert np.linalg.norm(lamps.to_sky, axis=1) == pytest.approx(np.ones(len(lamps.to_sky)))
    assert np.rad2deg(np.arcsin(lamps.to_sun[2])) == pytest.approx(elevation)


def test_the_exposure_follows_the_photo():
    dark, light = (np.full((480, 640, 3), level, np.uint8) for level in (90, 170))
    low, high = (judged_exposure(photo, VIEW, STACK) for photo in (dark, light))
    # Linear light of 8-bit levels 90 and 170, over half of it thrown back.
    assert low == pytest.approx(2 * 0.1022, rel=0.02)
    assert high == pytest.approx(2 * 0.4020, rel=0.02)
