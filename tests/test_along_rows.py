"""Segments along the rows speak against rows that only a part of the ground seems to have."""

from dataclasses import replace

import numpy as np
import pytest

from autoreg.fitting.fit import Fit
from autoreg.ground.points import project_ground
from autoreg.ground.sides import Grid
from autoreg.rows.along_rows import AlongRows, along_rows
from autoreg.rows.cross_joints import CrossJoints, in_columns
from autoreg.segments import Segments

WIDTH = 0.3
FIELD = np.array([[-0.5, 1.0], [0.5, 1.0], [0.5, 2.0], [-0.5, 2.0]])


@pytest.fixture(scope="module")
def rows_fit(half_fit: Fit) -> Fit:
    return replace(half_fit, grid=Grid(None, WIDTH))


def segments_at(fit: Fit, place: np.ndarray, turn_rad: float = 0.0) -> Segments:
    """Segments of 0.2 m with their middles at such places of the ground, turned from the rows."""
    half = 0.1 * np.array([np.cos(turn_rad), np.sin(turn_rad)])
    ends = place[:, None] + np.stack([-half, half])
    px = project_ground(fit.camera, fit.cam_from_ground, ends)
    seen = px[np.isfinite(px).all((1, 2))]
    return Segments(seen, np.full(len(seen), 0.2), np.zeros(len(seen), int))


def places(rng: np.random.Generator, low: list[float], high: list[float], count: int = 200) -> np.ndarray:
    return rng.uniform(low, high, (count, 2))


def on_joints(place: np.ndarray) -> np.ndarray:
    return np.column_stack([place[:, 0], WIDTH * np.round(place[:, 1] / WIDTH)])


def said_of(fit: Fit, segments: Segments, contrast: np.ndarray | float = 20.0) -> AlongRows:
    contrasts = np.broadcast_to(np.asarray(contrast, float), (len(segments),))
    return along_rows(segments, contrasts, fit, FIELD, (fit.camera.width, fit.camera.height))


def test_edges_of_the_rows_joints_speak_for_them(rows_fit: Fit):
    rng = np.random.default_rng(0)
    edges = on_joints(places(rng, [-2.0, 0.6], [2.0, 4.0])) + rng.choice([-0.01, 0.01], (200, 1)) * [0.0, 1.0]
    said = said_of(rows_fit, segments_at(rows_fit, edges))
    assert (said.in_field, said.around) == (1.0, 1.0)
    assert not said.contradict


@pytest.mark.parametrize(("blur_px", "speak_for"), [(3.5, True), (0.5, False)])
def test_edges_lie_as_far_from_their_joints_as_these_are_blurred(
    rows_fit: Fit, blur_px: float, speak_for: bool
):
    # Far away a row is thirty pixels wide, and five are more than an eighth of that.
    fit = replace(rows_fit, strip=replace(rows_fit.strip, blur_px=blur_px))
    edges = on_joints(places(np.random.default_rng(5), [-0.5, 2.6], [0.5, 3.0]))
    field = np.array([[-0.6, 2.4], [0.6, 2.4], [0.6, 3.2], [-0.6, 3.2]])
    segments = segments_at(fit, edges)
    segments = replace(segments, ends_px=segments.ends_px + np.array([0.0, 5.0]))
    size = (fit.camera.width, fit.camera.height)
    said = along_rows(segments, np.full(len(segments), 20.0), fit, field, size)
    assert said.contradict is not speak_for


def test_rows_of_a_few_blurs_do_not_tell_what_lies_on_their_joints(rows_fit: Fit):
    anywhere = segments_at(rows_fit, places(np.random.default_rng(1), [-0.5, 1.0], [0.5, 2.0]))
    assert said_of(rows_fit, anywhere).contradict
    soft = replace(rows_fit, strip=replace(rows_fit.strip, blur_px=40.0))
    assert not said_of(soft, anywhere).contradict


def test_courses_that_lie_elsewhere_in_the_field_speak_against_its_rows(rows_fit: Fit):
    anywhere = places(np.random.default_rng(1), [-0.5, 1.0], [0.5, 2.0])
    said = said_of(rows_fit, segments_at(rows_fit, anywhere))
    assert said.in_field == pytest.approx(0.24, abs=0.1)
    assert said.contradict


def test_a_patch_of_even_courses_is_not_the_ground_if_most_of_that_has_others(rows_fit: Fit):
    rng = np.random.default_rng(2)
    patch = on_joints(places(rng, [-0.5, 1.0], [0.5, 2.0], 30))
    beside = places(rng, [-1.5, 2.0], [1.5, 3.0], 200)
    said = said_of(rows_fit, segments_at(rows_fit, np.concatenate([patch, beside])))
    assert said.in_field > 0.95
    assert said.contradict
    # What lies far beyond the field, a wall with courses of its own perhaps, has no say.
    far = segments_at(rows_fit, np.concatenate([patch, np.add(beside, [0.0, 1.5])]))
    assert not said_of(rows_fit, far).contradict


