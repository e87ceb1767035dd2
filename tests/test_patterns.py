from __future__ import annotations

import numpy as np
import pytest
from made_sides import made_presence, presence_with

from autoreg.lattice_choice import departs
from autoreg.patterns import best_pattern, broken
from autoreg.stations import ALONG_X, ALONG_Y, Grid, slab_sides


@pytest.mark.parametrize(
    ("period", "advance", "phase"), [(2, 0, 1), (2, 1, 0), (3, 1, 2), (3, 2, 1), (4, 2, 3), (5, 2, 0)]
)
@pytest.mark.parametrize("family", [ALONG_X, ALONG_Y])
def test_the_pattern_of_absent_sides_is_found(period: int, advance: int, phase: int, family: int):
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 10.0))
    residue = (sides.line - sides.cell * advance) % period
    there = (sides.family != family) | (residue == phase)
    best = best_pattern(made_presence(there), family)[0]
    assert (best.period, best.advance, best.phase) == (period, advance, phase)
    other = ALONG_Y if family == ALONG_X else ALONG_X
    assert best_pattern(made_presence(there), other)[0].period == 1


def test_where_all_sides_are_there_none_is_left_out():
    patterns = best_pattern(made_presence(np.array(True)), ALONG_X)
    assert patterns[0].period == 1
    assert patterns[0].score > patterns[1].score > 0


def test_some_sides_missing_at_random_are_no_pattern():
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 10.0))
    there = np.random.default_rng(5).uniform(size=len(sides)) > 0.3
    assert best_pattern(made_presence(there), ALONG_Y)[0].period == 1


@pytest.mark.parametrize("family", [ALONG_X, ALONG_Y])
def test_regular_gaps_speak_against_a_lattice_and_random_ones_do_not(family: int):
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 10.0))
    regular = (sides.family != family) | (sides.line % 2 == 0)
    assert departs(made_presence(regular))
    assert not departs(made_presence(np.random.default_rng(3).uniform(size=len(sides)) > 0.3))


@pytest.mark.parametrize("worn", [0.0, 0.3])
@pytest.mark.parametrize("family", [ALONG_X, ALONG_Y])
def test_joints_that_break_off_as_those_of_herringbone_are_told_from_worn_ones(family: int, worn: float):
    rng = np.random.default_rng(7)
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 20.0))
    # In no order: of sides of one size it is the first half that is looked at.
    sides = sides.take(rng.permutation(len(sides)))
    # Blocks two squares long: every fourth side would cut one, a square farther on in every course.
    cuts = (sides.family == family) & ((sides.line - sides.cell) % 4 == 2)
    seen = rng.uniform(size=len(sides)) > worn

    def presence(there: np.ndarray):
        p = np.where(there, rng.beta(0.2, 2.0, len(sides)), rng.uniform(size=len(sides)))
        return presence_with(sides, np.maximum(p, 1e-3))

    assert broken(presence(seen & ~cuts), family)
    assert not broken(presence(seen & ~cuts), ALONG_X + ALONG_Y - family)
    for _ in range(5):
        assert not broken(presence(rng.uniform(size=len(sides)) > worn), family)
