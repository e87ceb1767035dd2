import numpy as np
import pytest

from autoreg.numbering import MOST_CODES, numbered


@pytest.mark.parametrize("spread", [3, 40, MOST_CODES])
def test_equal_keys_have_equal_numbers_in_the_order_of_the_keys(spread: int):
    rng = np.random.default_rng(spread)
    keys = rng.integers(-spread, spread, (500, 2))
    number, first = numbered(keys[:, 0], keys[:, 1])
    names, inverse = np.unique(keys, axis=0, return_inverse=True)
    assert np.array_equal(number, inverse.ravel())
    assert np.array_equal(keys[first], names)


def test_whole_numbers_may_be_truth_values_or_floating_point():
    number, first = numbered(np.array([True, False, True]), np.array([2.0, 7.0, 1.0]))
    assert number.tolist() == [2, 0, 1]
    assert first.tolist() == [1, 2, 0]


def test_nothing_has_no_numbers():
    number, first = numbered(np.zeros(0, dtype=int))
    assert len(number) == len(first) == 0
