from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from made_sides import drawn_presence
from paved import GRAVEL, gray_of, misses, nudged

from autoreg.fitting.fit import Fit
from autoreg.ground.ground_frame import with_origin
from autoreg.ground.points import project_ground
from autoreg.ground.sides import ALONG_X, ALONG_Y, Grid, slab_sides, visible_sides
from autoreg.ground.sight import looks_at
from autoreg.joints.joint_looks import Strip
from autoreg.paving.lattice_choice import carry, of_joints_alone, settle_bond, suited, with_pattern
from autoreg.paving.lattice_evidence import Paving, presented, rival, same_lattice, told_twice
from autoreg.paving.lay import fills, fitted_anew, lay_lattice, refine_in_field
from autoreg.paving.multiples import divided
from autoreg.paving.patterns import Pattern
from autoreg.paving.plane_combs import comb_planes
from autoreg.paving.presence import Presence
from autoreg.paving.side_support import CLOSE, PAIRED_COST, USUAL, Effort, presence_of
from autoreg.segments import detect_segments
from autoreg.solve.freedom import Free
from autoreg.synthetic import SyntheticPhoto

ALL = Pattern(1, 0, 0, 0.0)


def segments_of(photo: SyntheticPhoto):
    return detect_segments(photo.pixels.mean(-1).astype(np.uint8))


def spacing_of(fit: Fit) -> tuple[float, float]:
    assert fit.grid.spacing_x is not None
    return fit.grid.spacing_x, fit.grid.spacing_y


def in_metres(fit: Fit, photo: SyntheticPhoto) -> Fit:
    """The fit in the unit of the photo's own frame, by the slabs' area."""
    a, b = spacing_of(fit)
    lattice = photo.lattice
    assert lattice is not None
    assert lattice.spacing_x is not None
    scale = float(np.sqrt(lattice.spacing_x * lattice.spacing_y / (a * b)))
    pose = replace(fit.cam_from_ground, t=scale * fit.cam_from_ground.t)
    return replace(fit, cam_from_ground=pose, grid=Grid(scale * a, scale * b, fit.grid.shift))


def patterns(grid: Grid) -> list[tuple[Pattern, Pattern]]:
    """Every pattern of one family's sides up to a period of four; of a running bond, of its columns alone."""
    ways = [
        Pattern(period, advance, phase, 0.0)
        for period in (2, 3, 4)
        for advance in range(period)
        for phase in range(period)
    ]
    return [(ALL, way) for way in ways] + ([] if grid.shift else [(way, ALL) for way in ways])


def joint_points(grid: Grid, x: Pattern, y: Pattern) -> tuple[np.ndarray, np.ndarray]:
    """Middles of a lattice's sides near the origin, and whether the patterns say that they are there."""
    sides = slab_sides(grid, np.full(2, -2.0), np.full(2, 2.0))
    there = np.zeros(len(sides), bool)
    for family, pattern in ((ALONG_X, x), (ALONG_Y, y)):
        residue = (sides.line - sides.cell * pattern.advance) % pattern.period
        there |= (sides.family == family) & (residue == pattern.phase)
    # A third of the way along, so that no point is a crossing of another line of the finer lattice.
    return sides.ends[:, 0] + (sides.ends[:, 1] - sides.ends[:, 0]) * 0.37, there


def lies_on(grid: Grid, points: np.ndarray) -> np.ndarray:
    """Which points lie on a joint of a lattice."""
    a, b = grid.spacing_x or 1.0, grid.spacing_y
    row, column = points[:, 1] / b, points[:, 0] / a
    on_x = np.abs(row - np.round(row)) < 1e-6
    moved = column - np.floor(row) * grid.shift
    return on_x | (np.abs(moved - np.round(moved)) < 1e-6)


@pytest.mark.parametrize("shift", [0.0, 1 / 2])
def test_the_lattice_that_a_pattern_means_has_the_sides_that_are_there_and_no_others(
    stack_fit: Fit, shift: float
):
    grid = Grid(0.3, 0.5, shift)
    before = replace(stack_fit, grid=grid, strip=Strip((0.01, 0.02), 0.8, (-1, 1)))
    for x, y in patterns(grid):
        after = with_pattern(before, x, y)
        assert after is not None
        points, there = joint_points(grid, x, y)
        flat = np.column_stack([points, np.zeros(len(points))])
        told = after.cam_from_ground.inverse.apply(before.cam_from_ground.apply(flat))
        assert told[:, 2] == pytest.approx(0.0, abs=1e-9)
        assert (lies_on(after.grid, told[:, :2]) == there).all()
        # If X and Y have changed roles, so have the widths of their joints.
        turned = abs(after.cam_from_ground.R[:, 0] @ before.cam_from_ground.R[:, 0]) < 0.5
        assert after.strip.width == ((0.02, 0.01) if turned else (0.01, 0.02))


