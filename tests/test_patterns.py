from __future__ import annotations

import numpy as np
import pytest
from made_sides import drawn_presence, made_presence, presence_with

from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid, slab_sides
from autoreg.paving.lattice_choice import departs, hopeful
from autoreg.paving.patterns import best_pattern, broken, half_there, outstanding, skipping, true_sides
from autoreg.paving.presence import Presence


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


def weakly_there(chosen: np.ndarray, weaker: float) -> Presence:
    """Sides all of which are there, most of those that are not chosen so much weaker than the others."""
    rng = np.random.default_rng(1)
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 10.0))
    marked = rng.uniform(size=len(sides)) < 0.6
    p = np.where(chosen | marked, 0.01, rng.uniform(size=len(sides)))
    support = rng.normal(0.6, 0.1, len(sides)) - np.where(chosen, 0.0, weaker)
    return presence_with(sides, p, support=np.where(chosen | marked, support, 0.1))


@pytest.mark.parametrize(("period", "advance", "phase"), [(2, 0, 1), (2, 1, 0), (3, 0, 2), (3, 2, 1)])
@pytest.mark.parametrize("family", [ALONG_X, ALONG_Y])
def test_joints_stand_out_from_weaker_marks_between_them(period: int, advance: int, phase: int, family: int):
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 10.0))
    chosen = (sides.family != family) | ((sides.line - sides.cell * advance) % period == phase)
    presence = weakly_there(chosen, 0.2)
    # So many are there that their absence would tell nothing.
    assert best_pattern(presence, family)[0].period == 1
    found = true_sides(presence, family)
    assert (found.period, found.advance, found.phase) == (period, advance, phase)
    other = ALONG_Y if family == ALONG_X else ALONG_X
    assert outstanding(presence, other) is None


def test_worn_joints_are_not_taken_for_marks_between_others():
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 10.0))
    # Every second one is worn away in places, and as strong as the others where it is not.
    assert outstanding(weakly_there((sides.line % 2 == 0), 0.0), ALONG_X) is None


@pytest.mark.parametrize("shift", [1 / 3, 0.5, 0.75])
@pytest.mark.parametrize("worn", [0.0, 0.3])
def test_of_unbroken_joints_of_slabs_both_kinds_of_pieces_are_there(shift: float, worn: float):
    rng = np.random.default_rng(7)
    sides = slab_sides(Grid(1.0, 0.5, shift), np.zeros(2), np.full(2, 12.0))
    seen = rng.uniform(size=len(sides)) >= worn
    assert not half_there(drawn_presence(sides, seen, rng))
    second = sides.cell % 2 == 1
    pieces = [np.flatnonzero((sides.family == ALONG_X) & (second == kind)) for kind in (False, True)]
    short, long = sorted(pieces, key=lambda rows: float(np.ptp(sides.ends[rows[0], :, 0])))
    # Edges of hexagons are the shorter ones; those of slabs may well be too short to be seen.
    for gone, halved in ((long, True), (short, shift == 0.5)):
        left = seen.copy()
        left[gone] = False
        assert half_there(drawn_presence(sides, left, rng)) == halved
    assert not half_there(drawn_presence(sides, seen & (sides.family == ALONG_Y), rng))


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


@pytest.mark.parametrize("family", [ALONG_X, ALONG_Y])
def test_cut_blocks_that_show_marks_where_joints_would_be_break_off_none_the_less(family: int):
    rng = np.random.default_rng(7)
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 20.0))
    cuts = (sides.family == family) & ((sides.line - sides.cell) % 4 == 2)
    marked = rng.uniform(size=len(sides)) < 0.45
    p = np.where(cuts & ~marked, rng.uniform(size=len(sides)), 0.002)
    assert 0.2 < p[cuts].mean() < 0.33
    assert broken(presence_with(sides, p), family)
    # As many that are anywhere are worn.
    assert not broken(presence_with(sides, rng.permutation(p)), family)


