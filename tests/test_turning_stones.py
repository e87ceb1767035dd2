"""Stones that turn across their field are those of fans, however straight the joints along its middle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import Float, UInt8
from paved import STACK, fit_of
from tiles import photo_of

from autoreg.align import align
from autoreg.answer.full_resolution import _turned
from autoreg.answer.pattern_refusals import MOST_FANNED_DEG, turning, zigzag
from autoreg.camera import Camera
from autoreg.errors import Refusal
from autoreg.fitting.fit import Fit
from autoreg.geometry import Rigid
from autoreg.ground.points import inside_box, on_ground, project_ground
from autoreg.ground.sides import ALONG_X, ALONG_Y
from autoreg.rows.turning_stones import (
    AROUND,
    FEWEST_SEGMENTS,
    common_turn,
    directions,
    straight,
    turn_across,
    turn_of_rows,
    turned_alike,
)
from autoreg.segments import Segments
from autoreg.synthetic import look_at_ground, render_paving
from benchmarks.raytrace.scene import Paving
from benchmarks.raytrace.slabs import Slabs, lay

# Courses of the field, each with as many stones; their sides are shorter than the slabs of the fit.
COUNT, SHORT = 8, 0.9


@pytest.fixture(scope="module")
def fit() -> Fit:
    return fit_of(render_paving(STACK))


def sides_turned(
    fit: Fit, along: int, turn_deg: float, families: tuple[int, ...] = (ALONG_X, ALONG_Y)
) -> tuple[Segments, Float[np.ndarray, "4 2"]]:
    """Sides of stones, and their field: those of some families turn by so much from end to end along an axis.

    The middle of each side lies where it does on a lattice.
    """
    sizes = np.array([fit.grid.spacing_x, fit.grid.spacing_y], float)
    cells = np.stack(np.meshgrid(np.arange(COUNT), np.arange(COUNT), indexing="ij"), -1).reshape(-1, 2)
    # Before the camera, where it looks down at the ground.
    eye, ahead = fit.cam_from_ground.origin_in_a, fit.cam_from_ground.R[2, :2]
    start = eye[:2] + 1.6 * eye[2] * ahead / np.linalg.norm(ahead) - 0.5 * COUNT * sizes
    ends: list[np.ndarray] = []
    for family in (ALONG_X, ALONG_Y):
        middle = start + (cells + 0.5 * np.eye(2)[family]) * sizes
        place = (cells[:, along] - 0.5 * (COUNT - 1)) / (COUNT - 1)
        angle = np.radians(turn_deg * place if family in families else 0.0 * place)
        angle = angle + family * np.pi / 2
        half = 0.5 * SHORT * sizes[family] * np.stack([np.cos(angle), np.sin(angle)], -1)
        ends.append(np.stack([middle - half, middle + half], 1))
    ground = np.concatenate(ends)
    px = project_ground(fit.camera, fit.cam_from_ground, ground.reshape(-1, 2)).reshape(-1, 2, 2)
    n = len(px)
    low, high = start - sizes, start + (COUNT + 1) * sizes
    field = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    return Segments(px, np.full(n, 0.2), np.zeros(n, int)), field


@pytest.mark.parametrize("along", [ALONG_X, ALONG_Y])
@pytest.mark.parametrize("turn_deg", [0.0, 6.0, 30.0, -24.0])
def test_stones_turn_from_third_to_third_by_most_of_what_they_do_from_end_to_end(
    fit: Fit, along: int, turn_deg: float
):
    segments, field = sides_turned(fit, along, turn_deg)
    turn = common_turn(segments, fit, field)
    refusal = turning(turn)
    assert (refusal is not None) == (abs(turn_deg) > 1.5 * MOST_FANNED_DEG)
    if turn_deg:
        assert turn is not None
        # Of eight courses the thirds' middle ones are five apart, of seven in all.
        assert np.degrees(turn.angle) == pytest.approx(5 / 7 * turn_deg, rel=0.05)
    if refusal is not None:
        assert "turn by" in refusal.message


@pytest.mark.parametrize("along", [ALONG_X, ALONG_Y])
def test_joints_across_a_family_turn_by_themselves(fit: Fit, along: int):
    segments, field = sides_turned(fit, along, 6.0, families=(along,))
    straight_across = turn_across(segments, fit, field, along)
    assert straight_across is not None
    assert straight_across.angle == pytest.approx(0.0, abs=1e-3)
    segments, field = sides_turned(fit, along, 6.0, families=(1 - along,))
    turned = turn_across(segments, fit, field, along)
    assert turned is not None
    assert np.degrees(abs(turned.angle)) == pytest.approx(5 / 7 * 6.0, rel=0.05)


def test_stones_that_turn_around_a_small_field_count_where_that_is_asked_for(fit: Fit):
    segments, field = sides_turned(fit, ALONG_X, 30.0)
    middle = field.mean(0)
    # A third of it as long and as wide, in which they turn little.
    small = middle + (field - middle) / 3.0
    assert turning(common_turn(segments, fit, small)) is None
    assert turning(common_turn(segments, fit, small, margin=AROUND)) is not None


def among(own: Segments, others: Segments) -> Segments:
    ends, sigma = np.concatenate([own.ends_px, others.ends_px]), np.r_[own.sigma_px, others.sigma_px]
    return Segments(ends, sigma, np.r_[own.level, others.level])


def test_what_turns_around_straight_slabs_is_something_else(fit: Fit):
    segments, field = sides_turned(fit, ALONG_X, 0.0)
    assert straight(directions(segments, fit, field))
    askew, _ = sides_turned(fit, ALONG_X, 56.0)
    middle = field.mean(0)
    # Four of the eight columns, so that two turn on either side.
    inner = middle + (field - middle) / [2.6, 1.2]
    outside = ~inside_box(on_ground(askew.ends_px, fit.camera, fit.cam_from_ground).mean(1), inner, 0.0)
    # Slabs amid stones that turn, as a board before what lies behind it.
    kept = inside_box(on_ground(segments.ends_px, fit.camera, fit.cam_from_ground).mean(1), inner, 0.0)
    both = among(segments.take(kept), askew.take(outside))
    assert turning(common_turn(both, fit, inner, margin=AROUND)) is not None
    assert _turned(both, fit, inner) is None


@pytest.mark.parametrize("along", [ALONG_X, ALONG_Y])
def test_what_crosses_straight_joints_at_an_angle_on_one_side_is_no_turn(fit: Fit, along: int):
    joints, field = sides_turned(fit, along, 0.0)
    # Shadows beyond the middle, as many as joints before it.
    ground = on_ground(joints.ends_px, fit.camera, fit.cam_from_ground).mean(1)
    beyond = ground[:, along] > field[:, along].mean()
    turn = np.where(beyond, np.radians(25.0), np.random.default_rng(2).normal(0.0, 0.01, len(joints)))
    crossed = about_their_middles(fit, joints, turn)
    assert common_turn(crossed, fit, field) is None
    # As much in little steps is a turn.
    assert turning(common_turn(sides_turned(fit, along, 35.0)[0], fit, field)) is not None


def about_their_middles(fit: Fit, segments: Segments, turn: Float[np.ndarray, " n"]) -> Segments:
    """Segments that are turned on the ground by so many radians each."""
    ground = on_ground(segments.ends_px, fit.camera, fit.cam_from_ground)
    middle = ground.mean(1, keepdims=True)
    c, s = np.cos(turn), np.sin(turn)
    R = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], 1)
    ends = middle + np.einsum("nij,nkj->nki", R, ground - middle)
    return replace(segments, ends_px=project_ground(fit.camera, fit.cam_from_ground, ends))


def scattered(fit: Fit, degrees: tuple[float, float]) -> tuple[Segments, Float[np.ndarray, "4 2"]]:
    """Sides of stones whose directions scatter by so much, along X and along Y, wherever they lie."""
    straight_ones, field = sides_turned(fit, ALONG_X, 0.0)
    turn = np.random.default_rng(5).normal(0.0, np.radians(np.repeat(degrees, COUNT * COUNT)))
    return about_their_middles(fit, straight_ones, turn), field


@pytest.mark.parametrize(
    ("degrees", "refused"), [((2.0, 2.0), False), ((9.0, 9.0), True), ((9.0, 1.0), False)]
)
def test_stones_that_point_anywhere_are_none_of_a_lattice(
    fit: Fit, degrees: tuple[float, float], refused: bool
):
    # Shadows and wickerwork scatter the edges of one family.
    segments, field = scattered(fit, degrees)
    refusal = _turned(segments, fit, field)
    assert (refusal is not None) == refused
    if refusal is not None:
        assert "askew" in refusal.message
        assert refusal.measured == pytest.approx(9.0, rel=0.2)


@pytest.mark.parametrize(
    ("degrees", "refused"),
    [((0.0, 0.0), False), ((2.0, 2.5), True), ((-2.0, -2.5), True), ((2.0, -2.0), False)],
)
def test_a_lattice_does_not_lie_across_its_stones(fit: Fit, degrees: tuple[float, float], refused: bool):
    # As that of a pinwheel of large and small squares does; a wrong camera turns the families apart.
    segments, field = scattered(fit, (0.2, 0.2))
    across = about_their_middles(fit, segments, np.radians(np.repeat(degrees, COUNT * COUNT)))
    refusal = _turned(across, fit, field)
    assert (refusal is not None) == refused
    if refusal is not None:
        assert "askew of its joints" in refusal.message
        assert refusal.measured == pytest.approx(2.0, abs=0.15)
        alike = turned_alike(directions(across, fit, field))
        assert alike is not None
        assert np.sign(alike.angle) == np.sign(degrees[0])


@pytest.mark.parametrize("family", [ALONG_X, ALONG_Y])
@pytest.mark.parametrize(
    ("degrees", "refused"), [((30.0, -30.0), True), ((30.0, 25.0), False), ((4.0, -4.0), False)]
)
def test_joints_that_run_aslant_to_either_side_in_turn_are_those_of_hexagons(
    fit: Fit, family: int, degrees: tuple[float, float], refused: bool
):
    # Those of slabs run along the lattice; stripes of light that cross them all run the same way.
    segments, field = scattered(fit, (0.3, 0.3))
    turn = np.zeros(len(segments))
    own = np.arange(COUNT * COUNT) + family * COUNT * COUNT
    turn[own] = np.radians(np.resize(degrees, len(own)))
    aslant = about_their_middles(fit, segments, turn)
    refusal = zigzag(directions(aslant, fit, field))
    assert (refusal is not None) == refused
    if refusal is not None:
        assert "hexagons" in refusal.message
        assert refusal.measured == pytest.approx(30.0, abs=0.5)
        own_refusal = _turned(aslant, fit, field)
        assert own_refusal is not None
        assert "hexagons" in own_refusal.message


def test_joints_along_a_lattice_outweigh_what_runs_aslant_of_it(fit: Fit):
    segments, field = scattered(fit, (0.3, 0.3))
    turn = np.radians(np.resize([0.0, 30.0, -30.0], len(segments)))
    assert zigzag(directions(about_their_middles(fit, segments, turn), fit, field)) is None


@pytest.mark.parametrize(("turn_deg", "count"), [(12.0, COUNT * COUNT), (0.0, 20)])
def test_stones_that_turn_and_few_ones_are_not_known_to_be_straight(fit: Fit, turn_deg: float, count: int):
    segments, field = sides_turned(fit, ALONG_X, turn_deg)
    some = segments.take(np.r_[:count, COUNT * COUNT : COUNT * COUNT + count])
    assert not straight(directions(some, fit, field))


@pytest.mark.parametrize("family", [ALONG_X, ALONG_Y])
def test_joints_of_one_family_that_turn_are_no_turning_stones(fit: Fit, family: int):
    # The shadows of a chair's wicker do, and joints seen with a wrong camera.
    segments, field = sides_turned(fit, ALONG_X, 30.0, (family,))
    assert turning(common_turn(segments, fit, field)) is None


def test_families_that_turn_against_each_other_are_no_turning_stones(fit: Fit):
    ways = [sides_turned(fit, ALONG_X, turn_deg)[0] for turn_deg in (30.0, -30.0)]
    half = len(ways[0]) // 2
    ends_px = np.concatenate([ways[0].ends_px[:half], ways[1].ends_px[half:]])
    segments = Segments(ends_px, ways[0].sigma_px, ways[0].level)
    assert turning(common_turn(segments, fit, sides_turned(fit, ALONG_X, 0.0)[1])) is None


@pytest.mark.parametrize("along", [ALONG_X, ALONG_Y])
@pytest.mark.parametrize("turn_deg", [0.0, 6.0, 30.0, -24.0])
def test_unbroken_joints_turn_beside_a_small_field_of_rows(fit: Fit, along: int, turn_deg: float):
    segments, field = sides_turned(fit, along, turn_deg, (ALONG_X,))
    middle = field.mean(0)
    # A third of it as long and as wide: the ground around reaches as far as the stones do.
    turn = turn_of_rows(segments, fit, middle + (field - middle) / 3.0)
    assert turn is not None
    assert np.degrees(turn.angle) == pytest.approx(5 / 7 * turn_deg, rel=0.05, abs=0.1)
    assert (turning(turn) is not None) == (abs(turn_deg) > 1.5 * MOST_FANNED_DEG)


def test_cross_joints_do_not_turn_rows(fit: Fit):
    segments, field = sides_turned(fit, ALONG_X, 30.0, (ALONG_Y,))
    assert turning(turn_of_rows(segments, fit, field)) is None


def test_too_few_joints_tell_no_turn(fit: Fit):
    segments, field = sides_turned(fit, ALONG_X, 30.0)
    some = np.r_[np.arange(len(segments) // 2), len(segments) // 2 + np.arange(3 * FEWEST_SEGMENTS - 1)]
    assert common_turn(segments.take(some), fit, field) is None
    assert turning(None) is None


def drawn(slabs: Slabs, camera: Camera, pose: Rigid, rng: np.random.Generator) -> UInt8[np.ndarray, "h w"]:
    """A picture of light stones on a dark bed, each at its place and turn, with noise."""
    turn = np.radians(slabs.turn_deg)
    c, s = np.cos(turn), np.sin(turn)
    R = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], 1)
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * slabs.size_m[:, None]
    ground = slabs.middle_m[:, None] + np.einsum("nij,nkj->nki", R, corners)
    return photo_of(ground, camera, pose, rng)


@pytest.mark.slow
def test_a_strip_along_the_crowns_of_fans_is_refused():
    seed = 3
    rng = np.random.default_rng(seed)
    camera = Camera.from_focal(1000, 750, 800.0)
    pose = look_at_ground(
        pitch_deg=rng.uniform(30, 60),
        height_m=rng.uniform(1.5, 3.0),
        heading_deg=rng.uniform(0, 90),
        foot_m=(0.1, 0.2),
    )
    rng = np.random.default_rng(seed)
    fans = lay(Paving(layout="fan", joint_m=0.012, half_size_m=5.0), np.zeros(2), rng)
    moved = fans.middle_m + 0.003 * rng.standard_normal(fans.middle_m.shape)
    stones = Slabs(moved, fans.size_m, fans.turn_deg, fans.parity)
    with pytest.raises(Refusal) as refused:
        align(drawn(stones, camera, pose, rng), camera)
    assert refused.value.code == "no_lattice"
    assert "these stones turn by" in refused.value.message