def test_a_lattice_of_which_every_side_is_there_stays(stack_fit: Fit):
    assert with_pattern(stack_fit, ALL, ALL) is None


@pytest.mark.parametrize(
    ("name", "start"),
    [
        ("stack", Grid(0.3, 0.4)),
        ("stack", Grid(0.6, 0.2)),
        ("stack", Grid(0.3, 0.2)),
        ("stack", Grid(1.2, 0.4)),
        ("half", Grid(0.3, 0.3)),
        ("half", Grid(0.6, 0.3)),
        ("half", Grid(1.8, 0.3, 0.5)),
    ],
    ids=[
        "half columns",
        "half rows",
        "both halved",
        "double columns",
        "bond read as a stack",
        "bond read as every other row",
        "treble columns",
    ],
)
def test_too_fine_and_too_coarse_lattices_settle_on_the_one_that_is_there(
    name: str, start: Grid, request: pytest.FixtureRequest
):
    fit: Fit = request.getfixturevalue(f"{name}_fit")
    photo: SyntheticPhoto = request.getfixturevalue(f"{name}_photo")
    settled = settle_bond(gray_of(photo), replace(fit, grid=start))
    assert settled is not None
    assert settled.margin_nats > 0
    assert sorted(spacing_of(settled.fit)) == pytest.approx(sorted(spacing_of(fit)))
    assert settled.grid.shift == pytest.approx(fit.grid.shift)
    angle_deg, crossing_px = misses(settled.fit.cam_from_ground, spacing_of(settled.fit), photo)
    assert angle_deg < 0.01
    assert crossing_px < 0.1


@pytest.mark.parametrize("shift", [0.0, 1 / 4, 1 / 3, 1 / 2, 2 / 3, 0.72])
@pytest.mark.parametrize("factor", [2, 3])
def test_the_columns_of_a_lattice_are_found_again_among_so_many_times_as_many(
    stack_fit: Fit, shift: float, factor: int
):
    coarse = replace(stack_fit, grid=Grid(0.6, 0.3, shift))
    fine = divided(coarse, ALONG_Y, factor)
    assert fine is not None
    sides = slab_sides(fine.grid, np.full(2, -2.0), np.full(2, 2.0))
    sides = sides.take(np.flatnonzero(sides.family == ALONG_Y))
    old = (sides.line - sides.cell * carry(coarse.grid, factor)) % factor == 0
    middle = sides.middle
    column = middle[:, 0] / 0.6 - np.floor(middle[:, 1] / 0.3) * shift
    assert (old == (np.abs(column - np.round(column)) < 1e-6)).all()


@pytest.mark.parametrize(("share", "darker"), [(0.4, 4.0), (0.55, 12.0), (0.7, 30.0)])
@pytest.mark.parametrize("rows", [1, 2], ids=["from the slabs", "from half the rows"])
def test_marks_half_way_between_the_joints_do_not_halve_the_slabs(
    share: float, darker: float, rows: int, stack_fit: Fit, stack_photo: SyntheticPhoto
):
    halved = replace(stack_fit, grid=Grid(0.6, 0.2))
    sides = visible_sides(
        halved.camera, halved.cam_from_ground, halved.grid, reach=12.0, min_px=8.0, only=ALONG_X
    )
    marked = (sides.line % 2 == 1) & (np.random.default_rng(3).uniform(size=len(sides)) < share)
    ends = project_ground(halved.camera, halved.cam_from_ground, sides.ends[marked])
    picture = gray_of(stack_photo)
    mask = np.zeros(picture.shape, np.uint8)
    for a, b in np.rint(16 * ends).astype(int).tolist():
        cv2.line(mask, a, b, 255, 1, cv2.LINE_AA, 4)
    settled = settle_bond(picture - darker / 255 * mask, replace(stack_fit, grid=Grid(0.6, 0.4 / rows)))
    assert settled is not None
    assert spacing_of(settled.fit) == pytest.approx(spacing_of(stack_fit))


@pytest.mark.parametrize(("columns", "rows"), [(1, 1), (2, 1), (1, 2), (2, 2), (3, 2)])
def test_a_lattice_within_which_another_one_s_sides_alone_are_joints_is_known_to_be_too_fine(
    columns: int, rows: int, stack_fit: Fit, stack_photo: SyntheticPhoto
):
    a, b = spacing_of(stack_fit)
    fine = replace(stack_fit, grid=Grid(a / columns, b / rows))
    paving = presented(gray_of(stack_photo), fine)
    assert paving is not None
    alone = of_joints_alone(gray_of(stack_photo), paving)
    if columns == rows == 1:
        assert alone is None
    else:
        assert alone is not None
        assert same_lattice(alone.fit, stack_fit)


