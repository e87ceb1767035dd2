from __future__ import annotations

import numpy as np
import pytest
from paved import STACK

from autoreg.ground.ground_frame import quarter_turns, turned, with_origin

POINT = np.array([0.7, -0.3, 0.2])


def test_four_quarters_are_none_and_a_turn_keeps_the_hands():
    assert quarter_turns(4) == pytest.approx(np.eye(3))
    for count in range(-3, 4):
        assert np.linalg.det(quarter_turns(count)) == pytest.approx(1.0)
        assert quarter_turns(count) @ quarter_turns(1) == pytest.approx(quarter_turns(count + 1))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_turned_frame_sees_the_same_points_under_other_names(count: int):
    pose = STACK.cam_from_ground
    assert turned(pose, count).apply(quarter_turns(count).T @ POINT) == pytest.approx(pose.apply(POINT))


def test_a_moved_origin_is_where_it_was_moved_to():
    pose = STACK.cam_from_ground
    moved = with_origin(pose, 0.6, -0.4)
    assert moved.apply(POINT - [0.6, -0.4, 0.0]) == pytest.approx(pose.apply(POINT))
