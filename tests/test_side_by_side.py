from __future__ import annotations

import threading

import pytest

from autoreg.side_by_side import side_by_side


def test_what_becomes_of_things_comes_in_their_order():
    assert side_by_side(lambda n: n * n, [3, 1, 2]) == [9, 1, 4]
    assert side_by_side(str, []) == []


def test_two_things_are_worked_on_at_a_time():
    both = threading.Barrier(2, timeout=30.0)
    assert sorted(side_by_side(lambda _: both.wait(), "ab")) == [0, 1]


def test_what_goes_wrong_with_one_thing_is_told():
    with pytest.raises(ZeroDivisionError):
        side_by_side(lambda n: 1 / n, [1, 0, 2])