def test_what_runs_another_way_says_nothing(rows_fit: Fit):
    across = segments_at(rows_fit, places(np.random.default_rng(3), [-2.0, 0.6], [2.0, 4.0]), turn_rad=0.3)
    assert not said_of(rows_fit, across).contradict
    nothing = across.take(np.zeros(0, dtype=int))
    assert not said_of(rows_fit, nothing).contradict


def test_a_grain_that_is_fainter_than_the_joints_does_not_speak_against_rows(rows_fit: Fit):
    rng = np.random.default_rng(7)
    joints = on_joints(places(rng, [-0.5, 1.0], [0.5, 2.0], 100))
    grain = places(rng, [-0.5, 1.0], [0.5, 2.0], 150)
    both = segments_at(rows_fit, np.concatenate([joints, grain]))
    assert len(both) == 250
    assert said_of(rows_fit, both).contradict
    faint = np.repeat([20.0, 8.0], [100, 150])
    assert not said_of(rows_fit, both, faint).contradict
    # Joints of other courses are as clear as those of the rows, however few of these are very clear.
    other = np.repeat([20.0, 60.0, 20.0], [70, 30, 150])
    assert said_of(rows_fit, both, other).contradict


def test_joints_that_are_missed_by_little_are_no_grain_however_faint(rows_fit: Fit):
    rng = np.random.default_rng(8)
    place = on_joints(places(rng, [-0.5, 1.0], [0.5, 2.0], 250))
    place[100:, 1] += 0.2 * WIDTH * rng.choice([-1.0, 1.0], 150)
    assert said_of(rows_fit, segments_at(rows_fit, place), np.repeat([20.0, 8.0], [100, 150])).contradict


def test_fainter_joints_midway_between_those_of_rows_are_no_grain(rows_fit: Fit):
    place = on_joints(places(np.random.default_rng(9), [-0.5, 1.0], [0.5, 1.8], 250))
    place[100:, 1] += 0.5 * WIDTH
    assert said_of(rows_fit, segments_at(rows_fit, place), np.repeat([20.0, 8.0], [100, 150])).contradict


def test_ragged_edges_lie_on_a_joint_that_is_wide_and_beside_one_that_is_narrow(rows_fit: Fit):
    rng = np.random.default_rng(10)
    # As between old bricks: half a joint off its middle, by uneven shares of a row's width.
    off = rng.choice([-1.0, 1.0], 200) * (0.1 + rng.uniform(0.0, 0.06, 200))
    edges = on_joints(places(rng, [-2.0, 0.6], [2.0, 4.0])) + np.column_stack([np.zeros(200), WIDTH * off])
    for share, contradict in ((0.2, False), (0.04, True)):
        strip = replace(rows_fit.strip, width=(share * WIDTH, rows_fit.strip.width[1]))
        said = said_of(replace(rows_fit, strip=strip), segments_at(rows_fit, edges))
        assert said.contradict == contradict


def cross_joints(x: np.ndarray, row: np.ndarray) -> CrossJoints:
    """Both edges of joints at such places along their rows."""
    edges = np.concatenate([x - 0.008, x + 0.008])
    return CrossJoints(np.column_stack([edges, np.tile((row + 0.5) * WIDTH, 2)]), 50.0)


@pytest.mark.parametrize("seen_as", [1.0, 0.8, 1.2])
@pytest.mark.parametrize("move", [0.0, 0.3])
@pytest.mark.parametrize("jitter", [0.0, 0.02])
def test_the_joints_of_herringbone_stand_in_columns_of_its_slabs_width(
    seen_as: float, move: float, jitter: float
):
    rng = np.random.default_rng(4)
    row = rng.integers(0, 12, 60)
    x = seen_as * WIDTH * (rng.integers(-12, 12, 60) + move * row) + jitter * rng.standard_normal(60)
    assert in_columns(cross_joints(x, row), WIDTH)


def test_so_do_those_of_worn_herringbone_among_as_many_other_marks():
    rng = np.random.default_rng(6)
    row = rng.integers(0, 12, 100)
    x = WIDTH * rng.integers(-12, 12, 100).astype(float)
    x[55:] = rng.uniform(x.min(), x.max(), 45)
    assert in_columns(cross_joints(x, row), WIDTH)


def test_the_cross_joints_of_rows_stand_in_no_columns():
    rng = np.random.default_rng(5)
    random = [
        in_columns(cross_joints(rng.uniform(-3.0, 3.0, n), rng.integers(0, 12, n)), WIDTH)
        for n in range(4, 300)
    ]
    assert sum(random) == 0


def test_the_cross_joints_of_a_long_bond_stand_in_no_columns_of_the_width():
    row, column = np.divmod(np.arange(120), 12)
    assert not in_columns(cross_joints(1.87 * WIDTH * (column + 0.23 * row**1.5), row), WIDTH)
