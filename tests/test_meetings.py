from __future__ import annotations

import numpy as np
import pytest
from made_sides import drawn_presence, presence_with

from autoreg.answer.pattern_refusals import MOST_UNCROSSED, on_module
from autoreg.ground.sides import ALONG_X, Grid, Sides, slab_sides
from autoreg.paving.meetings import Meetings, meetings

CELLS = 24
SIDES = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, float(CELLS)))


def ashlar(seed: int) -> np.ndarray:
    """Sides between stones of one to four by one to three cells, laid at random on a module."""
    rng, stone = np.random.default_rng(seed), np.full((CELLS, CELLS), -1)
    for i, j in np.ndindex(CELLS, CELLS):
        if stone[i, j] < 0:
            wide, deep = rng.integers(1, 5), rng.integers(1, 4)
            room = stone[i : i + wide, j : j + deep]
            room[room < 0] = i * CELLS + j
    return between(stone)


def between(stone: np.ndarray) -> np.ndarray:
    """Which of the sides lie between two stones; those around the field do."""
    across = np.where((SIDES.family == ALONG_X)[:, None], [0.0, 0.5], [0.5, 0.0])
    framed = np.pad(stone, 2, constant_values=-9)
    before, beyond = (
        framed[tuple(np.clip(np.floor(SIDES.middle + way * across).astype(int) + 2, 0, CELLS + 3).T)]
        for way in (-1, 1)
    )
    return before != beyond


def met(there: np.ndarray, seed: int = 0, sides: Sides = SIDES) -> Meetings:
    return meetings(drawn_presence(sides, there, np.random.default_rng(seed), clearness=8.0))


@pytest.mark.parametrize(
    ("gone", "expected"),
    [
        ("", Meetings(1, 0, 0, 0, 0)),
        ("W", Meetings(0, 1, 0, 0, 0)),
        ("SN", Meetings(0, 0, 1, 0, 0)),
        ("WE", Meetings(0, 0, 0, 1, 0)),
        ("WN", Meetings(0, 0, 0, 0, 1)),
        ("WES", Meetings(0, 0, 0, 0, 0)),
        ("WESN", Meetings(0, 0, 0, 0, 0)),
    ],
)
def test_a_crossing_is_counted_by_its_sides(gone: str, expected: Meetings):
    crossing, ways = np.array([3.0, 3.0]), {"W": (-0.5, 0), "E": (0.5, 0), "S": (0, -0.5), "N": (0, 0.5)}
    sides = SIDES.take(np.flatnonzero(np.linalg.norm(SIDES.middle - crossing, axis=1) < 0.6))
    assert len(sides) == 4
    p = np.full(4, 0.001)
    for way in gone:
        p[np.linalg.norm(sides.middle - crossing - ways[way], axis=1).argmin()] = 0.9
    assert meetings(presence_with(sides, p)) == expected
    # Where one of them was not looked at, nothing is counted.
    assert meetings(presence_with(sides.take(np.arange(3)), p[:3])) == Meetings(0, 0, 0, 0, 0)


@pytest.mark.parametrize("seed", range(4))
def test_ashlar_on_a_module_is_refused(seed: int):
    refusal = on_module(met(ashlar(seed), seed))
    assert refusal is not None
    assert refusal.code == "no_lattice"
    assert refusal.measured is not None
    assert refusal.measured > MOST_UNCROSSED


@pytest.mark.parametrize("shares", [(1.0, 1.0), (0.8, 0.8), (0.6, 0.6), (1.0, 0.5), (0.9, 0.4)])
def test_slabs_are_not_however_many_of_their_joints_chance_hides(shares: tuple[float, float]):
    rng = np.random.default_rng(1)
    assert on_module(met(rng.uniform(size=len(SIDES)) < np.array(shares)[SIDES.family])) is None


@pytest.mark.parametrize("seed", range(3))
def test_slabs_are_not_under_leaves(seed: int):
    rng, hidden = np.random.default_rng(seed), np.zeros(len(SIDES), bool)
    while hidden.mean() < 0.5:
        centre, radius = rng.uniform(0, CELLS, 2), rng.uniform(0.6, 3.0)
        hidden |= np.linalg.norm(SIDES.middle - centre, axis=1) < radius
    assert on_module(met(~hidden)) is None


def test_few_crossings_tell_nothing():
    assert on_module(Meetings(crosses=2, tees=20, x_only=8, y_only=8, corners=0)) is None
