import numpy as np
import pytest
from scipy.linalg import cholesky_banded, solve_triangular

from autoreg.slabs.banded import solve_lower_banded


@pytest.mark.parametrize(
    ("size", "reach", "sides"),
    [(1, 0, 2), (7, 0, 3), (9, 1, 2), (40, 6, 5), (41, 6, 1), (5, 9, 3), (200, 37, 11)],
)
def test_many_right_sides_are_solved_at_once(size: int, reach: int, sides: int):
    rng = np.random.default_rng(size)
    band = np.zeros((reach + 1, size), order="F")
    for below in range(min(reach, size - 1) + 1):
        band[below, : size - below] = rng.normal(size=size - below)
    band[0] = 3.0 * (reach + 1) + np.abs(band[0])
    cholesky = cholesky_banded(band, lower=True)
    whole = np.zeros((size, size))
    for below in range(min(reach, size - 1) + 1):
        whole += np.diag(cholesky[below, : size - below], -below)
    right = rng.normal(size=(size, sides))
    expected = solve_triangular(whole, right, lower=True)
    assert solve_lower_banded(cholesky, right.copy()) == pytest.approx(expected, abs=1e-12)


def test_what_the_band_does_not_hold_has_no_say():
    band = np.asfortranarray(
        [[4.0, 5.0, 6.0, 7.0, 8.0], [1.0, 1.0, 1.0, 1.0, np.nan], [0.5, 0.5, 0.5, np.nan, np.nan]]
    )
    clean = np.asfortranarray(np.nan_to_num(band))
    right = np.arange(10.0).reshape(5, 2)
    assert np.array_equal(solve_lower_banded(band, right.copy()), solve_lower_banded(clean, right.copy()))
