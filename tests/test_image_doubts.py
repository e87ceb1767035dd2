"""Doubted effects are taken out as far as the picture tells them, and their doubt is uncertainty."""

from __future__ import annotations

import numpy as np
import pytest

from autoreg.grey_levels.image_doubts import Averaged, Doubt, averaged_over

RNG = np.random.default_rng(4)
COLUMNS = RNG.standard_normal((400, 5))
# What is doubted looks partly like the first unknown.
COLUMNS[:, 3] += 1.5 * COLUMNS[:, 0]
H = COLUMNS.T @ COLUMNS
TRUE = np.array([0.3, -0.2, 0.1])
DOUBTS = (Doubt((0, 1), (0.1, 0.3, 1.0, 3.0), 0.5, 0.0, 0.0),)


def answered(effect: float, seed: int = 0, doubts: tuple[Doubt, ...] = DOUBTS) -> Averaged:
    noise = np.random.default_rng(seed).standard_normal(len(COLUMNS))
    y = COLUMNS @ np.r_[TRUE, effect, 0.0] + noise
    return averaged_over(doubts, H, COLUMNS.T @ y, 3)


def test_an_effect_that_is_there_is_taken_out() -> None:
    biased = np.linalg.solve(H[:3, :3], H[:3, 3]) * 2.0
    for seed in range(5):
        found = answered(2.0, seed)
        assert np.abs(found.step[:3] - TRUE).max() < 0.25 * np.abs(biased).max()
        assert found.step[3] == pytest.approx(2.0, abs=0.3)


def test_without_an_effect_the_answer_stays_near_the_plain_one() -> None:
    found = answered(0.0)
    plain = np.linalg.solve(H[:3, :3], H[:3] @ np.r_[TRUE, 0.0, 0.0])
    assert np.trace(found.added) < np.trace(found.plain)
    assert np.abs(found.step[:3] - plain).max() < 4 * np.sqrt(np.diag(found.plain)).max()


def squared_errors(effect: float, *, doubted: bool) -> np.ndarray:
    squares: list[float] = []
    for seed in range(60):
        found = answered(effect, seed)
        plain = np.linalg.solve(H[:3, :3], H[:3] @ np.r_[TRUE, effect, 0.0])
        error = found.step[:3] - TRUE if doubted else plain - TRUE
        covariance = found.plain + found.added if doubted else found.plain
        squares.append(error @ np.linalg.solve(covariance, error))
    return np.array(squares)


@pytest.mark.parametrize("effect", [0.0, 0.3, 2.0])
def test_the_errors_are_covered_with_and_without_an_effect(effect: float) -> None:
    squares = squared_errors(effect, doubted=True)
    assert np.mean(squares) < 4.5
    assert np.mean(squares < 7.81) > 0.85


def test_an_effect_that_is_hardly_told_is_covered_better_than_by_those_who_do_not_doubt() -> None:
    # Twice its own sigma: the worst case of every choice between models, 3 would be exact.
    assert np.mean(squared_errors(0.1, doubted=True)) < 7.0
    assert np.mean(squared_errors(0.1, doubted=False)) > 9.0


def test_a_drawing_that_is_vague_adds_what_it_does_to_the_answer() -> None:
    sharp = answered(2.0)
    vague = answered(2.0, doubts=(Doubt((0, 1), (0.1, 0.3, 1.0, 3.0), 0.5, 0.0, 1.0),))
    moved = np.linalg.solve(H[:3, :3], H[:3, 3]) * sharp.step[3]
    extra = vague.added - sharp.added
    assert np.trace(extra) == pytest.approx(moved @ moved, rel=0.05)


def test_an_effect_that_no_pixel_shows_changes_nothing() -> None:
    blind = H.copy()
    blind[3:], blind[:, 3:] = 0.0, 0.0
    found = averaged_over(DOUBTS, blind, np.r_[H[:3, :3] @ TRUE, 0.0, 0.0], 3)
    assert found.step == pytest.approx(np.r_[TRUE, 0.0, 0.0])
    assert np.abs(found.added).max() < 1e-9


def test_an_effect_that_is_never_none_widens_by_its_size() -> None:
    found = answered(0.0, doubts=(Doubt((0, 1), (1e-3,), 0.0, 0.0, 0.0),))
    carried = np.linalg.solve(H[:3, :3], H[:3, 3:])
    assert found.added == pytest.approx(1e-6 * carried @ carried.T, rel=0.01)
