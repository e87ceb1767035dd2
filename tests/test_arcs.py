from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from paved import STACK, fit_of

from autoreg.answer.pattern_refusals import ARC_SIGMAS, MOST_ARC_DEG, MOST_BENT_DEG, arcs
from autoreg.fitting.fit import Fit
from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.rows.arcs import FEWEST_STATIONS, Arc, common_arc
from autoreg.rows.cross_joints import Lean
from autoreg.synthetic import render_paving


@pytest.fixture(scope="module")
def fit() -> Fit:
    return fit_of(render_paving(STACK))


def bent(fit: Fit, family: int, radius: float) -> Fit:
    """The fit of joints that are arcs of such a radius, each about a place of its own along it."""
    rows = fit.stations.family == family
    along = fit.stations.ground[:, family]
    middle = along[rows].mean() + 0.1 * fit.stations.line
    rise = rows * (along - middle) ** 2 / (2.0 * radius)
    moved = fit.distances_px + rise * fit.profiles.px_per_unit
    return replace(fit, distances_px=moved, sigma_px=fit.sigma_px + 1e3)


@pytest.mark.parametrize("family", [ALONG_X, ALONG_Y])
@pytest.mark.parametrize("radius", [60.0, 8.0, -4.0])
def test_arcs_turn_from_end_to_end_by_their_length_over_their_radius(fit: Fit, family: int, radius: float):
    found = common_arc(bent(fit, family, radius), family)
    assert found is not None
    length = np.ptp(fit.stations.ground[fit.usable & (fit.stations.family == family), family])
    assert found.turn == pytest.approx(length / radius, rel=0.05, abs=5 * found.sigma)
    assert found.sigma < 0.01
    refusal = arcs(found)
    assert (refusal is not None) == (abs(length / radius) > np.radians(MOST_ARC_DEG))
    assert refusal is None or "arcs" in refusal.message


@pytest.mark.parametrize("family", [ALONG_X, ALONG_Y])
def test_straight_joints_are_no_arcs_whatever_the_others_are(fit: Fit, family: int):
    found = common_arc(bent(fit, 1 - family, 4.0), family)
    assert found is not None
    assert abs(found.turn) < np.radians(0.5)
    assert arcs(found) is None


def test_too_few_stations_or_an_unsure_turn_tell_no_arc(fit: Fit):
    few = np.flatnonzero(fit.stations.family == ALONG_X)[FEWEST_STATIONS - 1 :]
    usable = fit.usable.copy()
    usable[few] = False
    assert common_arc(replace(fit, usable=usable), ALONG_X) is None
    assert arcs(None) is None
    turn = 2.0 * np.radians(MOST_ARC_DEG)
    assert arcs(Arc(turn, turn / (ARC_SIGMAS - 1.0))) is None
    assert arcs(Arc(turn, turn / (ARC_SIGMAS + 1.0))) is not None


def test_a_bow_whose_cross_joints_do_not_turn_along_is_that_of_the_ground_or_the_lens():
    bow = np.radians(0.5 * (MOST_ARC_DEG + MOST_BENT_DEG))
    arc = Arc(bow, 0.01 * bow)
    still = Lean(0.05 * bow, 0.05 * bow)
    assert arcs(arc, still) is None
    assert arcs(arc, None) is not None
    # As the stones of arcs do, to whichever side; or it is not known whether they do.
    assert arcs(arc, Lean(0.9 * bow, 0.05 * bow)) is not None
    assert arcs(arc, Lean(-0.9 * bow, 0.05 * bow)) is not None
    assert arcs(arc, Lean(0.05 * bow, 0.5 * bow)) is not None
    wide = Arc(1.1 * np.radians(MOST_BENT_DEG), 0.01 * bow)
    assert arcs(wide, still) is not None