@pytest.mark.parametrize("family", [ALONG_X, ALONG_Y])
def test_a_few_joints_of_which_moss_hides_some_do_not_break_off(family: int):
    rng = np.random.default_rng(3)
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 3.0))
    hidden = rng.uniform(size=(200, len(sides))) < 0.22
    p = np.where(hidden, rng.uniform(0.3, 1.0, hidden.shape), rng.uniform(0.01, 0.15, hidden.shape))
    alarms = sum(broken(presence_with(sides, own), family) for own in p)
    assert alarms <= 7


@pytest.mark.parametrize("family", [ALONG_X, ALONG_Y])
def test_whole_lines_that_break_off_in_turn_are_told_from_a_few_that_are_worn(family: int):
    rng = np.random.default_rng(13)
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 18.0))
    sides = sides.take(rng.permutation(len(sides)))
    thirds = (sides.family != family) | (sides.line % 3 != 1)
    lines = np.unique(sides.line)

    def presence(there: np.ndarray) -> Presence:
        return drawn_presence(sides, there, rng, 1.2)

    assert broken(presence(thirds), family)
    assert not broken(presence(thirds), ALONG_X + ALONG_Y - family)
    for _ in range(20):
        worn = rng.choice(lines, len(lines) // 4, replace=False)
        assert not broken(presence((sides.family != family) | ~np.isin(sides.line, worn)), family)


@pytest.mark.parametrize("family", [ALONG_X, ALONG_Y])
def test_pinwheels_of_large_and_small_squares_leave_out_two_of_five_joints(family: int):
    rng = np.random.default_rng(17)
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 16.0))
    sides = sides.take(rng.permutation(len(sides)))
    # A square of two by two and one of one by one in turn: joints that would cut the large ones are absent.
    ours = (sides.family != family) | ~np.isin((sides.line - 2 * sides.cell) % 5, (0, 3))

    def presence(there: np.ndarray) -> Presence:
        return drawn_presence(sides, there, rng, 3.0)

    assert broken(presence(ours), family)
    assert not broken(presence(ours), ALONG_X + ALONG_Y - family)
    for _ in range(20):
        worn = rng.uniform(size=len(sides)) < 0.4
        assert not broken(presence(~worn), family)


@pytest.mark.parametrize("worn", [0.0, 0.2])
@pytest.mark.parametrize("family", [ALONG_X, ALONG_Y])
def test_slabs_twice_as_long_are_told_from_worn_joints_wherever_their_courses_begin(family: int, worn: float):
    rng = np.random.default_rng(11)
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 12.0))
    seen = rng.uniform(size=len(sides)) > worn
    # Each course begins at one of two places.
    begins = rng.integers(0, 2, int(sides.cell.max()) + 2)
    ours = (sides.family != family) | ((sides.line + begins[sides.cell]) % 2 == 0)

    def presence(there: np.ndarray) -> Presence:
        p = np.where(there, rng.beta(0.2, 2.0, len(sides)), rng.uniform(size=len(sides)))
        return presence_with(sides, np.maximum(p, 1e-3), beaten=p)

    twice = presence(seen & ours)
    assert best_pattern(twice, family)[0].period == 1
    assert skipping(twice, family)
    assert departs(twice)
    assert not skipping(twice, ALONG_X + ALONG_Y - family)
    for missing in (0.1, 0.3, 0.5, 0.7):
        assert not skipping(presence(rng.uniform(size=len(sides)) > missing), family)


def test_a_start_may_be_worth_following_for_one_family_or_only_for_both():
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 10.0))
    one, both, none = (
        made_presence(there) for there in (sides.family == ALONG_X, np.array(True), np.array(False))
    )
    assert hopeful(one, both=False)
    assert not hopeful(one, both=True)
    assert hopeful(both, both=True)
    assert not hopeful(none, both=False)
