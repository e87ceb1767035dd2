import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from autoreg.errors import InputError
from autoreg.jobs.options import parse_crop, parse_height, parse_slab

sides = st.floats(1e-3, 100.0)


@settings(deadline=None, derandomize=True)
@given(sides, sides, st.sampled_from("xX×"))
def test_two_sides_are_read_as_written(a, b, times):
    assert parse_slab(f"{a}{times}{b}") == (a, b)


def test_one_number_is_a_square():
    assert parse_slab("0.5") == (0.5, 0.5)


@pytest.mark.parametrize(
    "text", ["", "x", "0.6x", "0x0.4", "-1x2", "1x2x3", "nanx1", "infx1", "a", "0,6x0,4", "60cm", "0_5"]
)
def test_what_is_no_slab_is_an_input_error_that_quotes_it(text):
    with pytest.raises(InputError, match="--slab wants metres") as caught:
        parse_slab(text)
    assert repr(text) in str(caught.value)


@pytest.mark.parametrize("text", ["1e-6", "1e-300", "0.6x1e-9", "1e300", "600x400"])
def test_a_slab_that_nobody_lays_is_refused_with_the_limits(text):
    with pytest.raises(InputError, match=r"--slab wants metres, 0\.001 to 100 .*got .* metres"):
        parse_slab(text)


def test_a_crop_is_four_whole_numbers():
    assert parse_crop("10, 20,300,400") == (10, 20, 300, 400)


@pytest.mark.parametrize("text", ["", "1,2,3", "1,2,3,4,5", "1.5,2,3,4", "-1,2,3,4", "1,2,0,4", "a,b,c,d"])
def test_what_is_no_crop_is_an_input_error(text):
    with pytest.raises(InputError, match="--crop"):
        parse_crop(text)


@pytest.mark.parametrize("text", ["0", "-1.5", "1e-6", "1e-300", "1e300"])
def test_a_height_is_one_that_a_camera_may_have(text):
    with pytest.raises(InputError, match=r"--camera-height wants metres .* 0\.01 to 10000, .*got .* metres"):
        parse_height(text)


@pytest.mark.parametrize("text", ["", "nan", "inf", "1.5m", "1,5", "1_5"])
def test_a_height_is_a_number(text):
    with pytest.raises(InputError, match=r"--camera-height wants metres .* 1\.55 for 155 cm; got"):
        parse_height(text)
    assert parse_height(" 1.55") == 1.55