@pytest.mark.parametrize("worse", [USUAL, CLOSE])
def test_an_unclear_lattice_is_judged_by_the_look_that_shows_it_better(
    worse: Effort, stack_fit: Fit, stack_photo: SyntheticPhoto, monkeypatch: pytest.MonkeyPatch
):
    gray, looks = gray_of(stack_photo), dict[Effort, Presence]()

    def look(picture: np.ndarray, fit: Fit, effort: Effort = USUAL, **options: object):
        presence = presence_of(gray, fit, effort)
        dim = np.maximum(presence.p, 0.05) if effort == worse else presence.p
        return looks.setdefault(effort, replace(presence, p=dim))

    monkeypatch.setattr("autoreg.paving.lattice_evidence.presence_of", look)
    monkeypatch.setattr("autoreg.paving.lattice_evidence.PLAIN_NATS", np.inf)
    paving = presented(gray, stack_fit)
    assert paving is not None
    better = looks[USUAL if worse == CLOSE else CLOSE]
    assert len(looks) == 2
    assert paving.presence is better


@pytest.mark.parametrize(("polarity", "clear"), [(0, True), (-1, False)])
def test_lines_of_two_tones_are_looked_for_where_steps_leave_one_family_in_doubt(
    stack_fit: Fit, stack_photo: SyntheticPhoto, monkeypatch: pytest.MonkeyPatch, polarity: int, clear: bool
):
    gray, rng = gray_of(stack_photo), np.random.default_rng(5)

    def look(picture: np.ndarray, fit: Fit, effort: Effort = USUAL, *, paired: bool = False, **_: object):
        presence = presence_of(gray, stack_fit, effort)
        hidden = (presence.sides.family == ALONG_X) & (not paired)
        p = np.where(hidden, rng.uniform(size=len(presence.p)), presence.p)
        return replace(presence, p=p, looks_nats=PAIRED_COST if paired else 0.0)

    def closer(picture: np.ndarray, fit: Fit, presence: Presence, *_: object, **__: object) -> Presence:
        return presence

    monkeypatch.setattr("autoreg.paving.lattice_evidence.presence_of", look)
    monkeypatch.setattr("autoreg.paving.lattice_evidence.looked_at_closer", closer)
    strip = replace(stack_fit.strip, polarity=(polarity, -1))
    paving = presented(gray, replace(stack_fit, strip=strip))
    assert (paving is not None and paving.plain) == clear
    if paving is not None:
        assert paving.presence.looks_nats == (PAIRED_COST if clear else 0.0)


@pytest.mark.parametrize("gaps", [False, True])
def test_a_small_field_whose_joints_break_off_as_those_of_herringbone_is_no_lattice(
    stack_fit: Fit, stack_photo: SyntheticPhoto, monkeypatch: pytest.MonkeyPatch, gaps: bool
):
    sides = slab_sides(Grid(1.0, 1.0), np.zeros(2), np.full(2, 12.0))
    cuts = gaps & (sides.family == ALONG_Y) & ((sides.line - sides.cell) % 4 == 1)
    closer = drawn_presence(sides, ~cuts, np.random.default_rng(3))
    monkeypatch.setattr("autoreg.paving.lattice_evidence.looked_at_closer", lambda *_, **__: closer)
    monkeypatch.setattr("autoreg.paving.lattice_evidence.PLAIN_NATS", np.inf)
    assert (presented(gray_of(stack_photo), stack_fit) is None) == gaps


def test_halves_of_a_slab_do_not_suit_it_though_they_have_its_shape(
    stack_fit: Fit, stack_photo: SyntheticPhoto
):
    a, b = spacing_of(stack_fit)
    # Of every second row of these, halves of the slabs are left.
    fine = presented(gray_of(stack_photo), replace(stack_fit, grid=Grid(a / 2, b / 4)))
    assert fine is not None
    found = suited(gray_of(stack_photo), (fine,), (a, b), halves=True)
    assert same_lattice(found[0].fit, stack_fit)


