"""The design effect is one for white scores, and as large as what cells or joints share makes it."""

from __future__ import annotations

import numpy as np
import pytest

from autoreg.fitting.design_effect import Asked, design_effects, drawn_design_effect

SIDE, UNKNOWNS = 12, 5
PLACES = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), -1).reshape(-1, 2).astype(float)


def solved_scores(seed: int, slab_sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Scores of cells at a least-squares solution, and their information, for noise and for slabs that move.

    Four pixels of every cell see one slab each; a slab's place enters the four cells at its corners alike.
    """
    rng = np.random.default_rng(seed)
    columns = rng.standard_normal((len(PLACES), 1, UNKNOWNS)) * np.ones((1, 4, 1))
    # Neighbours see about the same derivatives, as on a real ground.
    smooth = np.stack([np.sin(0.3 * PLACES @ v) for v in rng.standard_normal((UNKNOWNS, 2))], -1)
    columns = 0.2 * columns + smooth[:, None]
    slabs = slab_sigma * rng.standard_normal((SIDE + 1, SIDE + 1))
    i, j = PLACES.astype(int).T
    moved = np.stack([slabs[i + p, j + q] for p in (0, 1) for q in (0, 1)], 1)
    y = moved + rng.standard_normal(moved.shape)
    flat = columns.reshape(-1, UNKNOWNS)
    left = y - (columns @ np.linalg.lstsq(flat, y.ravel(), rcond=None)[0])
    return np.einsum("cpk,cp->ck", columns, left), np.einsum("cpk,cpl->ckl", columns, columns)


def by_cells(scores: np.ndarray, told: np.ndarray, unknowns: slice) -> tuple[float, float]:
    asked = Asked.of(told.sum(0), unknowns)
    return design_effects(scores @ asked.combined.T, asked.combined @ told, asked, PLACES, 1.0)


def effects(slab_sigma: float, asked: slice) -> np.ndarray:
    pairs = [by_cells(*solved_scores(seed, slab_sigma), asked) for seed in range(60)]
    return np.mean(pairs, 0)


@pytest.mark.parametrize("asked", [slice(0, UNKNOWNS), slice(0, 3)])
def test_white_noise_has_an_effect_of_one_by_cells_and_by_neighbours(asked: slice) -> None:
    assert effects(0.0, asked) == pytest.approx([1.0, 1.0], abs=0.12)


def test_places_that_cells_share_are_seen_in_full_by_neighbours_only() -> None:
    # Four pixels of a cell add up to 1 + s^2 of its information; with its neighbours it is nearly 1 + 4 s^2.
    alone, beside = effects(1.0, slice(0, UNKNOWNS))
    assert alone == pytest.approx(2.0, rel=0.15)
    assert beside > 1.6 * alone


def drawn(seed: int, line_sigma: float) -> float:
    rng = np.random.default_rng(seed)
    line, n = np.repeat(np.arange(15), 20), 300
    columns = np.column_stack([np.ones(n), line / 15.0, rng.standard_normal(n)])
    inverse = np.linalg.inv(columns.T @ columns)
    y = rng.standard_normal((n, 17))
    y[:, 0] += line_sigma * rng.standard_normal(15)[line]
    pulls = y - columns @ (inverse @ (columns.T @ y))
    return drawn_design_effect(columns, inverse, pulls, [line, np.arange(n) % 50], 3)


def test_measurements_as_the_model_has_them_have_a_drawn_effect_of_about_one() -> None:
    assert np.mean([drawn(seed, 0.0) for seed in range(40)]) == pytest.approx(1.0, abs=0.3)


def test_lines_that_lie_off_as_a_whole_raise_the_drawn_effect() -> None:
    # Twenty measurements that share as much again as the noise of each: by up to 21.
    assert np.mean([drawn(seed, 1.0) for seed in range(40)]) > 5.0
