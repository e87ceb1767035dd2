import numpy as np
import pytest
from handmade import CAMERA, POSE, distorted, shadow_of
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from autoreg.errors import InputError
from autoreg.rendering.objects import CastShadow, Light
from autoreg.rendering.sun import Sun, sun_by_shadow, sun_for
from autoreg.view import View

VIEW = View(CAMERA, POSE)


def turned(a, b):
    """The angle between two azimuths."""
    return (a - b + 180.0) % 360.0 - 180.0


@pytest.mark.parametrize("camera", [CAMERA, distorted()], ids=["pinhole", "lens"])
@settings(deadline=None, derandomize=True, max_examples=12)
@given(
    st.floats(-0.8, 0.8), st.floats(-0.5, 0.6), st.floats(0.6, 1.0), st.floats(-180, 180), st.floats(30, 60)
)
def test_a_posts_shadow_gives_the_sun_back(camera, x, y, height, azimuth, elevation):
    view = View(camera, POSE)
    shadow = shadow_of((x, y), height, azimuth, elevation, view)
    inside = (np.array([shadow.foot_px, shadow.top_px, shadow.tip_px]) >= 0).all()
    assume(inside and (np.array([shadow.foot_px, shadow.top_px, shadow.tip_px]) < [640, 480]).all())
    sun = sun_by_shadow(shadow, view)
    assert turned(sun.azimuth_deg, azimuth) == pytest.approx(0.0, abs=1e-6)
    assert sun.elevation_deg == pytest.approx(elevation, abs=1e-6)
    assert sun.source == "shadow"


def test_the_stated_deviations_are_those_of_pixels_that_are_a_pixel_off():
    shadow = shadow_of((0.2, 0.1), 0.7, 205.0, 40.0)
    px = np.array([shadow.foot_px, shadow.top_px, shadow.tip_px])
    stated = sun_by_shadow(shadow, VIEW).sigma_deg
    rng = np.random.default_rng(2)
    found = [sun_by_shadow(CastShadow(*map(tuple, px + rng.normal(0, 1, (3, 2)))), VIEW) for _ in range(200)]
    assert np.std([turned(sun.azimuth_deg, 205.0) for sun in found]) == pytest.approx(stated[0], rel=0.15)
    assert np.std([sun.elevation_deg for sun in found]) == pytest.approx(stated[1], rel=0.15)


def test_what_leans_shows_no_sun():
    with pytest.raises(InputError, match=r"leans by \d.*only something upright"):
        sun_by_shadow(shadow_of((0.2, 0.1), 0.7, 205.0, 40.0, lean=(0.1, 0.0)), VIEW)


def test_a_stub_is_too_rough():
    with pytest.raises(InputError, match=r"a pixel more or less turns the sun by \d+°"):
        sun_by_shadow(shadow_of((0.2, 1.0), 0.03, 205.0, 40.0), VIEW)


def test_a_top_below_its_foot_and_a_tip_in_the_sky_are_refused():
    good = shadow_of((0.2, 0.1), 0.7, 205.0, 40.0)
    for wrong in (
        CastShadow(good.top_px, good.foot_px, good.tip_px),
        CastShadow(good.foot_px, good.top_px, (320.0, -4000.0)),
    ):
        with pytest.raises(InputError, match="must lie on ground"):
            sun_by_shadow(wrong, VIEW)


def test_a_sun_that_would_stand_on_the_horizon_is_refused():
    with pytest.raises(InputError, match=r"the sun would stand 2\.0° high"):
        sun_by_shadow(shadow_of((0.4, 1.2), 0.05, 200.0, 2.0), VIEW)


def test_a_given_sun_stands_where_it_is_given_and_contradicts_a_shadow():
    assert sun_for(Light((205.0, 38.0)), VIEW) == Sun(205.0, 38.0, "given")
    with pytest.raises(ValueError, match="both say where the sun stands"):
        Light((205.0, 38.0), shadow=shadow_of((0.2, 0.1), 0.7, 205.0, 40.0))


def test_the_default_sun_stands_behind_the_cameras_left_shoulder():
    sun = sun_for(Light(), VIEW)
    assert sun.source == "default"
    assert sun.direction @ POSE.R[2] < 0
    assert sun.direction @ POSE.R[0] < 0
