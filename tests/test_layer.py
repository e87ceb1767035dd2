import numpy as np
from handmade import photo_for
from hypothesis import given, settings
from hypothesis import strategies as st

from autoreg.rendering.layer import Layer, lay_over, layer_picture, linear_from_srgb, srgb_from_linear
from autoreg.view import Window

PHOTO = photo_for()


def test_srgb_and_linear_light_are_each_others_inverse():
    every = np.arange(256, dtype=np.uint8)
    assert (srgb_from_linear(linear_from_srgb(every)) == every).all()


def layer_with(light, transmission):
    window = Window(100, 50, 30, 20)
    return Layer(window, np.full((20, 30, 3), light), np.full((20, 30), transmission))


@settings(deadline=None, derandomize=True, max_examples=30)
@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_the_composite_is_the_photo_bit_for_bit_where_alpha_is_zero(light, transmission):
    layer = layer_with(light * (1 - transmission), transmission)
    picture = layer_picture(layer, 640, 480)
    composite = lay_over(picture, PHOTO, layer.window)
    clear = picture[..., 3] == 0
    assert clear.sum() >= 640 * 480 - 600
    assert (composite[clear] == PHOTO[clear]).all()


def test_an_opaque_layer_hides_the_photo_with_its_own_colour():
    layer = layer_with(0.5, 0.0)
    composite = lay_over(layer_picture(layer, 640, 480), PHOTO, layer.window)
    assert (composite[50:70, 100:130] == srgb_from_linear(np.array([0.5]))).all()


def test_a_shadow_takes_its_part_of_the_photos_linear_light():
    layer = layer_with(0.0, 0.4)
    composite = lay_over(layer_picture(layer, 640, 480), PHOTO, layer.window)
    inside = np.s_[50:70, 100:130]
    ratio = linear_from_srgb(composite[inside]) / linear_from_srgb(PHOTO[inside])
    assert abs(np.median(ratio) - 0.4) < 0.004


def test_the_photo_itself_is_not_changed():
    before = PHOTO.copy()
    layer = layer_with(0.1, 0.5)
    lay_over(layer_picture(layer, 640, 480), PHOTO, layer.window)
    assert (before == PHOTO).all()