@pytest.mark.parametrize("name", ["stack", "half"])
def test_from_a_roughly_known_plane_to_the_lattice(name: str, request: pytest.FixtureRequest):
    photo: SyntheticPhoto = request.getfixturevalue(f"{name}_photo")
    true = photo.cam_from_ground
    wrong = nudged(true, 12.0, 0.0, 4)
    looks = looks_at(photo.pixels.mean(-1).astype(np.uint8))
    planes = comb_planes(
        looks,
        segments_of(photo),
        [(photo.camera, wrong.R), (photo.camera, nudged(true, 0.5, 0.0, 3).R)],
        free_focal=False,
    )
    assert len(planes) == 2
    assert planes[0].score > planes[1].score
    up = [plane.R[:, 2] @ true.R[:, 2] for plane in planes]
    assert np.rad2deg(np.arccos(np.clip(up[0], -1, 1))) < 1.0
    pavings = lay_lattice(looks, planes[0], Free(ratio=True))
    assert pavings[0].margin_nats > 0
    assert rival(pavings) is None
    fit = in_metres(pavings[0].fit, photo)
    angle_deg, crossing_px = misses(fit.cam_from_ground, spacing_of(fit), photo)
    assert angle_deg < 0.05
    assert crossing_px < 0.3


def test_a_fit_fills_the_field_that_it_was_made_in_and_no_other(stack_fit: Fit, stack_photo: SyntheticPhoto):
    field = presence_of(gray_of(stack_photo), stack_fit).field
    fit = refine_in_field(gray_of(stack_photo), stack_fit, field)
    assert fills(fit, field)
    part = field.mean(0) + 0.7 * (field - field.mean(0))
    assert not fills(fit, part)
    assert not fills(refine_in_field(gray_of(stack_photo), stack_fit, part), field)


def test_a_lattice_is_the_same_from_any_of_its_crossings_and_from_no_other_place(half_fit: Fit):
    a, b = spacing_of(half_fit)

    def same(column: float, row: float) -> bool:
        x = (column + row * half_fit.grid.shift) * a
        pose = with_origin(half_fit.cam_from_ground, x, row * b)
        return same_lattice(half_fit, replace(half_fit, cam_from_ground=pose))

    assert all(same(*crossing) for crossing in ((0, 0), (3, 0), (-1, 2), (2, -3)))
    assert not any(same(*place) for place in ((0.5, 0), (0, 0.5)))
    wider = replace(half_fit, grid=replace(half_fit.grid, spacing_x=2 * a))
    assert not same_lattice(half_fit, wider)


def test_a_bond_that_a_bad_fit_hid_shows_when_its_lattice_is_fitted_anew(
    half_fit: Fit, half_photo: SyntheticPhoto
):
    picture = gray_of(half_photo)
    halves = replace(half_fit, grid=Grid(0.3, 0.3), free=Free(ratio=True))
    hidden = Paving(halves, presence_of(picture, halves), (0.0, 0.0))
    again = fitted_anew(picture, hidden)
    assert again is not None
    assert again.grid.shift == 0.5
    assert spacing_of(again.fit) == pytest.approx((0.6, 0.3), rel=0.01)


def test_a_lattice_in_another_unit_is_no_rival(stack_fit: Fit, stack_photo: SyntheticPhoto):
    presence = presence_of(gray_of(stack_photo), stack_fit)
    best = Paving(stack_fit, presence, (40.0, 40.0))
    pose, (a, b) = stack_fit.cam_from_ground, spacing_of(stack_fit)
    same = replace(stack_fit, cam_from_ground=replace(pose, t=1.4 * pose.t), grid=Grid(1.4 * a, 1.4 * b))
    assert rival((best, replace(best, fit=same))) is None
    finer = replace(best, fit=replace(stack_fit, grid=Grid(a / 2, b)))
    assert rival((best, finer)) is finer


def test_no_lattice_is_laid_on_gravel(gravel_photo: SyntheticPhoto):
    looks = looks_at(gravel_photo.pixels.mean(-1).astype(np.uint8))
    planes = comb_planes(
        looks,
        segments_of(gravel_photo),
        [(gravel_photo.camera, GRAVEL.cam_from_ground.R)],
        free_focal=False,
    )
    pavings = [p for plane in planes for p in lay_lattice(looks, plane, Free(ratio=True))]
    assert all(paving.margin_nats < 0 for paving in pavings)


def test_a_lattice_is_told_twice_where_two_starts_lead_to_it_as_clearly(
    stack_fit: Fit, stack_photo: SyntheticPhoto
):
    a, b = spacing_of(stack_fit)
    clear = Paving(stack_fit, presence_of(gray_of(stack_photo), stack_fit), (60.0, 60.0))
    weaker = replace(clear, evidence_nats=(45.0, 45.0))
    finer = replace(weaker, fit=replace(stack_fit, grid=Grid(a / 2, b)))
    assert told_twice((clear, weaker))
    assert told_twice((weaker, clear))
    assert not told_twice((clear,))
    assert not told_twice((clear, finer))
    assert not told_twice((clear, replace(weaker, evidence_nats=(20.0, 20.0))))
