"""Edges inside the slabs of a lattice tell that it is one of patterns, such as of herringbone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from autoreg.answer.pattern_refusals import filled
from autoreg.fitting.fit import Fit
from autoreg.ground.points import project_ground
from autoreg.ground.sides import Grid, visible_sides
from autoreg.paving.inner_joints import inner_share
from autoreg.segments import Segments

FIELD = np.array([[-50.0, -50.0], [50.0, -50.0], [50.0, 50.0], [-50.0, 50.0]])


def segments_of(fit: Fit, ends: np.ndarray) -> Segments:
    """Segments of the picture along lines on the ground."""
    px = project_ground(fit.camera, fit.cam_from_ground, ends)
    return Segments(px, np.full(len(px), 0.1), np.zeros(len(px), int))


def sides_of(fit: Fit, grid: Grid) -> np.ndarray:
    return visible_sides(fit.camera, fit.cam_from_ground, grid).ends


def test_edges_on_the_joints_alone_are_those_of_slabs(stack_fit: Fit) -> None:
    share = inner_share(segments_of(stack_fit, sides_of(stack_fit, stack_fit.grid)), stack_fit, FIELD)
    assert share == 0.0
    assert filled(share) is None


def test_cells_that_hold_several_stones_are_no_slabs(stack_fit: Fit) -> None:
    a, b = stack_fit.grid.spacing_x, stack_fit.grid.spacing_y
    assert a is not None
    cells = replace(stack_fit, grid=Grid(4 * a, 3 * b))
    segments = segments_of(stack_fit, sides_of(stack_fit, stack_fit.grid))
    share = inner_share(segments, cells, FIELD)
    # Of four joints three lie inside, of three two, where lines anywhere would have six of ten.
    assert share == pytest.approx(0.75 / 0.6, abs=0.25)
    refusal = filled(share)
    assert refusal is not None
    assert refusal.code == "no_lattice"
    assert refusal.measured == pytest.approx(share, abs=0.01)


def test_another_field_in_a_part_of_the_hull_says_nothing(stack_fit: Fit) -> None:
    a, b = stack_fit.grid.spacing_x, stack_fit.grid.spacing_y
    assert a is not None
    ends = sides_of(stack_fit, stack_fit.grid)
    small = sides_of(stack_fit, Grid(a / 3, b / 3))
    beside = small[small.mean(1)[:, 0] > np.quantile(ends.mean(1)[:, 0], 0.6)]
    assert len(beside) > 40
    segments = segments_of(stack_fit, np.concatenate([ends, beside]))
    assert filled(inner_share(segments, stack_fit, FIELD)) is None


@pytest.mark.parametrize("turned", [False, True])
def test_the_grain_of_boards_is_no_joint_of_theirs_but_joints_across_boards_are(
    stack_fit: Fit, turned: bool
) -> None:
    a, b = stack_fit.grid.spacing_x, stack_fit.grid.spacing_y
    assert a is not None
    boards = replace(stack_fit, grid=Grid(a, 4 * a) if turned else Grid(4 * b, b))
    middle = np.random.default_rng(0).uniform(-4.0, 4.0, (3000, 2)) * [a, b]
    step = 0.3 * (np.array([0.0, b]) if turned else np.array([a, 0.0]))
    grain = np.stack([middle - step, middle + step], 1)
    assert filled(inner_share(segments_of(stack_fit, grain), boards, FIELD)) is None
    assert filled(inner_share(segments_of(stack_fit, grain[:, :, ::-1]), boards, FIELD)) is not None


def test_a_few_edges_in_slabs_say_nothing(stack_fit: Fit) -> None:
    a, b = stack_fit.grid.spacing_x, stack_fit.grid.spacing_y
    assert a is not None
    inner = np.array([[[(i + 0.5) * a, 0.1 * b], [(i + 0.5) * a, 0.9 * b]] for i in range(-5, 5)])
    assert inner_share(segments_of(stack_fit, inner), stack_fit, FIELD) == 0.0


def test_rows_have_no_slabs_to_look_into(stack_fit: Fit) -> None:
    rows = replace(stack_fit, grid=Grid(None, stack_fit.grid.spacing_y))
    assert inner_share(segments_of(stack_fit, sides_of(stack_fit, stack_fit.grid)), rows, FIELD) == 0.0
