"""The bond's shift is measured by the cross joints where it is another one than pavers use."""

from dataclasses import replace

import numpy as np
import pytest
from paved import HALF_BOND, fit_of

from autoreg.fitting.fit import Fit
from autoreg.ground.sides import ALONG_Y
from autoreg.paving.corrections import with_measured_shift
from autoreg.synthetic import render_paving


def sheared(fit: Fit, shift: float) -> Fit:
    """The fit as it would be measured if its courses moved on by this much more."""
    along = fit.stations.cell * shift * (fit.grid.spacing_x or 1.0) * (fit.stations.family == ALONG_Y)
    return replace(fit, distances_px=fit.distances_px - along * fit.profiles.px_per_unit)


@pytest.mark.parametrize("more", [0.02, -0.006])
def test_an_uncustomary_shift_is_measured(half_fit: Fit, more: float):
    measured = with_measured_shift(sheared(half_fit, more))
    assert measured is not None
    assert measured.grid.shift - 0.5 == pytest.approx(more, abs=0.001)


@pytest.mark.parametrize("more", [0.0, 0.001, -0.001])
def test_a_customary_shift_is_kept_however_surely_the_cross_joints_contradict_it(half_fit: Fit, more: float):
    even = replace(half_fit, distances_px=1e-3 * half_fit.distances_px)
    assert with_measured_shift(sheared(even, more)) is None
    # Where the shift is no customary one, as much is a correction.
    odd = replace(even, grid=replace(even.grid, shift=0.46))
    assert (with_measured_shift(sheared(odd, more)) is None) == (more == 0.0)


def test_a_photo_of_an_odd_bond_tells_its_shift():
    fit = fit_of(render_paving(replace(HALF_BOND, shift=0.47)))
    thought = replace(fit, grid=replace(fit.grid, shift=0.5))
    moved = sheared(thought, -0.03)
    measured = with_measured_shift(moved)
    assert measured is not None
    assert measured.grid.shift == pytest.approx(0.47, abs=0.001)
    assert np.isfinite(measured.distances_px).all()
