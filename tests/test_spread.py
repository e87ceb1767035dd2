"""Standard deviations by medians."""

from __future__ import annotations

import numpy as np
import pytest

from autoreg.spread import spread, spread_about

VALUES = 3.0 + 0.2 * np.random.default_rng(1).standard_normal(20_000)


def test_normal_values_have_their_own_spread():
    assert spread(VALUES) == pytest.approx(0.2, rel=0.03)
    assert spread_about(VALUES, 3.0) == pytest.approx(0.2, rel=0.03)


def test_wild_values_change_little():
    wild = np.r_[VALUES, np.full(len(VALUES) // 20, 1e6)]
    assert spread(wild) == pytest.approx(0.2, rel=0.1)


def test_what_lies_off_a_known_middle_counts():
    assert spread_about(VALUES, 2.0) > 1.4
