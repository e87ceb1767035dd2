from __future__ import annotations

import numpy as np
import pytest

from autoreg.fitting.fit import Fit
from autoreg.fitting.scatter import beside_rim, scatter_model
from autoreg.ground.sides import ALONG_X
from autoreg.solve.joint_data import PARAMETERS
from autoreg.solve.solver import Solution

NOTHING = Solution("converged", np.zeros(PARAMETERS), 0.0, np.zeros(3), np.zeros((3, PARAMETERS)), 1)


@pytest.mark.parametrize("end", ["first", "last"])
def test_an_outermost_line_that_lies_off_is_a_rim_and_an_inner_one_is_not(stack_fit: Fit, end: str):
    stations, usable = stack_fit.stations, stack_fit.usable
    off = np.random.default_rng(0).normal(0.0, 0.002, len(stations))
    lines = np.unique(stations.line[usable & (stations.family == ALONG_X)])
    rim = lines[0] if end == "first" else lines[-1]
    for line, taken in ((rim, True), (lines[len(lines) // 2], False)):
        moved = usable & (stations.family == ALONG_X) & (stations.line == line)
        off_px = 30.0 * np.where(moved, off + 0.04, off)
        beside = beside_rim(off_px, np.full(len(off), 30.0), stations, usable)
        assert (beside == (moved & taken)).all()


def test_uneven_lines_have_no_rim(stack_fit: Fit):
    stations, usable = stack_fit.stations, stack_fit.usable
    of_line = np.random.default_rng(1).normal(0.0, 0.01, 1000)
    off = of_line[stations.line + 500 * stations.family]
    assert beside_rim(30.0 * off, np.full(len(off), 30.0), stations, usable).mean() < 0.1


@pytest.mark.parametrize("share", [0.0, 1.0], ids=["measured badly", "laid badly"])
def test_the_scatter_model_tells_what_was_measured_badly_from_what_was_laid_badly(share: float):
    rng = np.random.default_rng(6)
    n = 1500
    measured, px_per_unit = rng.uniform(0.02, 0.2, n), rng.uniform(50.0, 500.0, n)
    truth = share * 0.002 * px_per_unit + (1 - share) * measured
    model = scatter_model(rng.normal(0, truth), measured, px_per_unit, np.arange(n), np.ones(n, bool))
    assert np.median(model / truth) == pytest.approx(1.0, abs=0.3)
    assert np.corrcoef(model, truth)[0, 1] > 0.8
