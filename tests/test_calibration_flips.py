import numpy as np
import pytest
from boards import BOARD, CAMERA, restless_views, views

from autoreg.calibration.board import BoardView
from autoreg.calibration.flips import SIGNS, flipped_views
from autoreg.calibration.model_choice import freedom_of
from autoreg.calibration.models import GENERAL
from autoreg.calibration.observations import data_of
from autoreg.calibration.pipeline import calibrate_views
from autoreg.calibration.starting import first_state
from autoreg.errors import InputError

W, H = CAMERA.width, CAMERA.height


def flipped(seen, flips):
    middle = np.array([W - 1, H - 1]) / 2
    return [
        BoardView(view.name, view.ids, middle + SIGNS[flip] * (view.corners_px - middle))
        for view, flip in zip(seen, flips, strict=True)
    ]


def found_in(seen):
    data = data_of(seen, BOARD)
    start = first_state(data, W, H)
    return flipped_views(data, start, freedom_of(GENERAL, start, W, H), W, H)


@pytest.mark.parametrize("flip", [1, 2, 3])
def test_photos_that_software_mirrored_or_turned_over_are_told_one_by_one(flip):
    flips = np.zeros(15, int)
    flips[[2, 7, 11]] = flip
    found = found_in(flipped(views(CAMERA, 15, seed=flip), flips))
    assert found is not None
    assert list(found.flips) == list(flips)
    assert np.abs(found.fit.state.intrinsics[2:4] - [CAMERA.cx, CAMERA.cy]).max() < 1


def test_the_whole_set_mirrored_is_a_camera_like_any_other():
    """A chessboard does not tell left from right, and the camera of mirrored photos is right for them."""
    seen = flipped(views(CAMERA, 15), np.ones(15, int))
    assert found_in(seen) is None
    found = calibrate_views(seen, BOARD, W, H)
    assert abs(found.camera.cx - (W - 1 - CAMERA.cx)) < 4 * found.precision.std_devs[2]


@pytest.mark.parametrize("kind", ["as they are", "focusing", "moving sensor", "bent"])
def test_photos_as_the_sensor_saw_them_are_left_alone(kind):
    for seed in range(2):
        assert found_in(restless_views(CAMERA, 14, kind, seed)) is None


def test_a_few_mirrored_photos_are_left_out_by_name():
    flips = [1 if k in (0, 4) else 0 for k in range(14)]
    found = calibrate_views(flipped(views(CAMERA, 14), flips), BOARD, W, H)
    assert {out.name for out in found.left_out} == {"view0.jpg", "view4.jpg"}
    assert all("mirrored left to right" in out.reason for out in found.left_out)
    assert abs(found.camera.cx - CAMERA.cx) < 4 * found.precision.std_devs[2]


def test_half_of_the_photos_turned_by_half_are_refused_with_both_groups():
    seen = flipped(views(CAMERA, 14), [3 * (k % 2) for k in range(14)])
    with pytest.raises(InputError, match=r"(?s)EXIF does not say.*7 of one kind.*7 turned by 180°") as told:
        calibrate_views(seen, BOARD, W, H)
    even = "view0.jpg, view2.jpg, view4.jpg ... view12.jpg"
    assert even in str(told.value)
